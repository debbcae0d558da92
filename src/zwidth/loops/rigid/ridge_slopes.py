"""Derivatives of the rigid loop's ridge in closed form.

At a maximum the frequency's own change does not count (envelope theorem), so that alpha_max moves as the curve does at
a fixed z. With U = z^D (z - c)/M and alpha = 4 y Im U/sin omega, see `loops.rigid.ridge_newton`,

    dU = -z^D conj M/rho dc - U conj M/rho dM + j omega U dD

The plant's coefficients are samples of an exponential spline: a delay a little longer moves the sampled position by
the velocity, a damping a little larger by moments of e^-x that are all of one sign.
"""

from __future__ import annotations

from functools import cache
from math import factorial
from typing import Any

import numpy as np

from zwidth.arrays.xp import horner, namespace, push_forward
from zwidth.loops.rigid.device import DelayClasses, Plant, held_plant, phi_functions
from zwidth.loops.rigid.ridge_newton import (
    Ridge,
    Start,
    expand_curve,
    is_undelayed,
    sides,
    solve,
    stationarity,
    wall,
    wave,
)
from zwidth.words.types import Array

# -phi2' = gap/x = e^(-x/2) sum_k (k + 1) (x/2)^(2k) / (2k + 3)!, as in `loops.rigid.device`
_CHI = [(k + 1.0) / factorial(2 * k + 3) for k in range(13)]


def _chi(x: Array, gap: Array) -> Array:
    """``gap/x = -phi2'``, 1/6 at 0; ``psi' = chi - psi`` and ``phi1' = -psi``."""
    xp = namespace(x)
    small = x < 2.5
    half = xp.where(small, 0.5 * x, 0.0)
    return xp.where(small, xp.exp(-half) * horner(half * half, _CHI), gap / xp.where(small, 1.0, x))


def plant_slopes(delta: Array, fraction: Array) -> tuple[Plant, Plant]:
    """The derivatives of `loops.rigid.device.held_plant` in delta and in the fraction."""
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


def alpha_change(s: Array, plant: Plant, lag: Array, change: Plant, undelayed: bool = False) -> Array:
    """How alpha moves at a fixed s (1 at a corner) when the plant does."""
    xp = namespace(s, plant.a2)
    curve = expand_curve(plant)
    at = wave(s, lag, undelayed)
    g1, g2, m, rho = sides(at, curve)
    y, q, tau, kappa = at.y, at.q, at.tau, at.kappa
    b, k, dk, sin2 = change.a2 + change.a0, curve.k, change.a2 - change.a0, 4.0 * y * q
    dm = xp.where(y < 0.5, b * (1.0 - 2.0 * y) + change.a1, 2.0 * b * q - change.gap)
    # dM conj M = h1 + j h2 sin omega
    h1, h2 = dm * m + dk * k * sin2, dk * m - dm * k
    turned = tau * (g1 * h1 - g2 * h2 * sin2) + kappa * (g1 * h2 + g2 * h1)
    return -4.0 * y * (change.c * (tau * m - kappa * k) + turned / rho) / rho


def alpha_by_lag(ridge: Ridge, lag: Array) -> Array:
    """How alpha moves with the exponent D; -inf at a corner, which the fractional power leaves like -d^(2/3)."""
    xp = namespace(ridge.s, lag)
    at = wave(ridge.s, lag, True)
    slope = -8.0 * at.y * at.half * at.per_sin * (ridge.beta + 0.5 * ridge.alpha)
    return xp.where(ridge.s >= 1.0, -np.inf, slope)


def differentiable_plant(delta: Array, fraction: Array) -> Plant:
    """`loops.rigid.device.held_plant`, in JAX with its derivatives in closed form."""
    return held_plant(delta, fraction) if namespace(delta, fraction) is np else _jax_plant()(delta, fraction)


def differentiable_ridge(plant: Plant, lag: Array, start: Start, delay_model: str, kind: DelayClasses) -> Ridge:
    """`loops.rigid.ridge_newton.solve`, in JAX with derivatives in plant and lag to any order."""
    if namespace(plant.a2, lag) is np:
        return solve(plant, lag, start, delay_model, kind)
    import jax
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
    share = jax.lax.stop_gradient(jnp.where(corner, (body / lean - 1.0) / 3.0, 0.0))
    return ridge._replace(alpha=ridge.alpha - fall, beta=ridge.beta - share * fall, omega=ridge.omega - fall)


def move_ridge(
    ridge: Ridge, plant: Plant, lag: Array, change: Plant, lag_change: Array, delay_model: str, kind: DelayClasses
) -> Ridge:
    """How the ridge moves when the plant and the lag do; whole periods do not."""
    xp = namespace(ridge.s, plant.a2)
    corner = ridge.s >= 1.0
    undelayed = is_undelayed(delay_model, kind)
    alpha = alpha_change(ridge.s, plant, lag, change, undelayed)
    if delay_model == "fractional_power":
        alpha += xp.where(corner, 0.0, alpha_by_lag(ridge, lag)) * lag_change
    else:
        lag_change = xp.zeros_like(lag)
    curve = expand_curve(plant)
    along = (push_forward(expand_curve, (plant,), (change,), xp), lag_change)
    first = push_forward(lambda curve, lag: stationarity(ridge.s, curve, lag, undelayed)[0], (curve, lag), along, xp)
    _, second = stationarity(ridge.s, curve, lag, undelayed)
    s = xp.where(corner, 0.0, -first / xp.where(corner, 1.0, second))
    _, beta = push_forward(lambda s, curve, lag: wall(s, curve, lag, undelayed), (ridge.s, curve, lag), (s, *along), xp)
    root = xp.sqrt(xp.where(corner, 1.0, (1.0 - ridge.s) * (1.0 + ridge.s)))
    return Ridge(alpha, beta, 2.0 * s / root, s, xp.zeros_like(s))


@cache
def _jax_plant() -> Any:
    import jax

    function = jax.custom_jvp(held_plant)

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

    @function.defjvp
    def rule(delay_model: str, kind: DelayClasses, primals: tuple, tangents: tuple) -> tuple[Ridge, Ridge]:
        # The rule calls the function itself and is made of differentiable formulas: hence right to any order.
        plant, lag, start = primals
        ridge = function(plant, lag, start, delay_model, kind)
        return ridge, move_ridge(ridge, plant, lag, tangents[0], tangents[1], delay_model, kind)

    return function
