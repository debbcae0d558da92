"""Ball arithmetic for the points that the floating-point filter of the certified method leaves open.

The text is that of `loops.rigid.crossover`; its numbers are balls of python-flint around inputs taken as
exact, and the precision doubles until a verdict is certain. Loaded only when needed: python-flint is optional.

What no precision decides is a pair of poles exactly on the unit circle. For delta > 0 and alpha > 0 no such point is
known: c is then transcendental, while alpha, beta, delta and d are rational. For delta = 0 everything is algebraic, and
whether the crossover is a zero of P is decided by their greatest common divisor, see `_crosses_exactly`.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from zwidth.arrays.phi import PhiFunctions
from zwidth.arrays.xp import horner
from zwidth.loops.rigid.crossover import Lag, Verdict, first_zero, gain_cubic, long_verdict, short_verdict
from zwidth.loops.rigid.delay_classes import DeviceTerms
from zwidth.loops.rigid.plant import discretize
from zwidth.words.status import Status

if TYPE_CHECKING:
    import flint

FIRST_BITS = 128
_EXTRA_BITS = 64
# Points that this many bits leave open are looked at exactly where delta = 0, up to this many whole periods.
_DOUBTFUL_BITS = 512
_LONGEST_EXACT = 512
_PRIME = 2**61 - 1


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
        last = bits == max_bits
        if delta == 0 and (last or bits == _DOUBTFUL_BITS) and _crosses_exactly(*_exact(alpha, beta, d), bits):
            return Decision(False, Status.ON_BOUNDARY, bits)
        if last:
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


def _exact(alpha: float, beta: float, d: float) -> tuple[Any, Any, int, Any]:
    """alpha, beta, n and f as rational numbers."""
    import flint

    stiffness, damping, f = (flint.fmpq(*value.as_integer_ratio()) for value in (alpha, beta, d - int(d)))
    return stiffness, damping, int(d), f


def _crosses_exactly(alpha: Any, beta: Any, whole: int, f: Any, bits: int) -> bool:
    """Whether the poles at delta = 0 include the crossover itself, ``z = e^(j w)``: then they are on the unit circle.

    Called where all that precedes the phase is certain, so that the wall borders the stable ones: no pole is outside.
    With rational alpha, beta and f, ``H(u)`` times a power of z is a polynomial G(z) of degree 6 at most, a simple
    zero of which is e^(j w). It is a zero of P too exactly if it is one of gcd(P mod G, G).
    """
    import flint

    cubic, wall, lead = _rational(alpha, beta, f)
    z = flint.fmpq_poly([0, 1])
    coefficients = cubic if alpha != 0 else cubic[1:]
    # u = -(z - 1)^2/(2 z)
    degree = len(coefficients) - 1
    g = sum((h * (-(z - 1) * (z - 1)) ** k * (2 * z) ** (degree - k) for k, h in enumerate(coefficients)), 0 * z)
    power = whole + lead
    if not _meet_modulo(g.numer(), (z - 1) * (z - 1), wall, power) or whole > _LONGEST_EXACT:
        return False
    common = g.gcd((_power_modulo(z, power, g) * (z - 1) * (z - 1) + wall) % g)
    if common.degree() == 0:
        return False
    with flint.ctx.workprec(bits):
        u, found = _enclose_zero(tuple(flint.arb(h) for h in cubic))
        if not found:
            return False
        at = flint.acb(1 - u, (u * (2 - u)).sqrt())
        # G = common * rest vanishes there; where rest does not, common does.
        rest = flint.acb_poly(flint.fmpq_poly(g / common))
        return not rest(at).contains(0)


def _rational(alpha: Any, beta: Any, f: Any) -> tuple[list[Any], Any, int]:
    """At delta = 0: H by powers of u, the wall's part of P, and the power of z in ``z^(n + lead) (z - 1)^2``."""
    import flint

    half, t = flint.fmpq(1, 2), 1 - f
    a2, a1, a0 = t * t * half, (1 + 2 * t * f) * half, f * f * half
    numerator, lead = ([a0, a1, a2], 2) if f != 0 else ([a1, a2], 1)
    nothing: dict[str, Any] = dict.fromkeys(DeviceTerms._fields)
    here = DeviceTerms(**nothing)._replace(
        delta=flint.fmpq(0), c=flint.fmpq(1), p1=flint.fmpq(1), a2=a2, a1=a1, a0=a0 if f != 0 else None
    )
    cubic = list(gain_cubic(alpha, beta, here))
    return cubic, flint.fmpq_poly(numerator) * flint.fmpq_poly([-beta, alpha + beta]), lead


def _meet_modulo(g: Any, factor: Any, wall: Any, power: int) -> bool:
    """Whether G and ``z^power factor + wall`` have a common zero modulo a prime: if not, they have none at all."""
    import flint

    def reduced(p: Any) -> Any:
        scale = flint.nmod(int(p.denom()), _PRIME)
        return flint.nmod_poly([flint.nmod(int(value), _PRIME) / scale for value in p.numer().coeffs()], _PRIME)

    small = flint.nmod_poly([int(value) % _PRIME for value in g.coeffs()], _PRIME)
    if small.degree() != g.degree():
        return True
    z = flint.nmod_poly([0, 1], _PRIME)
    return small.gcd((_power_modulo(z, power, small) * reduced(factor) + reduced(wall)) % small).degree() > 0


def _power_modulo(z: Any, power: int, modulus: Any) -> Any:
    """``z^power`` by repeated squaring."""
    result = z**0
    for digit in bin(power)[2:]:
        result = result * result % modulus
        if digit == "1":
            result = result * z % modulus
    return result


def polynomial(alpha: float, beta: float, delta: float, d: float, bits: int) -> list[Any]:
    """The coefficients of P as balls, lowest power first."""
    import flint

    with flint.ctx.workprec(bits):
        here = device(delta, d, bits)
        n = [a for a in (here.a0, here.a1, here.a2) if a is not None]
        stiffness, damping = flint.arb(alpha), flint.arb(beta)
        s = stiffness + damping
        wall = [-n[0] * damping, *(left * s - right * damping for left, right in pairwise(n)), n[-1] * s]
        p = [*wall, *[flint.arb(0)] * (int(d) + 1)]
        for index, value in enumerate((here.c, -(1 + here.c), flint.arb(1)), len(p) - 3):
            p[index] += value
        return p


def decide_all(columns: list[np.ndarray], max_bits: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`decide` point by point: stable, status, bits."""
    count = columns[0].size
    stable, status, bits = np.zeros(count, bool), np.zeros(count, np.int32), np.zeros(count, np.int32)
    alpha, beta, delta, d = (column.tolist() for column in columns)
    for index in range(count):
        stable[index], status[index], bits[index] = decide(alpha[index], beta[index], delta[index], d[index], max_bits)
    return stable, status, bits
