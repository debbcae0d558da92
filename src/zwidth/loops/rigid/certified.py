"""Stability that is never guessed: the verdict in float64 with a proved error bound, then in ball arithmetic.

The text is that of `loops.rigid.crossover`; for the points that the floating-point filter leaves open its numbers are
balls of python-flint (optional) around inputs taken as exact, and the precision doubles until a verdict is certain.
What no precision decides is a pair of poles exactly on the unit circle. For delta > 0 and alpha > 0 no such point is
known: c is then transcendental, while alpha, beta, delta and d are rational. For delta = 0 there are such walls (alpha
= 0, beta = 2, d = 0): they stay undecided.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from zwidth.arrays.xp import horner
from zwidth.loops.rigid.certified_filter import OPEN, STABLE, UNSTABLE, filter_walls
from zwidth.loops.rigid.crossover import Lag, Verdict, first_zero, long_verdict, short_verdict
from zwidth.loops.rigid.device import DeviceTerms, PhiFunctions, held_plant, wall_status
from zwidth.loops.rigid.folding import Points, fold_arguments
from zwidth.words.errors import InputError
from zwidth.words.status import Status
from zwidth.words.types import ArrayLike

if TYPE_CHECKING:
    import flint


FIRST_BITS = 128
_EXTRA_BITS = 64


def available() -> bool:
    """Whether python-flint is installed."""
    return find_spec("flint") is not None


def decide(alpha: float, beta: float, delta: float, d: float, max_bits: int) -> tuple[bool, Status, int]:
    """Label, status and bits of one exact point: alpha > 0 and beta > -delta, or alpha = 0 and beta > delta."""
    edge, bits = alpha == 0, min(FIRST_BITS, max_bits)
    while True:
        found = verdict(alpha, beta, delta, d, bits)
        if found.stable or found.unstable:
            inside = bool(found.stable)
            return inside and not edge, Status.ON_BOUNDARY if inside and edge else Status.OK, bits
        if bits == max_bits:
            return False, Status.UNDECIDED, bits
        bits = min(2 * bits, max_bits)


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


class CertifiedResult(NamedTuple):
    """Labels that are right or absent, with the reason and the precision."""

    stable: np.ndarray
    status: np.ndarray
    bits: np.ndarray


def certified_stable(
    alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike, *, max_bits: int = 8192
) -> CertifiedResult:
    """Decide whether every pole lies strictly inside the unit circle, for the inputs exactly as given.

    A label is a theorem about the float64 inputs, provided that ``+ - * /`` and the square root round correctly, as
    XLA's do unless its fast-math flags are set. ``stable`` is False wherever the status is not OK: ON_BOUNDARY, no pole
    is outside and at least one exactly on the circle; UNDECIDED, more than ``max_bits`` (at least 64) is needed, or the
    filter left the point open and the extra ``certified`` is not installed; or the input is out of range. ``bits`` is 0
    where the filter or a sign decided. The filter decides more than 99.9 % of a map and of scattered points; balls take
    about 0.1 ms a point (Walton, Marshall 1987; Rump 1999; Johansson 2017).

    Example:
        >>> from zwidth.loops.rigid.certified import certified_stable
        >>> certified_stable([0.3, 0.6, 0.7], 0.5, 0.0, 0).stable.tolist()
        [True, True, False]

        The boundary is at 3/5; the float64 number 0.6 is 2e-17 below it.
    """
    if max_bits < 64:
        raise InputError(f"max_bits: got {max_bits}, 64 or more is needed")
    laid = fold_arguments((alpha, beta, delta, d))
    points, shape = laid.points, laid.points.shape
    code = filter_walls(points)
    stable, status, bits = np.asarray(code == STABLE), np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    rest = np.flatnonzero(code >= OPEN)
    if rest.size:
        # A single index, because a point without axes has no other.
        flat = [np.broadcast_to(array, shape).reshape(-1)[rest] for array in points]
        settled = _settle_points(Points(*flat), code.reshape(-1)[rest] & 3, max_bits)
        for result, values in zip((stable, status, bits), settled, strict=True):
            result.reshape(-1)[rest] = values
    return CertifiedResult(*map(laid.spread, (stable, status, bits)))


def _settle_points(points: Points, verdict: np.ndarray, max_bits: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decide what the filter left open or marked as special, one axis of points: by signs, then by balls."""
    alpha, beta, delta, _ = points
    bits = np.zeros(alpha.size, np.int32)
    status = wall_status(*points)
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
        walls = zip(*(column[rest].tolist() for column in points), strict=True)
        stable[rest], status[rest], bits[rest] = zip(*(decide(*wall, max_bits=max_bits) for wall in walls), strict=True)
    return stable, status, bits
