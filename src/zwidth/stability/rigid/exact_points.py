"""Compute points of the stability boundary by a general nonlinear solver, as an independent check of the closed forms.

The unknowns are alpha, beta and omega, all real. Two equations state that the loop has a pole at z = e^(j omega), i.e.
that the wall lies on the boundary curve. The third equation is a condition on the wall:

    Re P = 0,  Im P = 0,  and  alpha or beta has a given value (on a *column* or a *row* of walls)
                          or   Im(conj(dP/dbeta) dP/domega) = 0 (at the *ridge*, the largest alpha)

The last equation is the stationarity of the Lagrangian for the largest alpha subject to P(e^(j omega)) = 0, without the
multipliers: along the curve, only beta changes there.

The solver needs only the frequency response of the loop, which is affine in (alpha, beta), and the fact that a row
meets the *lobe*, the first part of the boundary curve, once, and a column once on each side of the ridge. So it checks
`stability.rigid.curve` independently. The lobe ends at alpha = 0 or in the *corner*, a wall with a double pole at z =
-1. jaxopt's bisection computes a bracketed start; optimistix's Newton method refines it and provides the implicit
derivatives.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from zwidth.core.status import RidgeKind, Status
from zwidth.core.types import Array
from zwidth.core.xp import materialize, nan_with_nan_derivatives
from zwidth.model.circle_functions import circle_points
from zwidth.numerics.root_finding import polish_root
from zwidth.stability.rigid.crossover import stable_kernel
from zwidth.stability.rigid.normalization import device_status, wall_status
from zwidth.stability.rigid.polynomial import FrequencyLoop, Wall, build_frequency_loop, find_boundary_wall
from zwidth.stability.rigid.ridge_newton import expand_curve, find_corner

# Number of bisections; 52 reduce a bracket to one unit in the last place of a float64.
BISECTIONS = 52


def bracket_root(function: Callable[..., Array], lower: Array, upper: Array, *args: Any) -> tuple[Array, Array]:
    """Return a zero of ``function(x, *args)`` between two points by bisection, and whether the signs there differ."""
    with warnings.catch_warnings():
        # Suppress the notice that jaxopt is no longer maintained, because a user of zwidth cannot act on it.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        from jaxopt import Bisection

    lower, upper, args = jax.lax.stop_gradient((lower, upper, args))
    solver = Bisection(function, lower, upper, BISECTIONS, tol=0.0, check_bracket=False, unroll=False)
    root, state = solver.run(None, *args)
    return jax.lax.stop_gradient(root), state.sign != 0


def find_lobe_end(loop: FrequencyLoop, d: Array) -> Array:
    """Return the frequency omega at which the lobe ends with alpha = 0; pi if it ends in the corner."""
    limit = jnp.minimum(jnp.pi, jnp.pi / (d + 0.5))
    end, exists = bracket_root(lambda omega, loop: find_boundary_wall(omega, loop).alpha, 1e-6 * limit, limit, loop)
    return jnp.where(exists & ~find_corner(expand_curve(loop.plant), loop.n).reached, end, jnp.pi)


def evaluate_residual(omega: Array, alpha: Array, beta: Array, loop: FrequencyLoop) -> Array:
    """Return the real and imaginary part of ``P(e^(j omega))/e^(j (2 + n) omega)`` as one array."""
    plant, n = loop
    point, half_cosine = circle_points(omega), jnp.cos(0.5 * omega)
    # Evaluate (z - 1)(z - c) + z^-n M (alpha + beta (1 - 1/z)) with M = N(z)/z; ``point.z_minus_1`` is z - 1.
    m = (
        2.0 * (plant.a2 + plant.a0) * half_cosine * half_cosine
        - plant.gap
        + 1j * (plant.a2 - plant.a0) * jnp.sin(omega)
    )
    wall_term = jnp.exp(-1j * n * omega) * m * (alpha + beta * point.z_minus_1 * jnp.conj(point.z))
    value = point.z_minus_1 * (point.z_minus_1 + plant.em) + wall_term
    # Return real numbers, because optimistix requires real unknowns.
    return jnp.stack([value.real, value.imag])


def _evaluate_conditions(condition: str, unknowns: Array, args: tuple[FrequencyLoop, Array, Array]) -> Array:
    """Return the residuals of the three equations, scaled to order 1.

    Args:
        condition: The third equation: "row" (beta given), "lower" or "upper" (alpha given), or "ridge".
        unknowns: alpha, beta and omega, divided by their scales.
        args: The loop, the given beta or alpha, and the scales.
    """
    loop, number, scales = args
    alpha, beta, omega = unknowns * scales

    def evaluate_pole_conditions(beta: Array, omega: Array) -> Array:
        return evaluate_residual(omega, alpha, beta, loop)

    if condition != "ridge":
        wall, k = (alpha, beta), int(condition == "row")
        return jnp.append(evaluate_pole_conditions(beta, omega), (wall[k] - number) / scales[k])
    zero, one = jnp.zeros_like(beta), jnp.ones_like(beta)
    value, beta_derivative = jax.jvp(evaluate_pole_conditions, (beta, omega), (one, zero))
    _, omega_derivative = jax.jvp(evaluate_pole_conditions, (beta, omega), (zero, one))
    scale = jnp.sqrt(jnp.sum(beta_derivative**2) * jnp.sum(omega_derivative**2))
    scale = jax.lax.stop_gradient(jnp.where(scale > 0, scale, 1.0))
    return jnp.append(
        value, (beta_derivative[0] * omega_derivative[1] - beta_derivative[1] * omega_derivative[0]) / scale
    )


def _solve_conditions(
    condition: str, start: Array, bracketed: Array, number: Array, loop: FrequencyLoop
) -> tuple[Array, Wall]:
    """Return the solution of the three equations near a starting frequency: omega and the wall, with derivatives.

    Args:
        condition: The third equation, see `_evaluate_conditions`.
        start: Starting frequency, from a bisection.
        bracketed: Whether the bisection has found a change of sign.
        number: The given beta or alpha.
        loop: Plant and integer delay.
    """
    wall = jax.lax.stop_gradient(materialize(find_boundary_wall(start, loop), start))
    scale_alpha = jnp.maximum(jnp.abs(wall.alpha), jnp.finfo(start.dtype).tiny)
    scales = jnp.stack([scale_alpha, jnp.maximum(jnp.abs(wall.beta), scale_alpha), jnp.ones_like(start)])
    unknowns = jnp.stack([*wall, start]) / scales
    omega = polish_root(
        lambda *values: _evaluate_conditions(condition, *values), unknowns, (loop, number, scales), bracketed
    )[2]
    omega = materialize(omega, start)
    return omega, find_boundary_wall(omega, loop)


@jnp.vectorize
def kkt_kernel(delta: Array, d: Array) -> tuple[Array, ...]:
    """Return the fields of `zwidth.alpha_max` for one point, from the equations of the ridge."""
    status = device_status(delta, d)
    ok, inputs = status == Status.OK, (delta, d)
    # Replace NaN by valid numbers, because a solver may stop all batch entries at the NaN of one.
    delta, d = jnp.where(ok, delta, 1.0), jnp.where(ok, d, 1.0)
    loop = materialize(build_frequency_loop(delta, d), delta)
    corner = find_corner(expand_curve(loop.plant), loop.n)

    def differentiate_alpha(omega: Array, loop: FrequencyLoop) -> Array:
        return jax.grad(lambda w: find_boundary_wall(w, loop).alpha)(omega)

    end = materialize(find_lobe_end(loop, d), d)
    # Stay slightly below pi, because the derivative of alpha is 0 at pi by symmetry, even without a maximum there.
    upper = jnp.where(end < jnp.pi, end, jnp.pi * (1.0 - 1e-7))
    start, bracketed = bracket_root(differentiate_alpha, 1e-6 * end, upper, loop)
    start = materialize(start, d)
    omega, smooth = _solve_conditions("ridge", start, bracketed, d, loop)
    # Accept a solution close to its start, because rounding errors can keep Newton's method from its tolerance.
    converged = corner.is_ridge | (bracketed & (jnp.abs(omega - start) <= 1e-5 * end))
    nan_if_invalid = nan_with_nan_derivatives(ok & converged, *inputs)
    status = jnp.where(ok & ~converged, int(Status.NOT_CONVERGED), status)
    kind = jnp.where(corner.is_ridge, int(RidgeKind.CORNER), int(RidgeKind.SMOOTH))
    kind = jnp.where(status == Status.OK, kind, int(RidgeKind.NONE))
    return (
        jnp.where(corner.is_ridge, corner.alpha, smooth.alpha) + nan_if_invalid,
        jnp.where(corner.is_ridge, corner.beta, smooth.beta) + nan_if_invalid,
        jnp.where(corner.is_ridge, jnp.pi, omega) + nan_if_invalid,
        kind.astype(jnp.int32),
        status.astype(jnp.int32),
    )


@partial(jnp.vectorize, excluded=(3, 4))
def point_kernel(delta: Array, d: Array, number: Array, line: str, find_ridge: Callable[..., Any]) -> tuple[Array, ...]:
    """Return the fields of `zwidth.boundary_point` for one point.

    Args:
        delta: Normalized physical damping.
        d: Delay in periods.
        number: The given beta if ``line`` is "row"; the given alpha if it is "lower" or "upper".
        line: "row" for the largest stable alpha; "lower" or "upper" for the smallest or the largest stable beta.
        find_ridge: Function of delta and d that computes `zwidth.alpha_max`.
    """
    inputs, is_row = (delta, d, number), line == "row"
    input_status = wall_status(*((0.0 * number, number) if is_row else (number, 0.0 * number)), delta, d)
    ok = input_status == Status.OK
    delta, d, number = (jnp.where(ok, value, 1.0) for value in inputs)
    loop = build_frequency_loop(delta, d)
    ridge, end = jax.lax.stop_gradient(find_ridge(delta, d)), find_lobe_end(loop, d)

    def subtract(wall: Wall, number: Array) -> Array:
        return (wall.beta if is_row else wall.alpha) - number

    start, on_lobe = bracket_root(
        lambda omega, loop, number: subtract(find_boundary_wall(omega, loop), number),
        ridge.omega if line == "upper" else jnp.zeros_like(end),
        ridge.omega if line == "lower" else end,
        loop,
        number,
    )
    omega, wall = _solve_conditions(line, start, on_lobe, number, loop)
    tolerance = float(jnp.finfo(start.dtype).eps) ** 0.5
    # Also compare the wall with the given alpha or beta, because for very small alpha the bisection does not resolve
    # the low frequency.
    matches = jnp.abs(subtract(wall, number)) <= 0.1 * tolerance * (jnp.abs(wall.alpha) + jnp.abs(wall.beta))
    converged = matches & (jnp.abs(omega - start) <= 100.0 * tolerance)
    value = wall.alpha if is_row else wall.beta
    exists = on_lobe & (value > 0) if is_row else on_lobe
    if line != "lower":
        # For d < 1 the point may lie on the line of walls with a pole at z = -1, where alpha + 2 beta is constant.
        has_line = (loop.n == 0) & (loop.plant.gap > 0)
        line_value = 2.0 * (1.0 + loop.plant.c) / jnp.where(has_line, loop.plant.gap, 1.0)
        line_value = line_value - 2.0 * number if is_row else 0.5 * (line_value - number)
        is_real = has_line & (line_value < jnp.where(exists, value, jnp.inf))
        is_real = is_real & (line_value > 0) if is_row else is_real
        omega, value = jnp.where(is_real, jnp.pi, omega), jnp.where(is_real, line_value, value)
        exists, converged = exists | is_real, converged | is_real
    if is_row:
        # Accept the point only if the wall with half its alpha is stable.
        exists = exists & stable_kernel(0.5 * value, number, delta, d)
    else:
        exists = exists & (number > 0) & (number < ridge.alpha)
    status = jnp.where(exists, jnp.where(converged, int(Status.OK), int(Status.NOT_CONVERGED)), int(Status.NO_BOUNDARY))
    status = jnp.where(ok, status, input_status)
    nan_if_invalid = nan_with_nan_derivatives(status == Status.OK, *inputs)
    alpha, beta = (value, number) if is_row else (number, value)
    return alpha + nan_if_invalid, beta + nan_if_invalid, omega + nan_if_invalid, status.astype(jnp.int32)
