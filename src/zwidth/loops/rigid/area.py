"""Z-width as a number: the area of the stable walls in the (alpha, beta) plane (rigid loop)."""

from __future__ import annotations

import numpy as np

from zwidth.arrays.evaluate import evaluate
from zwidth.arrays.xp import along, frozen, namespace
from zwidth.loops.domain import nan_with_nan_slopes, valid_device
from zwidth.loops.rigid.curve import lobe, spread, wall
from zwidth.loops.rigid.delay_classes import DelayClasses, classify_delays
from zwidth.words.types import Array, ArrayLike

# Gauss-Legendre nodes along the lobe, where alpha d(beta) is analytic.
_NODES = 48
_NODE, _SHARE = np.polynomial.legendre.leggauss(_NODES)
_WEIGHT = 16


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
    return evaluate(_area_kernel, {"delta": delta, "d": d}, classify_delays(d), weight=_WEIGHT)


def _area_kernel(delta: Array, d: Array, kind: DelayClasses) -> Array:
    xp = namespace(delta, d)
    curve = lobe(delta, d, "held", kind)
    end = frozen(curve.end, xp)
    node, weight = (along(part, end) for part in (0.5 + 0.5 * _NODE, 0.5 * _SHARE))
    at = wall(end[..., None] * node, spread(curve))
    under_lobe = xp.sum(at.alpha * at.d_b * weight, axis=-1) * end
    # From a corner back to alpha = 0 along alpha + 2 beta = const.
    last = xp.where(curve.to_corner, wall(end, curve).alpha, 0.0)
    return under_lobe + 0.25 * last * last + nan_with_nan_slopes(valid_device(delta, d), delta, d)
