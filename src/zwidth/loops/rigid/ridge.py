"""The stiffest stable wall of the rigid loop, alpha_max(delta, d)."""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from zwidth.arrays.evaluate import evaluate
from zwidth.arrays.xp import epsilon, namespace
from zwidth.loops.domain import device_status, nan_unless
from zwidth.loops.rigid.delay_classes import ANY, DelayClasses, classify_delays
from zwidth.loops.rigid.plant import Plant, split_delay, undelayed_plant
from zwidth.loops.rigid.polynomial import check_delay_model
from zwidth.loops.rigid.ridge_newton import Ridge, guess_start, is_undelayed
from zwidth.loops.rigid.ridge_slopes import (
    alpha_by_lag,
    alpha_change,
    differentiable_plant,
    differentiable_ridge,
    move_ridge,
    plant_slopes,
)
from zwidth.words.errors import check_choice
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import Array, ArrayLike, DelayModel

RidgeMethod: TypeAlias = Literal["auto", "newton", "kkt"]
_METHODS: tuple[str, ...] = ("auto", "newton", "kkt")


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
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, whole or not. Both broadcast.
        delay: "held" (exact) or "fractional_power" (the paper's z^(1+d)); the same for whole d.
        method: "newton" solves the stationarity of the paper's loop in closed form, "kkt" the general conditions with
            optimistix; "auto" is "newton".

    Returns:
        RidgePoint with arrays of the broadcast shape: ``alpha``; ``beta``, the damping that goes with it; ``omega``,
        the frequency in radians a period at which the loop then oscillates; ``kind``, 0 smooth or 1 corner (a double
        pole at z = -1); ``status``, see `zwidth.Status`. NaN where the status is not 0.

    Numerics:
        alpha to about 1e-15 relative: at a maximum an error of omega enters squared. Traceable in delta and d, also
        twice. alpha's first derivatives are continuous, also where the corner takes over (d = 0:
        delta = 3.65936162742...) and at whole d > 0; its second ones and the first ones of beta and omega jump there,
        and at a whole d are those from the right. A fractional power has a corner at d = 0 only, with -inf in d.

        Float64 when called directly. Inside a transformation, `jax.grad` included, JAX's own precision holds: float32
        unless ``jax.config.update("jax_enable_x64", True)`` was called, which a `zwidth.PrecisionWarning` says once.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII, eqs. (24), (25).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.alpha_max(0.0, 1).alpha:.4f}")
        0.1445
    """
    check_delay_model(delay)
    check_choice("method", method, _METHODS)
    arguments = {"delta": delta, "d": d}
    if method == "kkt":
        # The general route iterates over long formulas; its solvers take a second to import.
        from zwidth.loops.rigid.exact_points import kkt_kernel

        return RidgePoint(*evaluate(kkt_kernel, arguments, delay, route="jax"))
    return evaluate(ridge_kernel, arguments, delay, classify_delays(d), slopes=move_point if delay == "held" else None)


def ridge_kernel(delta: Array, d: Array, delay_model: str, kind: DelayClasses = ANY) -> RidgePoint:
    """`alpha_max`, elementwise."""
    return _point(*_solve_ridge(delta, d, delay_model, kind)[:2])


def move_point(
    delta: Array, d: Array, delay_model: str, kind: DelayClasses = ANY
) -> tuple[RidgePoint, tuple[RidgePoint, RidgePoint]]:
    """`ridge_kernel` of a held delay, and how it moves with delta and d."""
    ridge, status, plant, lag, (delta, f) = _solve_ridge(delta, d, delay_model, kind)
    point, still, arrived = _point(ridge, status), np.zeros_like(lag), converged(ridge)

    def move(change: Plant) -> RidgePoint:
        alpha, beta, omega, *_ = move_ridge(ridge, plant, lag, change, still, delay_model, kind)
        return point._replace(**dict(zip(RidgePoint._fields, nan_unless(arrived, alpha, beta, omega), strict=False)))

    by_delta, by_f = plant_slopes(delta, f)
    return point, (move(by_delta), move(by_f))


class RidgeSlopes(NamedTuple):
    """The stiffest wall with its derivatives."""

    point: RidgePoint
    by_delta: Array
    by_d: Array


def slopes_kernel(delta: Array, d: Array, delay_model: str, kind: DelayClasses = ANY) -> RidgeSlopes:
    """`alpha_max` and the derivatives of alpha in delta and d, elementwise; at whole delays those from the right."""
    ridge, status, plant, lag, (delta, f) = _solve_ridge(delta, d, delay_model, kind)
    by_delta, by_f = plant_slopes(delta, f)
    undelayed = is_undelayed(delay_model, kind)
    fractional = delay_model == "fractional_power"
    by_d = alpha_by_lag(ridge, lag) if fractional else alpha_change(ridge.s, plant, lag, by_f, undelayed)
    by_delta = alpha_change(ridge.s, plant, lag, by_delta, undelayed)
    by_delta, by_d = nan_unless(converged(ridge), by_delta, by_d)
    return RidgeSlopes(_point(ridge, status), by_delta, by_d)


def stiffness_slopes(
    found: RidgeSlopes, mass: Array, period: Array, delta: Array, d: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """K_max and what it gains per unit of mass, damping, period and delay, each with the other three held fixed.

    ``dK/dm = (a - delta a_delta)/T^2``, ``dK/db = a_delta/T``, ``dK/dT = (delta a_delta - d a_d - 2 a) m/T^3``,
    ``dK/dt_d = a_d m/T^3`` with ``a = alpha_max(delta, d)``.
    """
    alpha, rate, change = found.point.alpha, 1.0 / period, delta * found.by_delta
    # No delay needs no product, which an infinite slope would make NaN.
    delayed = namespace(alpha).where(d > 0.0, d * found.by_d, 0.0)
    return (
        alpha * mass * rate * rate,
        (alpha - change) * rate * rate,
        found.by_delta * rate,
        (change - delayed - 2.0 * alpha) * mass * rate**3,
        found.by_d * mass * rate**3,
    )


def _solve_ridge(
    delta: Array, d: Array, delay_model: str, kind: DelayClasses
) -> tuple[Ridge, Array, Plant, Array, tuple[Array, Array]]:
    """The ridge, its status, the plant behind a lag, and the plant's damping and fraction."""
    status = device_status(delta, d)
    delta, d = nan_unless(status == Status.OK, delta, d)
    whole, f = split_delay(d)
    if not kind.fractional:
        # Both models are one, except for derivatives in d, which nobody can ask for where `kind` is known.
        delay_model = "held"
    if delay_model == "fractional_power":
        whole, f = d, 0.0 * d
    start = guess_start(delta, d, f, kind)
    plant = differentiable_plant(delta, f) if kind.fractional and delay_model == "held" else undelayed_plant(delta)
    ridge = differentiable_ridge(plant, whole, start, delay_model, kind)
    return ridge, status, plant, whole, (delta, f)


def converged(ridge: Ridge) -> Array:
    """Whether the solver has arrived."""
    # Quadratic convergence: after a step of sqrt(eps) nothing but rounding is left.
    return namespace(ridge.s).abs(ridge.last) <= 2.0 * epsilon(ridge.s) ** 0.5 * ridge.s


def _point(ridge: Ridge, status: Array) -> RidgePoint:
    xp = namespace(ridge.alpha)
    arrived = converged(ridge)
    status = xp.where((status == Status.OK) & ~arrived, int(Status.NOT_CONVERGED), status)
    kind = xp.where(ridge.s >= 1.0, int(RidgeKind.CORNER), int(RidgeKind.SMOOTH))
    alpha, beta, omega = nan_unless(arrived, ridge.alpha, ridge.beta, ridge.omega)
    return RidgePoint(alpha, beta, omega, kind.astype(np.int32), status.astype(np.int32))
