"""Which virtual damping to choose for a wanted stiffness: the fastest-settling, and the most robust one."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import as_float64, broadcast, is_traced, pointwise, to_caller
from zwidth.errors import TracedDelayError
from zwidth.loop import FrequencyLoop, frequency_loop, poison, valid_wall
from zwidth.stability.boundary import boundary_point
from zwidth.stability.poles import radius_by_companion
from zwidth.stability.ridge import alpha_max
from zwidth.status import Status

# Samples across an interval, how many of its dips are refined, and by how many steps of golden section.
_SAMPLES, _DIPS, _REFINEMENTS = 65, 3, 45
# The search over the stiffness of the fastest wall: samples a round, and rounds.
_ROUND, _ROUNDS = 17, 9
_GOLDEN = 0.6180339887498949

Cost = Callable[[np.ndarray], np.ndarray]


def modulus_margin(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return how closely the Nyquist curve of the loop passes the point -1.

    ``min over omega of |1 + L(e^(j omega))|``, with ``L = N(z) (alpha z + beta (z - 1))/(z^(2+n) (z - 1)(z - c))``; the
    inverse of the largest sensitivity. A margin in the sense of robustness only where the wall is stable.

    Args:
        alpha: normalized stiffness, > 0.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held); concrete also inside `jit`. All four broadcast.

    Returns:
        Array of the broadcast shape, between 0 (a pole on the unit circle) and 1; NaN out of range.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.
        TracedDelayError: d is traced.

    Numerics:
        Sampled on a linear and a logarithmic grid, the lowest dips refined by golden section: about 1e-14.

    References:
        Landau 1990 (modulus margin); Hulin, Preusche, Hirzinger 2006, eq. (15) for the loop.

    Example:
        >>> from zwidth.design.damping import modulus_margin
        >>> print(f"{modulus_margin(0.1, 0.2, 0.1, 0):.4f}")
        0.5898
    """
    if is_traced(d):
        raise TracedDelayError("d: got a traced value, but the number of frequencies depends on it; pass a number")
    delays = as_float64("d", d)
    longest = np.max(delays, initial=0.0, where=np.isfinite(delays))
    samples = 1 << int(np.ceil(np.log2(8.0 * (longest + 3.0))))
    names = ("alpha", "beta", "delta", "d")
    return pointwise(_margin_kernel, names, (alpha, beta, delta, d), (samples,), max(1, (1 << 19) // samples))


def _margin_kernel(alpha: Array, beta: Array, delta: Array, d: Array, samples: int) -> Array:
    ok = valid_wall(alpha, beta, delta, d) & (alpha > 0)
    inputs = (alpha, beta, delta, d)
    alpha, beta, delta, d = (jnp.where(ok, value, 1.0) for value in inputs)
    loop = frequency_loop(delta, d, "held")

    def distance(omega: Array) -> Array:
        return distance_to_critical(omega, alpha, beta, loop)

    # Slow loops cross over near alpha/delta or sqrt(alpha): below a fraction of that |L| is large.
    lowest = 0.02 * alpha / (delta + jnp.sqrt(alpha) + alpha)
    part = jnp.arange(1, samples + 1, dtype=alpha.dtype) / samples
    grid = jnp.sort(jnp.concatenate([lowest * (jnp.pi / lowest) ** part, jnp.pi * part]))
    values = jax.vmap(distance)(grid)
    padded = jnp.pad(values, 1, constant_values=jnp.inf)
    is_dip = (values <= padded[:-2]) & (values <= padded[2:])
    _, best = jax.lax.top_k(jnp.where(is_dip, -values, -jnp.inf), _DIPS)
    low, high = grid[jnp.maximum(best - 1, 0)], grid[jnp.minimum(best + 1, 2 * samples - 1)]

    def shrink(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        width = _GOLDEN * (high - low)
        inside = jnp.stack([high - width, low + width])
        left, right = jax.vmap(jax.vmap(distance))(inside)
        return jnp.where(left < right, low, inside[0]), jnp.where(left < right, inside[1], high)

    low, high = jax.lax.fori_loop(0, _REFINEMENTS, shrink, (low, high))
    refined = jax.vmap(distance)(0.5 * (low + high))
    return jnp.minimum(jnp.min(refined), jnp.min(values)) + poison(ok, *inputs)


def distance_to_critical(omega: Array, alpha: Array, beta: Array, loop: FrequencyLoop) -> Array:
    """|1 + L| at one frequency in (0, pi]; every factor of L is formed without cancellation."""
    plant, whole = loop
    s, sin_w = jnp.sin(0.5 * omega), jnp.sin(omega)
    # M = N(z)/z and (z - 1)(z - c)
    cos_half = jnp.cos(0.5 * omega)
    m = jax.lax.complex(-plant.gap + 2.0 * (plant.a2 + plant.a0) * cos_half * cos_half, (plant.a2 - plant.a0) * sin_w)
    step = jax.lax.complex(-2.0 * s * s, sin_w)
    wall = jax.lax.complex(alpha + 2.0 * beta * s * s, beta * sin_w)
    lag = jax.lax.complex(jnp.cos(whole * omega), -jnp.sin(whole * omega))
    return jnp.abs(1.0 + lag * m * wall / (step * (step + plant.em)))


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
        d: delay in periods, >= 0, whole or not (held). All three broadcast; none may be traced.

    Returns:
        DampingChoice: ``beta``; ``achieved``, the spectral radius; ``status``, NO_BOUNDARY with NaN where no beta is
        stable.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.
        TracedDelayError: an argument is traced.

    Numerics:
        The optimum is usually a kink, where a pole pair meets on the real axis or another pole takes over: sampled
        across the stable interval, then golden section round the lowest dips. The radius is right to about 1e-8, the
        accuracy of a double pole.

    References:
        Hulin, Preusche, Hirzinger 2006, section VIII.

    Example:
        >>> from zwidth.design import fastest_damping
        >>> choice = fastest_damping(0.1, 0.0, 0)
        >>> print(f"{choice.beta:.3f} {choice.achieved:.3f}")
        0.452 0.609
    """
    return _best_damping(
        lambda beta, point: np.asarray(radius_by_companion(point[0], beta, *point[1:])), alpha, delta, d
    )


def most_robust_damping(alpha: ArrayLike, delta: ArrayLike, d: ArrayLike) -> DampingChoice:
    """Find the virtual damping with the largest stability margin for a wall of this stiffness.

    ``max over beta of min over omega |1 + L(e^(j omega))|``, see `zwidth.design.modulus_margin`: the loop that bears
    the largest unknown multiplicative change of its inverse at every frequency.

    Args:
        alpha: normalized stiffness K T^2/m, > 0.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not (held). All three broadcast; none may be traced.

    Returns:
        DampingChoice: ``beta``; ``achieved``, the modulus margin; ``status``, NO_BOUNDARY with NaN where no beta is
        stable.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.
        TracedDelayError: an argument is traced.

    Numerics:
        As `fastest_damping`; the margin is right to about 1e-12.

    References:
        Landau 1990 (modulus margin).

    Example:
        >>> from zwidth.design import most_robust_damping
        >>> choice = most_robust_damping(0.1, 0.0, 0)
        >>> 0 < choice.achieved < 1
        np.True_
    """
    return _best_damping(
        lambda beta, point: -np.asarray(modulus_margin(point[0], beta, *point[1:])), alpha, delta, d, -1.0
    )


def _best_damping(
    cost: Callable[[np.ndarray, list[np.ndarray]], np.ndarray],
    alpha: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    sign: float = 1.0,
) -> DampingChoice:
    """Minimize over the stable beta of every point; ``achieved`` is ``sign`` times the cost."""
    if is_traced(alpha, delta, d):
        raise TracedDelayError("alpha, delta, d: got a traced value; this search runs on the host, pass numbers")
    arrays = broadcast(("alpha", "delta", "d"), (alpha, delta, d))
    columns = [array.ravel() for array in arrays]
    lower, upper, status = _stable_interval(*columns)
    good = np.flatnonzero(status == Status.OK)
    beta, achieved = np.full(lower.shape, np.nan), np.full(lower.shape, np.nan)
    if good.size:
        point = [column[good, None] for column in columns]
        beta[good], value = minimize_rows(lambda x: cost(x, point), lower[good], upper[good])
        achieved[good] = sign * value
    result = DampingChoice(*(part.reshape(arrays[0].shape) for part in (beta, achieved, status)))
    return to_caller(result, (alpha, delta, d))


def _stable_interval(alpha: np.ndarray, delta: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, ...]:
    """The ends of the stable beta of a column, with a status."""
    low = boundary_point(delta, d, alpha=alpha, side="lower")
    high = boundary_point(delta, d, alpha=alpha, side="upper")
    status = np.maximum(np.asarray(low.status), np.asarray(high.status)).astype(np.int32)
    inside = np.isfinite(alpha) & (alpha > 0)
    status = np.where(np.isfinite(alpha) & ~inside, Status.NO_BOUNDARY, status).astype(np.int32)
    return np.asarray(low.beta), np.asarray(high.beta), status


def minimize_rows(cost: Cost, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimize ``cost`` on every interval: samples, then golden section round the lowest dips. (x, cost), a row each.

    ``cost`` takes an array of shape (rows, k), k trial values a row.
    """
    part = np.linspace(0.0, 1.0, _SAMPLES + 1)
    grid = lower[:, None] + (upper - lower)[:, None] * part
    # Every call has as many columns as golden section needs: one shape, hence one compilation.
    columns = 2 * _DIPS
    values = np.concatenate([cost(grid[:, i : i + columns]) for i in range(0, _SAMPLES + 1, columns)], axis=1)
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=np.inf)
    dips = np.where((values <= padded[:, :-2]) & (values <= padded[:, 2:]), values, np.inf)
    best = np.argsort(dips, axis=1, kind="stable")[:, :_DIPS]
    low = np.take_along_axis(grid, np.maximum(best - 1, 0), axis=1)
    high = np.take_along_axis(grid, np.minimum(best + 1, _SAMPLES), axis=1)
    for _ in range(_REFINEMENTS):
        width = _GOLDEN * (high - low)
        both = cost(np.concatenate([high - width, low + width], axis=1))
        keep_left = both[:, :_DIPS] < both[:, _DIPS:]
        low, high = np.where(keep_left, low, high - width), np.where(keep_left, low + width, high)
    candidates = np.concatenate([0.5 * (low + high), np.take_along_axis(grid, best, axis=1)], axis=1)
    reached = cost(candidates)
    index = np.argmin(reached, axis=1)[:, None]
    return np.take_along_axis(candidates, index, axis=1)[:, 0], np.take_along_axis(reached, index, axis=1)[:, 0]


class FastestWall(NamedTuple):
    """The fastest-settling wall of a device."""

    alpha: Array
    beta: Array
    spectral_radius: Array
    status: Array


def fastest_wall(delta: float, d: float) -> FastestWall:
    """Find the wall, stiffness and damping, with which the loop settles fastest.

    ``min over (alpha, beta) of max |z|``: after k periods a disturbance has decayed to about ``spectral_radius^k``.

    Args:
        delta: normalized physical damping b T/m, >= 0, a single number.
        d: delay in periods, >= 0, a single number.

    Returns:
        FastestWall: ``alpha``, ``beta``, ``spectral_radius``, ``status``; NaN where the status is not 0.

    Raises:
        InputError: an argument is no real number.

    Numerics:
        A search over alpha, each step of which is `fastest_damping`. Several poles meet at the optimum: the radius is
        right to about 1e-5 (what float64 knows of a triple pole), alpha and beta to about 1e-3.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> from zwidth.design import fastest_wall
        >>> wall = fastest_wall(0.0, 0)
        >>> print(f"{wall.alpha:.2f} {wall.beta:.2f} {wall.spectral_radius:.2f}")
        0.07 0.41 0.59
    """
    ridge = alpha_max(delta, d)
    if np.ndim(ridge.alpha) != 0 or ridge.status != Status.OK:
        status = ridge.status if np.ndim(ridge.alpha) == 0 else np.int32(Status.INVALID_INPUT)
        return FastestWall(np.float64(np.nan), np.float64(np.nan), np.float64(np.nan), status)
    low, high = 0.0, float(ridge.alpha)
    best: tuple[float, float, float] = (np.inf, np.nan, np.nan)
    for _ in range(_ROUNDS):
        trials = np.linspace(low, high, _ROUND + 2)[1:-1]
        choice = fastest_damping(trials, float(delta), float(d))
        reached = np.where(np.isnan(choice.achieved), np.inf, choice.achieved)
        index = int(np.argmin(reached))
        best = min(best, (float(reached[index]), float(trials[index]), float(choice.beta[index])))
        width = (high - low) / (_ROUND + 1)
        low, high = max(trials[index] - width, 0.0), min(trials[index] + width, float(ridge.alpha))
    return FastestWall(np.float64(best[1]), np.float64(best[2]), np.float64(best[0]), ridge.status)
