"""Noise of a velocity estimate due to the resolution of the position sensor."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from zwidth.parts.state_space import estimate_matrices
from zwidth.parts.velocity import Estimate, Velocity

DOUBLINGS = 60  # each doubles the length of the impulse response summed; time constants of 1e15 periods are covered


def find_velocity_noise(velocity: Velocity, period: Any, resolution: float) -> float:
    """Return the standard deviation in m/s of a velocity estimate of quantized positions.

    The quantization error is nearly white with variance ``Q^2/12`` (Widrow, Kollar 2008, chapter 5). An estimate F(z)
    with impulse response f_k amplifies the variance by ``sum f_k^2``.
    """
    estimate = velocity.estimate(period)
    return resolution / period * math.sqrt(_sum_squared_response(estimate) / 12.0)


def _sum_squared_response(estimate: Estimate) -> float:
    """Return the sum of the squared impulse response for T = 1."""
    if estimate.window and not estimate.zeros.size and not estimate.poles.size:
        return 2.0 * (float(estimate.gain) / estimate.window) ** 2
    A, B, C, D, _ = estimate_matrices(estimate)
    # The controllability Gramian sum A^k B B' A'^k, by doubling the number of its terms (Smith 1968).
    gramian, power = B @ B.T, A
    for _ in range(DOUBLINGS):
        added = power @ gramian @ power.T
        gramian, power = gramian + added, power @ power
        if np.abs(added).max(initial=0.0) <= np.finfo(float).eps * np.abs(gramian).max(initial=0.0):
            break
    return float((C @ gramian @ C.T + D * D)[0, 0])
