"""P and its derivatives at one point, the steps of Halley's method, and how far a pole is at most.

P = z^p A + D with p = 1 + n, A = (z - 1)(z - c) and D = (a2 z + h)(s z - beta); for delays that are not whole periods
both take one factor more, z and z + q. On ``z = e^(re + j im)`` everything is formed from z - 1, so that poles next to
1 keep their digits, and the larger of z^p and 1 is divided out, so that nothing grows with n. As a function of log z
P is nearly an exponential, on which Halley's method converges from far away, and with the third power of the error.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.polynomials import square
from zwidth.loops.rigid.circle import Loop
from zwidth.words.types import Array
from zwidth.words.xp import COSINE, SINE, epsilon, horner, namespace, store_once

# Rounding errors of P in units of the sum of its parts' moduli: of its factors, and of the angle p im.
_ROUNDING = 16.0
# The longest step, over the distance between the poles of a long delay: longer ones lead to other poles.
_LONGEST = 1.0


class Pair:
    """A complex number by its parts, as compiled loops want it."""

    __slots__ = ("imag", "real")

    def __init__(self, real: Array, imag: Array) -> None:
        self.real, self.imag = real, imag

    def __add__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            return Pair(self.real + other.real, self.imag + other.imag)
        return Pair(self.real + other, self.imag)

    def __mul__(self, other: Any) -> Pair:
        if isinstance(other, Pair):
            real = self.real * other.real - self.imag * other.imag
            return Pair(real, self.real * other.imag + self.imag * other.real)
        return Pair(self.real * other, self.imag * other)

    def over(self, other: Pair) -> Pair:
        """The quotient."""
        size = square(other)
        real = (self.real * other.real + self.imag * other.imag) / size
        return Pair(real, (self.imag * other.real - self.real * other.imag) / size)

    def conjugate(self) -> Pair:
        """The same above the real axis as below."""
        return Pair(self.real, -self.imag)


def join(re: Array, im: Array) -> Array:
    """A complex array. As one array it is computed by one loop, as two by two loops that repeat what they share."""
    if namespace(re) is not np:
        from jax.lax import complex as join

        return join(re, im)
    value = np.empty(np.broadcast_shapes(re.shape, im.shape), complex)
    value.real, value.imag = re, im
    return value


class Value(NamedTuple):
    """P without the larger of z^p and 1, its derivatives by log z, and what rounding errors may add up to in P."""

    p: Any
    first: Any
    second: Any
    rounding: Array


def _half_turn(x: Array, xp: Any) -> tuple[Array, Array]:
    """Sine and cosine for |x| <= pi/2."""
    if xp is np:
        # Python's numbers stay Python's.
        return (float(np.sin(x)), float(np.cos(x))) if type(x) is float else (np.sin(x), np.cos(x))
    square = x * x
    return x * horner(square, SINE), horner(square, COSINE)


def _store(value: Any, witness: Array) -> Any:
    """A pair that five loops use, each of which would repeat its series: a step takes 0.7 of the time."""
    return Pair(*store_once((value.real, value.imag), witness))


def value_at(re: Array, im: Array, loop: Loop, fractional: bool) -> Value:
    """Evaluate at ``e^(re + j im)``, |im| <= pi."""
    xp = namespace(re, loop.alpha)
    number: Any = join if xp is np else Pair
    if xp is np and not np.ndim(re):
        # Python's own are several times faster for single numbers.
        number, re, im, loop = complex, float(re), float(im), Loop(*map(float, loop))
    power = loop.turns + 1.0 if fractional else loop.turns
    size = float(np.expm1(re)) if number is complex else xp.expm1(re)
    r = 1.0 + size
    sine, cosine = _half_turn(0.5 * im, xp)
    gap = number(size - 2.0 * r * sine * sine, 2.0 * r * sine * cosine)
    growth = power * re
    # Not by the modulus: its derivative at 0 would be lost.
    less = xp.exp(xp.where(growth < 0, growth, -growth))
    up, down = xp.where(growth < 0, less, 1.0), xp.where(growth < 0, 1.0, less)
    phase = power * im
    whole = xp.round(phase / (2.0 * np.pi))
    if number is complex:
        up, down, whole = float(up), float(down), float(whole)
    phase = phase - 2.0 * np.pi * whole
    turned, level = _half_turn(0.5 * phase, xp)
    lag = number(up * (1.0 - 2.0 * turned * turned), 2.0 * up * turned * level)
    if number is Pair:
        gap, lag = _store(gap, re), _store(lag, re)
    z = gap + 1.0
    a, slope = gap * (gap + loop.em), z * (gap * 2.0 + loop.em)
    lead = (z * loop.a2 + loop.h) * down
    bend, wall, lean = z * (loop.a2 * down), gap * loop.s + loop.alpha, z * loop.s
    d = lead * wall
    d1 = bend * wall + lead * lean
    d2 = d1 + bend * lean * 2.0
    width = xp.abs(gap.real) + xp.abs(gap.imag)
    sizes = down * (loop.h + loop.a2 * r) * (xp.abs(loop.alpha) + xp.abs(loop.s) * width)
    if fractional:
        late = z + loop.q
        d, d1, d2 = d * late, d1 * late + d * z, d2 * late + (d1 * 2.0 + d) * z
        sizes = sizes * (r + loop.q)
    t1 = lag * (a * power + slope)
    t2 = lag * ((a * power + slope * 2.0) * power + slope + z * z * 2.0)
    turning = power * (xp.abs(re) + xp.abs(im))
    rounding = up * width * (width + loop.em) * (_ROUNDING + turning) + _ROUNDING * sizes
    found = lag * a + d, t1 + d1, t2 + d2
    # Unlike Python's numbers, NumPy's may be divided by zero.
    return Value(*(map(np.complex128, found) if number is complex else found), rounding=epsilon(re) * rounding)


class Step(NamedTuple):
    """Newton's step for log z, how far from here a pole is at most, and how far from the step's end it may be."""

    re: Array
    im: Array
    within: Array
    doubt: Array


def newton_step(re: Array, im: Array, loop: Loop, fractional: bool) -> Step:
    """One step from ``e^(re + j im)``, |im| <= pi."""
    xp = namespace(re, loop.alpha)
    at = value_at(re, im, loop, fractional)
    norm = square(at.first)
    by = at.p * at.first.conjugate() * (-1.0 / norm)
    # A polynomial of degree N has a zero within N |P/P'| of any point.
    poles, slope = loop.turns + (3.0 if fractional else 2.0), xp.sqrt(norm)
    doubt = at.rounding / slope
    # Of the step itself what the bend leaves: next to a double pole half of it.
    bent = square(by) * xp.sqrt(square(at.second)) / slope
    return Step(by.real, by.imag, poles * (xp.sqrt(square(at.p)) / slope + doubt), doubt + bent)


def halley_step(re: Array, im: Array, loop: Loop, fractional: bool) -> tuple[Array, Array]:
    """The place in the upper half plane to which a step leads, not longer than about the distance between poles."""
    xp = namespace(re, loop.alpha)
    at = value_at(re, im, loop, fractional)
    back = at.first.conjugate() * (1.0 / square(at.first))
    by = at.p * back
    bent = by * (at.second * back) * -0.5 + 1.0
    by = by * bent.conjugate() * (-1.0 / square(bent))
    size = xp.sqrt(square(by)) * (loop.turns + 1.0)
    shorter = _LONGEST / xp.maximum(size, _LONGEST)
    return move_pole(re, im, by.real * shorter, by.imag * shorter)


def move_pole(re: Array, im: Array, by_re: Array, by_im: Array) -> tuple[Array, Array]:
    """The next place in the upper half plane: past the real axis the conjugate is meant."""
    xp = namespace(re)
    im = xp.abs(im + by_im)
    return re + by_re, xp.where(im > np.pi, 2.0 * np.pi - im, im)
