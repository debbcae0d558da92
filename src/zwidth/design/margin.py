"""The modulus margin: how closely the Nyquist curve of the loop passes the point -1."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import as_float64, is_traced, pointwise
from zwidth.errors import TracedDelayError
from zwidth.loop import FrequencyLoop, frequency_loop, poison, valid_wall
from zwidth.stability.golden import golden_section

# How many of the lowest samples are refined, and by how many steps of golden section.
_DIPS, _REFINEMENTS = 3, 45


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
        >>> from zwidth.design import modulus_margin
        >>> print(f"{modulus_margin(0.1, 0.2, 0.1, 0):.4f}")
        0.5898
    """
    samples = frequency_count(d)
    names = ("alpha", "beta", "delta", "d")
    return pointwise(margin_kernel, names, (alpha, beta, delta, d), (samples,), max(1, (1 << 19) // samples))


def frequency_count(d: ArrayLike) -> int:
    """Samples on either grid, enough for the longest delay; a power of two, so that few counts are compiled."""
    if is_traced(d):
        raise TracedDelayError("d: got a traced value, but the number of frequencies depends on it; pass a number")
    delays = as_float64("d", d)
    longest = np.max(delays, initial=0.0, where=np.isfinite(delays))
    return 1 << int(np.ceil(np.log2(8.0 * (longest + 3.0))))


def margin_kernel(alpha: Array, beta: Array, delta: Array, d: Array, samples: int) -> Array:
    """`modulus_margin` of one point."""
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

    low, high = golden_section(jax.vmap(distance), low, high, _REFINEMENTS)
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
