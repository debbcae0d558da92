"""Noise of velocity estimates: the standard deviation of the velocity caused by quantization of the position.

The quantization error is modeled as white noise with variance Q^2/12, where Q is the resolution (Widrow, Kollar 2008,
chapter 5). A velocity filter with the impulse response f_k multiplies the variance by the sum of f_k^2.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from zwidth.model.estimate import Estimate
from zwidth.model.state_space import realize_estimate
from zwidth.model.velocity import Velocity

DOUBLINGS = 60  # largest number of doublings of the number of terms; 2^60 terms suffice for time constants of 1e15 T


def find_velocity_noise(velocity: Velocity, period: Any, resolution: float) -> float:
    """Return the standard deviation in m/s of a velocity that is estimated from quantized positions.

    Args:
        velocity: velocity estimate.
        period: sampling period in s.
        resolution: quantization step of the position in m.
    """
    estimate = velocity.estimate(period)
    return resolution / period * math.sqrt(_sum_squared_response(estimate) / 12.0)


def _sum_squared_response(estimate: Estimate) -> float:
    """Return the sum of the squares of the impulse response of a velocity estimate that is normalized to T = 1."""
    if estimate.window and not estimate.zeros.size and not estimate.poles.size:
        return 2.0 * (float(estimate.gain) / estimate.window) ** 2
    A, B, C, D, _ = realize_estimate(estimate)
    # The sum of squares is C G C' + D^2 with the controllability Gramian G, the sum of A^k B B' A'^k. Smith's method
    # (1968) doubles the number of summed terms in each step.
    gramian, power = B @ B.T, A
    for _ in range(DOUBLINGS):
        added = power @ gramian @ power.T
        gramian, power = gramian + added, power @ power
        if np.abs(added).max(initial=0.0) <= np.finfo(float).eps * np.abs(gramian).max(initial=0.0):
            break
    return float((C @ gramian @ C.T + D * D)[0, 0])
