"""Compute the maximum stiffness of rigid devices, alpha_max(delta, d), with derivatives in delta and d.

The *ridge* is the point of maximum stiffness, given by s = sin(omega/2) with its frequency omega. It is a smooth
maximum of alpha on the stability lobe, or the *corner*, a wall with a double pole at z = -1 (docs/theory/boundary.md,
B2). `stability.rigid.ridge_newton` solves the optimality condition T(s) = 0. The derivatives of s follow from T by the
implicit function theorem, and those of alpha by the envelope theorem, because alpha is stationary in s. For strong
damping, alpha_max is proportional to delta; `stiffness_slope` returns the factor, the paper's eq. (22).

The delay is d = n + f. The plant has the numerator N(z) = a2 z^2 + a1 z + a0 and the pole c = e^-delta; a0, a1 and a2
consist of phi1(x) = (1 - e^-x)/x, phi2 = (1 - phi1)/x, psi = (phi1 - e^-x)/x and gap = phi2 - psi.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from zwidth.core.errors import check_choice
from zwidth.core.status import RidgeKind, Status
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import differentiate_along, epsilon, namespace, nan_unless
from zwidth.numerics.evaluate import evaluate
from zwidth.numerics.root_finding import attach_root_derivatives
from zwidth.plant.rigid_mass import (
    ANY,
    DelayClasses,
    Plant,
    classify_delays,
    differentiate_mass,
    discretize_mass,
    get_differentiable_mass,
    is_valid_device,
    split_delay,
)
from zwidth.stability.results import RidgePoint
from zwidth.stability.rigid.normalization import device_status
from zwidth.stability.rigid.ridge_newton import (
    Ridge,
    Start,
    evaluate_stationarity,
    evaluate_wall,
    evaluate_wave,
    expand_curve,
    guess_start,
    solve_ridge,
)


def differentiable_ridge(plant: Plant, n: Array, start: Start, kind: DelayClasses) -> Ridge:
    """Return the ridge of one plant with a delay of n periods; JAX can differentiate it exactly in ``plant`` and n."""
    ridge = solve_ridge if namespace(plant.a2, n) is np else _jax_ridge()
    return ridge(plant, n, start, kind)


@cache
def _jax_ridge() -> Any:
    """Return `solve_ridge` as a JAX function with exact derivatives of any order in the plant and in n."""
    import jax

    function = jax.custom_jvp(solve_ridge, nondiff_argnums=(3,))

    def rule(kind: DelayClasses, primals: tuple, tangents: tuple) -> tuple[Ridge, Ridge]:
        # Call ``function``, i.e. apply this derivative rule recursively, because derivatives of higher order require
        # the derivatives of s.
        ridge = function(*primals, kind)
        return ridge, jax.jvp(lambda plant, n: _vary_ridge(ridge, plant, n, kind), primals[:2], tangents[:2])[1]

    function.defjvp(rule)
    return function


def _vary_ridge(ridge: Ridge, plant: Plant, n: Array, kind: DelayClasses) -> Ridge:
    """Return a computed ridge again, as an expression in ``plant`` and n that JAX can differentiate."""
    xp, undelayed, curve = namespace(ridge.s), not kind.long, expand_curve(plant)
    is_corner = ridge.s >= 1.0
    # Attach the derivatives of s as the root of the optimality condition T(s) = 0. A corner stays at s = 1, without
    # derivatives.
    s = attach_root_derivatives(
        lambda s, curve, n: evaluate_stationarity(s, curve, n, undelayed)[0],
        xp.where(is_corner, 0.5, ridge.s),
        lambda _, rate, __: rate != 0.0,
        *(curve, n),
        slope=lambda s, curve, n: evaluate_stationarity(s, curve, n, undelayed)[1],
    )
    # Compute omega = 2 arcsin(s) by arctan and not by the series in `evaluate_wave`, whose derivative has fewer correct
    # digits.
    omega = xp.where(is_corner, np.pi, 2.0 * xp.arctan(s / xp.sqrt((1.0 - s) * (1.0 + s))))
    s = xp.where(is_corner, 1.0, s)
    # Compute alpha at the constant s of the ridge and beta at the s with derivatives. For alpha, derivatives at
    # constant s suffice, because alpha is stationary in s (envelope theorem).
    alpha, beta = (evaluate_wall(evaluate_wave(value, n, undelayed), curve) for value in (ridge.s, s))
    return Ridge(alpha[0], beta[1], omega, s, ridge.last)


RidgeMethod: TypeAlias = Literal["auto", "newton", "kkt"]


def alpha_max(delta: ArrayLike, d: ArrayLike, *, method: RidgeMethod = "auto") -> RidgePoint:
    """Return the maximum stiffness of a stable virtual wall.

    ``alpha_max(delta, d) = sup {alpha : some beta is stable}``; in SI units ``K_max = alpha_max m/T^2``.

    Args:
        delta: normalized physical damping b T/m, 0 to 1e12.
        d: delay in periods, 0 to 1e5, integer or fractional. Both broadcast.
        method: "newton" solves the stationarity of the paper's loop in closed form, "kkt" the general conditions with
            optimistix; "auto" is "newton".

    Returns:
        RidgePoint with arrays of the broadcast shape: ``alpha``, the maximum stiffness; ``beta``, the virtual damping
        at the maximum; ``omega``, the frequency of the oscillation there, in rad per sample; ``kind``, a code of
        `zwidth.RidgeKind`: 0 for a smooth maximum, 1 for a corner (a double pole at z = -1); ``status``, see
        `zwidth.Status`. If the status is not 0, ``alpha``, ``beta`` and ``omega`` are NaN and ``kind`` is 3 (NONE).

    Numerics:
        alpha to about 1e-15 relative, because at a maximum the error of alpha is of second order in that of omega. JAX
        can trace the function in delta and d, and can differentiate it to any order. The first derivatives of alpha are
        continuous, also at the transition to the corner (d = 0: delta = 3.65936162742...) and at integer d > 0. The
        second derivatives of alpha and the first ones of beta and omega jump there; at integer d they are those from
        the right. For strong damping the second derivative in delta decreases as delta^-3. Its rounding error is 1e-15
        (d = 0) to 1e-12 (d = 500) times alpha/delta^2, so none of its digits is reliable at delta = 1e6.

        Float64 when called directly. Inside a transformation, also `jax.grad`, JAX's default precision applies: float32
        unless ``jax.config.update("jax_enable_x64", True)`` was called; a `zwidth.PrecisionWarning` reports it once.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII, eqs. (24), (25).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.alpha_max(0.0, 1).alpha:.4f}")
        0.1445
    """
    check_choice("method", method, get_args(RidgeMethod))
    arguments = {"delta": delta, "d": d}
    if method == "kkt":
        # Import the solvers only if this method is requested, because the import takes a second. Let JAX compile them,
        # because they iterate long formulas.
        from zwidth.stability.rigid.exact_points import kkt_kernel

        return RidgePoint(*evaluate(kkt_kernel, arguments, route="jax"))
    return evaluate(ridge_kernel, arguments, classify_delays(d))


def ridge_kernel(delta: Array, d: Array, kind: DelayClasses = ANY) -> RidgePoint:
    """Compute the point of maximum stiffness elementwise, for the classes of delays ``kind``."""
    return _make_point(*_solve_point(delta, d, kind)[:2])


class RidgeSlopes(NamedTuple):
    """The point of maximum stiffness, and the derivatives of its alpha in delta and d."""

    point: RidgePoint
    by_delta: Array
    by_d: Array


def slopes_kernel(delta: Array, d: Array, kind: DelayClasses = ANY) -> RidgeSlopes:
    """Return the point of maximum stiffness, and d alpha/d delta and d alpha/dd (from the right at integer d)."""
    ridge, status, plant, n, (delta, f) = _solve_point(delta, d, kind)
    xp, wave = namespace(ridge.s), evaluate_wave(ridge.s, n, not kind.long)

    def differentiate(change: Plant) -> Array:
        return differentiate_along(lambda plant: evaluate_wall(wave, expand_curve(plant))[0], (plant,), (change,), xp)

    slopes = map(differentiate, differentiate_mass(delta, f))
    by_delta, by_d = nan_unless(converged(ridge), *slopes)
    return RidgeSlopes(_make_point(ridge, status), by_delta, by_d)


def stiffness_slopes(
    slopes: RidgeSlopes, mass: Array, period: Array, delta: Array, d: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return K_max and its derivatives in mass, damping, period and delay; see `zwidth.sensitivities`."""
    alpha, rate, change = slopes.point.alpha, 1.0 / period, delta * slopes.by_delta
    return (
        alpha * mass * rate * rate,
        (alpha - change) * rate * rate,
        slopes.by_delta * rate,
        (change - d * slopes.by_d - 2.0 * alpha) * mass * rate**3,
        slopes.by_d * mass * rate**3,
    )


def _solve_point(delta: Array, d: Array, kind: DelayClasses) -> tuple[Ridge, Array, Plant, Array, tuple[Array, Array]]:
    """Return the ridge, its status, the plant, the integer delay n, and the pair (delta, fraction f of the delay)."""
    status = device_status(delta, d)
    delta, d = nan_unless(status == Status.OK, delta, d)
    n, f = split_delay(d)
    start = guess_start(delta, d, f, kind)
    if kind.fractional:
        plant = (discretize_mass if namespace(delta, f) is np else get_differentiable_mass())(delta, f)
    else:
        plant = discretize_mass(delta)
    ridge = differentiable_ridge(plant, n, start, kind)
    return ridge, status, plant, n, (delta, f)


def converged(ridge: Ridge) -> Array:
    """Return a mask of the points at which the solver has converged."""
    # Compare the last step with sqrt(eps): convergence is quadratic, so that after such a step only rounding errors
    # remain.
    return namespace(ridge.s).abs(ridge.last) <= 2.0 * epsilon(ridge.s) ** 0.5 * ridge.s


def _make_point(ridge: Ridge, status: Array) -> RidgePoint:
    xp = namespace(ridge.alpha)
    has_converged = converged(ridge)
    status = xp.where((status == Status.OK) & ~has_converged, int(Status.NOT_CONVERGED), status)
    kind = xp.where(ridge.s >= 1.0, int(RidgeKind.CORNER), int(RidgeKind.SMOOTH))
    kind = xp.where(status == Status.OK, kind, int(RidgeKind.NONE))
    alpha, beta, omega = nan_unless(has_converged, ridge.alpha, ridge.beta, ridge.omega)
    return RidgePoint(alpha, beta, omega, kind.astype(np.int32), status.astype(np.int32))


def stiffness_slope(d: ArrayLike) -> Array:
    """Return the derivative of the maximum stiffness in physical damping, in the limit of strong damping.

    ``g(d) = lim alpha_max(delta, d)/delta`` for ``delta -> infinity``; in SI units ``K_max T/b -> g(d)``. With
    ``alpha = g delta``, ``beta = h delta`` the loop becomes, for d = n + f,

        z^(2+n) (z - 1) + ((1 - f) z + f) ((g + h) z - h) = 0

    (integer d: ``z^(2+d) - z^(1+d) + (g + h) z - h = 0``). g is the largest value for which some h keeps every zero
    inside the unit circle.

    Args:
        d: delay in periods, 0 to 1e5, integer or fractional; any shape.

    Returns:
        Array of d's shape: 4, 1, 0.631130, 0.465011, 0.369041 for d = 0, 1, 2, 3, 4. NaN if d is NaN, negative,
        infinite or above 1e5.

    Numerics:
        About 1e-15 relative. Traceable, with derivatives of every order in d. g is ``4 (1 - 3 d)/(1 - 2 d)^2``
        (a corner, with its maximum 4.5 at d = 1/6) up to d = 1/4 and ``1/d`` up to d = 1. It is continuous, with a kink
        at every integer d > 0: derivatives there are those from the right (0 at d = 1, where the one from the left is
        -1). For finite delta alpha_max has no kink: its derivative in d turns within about 1/delta of an integer d.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (22).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.stability.rigid.ridge.stiffness_slope(2):.6f}")
        0.631130
    """
    return evaluate(slope_kernel, {"d": d}, classify_delays(d))


def slope_kernel(d: Array, kind: DelayClasses = ANY) -> Array:
    """Compute the limit g(d) of alpha_max/delta for strong damping elementwise, for the classes of delays ``kind``."""
    (d,) = nan_unless(is_valid_device(0.0 * d, d), d)
    zero = 0.0 * d
    n, f = split_delay(d)
    # Use the plant in the limit delta -> infinity: N(z) is multiplied by delta, because the velocity is proportional to
    # force/delta, and c = 0.
    plant = Plant(c=zero, em=zero + 1.0, a2=1.0 - f, a1=f, a0=zero, gap=1.0 - 2.0 * f)
    start = guess_start(zero, d, f, kind, strength=zero + 1.0)._replace(corner=zero)
    ridge = differentiable_ridge(plant, n, start, kind)
    return nan_unless(converged(ridge), ridge.alpha)[0]
