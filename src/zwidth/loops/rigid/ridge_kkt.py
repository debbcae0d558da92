"""The ridge as a constrained optimum, by optimistix (any loop): maximize alpha subject to P(e^(j omega)) = 0.

This route needs of a loop only its frequency response, affine in (alpha, beta). The unknowns are real:

    Re P = 0,  Im P = 0,  Im(conj(dP/dbeta) dP/domega) = 0

The last is the stationarity of the Lagrangian with the multipliers eliminated: moving along the curve may change
beta only. jaxopt's bisection brackets the optimum, optimistix' Newton method finishes it and supplies the
implicit derivative.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix

from zwidth.arrays.xla import store_once
from zwidth.loops.domain import device_status, poison
from zwidth.loops.rigid.bracketing import bisect, lobe_end
from zwidth.loops.rigid.polynomial import FrequencyLoop, frequency_boundary, frequency_loop
from zwidth.loops.rigid.ridge import RidgeKind, RidgePoint
from zwidth.loops.rigid.ridge_newton import corner, expand_curve
from zwidth.words.status import Status
from zwidth.words.types import Array

_MAX_STEPS = 16


def frequency_residual(omega: Array, alpha: Array, beta: Array, loop: FrequencyLoop) -> Array:
    """``P(e^(j omega))/e^(j (2 + n) omega)`` as a real pair."""
    plant, whole = loop
    sin = jnp.sin(omega)
    # (z - 1)(z - c), then z^-n M (alpha + beta (1 - 1/z)), all as real pairs: optimistix wants real unknowns.
    re_1, re_c = -2.0 * jnp.sin(0.5 * omega) ** 2, plant.em - 2.0 * jnp.sin(0.5 * omega) ** 2
    re_m = -plant.gap + 2.0 * (plant.a2 + plant.a0) * jnp.cos(0.5 * omega) ** 2
    im_m = (plant.a2 - plant.a0) * sin
    re_w, im_w = alpha - beta * re_1, beta * sin
    re_mw, im_mw = re_m * re_w - im_m * im_w, re_m * im_w + im_m * re_w
    lag_re, lag_im = jnp.cos(whole * omega), -jnp.sin(whole * omega)
    re = re_1 * re_c - sin * sin + lag_re * re_mw - lag_im * im_mw
    im = sin * (re_1 + re_c) + lag_re * im_mw + lag_im * re_mw
    return jnp.stack([re, im])


class KktArguments(NamedTuple):
    """The parameters of the optimality conditions."""

    loop: FrequencyLoop
    scale_alpha: Array
    scale_beta: Array


def kkt_residual(unknowns: Array, args: KktArguments) -> Array:
    """The three optimality conditions, of order one; ``unknowns`` are alpha and beta over their scales, and omega."""

    def residual(beta: Array, omega: Array) -> Array:
        return frequency_residual(omega, unknowns[0] * args.scale_alpha, beta * args.scale_beta, args.loop)

    point = (unknowns[1], unknowns[2])
    value, by_beta = jax.jvp(residual, point, (jnp.ones_like(point[0]), jnp.zeros_like(point[0])))
    _, by_omega = jax.jvp(residual, point, (jnp.zeros_like(point[0]), jnp.ones_like(point[0])))
    size = jnp.sqrt(jnp.sum(by_beta**2) * jnp.sum(by_omega**2))
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
    stationary = (by_beta[0] * by_omega[1] - by_beta[1] * by_omega[0]) / size
    return jnp.stack([value[0], value[1], stationary])


def kkt_kernel(delta: Array, d: Array, delay_model: str) -> RidgePoint:
    """`zwidth.alpha_max` of one point by this route."""
    status = device_status(delta, d)
    ok, inputs = status == Status.OK, (delta, d)
    # A solver that sees NaN in one lane may stop the others.
    delta, d = jnp.where(ok, delta, 1.0), jnp.where(ok, d, 1.0)
    loop = store_once(frequency_loop(delta, d, delay_model), delta)
    end = corner(expand_curve(loop.plant), loop.lag)
    omega, found = _smooth_omega(loop, d, delay_model)
    smooth = frequency_boundary(omega, loop, delay_model)
    converged = jnp.logical_or(end.is_ridge, found)
    spoiled = poison(ok & converged, *inputs)
    status = jnp.where(ok & ~converged, int(Status.NOT_CONVERGED), status)
    return RidgePoint(
        jnp.where(end.is_ridge, end.alpha, smooth.alpha) + spoiled,
        jnp.where(end.is_ridge, end.beta, smooth.beta) + spoiled,
        jnp.where(end.is_ridge, jnp.pi, omega) + spoiled,
        jnp.where(end.is_ridge, RidgeKind.CORNER, RidgeKind.SMOOTH).astype(jnp.int32),
        status.astype(jnp.int32),
    )


def _smooth_omega(loop: FrequencyLoop, d: Array, delay_model: str) -> tuple[Array, Array]:
    """The frequency of the smooth optimum of one point, differentiable in ``loop``, and whether it was found."""

    def slope(omega: Array, loop: FrequencyLoop) -> Array:
        return jax.grad(lambda w: frequency_boundary(w, loop, delay_model).alpha)(omega)

    end = store_once(lobe_end(loop, d, delay_model), d)
    # Below, the slope is positive; at pi itself it vanishes by symmetry whatever the optimum.
    upper = jnp.where(end < jnp.pi, end, jnp.pi * (1.0 - 1e-7))
    start, bracketed = bisect(slope, 1e-6 * end, upper, loop)
    start = store_once(start, d)
    wall = jax.lax.stop_gradient(store_once(frequency_boundary(start, loop, delay_model), d))
    scale_alpha = jnp.maximum(jnp.abs(wall.alpha), jnp.finfo(wall.alpha.dtype).tiny)
    scale_beta = jnp.maximum(jnp.abs(wall.beta), scale_alpha)
    tolerance = float(16 * jnp.finfo(start.dtype).eps)
    solution = optimistix.root_find(
        kkt_residual,
        optimistix.Newton(rtol=tolerance, atol=tolerance),
        jnp.stack([wall.alpha / scale_alpha, wall.beta / scale_beta, start]),
        args=KktArguments(loop, scale_alpha, scale_beta),
        max_steps=_MAX_STEPS,
        throw=False,
    )
    omega = store_once(solution.value[2], d)
    # Rounding can keep Newton from its last tolerance; what counts is that it stayed where the bracket put it.
    close = jnp.abs(omega - start) <= 1e-5 * end
    return omega, bracketed & close
