"""Stable, unstable, or open: the verdict of `zwidth.stability.crossover` in balls, one text for float64 and for arb.

Every comparison is between balls, so that what it says holds for every number in them: the same lines certify one wall
given exactly and a whole box of walls and devices. Theorems: docs/theory/one-crossover.md (the crossover, and the phase
there), docs/theory/one-lobe.md (rows below one period).

The text is written for ``alpha >= 0`` and ``beta > -delta``. At alpha = 0, where a pole is at z = 1, its verdict is on
the others, for ``beta > delta``: with ``P = (z - 1) R``, R is stable exactly if P is for every small alpha > 0, because
the pole at 1 then moves inside, and everything below is continuous there (|B|^2 and |T|^2 lose the factor u).
"""

from __future__ import annotations

from collections.abc import Callable
from math import factorial
from typing import Any, NamedTuple

from zwidth._types import Array
from zwidth.stability.crossover import first_zero
from zwidth.stability.enclosed_plant import Plant
from zwidth.stability.enclosure import TINY, UNIT, Ball
from zwidth.xp import horner, namespace


class Verdict(NamedTuple):
    """What is certain; neither for what is left open."""

    stable: Any
    unstable: Any


class Short(NamedTuple):
    """What rows with d < 1 need of a device: see `zwidth.stability.row_limit`."""

    plant: Plant
    gap: Any  # N(-1)
    line: Any  # 2 (1 + c)
    linear: tuple[Any, Any] | None  # of V b = y (u0 + u1 y): u0, u1
    size: tuple[Any, Any, Any]  # V = |N|^2 by powers of y
    curve: tuple[Any, Any, Any]  # alpha V = 4 y times this


class Long(NamedTuple):
    """What the crossover needs of a device."""

    plant: Plant
    square: Any  # phi1^2
    m1: Any
    corner: Any  # 4 a2 a0, None for a whole delay, like the others that vanish
    sigma: Any
    mu: Any


class Lag(NamedTuple):
    """Cosine and sine of ``(n + 1/2) w``, and what is certain of w."""

    cosine: Any
    sine: Any
    within: Any  # (n + 1/2) w <= pi
    beyond: Any  # w >= pi/(n + 1)


# h0, h1, h2, h3 (None for a quadratic) -> u, and whether it is proved to contain the only zero in (0, 2)
Solve = Callable[[tuple[Any, Any, Any, Any]], tuple[Any, Any]]
# u, u (2 - u), n -> Lag
TakeLag = Callable[[Any, Any, Any], Lag]


def short_device(plant: Plant) -> Short:
    """The device for `short_verdict`."""
    p1, em, a2, a1, a0, f = plant.p1, plant.em, plant.a2, plant.a1, plant.a0, plant.f
    line = (plant.c + 1) * 2
    if a0 is None:
        return Short(plant, a2 - a1, line, None, (p1, a2, a1), (p1, p1, p1))
    t = 1 - f
    slack = f * (f * em + p1) + t * (f * plant.p1_t + t * plant.psi_t) + a0
    u0, u1 = p1 * slack * 4, a0 * (f + t * plant.p1_t) * -16
    product = a2 * a0 * 4
    size = (p1 * p1, (a1 * (a2 + a0) + product) * -4, product * 4)
    curve = (p1 * (em + f * em + p1), (a1 + a0 * 3 + a0 * em) * -4, a0 * 16)
    return Short(plant, a2 - a1 + a0, line, (u0, u1), size, curve)


def short_verdict(alpha: Any, beta: Any, device: Short) -> Verdict:
    """The verdict for d < 1: alpha against the end of its row."""
    plant = device.plant
    # |L(-1)| < 1 is needed; without it there is no crossover.
    height = device.gap * (alpha + beta * 2)
    below, without = height < device.line, (height > device.line) | (height < -device.line)
    b = beta + plant.delta
    if device.linear is None:
        p1, phi2, psi = device.size
        left, right = alpha * psi * (p1 + phi2 * b), p1 * b * (1 - psi * beta)
        return Verdict(below & (left < right), without | (left > right))
    (u0, u1), (v0, v1, v2), (g0, g1, g2) = device.linear, device.size, device.curve
    # Where on the lobe this beta is: lead y^2 - linear y + start = 0, the first zero.
    start, linear, lead = v0 * b, u0 - b * v1, b * v2 - u1
    square = linear * linear - start * lead * 4
    y = start * 2 / (linear + square.sqrt())
    left, right = alpha * (v0 + y * (v1 + y * v2)), y * (g0 + y * (g1 + y * g2)) * 4
    reached, missed = (square > 0) & (y < 1), (square < 0) | (y > 1)
    # Beyond the lobe's end a row is stable up to the line, if the lobe ends at z = -1, or nowhere. It ends before where
    # alpha would be negative at z = -1, or the line would lie below.
    end = g0 + g1 + g2
    cornered, ended = (end > 0) & (device.gap > 0), (end < 0) | (device.gap < 0)
    stable = below & ((reached & (left < right)) | (missed & cornered))
    return Verdict(stable, without | (reached & (left > right)) | (ended & (missed | (left > right))))


def long_device(plant: Plant) -> Long:
    """The device for `long_verdict`."""
    p1, a2, a1, a0 = plant.p1, plant.a2, plant.a1, plant.a0
    if a0 is None:
        return Long(plant, p1 * p1, a1 * a2, None, a2, a2)
    corner, sigma = a2 * a0 * 4, a2 + a0
    return Long(plant, p1 * p1, a1 * sigma + corner, corner, sigma, a2 - a0)


def long_verdict(alpha: Any, beta: Any, whole: Any, device: Long, solve: Solve, take_lag: TakeLag) -> Verdict:
    """The verdict for d >= 1: the phase at the gain crossover, see `zwidth.stability.crossover`."""
    cubic = gain_cubic(alpha, beta, device)
    u, found = solve(cubic)
    q = u * (2 - u)
    lag = take_lag(u, q, whole)
    re, im = loop_vector(alpha, beta, u, q, device)
    phase = im * lag.cosine - re * lag.sine
    h0, h1, h2, h3 = cubic
    # w > pi/2, or no crossover at all.
    late = h0 + h1 + h2 + (0 if h3 is None else h3) > 0
    stable = found & lag.within & (im > 0) & (phase > 0)
    return Verdict(stable, late | (found & (lag.beyond | (im < 0) | (lag.within & (phase < 0)))))


def gain_cubic(alpha: Any, beta: Any, device: Long) -> tuple[Any, Any, Any, Any]:
    """``|B|^2 - |T|^2`` by powers of u, the last one None for a whole delay."""
    plant, square, m1, corner, _, _ = device
    spread, tall = beta * (alpha + beta) * 2, alpha * alpha
    bend = (beta - plant.delta) * (beta + plant.delta) + alpha * beta
    h0, h1 = square * tall, (square * bend - m1 * tall) * 2
    h2 = m1 * spread * -2 - plant.c * 4
    if corner is None:
        return h0, h1, h2, None
    return h0, h1, corner * tall + h2, corner * spread


def loop_vector(alpha: Any, beta: Any, u: Any, q: Any, device: Long) -> tuple[Any, Any]:
    """Real and imaginary part of V = W M Z at ``u = 1 - cos w``; q = u (2 - u) is the square of sin w."""
    em, mu = device.plant.em, device.mu
    side = alpha + beta * (u * 2 - em)
    im = alpha * (em - u) + beta * u * (em + 2 - u * 2)
    m_re = device.plant.p1 - device.sigma * u
    return q.sqrt() * (side * m_re - im * mu), im * m_re + q * side * mu


# --- float64 ---

# asin(sqrt y)/sqrt y by powers of 4 y - 1, within 2^-46 of itself for 0 <= y <= 0.5002, rounding included.
_ARCSINE = [
    *(1.0471975511965939, 0.053751493591325285, 0.007798902239476116, 0.001519668539770706, 0.0003408637129203685),
    *(8.302317447211976e-05, 2.1345635825394298e-05, 5.701810038289938e-06, 1.5666403429672824e-06),
    *(4.400955991598038e-07, 1.2651766241163793e-07, 3.670228515702153e-08, 9.938877829363156e-09),
    *(2.9355657831219474e-09, 1.3880931000501491e-09, 4.2073851086352364e-10),
]
_LARGEST_U = 1.0002
# Taylor series. On [0, 1.6] the first term left out and the rounding are below 2^-43 (of the angle for the sine).
_SIN = [(-1.0) ** k / factorial(2 * k + 1) for k in range(9)]
_COS = [(-1.0) ** k / factorial(2 * k) for k in range(10)]
_LARGEST_ANGLE = 1.6
_HALF_PI_BELOW, _HALF_PI_ABOVE = 1.570796326794896, 1.5707963267948970


def enclose_zero(cubic: tuple[Ball, Ball, Ball, Any]) -> tuple[Ball, Array]:
    """Around the zero of the midpoints, as wide as the radii make it; the signs of H at both ends are the proof."""
    mids, radii = zip(*((h.mid, h.radius) for h in cubic if h is not None), strict=True)
    xp = namespace(*mids)
    h0, h1, h2 = mids[:3]
    h3 = mids[3] if len(mids) == 4 else 0.0
    u = first_zero(h0, h1, h2, h3, len(mids) == 4, xp)
    value, slope = horner(u, list(mids)), h1 + u * (2.0 * h2 + 3.0 * u * h3)
    error = _horner_error(u, mids, radii)
    reach = 1.5 * (2.0 * error + abs(value)) / abs(slope) + (8.0 * UNIT) * u
    low, high = u - reach, u + reach
    bound = _horner_error(high, mids, radii)
    found = (low > 0) & (high < _LARGEST_U) & (horner(low, list(mids)) > bound) & (horner(high, list(mids)) < -bound)
    return Ball(u, reach + (4.0 * UNIT) * u), found


def _horner_error(u: Array, mids: tuple[Array, ...], radii: tuple[Array, ...]) -> Array:
    """Of H at up to u >= 0: the radii of its coefficients, and 7u of the absolute terms for Horner's rule."""
    return horner(u, [radius + (8.0 * UNIT) * abs(mid) for mid, radius in zip(mids, radii, strict=True)]) + TINY


def take_lag(u: Ball, q: Ball, whole: Array) -> Lag:
    """The lag by series of half its angle, ``(n + 1/2) w/2``."""
    xp = namespace(u.mid)
    safe = xp.where((u.mid > 0) & (u.mid < _LARGEST_U), u.mid, 0.5)
    half = (whole + 0.5) * (xp.sqrt(0.5 * safe) * horner(2.0 * safe - 1.0, _ARCSINE))
    # dw/du = 1/sqrt(u (2 - u))
    error = 0.5 * (whole + 0.5) * u.radius / xp.sqrt(xp.maximum(q.lower(), 0.0)) + 2.0**-45 * half
    within = half + error < _HALF_PI_BELOW
    beyond = (half - error) * (whole + 1.0) > (_HALF_PI_ABOVE * (whole + 0.5)) * (1.0 + 4.0 * UNIT)
    angle = xp.minimum(half, _LARGEST_ANGLE)
    square = angle * angle
    sine, cosine = angle * horner(square, _SIN), horner(square, _COS)
    # The derivative of both by half of the angle is at most 2.
    return Lag(
        Ball((cosine - sine) * (cosine + sine), 2.0 * error + 2.0**-40),
        Ball(2.0 * sine * cosine, 2.0 * error + 2.0**-40 * angle),
        within,
        beyond,
    )
