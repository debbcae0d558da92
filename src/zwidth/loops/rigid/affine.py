"""First-order enclosures: how a quantity depends on the uncertain ones of a box, with a bound on what is left.

A `Form` is ``mid + sum_i lin_i e_i + r``, |e_i| <= 1, |r| <= rad, with one e_i for each uncertain quantity: affine
arithmetic (Comba, Stolfi 1993). What depends on the same quantity cancels, so that the width of what is left shrinks
with the square of the box, where that of a plain interval shrinks with the box itself. Every operation bounds its own
rounding by some ``u = 2^-53`` of its terms and by `TINY`, as in `loops.rigid.enclosure`; NumPy's sine, cosine and
arcsine are trusted to 2^-45. Over arrays of boxes; the operators are those of the verdict's one text,
`loops.rigid.crossover`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.loops.rigid.certified_filter import functions
from zwidth.loops.rigid.crossover import Lag, first_zero, long_verdict, short_verdict
from zwidth.loops.rigid.delay_classes import DeviceTerms
from zwidth.loops.rigid.enclosure import TINY, UNIT

# What the rounding of radii may have lost.
_INFLATED = 1.0 + 2.0**-30
# Of the phi-functions, slightly negative arguments included.
_PHI_ERROR = 100.0 * UNIT
_ARCSINE_ERROR = 2.0**-45


class Form:
    """``mid``, shape (boxes,); ``lin``, shape (quantities, boxes); ``rad``, shape (boxes,)."""

    __slots__ = ("lin", "mid", "rad")
    __array_ufunc__ = None

    def __init__(self, mid: Any, lin: Any, rad: Any):
        self.mid, self.lin, self.rad = mid, lin, rad

    @property
    def spread(self) -> np.ndarray:
        """The distance from ``mid`` that no value exceeds."""
        return _INFLATED * (np.abs(self.lin).sum(axis=0) + self.rad)

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


def _phi_forms(x: Form) -> tuple[Form, Form, Form]:
    """c, phi2 and psi: integrals of e^(-x t) over weights, so that all derivatives fall in size with x."""
    low, high = x.lower(), x.upper()
    # The series behind them are right for slightly negative arguments too, which a box round 0 has.
    low = np.where(low > -1.0, low, np.nan)
    first, last = ((at.c, at.phi2, at.psi) for at in map(functions, (low, high)))
    size = np.maximum(low, 1e-3)
    at_low = first[2]
    bends = (first[0], np.minimum(0.25 * at_low, 2.0 / size**3), np.minimum(at_low, 6.0 / size**4))
    forms = [
        chord(x, ends, bend * (1.0 + _PHI_ERROR), _PHI_ERROR)
        for ends, bend in zip(zip(first, last, strict=True), bends, strict=True)
    ]
    return forms[0], forms[1], forms[2]


def plant(delta: Form, f: Form) -> DeviceTerms:
    """The devices of boxes, in the form of `loops.rigid.plant.held_plant`."""
    t = 1.0 - f
    x_t, x_f = delta * t, delta * f
    (e_t, phi2_t, psi_t), (_, phi2_f, psi_f), (c, phi2, psi) = _phi_forms(x_t), _phi_forms(x_f), _phi_forms(delta)
    p1_t, p1_f, p1 = phi2_t + psi_t, phi2_f + psi_f, phi2 + psi
    a1 = t * t * psi_t + t * f * (e_t + p1_t) * p1_f + f * f * phi2_f
    a2, a0 = t * t * phi2_t, e_t * (f * f * psi_f)
    return DeviceTerms(delta, None, f, c, delta * p1, p1, phi2, psi, p1_t, psi_t, a2, a1, a0, a2 - a1 + a0, None)


def enclose_zero(cubic: tuple[Form, Form, Form, Form]) -> tuple[Form, np.ndarray]:
    """The crossover as a form: first order by the implicit function, proved by the signs of H on both sides of it."""
    _, h1, h2, h3 = mids = tuple(h.mid for h in cubic)
    u = first_zero(mids)
    slope = h1 + u * (2.0 * h2 + 3.0 * u * h3)
    lin = -(cubic[0].lin + u * (cubic[1].lin + u * (cubic[2].lin + u * cubic[3].lin))) / slope
    form = Form(u, lin, np.zeros_like(u))
    left = _horner(form, cubic)
    reach = 2.0 * (np.abs(left.mid) + left.spread) / np.abs(slope) + 8.0 * UNIT * u
    before, behind = (_horner(Form(u + side, lin, 4.0 * UNIT * u), cubic) for side in (-reach, reach))
    found = (before > 0) & (behind < 0) & (form.mid - form.spread - reach > 0)
    return Form(u, lin, reach + 8.0 * UNIT * u), found


def _horner(x: Form, coefficients: tuple[Form, ...]) -> Form:
    total = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def take_lag(u: Form, whole: np.ndarray) -> Lag:
    """Cosine and sine of ``(n + 1/2) w``: w(u) by its chord, concave for u < 1; then to first order, |sin|'' <= 1."""
    low, high = u.lower(), u.upper()
    good = (low > 0) & (high < 1.0)
    low, high = np.where(good, low, 0.5), np.where(good, high, 0.5)
    turns = whole + 0.5
    ends = 2.0 * turns * np.arcsin(np.sqrt(0.5 * low)), 2.0 * turns * np.arcsin(np.sqrt(0.5 * high))
    square = low * (2.0 - low)
    angle = chord(u, ends, -turns * (1.0 - low) / (square * np.sqrt(square)), _ARCSINE_ERROR)
    spread = angle.spread
    within = good & (angle.mid + spread < np.pi * (1.0 - 1e-15))
    beyond = good & ((angle.mid - spread) * (whole + 1.0) > np.pi * turns * (1.0 + 1e-15))
    sine, cosine = np.sin(angle.mid), np.cos(angle.mid)
    left = angle.rad + 0.5 * spread * spread + 2.0**-45
    turned = Form(cosine, -sine * angle.lin, left)
    return Lag(turned, Form(sine, cosine * angle.lin, left), (1.0 - turned) * 0.5, within, beyond)


def stable_everywhere(alpha: Form, beta: Form, delta: Form, d: Form) -> np.ndarray:
    """Whether every wall of each box is proved stable; a delay that crosses a whole number is taken on both sides."""
    low, high = d.lower(), d.upper()
    first = np.maximum(np.floor(low), 0.0)
    stable = (alpha > 0) & (beta + delta > 0) & (high <= first + 2.0)
    with np.errstate(all="ignore"):
        stable &= _stable_behind(alpha, beta, delta, d, first)
        crosses = np.flatnonzero(stable & (high >= first + 1.0))
        if crosses.size:
            parts = [Form(x.mid[crosses], x.lin[:, crosses], x.rad[crosses]) for x in (alpha, beta, delta, d)]
            stable[crosses] &= _stable_behind(parts[0], parts[1], parts[2], parts[3], first[crosses] + 1.0)
    return stable


def _stable_behind(alpha: Form, beta: Form, delta: Form, d: Form, whole: np.ndarray) -> np.ndarray:
    """The verdict with n = ``whole``; f may leave [0, 1], where only its part inside has a meaning."""
    here = plant(delta, d - whole)
    short = whole == 0
    stable = np.zeros(whole.shape, bool)
    if short.any():
        stable = short & short_verdict(alpha, beta, here).stable
    if not short.all():
        stable |= ~short & long_verdict(alpha, beta, whole, here, enclose_zero, take_lag).stable
    return stable
