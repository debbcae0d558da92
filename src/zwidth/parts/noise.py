"""What a quantized position makes of a velocity: noise, in closed form for each estimate.

A device that moves over many counts a period has an error of its position that is nearly white and uniform over one
count Q, of variance ``Q^2/12``. Through ``F(z)`` with the impulse response f its variance becomes
``Q^2/12 sum f_k^2``; with the pole ``p`` of a low-pass

    difference            sum f^2 = 2/T^2
    difference over n     2/(n T)^2
    one low-pass          2 (1 - p)^2/((1 + p) T^2)
    two low-passes        2 (1 - p)^3/((1 + p)^3 T^2)
"""

from __future__ import annotations

import math
from typing import Any

from zwidth.parts.velocity import BackwardDifference, LowPass, Velocity, WindowedDifference
from zwidth.words.errors import InputError


def find_velocity_noise(velocity: Velocity, period: Any, resolution: float) -> float:
    """The standard deviation of a velocity estimate, in m/s.

    Args:
        velocity: a difference, a windowed difference or a low-pass.
        period: of the loop, in s.
        resolution: Q, one count of the position, in m.

    Raises:
        InputError: there is no closed form for the estimate.

    References:
        Widrow, Kollar 2008, Quantization Noise, chapter 5 (the white error of variance Q^2/12).
    """
    estimate = velocity.estimate(period)
    power = 2.0 * (float(estimate.gain) / (estimate.window * period)) ** 2 if estimate.window else math.nan
    if isinstance(velocity, LowPass):
        offset = float(estimate.poles[0].real)
        # 1 + p = 2 - (1 - p); the gain holds (1 - p) once for every low-pass.
        power /= (2.0 - offset) if velocity.order == 1 else offset * (2.0 - offset) ** 3
    elif not isinstance(velocity, BackwardDifference | WindowedDifference):
        raise InputError(
            f"velocity: got {type(velocity).__name__}, whose noise has no closed form here; use a difference, a "
            "windowed difference or a low-pass"
        )
    return resolution * math.sqrt(power / 12.0)
