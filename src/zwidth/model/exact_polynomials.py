"""Polynomials with exact rational coefficients, and their roots to full float64 accuracy.

Every float is an integer times a power of 2, and therefore an exact fraction. Products, greatest common divisors and
characteristic polynomials are exact. Roots are computed by Aberth's iteration in decimal arithmetic, whose precision is
doubled until the error bounds of all roots are small enough.

References:
    Aberth 1973, Math. Comp. 27, 339-344 (simultaneous iteration for all roots). Yun 1976, SYMSAC, 26-35 (square-free
    factorization).
"""

from __future__ import annotations

from decimal import Context, Decimal, getcontext, localcontext
from fractions import Fraction
from math import gcd, lcm
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.core.errors import InputError

Polynomial: TypeAlias = tuple[Fraction, ...]
"""Exact coefficients, highest power first, without leading zeros; empty for the zero polynomial."""

# NumPy's polynomial functions are exact for fractions, which its type annotations exclude.
numpy: Any = np

# Working precisions in decimal digits, tried in this order: 50, 100, .., 1600.
DIGITS = tuple(50 << k for k in range(6))
STEPS = 400  # largest number of Aberth steps; about 10 suffice, starting from the eigenvalues of the companion matrix
ACCURATE = Decimal("1e-22")  # required relative error bound of a root, well below the float64 resolution of 1e-16
EXPONENT = 10**9  # largest magnitude of decimal exponents, so large that no intermediate result overflows


class Complex(NamedTuple):
    """A complex number in decimal arithmetic."""

    real: Decimal
    imag: Decimal


def trim(coefficients: Any) -> Polynomial:
    """Convert coefficients to exact fractions and remove leading zeros."""
    exact = [Fraction(value) if isinstance(value, Fraction | int) else Fraction(float(value)) for value in coefficients]
    first = next((k for k, value in enumerate(exact) if value), len(exact))
    return tuple(exact[first:])


def multiply(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the product of two polynomials."""
    return trim(numpy.polymul(one, other))


def subtract(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the difference of two polynomials."""
    return trim(numpy.polysub(one, other))


def differentiate(polynomial: Polynomial) -> Polynomial:
    """Return the derivative of a polynomial."""
    return trim(numpy.polyder(polynomial))


def shift(polynomial: Polynomial) -> Polynomial:
    """Return the coefficients of the polynomial p(1 - x), given those of p(x)."""
    return trim(numpy.polyval(polynomial, np.poly1d([-1, 1])).coeffs)


def divide(top: Polynomial, bottom: Polynomial) -> tuple[Polynomial, Polynomial]:
    """Return the quotient and the remainder of the division of two polynomials."""
    rest, quotient = list(top), []
    while len(rest) >= len(bottom):
        factor = rest[0] / bottom[0]
        quotient.append(factor)
        rest = [a - factor * b for a, b in zip(rest, (*bottom, *[Fraction(0)] * len(rest)), strict=False)][1:]
    return tuple(quotient), trim(rest)


def find_common_factor(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the monic greatest common divisor of two polynomials, by Euclid's algorithm."""
    a, b = _to_integers(one), _to_integers(other)
    while b:
        # Compute pseudo-remainders, because they need only integers. Divide each by the greatest common divisor of its
        # coefficients, because the integers would otherwise grow fast.
        while len(a) >= len(b):
            a = [x * b[0] - a[0] * y for x, y in zip(a, b + [0] * (len(a) - len(b)), strict=True)][1:]
        first = next((k for k, value in enumerate(a) if value), len(a))
        a, b = b, _without_content(a[first:])
    return tuple(Fraction(value, a[0]) for value in a)


def _to_integers(polynomial: Polynomial) -> list[int]:
    """Scale the coefficients of a polynomial to integers without a common divisor."""
    scale = lcm(*(value.denominator for value in polynomial))
    return _without_content([int(value * scale) for value in polynomial])


def _without_content(values: list[int]) -> list[int]:
    """Return integers divided by their greatest common divisor."""
    common = gcd(*values)
    return [value // common for value in values] if common > 1 else values


def characteristic_polynomial(matrix: np.ndarray) -> Polynomial:
    """Return det(s I - A) for a square matrix A of fractions, by the Faddeev-LeVerrier algorithm in integers."""
    size = len(matrix)
    scale = lcm(1, *(value.denominator for value in matrix.ravel()))
    exact = np.array([[int(value * scale) for value in row] for row in matrix], object)
    one = np.array([[int(i == j) for j in range(size)] for i in range(size)], object)
    coefficients, power = [1], one
    for k in range(1, size + 1):
        product = exact @ power
        coefficients.append(-int(np.trace(product)) // k)
        power = product + coefficients[-1] * one
    return tuple(Fraction(value, scale**k) for k, value in enumerate(coefficients))


def find_roots(polynomial: Polynomial, offsets: bool = False) -> np.ndarray:
    """Return all roots of a polynomial (or their ``offsets`` from 1) to full float64 accuracy, with multiplicity.

    Args:
        polynomial: the polynomial.
        offsets: return 1 - root in place of each root, because a caller could not compute this difference accurately
            from a root near 1 in float64.
    """
    rest = shift(polynomial) if offsets else polynomial
    roots: list[complex] = []
    for times, factor in enumerate(_split_by_multiplicity(rest), start=1):
        while len(factor) > 1 and factor[-1] == 0:
            factor, roots = factor[:-1], [*roots, *[0j] * times]
        roots += [root for root in find_simple_roots(factor) for _ in range(times)]
    return np.array(roots, complex)


def _split_by_multiplicity(polynomial: Polynomial) -> list[Polynomial]:
    """Return the list of the square-free factors of a polynomial, by Yun's algorithm (1976).

    The simple roots of the k-th factor, counted from 1, are the roots of the polynomial with multiplicity k.
    """
    factors = []
    derivative = differentiate(polynomial)
    common = find_common_factor(polynomial, derivative) if derivative else polynomial
    # The names b and d are those of Yun's algorithm.
    b, d = divide(polynomial, common)[0], divide(derivative, common)[0]
    while len(b) > 1:
        d = subtract(d, differentiate(b))
        factor = find_common_factor(b, d) if d else b
        factors.append(factor)
        b, d = divide(b, factor)[0], divide(d, factor)[0] if d else d
    return factors


def find_simple_roots(polynomial: Polynomial) -> list[complex]:
    """Return the roots of a square-free polynomial that has no root at 0."""
    if len(polynomial) < 2:
        return []
    for digits in DIGITS:
        with localcontext(Context(prec=digits, Emax=EXPONENT, Emin=-EXPONENT)):
            exact = [Decimal(value.numerator) / Decimal(value.denominator) for value in polynomial]
            roots, errors = iterate_roots(exact)
            # Require small errors, because larger ones leave open whether two close roots are real or complex.
            if all(error <= ACCURATE * magnitude(root) for root, error in zip(roots, errors, strict=True)):
                return _pair_up(roots, errors)
    raise InputError("device: some poles or zeros are too close together; remove modes that hardly affect the output")


def _pair_up(roots: list[Complex], errors: list[Decimal]) -> list[complex]:
    """Convert the roots of a real polynomial to floats that are exactly real or in exact conjugate pairs.

    Args:
        roots: approximate roots.
        errors: bounds on the errors of the roots. A real or imaginary part within its bound becomes exactly 0.
    """
    pairs = []
    for root, error in zip(roots, errors, strict=True):
        real, imag = (0.0 if abs(part) <= error else float(part) for part in root)
        if imag >= 0:
            pairs += [complex(real, imag), complex(real, -imag)] if imag else [complex(real, 0.0)]
    return pairs


def magnitude(value: Complex) -> Decimal:
    """Return the magnitude of a complex number."""
    return (value.real * value.real + value.imag * value.imag).sqrt()


def _times(a: Complex, b: Complex) -> Complex:
    """Return the product of two complex numbers."""
    return Complex(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


def _inverse(a: Complex) -> Complex:
    """Return the reciprocal of a complex number."""
    square = a.real * a.real + a.imag * a.imag
    return Complex(a.real / square, -a.imag / square)


def iterate_roots(coefficients: list[Decimal]) -> tuple[list[Complex], list[Decimal]]:
    """Return the roots of a real polynomial in the precision of the decimal context, and bounds on their errors.

    For a polynomial p of degree n, the disk of radius ``n |p(x)/p'(x)|`` around any x contains a root. The error bound
    of an approximate root x is this radius, including the rounding error of p(x).
    """
    order = len(coefficients) - 1
    # Start from the eigenvalues of the companion matrix in float64. Divide the roots by their geometric mean first, so
    # that the coefficients do not overflow.
    unit = ((abs(coefficients[-1] / coefficients[0])).ln() / order).exp() if coefficients[-1] else Decimal(1)
    scaled = [value / coefficients[0] / unit**k for k, value in enumerate(coefficients)]
    with np.errstate(all="ignore"):
        start = np.roots([float(value) for value in scaled]).astype(complex)
    if start.size != order or not np.isfinite(start).all():
        start = np.exp(1j * (0.7 + 2.0 * np.pi * np.arange(order) / order))
    # Perturb the starting values, because real values can only converge to real roots, and equal values would cause a
    # division by 0.
    start = start * (1.0 + 1e-9 * np.exp(2.4j * np.arange(order)))
    roots = [Complex(Decimal(value.real), Decimal(value.imag)) for value in start.tolist()]
    tolerance = Decimal(10) ** (6 - getcontext().prec)
    moving = [True] * order
    for _ in range(STEPS):
        for k in range(order):
            if not moving[k]:
                continue
            ratio, _ = _newton(scaled, roots[k])
            # Aberth's step is ratio/(1 - ratio sum_j 1/(x_k - x_j)), with the Newton step ratio = p/p'.
            total = Complex(Decimal(0), Decimal(0))
            for j in range(order):
                if j != k and roots[j] != roots[k]:
                    term = _inverse(Complex(roots[k].real - roots[j].real, roots[k].imag - roots[j].imag))
                    total = Complex(total.real + term.real, total.imag + term.imag)
            product = _times(ratio, total)
            step = _times(ratio, _inverse(Complex(1 - product.real, -product.imag)))
            roots[k] = Complex(roots[k].real - step.real, roots[k].imag - step.imag)
            moving[k] = magnitude(step) > tolerance * magnitude(roots[k])
        if not any(moving):
            break
    errors = [_newton(scaled, root)[1] * order * unit for root in roots]
    return [Complex(root.real * unit, root.imag * unit) for root in roots], errors


def _newton(coefficients: list[Decimal], x: Complex) -> tuple[Complex, Decimal]:
    """Return the Newton step p/p' of a polynomial at x, and an upper bound on |p/p'| despite rounding errors of p."""
    # Evaluate p and p' by Horner's scheme. ``total``, the sum of the magnitudes of all terms, bounds the rounding error
    # of p.
    value, derivative, total = Complex(Decimal(0), Decimal(0)), Complex(Decimal(0), Decimal(0)), Decimal(0)
    radius = magnitude(x)
    for coefficient in coefficients:
        derivative_x, value_x = _times(derivative, x), _times(value, x)
        derivative = Complex(derivative_x.real + value.real, derivative_x.imag + value.imag)
        value = Complex(value_x.real + coefficient, value_x.imag)
        total = total * radius + abs(coefficient)
    if not (derivative.real or derivative.imag):
        return Complex(Decimal(0), Decimal(0)), Decimal("Infinity")
    rounding_error = total * 4 * len(coefficients) * Decimal(10) ** (1 - getcontext().prec)
    return _times(value, _inverse(derivative)), (magnitude(value) + rounding_error) / magnitude(derivative)
