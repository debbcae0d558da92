"""Z-width as a number: the area of the stable walls in the (alpha, beta) plane."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import pointwise
from zwidth.loop import FrequencyLoop, frequency_boundary, frequency_loop, line_at_minus_one, poison, valid_device
from zwidth.stability.curve import lobe_end

# Gauss-Legendre nodes on a half of the lobe.
_NODES = 48
# Where the lobe may be cut by the line of real poles it is sampled this often, then bisected.
_SAMPLES, _BISECTIONS = 256, 52
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
