"""Independent formulas in mpmath with at least 60 digits, as references for the library's float64 results.

Each follows the printed definitions of the model (quotients, powers, sums), not the rearranged forms of the
library. Where a printed formula has cancellation, more digits are used instead.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from mpmath import mp, mpc, mpf

DIGITS = 60
WIDE = 1400  # digits that resolve the square of the smallest float64 (647 zeros) next to 1


def digits_for(delta: float) -> int:
    """Return the decimal digits necessary with the cancellation of order delta^2 in the printed formulas."""
    if delta == 0:
        return DIGITS
    return DIGITS + max(0, math.ceil(-4 * math.log10(delta)))


class Phi(NamedTuple):
    """c, phi1, phi2, psi of one argument, as printed."""

    c: mpf
    phi1: mpf
    phi2: mpf
    psi: mpf


def phi(x) -> Phi:
    """Return the printed quotients, or their limits at 0. Requires the working precision of `digits_for`."""
    x = mpf(x)
    if x == 0:
        return Phi(mpf(1), mpf(1), mpf(1) / 2, mpf(1) / 2)
    c = mp.exp(-x)
    phi1 = (1 - c) / x
    phi2 = (1 - phi1) / x
    return Phi(c, phi1, phi2, phi1 - phi2)


def numerator(delta, fraction) -> tuple[mpf, mpf, mpf]:
    """Return z n0(z) + n1(z) of the zero-order-hold plant, highest power first, from the exact discretization."""
    delta, f = mpf(delta), mpf(fraction)
    full, late, early = phi(delta), phi(delta * (1 - f)), phi(delta * f)
    t = 1 - f
    g0x, g0v = t**2 * late.phi2, t * late.phi1
    g1x = f**2 * early.phi2 + t * late.phi1 * f * early.phi1
    g1v = mp.exp(-delta * t) * f * early.phi1
    c, phi1 = full.c, full.phi1
    return g0x, (phi1 * g0v - c * g0x) + g1x, phi1 * g1v - c * g1x


def polynomial(alpha, beta, delta, d) -> list[mpf]:
    """Return P with an exact delay, highest power first: degree 3 + d at integer d, otherwise 4 + n."""
    alpha, beta, delta, d = mpf(alpha), mpf(beta), mpf(delta), mpf(d)
    n = int(mp.floor(d).real)
    f = d - n
    c = phi(delta).c
    g = list(numerator(delta, f))
    wall = [alpha + beta, -beta]
    product = [mpf(0)] * 4
    for i, left in enumerate(g):
        for j, right in enumerate(wall):
            product[i + j] += left * right
    total = [mpf(1), -(1 + c), c] + [mpf(0)] * (n + 2)
    for k in range(4):
        total[len(total) - 4 + k] += product[k]
    return total if f else total[:-1]


def paper_polynomial(alpha, beta, delta, d: int) -> list[mpf]:
    """Return eq. (17) as printed, for integer d and delta > 0: degree 3 + d, not monic."""
    alpha, beta, delta = mpf(alpha), mpf(beta), mpf(delta)
    c = mp.exp(-delta)
    total = [-(delta**2), delta**2 * (1 + c), -(delta**2) * c] + [mpf(0)] * (d + 1)
    total[-3] += (1 - c - delta) * (alpha + beta)
    total[-2] += (c * delta - 1 + c) * alpha + ((1 + c) * delta - 2 * (1 - c)) * beta
    total[-1] += (1 - c - c * delta) * beta
    return total


def paper_polynomial_si(mass, damping, period, stiffness, virtual_damping, d: int) -> list[mpf]:
    """Return eq. (11) as printed, for integer d and b > 0."""
    m, b, T, K, B = (mpf(value) for value in (mass, damping, period, stiffness, virtual_damping))
    c = mp.exp(-T * b / m)
    lead = -T * b**2
    total = [lead, -lead * (1 + c), lead * c] + [mpf(0)] * (d + 1)
    total[-3] += (m * (1 - c) - T * b) * (K * T + B)
    total[-2] += (T * b * c - m * (1 - c)) * K * T + (T * b + T * b * c - 2 * m * (1 - c)) * B
    total[-1] += (-T * b * c + m * (1 - c)) * B
    return total


def boundary(omega, delta, d, delay: str = "held") -> tuple[mpf, mpf]:
    """Return (alpha, beta) from the 2x2 system Re P = Im P = 0 at z = e^(j omega), 0 < omega < pi."""
    omega, delta, d = mpf(omega), mpf(delta), mpf(d)
    z = mp.expj(omega)
    c = mp.exp(-delta)
    if delay == "held":
        n = mp.floor(d)
        a2, a1, a0 = numerator(delta, d - n)
        # Use z^-(1+n) P: a power of z does not change the zeros, and makes d = 500 as fast as d = 0.
        gain = ((a2 * z + a1) * z + a0) / z ** (2 + n)
    else:
        values = phi(delta)
        gain = (values.phi2 * z + values.psi) * mp.expj(-omega * (1 + d))
    free = (z - 1) * (z - c)
    by_alpha, by_beta = gain * z, gain * (z - 1)
    determinant = by_alpha.real * by_beta.imag - by_alpha.imag * by_beta.real
    alpha = (-free.real * by_beta.imag + free.imag * by_beta.real) / determinant
    beta = (-by_alpha.real * free.imag + by_alpha.imag * free.real) / determinant
    return alpha, beta


def complex_number(real: Any, imag: Any = 0) -> mpc:
    """Return a complex number; type checkers infer integer parts from mpmath's own class."""
    return mpc(real, imag)


def evaluate(coefficients, z) -> mpc:
    """Evaluate a polynomial by Horner's rule, highest power first."""
    total = mpc(0)
    for coefficient in coefficients:
        total = total * z + coefficient
    return total


def roots(coefficients) -> list[mpc]:
    """Return all roots of a polynomial with simple roots: NumPy's roots refined by Newton's method."""
    degree = len(coefficients) - 1
    derivative = [(degree - k) * coefficient for k, coefficient in enumerate(coefficients[:-1])]
    refined: list[Any] = [
        mpc(root) for root in np.roots(np.array([float(coefficient) for coefficient in coefficients]))
    ]
    for _ in range(8):
        refined = [root - evaluate(coefficients, root) / evaluate(derivative, root) for root in refined]
    distances = [abs(a - b) for k, a in enumerate(refined) for b in refined[:k]]
    assert min(distances) > mpf(10) ** -20, "two starting points met at one root"
    return refined


def exact_radius(alpha, beta, delta, d) -> mpf:
    """Return the modulus of the dominant pole, if all poles are simple."""
    with mp.workdps(max(mp.dps, digits_for(delta))):
        return max(abs(root) for root in roots(polynomial(alpha, beta, delta, d)))


def relative_error(got, exact, floor: float = 0) -> float:
    """Return |got - exact| divided by |exact|, or by ``floor`` if larger."""
    scale = max(abs(exact), mpf(floor))
    difference = abs(mpf(float(got)) - exact)
    return float(difference / scale) if scale else float(difference)


def worst(got, exact, floor: float = 0) -> float:
    """Return the largest `relative_error` of two sequences."""
    return max(relative_error(g, e, floor) for g, e in zip(np.ravel(got), exact, strict=True))
