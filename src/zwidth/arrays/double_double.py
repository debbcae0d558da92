"""Numbers as unevaluated sums of two float64: some 31 digits, in NumPy.

The sum and the product of two float64 are exact as such pairs (Knuth; Dekker and Veltkamp); the operations on pairs
lose a few units of 2^-104. A complex number is a pair of them. Magnitudes must stay below 1e300.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.words.types import Array

_SPLIT = 134217729.0  # 2^27 + 1


class Double(NamedTuple):
    """high + low, with low below half of a unit in the last place of high."""

    high: Array
    low: Array

    def plus(self, other: Double) -> Double:
        """The sum."""
        high, low = two_sum(self.high, other.high)
        more, rest = two_sum(self.low, other.low)
        high, low = _normal(high, low + more)
        return _normal(high, low + rest)

    def minus(self, other: Double) -> Double:
        """The difference."""
        return self.plus(Double(-other.high, -other.low))

    def times(self, other: Double) -> Double:
        """The product."""
        high, low = two_product(self.high, other.high)
        return _normal(high, low + (self.high * other.low + self.low * other.high))

    def scaled(self, power: Array) -> Double:
        """Times a power of two."""
        return Double(self.high * power, self.low * power)

    def over(self, other: Double) -> Double:
        """The quotient."""
        first = self.high / other.high
        rest = self.minus(other.times(single(first)))
        second = rest.high / other.high
        rest = rest.minus(other.times(single(second)))
        return _normal(*_normal(first, second)).plus(single(rest.high / other.high))


def select(which: Array, new: Double, old: Double) -> Double:
    """One pair or the other, place by place."""
    return Double(np.where(which, new.high, old.high), np.where(which, new.low, old.low))


def single(value: Array) -> Double:
    """A float64 as a pair."""
    return Double(value, 0.0 * value)


def two_sum(a: Array, b: Array) -> Double:
    """``a + b``, exactly."""
    high = a + b
    part = high - a
    return Double(high, (a - (high - part)) + (b - part))


def two_product(a: Array, b: Array) -> Double:
    """``a b``, exactly."""
    high = a * b
    ah, bh = _SPLIT * a, _SPLIT * b
    ah, bh = ah - (ah - a), bh - (bh - b)
    al, bl = a - ah, b - bh
    return Double(high, ((ah * bh - high) + ah * bl + al * bh) + al * bl)


def _normal(high: Array, low: Array) -> Double:
    total = high + low
    return Double(total, low - (total - high))


class Complex(NamedTuple):
    """A complex number of two pairs."""

    re: Double
    im: Double

    def plus(self, other: Complex) -> Complex:
        """The sum."""
        return Complex(self.re.plus(other.re), self.im.plus(other.im))

    def shifted(self, by: Double) -> Complex:
        """Plus a real number."""
        return Complex(self.re.plus(by), self.im)

    def stretched(self, by: Double) -> Complex:
        """Times a real number."""
        return Complex(self.re.times(by), self.im.times(by))

    def times(self, other: Complex) -> Complex:
        """The product."""
        return Complex(
            self.re.times(other.re).minus(self.im.times(other.im)),
            self.re.times(other.im).plus(self.im.times(other.re)),
        )

    def grown(self, exponent: Array) -> Complex:
        """``((1 + x)^k - 1)/x`` for whole k >= 0, without cancellation, by repeated squaring."""
        left = np.asarray(exponent).astype(np.int64)
        one, two = (single(value + 0.0 * self.re.high) for value in (1.0, 2.0))
        result = Complex(single(0.0 * self.re.high), single(0.0 * self.re.high))
        for bit in reversed(range(int(np.max(left, initial=0)).bit_length())):
            result = result.times(result.times(self).shifted(two))
            more = result.plus(result.times(self)).shifted(one)
            odd = (left >> bit) & 1 == 1
            result = Complex(*(select(odd, new, old) for new, old in zip(more, result, strict=True)))
        return result

    @property
    def rounded(self) -> Array:
        """The nearest complex128."""
        return self.re.high + 1j * self.im.high


class PhiPair(NamedTuple):
    """1 - e^-x, phi1 and phi2 of one argument."""

    em: Double
    phi1: Double
    phi2: Double


_TERMS = 14
# The series is used up to this; beyond, both halve and double.
_SMALL = 2.0**-6


def phi_pair(x: Double) -> PhiPair:
    """As `numerics.phi` at x >= 0: Taylor's series at x/2^k, then doubled k times without cancellation."""
    halvings = np.ceil(np.log2(np.maximum(x.high, _SMALL) / _SMALL))
    y = x.scaled(0.5**halvings)
    one = single(1.0 + 0.0 * y.high)
    # phi2(y) = sum (-y)^k/(k + 2)!, phi1 = 1 - y phi2, em = y phi1
    total = one
    for k in range(_TERMS, 0, -1):
        total = one.minus(y.times(total).over(single(k + 2.0 + 0.0 * y.high)))
    phi2 = total.scaled(0.5)
    phi1 = one.minus(y.times(phi2))
    em = y.times(phi1)
    two = one.scaled(2.0)
    for done in range(int(np.max(halvings, initial=0.0))):
        rest = two.minus(em)
        doubled = em.times(rest), phi1.times(rest).scaled(0.5), phi1.times(phi1).plus(phi2.scaled(2.0)).scaled(0.25)
        left = done < halvings
        em, phi1, phi2 = (select(left, *pair) for pair in zip(doubled, (em, phi1, phi2), strict=True))
    return PhiPair(em, phi1, phi2)
