"""The ridge by Newton's method on its closed-form optimality condition.

The curve z = e^(j omega) and its slope are written in ``y = sin^2(omega/2)``. There the maximum stays a regular
one at omega = pi, where every derivative in omega vanishes by symmetry, and the corner is the end point y = 1.
With D = n + 1 (held) or D = d + 1 (fractional power), q = 1 - y, M = N(z)/z and a prime for d/dy:

    (z - c) conj M = g1 + j g2 sin omega     quadratic and linear in y
    |M|^2 = rho = m^2 + k^2 4 y q            m = Re M = N(1) - 2 b y, b = a2 + a0, k = a2 - a0
    tau = sin(D omega)/sin omega             kappa = cos(D omega)
    Q = tau g1 + kappa g2
    alpha = 4 y Q/rho                        beta = -(kappa g1 - 4 y q tau g2)/rho - alpha/2
    T = rho (Q + y Q') - y Q rho' = 0        T = rho^2 alpha'/4,  T' = rho (2 Q' + y Q'') - y Q rho''

tau is the Chebyshev polynomial U_(D-1) of cos omega for whole D, kappa is T_D, hence

    kappa' = -2 D tau     tau' = (D kappa - tau cos omega)/(2 y q)
    tau'' = -((3/2) cos omega tau' + (D^2 - 1) tau)/(y q)          and for D = 1: tau = 1, kappa = 1 - 2 y

No logarithm, no arc tangent and, for D = 1, no angle at all. The number of steps is fixed: no point waits for another.
"""

from __future__ import annotations

from functools import partial
from math import factorial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array
from zwidth.plant import Plant


class Curve(NamedTuple):
    """Coefficients in y of the curve of one device: all that the solver needs beside the exponent D."""

    g1: tuple[Array, Array, Array]
    g2: tuple[Array, Array]
    at_one: Array  # N(1)
    b: Array
    k: Array
    gap: Array  # N(-1)


def curve_of(plant: Plant) -> Curve:
    """The curve of one plant; every coefficient is free of cancellation where the ridge can be."""
    c, em, a2, a1, a0, gap = plant.c, plant.em, plant.a2, plant.a1, plant.a0, plant.gap
    b = a2 + a0
    at_one = b + a1
    g1 = (em * at_one, -2.0 * (4.0 * a0 - gap + em * b), 8.0 * a0)
    g2 = (a1 + a2 * c + a0 * (1.0 + em), -4.0 * a0)
    return Curve(g1, g2, at_one, b, a2 - a0, gap)


def _chebyshev_fit(terms: int) -> list[float]:
    """``asin(sqrt y)/sqrt y`` on [0, 1/2] as powers of 4 y - 1, by interpolation: 2e-16 relative with 19 terms."""
    node = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    y = 0.25 * (node + 1.0)
    fit = np.polynomial.chebyshev.chebfit(node, np.arcsin(np.sqrt(y)) / np.sqrt(y), terms - 1)
    return np.polynomial.chebyshev.cheb2poly(fit).tolist()


_ARCSIN = _chebyshev_fit(19)
# Taylor series; on |x| <= pi/2 the first term left out is below 1e-17.
_SIN = [(-1.0) ** i / factorial(2 * i + 1) for i in range(11)]
_COS = [(-1.0) ** i / factorial(2 * i) for i in range(12)]


def _horner(x: Array, coefficients: list[float]) -> Array:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def half_angle(y: Array) -> Array:
    """``asin(sqrt y)`` for y in [0, 1/2]; XLA's own trigonometry would cost more than all the rest together."""
    return jnp.sqrt(y) * _horner(4.0 * y - 1.0, _ARCSIN)


class Wave(NamedTuple):
    """The oscillating factors at one y."""

    tau: Array
    kappa: Array
    over_sin2: Array  # 1/sin^2 omega, 1 where D = 1
    is_one: Array  # D = 1


def wave(y: Array, D: Array, delay: str) -> Wave:
    """tau and kappa; finite with all derivatives for 0 < y <= 1 where D = 1, for 0 < y < 1 elsewhere."""
    q = 1.0 - y
    is_one = D <= 1.0
    over_sin2 = 1.0 / jnp.where(is_one, 1.0, 4.0 * y * q)
    if delay == "fractional_power":
        # Beyond omega = pi/2 the angle is taken from pi, where D omega = pi + (pi d - D v) with small terms.
        low = y < 0.5
        half = half_angle(jnp.where(is_one, 0.25, jnp.where(low, y, q)))
        x = jnp.where(low, 2.0 * D * half, np.pi * (D - 1.0) - 2.0 * D * half)
        sign = jnp.where(low, 1.0, -1.0)
        sin, cos = sign * jnp.sin(x), sign * jnp.cos(x)
    else:
        # D >= 2 keeps y below 0.43 and x inside [-pi/2, pi/2]; where D = 1 the result is not used.
        x = 2.0 * D * half_angle(y) - 0.5 * np.pi
        sin, cos = _horner(x * x, _COS), -x * _horner(x * x, _SIN)
    tau = jnp.where(is_one, 1.0, sin * jnp.sqrt(over_sin2))
    return Wave(tau, jnp.where(is_one, q - y, cos), over_sin2, is_one)


def _real_m(y: Array, curve: Curve) -> Array:
    """Re M, free of cancellation at both ends."""
    return jnp.where(y < 0.5, curve.at_one - 2.0 * curve.b * y, 2.0 * curve.b * (1.0 - y) - curve.gap)


def wall(y: Array, curve: Curve, D: Array, delay: str) -> tuple[Array, Array]:
    """(alpha, beta) of the curve at one y."""
    tau, kappa, _, _ = wave(y, D, delay)
    g1 = curve.g1[0] + y * (curve.g1[1] + y * curve.g1[2])
    g2 = curve.g2[0] + y * curve.g2[1]
    sin2 = 4.0 * y * (1.0 - y)
    over_rho = 1.0 / (_real_m(y, curve) ** 2 + curve.k * curve.k * sin2)
    alpha = 4.0 * y * (tau * g1 + kappa * g2) * over_rho
    return alpha, -(kappa * g1 - sin2 * tau * g2) * over_rho - 0.5 * alpha


def stationarity(y: Array, curve: Curve, D: Array, delay: str) -> tuple[Array, Array]:
    """T and T', see the head of this file."""
    q = 1.0 - y
    cos_w = q - y
    tau, kappa, over_sin2, is_one = wave(y, D, delay)
    tau1 = jnp.where(is_one, 0.0, 2.0 * (D * kappa - tau * cos_w) * over_sin2)
    tau2 = jnp.where(is_one, 0.0, -4.0 * (1.5 * cos_w * tau1 + (D * D - 1.0) * tau) * over_sin2)
    g1 = curve.g1[0] + y * (curve.g1[1] + y * curve.g1[2])
    g2 = curve.g2[0] + y * curve.g2[1]
    dg1, dg2 = curve.g1[1] + 2.0 * y * curve.g1[2], curve.g2[1]
    m, k2 = _real_m(y, curve), curve.k * curve.k
    rho = m * m + 4.0 * k2 * y * q
    drho, ddrho = 4.0 * (k2 * cos_w - curve.b * m), 8.0 * (curve.b * curve.b - k2)
    twice = 2.0 * D
    value = tau * g1 + kappa * g2
    slope = tau1 * g1 + tau * (dg1 - twice * g2) + kappa * dg2
    bend = tau2 * g1 + tau1 * (2.0 * dg1 - twice * g2) + 2.0 * tau * (curve.g1[2] - twice * dg2)
    weighted = y * value
    return rho * (value + y * slope) - weighted * drho, rho * (2.0 * slope + y * bend) - weighted * ddrho


def ends_in_corner(curve: Curve, D: Array) -> Array:
    """Whether the ridge is the double pole at z = -1: the lobe reaches y = 1 with alpha > 0, still rising.

    The curve gets there on the first lobe only if D = 1 and if arg M grows up to pi: N(-1) > 0, k > 0.
    """
    g1 = sum(curve.g1[1:], curve.g1[0])
    g2 = curve.g2[0] + curve.g2[1]
    value, slope = g1 - g2, curve.g1[1] + 2.0 * curve.g1[2] - 2.0 * g2 - curve.g2[1]
    rho, drho = curve.gap**2, 4.0 * (curve.b * curve.gap - curve.k**2)
    rising = rho * (value + slope) - value * drho >= 0.0
    return (D <= 1.0) & (curve.gap > 0.0) & (curve.k > 0.0) & (value > 0.0) & rising


class Start(NamedTuple):
    """What the solver needs to know of (delta, d) to begin."""

    scale: Array  # 1/(d + 1)^2; y over it lies between 0.28 and 1.57 for every delta and d
    strength: Array  # r/(r + 4) with r = delta (d + 1): 0 undamped, 1 for delta -> infinity


def start_of(delta: Array, d: Array) -> Start:
    """Where to begin for one (delta, d)."""
    r = delta * (d + 1.0)
    return jax.lax.stop_gradient(Start(1.0 / ((d + 1.0) * (d + 1.0)), r / (r + 4.0)))


# The start is within 24 % for every delta and d; five steps then leave 1e-15 (the fourth 4e-10).
_HELD_STEPS = 5
_FRACTIONAL_STEPS = 12


def _solve_held(curve: Curve, D: Array, start: Start) -> tuple[Array, Array]:
    """Newton's method clipped to a bracket that holds every ridge; the last step comes back too."""
    lower, upper = 0.25 * start.scale, jnp.minimum(1.0, 1.7 * start.scale)
    y = jnp.clip((0.353 + 0.879 * start.strength) * start.scale, lower, upper)
    before = y
    for _ in range(_HELD_STEPS):
        value, slope = stationarity(y, curve, D, "held")
        before, y = y, jnp.clip(y - value / slope, lower, upper)
    return y, y - before


def _solve_fractional(curve: Curve, D: Array, start: Start) -> tuple[Array, Array]:
    """The same with a shrinking bracket.

    For small d the ridge sits near omega = pi, where T behaves like A + B q - C d q^(-3/2): there the step is
    Newton's for ``T q^(3/2)`` as a function of ``q^(5/2)``.
    """
    d = D - 1.0
    is_one = D <= 1.0
    lower = 0.25 * start.scale
    upper = jnp.minimum(1.0 - 0.3 * jnp.minimum(d, 0.05) ** (2.0 / 3.0), 1.1 * start.scale)
    y = jnp.clip((0.353 + 0.879 * start.strength) * start.scale, lower, upper)

    def step(_: int, state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        y, _, lower, upper = state
        value, slope = stationarity(y, curve, D, "fractional_power")
        rising = value > 0.0
        lower, upper = jnp.where(rising, y, lower), jnp.where(rising, upper, y)
        q = 1.0 - y
        near = (y > 0.5) & ~is_one
        scaled = 1.5 * value - q * slope
        ratio = 1.0 - 2.5 * value / scaled
        usable = jnp.where(near, (scaled > 0.0) & (ratio > 0.0), slope < 0.0)
        power = jnp.where(near & usable, ratio, 1.0) ** 0.4
        candidate = jnp.clip(jnp.where(near, 1.0 - q * power, y - value / slope), lower, upper)
        # Off the bracket, towards pi, q is bisected geometrically: it may be small.
        inner = 1.0 - jnp.sqrt((1.0 - lower) * (1.0 - upper))
        middle = jnp.where(rising, inner, 0.5 * (lower + upper))
        new = jnp.where(usable, candidate, middle)
        return new, new - y, lower, upper

    y, last, _, _ = jax.lax.fori_loop(0, _FRACTIONAL_STEPS, step, (y, y, lower, upper))
    return y, last


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def ridge_point(curve: Curve, D: Array, start: Start, delay: str) -> tuple[Array, Array]:
    """The y of the ridge, exactly 1 at a corner, and the last step taken; differentiable in ``curve`` and D."""
    solve = _solve_fractional if delay == "fractional_power" else _solve_held
    y, last = solve(curve, D, start)
    corner = ends_in_corner(curve, D)
    return jnp.where(corner, 1.0, y), jnp.where(corner, 0.0, last)


@ridge_point.defjvp
def _ridge_point_jvp(delay: str, primals: tuple, tangents: tuple) -> tuple:
    """Implicit derivative ``dy = -dT/T'``; calls `ridge_point` itself, hence right to any order."""
    curve, D, start = primals
    y, last = ridge_point(curve, D, start, delay)
    change = _directional(lambda c, e: stationarity(y, c, e, delay)[0], curve, D, tangents, delay)
    _, slope = stationarity(y, curve, D, delay)
    smooth = y < 1.0
    dy = jnp.where(smooth, -change / jnp.where(smooth, slope, 1.0), 0.0)
    return (y, last), (dy, jnp.zeros_like(last))


def _directional(function, curve: Curve, D: Array, tangents: tuple, delay: str) -> Array:
    """The change of ``function(curve, D)``; in the held model D is whole and does not move."""
    if delay == "held":
        return jax.jvp(lambda c: function(c, D), (curve,), (tangents[0],))[1]
    return jax.jvp(function, (curve, D), (tangents[0], tangents[1]))[1]


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def peak(curve: Curve, D: Array, y: Array, delay: str) -> Array:
    """alpha at the ridge's y. Envelope theorem: its derivative is the partial one at fixed y, corner or smooth."""
    return wall(y, curve, D, delay)[0]


@peak.defjvp
def _peak_jvp(delay: str, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    curve, D, y = primals
    # The tangent is a function of y too: that is where second derivatives come from.
    change = _directional(lambda c, e: wall(y, c, e, delay)[0], curve, D, tangents, delay)
    return wall(y, curve, D, delay)[0], change


def omega_of(y: Array) -> Array:
    """``omega = 2 asin(sqrt y)``, pi with derivative 0 at the corner."""
    corner = y >= 1.0
    low = y < 0.5
    angle = 2.0 * half_angle(jnp.where(corner, 0.25, jnp.where(low, y, 1.0 - y)))
    return jnp.where(corner, np.pi, jnp.where(low, angle, np.pi - angle))


class NewtonRidge(NamedTuple):
    """The ridge of one point."""

    alpha: Array
    beta: Array
    omega: Array
    is_corner: Array
    converged: Array


def newton_ridge(plant: Plant, lag: Array, start: Start, delay: str) -> NewtonRidge:
    """The ridge of one plant behind ``lag`` periods (whole in the held model), with exact derivatives."""
    curve = curve_of(plant)
    D = lag + 1.0
    y, last = ridge_point(curve, D, start, delay)
    # Quadratic convergence: after a step of sqrt(eps) nothing but rounding is left.
    converged = jnp.abs(last) <= jnp.sqrt(jnp.finfo(y.dtype).eps) * y
    return NewtonRidge(peak(curve, D, y, delay), wall(y, curve, D, delay)[1], omega_of(y), y >= 1.0, converged)
