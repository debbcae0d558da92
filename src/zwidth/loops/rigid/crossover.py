"""Stability of the rigid loop in closed form, decided at its only gain crossover.

Notation, on ``z = e^(j w)`` with ``u = 1 - cos w``, ``y = u/2``, and the plant of `arrays.held_mass`: P = T + B with

    T = z^(1+n) (z - 1)(z - c)                device and delay, d = n + f
    B = M(z) ((alpha + beta) z - beta)        wall;  M = a2 z + a1 + a0/z

The gain crossover, |T| = |B|, is the zero of a cubic in u (a quadratic for integer d), which has one zero in (0, 2) or
none (docs/theory/one-crossover.md, Theorem 1). There the wall and the point (alpha_w, beta_w) of the boundary curve at
this w have ``W = alpha + beta u + j beta sin w`` of equal magnitude. The wall is stable if and only if its W has the
larger argument (S15a): ``beta alpha_w > alpha beta_w``, or ``beta > beta_w``. The curve is computed as in
`loops.rigid.row_limit`. For d < 1 the crossover is eliminated: the largest stable alpha at each beta has a closed form.

The same source code serves arrays of NumPy and JAX, float64 numbers with an error bound, and balls of python-flint
(`loops.rigid.certified`). With bounds or balls, a comparison is true only if it is certain.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.held_mass import ANY, DelayClasses, DeviceTerms, device
from zwidth.arrays.roots import follow_root
from zwidth.words.quantities import WALL_RANGE
from zwidth.words.types import Array
from zwidth.words.xp import ARCSINE, COSINE, SINE, find_turn, frozen, horner, namespace, roots, within

# From its start the zero of the cubic is within 11 %; each step squares that.
_NEWTON_STEPS = 4


def short_curve(here: Any) -> tuple[tuple[Any, Any], tuple[Any, Any, Any], tuple[Any, Any, Any]]:
    """The lobe for a held d < 1 by powers of y, in any arithmetic: ``V b = y (u0 + u1 y)``, V, ``alpha V/(4 y)``."""
    p1, em, a2, a1, a0, f = here.p1, here.em, here.a2, here.a1, here.a0, here.f
    t = 1.0 - f
    # Both coefficients of b are sums of terms of one sign.
    slack = f * (f * em + p1) + t * (f * here.p1_t + t * here.psi_t) + a0
    by_b = p1 * slack * 4.0, a0 * (f + t * here.p1_t) * -16.0
    size = p1 * p1, (a1 * (a2 + a0) + a2 * a0 * 4.0) * -4.0, a2 * a0 * 16.0
    return by_b, size, (p1 * (em + f * em + p1), (a1 + a0 * 3.0 + a0 * em) * -4.0, a0 * 16.0)


def long_curve(here: Any) -> tuple[tuple, tuple, tuple, tuple]:
    """E, H, V and ``(delta V - E)/y`` rearranged, by powers of y, in any arithmetic; a0 is None for whole d."""
    p1, em, a2, a1, a0 = here.p1, here.em, here.a2, here.a1, here.a0
    if a0 is None:
        return (em * p1, (here.gap - em * a2) * 2.0), (p1 * p1,), (p1 * p1, a1 * a2 * -4.0), (p1 * here.gap * -2.0,)
    sigma, mu, corner = a2 + a0, a2 - a0, a2 * a0 * 4.0
    g = em * p1, (p1 + sigma * em - mu * 2.0) * -2.0, a0 * 8.0
    b1 = p1 * 2.0 - mu * 4.0 + here.delta * (sigma * (sigma - a1) - corner * 2.0) * 2.0
    b2 = a0 * (1.0 - here.delta * a2 * 2.0) * -8.0
    return g, (p1 * (p1 + here.f * em), a0 * -4.0), (p1 * p1, (a1 * sigma + corner) * -4.0, corner * 4.0), (b1, b2)


class Verdict(NamedTuple):
    """Two masks; a wall that is not certain is in neither."""

    stable: Any
    unstable: Any


class Lag(NamedTuple):
    """The delay phase ``(n + 1/2) w`` at the crossover; a bound of w that is not certain is False."""

    cosine: Any  # of the delay phase
    sine: Any
    rise: Any  # square of the sine of half the delay phase
    within: Any  # (n + 1/2) w <= pi
    beyond: Any  # w >= pi/(n + 1)


# h0, h1, h2, h3 (left out for a quadratic) -> u, and whether it is certainly the only zero in (0, 2)
Solve = Callable[[tuple[Any, ...]], tuple[Any, Any]]
# u, n -> Lag
TakeLag = Callable[[Any, Any], Lag]


def short_verdict(alpha: Any, beta: Any, here: Any) -> Verdict:
    """The verdict for d < 1, alpha > 0 and beta > -delta: alpha against the end of its row."""
    # |L(-1)| < 1 is needed; without it there is no crossover. By far: what follows is then rounding.
    height, line = here.gap * (alpha + beta * 2.0), (here.c + 1.0) * 2.0
    below, without = (height < line) & (height > -line), (height > line) | (height < -line)
    b = beta + here.delta
    if here.a0 is None:
        left, right = alpha * here.a1 * (here.p1 + here.a2 * b), here.p1 * b * (1.0 - here.a1 * beta)
        return Verdict(below & (left < right), without | (left > right))
    (u0, u1), size, shape = short_curve(here)
    # Where on the lobe this beta is: lead y^2 - linear y + start = 0, the first zero.
    start, linear, lead = size[0] * b, u0 - b * size[1], b * size[2] - u1
    square = linear * linear - start * lead * 4.0
    y = start * 2.0 / (linear + roots(square)[0])
    left, right = alpha * horner(y, size), y * horner(y, shape) * 4.0
    meets, missed = square > 0, (square < 0) | (y > 1.0)
    reached = meets & (y < 1.0)
    # Beyond the lobe's end a row is stable up to the line, if the lobe ends at z = -1, or nowhere. It ends before where
    # alpha would be negative at z = -1, or the line would lie below.
    end = shape[0] + shape[1] + shape[2]
    cornered, ended = (end > 0) & (here.gap > 0), (end < 0) | (here.gap < 0)
    # At the damping of a corner y is 1, or for all that is certain on either side of it.
    stable = below & ((reached & (left < right)) | (cornered & (missed | (meets & (left < right)))))
    return Verdict(stable, without | (reached & (left > right)) | (ended & (missed | (left > right))))


def gain_cubic(alpha: Any, beta: Any, here: Any) -> tuple[Any, ...]:
    """``|B|^2 - |T|^2`` by powers of u: positive at u = 0, negative behind its one zero in (0, 2)."""
    square, spread, tall = here.p1 * here.p1, beta * (alpha + beta) * 2, alpha * alpha
    bend = (beta - here.delta) * (beta + here.delta) + alpha * beta
    if here.a0 is None:
        m1 = here.a1 * here.a2
        return square * tall, (square * bend - m1 * tall) * 2, m1 * spread * -2 - here.c * 4
    corner = here.a2 * here.a0 * 4
    m1 = here.a1 * (here.a2 + here.a0) + corner
    h2 = corner * tall - m1 * spread * 2 - here.c * 4
    return square * tall, (square * bend - m1 * tall) * 2, h2, corner * spread


def long_verdict(alpha: Any, beta: Any, whole: Any, here: Any, solve: Solve, take_lag: TakeLag) -> Verdict:
    """The verdict for d >= 1, alpha > 0 and beta > -delta: the curve where the gain is one."""
    # At alpha = 0, where a pole is at z = 1, it is on the others, for ``beta > delta`` (docs/theory, S15b).
    cubic = gain_cubic(alpha, beta, here)
    u, found = solve(cubic)
    y = u * 0.5
    sine, cosine = roots(y, 1.0 - y)
    lag = take_lag(u, whole)
    g, h, v, base = long_curve(here)
    E, F = horner(y, g), sine * cosine * horner(y, h) * 2.0
    # Times V cos(w/2): alpha_w = 2 sin(w/2) across, beta_w = turned - cosine E; and b V cos(w/2) without cancellation.
    ahead = lag.cosine * cosine - lag.sine * sine  # cos((n + 1) w)
    across = (lag.sine * cosine + lag.cosine * sine) * E + ahead * F
    turned = lag.sine * F
    wider = across * beta * sine * 2.0 - (turned - lag.cosine * E) * alpha
    low = cosine * y * horner(y, base) + E * (lag.rise * 2.0 - y / (cosine + 1.0)) + turned
    above = (beta + here.delta) * cosine * horner(y, v) - low
    # On the lobe (n + 1) w and the argument of E + j F, both above 0, have a sum below pi; its sine is ``across``.
    inside = found & lag.within & (across > 0) & ((E > 0) | (ahead > 0))
    # Both differences have one sign. The first one is exact where the lobe falls, the second one next to beta = -delta.
    steep = sine * cosine * beta * 2.0 > alpha
    stable = inside & ((steep & (wider > 0)) | ((steep ^ True) & (above > 0)))
    # w > pi/2, or no crossover at all.
    late = sum(cubic[1:], cubic[0]) > 0
    return Verdict(stable, late | (found & (lag.beyond | (across < 0) | (wider < 0) | (above < 0))))


def first_zero(cubic: tuple[Array, ...]) -> Array:
    """The zero in (0, 1] of a cubic that is positive before it and negative behind, or of a quadratic."""
    h0, h1, h2, *rest = cubic
    xp = namespace(*cubic)
    lead = -(h2 + 0.5 * rest[0]) if rest else -h2
    size = xp.sqrt(xp.maximum(h1 * h1 + 4.0 * lead * h0, 0.0))
    falling = h1 < 0
    zero = xp.where(falling, 2.0 * h0, h1 + size) / xp.where(falling, size - h1, 2.0 * lead)
    if not rest:
        return zero
    h3 = rest[0]
    # A start outside (0, 1] only means that the part of the cubic left out matters.
    zero = xp.where((zero > 0) & (zero < 1.0), zero, 1.0)
    # Unrolled: XLA then makes one loop over the points out of all steps.
    for _ in range(_NEWTON_STEPS):
        value, slope = h0 + zero * (h1 + zero * (h2 + zero * h3)), h1 + zero * (2.0 * h2 + 3.0 * zero * h3)
        new = zero - value / slope
        zero = xp.where(new > 0, xp.minimum(new, 1.0), 0.5 * zero)
    return zero


def _solve(cubic: tuple[Array, ...]) -> tuple[Array, Array]:
    """Return the zero u of the cubic and a mask of the points with a zero in (0, 1]; other u have no meaning."""
    u = first_zero(cubic)
    return u, (sum(cubic[1:], cubic[0]) <= 0) & (u > 0) & (u <= 1.0)


def compute_lag(u: Array, whole: Array) -> Lag:
    """Return the delay phase at the crossover ``u = 1 - cos w``."""
    xp = namespace(u, whole)
    # Compute the sine of half the angle, because it keeps its digits for slow loops.
    half = xp.minimum((whole + 0.5) * xp.sqrt(0.5 * u) * horner(2.0 * u - 1.0, ARCSINE), 0.5 * np.pi)
    square = half * half
    sine, cosine = half * horner(square, SINE), horner(square, COSINE)
    # The test implies (n + 1/2) w <= pi; its failure implies (n + 1) w >= pi (docs/theory/certified.md, C5).
    near = u * (whole + 1.0) * (whole + 1.0) < 0.5 * np.pi * np.pi
    return Lag((cosine - sine) * (cosine + sine), 2.0 * sine * cosine, sine * sine, near, near ^ True)


def gain_crossover(alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array]:
    """The w at which the gain is one, for margins, and whether there is one, without which w means nothing."""
    # Of u and 2 - u = 1 + cos w the nearer one is found, which then has all its digits.
    xp = namespace(alpha, here.delta)
    cubic = gain_cubic(alpha, beta, here)
    # At z = -1 the device and its delay must be the larger part; there the cubic starts in y with the opposite sign.
    one, turned = 2.0 * (1.0 + here.c), alpha + 2.0 * beta
    other, mu = here.gap * turned, here.a2 - here.a0
    tall, spread, corner = turned * turned, 2.0 * beta * (alpha + beta), 4.0 * here.a2 * here.a0
    g1 = 2.0 * (mu * mu - here.gap * (here.a2 + here.a0))
    behind = (
        (one - other) * (one + other),
        here.gap * here.gap * spread - g1 * tall - 2.0 * (here.em * here.em + 8.0 * here.c),
        4.0 * here.c - corner * tall + g1 * spread,
        cubic[3],
    )
    far = sum(cubic[1:], cubic[0]) > 0
    known = tuple(xp.where(far, *pair) for pair in zip(behind, cubic, strict=True))
    near = follow_root(
        lambda x, *powers: horner(x, powers), first_zero(frozen(known, xp)), lambda x, slope, _: slope != 0, *known
    )
    exists = (xp.abs(other) < one) & (near > 0) & (near <= 1.0)
    u, y = xp.where(far, 2.0 - near, near), xp.where(far, near, 2.0 - near)
    return find_turn(0.5 * u, 0.5 * y, xp), exists


def stable_kernel(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses = ANY) -> Array:
    """Return whether each wall is stable, elementwise; False for NaN."""
    here = device(delta, d, kind)
    return stable_at(alpha, beta, here, kind)


def stable_at(alpha: Array, beta: Array, here: DeviceTerms, kind: DelayClasses) -> Array:
    """Return whether each wall is stable on a discretized device."""
    plain = here._replace(a0=None)
    if not kind.fractional:
        here = plain
    early = short_verdict(alpha, beta, here).stable if kind.short else None
    if early is not None and kind.fractional:
        # Use the formula for d = 0, because it is more accurate at the corner.
        early = namespace(here.f).where(here.f == 0, short_verdict(alpha, beta, plain).stable, early)
    late = long_verdict(alpha, beta, here.whole, here, _solve, compute_lag).stable if kind.long else early
    stable = late if early is None else namespace(here.whole).where(here.whole < 1, early, late)
    return stable & (alpha > 0) & (beta + here.delta > 0) & within(alpha, WALL_RANGE) & within(beta, WALL_RANGE)
