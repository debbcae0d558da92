"""First-order enclosures: how a quantity depends on the uncertain ones of a box, with a bound on what is left.

A `Form` is ``mid + sum_i lin_i e_i + r``, |e_i| <= 1, |r| <= rad, with one e_i for each uncertain quantity: affine
arithmetic (Comba, Stolfi 1993). What depends on the same quantity cancels, so that the width of what is left shrinks
with the square of the box, where that of a plain interval shrinks with the box itself. Every operation bounds its own
rounding by some ``u = 2^-53`` of its terms and by `TINY`, as in `arrays.balls`. Over arrays of boxes; the operators
are those of balls.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.arrays.balls import INFLATED, TINY, UNIT


class Form:
    """``mid``, shape (boxes,); ``lin``, shape (quantities, boxes); ``rad``, shape (boxes,)."""

    __slots__ = ("lin", "mid", "rad")
    __array_ufunc__ = None

    def __init__(self, mid: Any, lin: Any, rad: Any):
        self.mid, self.lin, self.rad = mid, lin, rad

    @property
    def spread(self) -> np.ndarray:
        """The distance from ``mid`` that no value exceeds."""
        return INFLATED * (np.abs(self.lin).sum(axis=0) + self.rad)

    def lower(self) -> np.ndarray:
        """A number below every value."""
        end = self.mid - self.spread
        return end - 2.0 * (UNIT * np.abs(end) + TINY)

    def upper(self) -> np.ndarray:
        """A number above every value."""
        end = self.mid + self.spread
        return end + 2.0 * (UNIT * np.abs(end) + TINY)

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

    def __sub__(self, other: Any) -> Form:
        return self + (-other)

    def __rsub__(self, other: Any) -> Form:
        return (-self) + other

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
        ends = 1.0 / low, 1.0 / high
        return chord(self, ends, 2.0 / low**3, 2.0 * UNIT)

    def sqrt(self) -> Form:
        """Of what is positive throughout; nothing is known elsewhere."""
        low, high = self.lower(), self.upper()
        low = np.where(low > 0, low, np.nan)
        root = np.sqrt(low)
        return chord(self, (root, np.sqrt(high)), -0.25 / (low * root), 2.0 * UNIT)

    def __gt__(self, other: Any) -> Any:
        difference = self if isinstance(other, int | float) and other == 0 else self - other
        return difference.mid > difference.spread

    def __lt__(self, other: Any) -> Any:
        difference = self if isinstance(other, int | float) and other == 0 else self - other
        return difference.mid < -difference.spread


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


def chord(x: Form, ends: tuple[np.ndarray, np.ndarray], bend: np.ndarray, error: Any) -> Form:
    """A function of x by the chord between its ``ends``, each within the relative ``error``.

    ``bend`` is the second derivative of largest size: of one sign throughout, it keeps the function on one side of the
    chord, at most ``bend width^2/8`` from it.
    """
    low, high = x.lower(), x.upper()
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
