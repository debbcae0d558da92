"""All poles: eigenvalues of the companion matrix, polished, or of many walls at one time by Aberth's iteration."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from zwidth.arrays.evaluate import as_float64, map_blocks, to_caller
from zwidth.arrays.polynomials import companion, square
from zwidth.loops.rigid.aberth import aberth_kernel, evaluate, product_form, split, with_zero
from zwidth.loops.rigid.folding import Degree, few_poles, find_degree, map_by_degree
from zwidth.loops.rigid.normalization import valid_wall, wall_status
from zwidth.loops.rigid.pole_step import Pair, join
from zwidth.loops.rigid.polynomial import check_has_poles, coefficients
from zwidth.words.errors import InputError, check_choice
from zwidth.words.quantities import LONGEST_DELAY, MOST_POLES
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike, Matrices, Reals, Roots, RootsFirst
from zwidth.words.xp import is_traced, namespace, nan_with_nan_slopes, repeat

PoleMethod: TypeAlias = Literal["auto", "aberth", "companion"]

# The eigenvalues start with errors near eps^(1/k) for a k-fold pole; two steps finish a simple one.
_POLISHING_STEPS = 3

# Beyond, steps and the time to compile them grow, and the product of all distances between poles loses its digits.
_MOST_AT_ONE_TIME = 24
# Numbers of one kind that a block of walls holds, which then stay in the cache, and those of a block of matrices.
_NUMBERS, _MATRICES = 1 << 15, 1 << 15


def pole_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool = False) -> Roots:
    """All poles along a new last axis; for walls without virtual damping, ``spring``, the matrix is a row smaller."""
    matrices = _matrices(alpha, beta, delta, d, degree, spring)
    xp = namespace(matrices)
    z = _eigenvalues(matrices) if xp is np else xp.linalg.eigvals(matrices)
    return _polish_poles(z, alpha, beta, delta, d, degree, spring)


def _matrices(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool) -> Matrices:
    monic = coefficients(alpha, beta, delta, d, degree)
    return companion(monic[..., :-1] if spring else monic)


def _eigenvalues(matrices: np.ndarray) -> np.ndarray:
    """Eigenvalues by LAPACK; NaN for a matrix on which it gives up, which must not spoil the others."""
    try:
        return np.linalg.eigvals(matrices) + 0j
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.full(matrices.shape[:-1], complex(np.nan, np.nan))
        return np.concatenate([_eigenvalues(half) for half in np.array_split(matrices, 2)])


def _polish_poles(z: Array, alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool) -> Roots:
    """Short Newton steps on the factored polynomial, where |P| is lower at their end: a multiple pole stays put."""
    xp = namespace(z, alpha)
    loop = product_form(alpha, beta, delta, d, degree)
    spoiled = nan_with_nan_slopes(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)

    def at(z: RootsFirst) -> tuple[Pair, Pair]:
        return evaluate(split(z), loop, degree, spring)

    def step(z: RootsFirst) -> RootsFirst:
        here = split(z)
        value, slope = at(z)
        still = (slope.real == 0) & (slope.imag == 0)
        by = value.over(Pair(xp.where(still, 1.0, slope.real), slope.imag))
        taken = ~still & (square(by) < 1e-6 * xp.maximum(square(here), 1e-6))
        return join(here.real - xp.where(taken, by.real, 0.0), here.imag - xp.where(taken, by.imag, 0.0))

    first = xp.moveaxis(z, -1, 0)
    last = repeat(_POLISHING_STEPS, step, first, xp)
    better = square(at(last)[0]) < square(at(first)[0])
    return with_zero(xp.moveaxis(xp.where(better, last, first), 0, -1), spring) + spoiled[..., None]


def is_spring(beta: ArrayLike) -> bool:
    """Whether all walls are known to be without virtual damping: one pole less to compute."""
    return not is_traced(beta) and np.size(values := as_float64("beta", beta)) > 0 and not np.any(values)


def check_degree(d: ArrayLike) -> None:
    """Refuse to begin what would take minutes a point and gigabytes."""
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


def _check(values: tuple[ArrayLike, ...], delay_model: str = "held", method: str = "companion") -> None:
    check_has_poles(delay_model)
    check_choice("method", method, get_args(PoleMethod))
    check_degree(values[3])


def _by_companion(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool) -> Roots:
    """Poles of columns of one degree, with the eigenvalues of concrete ones from LAPACK on every processor."""
    columns = alpha, beta, delta, d
    if is_traced(*columns):
        # As one program: differentiated outside `jit`, every operation would be compiled alone.
        return _compile_by_degree(pole_kernel, degree, spring)(*columns)
    # Of large matrices the eigenvalues take so long that nothing else is worth a compilation.
    few = alpha.size <= few_poles(degree)

    def block(*walls: Any) -> np.ndarray:
        if few or degree.poles > _MOST_AT_ONE_TIME:
            with np.errstate(all="ignore"):
                return pole_kernel(*walls, degree=degree, spring=spring)
        matrices = np.asarray(_compile_by_degree(_matrices, degree, spring)(*walls))
        return np.asarray(_compile_by_degree(_polish_poles, degree, spring)(_eigenvalues(matrices), *walls))

    return block(*columns) if few else map_blocks(block, columns, _block(_MATRICES // degree.poles**2))


@cache
def _compile_by_degree(kernel: Callable[..., Any], degree: Degree, spring: bool) -> Any:
    import jax

    return jax.jit(lambda *arrays: kernel(*arrays, degree, spring))


def _block(most: int) -> int:
    """The largest power of two that is not above."""
    return 1 << max(1, most).bit_length() - 1


def poles(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: PoleMethod = "auto",
    delay: str = "held",
) -> Roots:
    """Return the poles of the closed loop.

    ``P(z) = 0``, see `zwidth.char_poly`; the loop is stable when every ``|z| < 1``. In no particular order.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not; concrete also inside `jit`. All four broadcast.
        method: "companion" computes eigenvalues; "aberth" all poles at one time by the iteration of Aberth and Ehrlich,
            and eigenvalues where it has no proof that each pole was found; "auto" takes that for many walls with up to
            24 poles, and eigenvalues otherwise and inside `jit`.
        delay: only "held" has poles.

    Returns:
        Complex array of the broadcast shape with one more axis at the end: 3 + d poles for whole d, 4 + n for
        d = n + f. Where degrees are mixed, the missing poles are NaN, at the end. A point out of range is NaN.

    Raises:
        InputError: an argument is no real number or a scalar out of range, shapes do not broadcast, a name is unknown,
            ``delay="fractional_power"``, there are more than 4,000 poles: what their memory and time would be; or
            "aberth" is asked for inside a JAX transformation.
        TracedDelayError: d is traced.

    Numerics:
        A simple pole is right to about 1e-15 times its condition; a k-fold pole to about 1e-16^(1/k).
        Eigenvalues by LAPACK, O(degree^3) a point, of one degree less where every beta is
        0; then Newton steps on the factored polynomial. Aberth's iteration works on that polynomial too, O(degree^2) a
        step. Few points need no JAX; many are compiled once for every degree.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17); Aberth 1973; Smith 1970.

    Example:
        >>> import numpy as np, zwidth
        >>> np.abs(zwidth.poles(0.5, 0.5, 0.1, 1)).max() > 1
        np.True_
    """
    values = (alpha, beta, delta, d)
    _check(values, delay, method)
    if is_traced(*values) and method == "aberth":
        raise InputError(
            "method: 'aberth' falls back on the host; inside a JAX transformation use 'auto' or 'companion'"
        )
    return map_by_degree(_find_poles, values, is_spring(values[1]), method, route="numpy")


def _find_poles(
    alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, spring: bool, method: PoleMethod
) -> Roots:
    """Poles of columns of one degree, by Aberth's iteration where it pays and by eigenvalues where it must."""
    columns = alpha, beta, delta, d
    few = alpha.size <= few_poles(degree)
    if method == "auto" and (few or is_traced(*columns) or degree.poles > _MOST_AT_ONE_TIME):
        method = "companion"
    if method == "companion":
        return _by_companion(*columns, degree, spring)
    if few:
        z, _, proved = aberth_kernel(*columns, degree, spring)
    else:
        block = _block(_NUMBERS // degree.poles)
        z, _, proved = map_blocks(_compile_by_degree(aberth_kernel, degree, spring), columns, block)
    left = np.flatnonzero(~proved & (wall_status(*columns) == Status.OK))
    if left.size:
        z[left] = _by_companion(*(column[left] for column in columns), degree=degree, spring=spring)
    return z


def radius_by_companion(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Reals:
    """The spectral radius at every point, from the poles; NaN where the input is out of range."""
    values = (alpha, beta, delta, d)
    _check(values)
    found = map_by_degree(_by_companion, values, is_spring(beta), route="numpy")
    xp = namespace(found) if is_traced(*values) else np
    z: Any = xp.asarray(found)
    # Of a wall that has fewer poles than others.
    missing = xp.isnan(z.real) & ~xp.isnan(z[..., :1].real)
    radius = xp.max(xp.where(missing, 0.0, xp.abs(z)), axis=-1)
    # Without stiffness a pole is at 1, whatever rounding makes of it.
    radius = xp.where(xp.asarray(alpha) == 0, xp.maximum(radius, 1.0), radius)
    return radius if xp is not np else to_caller(radius, values)
