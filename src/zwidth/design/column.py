"""The stable dampings of one stiffness, for kernels of one point: a column of the (alpha, beta) plane.

The stable set is taken as one lobe of the boundary curve, cut by the line on which a real pole crosses at z = -1, as
found by counting poles (see `zwidth.stability.row_limit`). The curve's alpha rises up to the ridge and falls behind it,
so that a column meets it once on either side.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from zwidth._types import Array
from zwidth.loop import FrequencyLoop, frequency_boundary, frequency_loop, tilt_at_minus_one
from zwidth.stability.curve import corner

# Each halves the bracket of a frequency: one unit in the last place is left.
_BISECTIONS = 52


class Lobe(NamedTuple):
    """What all columns of one device share: the curve, its ridge, and what lies behind it."""

    loop: FrequencyLoop
    alpha: Array
    omega: Array
    beyond: Array  # a frequency at which the curve has left the lobe
    returns: Array  # whether it does so by returning to alpha = 0, and not at omega = pi
    tilt: Array  # P(-1) has the stable sign where tilt (alpha + 2 beta) < 1


class Column(NamedTuple):
    """The lowest and the highest stable damping, and whether there is any."""

    lower: Array
    upper: Array
    exists: Array


def lobe(delta: Array, d: Array, alpha: Array, omega: Array) -> Lobe:
    """The lobe of a device with a held delay, from its ridge ``(alpha, omega)``; no derivative passes through."""
    delta, d, alpha, omega = jax.lax.stop_gradient((delta, d, alpha, omega))
    loop = frequency_loop(delta, d, "held")
    returns = ~corner(loop).reached
    tilt = tilt_at_minus_one(loop.plant, loop.lag)
    return Lobe(loop, alpha, omega, jnp.where(returns, jnp.minimum(jnp.pi, jnp.pi / (d + 0.5)), jnp.pi), returns, tilt)


def column(alpha: Array, lobe: Lobe) -> Column:
    """The stable dampings at one stiffness."""
    alpha = jax.lax.stop_gradient(alpha)
    inner = jnp.stack([jnp.zeros_like(lobe.omega), lobe.beyond])
    outer = jnp.stack([lobe.omega, lobe.omega])

    def halve(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        """Before the ridge and behind it at once; ``inner`` stays below the stiffness, ``outer`` above."""
        inner, outer, _ = state
        middle = 0.5 * (inner + outer)
        wall = jax.vmap(lambda omega: frequency_boundary(omega, lobe.loop, "held"))(middle)
        below = wall.alpha < alpha
        return jnp.where(below, middle, inner), jnp.where(below, outer, middle), wall.beta

    found, _, beta = jax.lax.fori_loop(0, _BISECTIONS, halve, (inner, outer, inner))
    # Where the curve ends at omega = pi above this stiffness, the line alone bounds the column.
    upper = jnp.where(lobe.returns | (found[1] < lobe.beyond), beta[1], jnp.inf)
    on_line = 0.5 * (1.0 / jnp.where(lobe.tilt == 0, 1.0, lobe.tilt) - alpha)
    upper = jnp.where(lobe.tilt > 0, jnp.minimum(upper, on_line), upper)
    lower = jnp.where(lobe.tilt < 0, jnp.maximum(beta[0], on_line), beta[0])
    exists = (alpha > 0) & (alpha < lobe.alpha) & (lower < upper) & jnp.isfinite(upper)
    return Column(lower, upper, exists)
