"""How fast the stiffest stable wall grows with damping, once the damping is strong: eq. (22)'s slope."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from zwidth._types import Array, ArrayLike, DelayModel
from zwidth.batching import pointwise
from zwidth.loop import check_delay_model
from zwidth.plant import Plant, split_delay
from zwidth.stability.ridge_newton import Start, newton_ridge

_CHUNK = 1 << 13
_LEAST = 1 << 4


def stiffness_slope(d: ArrayLike, *, delay: DelayModel = "held") -> Array:
    """Return the slope of the stiffest stable wall over physical damping, in the limit of strong damping.

    ``g(d) = lim alpha_max(delta, d)/delta`` for ``delta -> infinity``; in SI units ``K_max T/b -> g(d)``. With
    ``alpha = g delta``, ``beta = h delta`` the loop becomes, for a held delay d = n + f,

        z^(2+n) (z - 1) + ((1 - f) z + f) ((g + h) z - h) = 0

    (whole d: ``z^(2+d) - z^(1+d) + (g + h) z - h = 0``), for the fractional power the latter with z^d for every d.
    g is the largest one for which some h keeps every zero inside the unit circle.

    Args:
        d: delay in periods, >= 0, whole or not; any shape.
        delay: "held" (exact) or "fractional_power" (the paper's z^(1+d)); the same for whole d.

    Returns:
        Array of d's shape: 4, 1, 0.631130, 0.465011, 0.369041 for d = 0, 1, 2, 3, 4. NaN where d is NaN, negative
        or infinite.

    Raises:
        InputError: d is no real number, or ``delay`` is unknown.

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
        >>> print(f"{zwidth.stability.slope.stiffness_slope(2):.6f}")
        0.631130
    """
    check_delay_model(delay)
    return pointwise(slope_kernel, ("d",), (d,), (delay,), _CHUNK, least=_LEAST)


def slope_kernel(d: Array, delay: str) -> Array:
    """`stiffness_slope` of one point."""
    d = d * jnp.where(jnp.isfinite(d) & (d >= 0), 1.0, jnp.nan)
    lag, f = split_delay(d) if delay == "held" else (d, jnp.zeros_like(d))
    zero, one = jnp.zeros_like(d), jnp.ones_like(d)
    # delta N(z) for delta -> infinity: the velocity follows the force at once, e^-delta and its like vanish.
    plant = Plant(c=zero, em=one, a2=1.0 - f, a1=f, a0=zero, gap=1.0 - 2.0 * f)
    start = jax.lax.stop_gradient(Start(1.0 / (d + 1.0), one, zero))
    ridge = newton_ridge(plant, lag, start, delay)
    return ridge.alpha * jnp.where(ridge.converged, 1.0, jnp.nan)
