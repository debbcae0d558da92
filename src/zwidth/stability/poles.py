"""Poles as eigenvalues of the companion matrix, polished by Newton's method on the factored polynomial."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import as_float64, is_traced
from zwidth.domain import LONGEST_DELAY, check_scalars, wall_status
from zwidth.errors import InputError
from zwidth.grouping import Degree, by_degree, degree_of, few_poles
from zwidth.loop import check_has_poles, coefficients, evaluate, plant_of, poison, valid_wall
from zwidth.status import Method, Status
from zwidth.xp import namespace

# The eigenvalues start with errors near eps^(1/k) for a k-fold pole; two steps finish a simple one.
_POLISHING_STEPS = 3

# XLA hands eigenvalues of a batch to threads of its own and waits for them: two batches at one time were seen to wait
# for each other for ever.
_THREADS = 1

# All poles take degree^3 operations and degree^2 numbers: 4,000 take minutes and 0.3 GB.
MOST_POLES = 4000


def companion(monic: Array) -> Array:
    """The companion matrices whose eigenvalues are the zeros of monic polynomials, highest power first."""
    xp = namespace(monic)
    size = monic.shape[-1] - 1
    below = xp.broadcast_to(xp.eye(size - 1, size, dtype=monic.dtype), (*monic.shape[:-1], size - 1, size))
    return xp.concatenate([-monic[..., None, 1:], below], axis=-2)


def pole_kernel(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, spring: bool = False) -> Array:
    """All poles along a new last axis of degree.poles; NaN where the input is out of range.

    With ``spring``, for walls without virtual damping, one pole is 0 and the matrix a row smaller.
    """
    xp = namespace(alpha, beta, delta, d)
    ok = valid_wall(alpha, beta, delta, d)
    spoiled = poison(ok, alpha, beta, delta, d)
    alpha, beta, delta = (xp.where(ok, value, 0.0) for value in (alpha, beta, delta))
    d = xp.where(ok, d, float(degree.whole))
    plant = plant_of(delta, d, degree)
    monic = coefficients(alpha, beta, delta, d, degree)
    z = xp.linalg.eigvals(companion(monic[..., :-1] if spring else monic)) + 0j
    if spring:
        z = xp.concatenate([z, xp.zeros_like(z[..., :1])], axis=-1)
    plant = type(plant)(*(field[..., None] for field in plant))
    alpha, beta = alpha[..., None], beta[..., None]
    for _ in range(_POLISHING_STEPS):
        value, slope = evaluate(z, alpha, beta, plant, degree)
        z = _safe_step(z, value, slope, alpha, beta, plant, degree)
    return z + spoiled[..., None]


def _safe_step(z, value, slope, alpha, beta, plant, degree: Degree) -> Array:
    """A Newton step, taken only where it is short and lowers |P|: a multiple pole is left as it is."""
    xp = namespace(z)
    step = xp.where(slope == 0, 0.0, value / xp.where(slope == 0, 1.0, slope))
    candidate = z - step
    better = xp.abs(evaluate(candidate, alpha, beta, plant, degree)[0]) < xp.abs(value)
    short = xp.abs(step) < 1e-3 * xp.maximum(xp.abs(z), 1e-3)
    return xp.where(better & short, candidate, z)


def radius_kernel(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, spring: bool = False) -> Array:
    """The spectral radius from the companion matrix; at least 1 without stiffness, for a pole is there."""
    xp = namespace(alpha, beta, delta, d)
    radius = xp.max(xp.abs(pole_kernel(alpha, beta, delta, d, degree, spring)), axis=-1)
    return xp.where(alpha == 0, xp.maximum(radius, 1.0), radius)


def is_spring(beta: ArrayLike) -> bool:
    """Whether all walls are known to be without virtual damping: one pole less to compute."""
    return not is_traced(beta) and np.size(values := as_float64("beta", beta)) > 0 and not np.any(values)


def check_degree(d: ArrayLike) -> None:
    """Refuse to begin what would take minutes a point and gigabytes."""
    if is_traced(d):
        return
    delays = as_float64("d", d)
    longest = float(np.max(delays, where=delays <= LONGEST_DELAY, initial=0.0))
    poles = degree_of(longest).poles
    if poles > MOST_POLES:
        raise InputError(
            f"d: got {longest:g}; its {poles} poles would take about {8e-6 * poles**2:.0f} MB and "
            f"{2e-9 * poles**3:.0f} s a point, and at most {MOST_POLES} are computed; zwidth.spectral_radius, "
            "decay_rate and is_stable answer for every delay at once"
        )


def _of_all_poles(kernel: Callable[..., Any], values: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]) -> Array:
    check_scalars(**dict(zip(("alpha", "beta", "delta", "d"), values, strict=True)))
    check_degree(values[3])
    static = (is_spring(values[1]),)
    return by_degree(kernel, values, static=static, chunk=companion_chunk, threads=_THREADS, few=few_poles)


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
        InputError: an argument is no real number or a scalar out of range, shapes do not broadcast,
            ``delay="fractional_power"``, or there are more than 4,000 poles: what their memory and time would be.
        TracedDelayError: d is traced.

    Numerics:
        Companion eigenvalues by LAPACK, O(degree^3) a point, of one degree less where every beta is 0; then Newton
        steps on the factored polynomial. A simple pole is right to about 1e-15 times its condition; a k-fold pole to
        about 1e-16^(1/k). Few points need no JAX; many are compiled once for every degree.

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
    xp = namespace(alpha, beta, delta, d)
    z = pole_kernel(alpha, beta, delta, d, degree, spring)
    count = xp.sum(xp.abs(z) >= 1.0, axis=-1)
    # Without stiffness a pole is at 1, whatever rounding makes of it.
    count = xp.where(alpha == 0, xp.maximum(count, 1), count)
    return xp.where(xp.isnan(z[..., 0].real), -1, count)


def radius_and_bound(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> tuple[Array, ...]:
    """The spectral radius from the poles, a bound of its error, no certificates, a status and the method."""
    values = (alpha, beta, delta, d)
    radius, error, status = _of_all_poles(_bound_kernel, values)
    return radius, error, 0 * status > 0, status, 0 * status + np.int32(Method.COMPANION)


def _bound_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, spring: bool
) -> tuple[Array, Array, Array]:
    """A pole lies within degree |P/P'| of any z. What rounding may do to P itself comes on top."""
    xp = namespace(alpha, beta, delta, d)
    poles = pole_kernel(alpha, beta, delta, d, degree, spring)
    size = xp.abs(poles)
    largest = xp.argmax(xp.where(xp.isnan(size), 0.0, size), axis=-1)[..., None]
    z = xp.take_along_axis(poles, largest, axis=-1)
    radius = xp.where(alpha == 0, xp.maximum(xp.max(size, axis=-1), 1.0), xp.max(size, axis=-1))
    plant = plant_of(delta, d, degree)
    plant = type(plant)(*(field[..., None] for field in plant))
    value, slope = (part[..., 0] for part in evaluate(z, alpha[..., None], beta[..., None], plant, degree))
    wall = (xp.abs(alpha) + xp.abs(beta)) * xp.maximum(radius, 1.0) ** 3
    rounding = 4e-16 * degree.poles * ((1.0 + radius) ** 2 * radius ** (degree.poles - 2) + wall)
    error = degree.poles * (xp.abs(value) + rounding) / xp.abs(slope) + 4e-16 * radius
    status = wall_status(alpha, beta, delta, d)
    bounded = xp.isfinite(error)
    status = xp.where((status == Status.OK) & ~bounded, np.int32(Status.NOT_CONVERGED), status)
    return radius, xp.where(xp.isnan(radius), np.nan, xp.where(bounded, error, np.inf)), status
