"""Which virtual damping to choose for a stiffness: the fastest-settling, and the most robust one (rigid loop)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.arrays.batching import elementwise, pointwise, to_caller
from zwidth.arrays.minimize import Cost, lowest, without_slope
from zwidth.arrays.xp import frozen, is_traced, namespace
from zwidth.loops.domain import device_status, void
from zwidth.loops.rigid.curve import column, lobe, peak
from zwidth.loops.rigid.degrees import Degree, map_by_degree
from zwidth.loops.rigid.delay_classes import Kind, classify_delays
from zwidth.loops.rigid.modulus import margin_kernel
from zwidth.loops.rigid.poles import companion_chunk, radius_kernel
from zwidth.loops.rigid.verdict import is_stable
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike

# Samples across a column, how many of their dips are refined, and by how many steps of golden section.
_COLUMN = {"samples": 66, "dips": 3, "steps": 52}
# The same across the stiffnesses of the fastest wall, of which rounding leaves fewer digits.
_WALL = {"samples": 24, "dips": 1, "steps": 36}
# Eigenvalues of two batches at one time were seen to wait for each other for ever.
_THREADS = 1
_NAMES = ("alpha", "delta", "d")
# Batches of few points are filled up to share a compilation.
_CHUNK, _LEAST = 1 << 10, 1 << 3


class DampingChoice(NamedTuple):
    """A virtual damping, what it achieves, and a `zwidth.Status`."""

    beta: Array
    achieved: Array
    status: Array


def fastest_damping(alpha: ArrayLike, delta: ArrayLike, d: ArrayLike) -> DampingChoice:
    """Find the virtual damping with which a wall of this stiffness settles fastest.

    The beta of the smallest spectral radius, ``min over beta of max |z|``, among the stable ones.

    Args:
        alpha: normalized stiffness K T^2/m, > 0.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not (held); concrete also inside `jit`. All three broadcast.

    Returns:
        DampingChoice: ``beta``; ``achieved``, the spectral radius; ``status``, NO_BOUNDARY with NaN where no beta is
        stable.

    Raises:
        TracedDelayError: d is traced.

    Numerics:
        The optimum is usually a kink, where poles meet on the real axis or another takes over: sampled across the
        stable interval, then golden section round the lowest dips. The radius is right to about 1e-8, the accuracy of
        a double pole. Traceable in alpha and delta, with NaN for derivatives: at a kink there are none.

    References:
        Hulin, Preusche, Hirzinger 2006, section VIII.

    Example:
        >>> from zwidth import fastest_damping
        >>> choice = fastest_damping(0.1, 0.0, 0)
        >>> print(f"{choice.beta:.3f} {choice.achieved:.3f}")
        0.452 0.609
    """
    inputs = (alpha, delta, d)
    lower, upper, status = elementwise(_column_kernel, _NAMES, inputs, (classify_delays(d),))
    found = map_by_degree(
        _fastest_kernel,
        (alpha, lower, upper, delta, d),
        names=("alpha", "lower", "upper", "delta", "d"),
        chunk=companion_chunk,
        least=_LEAST,
        threads=_THREADS,
    )
    return _answer(found, found[1] < 1.0, status, inputs)


def _fastest_kernel(
    alpha: Array, lower: Array, upper: Array, delta: Array, d: Array, degree: Degree
) -> tuple[Array, Array]:
    cost = _radius_over(alpha, delta, d, degree)
    return lowest(cost, lower, upper, **_COLUMN)[:2]


def _radius_over(alpha: Array, delta: Array, d: Array, degree: Degree) -> Cost:
    """The spectral radius as a function of the virtual damping."""

    def cost(betas: Array) -> tuple[Array, tuple]:
        a, b, x, y = jnp.broadcast_arrays(alpha, betas, delta, d)
        return radius_kernel(a, b, x, y, degree), ()

    return cost


def most_robust_damping(alpha: ArrayLike, delta: ArrayLike, d: ArrayLike) -> DampingChoice:
    """Find the virtual damping with the largest stability margin for a wall of this stiffness.

    ``max over beta of min over omega |1 + L(e^(j omega))|``, see `zwidth.modulus_margin`: the loop that bears
    the largest unknown multiplicative change of its inverse at every frequency.

    Args:
        alpha, delta, d: as for `fastest_damping`.

    Returns:
        DampingChoice: ``beta``; ``achieved``, the modulus margin, right to about 1e-12 and returned only where
        `zwidth.is_stable` finds the wall stable; ``status`` as for `fastest_damping`.

    References:
        Landau 1990 (modulus margin).

    Example:
        >>> from zwidth import most_robust_damping
        >>> choice = most_robust_damping(0.1, 0.0, 0)
        >>> 0 < choice.achieved < 1
        np.True_
    """
    inputs = (alpha, delta, d)
    lower, upper, status = elementwise(_column_kernel, _NAMES, inputs, (classify_delays(d),))
    names = ("alpha", "lower", "upper", "delta", "d")
    found = pointwise(_robust_kernel, names, (alpha, lower, upper, delta, d), (), _CHUNK, least=_LEAST)
    # The margin says nothing of the side of the boundary.
    return _answer(found, is_stable(alpha, found[0], delta, d), status, inputs)


def _robust_kernel(alpha: Array, lower: Array, upper: Array, delta: Array, d: Array) -> tuple[Array, Array]:
    def cost(betas: Array) -> tuple[Array, tuple[()]]:
        return -margin_kernel(*jnp.broadcast_arrays(alpha, betas, delta, d)), ()

    beta, achieved, _ = lowest(cost, lower, upper, **_COLUMN)
    return beta, -achieved


def _column_kernel(alpha: Array, delta: Array, d: Array, kind: Kind) -> tuple[Array, Array, Array]:
    """The ends of the stable dampings, and a status."""
    xp = namespace(alpha, delta, d)
    alpha, delta, d = frozen((alpha, delta, d), xp)
    curve, status = lobe(delta, d, "held", kind), device_status(delta, d)
    lower, upper, exists = column(alpha, curve, peak(curve, "held", kind))
    status = xp.where((status == Status.OK) & ~exists, int(Status.NO_BOUNDARY), status)
    status = xp.where(xp.isfinite(alpha), status, int(Status.INVALID_INPUT))
    return lower, upper, status.astype(np.int32)


def _answer(found: tuple[Array, Array], good: Array, status: Array, inputs: tuple[ArrayLike, ...]) -> DampingChoice:
    """NaN where the status is not 0, or where the answer turned out not to be stable."""
    traced = is_traced(*inputs)
    xp = jnp if traced else np
    status = xp.where((status == Status.OK) & ~xp.asarray(good), Status.NO_BOUNDARY, xp.asarray(status)).astype(
        np.int32
    )
    beta, achieved = (xp.where(status == Status.OK, xp.asarray(value), np.nan) for value in found)
    if traced:
        beta, achieved = without_slope((beta, achieved), inputs)
        return DampingChoice(beta, achieved, status)
    return to_caller(DampingChoice(beta, achieved, status), inputs)


class FastestWall(NamedTuple):
    """The fastest-settling wall of a device."""

    alpha: Array
    beta: Array
    spectral_radius: Array
    status: Array


def fastest_wall(delta: ArrayLike, d: ArrayLike) -> FastestWall:
    """Find the wall, stiffness and damping, with which the loop settles fastest.

    ``min over (alpha, beta) of max |z|``: after k periods a disturbance has decayed to about ``spectral_radius^k``.

    Args:
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not (held); concrete also inside `jit`. Both broadcast.

    Returns:
        FastestWall of the broadcast shape: ``alpha``, ``beta``, ``spectral_radius``, ``status``; NaN where the status
        is not 0.

    Raises:
        TracedDelayError: d is traced.

    Numerics:
        A search over alpha, each step of which is that of `fastest_damping`. Several poles meet at the optimum: the
        radius is right to about 1e-5 (what float64 knows of a triple pole), alpha and beta to about 1e-3. About
        13,000 pole computations a device. Traceable in delta, with NaN for derivatives.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> from zwidth import fastest_wall
        >>> wall = fastest_wall(0.0, 0)
        >>> print(f"{wall.alpha:.2f} {wall.beta:.2f} {wall.spectral_radius:.2f}")
        0.07 0.41 0.59
    """
    return map_by_degree(_wall_kernel, (delta, d), names=("delta", "d"), chunk=companion_chunk, threads=_THREADS)


def _wall_kernel(delta: Array, d: Array, degree: Degree) -> FastestWall:
    kind = Kind(degree.whole == 0, degree.whole > 0, degree.fractional)
    curve = frozen(lobe(delta, d, "held", kind), jnp)
    top = peak(curve, "held", kind)
    status = device_status(delta, d)

    def best_damping(alpha: Array) -> tuple[Array, Array]:
        lower, upper, exists = column(alpha, curve, top)
        beta, radius, _ = lowest(_radius_over(alpha, delta, d, degree), lower, upper, **_COLUMN)
        # Without stiffness, and on the ridge, a pole is on the circle.
        return jnp.where(exists, radius, 1.0), beta

    alpha, radius, beta = lowest(jax.vmap(best_damping), jnp.zeros_like(delta), top.alpha, **_WALL)
    alpha, beta, radius = without_slope(void(status == Status.OK, alpha, beta, radius), (delta, d))
    return FastestWall(alpha, beta, radius, status.astype(jnp.int32))
