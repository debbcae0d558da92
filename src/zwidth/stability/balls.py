"""Ball arithmetic for the points that the floating-point filter of the certified method leaves open.

Every number is an interval (a "ball" of python-flint) that contains the exact one, starting from inputs that are
taken as exact; the precision doubles until the Schur-Cohn recursion is certain of every comparison, or of one that
fails. Loaded only when needed: python-flint is an optional dependency.

What no precision decides is a pole exactly on the unit circle. At alpha = 0 one is at z = 1, and P/(z - 1) decides.
For delta = 0 the coefficients are rational numbers, and ``gcd(P, P*)``, P* with the coefficients reversed, holds
exactly the zeros z of P for which 1/z is another one, those on the circle among them. For delta > 0 and alpha > 0 no
such point is known: c is then transcendental, while alpha, beta, delta and d are rational.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from itertools import pairwise
from math import frexp
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from zwidth.status import Status

if TYPE_CHECKING:
    import flint

FIRST_BITS = 128
# Enough for the exact product of a float64 and 1 - f; what its rounding lost, the phi-functions would multiply.
_EXACT_BITS = 1200


class Verdict(NamedTuple):
    """What is known of one point."""

    stable: bool
    status: Status
    bits: int


def available() -> bool:
    """Whether python-flint is installed."""
    return find_spec("flint") is not None


def decide(alpha: float, beta: float, delta: float, d: float, max_bits: int) -> Verdict:
    """Decide one valid point, taken as exact, with alpha > 0, or alpha = 0 and beta > delta."""
    edge = alpha == 0
    # A stage of the recursion costs up to a bit.
    bits = min(FIRST_BITS << (int(d) // FIRST_BITS).bit_length(), max_bits)
    while True:
        inside = _all_inside(alpha, beta, delta, d, bits)
        if inside is not None:
            return Verdict(inside and not edge, Status.ON_BOUNDARY if inside and edge else Status.OK, bits)
        if bits == max_bits:
            break
        bits = min(2 * bits, max_bits)
    if delta == 0:
        return _decide_rational(alpha, beta, d, max_bits)
    return Verdict(False, Status.UNDECIDED, max_bits)


def _all_inside(alpha: float, beta: float, delta: float, d: float, bits: int) -> bool | None:
    """Whether every pole lies inside, the one at z = 1 for alpha = 0 aside; None if the precision does not tell."""
    import flint

    with flint.ctx.workprec(bits):
        plant, whole = _device(delta, d, bits), int(d)
        if alpha == 0:
            return _sparse_schur_cohn(_edge_coefficients(flint.arb(beta), plant, whole))
        return _sparse_schur_cohn(_coefficients(flint.arb(alpha), flint.arb(beta), plant, whole))


def polynomial(alpha: float, beta: float, delta: float, d: float, bits: int) -> list[Any]:
    """The coefficients of P as balls, lowest power first."""
    import flint

    with flint.ctx.workprec(bits):
        return _coefficients(flint.arb(alpha), flint.arb(beta), _device(delta, d, bits), int(d)).dense()


class _BallDevice(NamedTuple):
    c: Any
    numerator: tuple[Any, ...]  # lowest power first; two terms for a whole delay


@lru_cache(maxsize=64)
def _device(delta: float, d: float, bits: int) -> _BallDevice:
    """The device in balls; whole maps share it."""
    import flint

    f = d - int(d)
    if f == 0:
        c, phi2, psi = _phi(flint.arb(delta), frexp(delta)[1], bits)
        return _BallDevice(c, (psi, phi2))
    ball, f_ball = flint.arb(delta), flint.arb(f)
    with flint.ctx.workprec(_EXACT_BITS):
        t = 1 - f_ball
        x_t, x_f = ball * t, ball * f_ball
    # Of a product's exponent, the sum of the factors' is off by one at most.
    e_t, phi2_t, psi_t = _phi(x_t, frexp(delta)[1] + frexp(1 - f)[1] - 1, bits)
    _, phi2_f, psi_f = _phi(x_f, frexp(delta)[1] + frexp(f)[1] - 1, bits)
    with flint.ctx.workprec(bits):
        phi1_t, phi1_f = phi2_t + psi_t, phi2_f + psi_f
        a2 = t * t * phi2_t
        a1 = t * t * psi_t + t * f_ball * (e_t + phi1_t) * phi1_f + f_ball * f_ball * phi2_f
        a0 = e_t * f_ball * f_ball * psi_f
        return _BallDevice((-ball).exp(), (a0, a1, a2))


def _phi(x: flint.arb, exponent: int, bits: int) -> tuple[flint.arb, flint.arb, flint.arb]:
    """c, phi2 and psi of x >= 2^(exponent - 1), or of 0, with as many bits more as the quotients cancel."""
    import flint

    if x == 0:
        return flint.arb(1), flint.arb(0.5), flint.arb(0.5)
    with flint.ctx.workprec(bits + 16 + max(0, -2 * exponent)):
        c = (-x).exp()
        phi1 = -(-x).expm1() / x
        return c, (1 - phi1) / x, (phi1 - c) / x


class _Sparse(NamedTuple):
    """A polynomial with a gap of zeros in the middle, which a long delay leaves and the recursion keeps."""

    degree: int
    low: list[Any]  # lowest power first
    high: list[Any]  # highest power first

    def dense(self) -> list[Any]:
        """All coefficients, lowest power first; what overlaps is added."""
        p = [*self.low, *[0] * (self.degree + 1 - len(self.low))]
        for index, value in enumerate(self.high):
            p[self.degree - index] += value
        return p


def _coefficients(alpha: Any, beta: Any, plant: _BallDevice, whole: int) -> _Sparse:
    """P, for balls as well as for rational numbers."""
    c, n = plant
    s = alpha + beta
    wall = [-n[0] * beta, *(left * s - right * beta for left, right in pairwise(n)), n[-1] * s]
    return _Sparse(whole + len(n) + 1, wall, [1 + 0 * c, -(1 + c), c])


def _edge_coefficients(beta: Any, plant: _BallDevice, whole: int) -> _Sparse:
    """``P/(z - 1)`` at alpha = 0."""
    c, n = plant
    return _Sparse(whole + len(n), [a * beta for a in n], [1 + 0 * c, -c])


def _sparse_schur_cohn(p: _Sparse) -> bool | None:
    """`schur_cohn` at a cost proportional to the degree."""
    degree, low, high = p
    while degree > len(low) + len(high):
        within = _last_within_lead(low[0], high[0])
        if not within:
            return within
        k = low[0] / high[0]
        low, high = _less(low[1:], k, high[1:]), _less(high, k, low)
        degree -= 1
    return schur_cohn(_Sparse(degree, low, high).dense())


def schur_cohn(p: list[Any]) -> bool | None:
    """Whether all zeros lie inside the unit circle, lowest power first; None if the balls do not tell."""
    while len(p) > 1:
        within = _last_within_lead(p[0], p[-1])
        if not within:
            return within
        p = _less(p[1:], p[0] / p[-1], p[-2::-1])
    return True


def _last_within_lead(last: Any, lead: Any) -> bool | None:
    """Whether ``|last| < |lead|``. Where it fails the zeros' product, hence one of them, is above one."""
    margin = abs(lead) - abs(last)
    if margin > 0:
        return True
    return False if margin < 0 else None


def _less(x: list[Any], k: Any, y: list[Any]) -> list[Any]:
    """``x - k y``, the shorter one continued by zeros."""
    both = [left - k * right for left, right in zip(x, y, strict=False)]
    return both + x[len(y) :] + [-k * right for right in y[len(x) :]]


def _decide_rational(alpha: float, beta: float, d: float, max_bits: int) -> Verdict:
    """Decide a point with delta = 0 that no precision decides: a pole of it may be exactly on the circle."""
    import flint

    undecided = Verdict(False, Status.UNDECIDED, max_bits)
    exact = flint.fmpq_poly(_rational_coefficients(alpha, beta, d))
    paired = exact.gcd(flint.fmpq_poly(exact.coeffs()[::-1]))
    if paired.degree() == 0:
        return undecided
    rest = (exact / paired).numer()
    bits = max_bits
    with flint.ctx.workprec(bits):
        inside = schur_cohn([flint.arb(value) for value in rest.coeffs()])
        if inside is None:
            # The recursion also stops where the zeros' product is one; none of them is on the circle.
            found: Any = rest.complex_roots()
            sizes = [abs(zero) for zero, _multiplicity in found]
            inside = False if any(size > 1 for size in sizes) else all(size < 1 for size in sizes) or None
        if inside is False:
            return Verdict(False, Status.OK, bits)
        roots: Any = paired.numer().complex_roots()
        zeros = [zero for zero, _multiplicity in roots]
        if any(abs(zero) > 1 for zero in zeros):
            return Verdict(False, Status.OK, bits)
        # 1/conj(z) is a zero too; where its ball meets no other zero's, it is z itself: z is on the circle.
        alone = all(
            sum((1 / flint.acb(zero.real, -zero.imag)).overlaps(other) for other in zeros) == 1 for zero in zeros
        )
        return Verdict(False, Status.ON_BOUNDARY, bits) if inside and alone else undecided


def _rational_coefficients(alpha: float, beta: float, d: float) -> list:
    """P at delta = 0, where phi1 = 1 and phi2 = psi = 1/2, as rational numbers."""
    import flint

    def exact(value: float) -> flint.fmpq:
        return flint.fmpq(*value.as_integer_ratio())

    f = exact(d - int(d))
    t, half = 1 - f, flint.fmpq(1, 2)
    n = (half, half) if f == 0 else (f * f * half, (t * t + 4 * t * f + f * f) * half, t * t * half)
    plant = _BallDevice(flint.fmpq(1), n)
    if alpha == 0:
        return _edge_coefficients(exact(beta), plant, int(d)).dense()
    return _coefficients(exact(alpha), exact(beta), plant, int(d)).dense()


def decide_all(columns: list[np.ndarray], max_bits: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`decide` point by point: stable, status, bits."""
    count = columns[0].size
    stable, status, bits = np.zeros(count, bool), np.zeros(count, np.int32), np.zeros(count, np.int32)
    alpha, beta, delta, d = (column.tolist() for column in columns)
    for index in range(count):
        verdict = decide(alpha[index], beta[index], delta[index], d[index], max_bits)
        stable[index], status[index], bits[index] = verdict
    return stable, status, bits
