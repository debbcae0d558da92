"""Z-width: the area of the passive walls in the (alpha, beta) plane (rigid loop).

In the direction ``alpha = cos(theta)/(d + 1/2)``, ``beta = sin(theta)`` the damping that a wall needs is decided

    at omega = 0                       for theta < theta1,
    at one omega that rises with theta for theta1 < theta < theta2,
    at omega = pi                      for theta > theta2, which happens for d < 2/9 only

(`loops.rigid.needed_damping`). It passes from one to the next without a jump (for d = 0 all at once), and between
them it is analytic in theta.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zwidth.arrays.evaluate import evaluate
from zwidth.arrays.xp import along, frozen, namespace
from zwidth.loops.domain import nan_with_nan_slopes, valid_device
from zwidth.loops.rigid.needed_damping import directions, needed_damping
from zwidth.words.types import Array, ArrayLike

# Gauss-Legendre nodes for each of the three parts.
_NODES = (64, 64, 32)
_WEIGHT = 64


def passive_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the passive set in the (alpha, beta) plane.

    The condition is convex and homogeneous in (alpha, beta, delta): with ``needed(phi)`` the physical damping that
    the wall ``(cos phi, sin phi)`` needs, ``A = (delta^2/2) integral of needed(phi)^-2`` over phi from -pi/2 to pi/2.
    At d = 0 it is the triangle ``delta > alpha/2 + |beta|``: ``A = 2 delta^2``.

    Args:
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held). Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range (see `loops.domain`).

    Numerics:
        Gauss-Legendre quadrature between the kinks of ``needed``: about 1e-14 relative, at a cost that does not grow
        with d. Traceable, with derivatives; those in d at whole d are from the right.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> from zwidth import passive_area
        >>> print(f"{passive_area(0.5, 0):.4f}")
        0.5000
    """
    return evaluate(_passive_area_kernel, {"delta": delta, "d": d}, weight=_WEIGHT)


def _passive_area_kernel(delta: Array, d: Array) -> Array:
    xp = namespace(delta, d)
    ok = valid_device(delta, d)
    safe_d = xp.where(ok, d, 1.0)
    unit = 1.0 / (safe_d + 0.5)
    # Where the kinks lie does not matter to the first order.
    first, last = (xp.arctan(t * frozen(unit, xp)) for t in frozen(directions(safe_d), xp))
    end = 0.5 * np.pi + 0.0 * safe_d

    def needed(theta: Array) -> Array:
        # The straight edge alpha = 0 is the range of theta: rounding must not lead beyond it.
        alpha = xp.maximum(xp.cos(theta), 0.0) * unit[..., None]
        return needed_damping(alpha, xp.sin(theta), safe_d[..., None] + 0.0 * theta)

    edges = (-end, first, last, end)
    parts = [_integral(needed, edges[i], edges[i + 1], nodes) for i, nodes in enumerate(_NODES)]
    return 0.5 * delta * delta * unit * (parts[0] + parts[1] + parts[2]) + nan_with_nan_slopes(ok, delta, d)


def _integral(needed: Callable[[Array], Array], low: Array, high: Array, nodes: int) -> Array:
    xp = namespace(low)
    node, weight = (along(values, low) for values in np.polynomial.legendre.leggauss(nodes))
    width = high - low
    theta = low[..., None] + width[..., None] * (0.5 * (node + 1.0))
    # Of no width: the values are finite and do not matter.
    return 0.5 * width * xp.sum(needed(theta) ** -2 * weight, axis=-1)
