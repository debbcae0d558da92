"""Compute all closed-loop poles: by eigenvalues, or by Aberth's iteration for many walls at once.

The eigenvalues are those of the companion matrix of the characteristic polynomial P (`stability.reference`). Newton's
method, with P evaluated from its factors (`stability.rigid.characteristic_polynomial`), then refines the eigenvalues.

Aberth's iteration (Ehrlich 1967, Aberth 1973) updates all approximations z_i of a wall together. With P monic of
degree N, q_i the product of z_i - z_j over all j != i, and q_i' its derivative in z_i, one step subtracts

    P q_i/(P' q_i - P q_i')        at z_i

This form needs only products and a single quotient per pole, which XLA fuses into one loop over the walls. The same
q_i certify the result: every zero of P lies in one of the discs |z - z_i| <= N |P(z_i)/q_i|, and if these discs are
disjoint, each of them contains exactly one zero (Smith 1970). Walls without this certificate are computed by
eigenvalues instead.

References:
    Ehrlich 1967, Commun. ACM 10, 107-108. Aberth 1973, Math. Comp. 27, 339-344. Smith 1970, J. ACM 17, 661-674.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from zwidth.core.errors import InputError, check_choice
from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike, Coefficients, Radii, RadiiFirst, Reals, Roots, RootsFirst
from zwidth.core.xp import (
    epsilon,
    is_jax,
    is_traced,
    iterate,
    lazy_jax,
    namespace,
    nan_with_nan_derivatives,
)
from zwidth.numerics.blocks import map_blocks
from zwidth.numerics.complex_pairs import Pair, make_complex
from zwidth.numerics.evaluate import as_float64, precision, to_caller
from zwidth.numerics.polynomials import abs2, companion
from zwidth.stability.reference import Degree, compute_poles, expand_loop
from zwidth.stability.rigid.broadcasting import compile_by_degree, count_uncompiled_points, find_degree, map_by_degree
from zwidth.stability.rigid.characteristic_polynomial import (
    LoopFactors,
    bound_wall_part,
    evaluate_factors,
    factor_loop,
)
from zwidth.stability.rigid.normalization import valid_wall, wall_status
from zwidth.units.quantities import LONGEST_DELAY, MOST_POLES

PoleMethod: TypeAlias = Literal["auto", "aberth", "companion"]

# Newton steps that refine the eigenvalues, whose errors are near eps^(1/k) for a k-fold pole; two steps suffice for a
# simple pole.
POLISHING_STEPS = 3
# Aberth steps in addition to half the number of poles; after these, about 2 walls in 1,000 have not converged.
MIN_ABERTH_STEPS = 9
# Rounding error of the wall's part of P, in rounding units. It covers the numerator N(z) of the plant (its coefficients
# and their sum) and the products with it.
NUMERATOR_ROUNDING = 32.0
# Largest degree for Aberth's iteration. For more poles the number of steps and the compile time grow, and the product
# of all distances between poles loses accuracy.
MAX_ABERTH_POLES = 24
# Numbers per array, or matrix elements, in a block of walls; such blocks fit in the cache.
BLOCK_SIZE = 1 << 15


def factor_with_pole_axis(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> LoopFactors:
    """Return the factors of P of each wall, with a new first axis for its poles; NaN if the wall is out of range."""
    xp = namespace(alpha, beta, delta, d)
    loop = factor_loop(alpha, beta, delta, d, degree.fractional)
    return LoopFactors(*(xp.asarray(part)[None] for part in loop))


def _raise_to_power(z: Pair, power: int) -> Pair:
    """Return z^power by repeated squaring."""
    if power == 0:
        return Pair(0.0 * z.real + 1.0, 0.0 * z.imag)
    half_power = _raise_to_power(z, power // 2)
    squared = half_power * half_power
    return squared * z if power % 2 else squared


def _evaluate(z: Pair, loop: LoopFactors, degree: Degree) -> tuple[Pair, Pair]:
    """Return P(z) and P'(z)."""
    power = degree.poles - 2
    A, dA, N, dN, _, W = evaluate_factors(z, z + -1.0, loop, degree.fractional)
    low_power = _raise_to_power(z, power - 1)
    return low_power * z * A + N * W, low_power * (A * power + z * dA) + W * dN + N * loop.s


def _bound_rounding(z: Pair, loop: LoopFactors, degree: Degree, unit: float) -> Array:
    """Return a bound of the rounding error of P(z)."""
    xp, power = namespace(z.real), degree.poles - 2
    # Use |Re| + |Im| as an upper bound of the modulus, because it neither overflows nor underflows.
    abs_z, abs_z_minus_1, abs_z_minus_c = (xp.abs(z.real - zero) + xp.abs(z.imag) for zero in (0.0, 1.0, loop.c))
    device_part = abs_z**power * abs_z_minus_1 * ((3.0 * power + 8.0) * abs_z_minus_c + 2.0 * loop.c)
    return unit * (device_part + NUMERATOR_ROUNDING * bound_wall_part(abs_z, abs_z_minus_1, loop, degree.fractional))


def _split(z: Array) -> Pair:
    """Split a complex array into its real and imaginary parts."""
    return Pair(z.real, z.imag)


def _subtract_pairwise(z: RootsFirst) -> list[Pair]:
    """Return the differences z_i - z_(i+k) for k = 1, 2, ..., with indices modulo the number of poles."""
    twice, count = namespace(z).concatenate([z, z]), z.shape[0]
    return [_split(z - twice[k : k + count]) for k in range(1, count)]


def _take_aberth_step(z: RootsFirst, loop: LoopFactors, degree: Degree) -> RootsFirst:
    """Return the approximations of all poles after one step of Aberth's iteration from ``z``."""
    q, *others = _subtract_pairwise(z)
    pair = _split(z)
    q_slope = Pair(0.0 * pair.real + 1.0, 0.0 * pair.imag)
    for difference in others:
        q_slope = q_slope * difference + q
        q = q * difference
    value, slope = _evaluate(pair, loop, degree)
    step = (value * q).over(slope * q + value * q_slope * -1.0)
    return make_complex(pair.real - step.real, pair.imag - step.imag)


def _guess_poles(loop: LoopFactors, degree: Degree) -> RootsFirst:
    """Return starting points: two near the device's poles, the others where both parts of P have similar magnitudes."""
    xp, n_others, no_damping = namespace(loop.c), degree.poles - 2, loop.beta == 0
    # Without virtual damping one pole is exactly 0; one starting point is 0 and stays there.
    constant_term = loop.h * xp.where(no_damping, loop.alpha, loop.beta) * (loop.q if degree.fractional else 1.0)
    r = xp.clip(xp.abs(constant_term) ** (1.0 / xp.maximum(n_others - no_damping, 1)), 0.02, 3.0)
    # Choose a set that is not symmetric about the real axis. The iteration would preserve such a symmetry, and the
    # number of real poles could never change.
    circle = np.exp(1j * (2.0 * np.pi * np.arange(n_others) / n_others + 0.4)).reshape(-1, *[1] * (r.ndim - 1))
    first, rest = xp.where(no_damping, 0.0, r * circle[:1]), r * circle[1:]
    return xp.concatenate([first, rest, 0.0 * r + (0.9 + 0.45j), 0.0 * r + (0.75 - 0.4j)])


def compute_discs(z: RootsFirst, loop: LoopFactors, degree: Degree) -> tuple[RadiiFirst, Array, Array]:
    """Return Smith's discs around approximations ``z``, with the poles along the first axis.

    Returns:
        The radius of each disc; whether all discs of a wall are disjoint, so that each contains exactly one pole; and
        whether |P| at every approximation is within its rounding error (the iteration has converged).
    """
    xp, poles = namespace(z), len(z)
    pair, unit = _split(z), epsilon(z.real)
    distances = [xp.sqrt(part.real * part.real + part.imag * part.imag) for part in _subtract_pairwise(z)]
    q = 0.0 * pair.real + 1.0
    for distance in distances:
        q = q * distance
    value, rounding = _evaluate(pair, loop, degree)[0], _bound_rounding(pair, loop, degree, unit)
    size = xp.abs(value.real) + xp.abs(value.imag)
    # The factor 1.001 covers the rounding error of q.
    radius = 1.001 * poles * (size + rounding) / q
    doubled = xp.concatenate([radius, radius])
    disjoint = xp.isfinite(radius)
    for k, distance in enumerate(distances[: poles // 2], start=1):
        disjoint = disjoint & (distance > radius + doubled[k : k + poles])
    converged = size <= rounding + unit * (xp.abs(pair.real) + xp.abs(pair.imag)) * q
    return radius, xp.all(disjoint, axis=0), xp.all(converged, axis=0)


def aberth_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> tuple[Roots, Radii, Array]:
    """Return all poles, a bound of each error, and whether the bounds are certified and the iteration has converged."""
    loop = factor_with_pole_axis(alpha, beta, delta, d, degree)
    nan_if_invalid = nan_with_nan_derivatives(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
    xp, steps = namespace(loop.c), MIN_ABERTH_STEPS + degree.poles // 2
    z = iterate(steps, lambda z: _take_aberth_step(z, loop, degree), _guess_poles(loop, degree), xp)
    radius, disjoint, converged = compute_discs(z, loop, degree)
    # If a disc contains exactly one pole and meets the real axis, this pole is real, unless its conjugate is in a
    # neighboring disc.
    real = xp.abs(z.imag) <= radius
    radius = radius + xp.where(real, xp.abs(z.imag), 0.0)
    z = make_complex(z.real, xp.where(real, 0.0, z.imag))
    z, radius = (xp.moveaxis(part, 0, -1) + nan_if_invalid[..., None] for part in (z, radius))
    return z, radius, disjoint & converged


def _replace_invalid(
    alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree
) -> tuple[Reals, Reals, Reals, Reals]:
    """Replace arguments out of range by valid numbers; the caller sets the results of these walls to NaN."""
    xp, ok = namespace(alpha, beta, delta, d), valid_wall(alpha, beta, delta, d)
    alpha, beta, delta = (xp.where(ok, value, 0.0) for value in (alpha, beta, delta))
    return alpha, beta, delta, xp.where(ok, d, float(degree.n))


def pole_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Roots:
    """Return all poles along a new last axis, from the eigenvalues of companion matrices."""
    walls = _replace_invalid(alpha, beta, delta, d, degree)
    if namespace(*walls) is np:
        z = _eigenvalues(companion(expand_loop(*walls, degree)))
    else:
        z = compute_poles(*walls, degree)
    return _polish_poles(z, alpha, beta, delta, d, degree)


def _eigenvalues(matrices: np.ndarray) -> np.ndarray:
    """Return eigenvalues by LAPACK; NaN only for those matrices for which LAPACK does not converge."""
    try:
        return np.linalg.eigvals(matrices) + 0j
    except np.linalg.LinAlgError:
        if len(matrices) == 1:
            return np.full(matrices.shape[:-1], complex(np.nan, np.nan))
        return np.concatenate([_eigenvalues(half) for half in np.array_split(matrices, 2)])


def _polish_poles(z: Array, alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Roots:
    """Improve poles by short Newton steps, each accepted only if it lowers |P|; multiple poles are not moved."""
    xp = namespace(z, alpha)
    loop = factor_with_pole_axis(alpha, beta, delta, d, degree)
    nan_if_invalid = nan_with_nan_derivatives(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)

    def evaluate(z: RootsFirst) -> tuple[Pair, Pair]:
        return _evaluate(_split(z), loop, degree)

    def step(z: RootsFirst) -> RootsFirst:
        pair = _split(z)
        value, slope = evaluate(z)
        stationary = (slope.real == 0) & (slope.imag == 0)
        correction = value.over(Pair(xp.where(stationary, 1.0, slope.real), slope.imag))
        accepted = ~stationary & (abs2(correction) < 1e-6 * xp.maximum(abs2(pair), 1e-6))
        return make_complex(
            pair.real - xp.where(accepted, correction.real, 0.0), pair.imag - xp.where(accepted, correction.imag, 0.0)
        )

    first = xp.moveaxis(z, -1, 0)
    last = iterate(POLISHING_STEPS, step, first, xp)
    better = abs2(evaluate(last)[0]) < abs2(evaluate(first)[0])
    return xp.moveaxis(xp.where(better, last, first), 0, -1) + nan_if_invalid[..., None]


def check_degree(d: ArrayLike) -> None:
    """Raise `InputError` for a delay with more than `MOST_POLES` poles, which would take minutes and gigabytes."""
    if is_traced(d):
        return
    delays = as_float64("d", d)
    longest = float(np.max(delays, where=delays <= LONGEST_DELAY, initial=0.0))
    poles = find_degree(longest).poles
    if poles > MOST_POLES:
        raise InputError(
            f"d: got {longest:g}; its {poles} poles need about {8e-6 * poles**2:.0f} MB and "
            f"{2e-9 * poles**3:.0f} s per point; at most {MOST_POLES} are computed. Use zwidth.spectral_radius, "
            "decay_rate or is_stable instead"
        )


def _check_arguments(values: tuple[ArrayLike, ...], method: str = "companion") -> None:
    """Raise `InputError` for an unknown method or too many poles."""
    check_choice("method", method, get_args(PoleMethod))
    check_degree(values[3])


def _compute_by_companion(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Roots:
    """Return the poles of columns of one degree by eigenvalues; concrete matrices go to LAPACK on all processors."""
    columns = alpha, beta, delta, d
    if is_jax(alpha):
        return pole_kernel(*columns, degree)

    # Do not compile: the eigenvalues take most of the time, NumPy computes them as fast as JAX, and calls of JAX's
    # eigenvalues from two threads can block each other forever (jaxlib 0.10.2 on CPUs).
    def compute_block(*walls: Any) -> np.ndarray:
        with np.errstate(all="ignore"):
            return pole_kernel(*walls, degree=degree)

    if alpha.size <= count_uncompiled_points(degree):
        return compute_block(*columns)
    return map_blocks(compute_block, columns, max(1, BLOCK_SIZE // degree.poles**2))


def char_poly(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Coefficients:
    """Return the coefficients of the monic characteristic polynomial, highest power first.

    ``P(z) = z^(2+n) (z - 1)(z - c) + (z n0(z) + n1(z)) (alpha z + beta (z - 1))``, d = n + f, ``c = e^-delta``; for
    integer d the paper's (17) over ``-delta^2``, also for delta = 0. The loop is stable if all zeros lie inside the
    unit circle.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional; concrete also inside `jit`, because it determines the degree.
            All four broadcast.

    Returns:
        Array of the broadcast shape with one more axis at the end: 4 + d coefficients for integer d, 5 + n otherwise.
        If degrees are mixed, shorter polynomials have leading zeros. A point out of range is NaN.

    Raises:
        InputError: an argument is no real number or a scalar out of range, or shapes do not broadcast.
        TracedDelayError: d is traced.

    Numerics:
        Each coefficient is a sum; its error is a few rounding errors of the terms of this sum, for all delta.

    References:
        Hulin, Preusche, Hirzinger 2006, eqs. (15), (17).

    Example:
        >>> import numpy as np, zwidth
        >>> print(np.array2string(zwidth.char_poly(0.5, 0.5, 0.0, 0), precision=2))
        [ 1.   -1.5   1.25 -0.25]
    """
    return map_by_degree(_char_poly_kernel, (alpha, beta, delta, d), lead=True)


def _char_poly_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Coefficients:
    nan_if_invalid = nan_with_nan_derivatives(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
    return expand_loop(*_replace_invalid(alpha, beta, delta, d, degree), degree) + nan_if_invalid[..., None]


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
    _check_arguments(values, method)
    if is_traced(*values) and method == "aberth":
        raise InputError(
            "method: 'aberth' falls back on the host; inside a JAX transformation use 'auto' or 'companion'"
        )
    if method == "aberth" and any(map(is_jax, values)):
        return to_caller(poles(*map(np.asarray, values), method=method), values)
    return map_by_degree(_find_poles, values, method, route="numpy")


def _find_poles(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree, method: PoleMethod) -> Roots:
    """Return the poles of columns of one degree, by Aberth's iteration for many walls of low degree."""
    columns = alpha, beta, delta, d
    few = alpha.size <= count_uncompiled_points(degree)
    if method == "auto" and (few or is_jax(alpha) or degree.poles > MAX_ABERTH_POLES):
        method = "companion"
    if method == "companion":
        return _compute_by_companion(*columns, degree)
    if few:
        z, _, certified = aberth_kernel(*columns, degree)
    else:
        compiled = compile_by_degree(aberth_kernel, degree)
        z, _, certified = map_blocks(compiled, columns, max(1, BLOCK_SIZE // degree.poles))
    open_walls = np.flatnonzero(~certified & (wall_status(*columns) == Status.OK))
    if open_walls.size:
        z[open_walls] = _compute_by_companion(*(column[open_walls] for column in columns), degree=degree)
    return z


def radius_by_companion(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Reals:
    """Return the spectral radius of each wall, from all poles; NaN for input out of range."""
    values = (alpha, beta, delta, d)
    _check_arguments(values)
    all_poles = map_by_degree(_compute_by_companion, values, route="numpy")
    if is_jax(all_poles):
        with precision(values):
            return lazy_jax.jit(_find_largest)(all_poles, lazy_jax.numpy.asarray(alpha))
    return _find_largest(np.asarray(all_poles), np.asarray(alpha))[()]


def _find_largest(z: Any, alpha: Any) -> Reals:
    """Return the largest magnitude of the poles of each wall; the poles are along the last axis of ``z``."""
    xp = namespace(z)
    # Ignore missing poles: NaN after the other poles of a wall with a lower degree.
    missing = xp.isnan(z.real) & ~xp.isnan(z[..., :1].real)
    radius = xp.max(xp.where(missing, 0.0, xp.abs(z)), axis=-1)
    # Without stiffness one pole is exactly 1, but the computed one has a rounding error.
    return xp.where(alpha == 0, xp.maximum(radius, 1.0), radius)
