"""Z-width as a number: the area of the stable and of the passive walls in the (alpha, beta) plane."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import broadcast, is_traced, pointwise, to_caller
from zwidth.errors import TracedDelayError
from zwidth.loop import FrequencyLoop, frequency_boundary, frequency_loop, line_at_minus_one, poison, valid_device
from zwidth.stability.curve import lobe_end
from zwidth.stability.passivity import passivity_margin

# Gauss-Legendre nodes: on a half of the lobe, and on a panel of the passive set's outline.
_NODES, _PANEL_NODES = 48, 12
# Where the lobe may be cut by the line of real poles it is sampled this often, then bisected.
_SAMPLES, _BISECTIONS = 256, 52
_SHORTEST_PANEL, _PANEL_TOLERANCE = 1e-11, 1e-13
_CHUNK, _LEAST = 1 << 10, 1 << 4


def stable_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the stable set in the (alpha, beta) plane.

    ``A = -integral of beta d(alpha)`` along the lobe of `zwidth.boundary`, closed by the line on which a real pole
    crosses at z = -1, where that line cuts it, and by alpha = 0. In SI units the area over K and B is ``A m^2/T^3``.

    Args:
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not (held). Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.

    Numerics:
        Gauss-Legendre quadrature of the closed form, about 1e-12. Traceable, with first derivatives: the area does
        not change to first order when the ends of the lobe move, so they count as fixed. Relies on the stable set
        being one lobe cut by one line, as `zwidth.stable_region` verifies by counting poles.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> from zwidth.design import stable_area
        >>> print(f"{stable_area(0.0, 0):.4f}")
        0.9096
    """
    return pointwise(_stable_area_kernel, ("delta", "d"), (delta, d), chunk=_CHUNK, fused=False, least=_LEAST)


def _stable_area_kernel(delta: Array, d: Array) -> Array:
    ok = valid_device(delta, d)
    safe_delta, safe_d = jnp.where(ok, delta, 1.0), jnp.where(ok, d, 1.0)
    loop = frequency_loop(safe_delta, safe_d, "held")
    limit = line_at_minus_one(safe_delta, safe_d)
    end = jax.lax.stop_gradient(_end_of_lobe(loop, safe_delta, safe_d, limit))
    last = frequency_boundary(end, loop, "held")
    # The way back to alpha = 0: level if the lobe ends there, else along alpha + 2 beta = const.
    on_line = last.alpha > 1e-9 * jnp.abs(last.beta)
    back = last.alpha * (last.beta + jnp.where(on_line, 0.25 * last.alpha, 0.0))
    return back - _under_lobe(loop, end) + poison(ok, delta, d)


def _under_lobe(loop: FrequencyLoop, end: Array) -> Array:
    """The integral of beta d(alpha) over the lobe, by Gauss-Legendre on its two halves."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    half = np.concatenate([0.25 * (node + 1.0), 0.5 + 0.25 * (node + 1.0)])
    omega = end * jnp.asarray(half, end.dtype)

    def integrand(omega: Array) -> Array:
        wall, change = jax.jvp(lambda w: tuple(frequency_boundary(w, loop, "held")), (omega,), (jnp.ones_like(omega),))
        return wall[1] * change[0]

    return jnp.sum(jax.vmap(integrand)(omega) * jnp.asarray(np.tile(0.25 * weight, 2), end.dtype)) * end


def _end_of_lobe(loop: FrequencyLoop, delta: Array, d: Array, limit: Array) -> Array:
    """Where the lobe returns to alpha = 0 or first meets the line alpha + 2 beta = ``limit``."""
    end = lobe_end(loop, d, "held")
    finite = jnp.isfinite(limit)
    level = jnp.where(finite, limit, 0.0)
    # The lobe starts on the stable side, at alpha + 2 beta = -2 delta.
    side = jnp.sign(level + 2.0 * delta)

    def room(omega: Array) -> Array:
        wall = frequency_boundary(omega, loop, "held")
        return (level - wall.alpha - 2.0 * wall.beta) * side

    # At omega = pi the curve touches the line: rounding there is no crossing.
    grid = end * jnp.linspace(0.0, 1.0 - 1e-6, _SAMPLES, dtype=end.dtype)[1:]
    beyond = (jax.vmap(room)(grid) < 0) & finite
    first = jnp.argmax(beyond)
    low, high = jnp.where(first > 0, grid[jnp.maximum(first - 1, 0)], 0.0), grid[first]

    def halve(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        inside = room(middle) >= 0
        return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

    low, high = jax.lax.fori_loop(0, _BISECTIONS, halve, (low, high))
    return jnp.where(jnp.any(beyond), 0.5 * (low + high), end)


def passive_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the passive set in the (alpha, beta) plane.

    The condition is convex and homogeneous in (alpha, beta, delta): with ``needed(phi)`` the physical damping that
    the wall ``(cos phi, sin phi)`` needs, ``A = (delta^2/2) integral of needed(phi)^-2`` over phi from -pi/2 to pi/2.
    At d = 0 it is the triangle ``delta > alpha/2 + |beta|``: ``A = 2 delta^2``.

    Args:
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held); concrete also inside `jit`. Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range.

    Raises:
        InputError: an argument is no real number, or shapes do not broadcast.
        TracedDelayError: d is traced.

    Numerics:
        Adaptive quadrature on the host, once for each different d: about 1e-10 relative.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> from zwidth.design import passive_area
        >>> print(f"{passive_area(0.5, 0):.4f}")
        0.5000
    """
    if is_traced(d):
        raise TracedDelayError("d: got a traced value, but the number of frequencies depends on it; pass a number")
    if is_traced(delta):
        _, delays = broadcast(("delta", "d"), (0.0, d))
        constant = jnp.asarray(_passive_constants(delays), jnp.result_type(float))
        return jnp.where(delta >= 0, delta * delta, jnp.nan) * constant
    deltas, delays = broadcast(("delta", "d"), (delta, d))
    squared = np.where(np.isfinite(deltas) & (deltas >= 0), deltas, np.nan) ** 2
    return to_caller(squared * _passive_constants(delays), (delta, d))


def _passive_constants(delays: np.ndarray) -> np.ndarray:
    """The area at delta = 1 for every delay."""
    different, place = np.unique(delays, return_inverse=True)
    usable = np.isfinite(different) & (different >= 0)
    areas = [_passive_constant(float(d)) if good else np.nan for d, good in zip(different, usable, strict=True)]
    return np.asarray(areas)[place].reshape(delays.shape)


def _passive_constant(d: float) -> float:
    def inverse_square(phi: np.ndarray) -> np.ndarray:
        # Colgate's condition knows no sign of alpha; the straight edge alpha = 0 is the range of phi.
        margin = passivity_margin(np.maximum(np.cos(phi), 0.0), np.sin(phi), 1.0, d)
        return (1.0 - np.asarray(margin)) ** -2

    return 0.5 * adaptive_integral(inverse_square, -0.5 * np.pi, 0.5 * np.pi)


def adaptive_integral(function: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> float:
    """Integrate a function with kinks: panels on which halving changes the result are halved, all at once."""
    node, weight = np.polynomial.legendre.leggauss(_PANEL_NODES)

    def panels(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        half = 0.5 * (right - left)
        points = (0.5 * (left + right))[:, None] + half[:, None] * node
        return (function(points.ravel()).reshape(points.shape) @ weight) * half

    edges = np.linspace(low, high, 17)
    left, right = edges[:-1], edges[1:]
    coarse, total = panels(left, right), 0.0
    while left.size:
        middle = 0.5 * (left + right)
        lower, upper = panels(left, middle), panels(middle, right)
        fine = lower + upper
        done = (np.abs(fine - coarse) <= _PANEL_TOLERANCE * (abs(total) + fine.sum())) | (
            right - left < _SHORTEST_PANEL
        )
        total += float(fine[done].sum())
        keep = ~done
        left, right = np.concatenate([left[keep], middle[keep]]), np.concatenate([middle[keep], right[keep]])
        coarse = np.concatenate([lower[keep], upper[keep]])
    return total
