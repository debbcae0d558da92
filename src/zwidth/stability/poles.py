"""Poles as eigenvalues of the companion matrix, polished by Newton's method on the factored polynomial."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import as_float64, is_traced
from zwidth.grouping import Degree, by_degree
from zwidth.loop import check_has_poles, coefficients, evaluate, plant_of, poison, valid_wall

# The eigenvalues start with errors near eps^(1/k) for a k-fold pole; two steps finish a simple one.
_POLISHING_STEPS = 3

# XLA hands eigenvalues of a batch to threads of its own and waits for them: two batches at one time were seen to wait
# for each other for ever.
_THREADS = 1


def companion(monic: Array) -> Array:
    """The companion matrix whose eigenvalues are the zeros of a monic polynomial, highest power first."""
    size = monic.shape[0] - 1
    return jnp.concatenate([-monic[None, 1:], jnp.eye(size - 1, size, dtype=monic.dtype)])


def pole_kernel(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, spring: bool = False) -> Array:
    """All poles of one point, shape (degree.poles,); NaN where the input is out of range.

    With ``spring``, for walls without virtual damping, one pole is 0 and the matrix a row smaller.
    """
    ok = valid_wall(alpha, beta, delta, d)
    spoiled = poison(ok, alpha, beta, delta, d)
    alpha, beta, delta = (jnp.where(ok, value, 0.0) for value in (alpha, beta, delta))
    d = jnp.where(ok, d, float(degree.whole))
    plant = plant_of(delta, d, degree)
    monic = coefficients(alpha, beta, delta, d, degree)
    z = jnp.linalg.eigvals(companion(monic[:-1] if spring else monic))
    if spring:
        z = jnp.append(z, 0.0)
    for _ in range(_POLISHING_STEPS):
        value, slope = evaluate(z, alpha, beta, plant, degree)
        z = _safe_step(z, value, slope, alpha, beta, plant, degree)
    return z + spoiled


def _safe_step(z, value, slope, alpha, beta, plant, degree: Degree) -> Array:
    """A Newton step, taken only where it is short and lowers |P|: a multiple pole is left as it is."""
    step = jnp.where(slope == 0, 0.0, value / jnp.where(slope == 0, 1.0, slope))
    candidate = z - step
    better = jnp.abs(evaluate(candidate, alpha, beta, plant, degree)[0]) < jnp.abs(value)
    short = jnp.abs(step) < 1e-3 * jnp.maximum(jnp.abs(z), 1e-3)
    return jnp.where(better & short, candidate, z)


def radius_kernel(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, spring: bool = False) -> Array:
    """The spectral radius of one point from its companion matrix."""
    return jnp.max(jnp.abs(pole_kernel(alpha, beta, delta, d, degree, spring)))


def is_spring(beta: ArrayLike) -> bool:
    """Whether all walls are known to be without virtual damping: one pole less to compute."""
    return not is_traced(beta) and np.size(values := as_float64("beta", beta)) > 0 and not np.any(values)


def _of_all_poles(kernel: Callable[..., Any], values: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]) -> Array:
    return by_degree(kernel, values, static=(is_spring(values[1]),), chunk=companion_chunk, threads=_THREADS)


def companion_chunk(degree: Degree) -> int:
    """How many companion matrices fit into about 32 MiB."""
    return max(1, 1 << ((1 << 22) // degree.poles**2).bit_length() - 1)


def poles(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike, *, delay: str = "held") -> Array:
    """Return the poles of the closed loop.

    ``P(z) = 0``, see `zwidth.char_poly`; the loop is stable when every ``|z| < 1``. In no particular order.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not; concrete also inside `jit`. All four broadcast.
        delay: only "held" has poles.

    Returns:
        Complex array of the broadcast shape with one more axis at the end: 3 + d poles for whole d, 4 + n for
        d = n + f. Where degrees are mixed, the missing poles are NaN, at the end. A point out of range is NaN.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, or ``delay="fractional_power"``.
        TracedDelayError: d is traced.

    Numerics:
        Companion eigenvalues by LAPACK, O(degree^3) a point, of one degree less where every beta is 0; then Newton
        steps on the factored polynomial. A simple pole is right to about 1e-15 times its condition; a k-fold pole to
        about 1e-16^(1/k).

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> import numpy as np, zwidth
        >>> np.abs(zwidth.poles(0.5, 0.5, 0.1, 1)).max() > 1
        np.True_
    """
    check_has_poles(delay)
    return _of_all_poles(pole_kernel, (alpha, beta, delta, d))


def radius_by_companion(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """The spectral radius at every point, from the poles."""
    return _of_all_poles(radius_kernel, (alpha, beta, delta, d))


def unstable_poles(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """How many poles lie on or outside the unit circle; -1 where the input is out of range."""
    return _of_all_poles(_count_kernel, (alpha, beta, delta, d))


def _count_kernel(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, spring: bool) -> Array:
    z = pole_kernel(alpha, beta, delta, d, degree, spring)
    return jnp.where(jnp.isnan(z[0]), -1, jnp.sum(jnp.abs(z) >= 1.0))
