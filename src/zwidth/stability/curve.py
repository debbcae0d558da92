"""Geometry of the boundary curve of one (delta, d): where its lobe ends, and its corner at z = -1.

The curve starts at (0, -delta), omega = 0, and bounds the stable set until it returns to alpha = 0 or, for short
delays and strong damping, until omega = pi, where a double pole sits at z = -1 (the corner).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from zwidth._types import Array
from zwidth.loop import FrequencyLoop, frequency_boundary
from zwidth.stability.bracketing import bisect


class Corner(NamedTuple):
    """The wall with a double pole at z = -1, and whether it is the stiffest stable one."""

    alpha: Array
    beta: Array
    reached: Array
    is_ridge: Array


def corner(loop: FrequencyLoop) -> Corner:
    """Solve P(-1) = P'(-1) = 0, linear in (alpha, beta), and decide whether the ridge sits there.

    On z = -e^s, s = -j (pi - omega), the curve is ``alpha = 2 tan(omega/2) Im E`` with
    ``E(s) = (-1)^(n+1) e^(s (n+2)) (e^s + c)/N(-e^s)``, real for real s. With E1, E3 the first and third derivative
    at s = 0, ``alpha = -4 E1 + (2 E3 + E1) v^2/3 + ...``: the curve reaches omega = pi as part of the stable set's
    edge when alpha stays positive, and has a maximum there when ``2 E3 + E1 < 0``. Both come from those of log E.
    Only n = 0 reaches omega = pi on the first lobe, so the sign (-1)^(n+1) is -1.
    """
    plant = loop.plant
    # Where N(-1) is not clearly positive there is no corner, and nothing below may overflow: its derivative would
    # be NaN and spoil the branch that is chosen instead.
    usable = plant.gap > 1e-9 * plant.a2
    gap = jnp.where(usable, plant.gap, 1.0)
    sigma = 1.0 / (1.0 + plant.c)
    q1, q2, q3 = ((m * plant.a2 - plant.a1) / gap for m in (2.0, 4.0, 8.0))
    log1 = 2.0 + sigma - q1
    log2 = sigma * (1.0 - sigma) - (q2 - q1 * q1)
    log3 = sigma * (1.0 - sigma) * (1.0 - 2.0 * sigma) - (q3 - 3.0 * q1 * q2 + 2.0 * q1**3)
    e0 = -(1.0 + plant.c) / gap
    alpha = -4.0 * e0 * log1
    beta = -e0 - 0.5 * alpha
    reached = usable & (loop.lag == 0) & (plant.a2 > plant.a0) & (log1 > 0)
    # e0 < 0: 2 E3 + E1 < 0 exactly where this is positive.
    curvature = 2.0 * (log1**3 + 3.0 * log1 * log2 + log3) + log1
    return Corner(alpha, beta, reached, reached & (curvature >= 0))


def lobe_limit(d: Array) -> Array:
    """A frequency beyond the end of the lobe: its phase exceeds pi there for every delta."""
    return jnp.minimum(jnp.pi, jnp.pi / (d + 0.5))


def lobe_end(loop: FrequencyLoop, d: Array, delay: str) -> Array:
    """The frequency at which the curve first returns to alpha = 0, pi where it does not before."""
    limit = lobe_limit(d)
    # Away from 0 itself, where alpha = 0 too.
    end, found = bisect(lambda omega, loop: frequency_boundary(omega, loop, delay).alpha, 1e-6 * limit, limit, loop)
    return jnp.where(found & ~corner(loop).reached, end, jnp.pi)
