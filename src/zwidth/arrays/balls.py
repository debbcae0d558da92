"""Float64 numbers with a proved error: a midpoint and a radius, elementwise over arrays, in NumPy or in JAX.

A `Ball` contains the exact number. Every operation bounds its own rounding by ``u |mid|``, u = 2^-53 (binary64
``+ - * /`` round correctly; XLA may fuse a product into a sum, which only removes an error), and by `TINY` what is lost
below 2^-1022, where XLA takes numbers for zero. Radii are sums and products of positive numbers: each operation on them
errs by a few u of the radius, thousands of them by less than 2^-30, which is added wherever a radius is used.

The operators are those of python-flint's ``arb``, so that one text runs in both. A comparison is true where it is
certain for every number of the balls; NaN, and a radius that overflowed, make none certain.
"""

from __future__ import annotations

from importlib.util import find_spec
from math import frexp
from typing import Any, TypeAlias

import numpy as np

from zwidth.words.types import Array
from zwidth.words.xp import namespace

UNIT = 2.0**-53
TINY = 2.0**-1000
# What the rounding of radii may have lost.
INFLATED = 1.0 + 2.0**-30
_ROOT_ERROR = 2.0 * UNIT

# Precisions of python-flint, one after the other until one is enough.
BITS = tuple(128 << k for k in range(7))


def available() -> bool:
    """Whether python-flint is installed."""
    return find_spec("flint") is not None


class Ball:
    """``mid`` within ``rad``."""

    __slots__ = ("mid", "rad")
    # NumPy then leaves ``array * ball`` to the ball.
    __array_ufunc__ = None

    def __init__(self, mid: Any, rad: Any = 0.0):
        self.mid = mid
        self.rad = rad

    @property
    def radius(self) -> Any:
        """The distance from ``mid`` that no number of the ball exceeds."""
        return INFLATED * self.rad

    def lower(self) -> Any:
        """A float64 number below or at every number of the ball."""
        end = self.mid - self.radius
        return end - 2.0 * _rounding(end)

    def __neg__(self) -> Ball:
        return Ball(-self.mid, self.rad)

    def __abs__(self) -> Ball:
        return Ball(abs(self.mid), self.rad)

    def __add__(self, other: Any) -> Ball:
        other = as_ball(other)
        mid = self.mid + other.mid
        return Ball(mid, _rounding(mid) + self.rad + other.rad)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        return self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return (-self) + other

    def __mul__(self, other: Any) -> Ball:
        if not isinstance(other, Ball):
            if isinstance(other, int | float) and abs(frexp(other)[0]) == 0.5:
                # A power of two only moves the exponent.
                return Ball(self.mid * other, self.rad * abs(other) + (TINY if abs(other) < 1.0 else 0.0))
            other = Ball(other)
        mid = self.mid * other.mid
        return Ball(mid, _rounding(mid) + abs(other.mid) * self.rad + (abs(self.mid) + self.rad) * other.rad)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Ball:
        other = as_ball(other)
        mid = self.mid / other.mid
        spread = self.rad + abs(mid) * other.rad
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
        return Ball(mid, self.rad / mid + own)

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


class Form(Ball):
    """How a quantity depends on the uncertain ones of a box: ``mid + sum_i lin_i e_i + r``, |e_i| <= 1, |r| <= rad.

    One e_i stands for each uncertain quantity (affine arithmetic: Comba, Stolfi 1993). What depends on the same one
    cancels, so that the width of what is left shrinks with the square of the box. Rounding is bounded as that of balls.
    Over arrays: ``mid`` and ``rad`` of shape (boxes,), ``lin`` of shape (quantities, boxes).
    """

    __slots__ = ("lin",)

    def __init__(self, mid: Any, lin: Any, rad: Any):
        super().__init__(mid, rad)
        self.lin = lin

    @property
    def radius(self) -> np.ndarray:
        return INFLATED * (np.abs(self.lin).sum(axis=0) + self.rad)

    def upper(self) -> np.ndarray:
        """A number above every value."""
        end = self.mid + self.radius
        return end + 2.0 * _rounding(end)

    def __neg__(self) -> Form:
        return Form(-self.mid, -self.lin, self.rad)

    def __add__(self, other: Any) -> Form:
        if not isinstance(other, Form):
            mid = self.mid + other
            return Form(mid, self.lin, self.rad + (UNIT * np.abs(mid) + TINY))
        mid, lin = self.mid + other.mid, self.lin + other.lin
        rounding = UNIT * (np.abs(mid) + np.abs(lin).sum(axis=0)) + TINY
        return Form(mid, lin, self.rad + other.rad + rounding)

    __radd__ = __add__

    def __mul__(self, other: Any) -> Form:
        if not isinstance(other, Form):
            mid, lin, size = self.mid * other, self.lin * other, np.abs(other)
            rounding = UNIT * (np.abs(mid) + np.abs(lin).sum(axis=0)) + TINY
            return Form(mid, lin, self.rad * size + rounding)
        mid = self.mid * other.mid
        left, right = self.mid * other.lin, other.mid * self.lin
        first, second = np.abs(self.lin).sum(axis=0), np.abs(other.lin).sum(axis=0)
        sides = np.abs(self.mid), np.abs(other.mid)
        beyond = sides[0] * other.rad + sides[1] * self.rad + (first + self.rad) * (second + other.rad)
        rounding = UNIT * (np.abs(mid) + 2.0 * (sides[0] * second + sides[1] * first)) + TINY
        return Form(mid, left + right, beyond + rounding)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Form:
        return self * other.inverse() if isinstance(other, Form) else self * (1.0 / np.float64(other))

    def inverse(self) -> Form:
        """Of what is positive throughout; nothing is known elsewhere."""
        low, high = self.lower(), self.upper()
        low = np.where(low > 0, low, np.nan)
        return chord(self, (low, high), (1.0 / low, 1.0 / high), 2.0 / low**3, 2.0 * UNIT)

    def sqrt(self) -> Form:
        """Of what is positive throughout; nothing is known elsewhere."""
        low, high = self.lower(), self.upper()
        low = np.where(low > 0, low, np.nan)
        root = np.sqrt(low)
        return chord(self, (low, high), (root, np.sqrt(high)), -0.25 / (low * root), 2.0 * UNIT)


def quantities(low: np.ndarray, high: np.ndarray) -> list[Form]:
    """The uncertain quantities of boxes themselves; ``low`` and ``high`` of shape (boxes, quantities)."""
    forms = []
    for index in range(low.shape[1]):
        mid = 0.5 * low[:, index] + 0.5 * high[:, index]
        half = np.maximum(high[:, index] - mid, mid - low[:, index])
        lin = np.zeros((low.shape[1], low.shape[0]))
        lin[index] = half
        forms.append(Form(mid, lin, 2.0 * UNIT * (np.abs(mid) + half) + TINY))
    return forms


Pair: TypeAlias = tuple[np.ndarray, np.ndarray]


def chord(x: Form, between: Pair, ends: Pair, bend: np.ndarray, error: Any) -> Form:
    """A function of x by its chord ``between`` two x, its values there each of a relative ``error``; else unknown.

    ``bend`` is the largest f'' between them.
    """
    # Of one sign throughout, f'' keeps it on one side of the chord, at most ``bend width^2/8`` from it.
    low, high = between
    width = np.maximum(high - low, TINY)
    slope = (ends[1] - ends[0]) / width
    size = np.abs(ends[0]) + np.abs(ends[1])
    # The chord as it is computed need not be the true one: what rounding does to it is added at both ends.
    sag = -0.125 * bend * width * width
    middle = 0.5 * (ends[0] + ends[1]) + 0.5 * sag
    shift = x.mid - (0.5 * low + 0.5 * high)
    mid = middle + slope * shift
    lin = slope * x.lin
    reach = np.abs(slope) * (x.rad + 8.0 * UNIT * (np.abs(x.mid) + width))
    rounding = (2.0 * error + 16.0 * UNIT) * size + 4.0 * UNIT * (np.abs(mid) + np.abs(lin).sum(axis=0) + np.abs(sag))
    return Form(mid, lin, reach + 0.5 * np.abs(sag) * (1.0 + 16.0 * UNIT) + rounding + TINY)
