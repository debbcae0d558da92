"""Polynomials with exact rational coefficients, highest power first, and their roots to the last digit of float64.

Binary floats are exact integers over powers of 2. Products, greatest common divisors and characteristic polynomials are
computed with integers, roots by Aberth's iteration in decimal arithmetic whose precision doubles until it suffices.
"""

from __future__ import annotations

from decimal import Context, Decimal, getcontext, localcontext
from fractions import Fraction
from math import gcd, lcm
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.words.errors import InputError

Polynomial: TypeAlias = tuple[Fraction, ...]
"""Exact coefficients, highest power first; empty for 0."""

DIGITS = tuple(50 << k for k in range(6))  # precisions in decimal digits, tried in order
STEPS = 400  # Aberth steps; about 10 suffice from the eigenvalues of the companion matrix
ACCURATE = Decimal("1e-22")  # relative error bound of a root right to float64
EXPONENT = 10**9  # largest exponent of decimals


class Complex(NamedTuple):
    """A complex decimal."""

    real: Decimal
    imag: Decimal


def trim(coefficients: Any) -> Polynomial:
    """Return the polynomial of numbers without leading zeros."""
    exact = [Fraction(value) if isinstance(value, Fraction | int) else Fraction(float(value)) for value in coefficients]
    first = next((k for k, value in enumerate(exact) if value), len(exact))
    return tuple(exact[first:])


def multiply(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the product of two polynomials."""
    product = [Fraction(0)] * (len(one) + len(other) - 1)
    for i, a in enumerate(one):
        for j, b in enumerate(other):
            product[i + j] += a * b
    return trim(product)


def subtract(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the difference of two polynomials."""
    size = max(len(one), len(other))
    padded = ((Fraction(0),) * (size - len(part)) + part for part in (one, other))
    return trim([a - b for a, b in zip(*padded, strict=True)])


def differentiate(polynomial: Polynomial) -> Polynomial:
    """Return the derivative."""
    size = len(polynomial) - 1
    return trim([value * (size - k) for k, value in enumerate(polynomial[:-1])])


def shift(polynomial: Polynomial) -> Polynomial:
    """Return p(1 - x)."""
    values = list(polynomial)
    for k in range(1, len(values)):
        for j in range(1, len(values) - k + 1):
            values[j] += values[j - 1]
    size = len(values) - 1
    return trim([-value if (size - k) % 2 else value for k, value in enumerate(values)])


def divide(top: Polynomial, bottom: Polynomial) -> tuple[Polynomial, Polynomial]:
    """Return quotient and remainder."""
    rest, quotient = list(top), []
    while len(rest) >= len(bottom):
        factor = rest[0] / bottom[0]
        quotient.append(factor)
        rest = [a - factor * b for a, b in zip(rest, (*bottom, *[Fraction(0)] * len(rest)), strict=False)][1:]
    return tuple(quotient), trim(rest)


def find_common_factor(one: Polynomial, other: Polynomial) -> Polynomial:
    """Return the monic greatest common divisor."""
    a, b = _to_integers(one), _to_integers(other)
    while b:
        # Pseudo-remainders: integers without fractions, divided by their common factor.
        while len(a) >= len(b):
            a = [x * b[0] - a[0] * y for x, y in zip(a, b + [0] * (len(a) - len(b)), strict=True)][1:]
        first = next((k for k, value in enumerate(a) if value), len(a))
        a, b = b, _without_content(a[first:])
    return tuple(Fraction(value, a[0]) for value in a)


def _to_integers(polynomial: Polynomial) -> list[int]:
    """Return a multiple with integer coefficients."""
    scale = lcm(*(value.denominator for value in polynomial))
    return _without_content([int(value * scale) for value in polynomial])


def _without_content(values: list[int]) -> list[int]:
    common = gcd(*values)
    return [value // common for value in values] if common > 1 else values


def characteristic_polynomial(matrix: np.ndarray) -> Polynomial:
    """Return det(s - A) of a square matrix of fractions, by the method of Faddeev and LeVerrier."""
    size = len(matrix)
    scale = lcm(1, *(value.denominator for value in matrix.ravel()))
    exact = np.array([[int(value * scale) for value in row] for row in matrix], object)
    one = np.array([[int(i == j) for j in range(size)] for i in range(size)], object)
    found, power = [1], one
    for k in range(1, size + 1):
        product = exact @ power
        found.append(-int(np.trace(product)) // k)
        power = product + found[-1] * one
    return tuple(Fraction(value, scale**k) for k, value in enumerate(found))


def find_roots(polynomial: Polynomial, offsets: bool = False) -> np.ndarray:
    """Return all roots to the last digits, or 1 less each of them; equal ones as often as they occur."""
    rest = shift(polynomial) if offsets else polynomial
    found = []
    for times, factor in enumerate(_split_by_multiplicity(rest), start=1):
        while len(factor) > 1 and factor[-1] == 0:
            factor, found = factor[:-1], [*found, *[0j] * times]
        found += [root for root in _simple_roots(factor) for _ in range(times)]
    return np.array(found, complex)


def _split_by_multiplicity(polynomial: Polynomial) -> list[Polynomial]:
    """Return square-free polynomials of the roots that occur once, twice, and so on (Yun 1976)."""
    parts = []
    slope = differentiate(polynomial)
    common = find_common_factor(polynomial, slope) if slope else polynomial
    left, over = divide(polynomial, common)[0], divide(slope, common)[0]
    while len(left) > 1:
        over = subtract(over, differentiate(left))
        own = find_common_factor(left, over) if over else left
        parts.append(own)
        left, over = divide(left, own)[0], divide(over, own)[0] if over else over
    return parts


def _simple_roots(polynomial: Polynomial) -> list[complex]:
    """Return the roots of a square-free polynomial without root at 0."""
    if len(polynomial) < 2:
        return []
    for digits in DIGITS:
        with localcontext(Context(prec=digits, Emax=EXPONENT, Emin=-EXPONENT)):
            exact = [Decimal(value.numerator) / Decimal(value.denominator) for value in polynomial]
            roots, errors = iterate_roots(exact)
            # Two roots nearer than their errors may be a real pair or a complex one.
            if all(error <= ACCURATE * size(root) for root, error in zip(roots, errors, strict=True)):
                return _pair_up(roots, errors)
    raise InputError("device: its poles or zeros are too close to each other; leave out what hardly moves the position")


def _pair_up(roots: list[Complex], errors: list[Decimal]) -> list[complex]:
    """Return the roots of a real polynomial as floats, exactly real or in exact conjugate pairs."""
    found = []
    for root, error in zip(roots, errors, strict=True):
        real, imag = (0.0 if abs(part) <= error else float(part) for part in root)
        if imag >= 0:
            found += [complex(real, imag), complex(real, -imag)] if imag else [complex(real, 0.0)]
    return found


def size(value: Complex) -> Decimal:
    """Return the magnitude."""
    return (value.real * value.real + value.imag * value.imag).sqrt()


def _times(a: Complex, b: Complex) -> Complex:
    return Complex(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


def _inverse(a: Complex) -> Complex:
    square = a.real * a.real + a.imag * a.imag
    return Complex(a.real / square, -a.imag / square)


def iterate_roots(coefficients: list[Decimal]) -> tuple[list[Complex], list[Decimal]]:
    """Return the roots of a real polynomial in the precision of the context, and bounds of their errors.

    A disk of radius ``n |p/p'|`` around an approximation contains a root. Where rounding errors dominate p, the bound
    includes them.
    """
    order = len(coefficients) - 1
    # Starting values from the companion matrix, in units of the geometric mean of the roots.
    unit = ((abs(coefficients[-1] / coefficients[0])).ln() / order).exp() if coefficients[-1] else Decimal(1)
    scaled = [value / coefficients[0] / unit**k for k, value in enumerate(coefficients)]
    with np.errstate(all="ignore"):
        start = np.roots([float(value) for value in scaled]).astype(complex)
    if start.size != order or not np.isfinite(start).all():
        start = np.exp(1j * (0.7 + 2.0 * np.pi * np.arange(order) / order))
    # Off the real line: two real values may have to become a pair. Off each other: equal values would divide by 0.
    start = start * (1.0 + 1e-9 * np.exp(2.4j * np.arange(order)))
    roots = [Complex(Decimal(value.real), Decimal(value.imag)) for value in start.tolist()]
    unit_error = Decimal(10) ** (6 - getcontext().prec)
    moving = [True] * order
    for _ in range(STEPS):
        for k in range(order):
            if not moving[k]:
                continue
            ratio, _ = _newton(scaled, roots[k])
            apart = Complex(Decimal(0), Decimal(0))
            for j in range(order):
                if j != k and roots[j] != roots[k]:
                    one = _inverse(Complex(roots[k].real - roots[j].real, roots[k].imag - roots[j].imag))
                    apart = Complex(apart.real + one.real, apart.imag + one.imag)
            product = _times(ratio, apart)
            step = _times(ratio, _inverse(Complex(1 - product.real, -product.imag)))
            roots[k] = Complex(roots[k].real - step.real, roots[k].imag - step.imag)
            moving[k] = size(step) > unit_error * size(roots[k])
        if not any(moving):
            break
    errors = [_newton(scaled, root)[1] * order * unit for root in roots]
    return [Complex(root.real * unit, root.imag * unit) for root in roots], errors


def _newton(coefficients: list[Decimal], x: Complex) -> tuple[Complex, Decimal]:
    """Return p/p' at x, and a bound of its magnitude with the rounding error of p."""
    value, slope, largest = Complex(Decimal(0), Decimal(0)), Complex(Decimal(0), Decimal(0)), Decimal(0)
    far = size(x)
    for coefficient in coefficients:
        moved, turned = _times(slope, x), _times(value, x)
        slope = Complex(moved.real + value.real, moved.imag + value.imag)
        value = Complex(turned.real + coefficient, turned.imag)
        largest = largest * far + abs(coefficient)
    if not (slope.real or slope.imag):
        return Complex(Decimal(0), Decimal(0)), Decimal("Infinity")
    noise = largest * 4 * len(coefficients) * Decimal(10) ** (1 - getcontext().prec)
    return _times(value, _inverse(slope)), (size(value) + noise) / size(slope)
