"""The spectral radius of one point: by bisection, and by Newton's method on one pole with a certificate.

All zeros of P lie inside the circle of radius r exactly where P(r z) passes the Schur-Cohn test. Bisection on r uses
nothing else. A few steps of it already tell the largest pole: at the end of the recursion a quadratic is left over
whose zeros, times r, are near the poles that reach the circle first. Newton's method on P in its product form then
gives the pole itself, and one last test a little outside it proves that no other pole is larger.

What an accepted point proves, in float64 arithmetic, is ``|z|(1 - tol) <= radius <= |z|(1 + tol)``: a pole lies within
``degree |P/P'|`` of each Newton iterate, and all lie inside ``|z|(1 + tol)``. Points at which rounding errors could
have decided that test (near double poles) are not accepted.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, log
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zwidth._types import Array
from zwidth.grouping import Degree
from zwidth.stability.devices import Device
from zwidth.stability.recursion import Ends, Signed, Verdict, bits, reduce_to
from zwidth.stability.schur_cohn import polynomial

# Multiples of the accuracy at which bisection looks for a circle that is surely free of poles.
_LADDER = (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6)


class Circle(NamedTuple):
    """The verdict on the circle of one radius, and the quadratic left over at the end of the recursion."""

    inside: Array  # every pole is inside
    sure: Array  # ... and rounding errors cannot have decided that
    quadratic: tuple[Array, Array, Array]


def circle(alpha: Array, beta: Array, inverse: Array, device: Device, degree: Degree, margin: bool = True) -> Circle:
    """Test the circle of radius ``1/inverse``; without ``margin``, in any precision, ``sure`` means nothing."""
    p = polynomial(alpha, beta, device, degree)
    power = inverse
    top = [p.top[0]]
    for value in p.top[1:]:
        top.append(None if value is None else Signed(value.sign, value.number * power))
        power = power * inverse
    power = jax.lax.integer_pow(inverse, p.degree - len(p.low) + 1)
    low: list[Signed | None] = []
    for value in reversed(p.low):
        low.insert(0, None if value is None else Signed(value.sign, value.number * power))
        power = power * inverse
    one = jnp.ones_like(alpha * beta * inverse)
    top[0] = Signed(1, one)
    verdict = Verdict(margin=margin)
    q2, q1, q0 = reduce_to(Ends(top, low, p.degree), verdict, 2).values
    verdict.note(q2 * q2 - q0 * q0, q2)
    both = q2 + q0
    verdict.note_ratio(both - jnp.abs(q1), both)
    inside = verdict.positive & (both > jnp.abs(q1))
    return Circle(inside, inside & ~verdict.small_margin if margin else inside, (q2, q1, q0))


def bracket(alpha: Array, beta: Array, device: Device, degree: Degree) -> tuple[Array, Array]:
    """Bounds of the radius within a factor of 2 degree: ``max (|p_(n-i)|/C(n,i))^(1/i)``, ``2 max |p_(n-i)|^(1/i)``."""
    p = polynomial(alpha, beta, device, degree).joined()
    n = p.degree
    met = len(p.top) > n
    named = list(enumerate(p.top)) if met else [*enumerate(p.top), *((n - i, v) for i, v in enumerate(p.low))]
    low, high = jnp.zeros_like(alpha * beta), jnp.zeros_like(alpha * beta)
    for i, value in named:
        if i == 0 or value is None:
            continue
        size = jnp.log(jnp.abs(value.number))
        high = jnp.maximum(high, jnp.exp(size / i))
        # As a logarithm: the number of combinations overflows at high degree.
        low = jnp.maximum(low, jnp.exp((size - log(comb(n, i))) / i))
    return low, 2.0 * high


def bisect(
    alpha: Array, beta: Array, low: Array, high: Array, steps: Array | int, device: Device, degree: Degree
) -> tuple[Array, Array]:
    """Halve the logarithm of a bracket so many times; its upper end always passes the test.

    The lower end is the upper one times a width that shrinks the same way everywhere: with one number to decide about,
    not two, XLA runs the test once a step.
    """

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        inverse, half = state
        middle = inverse * half
        inside = circle(alpha, beta, middle, device, degree, margin=False).inside
        return jnp.where(inside, middle, inverse), jnp.sqrt(half)

    inverse, half = jax.lax.fori_loop(0, steps, step, (1.0 / high, jnp.sqrt(high / low)))
    high = 1.0 / inverse
    return high / (half * half), high


@dataclass(frozen=True)
class Pole:
    """A complex number by its parts: XLA's real arithmetic is faster than its complex one."""

    re: Array
    im: Array

    def __mul__(self, other: Pole) -> Pole:
        return Pole(self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re)

    def times(self, factor: Array | float) -> Pole:
        return Pole(self.re * factor, self.im * factor)

    def plus(self, other: Pole) -> Pole:
        return Pole(self.re + other.re, self.im + other.im)

    def shifted(self, real: Array | float) -> Pole:
        return Pole(self.re + real, self.im)

    @property
    def square(self) -> Array:
        return self.re * self.re + self.im * self.im


def _power(z: Pole, exponent: int) -> Pole | None:
    """z^exponent by repeated squaring; None for exponent 0."""
    result = None
    while exponent:
        if exponent & 1:
            result = z if result is None else result * z
        exponent >>= 1
        if exponent:
            z = z * z
    return result


class Local(NamedTuple):
    """P, P' and N at one z; dP/dalpha = z N, dP/dbeta = (z - 1) N."""

    value: Pole
    slope: Pole
    n: Pole


def evaluate(z: Pole, alpha: Array, beta: Array, device: Device, degree: Degree) -> Local:
    """The product form ``z^k (z - 1)(z - c) + N(z) ((alpha + beta) z - beta)``."""
    c, a2, a1, a0 = device.c, device.a2, device.a1, device.a0
    power = degree.whole + (2 if degree.fractional else 1)
    lag = _power(z, power - 1)
    near = z.shifted(-1.0)
    quadratic = near * z.shifted(-c)
    n, dn = z.times(a2).shifted(a1), Pole(a2, jnp.zeros_like(a2))
    if degree.fractional:
        n, dn = (n * z).shifted(a0), z.times(2.0 * a2).shifted(a1)
    total = alpha + beta
    wall = z.times(total).shifted(-beta)
    inner = quadratic.times(float(power)).plus(z * z.times(2.0).shifted(-(1.0 + c)))
    head, slope = z * quadratic, inner
    if lag is not None:
        head, slope = head * lag, inner * lag
    rest = Pole(dn.re * wall.re, dn.re * wall.im) if not degree.fractional else dn * wall
    return Local(head.plus(n * wall), slope.plus(rest).plus(n.times(total)), n)


def _reciprocal(x: Array) -> Array:
    """``1/x`` for x > 0, to 1e-10: a quotient used twice would break XLA's fusion."""
    y = jax.lax.bitcast_convert_type(0x7FDE623822FC16E6 - bits(x), jnp.float64)
    for _ in range(3):
        y = y * (2.0 - x * y)
    return y


def _inverse_root(x: Array) -> Array:
    """``1/sqrt(x)`` for x > 0, to rounding."""
    y = jax.lax.bitcast_convert_type(0x5FE6EB50C7B537A9 - (bits(x) >> 1), jnp.float64)
    for _ in range(4):
        y = y * (1.5 - 0.5 * x * y * y)
    return y


def over(left: Pole, right: Pole) -> Pole:
    """The quotient, to ten digits."""
    scaled = _reciprocal(right.square)
    return Pole((left.re * right.re + left.im * right.im) * scaled, (left.im * right.re - left.re * right.im) * scaled)


def newton(z: Pole, steps: int, alpha: Array, beta: Array, device: Device, degree: Degree) -> tuple[Pole, Pole]:
    """So many steps from z; the result, and the last step.

    XLA makes one loop over the points out of all steps, and of what comes before and behind, where a single array
    comes out at the end; with two it would compute every step again for each step that follows.
    """
    by = z
    for _ in range(steps):
        at = evaluate(z, alpha, beta, device, degree)
        by = over(at.value, at.slope)
        z = Pole(z.re - by.re, z.im - by.im)
    return z, by


def accept(
    z: Pole, step: Pole, tolerance: Array | float, alpha: Array, beta: Array, device: Device, degree: Degree
) -> Array:
    """The certificate: a pole is near z, and every pole is inside ``|z|(1 + tolerance)``.

    |z| where that is proved, ``-|z|`` where it is not: one array for two results, see `newton`.
    """
    square = z.square
    inverse = _inverse_root(square)
    outside = circle(alpha, beta, inverse * (1.0 - tolerance), device, degree)
    allowed = tolerance / (degree.poles + 1)
    near = step.square < allowed * allowed * square
    # Of a real pole no root need be taken: the one at z = 1 of a wall without stiffness stays exactly there.
    radius = jnp.where(z.im == 0, jnp.abs(z.re), square * inverse)
    return jnp.where(outside.sure & near, radius, -radius)


def start(alpha: Array, beta: Array, high: Array, device: Device, degree: Degree) -> Pole:
    """The largest zero of the quadratic left over on a circle just outside the largest pole, times its radius."""
    q2, q1, q0 = circle(alpha, beta, _reciprocal(high), device, degree, margin=False).quadratic
    scale = _reciprocal(q2)
    half = -0.5 * q1 * scale
    discriminant = half * half - q0 * scale
    size = jnp.abs(discriminant)
    root = size * _inverse_root(size)
    real = discriminant >= 0
    re = jnp.where(real, half + jnp.where(half < 0, -root, root), half)
    return Pole(re * high, jnp.where(real, 0.0, root) * high)


def sure_error(alpha: Array, beta: Array, radius: Array, accuracy: Array, device: Device, degree: Degree) -> Array:
    """The least of accuracy, 10 accuracy, ... at which a circle outside the radius surely holds every pole; or NaN.

    Close to a double pole, at a distance e, the test amplifies rounding errors by 1/e^3: it is unsure up to about 1e-5
    on both sides of it.
    """
    error = jnp.full_like(radius, jnp.nan)
    for factor in reversed(_LADDER):
        tolerance = factor * accuracy
        sure = circle(alpha, beta, (1.0 - tolerance) / radius, device, degree).sure
        error = jnp.where(sure, tolerance * radius, error)
    return error
