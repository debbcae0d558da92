"""Float64 numbers with a proved error: a midpoint and a radius, elementwise over arrays, in NumPy or in JAX.

A `Ball` contains the exact number. Every operation bounds its own rounding by ``u |mid|``, u = 2^-53 (binary64
``+ - * /`` round correctly; XLA may fuse a product into a sum, which only removes an error), and by `TINY` what is lost
below 2^-1022, where XLA takes numbers for zero. Radii are sums and products of positive numbers: each operation on them
errs by a few u of the radius, thousands of them by less than 2^-30, which is added wherever a radius is used.

The operators are those of python-flint's ``arb``, so that one text runs in both. A comparison is true where it is
certain for every number of the balls; NaN, and a radius that overflowed, make none certain.
"""

from __future__ import annotations

from math import frexp
from typing import Any

from zwidth.arrays.xp import namespace
from zwidth.words.types import Array

UNIT = 2.0**-53
TINY = 2.0**-1000
# What the rounding of radii may have lost.
INFLATED = 1.0 + 2.0**-30
_ROOT_ERROR = 2.0 * UNIT


class Ball:
    """``mid`` within ``rad``; a radius of None says that ``mid`` is the number itself."""

    __slots__ = ("mid", "rad")
    # NumPy then leaves ``array * ball`` to the ball.
    __array_ufunc__ = None

    def __init__(self, mid: Any, rad: Any = None):
        self.mid = mid
        self.rad = rad

    @property
    def radius(self) -> Any:
        """The distance from ``mid`` that no number of the ball exceeds."""
        return 0.0 if self.rad is None else INFLATED * self.rad

    def lower(self) -> Any:
        """A float64 number below or at every number of the ball."""
        end = self.mid - self.radius
        return end - 2.0 * _rounding(end)

    def __neg__(self) -> Ball:
        return Ball(-self.mid, self.rad)

    def __abs__(self) -> Ball:
        return Ball(abs(self.mid), self.rad)

    def __add__(self, other: Any) -> Ball:
        if not isinstance(other, Ball):
            other = Ball(other)
        mid = self.mid + other.mid
        rad = UNIT * abs(mid) + TINY
        if self.rad is not None:
            rad = self.rad + rad
        if other.rad is not None:
            rad = other.rad + rad
        return Ball(mid, rad)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Ball:
        return self + (-as_ball(other))

    def __rsub__(self, other: Any) -> Ball:
        return (-self) + other

    def __mul__(self, other: Any) -> Ball:
        if not isinstance(other, Ball):
            if isinstance(other, int | float) and abs(frexp(other)[0]) == 0.5:
                # A power of two only moves the exponent.
                rad = None if self.rad is None else self.rad * abs(other)
                return Ball(self.mid * other, rad if abs(other) >= 1.0 else _total(rad, TINY))
            other = Ball(other)
        mid = self.mid * other.mid
        rad = UNIT * abs(mid) + TINY
        if self.rad is not None:
            rad = abs(other.mid) * self.rad + rad
        if other.rad is not None:
            rad = (abs(self.mid) if self.rad is None else abs(self.mid) + self.rad) * other.rad + rad
        return Ball(mid, rad)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Ball:
        other = as_ball(other)
        mid = self.mid / other.mid
        spread = _total(self.rad, None if other.rad is None else abs(mid) * other.rad)
        if spread is None:
            return Ball(mid, _rounding(mid))
        # The divisor's smallest size: inflated, for it is a difference. Where it is not positive, nothing is known.
        least = abs(other.mid) - other.radius
        xp = namespace(least)
        return Ball(mid, xp.where(least > 0, (1.0 + 4.0 * UNIT) * spread / least, xp.inf) + _rounding(mid))

    def __rtruediv__(self, other: Any) -> Ball:
        return as_ball(other) / self

    def sqrt(self) -> Ball:
        """The root of every number of the ball that is not negative; nothing is known where ``mid`` is not positive."""
        xp = namespace(self.mid)
        mid = xp.sqrt(xp.where(self.mid > 0, self.mid, xp.nan))
        own = _ROOT_ERROR * mid + TINY
        # |sqrt x - sqrt m| = |x - m|/(sqrt x + sqrt m)
        return Ball(mid, own if self.rad is None else self.rad / mid + own)

    def __gt__(self, other: Any) -> Any:
        difference = self if _is_zero(other) else self - other
        return difference.mid > difference.radius

    def __lt__(self, other: Any) -> Any:
        difference = self if _is_zero(other) else self - other
        return difference.mid < -difference.radius


def as_ball(value: Any) -> Ball:
    """A ball as it is, a float64 number or array as an exact one."""
    return value if isinstance(value, Ball) else Ball(value)


def _is_zero(value: Any) -> bool:
    return isinstance(value, int | float) and value == 0


def _rounding(mid: Array) -> Array:
    return UNIT * abs(mid) + TINY


def _total(*parts: Any) -> Any:
    """The sum of the radii that there are."""
    total = None
    for part in parts:
        if part is not None:
            total = part if total is None else total + part
    return total
