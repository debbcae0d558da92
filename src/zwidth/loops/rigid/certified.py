"""Stability that is never guessed: the verdict in float64 with a proved error bound, then in ball arithmetic.

The text is that of `loops.rigid.crossover`; for the points that the floating-point filter leaves open its numbers are
balls of python-flint (optional) around inputs taken as exact, and the precision doubles until a verdict is certain
(Walton, Marshall 1987; Rump 1999; Johansson 2017). What no precision decides is a pair of poles exactly on the unit
circle. For delta > 0 and alpha > 0 no such point is known: c is then transcendental, while alpha, beta, delta and d are
rational. For delta = 0 there are such walls (alpha = 0, beta = 2, d = 0): they stay undecided.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.arrays.balls import BITS, available
from zwidth.arrays.held_mass import DeviceTerms, PhiFunctions, held_plant
from zwidth.loops.rigid.certified_filter import OPEN, STABLE, UNSTABLE, filter_walls
from zwidth.loops.rigid.crossover import Lag, Verdict, first_zero, long_verdict, short_verdict
from zwidth.loops.rigid.folding import Points, pick_points
from zwidth.loops.rigid.normalization import wall_status
from zwidth.words.status import Status
from zwidth.words.xp import horner

if TYPE_CHECKING:
    import flint


_EXTRA_BITS = 64


def decide(alpha: float, beta: float, delta: float, d: float) -> tuple[bool, Status]:
    """Label and status of one exact point: alpha > 0 and beta > -delta, or alpha = 0 and beta > delta."""
    edge = alpha == 0
    for bits in BITS:
        found = verdict(alpha, beta, delta, d, bits)
        if found.stable or found.unstable:
            inside = bool(found.stable)
            return inside and not edge, Status.ON_BOUNDARY if inside and edge else Status.OK
    return False, Status.UNDECIDED


def verdict(alpha: float, beta: float, delta: float, d: float, bits: int) -> Verdict:
    """What is certain at one precision."""
    import flint

    with flint.ctx.workprec(bits):
        here, wall = device(delta, d, bits), (flint.arb(alpha), flint.arb(beta))
        return short_verdict(*wall, here) if d < 1 else long_verdict(*wall, int(d), here, _enclose_zero, _take_lag)


@lru_cache(maxsize=64)
def device(delta: float, d: float, bits: int) -> DeviceTerms:
    """The device of exact delta and d in balls; whole maps share it."""
    import flint

    # What the rounding of delta (1 - f) loses, the phi-functions multiply.
    with flint.ctx.workprec(bits + _EXTRA_BITS):
        x, f = flint.arb(delta), flint.arb(d - int(d))
        late = _phi(x * (1 - f))
        p = held_plant(x, f if f != 0 else None, _phi)
        a0 = p.a0 if f != 0 else None
        at = _phi(x)
        phis = at.phi1, at.phi2, at.psi, late.phi1, late.psi
        return DeviceTerms(x, None, f, p.c, p.em, *phis, p.a2, p.a1, a0, p.gap, None)


def _phi(x: flint.arb) -> PhiFunctions:
    """The phi-functions of x >= 0, with as many bits more as the quotients cancel."""
    import flint

    if x == 0:
        one, half = flint.arb(1), flint.arb(0.5)
        return PhiFunctions(one, one, half, half, flint.arb(0))
    man, exponent = x.mid().man_exp()
    with flint.ctx.workprec(flint.ctx.prec + 16 + max(0, -3 * (int(exponent) + int(man).bit_length()))):
        c = (-x).exp()
        p1 = -(-x).expm1() / x
        p2, psi = (1 - p1) / x, (p1 - c) / x
        return PhiFunctions(c, p1, p2, psi, p2 - psi)


def _enclose_zero(cubic: tuple[Any, ...]) -> tuple[flint.arb, bool]:
    """Newton's method on the midpoints, then the signs beside it."""
    import flint

    mids = [h.mid() for h in cubic]
    with np.errstate(all="ignore"):
        guess = first_zero(tuple(map(np.float64, mids)))
    u = flint.arb(float(guess) if 0 < guess < 2 else 1.0)
    smallest = flint.arb(2) ** (8 - flint.ctx.prec)
    slopes = [k * h for k, h in enumerate(mids)][1:]
    for _ in range(64):
        step = (horner(u, mids) / horner(u, slopes)).mid()
        u = (u - step).mid()
        if not (u > 0 and u < 2):
            return u, False
        if abs(step) < u * smallest * 16:
            break
    error, slope = abs(horner(u, cubic)), abs(horner(u, slopes))
    reach = (error * 3 / slope + u * smallest).upper()
    low, high = u - reach, u + reach
    found = low > 0 and high < 2 and horner(low, cubic) > 0 and horner(high, cubic) < 0
    return flint.arb(u, reach), bool(found)


def _take_lag(u: flint.arb, whole: int) -> Lag:
    import flint

    w = (u / 2).sqrt().asin() * 2
    lag, turn = w * (whole + 0.5), flint.arb.pi()
    sine, cosine = lag.sin_cos()
    half = (lag / 2).sin()
    return Lag(cosine, sine, half * half, lag < turn, w * (whole + 1) > turn)


def prove_labels(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Labels that are right, and statuses: ON_BOUNDARY or UNDECIDED where there is none (docs/theory/certified.md)."""
    code = filter_walls(points)
    stable, status = np.asarray(code == STABLE), np.zeros(points.shape, np.int32)
    rest = code >= OPEN
    if rest.any():
        stable[rest], status[rest] = _settle_points(pick_points(points, rest).columns(), code[rest] & 3)
    return stable, status


def _settle_points(columns: list[np.ndarray], verdict: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Decide what the filter left open or marked as special, by signs, then by balls."""
    alpha, beta, delta, d = np.broadcast_arrays(*columns)
    status = np.broadcast_to(wall_status(alpha, beta, delta, d), verdict.shape).copy()
    inside = status == Status.OK
    # P(1) = phi1 alpha < 0, or for alpha = 0 P'(1) = phi1 (delta + beta) < 0: a real pole beyond z = 1. For alpha > 0
    # the lobe lies above beta = -delta.
    signs = (alpha < 0) | (beta < -delta) | ((alpha > 0) & (beta == -delta))
    # For alpha = 0 and |beta| <= delta, |beta N| <= |beta| phi1 <= 1 - c <= |z - c| on the circle: with the pole at
    # z = 1 aside, none is outside.
    calm = (alpha == 0) & (np.abs(beta) <= delta)
    verdict = np.where(signs, UNSTABLE, np.where(calm, STABLE, verdict))
    stable = inside & (verdict == STABLE) & (alpha != 0)
    status[inside & (verdict == STABLE) & (alpha == 0)] = Status.ON_BOUNDARY
    rest = np.flatnonzero(inside & (verdict == OPEN))
    status[rest] = Status.UNDECIDED
    if rest.size and available():
        walls = zip(*(column[rest].tolist() for column in (alpha, beta, delta, d)), strict=True)
        stable[rest], status[rest] = zip(*(decide(*wall) for wall in walls), strict=True)
    return stable, status
