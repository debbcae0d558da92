"""Stable or not in closed form: the loop has one gain crossover, and the phase there decides.

Notation, on ``z = e^(j w)`` with ``u = 1 - cos w``, ``s = sin w`` and the plant of `zwidth.plant`: P = T + B with

    T = z^(1+n) (z - 1)(z - c)                device and delay, d = n + f
    B = M(z) ((alpha + beta) z - beta)        wall;  M = a2 z + a1 + a0/z

Their sizes are equal where a cubic in u vanishes (a quadratic for whole d). It has one zero in (0, 2) or none
(docs/theory/one-crossover.md, Theorem 1). With it

    V = W M Z,   W = alpha + beta u + j beta s,   Z = s + j (em - u),   em = 1 - c

the wall is stable exactly if alpha > 0, beta > -delta, the crossover exists, w < pi/(n + 1) and
``0 < arg V``, ``(n + 1/2) w < arg V`` (Theorem 2). The difference is the phase margin.
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.domain import WALL_RANGE, within
from zwidth.stability.devices import ANY, Device, Kind, device
from zwidth.stability.row_limit import short_row
from zwidth.xp import horner, namespace


def _arcsine_fit(terms: int) -> list[float]:
    """``asin(sqrt y)/sqrt y`` on [0, 1/2] as powers of 4 y - 1, by interpolation: 2e-16 relative with 19 terms."""
    node = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    y = 0.25 * (node + 1.0)
    fit = np.polynomial.chebyshev.chebfit(node, np.arcsin(np.sqrt(y)) / np.sqrt(y), terms - 1)
    return np.polynomial.chebyshev.cheb2poly(fit).tolist()


ARCSINE = _arcsine_fit(19)
# Taylor series; on [0, pi/2] the first term left out is below 1e-17.
_SIN = [(-1.0) ** k / factorial(2 * k + 1) for k in range(11)]
_COS = [(-1.0) ** k / factorial(2 * k) for k in range(12)]

# From its start the zero of the cubic is within 11 %; each step squares that.
_NEWTON_STEPS = 4


class Crossover(NamedTuple):
    """Where the two parts of the loop are equally large, of no meaning unless it exists."""

    u: Array  # 1 - cos w
    y: Array  # 1 + cos w
    lean: Array  # alpha - 2 u
    exists: Array


def gain_crossover(alpha: Array, beta: Array, here: Device, kind: Kind) -> Crossover:
    """Solve ``|B|^2 = |T|^2`` for the nearer of u and y = 2 - u, which then has all its digits.

    ``|B|^2 - |T|^2 = h0 + h1 u + h2 u^2 + h3 u^3`` is positive at u = 0 and negative behind its one zero in (0, 2);
    in y it is the same with the opposite sign. From n = 1 on a stable loop has u < 1.
    """
    delta, c, em, a2, a1, a0 = here.delta, here.c, here.em, here.a2, here.a1, here.a0
    p1, gap = here.p1, here.gap
    xp = namespace(alpha, delta)
    sigma, mu, corner = a2 + a0, a2 - a0, 4.0 * a2 * a0
    m1 = a1 * sigma + corner
    spread, square, turned = 2.0 * beta * (alpha + beta), alpha * alpha, alpha + 2.0 * beta
    h0 = p1 * p1 * square
    h1 = 2.0 * (p1 * p1 * ((beta - delta) * (beta + delta) + alpha * beta) - m1 * square)
    rest = corner * square - 2.0 * m1 * spread
    h2, h3 = rest - 4.0 * c, corner * spread
    at_one = h0 + (h1 + h2 + h3)
    # At z = -1 the device and its delay must be the larger part.
    one, other = 2.0 * (1.0 + c), gap * turned
    exists = xp.abs(other) < one
    far, first = False, (h1, rest, h3)
    if kind.short:
        far = at_one > 0
        g1 = 2.0 * (mu * mu - gap * sigma)
        tall = turned * turned
        h0 = xp.where(far, (one - other) * (one + other), h0)
        h1 = xp.where(far, gap * gap * spread - g1 * tall - 2.0 * (em * em + 8.0 * c), h1)
        h2 = xp.where(far, 4.0 * c - corner * tall + g1 * spread, h2)
    else:
        # A zero behind u = 1 is not sought: what the steps towards it end with means nothing.
        exists = exists & (at_one <= 0)
    near = first_zero(h0, h1, h2, h3, kind.fractional, xp)
    u, y = xp.where(far, 2.0 - near, near), xp.where(far, near, 2.0 - near)
    return Crossover(u, y, _lean(alpha, u, first, here, xp), exists & (near > 0) & (near <= 1.0))


def _lean(alpha: Array, u: Array, first: tuple[Array, Array, Array], here: Device, xp: Any) -> Array:
    """``alpha - 2 u``, which vanishes beside both for slow, nearly undamped loops, by the equation that u solves.

    ``phi1^2 (alpha^2 - 4 u^2) = -(h1 u + (h2 + 4 c) u^2 + h3 u^3) - 4 u^2 (phi1^2 - c)``, wherever its terms are
    smaller than those of the difference itself.
    """
    terms = [first[0] * u, first[1] * (u * u), first[2] * (u * u * u), 4.0 * here.excess * (u * u)]
    total, scale = alpha + 2.0 * u, here.p1 * here.p1
    size = sum(xp.abs(term) for term in terms)
    scaled = scale * total
    return xp.where(size < scaled * total, -sum(terms) / xp.where(scaled > 0, scaled, 1.0), alpha - 2.0 * u)


def first_zero(h0: Array, h1: Array, h2: Array, h3: Array, fractional: bool, xp: Any) -> Array:
    """The zero in (0, 1] of a cubic that is positive before it and negative behind; a quadratic for h3 = 0."""
    lead = -(h2 + 0.5 * h3) if fractional else -h2
    root = xp.sqrt(xp.maximum(h1 * h1 + 4.0 * lead * h0, 0.0))
    falling = h1 < 0
    zero = xp.where(falling, 2.0 * h0, h1 + root) / xp.where(falling, root - h1, 2.0 * lead)
    if not fractional:
        return zero
    # A start outside (0, 1] only means that the part of the cubic left out matters.
    zero = xp.where((zero > 0) & (zero < 1.0), zero, 1.0)
    # Unrolled: XLA then makes one loop over the points out of all steps.
    for _ in range(_NEWTON_STEPS):
        value, slope = h0 + zero * (h1 + zero * (h2 + zero * h3)), h1 + zero * (2.0 * h2 + 3.0 * zero * h3)
        new = zero - value / slope
        zero = xp.where(new > 0, xp.minimum(new, 1.0), 0.5 * zero)
    return zero


def loop_vector(alpha: Array, beta: Array, crossover: Crossover, here: Device) -> tuple[Array, Array]:
    """Real and imaginary part of V, free of cancellation at both ends and where beta is near ``-delta``."""
    delta, c, em, a2, a0, p1, gap = here.delta, here.c, here.em, here.a2, here.a0, here.p1, here.gap
    u, y, lean, _ = crossover
    xp = namespace(u)
    s, near = xp.sqrt(u * y), u < 1.0
    re = s * (alpha + beta * (2.0 * u - em))
    im = xp.where(
        near,
        # alpha (em - u) + beta u (2 + em - 2 u), with em + beta = (beta + delta) - delta^2 phi2
        em * lean + u * (2.0 * ((beta + delta) - delta * delta * here.p2) + beta * (em - 2.0 * u) - alpha),
        y * (alpha + beta * (5.0 + c - 2.0 * y)) - (1.0 + c) * (alpha + 2.0 * beta),
    )
    sigma = a2 + a0
    m_re, m_im = xp.where(near, p1 - sigma * u, sigma * y - gap), (a2 - a0) * s
    return re * m_re - im * m_im, re * m_im + im * m_re


def lag_vector(crossover: Crossover, whole: Array) -> tuple[Array, Array]:
    """Cosine and sine of ``(n + 1/2) w``, which the verdict needs up to pi only."""
    u, y = crossover.u, crossover.y
    xp = namespace(u, whole)
    cos_half, sin_half = xp.sqrt(0.5 * xp.maximum(y, 0.0)), xp.sqrt(0.5 * u)
    # Half of the angle, so that its sine keeps its digits for slow loops; behind a quarter turn only n = 0 matters.
    small = xp.minimum(u, 1.0)
    half = (whole + 0.5) * sin_half * horner(2.0 * small - 1.0, ARCSINE)
    half = xp.minimum(half, 0.5 * np.pi)
    square = half * half
    sine, cosine = half * horner(square, _SIN), horner(square, _COS)
    undelayed = whole == 0
    return (
        xp.where(undelayed, cos_half, (cosine - sine) * (cosine + sine)),
        xp.where(undelayed, sin_half, 2.0 * sine * cosine),
    )


class Phase(NamedTuple):
    """The loop at its crossover, turned by the lag: its argument is the phase margin where ``usable``."""

    re: Array
    im: Array
    usable: Array  # every other condition of stability holds


def phase_at(alpha: Array, beta: Array, crossover: Crossover, here: Device) -> Phase:
    """``V e^(-j (n + 1/2) w)``; the wall is stable where it is usable and its imaginary part is positive."""
    xp = namespace(alpha, crossover.u)
    re, im = loop_vector(alpha, beta, crossover, here)
    cosine, sine = lag_vector(crossover, here.whole)
    # w < pi/(n + 1), with room: where that binds the wall is unstable by far, and only a full turn must be excluded.
    near = crossover.u * (here.whole + 1.0) * (here.whole + 1.0) < 0.5 * np.pi * np.pi
    near = xp.where(here.whole > 0, near, True)
    usable = (alpha > 0) & (beta > -here.delta) & crossover.exists & near & (im > 0)
    return Phase(re * cosine + im * sine, im * cosine - re * sine, usable)


def stable_kernel(alpha: Array, beta: Array, delta: Array, d: Array, kind: Kind = ANY) -> Array:
    """Whether each wall is stable, elementwise; False for what is NaN."""
    return stable_at(alpha, beta, device(delta, d, kind), kind)


def stable_at(alpha: Array, beta: Array, here: Device, kind: Kind) -> Array:
    """The same on a discretized device.

    Below one period the crossover is eliminated: the limit of each row is in closed form (docs/theory/one-lobe.md), and
    as well conditioned for strong damping as for none.
    """
    xp = namespace(alpha, here.c)
    alpha = xp.where(within(alpha, WALL_RANGE) & within(beta, WALL_RANGE), alpha, np.nan)
    below = alpha < short_row(beta, here) if kind.short else None
    if not kind.long:
        return (alpha > 0) & below
    long = Kind(False, True, kind.fractional)
    phase = phase_at(alpha, beta, gain_crossover(alpha, beta, here, long), here)
    stable = phase.usable & (phase.im > 0)
    return stable if below is None else xp.where(here.whole < 1, (alpha > 0) & below, stable)
