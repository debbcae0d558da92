"""The verdict in numbers with proved errors: in balls for arrays of walls, in affine forms for boxes of devices.

The text is that of `loops.rigid.crossover`. Here are the numbers that go into it: device, crossover and lag. Balls are
the certified method's first step, which settles nearly all walls; affine forms prove that every wall of a box of walls
and devices is stable, with NumPy's sine, cosine and arcsine trusted to 2^-45. ``u = 2^-53``. No library's exp is
trusted; by how many u each number may be off is F1 to F3 of docs/theory/certified.md.
"""

from __future__ import annotations

from math import factorial
from typing import Any

import numpy as np

from zwidth.arrays.balls import TINY, UNIT, Ball, Form, chord
from zwidth.arrays.evaluate import evaluate_columns
from zwidth.arrays.held_mass import DelayClasses, DeviceTerms, classify_delays, device, phi_functions
from zwidth.loops.rigid.crossover import Lag, first_zero, long_verdict, short_verdict
from zwidth.loops.rigid.folding import Points, pick_points
from zwidth.loops.rigid.normalization import wall_status
from zwidth.loops.rigid.row_limit import row_limits
from zwidth.words.quantities import WALL_RANGE
from zwidth.words.status import Status
from zwidth.words.types import Array
from zwidth.words.xp import COSINE, SINE, fit_arcsine, horner, namespace, store_once

UNSTABLE, STABLE, OPEN = 0, 1, 2
# Added to the code where alpha or beta is 0 or a value is out of range: XLA takes numbers below 2^-1022 for zero, and
# at alpha = 0 the verdict is not on the pole at z = 1.
SPECIAL = 4

_LOG2_E = 1.4426950408889634
# The first part has 32 significant bits: its products with whole numbers below 2^21 are exact.
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXP_TERMS = [1.0 / factorial(k) for k in range(14)]
_EXP_LIMIT = -700.0

# asin(sqrt y)/sqrt y by powers of 4 y - 1, within 2^-46 of itself for 0 <= y <= 0.5002, rounding included.
ARCSINE = fit_arcsine(16)
_LARGEST_U = 1.0002
# Of both series, on [0, 1.6], the first term left out and the rounding are below 2^-43 (of the angle for the sine).
_LARGEST_ANGLE = 1.6
_HALF_PI_BELOW, _HALF_PI_ABOVE = 1.570796326794896, 1.570796326794897


def exp(x: Array) -> Array:
    """``e^x``, x <= 0, within 8u, and 1e-304 below -700."""
    xp = namespace(x)
    x = xp.maximum(x, _EXP_LIMIT)
    k = xp.round(x * _LOG2_E)
    return horner((x - k * _LN2_HIGH) - k * _LN2_LOW, _EXP_TERMS) * _power_of_two(k, xp)


def _power_of_two(k: Array, xp: Any) -> Array:
    if xp is np:
        return np.ldexp(1.0, np.nan_to_num(k).astype(np.int64))
    from jax.lax import bitcast_convert_type

    return bitcast_convert_type((1023 + k.astype(xp.int64)) << 52, xp.float64)


def functions(x: Array) -> Any:
    """The phi-functions, each within 30u."""
    return phi_functions(x, exp)


def enclosed_device(delta: Array, d: Array, kind: DelayClasses) -> DeviceTerms:
    """The device of exact delta and d in balls, NaN where they are out of range."""
    here = device(delta, d, kind, functions)
    if kind.fractional and kind.long:
        # Several loops of the compiler use it.
        here = store_once(here, delta)

    def within(mid: Array, units: float) -> Ball:
        return Ball(mid, (units * UNIT) * abs(mid) + TINY)

    exact = {"delta": Ball(here.delta), "f": Ball(here.f), "em": within(here.em, 32.0), "p1": within(here.p1, 31.0)}
    if not kind.fractional:
        a2, a1, gap = within(here.a2, 31.0), within(here.a1, 31.0), within(here.gap, 31.0)
        return here._replace(**exact, c=within(here.c, 18.0), a2=a2, a1=a1, a0=None, gap=gap)
    a2, a1 = within(here.a2, 42.0), within(here.a1, 78.0)
    a0 = Ball(here.a0, UNIT * (62.0 * here.a0 + 2.0 * here.a1) + TINY)
    late = {"p1_t": within(here.p1_t, 35.0), "psi_t": within(here.psi_t, 36.0)} if kind.short else {}
    return here._replace(**exact, **late, c=within(here.c, 18.0), a2=a2, a1=a1, a0=a0, gap=a2 - a1 + a0)


def enclose_zero(cubic: tuple[Ball, ...]) -> tuple[Ball, Array]:
    """Around the zero of the midpoints, as wide as the radii make it; the signs of H at both ends are the proof."""
    mids, radii = zip(*((h.mid, h.radius) for h in cubic), strict=True)
    u = first_zero(mids)
    value, slope = horner(u, mids), horner(u, [k * h for k, h in enumerate(mids)][1:])
    error = _horner_error(u, mids, radii)
    reach = 1.5 * (2.0 * error + abs(value)) / abs(slope) + (8.0 * UNIT) * u
    low, high = u - reach, u + reach
    bound = _horner_error(high, mids, radii)
    found = (low > 0) & (high < _LARGEST_U) & (horner(low, mids) > bound) & (horner(high, mids) < -bound)
    return Ball(u, reach + (4.0 * UNIT) * u), found


def _horner_error(u: Array, mids: tuple[Array, ...], radii: tuple[Array, ...]) -> Array:
    """Of H at up to u >= 0: the radii of its coefficients, and 7u of the absolute terms for Horner's rule."""
    return horner(u, [radius + (8.0 * UNIT) * abs(mid) for mid, radius in zip(mids, radii, strict=True)]) + TINY


def take_lag(u: Ball, whole: Array) -> Lag:
    """The lag by series of half its angle, ``(n + 1/2) w/2``."""
    xp = namespace(u.mid)
    safe = xp.where((u.mid > 0) & (u.mid < _LARGEST_U), u.mid, 0.5)
    half = (whole + 0.5) * (xp.sqrt(0.5 * safe) * horner(2.0 * safe - 1.0, ARCSINE))
    # dw/du = 1/sqrt(u (2 - u))
    error = 0.5 * (whole + 0.5) * u.radius / xp.sqrt(xp.maximum((u * (2 - u)).lower(), 0.0)) + 2.0**-45 * half
    within = half + error < _HALF_PI_BELOW
    beyond = (half - error) * (whole + 1.0) > (_HALF_PI_ABOVE * (whole + 0.5)) * (1.0 + 4.0 * UNIT)
    angle = xp.minimum(half, _LARGEST_ANGLE)
    square = angle * angle
    sine, cosine = angle * horner(square, SINE), horner(square, COSINE)
    # The derivative of both by half of the angle is at most 2, that of the square of its sine at most twice the angle.
    return Lag(
        Ball((cosine - sine) * (cosine + sine), 2.0 * error + 2.0**-40),
        Ball(2.0 * sine * cosine, 2.0 * error + 2.0**-40 * angle),
        Ball(sine * sine, 2.0 * error * (angle + error) + 2.0**-40 * square),
        within,
        beyond,
    )


def wall_codes(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses) -> Array:
    """The codes of walls, elementwise."""
    xp = namespace(alpha, beta, delta)
    here = enclosed_device(delta, d, kind)
    wall = Ball(alpha), Ball(beta)
    found = []
    if kind.short:
        found.append(short_verdict(*wall, here))
    if kind.long:
        found.append(long_verdict(*wall, here.whole, here, enclose_zero, take_lag))
    stable, unstable = (xp.where(here.whole < 1, *pair) for pair in zip(found[0], found[-1], strict=True))
    code = xp.where((stable | unstable) & (beta + delta > 0), stable.astype(xp.uint8), xp.uint8(OPEN))
    # P(1) = phi1 alpha < 0: a real pole beyond 1. The lobe lies above beta = -delta.
    code = xp.where((alpha < 0) | ((alpha > 0) & (beta <= -delta)), xp.uint8(UNSTABLE), code)
    least, most = WALL_RANGE
    stiffness, damping = abs(alpha), abs(beta)
    plain = (stiffness >= least) & (stiffness <= most) & (damping >= least) & (damping <= most)
    return code + xp.where(plain & (here.delta.mid == delta), xp.uint8(0), xp.uint8(SPECIAL))


def each_code(points: Points) -> np.ndarray:
    """The code of every point, point by point."""
    code = evaluate_columns(wall_codes, points.columns(), classify_delays(points.d)).reshape(points.shape)
    if np.signbit(points.delta).any() or np.signbit(points.d).any():
        code |= np.where((points.delta < 0) | (points.d < 0), SPECIAL, 0).astype(np.uint8)
    return code


# Of each row a wall so far below its end is tried, and one as far above.
_ASIDE = 1e-9


def filter_walls(points: Points) -> np.ndarray:
    """The code of every point, of the broadcast shape."""
    # On every row the stable walls are one interval, 0 < alpha < limit (docs/theory/one-lobe.md): what lies below a
    # wall proved stable is stable, what lies above one proved unstable is not. Which two walls does not matter for the
    # proof, so those next to the limit as computed are taken. What they leave is asked point by point.
    if not has_rows(points):
        return each_code(points)
    # A wall of moderate stiffness stands for the row: what is special about it is special about all.
    usual = (wall_status(np.ones(()), *points[1:]) == Status.OK) & (points.beta != 0)
    least, most = WALL_RANGE
    size = np.abs(points.alpha)
    known = (size >= least) & (size <= most)
    stiffness = np.unique(points.alpha[known & (points.alpha > 0)])
    limit = row_limits(*points[1:])
    ends = np.concatenate([[0.0], stiffness, [np.inf]])
    below = ends[np.searchsorted(stiffness, limit * (1.0 - _ASIDE))]
    above = ends[np.searchsorted(stiffness, limit * (1.0 + _ASIDE)) + 1]
    tried = [each_code(Points(np.clip(alpha, least, most), *points[1:])) for alpha in (below, above)]
    stable, unstable = np.where(tried[0] == STABLE, below, 0.0), np.where(tried[1] == UNSTABLE, above, np.inf)
    # Walls without or with negative stiffness: P(1) < 0 is a real pole beyond 1.
    alpha = np.where(points.alpha < 0, np.inf, points.alpha)
    over = alpha > stable
    between = over & (alpha < unstable)
    code = 1 - over.view(np.uint8)
    code += OPEN * between.view(np.uint8)
    if not (known.all() and usual.all()):
        code[~np.broadcast_to(known & usual, points.shape)] = OPEN
    rest = code == OPEN
    if rest.any():
        code[rest] = each_code(pick_points(points, rest))
    return code


def has_rows(points: Points) -> bool:
    """Whether alpha varies along axes of its own, and along enough values for two trials a row to pay."""
    rows = np.broadcast_shapes(*(array.shape for array in points[1:]))
    apart = all(along == 1 or across == 1 for along, across in zip(points.alpha.shape, rows, strict=True))
    return points.is_dense and apart and points.alpha.size >= 64


# Of the phi-functions.
_PHI_ERROR = 100.0 * UNIT
_ARCSINE_ERROR = 2.0**-45


def _phi_forms(x: Form) -> tuple[Form, Form, Form]:
    """c, phi2 and psi: integrals of e^(-x t) over weights, so that all derivatives fall in size with x."""
    # Of a box that reaches beyond f = 0 or f = 1 only what has x >= 0 counts.
    low, high = (np.maximum(end, 0.0) for end in (x.lower(), x.upper()))
    first, last = ((at.c, at.phi2, at.psi) for at in map(functions, (low, high)))
    size = np.maximum(low, 1e-3)
    at_low = first[2]
    bends = (first[0], np.minimum(0.25 * at_low, 2.0 / size**3), np.minimum(at_low, 6.0 / size**4))
    forms = [
        chord(x, (low, high), ends, bend * (1.0 + _PHI_ERROR), _PHI_ERROR)
        for ends, bend in zip(zip(first, last, strict=True), bends, strict=True)
    ]
    return forms[0], forms[1], forms[2]


def device_forms(delta: Form, f: Form) -> DeviceTerms:
    """The devices of boxes, in the form of `arrays.held_mass.held_plant`."""
    t = 1.0 - f
    x_t, x_f = delta * t, delta * f
    (e_t, phi2_t, psi_t), (_, phi2_f, psi_f), (c, phi2, psi) = _phi_forms(x_t), _phi_forms(x_f), _phi_forms(delta)
    p1_t, p1_f, p1 = phi2_t + psi_t, phi2_f + psi_f, phi2 + psi
    a1 = t * t * psi_t + t * f * (e_t + p1_t) * p1_f + f * f * phi2_f
    a2, a0 = t * t * phi2_t, e_t * (f * f * psi_f)
    return DeviceTerms(delta, None, f, c, delta * p1, p1, phi2, psi, p1_t, psi_t, a2, a1, a0, a2 - a1 + a0, None)


def enclose_zero_form(cubic: tuple[Form, Form, Form, Form]) -> tuple[Form, np.ndarray]:
    """The crossover as a form: first order by the implicit function, proved by the signs of H on both sides of it."""
    _, h1, h2, h3 = mids = tuple(h.mid for h in cubic)
    u = first_zero(mids)
    slope = h1 + u * (2.0 * h2 + 3.0 * u * h3)
    lin = -(cubic[0].lin + u * (cubic[1].lin + u * (cubic[2].lin + u * cubic[3].lin))) / slope
    form = Form(u, lin, np.zeros_like(u))
    left = horner(form, cubic)
    reach = 2.0 * (np.abs(left.mid) + left.radius) / np.abs(slope) + 8.0 * UNIT * u
    before, behind = (horner(Form(u + side, lin, 4.0 * UNIT * u), cubic) for side in (-reach, reach))
    found = (before > 0) & (behind < 0) & (form.mid - form.radius - reach > 0)
    return Form(u, lin, reach + 8.0 * UNIT * u), found


def take_lag_form(u: Form, whole: np.ndarray) -> Lag:
    """Cosine and sine of ``(n + 1/2) w``: w(u) by its chord, concave for u < 1; then to first order, |sin|'' <= 1."""
    low, high = u.lower(), u.upper()
    good = (low > 0) & (high < 1.0)
    low, high = np.where(good, low, 0.5), np.where(good, high, 0.5)
    turns = whole + 0.5
    ends = 2.0 * turns * np.arcsin(np.sqrt(0.5 * low)), 2.0 * turns * np.arcsin(np.sqrt(0.5 * high))
    square = low * (2.0 - low)
    angle = chord(u, (low, high), ends, -turns * (1.0 - low) / (square * np.sqrt(square)), _ARCSINE_ERROR)
    spread = angle.radius
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
    here = device_forms(delta, d - whole)
    short = whole == 0
    stable = np.zeros(whole.shape, bool)
    if short.any():
        stable = short & short_verdict(alpha, beta, here).stable
    if not short.all():
        stable |= ~short & long_verdict(alpha, beta, whole, here, enclose_zero_form, take_lag_form).stable
    return stable
