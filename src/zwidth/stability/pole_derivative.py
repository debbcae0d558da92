"""How a pole moves with its loop: Newton steps on log(T/B) from a pole that is held fixed.

Each step doubles the order to which the derivatives are right: two make first and second ones exact. The powers of z
enter as multiples of its logarithm; everything else is a quotient that is 1 at the fixed pole.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from zwidth._types import Array
from zwidth.stability.circle import Loop
from zwidth.stability.log_step import near
from zwidth.xp import frozen, namespace


class Complex(NamedTuple):
    """A complex number by its parts: real arithmetic is faster, and float32 stays float32."""

    re: Array
    im: Array

    def times(self, other: Complex) -> Complex:
        """The product."""
        return Complex(self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re)

    def over(self, other: Complex) -> Complex:
        """The quotient."""
        size = other.re * other.re + other.im * other.im
        return Complex(
            (self.re * other.re + self.im * other.im) / size, (self.im * other.re - self.re * other.im) / size
        )


def _factors(z: Complex, past_one: Array, loop: Loop) -> list[Complex]:
    """z - 1, z - c, a2 z + h, s z - beta, 1 + q/z and z; z - 1 is given."""
    r2 = z.re * z.re + z.im * z.im
    return [
        Complex(past_one, z.im),
        Complex(past_one + loop.em, z.im),
        Complex(loop.a2 * z.re + loop.h, loop.a2 * z.im),
        Complex(loop.alpha * z.re + loop.beta * past_one, loop.s * z.im),
        Complex(1.0 + loop.q * z.re / r2, -loop.q * z.im / r2),
    ]


def _quotient(factors: list[Complex]) -> Complex:
    one, pole, body, wall, late = factors
    return one.times(pole).over(body.times(wall).times(late))


def followed(re: Array, im: Array, loop: Loop, still: Loop, fractional: bool) -> Array:
    """The change of log |z| of the pole ``e^(re + j im)`` of the loop ``still`` when that becomes ``loop``."""
    xp = namespace(loop.alpha, re)
    base = frozen(near(re, im, still, fractional), xp)
    moved = Complex(0.0 * re, 0.0 * re)
    first: Any = None
    for _ in range(2):
        size, growth = xp.exp(re + moved.re), xp.expm1(re + moved.re)
        cosine, sine = xp.cos(im + moved.im), xp.sin(im + moved.im)
        half = xp.sin(0.5 * (im + moved.im))
        z = Complex(size * cosine, size * sine)
        factors = _factors(z, growth - 2.0 * size * half * half, loop)
        quotient = _quotient(factors)
        if first is None:
            first = _quotient(_factors(*frozen((z, factors[0].re), xp), still))
        change = quotient.over(first)
        value = Complex(
            base.level + loop.turns * moved.re + 0.5 * xp.log(change.re * change.re + change.im * change.im),
            base.past + loop.turns * moved.im + xp.arctan2(change.im, change.re),
        )
        one, pole, body, wall, late = factors
        slope = Complex(loop.turns, 0.0 * re)
        shifted = late.times(z)
        for part, zero in ((one, 1.0), (pole, loop.c), (body, loop.h), (wall, -loop.beta), (shifted, loop.q)):
            by = Complex(zero + 0.0 * re, 0.0 * re).over(part)
            slope = Complex(slope.re + by.re, slope.im + by.im)
        step = value.over(slope)
        moved = Complex(moved.re - step.re, moved.im - step.im)
    return moved.re
