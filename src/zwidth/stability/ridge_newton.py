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
from zwidth.batching import stored
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


def omega_of(s: Array) -> Array:
    """``omega = 2 asin(s)``, pi with derivative 0 at the corner."""
    corner = s >= 1.0
    y = jnp.where(corner, 0.25, s * s)
    low = y < 0.5
    small = jnp.where(low, y, 1.0 - y)
    angle = 2.0 * jnp.sqrt(small) * _horner(4.0 * small - 1.0, _ARCSIN)
    return jnp.where(corner, np.pi, jnp.where(low, angle, np.pi - angle))


class Wave(NamedTuple):
    """The oscillating factors at one s, finite with all their derivatives for every ridge."""

    tau: Array  # times scale
    kappa: Array
    scale: Array  # sin^2 omega, 1 where it may vanish


def wave(s: Array, D: Array, delay: str) -> Wave:
    """tau and kappa without a division."""
    y = s * s
    q = 1.0 - y
    if delay == "fractional_power":
        # D omega as omega + d omega: nothing cancels near pi, and D = 1 keeps its derivatives in D.
        x = (D - 1.0) * omega_of(s)
        sin, cos = jnp.sin(x), jnp.cos(x)
        inside = s < 1.0
        sin2 = jnp.where(inside, 4.0 * y * q, 1.0)
        sin_w = jnp.where(inside, jnp.sqrt(sin2), 0.0)
        return Wave(cos * sin2 + (q - y) * sin_w * sin, (q - y) * cos - sin_w * sin, sin2)
    is_one = D <= 1.0
    # D >= 2 keeps y below 0.43 and x inside [-pi/2, pi/2]; where D = 1 neither it nor the root is used.
    x = 2.0 * D * (s * _horner(4.0 * y - 1.0, _ARCSIN)) - 0.5 * np.pi
    sin, cos = _horner(x * x, _COS), -x * _horner(x * x, _SIN)
    tau = 2.0 * s * jnp.sqrt(jnp.where(is_one, 1.0, q)) * sin
    return Wave(jnp.where(is_one, 1.0, tau), jnp.where(is_one, q - y, cos), jnp.where(is_one, 1.0, 4.0 * y * q))


def _real_m(y: Array, curve: Curve) -> Array:
    """Re M, free of cancellation at both ends."""
    return jnp.where(y < 0.5, curve.at_one - 2.0 * curve.b * y, 2.0 * curve.b * (1.0 - y) - curve.gap)


def wall(s: Array, curve: Curve, D: Array, delay: str) -> tuple[Array, Array]:
    """(alpha, beta) of the curve at one s."""
    y = s * s
    tau, kappa, scale = wave(s, D, delay)
    g1 = curve.g1[0] + y * (curve.g1[1] + y * curve.g1[2])
    g2 = curve.g2[0] + y * curve.g2[1]
    sin2 = 4.0 * y * (1.0 - y)
    over_rho = 1.0 / (scale * (_real_m(y, curve) ** 2 + curve.k * curve.k * sin2))
    kappa = kappa * scale
    alpha = 4.0 * y * (tau * g1 + kappa * g2) * over_rho
    return alpha, -(kappa * g1 - sin2 * tau * g2) * over_rho - 0.5 * alpha


def stationarity(s: Array, curve: Curve, D: Array, delay: str) -> tuple[Array, Array]:
    """T and dT/ds, both times scale^3 (sin^6 omega), see the head of this file."""
    y = s * s
    q = 1.0 - y
    cos_w = q - y
    tau, kappa, scale = wave(s, D, delay)
    # For D = 1 kappa is cos omega and the next two are exactly 0.
    tau1 = 2.0 * (D * kappa * scale - tau * cos_w)
    tau2 = -4.0 * (1.5 * cos_w * tau1 + (D * D - 1.0) * tau * scale)
    tau, kappa, tau1 = tau * scale * scale, kappa * scale * scale * scale, tau1 * scale
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
    first = rho * (value + y * slope) - weighted * drho
    return first, 2.0 * s * (rho * (2.0 * slope + y * bend) - weighted * ddrho)


def ends_in_corner(curve: Curve, D: Array, known: Array) -> Array:
    """Whether the ridge is the double pole at z = -1: the lobe reaches y = 1 with alpha > 0, still rising.

    The curve gets there on the first lobe only if D = 1 and if arg M grows up to pi: N(-1) > 0, k > 0. ``known`` is
    `Start.corner`, which decides where it can.
    """
    g1 = sum(curve.g1[1:], curve.g1[0])
    g2 = curve.g2[0] + curve.g2[1]
    value, slope = g1 - g2, curve.g1[1] + 2.0 * curve.g1[2] - 2.0 * g2 - curve.g2[1]
    rho, drho = curve.gap**2, 4.0 * (curve.b * curve.gap - curve.k**2)
    rising = rho * (value + slope) - value * drho >= 0.0
    judged = (D <= 1.0) & (curve.gap > 0.0) & (curve.k > 0.0) & (value > 0.0) & rising
    return jnp.where(known == 0.0, judged, known > 0.0)


class Start(NamedTuple):
    """What the solver needs to know of (delta, d) to begin."""

    scale: Array  # u = 1/(d + 1)
    strength: Array  # t = r/(r + 3) with r = delta (d + 1): 0 undamped, 1 for delta -> infinity
    corner: Array  # whether the ridge is a corner, where (delta, d) alone says so: 1 yes, -1 no, 0 unknown


# The last smooth delta at d = 0: the corner takes over at 3.6593616274217835070, 4e-18 above this float64. Judged by
# rounded coefficients of the curve, its next neighbors would fall on either side.
_TAKE_OVER = 3.6593616274217835


def start_of(delta: Array, d: Array) -> Start:
    """Where to begin for one (delta, d)."""
    r = delta * (d + 1.0)
    corner = jnp.where(d == 0.0, jnp.where(delta > _TAKE_OVER, 1.0, -1.0), 0.0)
    return jax.lax.stop_gradient(Start(1.0 / (d + 1.0), r / (r + 3.0), corner))


# For every delta and d, s (d + 1) lies between 0.53 and 1.25, and the fit below is within 4 %: four steps then leave
# nothing but rounding (the third about 1e-9).
_HELD_STEPS = 4
_FRACTIONAL_STEPS = 12


def _first(start: Start, lower: Array, upper: Array) -> Array:
    """A fit of s by least squares over delta and d, clipped to the bracket."""
    u, t, _ = start
    return jnp.clip((0.551 + 0.493 * t + (t * u) ** 2 * (1.204 * u - 0.701)) * u, lower, upper)


def _solve_held(curve: Curve, D: Array, start: Start) -> tuple[Array, Array]:
    """Newton's method clipped to a bracket that holds every ridge; the last step comes back too."""
    lower, upper = 0.5 * start.scale, jnp.minimum(1.0, 1.3 * start.scale)
    s = _first(start, lower, upper)

    def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        s, _ = state
        value, slope = stationarity(s, curve, D, "held")
        new = jnp.clip(s - value / slope, lower, upper)
        return new, new - s

    return jax.lax.fori_loop(0, _HELD_STEPS, step, (s, s))


def _solve_fractional(curve: Curve, D: Array, start: Start) -> tuple[Array, Array]:
    """The same with a shrinking bracket.

    For small d the ridge sits near omega = pi, where T behaves like A + B q - C d q^(-3/2): there the step is
    Newton's for ``T q^(3/2)`` as a function of ``q^(5/2)``.
    """
    d = D - 1.0
    is_one = D <= 1.0
    lower = 0.5 * start.scale
    # d = 0 may end at pi itself, where 1/sin omega is infinite.
    rest = jnp.maximum(0.3 * jnp.minimum(d, 0.05) ** (2.0 / 3.0), jnp.finfo(d.dtype).eps)
    upper = jnp.minimum(jnp.sqrt(1.0 - rest), 1.05 * start.scale)
    s = _first(start, lower, upper)

    def step(_: int, state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        s, _, lower, upper = state
        value, slope = stationarity(s, curve, D, "fractional_power")
        rising = value > 0.0
        lower, upper = jnp.where(rising, s, lower), jnp.where(rising, upper, s)
        q = 1.0 - s * s
        near = (q < 0.5) & ~is_one
        # dq = -2 s ds
        scaled = 3.0 * s * value - q * slope
        ratio = 1.0 - 5.0 * s * value / scaled
        usable = jnp.where(near, (scaled > 0.0) & (ratio > 0.0), slope < 0.0)
        power = jnp.where(near & usable, ratio, 1.0) ** 0.4
        candidate = jnp.clip(jnp.where(near, jnp.sqrt(1.0 - q * power), s - value / slope), lower, upper)
        # Off the bracket, towards pi, q is bisected geometrically: it may be small.
        inner = jnp.sqrt(1.0 - jnp.sqrt((1.0 - lower * lower) * (1.0 - upper * upper)))
        new = jnp.where(usable, candidate, jnp.where(rising, inner, 0.5 * (lower + upper)))
        return new, new - s, lower, upper

    s, last, _, _ = jax.lax.fori_loop(0, _FRACTIONAL_STEPS, step, (s, s, lower, upper))
    return s, last


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def ridge_point(curve: Curve, D: Array, start: Start, delay: str) -> tuple[Array, Array]:
    """The s of the ridge, exactly 1 at a corner, and the last step taken; differentiable in ``curve`` and D."""
    solve = _solve_fractional if delay == "fractional_power" else _solve_held
    s, last = solve(curve, D, start)
    corner = ends_in_corner(curve, D, start.corner)
    # Just before the take-over a smooth optimum may round to the corner's place.
    smooth = jnp.minimum(s, 1.0 - 0.5 * jnp.finfo(s.dtype).eps)
    return jnp.where(corner, 1.0, smooth), jnp.where(corner, 0.0, last)


@ridge_point.defjvp
def _ridge_point_jvp(delay: str, primals: tuple, tangents: tuple) -> tuple:
    """Implicit derivative ``ds = -dT/(dT/ds)``; calls `ridge_point` itself, hence right to any order."""
    curve, D, start = primals
    s, last = ridge_point(curve, D, start, delay)
    change = _directional(lambda c, e: stationarity(s, c, e, delay)[0], curve, D, tangents, delay)
    _, slope = stationarity(s, curve, D, delay)
    smooth = s < 1.0
    ds = jnp.where(smooth, -change / jnp.where(smooth, slope, 1.0), 0.0)
    return (s, last), (ds, jnp.zeros_like(last))


def _directional(function, curve: Curve, D: Array, tangents: tuple, delay: str) -> Array:
    """The change of ``function(curve, D)``; in the held model D is whole and does not move."""
    if delay == "held":
        return jax.jvp(lambda c: function(c, D), (curve,), (tangents[0],))[1]
    return jax.jvp(function, (curve, D), (tangents[0], tangents[1]))[1]


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def peak(curve: Curve, D: Array, s: Array, delay: str) -> Array:
    """alpha at the ridge's s. Envelope theorem: its derivative is the partial one at fixed s, corner or smooth."""
    return wall(s, curve, D, delay)[0]


@peak.defjvp
def _peak_jvp(delay: str, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    curve, D, s = primals
    # The tangent is a function of s too: that is where second derivatives come from.
    change = _directional(lambda c, e: wall(s, c, e, delay)[0], curve, D, tangents, delay)
    return wall(s, curve, D, delay)[0], change


class NewtonRidge(NamedTuple):
    """The ridge of one point."""

    alpha: Array
    beta: Array
    omega: Array
    is_corner: Array
    converged: Array


def newton_ridge(plant: Plant, lag: Array, start: Start, delay: str) -> NewtonRidge:
    """The ridge of one plant behind ``lag`` periods (whole in the held model), with exact derivatives."""
    curve = curve_of(stored(plant, start.scale))
    D = lag + 1.0
    s, last = stored(ridge_point(curve, D, start, delay), start.scale)
    # Quadratic convergence: after a step of sqrt(eps) nothing but rounding is left.
    converged = jnp.abs(last) <= jnp.sqrt(jnp.finfo(s.dtype).eps) * s
    is_corner = s >= 1.0
    alpha, beta, omega = peak(curve, D, s, delay), wall(s, curve, D, delay)[1], omega_of(s)
    if delay == "fractional_power":
        # The corner is left like -d^(2/3) as soon as d > 0: all three fall with infinite slope.
        fall = jnp.where(is_corner, jnp.sqrt(jnp.where(is_corner, lag, 1.0)), 0.0)
        alpha, beta, omega = alpha - fall, beta - fall, omega - fall
    return NewtonRidge(alpha, beta, omega, is_corner, converged)
