"""Z-width as a number: the area of the stable and of the passive walls in the (alpha, beta) plane (rigid loop)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zwidth.arrays.evaluate import evaluate
from zwidth.arrays.xp import along, frozen, namespace, nan_with_nan_slopes
from zwidth.loops.rigid.curve import lobe, spread, wall
from zwidth.loops.rigid.device import DelayClasses, classify_delays, valid_device
from zwidth.loops.rigid.needed_damping import directions, needed_damping
from zwidth.words.types import Array, ArrayLike

# Gauss-Legendre nodes along the lobe, where alpha d(beta) is analytic, and for each of the three parts of what is
# needed; and what a point weighs for them.
_LOBE_NODES, _LOBE_WEIGHT = 48, 16
_PASSIVE_NODES, _PASSIVE_WEIGHT = (64, 64, 32), 64


def stable_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the stable set in the (alpha, beta) plane.

    ``A = integral of alpha d(beta)`` along the lobe of `zwidth.boundary`, closed by the line on which a real pole
    crosses at z = -1, where that line cuts it, and by alpha = 0. In SI units the area over K and B is ``A m^2/T^3``.

    Args:
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, whole or not (held). Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range.

    Numerics:
        Gauss-Legendre quadrature of the closed form, about 1e-13. Traceable, with first derivatives: the area does
        not change to first order when the ends of the lobe move, so they count as fixed; second derivatives are not
        right.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, section V.

    Example:
        >>> from zwidth import stable_area
        >>> print(f"{stable_area(0.0, 0):.4f}")
        0.9096
    """
    return evaluate(_area_kernel, {"delta": delta, "d": d}, classify_delays(d), weight=_LOBE_WEIGHT)


def _area_kernel(delta: Array, d: Array, kind: DelayClasses) -> Array:
    xp = namespace(delta, d)
    curve = lobe(delta, d, "held", kind)
    end, at_places = frozen(curve.end, xp), spread(curve)

    def rise(x: Array) -> Array:
        at = wall(x, at_places)
        return at.alpha * at.d_b

    # From a corner back to alpha = 0 along alpha + 2 beta = const.
    last = xp.where(curve.to_corner, wall(end, curve).alpha, 0.0)
    under_lobe = _integrate(rise, 0.0 * end, end, _LOBE_NODES)
    return under_lobe + 0.25 * last * last + nan_with_nan_slopes(valid_device(delta, d), delta, d)


def _integrate(function: Callable[[Array], Array], low: Array, high: Array, nodes: int) -> Array:
    """The integral of a function of points along a new last axis."""
    xp = namespace(low)
    node, weight = (along(values, low) for values in np.polynomial.legendre.leggauss(nodes))
    width = high - low
    points = low[..., None] + width[..., None] * (0.5 * (node + 1.0))
    # Of no width: the values are finite and do not matter.
    return 0.5 * width * xp.sum(function(points) * weight, axis=-1)


def passive_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the passive set in the (alpha, beta) plane.

    The condition is convex and homogeneous in (alpha, beta, delta): with ``needed(phi)`` the physical damping that
    the wall ``(cos phi, sin phi)`` needs, ``A = (delta^2/2) integral of needed(phi)^-2`` over phi from -pi/2 to pi/2.
    At d = 0 it is the triangle ``delta > alpha/2 + |beta|``: ``A = 2 delta^2``.

    Args:
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held). Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range (see `loops.rigid.device`).

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
    return evaluate(_passive_area_kernel, {"delta": delta, "d": d}, weight=_PASSIVE_WEIGHT)


def _passive_area_kernel(delta: Array, d: Array) -> Array:
    """By direction: ``alpha = cos(theta)/(d + 1/2)``, ``beta = sin(theta)``.

    Below the first of `directions` the damping that a wall needs is decided at omega = 0, above the last one (d < 2/9
    only) at omega = pi, between them at one omega that rises with theta. It passes from one to the next without a jump,
    for d = 0 all at once, and between them it is analytic in theta.
    """
    xp = namespace(delta, d)
    ok = valid_device(delta, d)
    safe_d = xp.where(ok, d, 1.0)
    unit = 1.0 / (safe_d + 0.5)
    # Where the kinks lie does not matter to the first order.
    first, last = (xp.arctan(t * frozen(unit, xp)) for t in frozen(directions(safe_d), xp))
    end = 0.5 * np.pi + 0.0 * safe_d

    def share(theta: Array) -> Array:
        # The straight edge alpha = 0 is the range of theta: rounding must not lead beyond it.
        alpha = xp.maximum(xp.cos(theta), 0.0) * unit[..., None]
        return needed_damping(alpha, xp.sin(theta), safe_d[..., None] + 0.0 * theta) ** -2

    edges = (-end, first, last, end)
    parts = [_integrate(share, edges[i], edges[i + 1], nodes) for i, nodes in enumerate(_PASSIVE_NODES)]
    return 0.5 * delta * delta * unit * (parts[0] + parts[1] + parts[2]) + nan_with_nan_slopes(ok, delta, d)
