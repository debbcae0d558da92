"""How fast the stiffest wall of the rigid loop grows with damping, once that is strong: eq. (22)'s slope."""

from __future__ import annotations

from zwidth.arrays.evaluate import evaluate
from zwidth.loops.domain import nan_unless, valid_device
from zwidth.loops.rigid.delay_classes import ANY, DelayClasses, classify_delays
from zwidth.loops.rigid.plant import Plant, split_delay
from zwidth.loops.rigid.polynomial import check_delay_model
from zwidth.loops.rigid.ridge import converged
from zwidth.loops.rigid.ridge_newton import guess_start
from zwidth.loops.rigid.ridge_slopes import differentiable_ridge
from zwidth.words.types import Array, ArrayLike, DelayModel


def stiffness_slope(d: ArrayLike, *, delay: DelayModel = "held") -> Array:
    """Return the slope of the stiffest stable wall over physical damping, in the limit of strong damping.

    ``g(d) = lim alpha_max(delta, d)/delta`` for ``delta -> infinity``; in SI units ``K_max T/b -> g(d)``. With
    ``alpha = g delta``, ``beta = h delta`` the loop becomes, for a held delay d = n + f,

        z^(2+n) (z - 1) + ((1 - f) z + f) ((g + h) z - h) = 0

    (whole d: ``z^(2+d) - z^(1+d) + (g + h) z - h = 0``), for the fractional power the latter with z^d for every d.
    g is the largest one for which some h keeps every zero inside the unit circle.

    Args:
        d: delay in periods, 0 to 1e5, whole or not; any shape.
        delay: "held" (exact) or "fractional_power" (the paper's z^(1+d)); the same for whole d.

    Returns:
        Array of d's shape: 4, 1, 0.631130, 0.465011, 0.369041 for d = 0, 1, 2, 3, 4. NaN where d is NaN, negative,
        infinite or too long.

    Numerics:
        About 1e-15 relative. Traceable, with derivatives of every order in d. The held slope is
        ``4 (1 - 3 d)/(1 - 2 d)^2`` (a corner, with its maximum 4.5 at d = 1/6) up to d = 1/4, ``1/d`` up to d = 1. It
        is continuous, with a kink at every whole d > 0: derivatives there are those from the right (0 at d = 1,
        where the one from the left is -1). For finite delta alpha_max has no kink: its derivative in d turns within
        about 1/delta of a whole d. The fractional power's slope has one kink, at d = 0: its derivative is -inf.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (22).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.loops.rigid.slope.stiffness_slope(2):.6f}")
        0.631130
    """
    check_delay_model(delay)
    return evaluate(slope_kernel, {"d": d}, delay, classify_delays(d))


def slope_kernel(d: Array, delay_model: str, kind: DelayClasses = ANY) -> Array:
    """`stiffness_slope`, elementwise."""
    (d,) = nan_unless(valid_device(0.0 * d, d), d)
    zero = 0.0 * d
    lag, f = split_delay(d) if delay_model == "held" else (d, zero)
    # delta N(z) for delta -> infinity: the velocity follows the force at once, e^-delta and its like vanish.
    plant = Plant(c=zero, em=zero + 1.0, a2=1.0 - f, a1=f, a0=zero, gap=1.0 - 2.0 * f)
    start = guess_start(zero, d, f, kind, strength=zero + 1.0)._replace(corner=zero)
    ridge = differentiable_ridge(plant, lag, start, delay_model, kind)
    return nan_unless(converged(ridge), ridge.alpha)[0]
