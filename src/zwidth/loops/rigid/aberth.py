"""All poles of many walls at one time: Aberth's and Ehrlich's simultaneous iteration, with Smith's discs as its proof.

With q_i the product of z_i - z_j over all j but i and q_i' its derivative by z_i, a step is P q/(P' q - P q'): products
alone and one quotient a pole, which compilers make into one loop over the walls. The same q ends it. Every zero of a
monic polynomial of degree N lies in one of the discs |z - z_i| <= N |P(z_i)/q_i| (Smith 1970), and where these are
disjoint each holds exactly one.
"""

from __future__ import annotations

import numpy as np

from zwidth.loops.rigid.circle import Loop, factor_loop
from zwidth.loops.rigid.folding import Degree
from zwidth.loops.rigid.normalization import valid_wall
from zwidth.loops.rigid.pole_step import Pair, join
from zwidth.words.types import Array, Radii, RadiiFirst, Reals, Roots, RootsFirst
from zwidth.words.xp import epsilon, namespace, nan_with_nan_slopes, repeat, store_once

# With half as many more as there are poles, all but some 2 walls in 1,000 are settled.
_FIRST_STEPS = 9
# Of the coefficients of N(z), which come from series, of their sum and of the products behind it, in rounding units.
_ROUNDING = 32.0


def product_form(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Loop:
    """The factors of P of every wall, NaN where it is out of range, with a new first axis for its poles."""
    xp = namespace(alpha, beta, delta, d)
    loop = store_once(factor_loop(alpha, beta, delta, d, degree.fractional), delta)
    return Loop(*(xp.asarray(part)[None] for part in loop))


def _power(z: Pair, power: int) -> Pair:
    """z^power by repeated squaring."""
    if power == 0:
        return Pair(0.0 * z.real + 1.0, 0.0 * z.imag)
    root = _power(z, power // 2)
    square = root * root
    return square * z if power % 2 else square


def evaluate(z: Pair, loop: Loop, degree: Degree, spring: bool) -> tuple[Pair, Pair]:
    """P(z) and P'(z); of walls with ``spring``, without virtual damping, a factor z is left out."""
    power = degree.poles - 2 - spring
    one, pole = z + -1.0, z + -loop.c
    quadratic, body = one * pole, z * (one + pole)
    if power:
        lag = _power(z, power - 1)
        value, slope = lag * z * quadratic, lag * (quadratic * power + body)
    else:
        value, slope = quadratic, one + pole
    n, n_slope = z * loop.a2 + loop.h, loop.a2
    if degree.fractional:
        late = z + loop.q
        n, n_slope = n * late, late * loop.a2 + n
    if spring:
        wall, stiffness = Pair(loop.alpha, 0.0), 0.0
    else:
        wall, stiffness = Pair(loop.alpha * z.real + loop.beta * one.real, loop.s * z.imag), loop.s
    return value + n * wall, slope + wall * n_slope + n * stiffness


def rounding(z: Pair, loop: Loop, degree: Degree, spring: bool, unit: float) -> Array:
    """What rounding errors may add up to in P(z)."""
    xp, power = namespace(z.real), degree.poles - 2 - spring
    # Sums of the parts' sizes are upper bounds of moduli that neither overflow nor underflow.
    r, one, pole = (xp.abs(z.real - zero) + xp.abs(z.imag) for zero in (0.0, 1.0, loop.c))
    lagged = r**power * one * ((3.0 * power + 8.0) * pole + 2.0 * loop.c)
    n = (loop.a2 * r + loop.h) * (r + loop.q if degree.fractional else 1.0)
    wall = xp.abs(loop.alpha) if spring else xp.abs(loop.alpha) * r + xp.abs(loop.beta) * one
    return unit * (lagged + _ROUNDING * n * wall)


def split(z: Array) -> Pair:
    """Real and imaginary parts."""
    return Pair(z.real, z.imag)


def _differences(z: RootsFirst) -> list[Pair]:
    """From each pole the ones that follow it, nearest in number first."""
    twice, count = namespace(z).concatenate([z, z]), z.shape[0]
    return [split(z - twice[k : k + count]) for k in range(1, count)]


def _step(z: RootsFirst, loop: Loop, degree: Degree, spring: bool) -> RootsFirst:
    q, *others = _differences(z)
    at = split(z)
    q_slope = Pair(0.0 * at.real + 1.0, 0.0 * at.imag)
    for difference in others:
        q_slope = q_slope * difference + q
        q = q * difference
    value, slope = evaluate(at, loop, degree, spring)
    step = (value * q).over(slope * q + value * q_slope * -1.0)
    return join(at.real - step.real, at.imag - step.imag)


def _start(loop: Loop, degree: Degree, spring: bool) -> RootsFirst:
    """Two poles near those of the device, the others around 0, where the two parts of P are about equally large."""
    xp, around = namespace(loop.c), degree.poles - 2 - spring
    last = loop.h * (loop.alpha if spring else loop.beta) * (loop.q if degree.fractional else 1.0)
    r = xp.clip(xp.abs(last) ** (1.0 / max(around, 1)), 0.02, 3.0)
    # No two are each other's conjugates: a symmetric set stays so, and could not change how many of it are real.
    circle = np.exp(1j * (2.0 * np.pi * np.arange(around) / max(around, 1) + 0.4)).reshape(-1, *[1] * (r.ndim - 1))
    return xp.concatenate([r * circle, 0.0 * r + (0.9 + 0.45j), 0.0 * r + (0.75 - 0.4j)])


def discs(z: RootsFirst, loop: Loop, degree: Degree, spring: bool) -> tuple[RadiiFirst, Array, Array]:
    """Radii of discs round ``z``, poles along the first axis: in each lies one pole if the second result says so."""
    # The third says whether P is as small at each of them as rounding lets it be seen.
    xp, poles = namespace(z), len(z)
    at, unit = split(z), epsilon(z.real)
    apart = [xp.sqrt(part.real * part.real + part.imag * part.imag) for part in _differences(z)]
    q = 0.0 * at.real + 1.0
    for distance in apart:
        q = q * distance
    value, bound = evaluate(at, loop, degree, spring)[0], rounding(at, loop, degree, spring, unit)
    size = xp.abs(value.real) + xp.abs(value.imag)
    # A thousandth more than N, for the rounding of q.
    within = 1.001 * poles * (size + bound) / q
    twice = xp.concatenate([within, within])
    disjoint = xp.isfinite(within)
    for k, distance in enumerate(apart[: poles // 2], start=1):
        disjoint = disjoint & (distance > within + twice[k : k + poles])
    settled = size <= bound + unit * (xp.abs(at.real) + xp.abs(at.imag)) * q
    return within, xp.all(disjoint, axis=0), xp.all(settled, axis=0)


def with_zero(poles: Array, spring: bool) -> Array:
    """The pole 0 of walls without virtual damping, which is not computed."""
    xp = namespace(poles)
    return xp.concatenate([poles, xp.zeros_like(poles[..., :1])], axis=-1) if spring else poles


def aberth_kernel(
    alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool
) -> tuple[Roots, Radii, Array]:
    """All poles, how far each is off at most, and whether that is proved and no digit is missing."""
    loop = product_form(alpha, beta, delta, d, degree)
    spoiled = nan_with_nan_slopes(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
    xp, steps = namespace(loop.c), _FIRST_STEPS + (degree.poles - spring) // 2
    z = repeat(steps, lambda z: _step(z, loop, degree, spring), _start(loop, degree, spring), xp)
    within, proved, settled = discs(z, loop, degree, spring)
    # A disc on the real axis that holds one pole holds a real one, unless the pole's conjugate is in a disc close by.
    real = xp.abs(z.imag) <= within
    within = within + xp.where(real, xp.abs(z.imag), 0.0)
    z = join(z.real, xp.where(real, 0.0, z.imag))
    z, within = (with_zero(xp.moveaxis(part, 0, -1), spring) + spoiled[..., None] for part in (z, within))
    return z, within, proved & settled
