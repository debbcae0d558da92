"""The stiffest stable wall, alpha_max(delta, d)."""

from __future__ import annotations

from enum import IntEnum
from typing import Literal, NamedTuple, TypeAlias

import jax.numpy as jnp

from zwidth._types import Array, ArrayLike, DelayModel
from zwidth.batching import pointwise
from zwidth.errors import check_choice
from zwidth.loop import check_delay_model, frequency_loop, valid_device
from zwidth.stability.ridge_newton import newton_ridge, start_of
from zwidth.status import Status

RidgeMethod: TypeAlias = Literal["auto", "newton", "kkt"]
_METHODS: tuple[str, ...] = ("auto", "newton", "kkt")
# Small enough for the second-level cache, large enough to pay for its dispatch.
_CHUNK = 1 << 13
_LEAST = 1 << 4


class RidgeKind(IntEnum):
    """Which kind of optimum the ridge is."""

    SMOOTH = 0
    CORNER = 1


class RidgePoint(NamedTuple):
    """The stiffest stable wall of a device, or an array of them."""

    alpha: Array
    beta: Array
    omega: Array
    kind: Array
    status: Array


def alpha_max(
    delta: ArrayLike, d: ArrayLike, *, delay: DelayModel = "held", method: RidgeMethod = "auto"
) -> RidgePoint:
    """Find the stiffest stable virtual wall.

    ``alpha_max(delta, d) = sup {alpha : some beta is stable}``; in SI units ``K_max = alpha_max m/T^2``.

    Args:
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not. Both broadcast.
        delay: "held" (exact) or "fractional_power" (the paper's z^(1+d)); the same for whole d.
        method: "newton" solves the stationarity of the paper's loop in closed form, "kkt" the general conditions with
            optimistix; "auto" is "newton".

    Returns:
        RidgePoint with arrays of the broadcast shape: ``alpha``; ``beta``, the damping that goes with it; ``omega``,
        the frequency in radians a period at which the loop then oscillates; ``kind``, 0 smooth or 1 corner (a double
        pole at z = -1); ``status``, see `zwidth.Status`. NaN where the status is not 0.

    Raises:
        InputError: an argument is no real number, shapes do not broadcast, or ``delay`` is unknown.

    Numerics:
        alpha to about 1e-15 relative: at a maximum an error of omega enters squared. Traceable: `jit`, `vmap`,
        `grad`, `jvp` and second derivatives, in delta and d; NaN where the status is not 0. Float64 when called
        directly; the ambient precision inside somebody's own `jit`.

        alpha's first derivatives are continuous, also where the corner takes over (d = 0: delta = 3.65936162742...)
        and at whole d > 0; its second derivatives and the first ones of beta and omega jump there. At a whole d they
        are those from the right, at the take-over those of the kind that is returned, and omega is left like a square
        root. With the fractional power a corner exists at d = 0 only: derivatives in d are -inf there.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII, eqs. (24), (25).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.alpha_max(0.0, 1).alpha:.4f}")
        0.1445
    """
    check_delay_model(delay)
    check_choice("method", method, _METHODS)
    # "auto" and "newton" share one compilation.
    route = "kkt" if method == "kkt" else "newton"
    # The general route iterates over long formulas.
    fused = route == "newton"
    return pointwise(ridge_kernel, ("delta", "d"), (delta, d), (delay, route), _CHUNK, fused, _LEAST)


def ridge_kernel(delta: Array, d: Array, delay: str, method: str = "newton") -> RidgePoint:
    """`alpha_max` of one point."""
    ok = valid_device(delta, d)
    # NaN goes through the computation and not around it, so that derivatives are NaN as well.
    mask = jnp.where(ok, 1.0, jnp.nan)
    delta, d = delta * mask, d * mask
    if method == "kkt":
        # Its solvers take a second to import.
        from zwidth.stability.ridge_kkt import kkt_ridge

        alpha, beta, omega, is_corner, converged = kkt_ridge(delta, d, delay)
    else:
        loop = frequency_loop(delta, d, delay)
        alpha, beta, omega, is_corner, converged = newton_ridge(loop.plant, loop.lag, start_of(delta, d), delay)
    found = jnp.where(converged, 1.0, jnp.nan)
    status = jnp.where(ok, jnp.where(converged, Status.OK, Status.NOT_CONVERGED), Status.INVALID_INPUT)
    kind = jnp.where(is_corner, RidgeKind.CORNER, RidgeKind.SMOOTH)
    return RidgePoint(alpha * found, beta * found, omega * found, kind.astype(jnp.int32), status.astype(jnp.int32))
