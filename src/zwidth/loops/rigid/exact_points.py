"""Exact walls by a general solve: a pole pair on the circle and one condition more, by optimistix and jaxopt.

The unknowns alpha, beta and omega are real. The third equation says that the wall lies on a given row or column or, for
the ridge, maximize alpha subject to P(e^(j omega)) = 0, that moving along the curve changes beta only (the stationarity
of the Lagrangian with the multipliers eliminated):

    Re P = 0,  Im P = 0,  Im(conj(dP/dbeta) dP/domega) = 0

Of the loop nothing is used but its frequency response, affine in (alpha, beta), and that its lobe is met once by a row,
and by a column once on either side of the ridge: an independent judge of the closed forms of `loops.rigid.curve`
(any loop whose stable set is bounded by one lobe). jaxopt's bisection brackets, optimistix' Newton method finishes and
supplies the implicit derivatives.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from zwidth.arrays.roots import polish
from zwidth.loops.rigid.crossover import stable_kernel
from zwidth.loops.rigid.normalization import device_status, wall_status
from zwidth.loops.rigid.polynomial import FrequencyLoop, Wall, frequency_boundary, frequency_loop
from zwidth.loops.rigid.ridge_newton import corner, expand_curve
from zwidth.parts.circle import circle
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import Array
from zwidth.words.xp import nan_with_nan_slopes, store_once

# Each step halves the bracket: 52 of them leave one unit in the last place of a float64.
_HALVINGS = 52


def bisect(function: Callable[..., Array], lower: Array, upper: Array, *args: Any) -> tuple[Array, Array]:
    """A sign change of ``function(x, *args)`` between two places, without derivative, and whether there is one."""
    with warnings.catch_warnings():
        # jaxopt announces at import that it is no longer maintained; a user of zwidth cannot act on that.
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        from jaxopt import Bisection

    lower, upper, args = jax.lax.stop_gradient((lower, upper, args))
    solver = Bisection(function, lower, upper, _HALVINGS, tol=0.0, check_bracket=False, unroll=False)
    root, state = solver.run(None, *args)
    return jax.lax.stop_gradient(root), state.sign != 0


def lobe_end(loop: FrequencyLoop, d: Array) -> Array:
    """The frequency at which the boundary curve first returns to alpha = 0, pi where it reaches the corner before."""
    limit = jnp.minimum(jnp.pi, jnp.pi / (d + 0.5))
    end, found = bisect(lambda omega, loop: frequency_boundary(omega, loop).alpha, 1e-6 * limit, limit, loop)
    return jnp.where(found & ~corner(expand_curve(loop.plant), loop.lag).reached, end, jnp.pi)


def frequency_residual(omega: Array, alpha: Array, beta: Array, loop: FrequencyLoop) -> Array:
    """``P(e^(j omega))/e^(j (2 + n) omega)`` as a real pair."""
    plant, whole = loop
    at, half = circle(omega), jnp.cos(0.5 * omega)
    # (z - 1)(z - c) + z^-n M (alpha + beta (1 - 1/z))
    m = 2.0 * (plant.a2 + plant.a0) * half * half - plant.gap + 1j * (plant.a2 - plant.a0) * jnp.sin(omega)
    pushed = jnp.exp(-1j * whole * omega) * m * (alpha + beta * at.before * jnp.conj(at.z))
    value = at.before * (at.before + plant.em) + pushed
    # optimistix wants real unknowns.
    return jnp.stack([value.real, value.imag])


def _residual(line: str, unknowns: Array, args: tuple[FrequencyLoop, Array, Array]) -> Array:
    """The three equations, of order one, in alpha, beta and omega over ``scales``; ``number`` is that of the line."""
    loop, number, scales = args
    alpha, beta, omega = unknowns * scales

    def pole(beta: Array, omega: Array) -> Array:
        return frequency_residual(omega, alpha, beta, loop)

    if line != "ridge":
        wall, k = (alpha, beta), int(line == "row")
        return jnp.append(pole(beta, omega), (wall[k] - number) / scales[k])
    zero, one = jnp.zeros_like(beta), jnp.ones_like(beta)
    value, by_beta = jax.jvp(pole, (beta, omega), (one, zero))
    _, by_omega = jax.jvp(pole, (beta, omega), (zero, one))
    size = jnp.sqrt(jnp.sum(by_beta**2) * jnp.sum(by_omega**2))
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
    return jnp.append(value, (by_beta[0] * by_omega[1] - by_beta[1] * by_omega[0]) / size)


def _solve(line: str, start: Array, bracketed: Array, number: Array, loop: FrequencyLoop) -> tuple[Array, Wall]:
    """The frequency at which the three equations hold, next to a start, and the wall there, differentiable."""
    wall = jax.lax.stop_gradient(store_once(frequency_boundary(start, loop), start))
    scale_alpha = jnp.maximum(jnp.abs(wall.alpha), jnp.finfo(start.dtype).tiny)
    scales = jnp.stack([scale_alpha, jnp.maximum(jnp.abs(wall.beta), scale_alpha), jnp.ones_like(start)])
    unknowns = jnp.stack([*wall, start]) / scales
    omega = polish(lambda *at: _residual(line, *at), unknowns, (loop, number, scales), bracketed)[2]
    omega = store_once(omega, start)
    return omega, frequency_boundary(omega, loop)


@jnp.vectorize
def kkt_kernel(delta: Array, d: Array) -> tuple[Array, ...]:
    """Return the fields of `zwidth.alpha_max` for one point."""
    status = device_status(delta, d)
    ok, inputs = status == Status.OK, (delta, d)
    # Replace NaN, because a solver may stop all batch entries at the NaN of one.
    delta, d = jnp.where(ok, delta, 1.0), jnp.where(ok, d, 1.0)
    loop = store_once(frequency_loop(delta, d), delta)
    summit = corner(expand_curve(loop.plant), loop.lag)

    def slope(omega: Array, loop: FrequencyLoop) -> Array:
        return jax.grad(lambda w: frequency_boundary(w, loop).alpha)(omega)

    end = store_once(lobe_end(loop, d), d)
    # Below, the slope is positive; at pi itself it vanishes by symmetry whatever the optimum.
    upper = jnp.where(end < jnp.pi, end, jnp.pi * (1.0 - 1e-7))
    start, bracketed = bisect(slope, 1e-6 * end, upper, loop)
    start = store_once(start, d)
    omega, smooth = _solve("ridge", start, bracketed, d, loop)
    # Test the distance from the bracket, because rounding errors can keep Newton's method from its tolerance.
    converged = summit.is_ridge | (bracketed & (jnp.abs(omega - start) <= 1e-5 * end))
    spoiled = nan_with_nan_slopes(ok & converged, *inputs)
    status = jnp.where(ok & ~converged, int(Status.NOT_CONVERGED), status)
    kind = jnp.where(summit.is_ridge, int(RidgeKind.CORNER), int(RidgeKind.SMOOTH))
    kind = jnp.where(status == Status.OK, kind, int(RidgeKind.NONE))
    return (
        jnp.where(summit.is_ridge, summit.alpha, smooth.alpha) + spoiled,
        jnp.where(summit.is_ridge, summit.beta, smooth.beta) + spoiled,
        jnp.where(summit.is_ridge, jnp.pi, omega) + spoiled,
        kind.astype(jnp.int32),
        status.astype(jnp.int32),
    )


@partial(jnp.vectorize, excluded=(3, 4))
def point_kernel(delta: Array, d: Array, number: Array, line: str, find_ridge: Callable[..., Any]) -> tuple[Array, ...]:
    """Return the fields of `zwidth.boundary_point` for one point; ``find_ridge`` computes `alpha_max`."""
    inputs, is_row = (delta, d, number), line == "row"
    given = wall_status(*((0.0 * number, number) if is_row else (number, 0.0 * number)), delta, d)
    ok = given == Status.OK
    delta, d, number = (jnp.where(ok, value, 1.0) for value in inputs)
    loop = frequency_loop(delta, d)
    ridge, end = jax.lax.stop_gradient(find_ridge(delta, d)), lobe_end(loop, d)

    def offset(wall: Wall, number: Array) -> Array:
        return (wall.beta if is_row else wall.alpha) - number

    start, on_lobe = bisect(
        lambda omega, loop, number: offset(frequency_boundary(omega, loop), number),
        ridge.omega if line == "upper" else jnp.zeros_like(end),
        ridge.omega if line == "lower" else end,
        loop,
        number,
    )
    omega, wall = _solve(line, start, on_lobe, number, loop)
    near = float(jnp.finfo(start.dtype).eps) ** 0.5
    # Compare values, too, because the bracket does not resolve the low frequency of a very soft wall.
    hit = jnp.abs(offset(wall, number)) <= 0.1 * near * (jnp.abs(wall.alpha) + jnp.abs(wall.beta))
    converged = hit & (jnp.abs(omega - start) <= 100.0 * near)
    found = wall.alpha if is_row else wall.beta
    exists = on_lobe & (found > 0) if is_row else on_lobe
    if line != "lower":
        # Below one period a line meets P(-1) = 0 too, where alpha + 2 beta is known.
        usable = (loop.lag == 0) & (loop.plant.gap > 0)
        rest = 2.0 * (1.0 + loop.plant.c) / jnp.where(usable, loop.plant.gap, 1.0)
        rest = rest - 2.0 * number if is_row else 0.5 * (rest - number)
        is_real = usable & (rest < jnp.where(exists, found, jnp.inf))
        is_real = is_real & (rest > 0) if is_row else is_real
        omega, found = jnp.where(is_real, jnp.pi, omega), jnp.where(is_real, rest, found)
        exists, converged = exists | is_real, converged | is_real
    if is_row:
        # Require a stable wall below the limit.
        exists = exists & stable_kernel(0.5 * found, number, delta, d)
    else:
        exists = exists & (number > 0) & (number < ridge.alpha)
    status = jnp.where(exists, jnp.where(converged, int(Status.OK), int(Status.NOT_CONVERGED)), int(Status.NO_BOUNDARY))
    status = jnp.where(ok, status, given)
    spoiled = nan_with_nan_slopes(status == Status.OK, *inputs)
    alpha, beta = (found, number) if is_row else (number, found)
    return alpha + spoiled, beta + spoiled, omega + spoiled, status.astype(jnp.int32)
