"""Where the model is computed: one range for every function, checked here.

No device lies outside; inside, no square or product of the formulas overflows or loses its digits. A value that is NaN,
infinite or negative where it must not be is INVALID_INPUT, one beyond the ranges OUT_OF_RANGE, in that order.
"""

from __future__ import annotations

import numpy as np

from zwidth.arrays.xp import namespace
from zwidth.words.quantities import LARGEST_DAMPING, LONGEST_DELAY, WALL_RANGE
from zwidth.words.status import Status
from zwidth.words.types import Array


def within(value: Array, limits: tuple[float, float]) -> Array:
    """Whether a value is 0 or of a magnitude within ``limits``."""
    size = abs(value)
    # In single precision the limits lie outside of what there is.
    kind = getattr(size, "dtype", np.float64)
    most = limits[1] if kind == np.float64 else min(limits[1], float(np.finfo(kind).max))
    return (size == 0) | ((size >= limits[0]) & (size <= most))


def valid_device(delta: Array, d: Array) -> Array:
    """Whether a device and its delay lie where the model is computed."""
    # What is NaN or infinite compares as outside.
    return (delta >= 0) & (delta <= LARGEST_DAMPING) & (d >= 0) & (d <= LONGEST_DELAY)


def valid_wall(alpha: Array, beta: Array, delta: Array, d: Array) -> Array:
    """Whether a wall on a device lies where the model is computed."""
    return valid_device(delta, d) & within(alpha, WALL_RANGE) & within(beta, WALL_RANGE)


def device_status(delta: Array, d: Array) -> Array:
    """The `Status` of a device and its delay."""
    return _status(valid_device(delta, d), delta, d)


def wall_status(alpha: Array, beta: Array, delta: Array, d: Array) -> Array:
    """The `Status` of a wall on a device."""
    return _status(valid_wall(alpha, beta, delta, d), delta, d, alpha, beta)


def _status(inside: Array, delta: Array, d: Array, *others: Array) -> Array:
    xp = namespace(delta, d, *others)
    valid = (delta >= 0) & (d >= 0)
    for value in (delta, d, *others):
        valid = valid & xp.isfinite(value)
    status = xp.where(valid, xp.where(inside, int(Status.OK), int(Status.OUT_OF_RANGE)), int(Status.INVALID_INPUT))
    return status.astype(np.int32)


# A bad point is NaN, and so are its derivatives: `where(ok, value, nan)` alone would give it the derivative 0, a finite
# number that means nothing. What may compute with NaN is voided before; what may not (a solver, a search, an
# exponent) gets harmless numbers, and its results are poisoned behind.


def nan_unless(ok: Array, *values: Array) -> tuple[Array, ...]:
    """The values where ``ok``, else NaN: so is what is computed with them, derivatives included."""
    xp = namespace(ok, *values)
    factor = xp.where(ok, 1.0, np.nan)
    return tuple([value * factor for value in values])


def nan_with_nan_slopes(ok: Array, *inputs: Array) -> Array:
    """Something to add to a result: 0 where ``ok``, else NaN with NaN first and second derivatives in every input."""
    xp = namespace(ok, *inputs)
    # Chosen twice: an input so large that its square overflows must not turn 0 into NaN where all is well.
    total = sum(xp.where(ok, 0.0, value) for value in inputs)
    return xp.where(ok, 0.0, np.nan) * total * (1.0 + total)
