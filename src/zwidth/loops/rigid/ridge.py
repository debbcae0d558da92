"""The stiffest stable wall of the rigid loop, alpha_max(delta, d), and its slope over strong damping, eq. (22)."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from zwidth.arrays.evaluate import evaluate
from zwidth.arrays.held_mass import (
    ANY,
    GAP,
    DelayClasses,
    Plant,
    classify_delays,
    held_plant,
    phi_functions,
    split_delay,
    valid_device,
)
from zwidth.loops.rigid.normalization import device_status
from zwidth.loops.rigid.polynomial import check_delay_model
from zwidth.loops.rigid.ridge_newton import (
    Ridge,
    Start,
    expand_curve,
    guess_start,
    is_undelayed,
    solve,
    stationarity,
    wall,
    wave,
)
from zwidth.words.errors import check_choice
from zwidth.words.results import RidgePoint
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import Array, ArrayLike, DelayModel
from zwidth.words.xp import epsilon, frozen, horner, namespace, nan_unless, push_forward, store_once


def _chi(x: Array, gap: Array) -> Array:
    """``gap/x = -phi2'``, 1/6 at 0; ``psi' = chi - psi`` and ``phi1' = -psi``."""
    xp = namespace(x)
    small = x < 2.5
    half = xp.where(small, 0.5 * x, 0.0)
    return xp.where(small, xp.exp(-half) * horner(half * half, GAP), gap / xp.where(small, 1.0, x))


def plant_slopes(delta: Array, fraction: Array) -> tuple[Plant, Plant]:
    """The derivatives of `arrays.held_mass.held_plant` in delta and in the fraction."""
    f, t = fraction, 1.0 - fraction
    c, e_t = (namespace(delta).exp(-x) for x in (delta, delta * t))
    at_t, at_f = phi_functions(delta * t), phi_functions(delta * f)
    chi_t, chi_f = _chi(delta * t, at_t.gap), _chi(delta * f, at_f.gap)
    # Every term of a1 falls.
    a2 = -t * t * t * chi_t
    a1 = t * t * t * (at_t.psi - chi_t) + f * f * f * chi_f
    a1 = -(a1 + t * f * (e_t * (t * at_f.phi1 + f * at_f.psi) + t * at_t.psi * at_f.phi1 + f * at_t.phi1 * at_f.psi))
    a0 = -e_t * f * f * (t * at_f.psi + f * (at_f.psi - chi_f))
    slow, fast = t * at_t.phi1, e_t * f * at_f.phi1
    zero = 0.0 * c
    return Plant(-c, c, a2, a1, a0, a2 - a1 + a0), Plant(zero, zero, -slow, slow - fast, fast, 2.0 * (fast - slow))


def follow(
    s: Array, plant: Plant, lag: Array, delay_model: str, kind: DelayClasses
) -> tuple[Array, Array, Array, Array]:
    """alpha, beta, omega and s of a ridge known to be at ``s``, as they move with plant and lag."""
    # One step of Newton's method, through which derivatives pass: it is exact to the first order. A corner stays at 1,
    # and at a maximum alpha moves as if s stood still.
    xp = namespace(s, plant.a2, lag)
    undelayed, curve, corner = is_undelayed(delay_model, kind), expand_curve(plant), s >= 1.0
    inside = xp.where(corner, 0.5, s)
    first, second = stationarity(inside, curve, lag, undelayed)
    inside = xp.where(corner, 0.5, inside - first / xp.where(corner, 1.0, second))
    moved = xp.where(corner, 1.0, inside)
    # Not by the series of `wave`, whose derivative has fewer digits.
    omega = xp.where(corner, np.pi, 2.0 * xp.arctan(inside / xp.sqrt((1.0 - inside) * (1.0 + inside))))
    alpha, beta = (wall(wave(place, lag, undelayed), curve) for place in (s, moved))
    return alpha[0], beta[1], omega, moved


def differentiable_ridge(plant: Plant, lag: Array, start: Start, delay_model: str, kind: DelayClasses) -> Ridge:
    """`loops.rigid.ridge_newton.solve`, in JAX with derivatives in plant and lag to any order."""
    if namespace(plant.a2, lag) is np:
        return solve(plant, lag, start, delay_model, kind)
    import jax.numpy as jnp

    ridge = _jax_ridge()(plant, lag, start, delay_model, kind)
    if delay_model == "held":
        return ridge
    # The corner is left as soon as d > 0, alpha like -d^(2/3), omega like -d^(1/3), with infinite slopes.
    corner = ridge.s >= 1.0
    fall = jnp.where(corner, jnp.sqrt(jnp.where(corner, lag, 1.0)), 0.0)
    # Turned by pi d the curve's alpha(q) and beta(q), q = 1 - s^2, become alpha + a1 q - 2 t, beta + b1 q + t, and the
    # largest alpha has t = -a1 q: it moves by 3 a1 q, beta by (b1 - a1) q.
    phi1, body = plant.a2 + plant.a1, plant.a1 * (1.0 + plant.a2 * ridge.beta)
    lean = plant.a2 + plant.c * plant.a1 - plant.a1 * (2.0 * ridge.beta * phi1 + ridge.alpha * plant.a2)
    share = frozen(jnp.where(corner, (body / lean - 1.0) / 3.0, 0.0), jnp)
    return ridge._replace(alpha=ridge.alpha - fall, beta=ridge.beta - share * fall, omega=ridge.omega - fall)


@cache
def _jax_plant() -> Any:
    """`arrays.held_mass.held_plant` with its derivatives in closed form."""
    import jax

    function = jax.custom_jvp(lambda delta, fraction: held_plant(delta, fraction))

    @function.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple[Plant, Plant]:
        (by_delta, by_f), (d_delta, d_f) = plant_slopes(*primals), tangents
        change = (a * d_delta + b * d_f for a, b in zip(by_delta, by_f, strict=True))
        return function(*primals), Plant(*change)

    return function


@cache
def _jax_ridge() -> Any:
    import jax

    function = jax.custom_jvp(solve, nondiff_argnums=(3, 4))

    def rule(delay_model: str, kind: DelayClasses, primals: tuple, tangents: tuple) -> tuple[Ridge, Ridge]:
        # s moves by this rule again: hence right to any order.
        ridge = function(*primals, delay_model, kind)

        def moving(plant: Plant, lag: Array) -> Ridge:
            return Ridge(*follow(ridge.s, plant, lag, delay_model, kind), ridge.last)

        return ridge, jax.jvp(moving, primals[:2], tangents[:2])[1]

    function.defjvp(rule)
    return function


RidgeMethod: TypeAlias = Literal["auto", "newton", "kkt"]


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
        RidgePoint with arrays of the broadcast shape: ``alpha``, the maximum stiffness; ``beta``, the virtual damping
        at the maximum; ``omega``, the frequency of the oscillation there, in rad per sample; ``kind``, a code of
        `zwidth.RidgeKind`: 0 for a smooth maximum, 1 for a corner (a double pole at z = -1); ``status``, see
        `zwidth.Status`. If the status is not 0, ``alpha``, ``beta`` and ``omega`` are NaN and ``kind`` is 3 (NONE).

    Numerics:
        alpha to about 1e-15 relative: at a maximum an error of omega enters squared. Traceable in delta and d, also
        twice. alpha's first derivatives are continuous, also where the corner takes over (d = 0:
        delta = 3.65936162742...) and at whole d > 0; its second ones and the first ones of beta and omega jump there,
        and at a whole d are those from the right. A fractional power has a corner at d = 0 only, with -inf in d.
        For strong damping the second one in delta falls like delta^-3, below the rounding of what it is the difference
        of, 1e-15 (d = 0) to 1e-12 (d = 500) of alpha/delta^2: at delta = 1e6 none of its digits are sure.

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
    check_choice("method", method, get_args(RidgeMethod))
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
    point, arrived = _point(ridge, status), converged(ridge)

    def move(change: Plant) -> RidgePoint:
        moved = push_forward(lambda plant: follow(ridge.s, plant, lag, delay_model, kind), (plant,), (change,), np)
        return point._replace(**dict(zip(RidgePoint._fields, nan_unless(arrived, *moved[:3]), strict=False)))

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
    xp, at = namespace(ridge.s), wave(ridge.s, lag, is_undelayed(delay_model, kind))

    def move(change: Plant) -> Array:
        return push_forward(lambda plant: wall(at, expand_curve(plant))[0], (plant,), (change,), xp)

    by_delta, by_d = map(move, store_once(plant_slopes(delta, f), ridge.s))
    if delay_model == "fractional_power":
        by_d = -8.0 * at.y * at.half * at.per_sin * (ridge.beta + 0.5 * ridge.alpha)
        by_d = xp.where(ridge.s >= 1.0, -np.inf, by_d)
    by_delta, by_d = nan_unless(converged(ridge), by_delta, by_d)
    return RidgeSlopes(_point(ridge, status), by_delta, by_d)


def stiffness_slopes(
    found: RidgeSlopes, mass: Array, period: Array, delta: Array, d: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """K_max and its derivatives in mass, damping, period and delay: see `zwidth.sensitivities`."""
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
    if kind.fractional and delay_model == "held":
        plant = held_plant(delta, f) if namespace(delta, f) is np else _jax_plant()(delta, f)
    else:
        plant = held_plant(delta)
    ridge = store_once(differentiable_ridge(plant, whole, start, delay_model, kind), delta)
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
    kind = xp.where(status == Status.OK, kind, int(RidgeKind.NONE))
    alpha, beta, omega = nan_unless(arrived, ridge.alpha, ridge.beta, ridge.omega)
    return RidgePoint(alpha, beta, omega, kind.astype(np.int32), status.astype(np.int32))


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
        >>> print(f"{zwidth.loops.rigid.ridge.stiffness_slope(2):.6f}")
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
