"""All poles: eigenvalues of the companion matrix, polished, or of many walls at one time by Aberth's iteration.

That iteration, Ehrlich's too, moves all poles of a wall at once, with Smith's discs as its proof. With q_i the product
of z_i - z_j over all j but i and q_i' its derivative by z_i, a step is P q/(P' q - P q'): products alone and one
quotient a pole, which compilers make into one loop over the walls. The same q ends it. Every zero of a monic polynomial
of degree N lies in one of the discs |z - z_i| <= N |P(z_i)/q_i| (Smith 1970), and where these are disjoint each holds
exactly one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from zwidth.arrays.blocks import map_blocks
from zwidth.arrays.evaluate import as_float64, to_caller
from zwidth.arrays.polynomials import companion, square
from zwidth.loops.rigid.circle import Loop, factor_loop
from zwidth.loops.rigid.folding import Degree, few_poles, find_degree, map_by_degree
from zwidth.loops.rigid.normalization import valid_wall, wall_status
from zwidth.loops.rigid.pole_step import Pair, join
from zwidth.loops.rigid.polynomial import coefficients
from zwidth.words.errors import InputError, check_choice
from zwidth.words.quantities import LONGEST_DELAY, MOST_POLES
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike, Radii, RadiiFirst, Reals, Roots, RootsFirst
from zwidth.words.xp import epsilon, is_traced, namespace, nan_with_nan_slopes, repeat, store_once

PoleMethod: TypeAlias = Literal["auto", "aberth", "companion"]

# The eigenvalues start with errors near eps^(1/k) for a k-fold pole; two steps finish a simple one.
_POLISHING_STEPS = 3
# Of Aberth's, with half as many more as there are poles: all but some 2 walls in 1,000 are settled.
_FIRST_STEPS = 9
# Of the coefficients of N(z), which come from series, of their sum and of the products behind it, in rounding units.
_ROUNDING = 32.0
# Beyond, steps and the time to compile them grow, and the product of all distances between poles loses its digits.
_MOST_AT_ONE_TIME = 24
# Numbers of one kind, or of matrices, that a block of walls holds at most, which then stay in the cache.
_NUMBERS = 1 << 15


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


def _evaluate(z: Pair, loop: Loop, degree: Degree) -> tuple[Pair, Pair]:
    """P(z) and P'(z)."""
    power = degree.poles - 2
    one, pole = z + -1.0, z + -loop.c
    lag, quadratic, body = _power(z, power - 1), one * pole, z * (one + pole)
    n, n_slope = z * loop.a2 + loop.h, loop.a2
    if degree.fractional:
        late = z + loop.q
        n, n_slope = n * late, late * loop.a2 + n
    wall = Pair(loop.alpha * z.real + loop.beta * one.real, loop.s * z.imag)
    return lag * z * quadratic + n * wall, lag * (quadratic * power + body) + wall * n_slope + n * loop.s


def _bound_rounding(z: Pair, loop: Loop, degree: Degree, unit: float) -> Array:
    """What rounding errors may add up to in P(z)."""
    xp, power = namespace(z.real), degree.poles - 2
    # Sums of the parts' sizes are upper bounds of moduli that neither overflow nor underflow.
    r, one, pole = (xp.abs(z.real - zero) + xp.abs(z.imag) for zero in (0.0, 1.0, loop.c))
    lagged = r**power * one * ((3.0 * power + 8.0) * pole + 2.0 * loop.c)
    n = (loop.a2 * r + loop.h) * (r + loop.q if degree.fractional else 1.0)
    return unit * (lagged + _ROUNDING * n * (xp.abs(loop.alpha) * r + xp.abs(loop.beta) * one))


def _split(z: Array) -> Pair:
    """Real and imaginary parts."""
    return Pair(z.real, z.imag)


def _differences(z: RootsFirst) -> list[Pair]:
    """From each pole the ones that follow it, nearest in number first."""
    twice, count = namespace(z).concatenate([z, z]), z.shape[0]
    return [_split(z - twice[k : k + count]) for k in range(1, count)]


def _move_apart(z: RootsFirst, loop: Loop, degree: Degree) -> RootsFirst:
    """A step of Aberth's iteration."""
    q, *others = _differences(z)
    at = _split(z)
    q_slope = Pair(0.0 * at.real + 1.0, 0.0 * at.imag)
    for difference in others:
        q_slope = q_slope * difference + q
        q = q * difference
    value, slope = _evaluate(at, loop, degree)
    step = (value * q).over(slope * q + value * q_slope * -1.0)
    return join(at.real - step.real, at.imag - step.imag)


def _start(loop: Loop, degree: Degree) -> RootsFirst:
    """Two poles near those of the device, the others around 0, where the two parts of P are about equally large."""
    xp, around, spring = namespace(loop.c), degree.poles - 2, loop.beta == 0
    # Without virtual damping a pole is at 0, from which no step leads away.
    last = loop.h * xp.where(spring, loop.alpha, loop.beta) * (loop.q if degree.fractional else 1.0)
    r = xp.clip(xp.abs(last) ** (1.0 / xp.maximum(around - spring, 1)), 0.02, 3.0)
    # No two are each other's conjugates: a symmetric set stays so, and could not change how many of it are real.
    circle = np.exp(1j * (2.0 * np.pi * np.arange(around) / around + 0.4)).reshape(-1, *[1] * (r.ndim - 1))
    first, others = xp.where(spring, 0.0, r * circle[:1]), r * circle[1:]
    return xp.concatenate([first, others, 0.0 * r + (0.9 + 0.45j), 0.0 * r + (0.75 - 0.4j)])


def discs(z: RootsFirst, loop: Loop, degree: Degree) -> tuple[RadiiFirst, Array, Array]:
    """Radii of discs round ``z``, poles along the first axis: in each lies one pole if the second result says so."""
    # The third says whether P is as small at each of them as rounding lets it be seen.
    xp, poles = namespace(z), len(z)
    at, unit = _split(z), epsilon(z.real)
    apart = [xp.sqrt(part.real * part.real + part.imag * part.imag) for part in _differences(z)]
    q = 0.0 * at.real + 1.0
    for distance in apart:
        q = q * distance
    value, bound = _evaluate(at, loop, degree)[0], _bound_rounding(at, loop, degree, unit)
    size = xp.abs(value.real) + xp.abs(value.imag)
    # A thousandth more than N, for the rounding of q.
    within = 1.001 * poles * (size + bound) / q
    twice = xp.concatenate([within, within])
    disjoint = xp.isfinite(within)
    for k, distance in enumerate(apart[: poles // 2], start=1):
        disjoint = disjoint & (distance > within + twice[k : k + poles])
    settled = size <= bound + unit * (xp.abs(at.real) + xp.abs(at.imag)) * q
    return within, xp.all(disjoint, axis=0), xp.all(settled, axis=0)


def aberth_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> tuple[Roots, Radii, Array]:
    """All poles, how far each is off at most, and whether that is proved and no digit is missing."""
    loop = product_form(alpha, beta, delta, d, degree)
    spoiled = nan_with_nan_slopes(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
    xp, steps = namespace(loop.c), _FIRST_STEPS + degree.poles // 2
    z = repeat(steps, lambda z: _move_apart(z, loop, degree), _start(loop, degree), xp)
    within, proved, settled = discs(z, loop, degree)
    # A disc on the real axis that holds one pole holds a real one, unless the pole's conjugate is in a disc close by.
    real = xp.abs(z.imag) <= within
    within = within + xp.where(real, xp.abs(z.imag), 0.0)
    z = join(z.real, xp.where(real, 0.0, z.imag))
    z, within = (xp.moveaxis(part, 0, -1) + spoiled[..., None] for part in (z, within))
    return z, within, proved & settled


def pole_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Roots:
    """All poles along a new last axis, from eigenvalues."""
    matrices = companion(coefficients(alpha, beta, delta, d, degree))
    xp = namespace(matrices)
    z = _eigenvalues(matrices) if xp is np else xp.linalg.eigvals(matrices)
    return _polish_poles(z, alpha, beta, delta, d, degree)


def _eigenvalues(matrices: np.ndarray) -> np.ndarray:
    """Eigenvalues by LAPACK; NaN for a matrix on which it gives up, which must not spoil the others."""
    try:
        return np.linalg.eigvals(matrices) + 0j
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.full(matrices.shape[:-1], complex(np.nan, np.nan))
        return np.concatenate([_eigenvalues(half) for half in np.array_split(matrices, 2)])


def _polish_poles(z: Array, alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Roots:
    """Short Newton steps on the factored polynomial, where |P| is lower at their end: a multiple pole stays put."""
    xp = namespace(z, alpha)
    loop = product_form(alpha, beta, delta, d, degree)
    spoiled = nan_with_nan_slopes(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)

    def at(z: RootsFirst) -> tuple[Pair, Pair]:
        return _evaluate(_split(z), loop, degree)

    def step(z: RootsFirst) -> RootsFirst:
        here = _split(z)
        value, slope = at(z)
        still = (slope.real == 0) & (slope.imag == 0)
        by = value.over(Pair(xp.where(still, 1.0, slope.real), slope.imag))
        taken = ~still & (square(by) < 1e-6 * xp.maximum(square(here), 1e-6))
        return join(here.real - xp.where(taken, by.real, 0.0), here.imag - xp.where(taken, by.imag, 0.0))

    first = xp.moveaxis(z, -1, 0)
    last = repeat(_POLISHING_STEPS, step, first, xp)
    better = square(at(last)[0]) < square(at(first)[0])
    return xp.moveaxis(xp.where(better, last, first), 0, -1) + spoiled[..., None]


def check_degree(d: ArrayLike) -> None:
    """Raise `InputError` for delays with so many poles that a point takes minutes and gigabytes."""
    if is_traced(d):
        return
    delays = as_float64("d", d)
    longest = float(np.max(delays, where=delays <= LONGEST_DELAY, initial=0.0))
    poles = find_degree(longest).poles
    if poles > MOST_POLES:
        raise InputError(
            f"d: got {longest:g}; its {poles} poles would take about {8e-6 * poles**2:.0f} MB and "
            f"{2e-9 * poles**3:.0f} s a point, and at most {MOST_POLES} are computed; zwidth.spectral_radius, "
            "decay_rate and is_stable answer for every delay at once"
        )


def _check(values: tuple[ArrayLike, ...], method: str = "companion") -> None:
    """Raise `InputError` for an unknown method or too many poles."""
    check_choice("method", method, get_args(PoleMethod))
    check_degree(values[3])


def _by_companion(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Roots:
    """Poles of columns of one degree, with the eigenvalues of concrete ones from LAPACK on every processor."""
    columns = alpha, beta, delta, d
    if is_traced(*columns):
        # As one program: differentiated outside `jit`, every operation would be compiled alone.
        return _compile_by_degree(pole_kernel, degree)(*columns)
    # Of large matrices the eigenvalues take so long that nothing else is worth a compilation.
    few = alpha.size <= few_poles(degree)

    def block(*walls: Any) -> np.ndarray:
        if few or degree.poles > _MOST_AT_ONE_TIME:
            with np.errstate(all="ignore"):
                return pole_kernel(*walls, degree=degree)
        z = _eigenvalues(companion(np.asarray(_compile_by_degree(coefficients, degree)(*walls))))
        return np.asarray(_compile_by_degree(_polish_poles, degree)(z, *walls))

    return block(*columns) if few else map_blocks(block, columns, max(1, _NUMBERS // degree.poles**2))


@cache
def _compile_by_degree(kernel: Callable[..., Any], degree: Degree) -> Any:
    import jax

    return jax.jit(lambda *arrays: kernel(*arrays, degree))


def poles(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike, *, method: PoleMethod = "auto") -> Roots:
    """Return the poles of the closed loop.

    The poles are the zeros of ``P(z)``, see `zwidth.char_poly`. The loop is stable if ``|z| < 1`` for all of them.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional; concrete also inside `jit`. All four broadcast.
        method: "companion" computes eigenvalues; "aberth" iterates on all poles at once (Aberth and Ehrlich), and
            computes eigenvalues for walls without a proof that each pole was found; "auto" is "aberth" for many walls
            with up to 24 poles, otherwise and inside `jit` "companion".

    Returns:
        Complex array of the broadcast shape with one more axis at the end, in no particular order: 3 + d poles for
        integer d, 4 + n for d = n + f. If degrees are mixed, missing poles are NaN, at the end. A point out of range is
        NaN.

    Raises:
        InputError: an argument is no real number or a scalar out of range, shapes do not broadcast, a name is unknown,
            there are more than 4,000 poles (the message states their memory and time), or the method is "aberth"
            inside a JAX transformation.
        TracedDelayError: d is traced.

    Numerics:
        The error of a simple pole is about 1e-15 times its condition number, that of a k-fold pole about 1e-16^(1/k).
        Eigenvalues by LAPACK, O(degree^3) per point, then Newton steps on the factored polynomial. Aberth's iteration
        uses the same polynomial, O(degree^2) per step. Few points need no JAX; for many, one program is compiled per
        degree.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17); Aberth 1973; Smith 1970.

    Example:
        >>> import numpy as np, zwidth
        >>> np.abs(zwidth.poles(0.5, 0.5, 0.1, 1)).max() > 1
        np.True_
    """
    values = (alpha, beta, delta, d)
    _check(values, method)
    if is_traced(*values) and method == "aberth":
        raise InputError(
            "method: 'aberth' falls back on the host; inside a JAX transformation use 'auto' or 'companion'"
        )
    return map_by_degree(_find_poles, values, method, route="numpy")


def _find_poles(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, method: PoleMethod) -> Roots:
    """Poles of columns of one degree, by Aberth's iteration where it pays and by eigenvalues where it must."""
    columns = alpha, beta, delta, d
    few = alpha.size <= few_poles(degree)
    if method == "auto" and (few or is_traced(*columns) or degree.poles > _MOST_AT_ONE_TIME):
        method = "companion"
    if method == "companion":
        return _by_companion(*columns, degree)
    if few:
        z, _, proved = aberth_kernel(*columns, degree)
    else:
        compiled = _compile_by_degree(aberth_kernel, degree)
        z, _, proved = map_blocks(compiled, columns, max(1, _NUMBERS // degree.poles))
    left = np.flatnonzero(~proved & (wall_status(*columns) == Status.OK))
    if left.size:
        z[left] = _by_companion(*(column[left] for column in columns), degree=degree)
    return z


def radius_by_companion(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Reals:
    """Return the spectral radius of each wall, from all poles; NaN for input out of range."""
    values = (alpha, beta, delta, d)
    _check(values)
    found = map_by_degree(_by_companion, values, route="numpy")
    xp = namespace(found) if is_traced(*values) else np
    z: Any = xp.asarray(found)
    # NaN marks a missing pole if the wall has other poles.
    missing = xp.isnan(z.real) & ~xp.isnan(z[..., :1].real)
    radius = xp.max(xp.where(missing, 0.0, xp.abs(z)), axis=-1)
    # Without stiffness a pole is exactly at 1, but the computed one has a rounding error.
    radius = xp.where(xp.asarray(alpha) == 0, xp.maximum(radius, 1.0), radius)
    return radius if xp is not np else to_caller(radius, values)
