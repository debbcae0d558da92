"""All poles of many walls at one time: Aberth's and Ehrlich's simultaneous iteration, with Smith's discs as its proof.

With q_i the product of z_i - z_j over all j but i and q_i' its derivative by z_i, a step is P q/(P' q - P q'): products
alone and one quotient a pole, which compilers make into one loop over the walls. The same q ends it. Every zero of a
monic polynomial of degree N lies in one of the discs |z - z_i| <= N |P(z_i)/q_i| (Smith 1970), and where these are
disjoint each holds exactly one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.arrays.xp import epsilon, namespace, nan_with_nan_slopes, repeat
from zwidth.loops.rigid.device import valid_wall
from zwidth.loops.rigid.folding import Degree
from zwidth.loops.rigid.pole_step import Pair
from zwidth.loops.rigid.polynomial import choose_plant
from zwidth.words.types import Array, Radii, RadiiFirst, Reals, Roots, RootsFirst

# With half as many more as there are poles, all but some 2 walls in 1,000 are settled.
_FIRST_STEPS = 9
# Of the coefficients of N(z), which come from series, of their sum and of the products behind it, in rounding units.
_ROUNDING = 32.0


class ProductForm(NamedTuple):
    """``P(z) = z^power (z - 1)(z - c) + N(z) (alpha z + beta (z - 1))``, N by its coefficients, highest power first.

    Rounding errors stay small where the coefficients of P cancel. Without virtual damping a factor z is left out.
    """

    power: int
    c: Array
    n: tuple[Array, ...]
    alpha: Array
    beta: Array | None

    @property
    def poles(self) -> int:
        """The degree of P."""
        return self.power + 2


def product_form(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool) -> ProductForm:
    """The polynomial of every wall, with a new first axis for its poles; of walls with ``spring`` beta is 0."""
    xp = namespace(alpha, beta, delta, d)
    plant = choose_plant(delta, d, degree)
    n = (plant.a2, plant.a1, plant.a0)[: 3 if degree.fractional else 2]
    c, alpha, beta, *n = (xp.asarray(part)[None] for part in (plant.c, alpha, beta, *n))
    return ProductForm(degree.poles - 2 - spring, c, tuple(n), alpha, None if spring else beta)


def _power(z: Pair, power: int) -> Pair:
    """z^power by repeated squaring."""
    if power == 0:
        return Pair(0.0 * z.real + 1.0, 0.0 * z.imag)
    root = _power(z, power // 2)
    square = root * root
    return square * z if power % 2 else square


def evaluate(z: Pair, form: ProductForm) -> tuple[Pair, Pair]:
    """P(z) and P'(z)."""
    one, pole = z + -1.0, z + -form.c
    quadratic, body = one * pole, z * (one + pole)
    if form.power:
        lag = _power(z, form.power - 1)
        value, slope = lag * z * quadratic, lag * (quadratic * form.power + body)
    else:
        value, slope = quadratic, one + pole
    zero = Pair(0.0 * z.real, 0.0 * z.imag)
    n, n_slope = zero + form.n[0], zero
    for coefficient in form.n[1:]:
        n_slope = n_slope * z + n
        n = n * z + coefficient
    if form.beta is None:
        wall, stiffness = Pair(form.alpha, 0.0), 0.0
    else:
        stiffness = form.alpha + form.beta
        wall = Pair(form.alpha * z.real + form.beta * one.real, stiffness * z.imag)
    return value + n * wall, slope + n_slope * wall + n * stiffness


def rounding(z: Pair, form: ProductForm, unit: float) -> Array:
    """What rounding errors may add up to in P(z)."""
    xp = namespace(z.real)
    # Sums of the parts' sizes are upper bounds of moduli that neither overflow nor underflow.
    r, one, pole = (xp.abs(z.real - zero) + xp.abs(z.imag) for zero in (0.0, 1.0, form.c))
    lagged = r**form.power * one * ((3.0 * form.power + 8.0) * pole + 2.0 * form.c)
    n = form.n[0]
    for coefficient in form.n[1:]:
        n = n * r + coefficient
    wall = xp.abs(form.alpha) if form.beta is None else xp.abs(form.alpha) * r + xp.abs(form.beta) * one
    return unit * (lagged + _ROUNDING * n * wall)


def join(re: Array, im: Array) -> Array:
    """A complex array. As one array it is computed by one loop, as two by two loops that repeat what they share."""
    if namespace(re) is np:
        return re + 1j * im
    from jax.lax import complex as join

    return join(re, im)


def split(z: Array) -> Pair:
    """Real and imaginary parts."""
    return Pair(z.real, z.imag)


def _differences(z: RootsFirst) -> list[Pair]:
    """From each pole the ones that follow it, nearest in number first."""
    twice, count = namespace(z).concatenate([z, z]), z.shape[0]
    return [split(z - twice[k : k + count]) for k in range(1, count)]


def _step(z: RootsFirst, form: ProductForm) -> RootsFirst:
    q, *others = _differences(z)
    at = split(z)
    q_slope = Pair(0.0 * at.real + 1.0, 0.0 * at.imag)
    for difference in others:
        q_slope = q_slope * difference + q
        q = q * difference
    value, slope = evaluate(at, form)
    step = (value * q).over(slope * q + value * q_slope * -1.0)
    return join(at.real - step.real, at.imag - step.imag)


def _start(form: ProductForm) -> RootsFirst:
    """Two poles near those of the device, the others around 0, where the two parts of P are about equally large."""
    xp = namespace(form.c)
    around = form.power
    last = form.alpha if form.beta is None else form.beta
    r = xp.clip(xp.abs(form.n[-1] * last) ** (1.0 / max(around, 1)), 0.02, 3.0)
    # No two are each other's conjugates: a symmetric set stays so, and could not change how many of it are real.
    circle = np.exp(1j * (2.0 * np.pi * np.arange(around) / max(around, 1) + 0.4)).reshape(-1, *[1] * (r.ndim - 1))
    return xp.concatenate([r * circle, 0.0 * r + (0.9 + 0.45j), 0.0 * r + (0.75 - 0.4j)])


def discs(z: RootsFirst, form: ProductForm) -> tuple[RadiiFirst, Array, Array]:
    """Radii of discs round ``z``, the poles along the first axis: in each lies one pole if the second result says so.

    The third says whether P is as small at each of them as rounding lets it be seen.
    """
    xp = namespace(z)
    at, unit = split(z), epsilon(z.real)
    apart = [xp.sqrt(part.real * part.real + part.imag * part.imag) for part in _differences(z)]
    q = 0.0 * at.real + 1.0
    for distance in apart:
        q = q * distance
    value, bound = evaluate(at, form)[0], rounding(at, form, unit)
    size = xp.abs(value.real) + xp.abs(value.imag)
    # A thousandth more than N, for the rounding of q.
    within = 1.001 * form.poles * (size + bound) / q
    twice = xp.concatenate([within, within])
    disjoint = xp.isfinite(within)
    for k, distance in enumerate(apart[: form.poles // 2], start=1):
        disjoint = disjoint & (distance > within + twice[k : k + form.poles])
    settled = size <= bound + unit * (xp.abs(at.real) + xp.abs(at.imag)) * q
    return within, xp.all(disjoint, axis=0), xp.all(settled, axis=0)


def replace_invalid(
    alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree
) -> tuple[tuple[Reals, Reals, Reals, Reals], Reals]:
    """Walls that can be computed, and what to add to the results of those that could not."""
    xp = namespace(alpha, beta, delta, d)
    ok = valid_wall(alpha, beta, delta, d)
    alpha_in, beta_in, delta_in = (xp.where(ok, value, 0.0) for value in (alpha, beta, delta))
    inside = (alpha_in, beta_in, delta_in, xp.where(ok, d, float(degree.whole)))
    return inside, nan_with_nan_slopes(ok, alpha, beta, delta, d)


def with_zero(poles: Array, spring: bool) -> Array:
    """The pole 0 of walls without virtual damping, which is not computed."""
    xp = namespace(poles)
    return xp.concatenate([poles, xp.zeros_like(poles[..., :1])], axis=-1) if spring else poles


def aberth_kernel(
    alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool
) -> tuple[Roots, Radii, Array]:
    """All poles, how far each is off at most, and whether that is proved and no digit is missing."""
    walls, spoiled = replace_invalid(alpha, beta, delta, d, degree)
    form = product_form(*walls, degree, spring)
    xp = namespace(form.c)
    z = repeat(_FIRST_STEPS + form.poles // 2, lambda z: _step(z, form), _start(form), xp)
    within, proved, settled = discs(z, form)
    # A disc on the real axis that holds one pole holds a real one, unless the pole's conjugate is in a disc close by.
    real = xp.abs(z.imag) <= within
    within = within + xp.where(real, xp.abs(z.imag), 0.0)
    z = join(z.real, xp.where(real, 0.0, z.imag))
    z, within = (with_zero(xp.moveaxis(part, 0, -1), spring) + spoiled[..., None] for part in (z, within))
    return z, within, proved & settled
