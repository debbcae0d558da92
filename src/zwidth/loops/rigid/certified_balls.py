"""Ball arithmetic for the points that the floating-point filter of the certified method leaves open.

The text is that of `loops.rigid.crossover`; its numbers are balls of python-flint around inputs taken as
exact, and the precision doubles until a verdict is certain. Loaded only when needed: python-flint is optional.

What no precision decides is a pair of poles exactly on the unit circle. For delta > 0 and alpha > 0 no such point is
known: c is then transcendental, while alpha, beta, delta and d are rational. For delta = 0 there are such walls
(alpha = 0, beta = 2, d = 0): they stay undecided.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from zwidth.arrays.phi import PhiFunctions
from zwidth.arrays.xp import horner
from zwidth.loops.rigid.crossover import Lag, Verdict, first_zero, long_verdict, short_verdict
from zwidth.loops.rigid.delay_classes import DeviceTerms
from zwidth.loops.rigid.plant import discretize
from zwidth.words.status import Status

if TYPE_CHECKING:
    import flint

FIRST_BITS = 128
_EXTRA_BITS = 64


class Decision(NamedTuple):
    """What is known of one point."""

    stable: bool
    status: Status
    bits: int


def available() -> bool:
    """Whether python-flint is installed."""
    return find_spec("flint") is not None


def decide(alpha: float, beta: float, delta: float, d: float, max_bits: int) -> Decision:
    """Decide one point of the domain, taken as exact: alpha > 0 and beta > -delta, or alpha = 0 and beta > delta."""
    edge, bits = alpha == 0, min(FIRST_BITS, max_bits)
    while True:
        found = verdict(alpha, beta, delta, d, bits)
        if found.stable or found.unstable:
            inside = bool(found.stable)
            return Decision(inside and not edge, Status.ON_BOUNDARY if inside and edge else Status.OK, bits)
        if bits == max_bits:
            return Decision(False, Status.UNDECIDED, bits)
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
        p = discretize(x, f if f != 0 else None, _phi)
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


def decide_all(columns: list[np.ndarray], max_bits: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`decide` point by point: stable, status, bits."""
    count = columns[0].size
    stable, status, bits = np.zeros(count, bool), np.zeros(count, np.int32), np.zeros(count, np.int32)
    alpha, beta, delta, d = (column.tolist() for column in columns)
    for index in range(count):
        stable[index], status[index], bits[index] = decide(alpha[index], beta[index], delta[index], d[index], max_bits)
    return stable, status, bits
