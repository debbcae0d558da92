"""Boundary curve of the rigid loop: the walls (alpha, beta) with a pole pair at z = e^(+-j omega).

Curve points are given by s = sin(omega/2) or y = s^2. E, H and V = |M|^2 are polynomials in y; b = beta + delta. On the
unit circle, P = 0 determines the factor W of P, i.e. alpha and beta. With P, M, c, n and delta of
`stability.rigid.characteristic_polynomial` (docs/theory/boundary.md, B1),

    V alpha = 4 y Q                              Q = tau E + kappa H
    V beta = 4 y q tau H - kappa E - 2 y Q
    V b = y excess + drop E + 2 y (2 q tau - kappa) H       b = beta + delta

    (z - c) conj(M) = E + j H sin omega          V = |M|^2       excess = (delta V - E)/y
    y = s^2       s = sin(omega/2)       q = 1 - y       D = n + 1
    tau = sin(D omega)/sin omega         kappa = cos(D omega)    drop = 1 - kappa - 2 y tau

The third equation keeps the relative accuracy of b, which vanishes like y at omega = 0. E, H and excess do not depend
on n. Names that begin with d denote derivatives in y. For n = 0, alpha and b are rational functions of y
(`ShortDelayCurve`). Functions "in any arithmetic" accept arrays, float64 numbers with an error bound, and balls.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import ARCSINE, COSINE, SINE, horner, namespace
from zwidth.stability.rigid.characteristic_polynomial import recover_wall


class Curve(NamedTuple):
    """The terms of one device's boundary curve that do not depend on n. Tuples: coefficients of y^0, y^1, y^2."""

    E: tuple[Any, ...]
    H: tuple[Any, ...]
    at_one: Any  # plant numerator N(z) = z M at z = 1
    sigma: Any  # a2 + a0
    mu: Any  # a2 - a0
    gap: Any  # N at z = -1
    excess: Any = None  # the polynomial (delta V - E)/y, from which b is computed; None if b is not required


def expand_curve(plant: Any, at_one: Any = None) -> Curve:
    """Return the terms of alpha and beta for one plant.

    ``at_one`` is N(1); it is required if the coefficient a0 of the plant is None, which means an integer delay.
    """
    c, em, a2, a1, a0, gap = plant.c, plant.em, plant.a2, plant.a1, plant.a0, plant.gap
    if a0 is None:
        return Curve((em * at_one, (gap - em * a2) * 2.0), (a1 + a2 * c,), at_one, a2, a2, gap)
    sigma = a2 + a0
    at_one = sigma + a1 if at_one is None else at_one
    E = em * at_one, (a0 * 4.0 - gap + em * sigma) * -2.0, a0 * 8.0
    return Curve(E, (a1 + a2 * c + a0 * (1.0 + em), a0 * -4.0), at_one, sigma, a2 - a0, gap)


def expand_curve_with_offset(plant: Any) -> Curve:
    """Return the terms of alpha, beta and b = beta + delta for one `DiscretePlant`."""
    p1, a2, a1, a0, curve = plant.p1, plant.a2, plant.a1, plant.a0, expand_curve(plant, plant.p1)
    # Compute the coefficients of excess = (delta V - E)/y in closed form. The constant terms of delta V - E cancel
    # exactly, because em = 1 - c is delta phi1 (phi1 is ``p1``).
    if a0 is None:
        # For integer delays (f = 0), 1 - delta a2 = phi1 simplifies the formula.
        return curve._replace(excess=(p1 * plant.gap * -2.0,))
    excess0 = p1 * 2.0 - curve.mu * 4.0 + plant.delta * (curve.sigma * (curve.sigma - a1) - a2 * a0 * 8.0) * 2.0
    return curve._replace(excess=(excess0, a0 * (1.0 - plant.delta * a2 * 2.0) * -8.0))


def compute_squared_modulus(y: Any, q: Any, curve: Curve) -> Any:
    """Return V = |M|^2 at y <= 1/2, q = 1 - y, in any arithmetic."""
    m, double_mu = curve.at_one - curve.sigma * y * 2.0, curve.mu * 2.0
    return m * m + double_mu * double_mu * (y * q)


class ShortDelayCurve(NamedTuple):
    """The boundary curve for n = 0, as polynomials in y with the lowest power first."""

    damping: tuple[Any, Any]  # the polynomial V b/y
    modulus: tuple[Any, Any, Any]  # the polynomial V = |M|^2
    stiffness: tuple[Any, Any, Any]  # the polynomial V alpha/(4 y)


def expand_short_delay_curve(plant: Any) -> ShortDelayCurve:
    """Expand the boundary curve for d < 1 in powers of y, in any arithmetic.

    The coefficients are those of the module docstring for n = 0, rearranged so that no digits cancel. In the general
    form, the coefficients of b would lose digits for strong damping.
    """
    p1, em, a2, a1, a0, f = plant.p1, plant.em, plant.a2, plant.a1, plant.a0, plant.f
    t = 1.0 - f
    total = f * (f * em + p1) + t * (f * plant.p1_t + t * plant.psi_t) + a0
    damping = p1 * total * 4.0, a0 * (f + t * plant.p1_t) * -16.0
    modulus = p1 * p1, (a1 * (a2 + a0) + a2 * a0 * 4.0) * -4.0, a2 * a0 * 16.0
    stiffness = p1 * (em + f * em + p1), (a1 + a0 * 3.0 + a0 * em) * -4.0, a0 * 16.0
    return ShortDelayCurve(damping, modulus, stiffness)


class Wave(NamedTuple):
    """The terms of the boundary curve that depend only on the frequency omega and the delay n; D = n + 1."""

    y: Array  # sin^2(omega/2)
    q: Array  # 1 - y
    tau: Array  # sin(D omega)/sin omega
    kappa: Array  # cos(D omega)
    # The following terms are computed by `evaluate_wave` only.
    drop: Any = None  # 1 - kappa - 2 y tau
    tau1: Any = None  # y d tau/dy
    n: Any = None
    half_omega: Any = None  # omega/2; this and the next field are arbitrary at omega = pi
    inverses: Any = None  # 1/s and 1/cos(omega/2)


def evaluate_wave(s: Array, n: Array, undelayed: bool = False, low: bool = False) -> Wave:
    """Return the terms of the boundary curve at a frequency on the lobe; their derivatives are finite up to omega = pi.

    Args:
        s: sin(omega/2), 0 < s <= 1; s = 1 only for n = 0.
        n: Integer delay, or the delay d for the paper's z^(1+d).
        undelayed: True if n = 0 for all points.
        low: True if omega < pi/2 for all points, as on the lobe for n >= 1.
    """
    xp = namespace(s, n)
    y, q = s * s, (1.0 - s) * (1.0 + s)
    cos_w = q - y
    # At omega = pi (y = 1), replace cos(omega/2) = 0 by 1 to avoid a division by 0. The quotients are not used at this
    # point, because it occurs only for n = 0.
    cos_half = xp.sqrt(q if low else xp.where(s < 1.0, q, 1.0))
    is_low = y < 0.5
    small = s if low else xp.where(is_low, s, cos_half)
    half_omega = small * horner(4.0 * small * small - 1.0, ARCSINE)
    if not low:
        half_omega = xp.where(is_low, half_omega, 0.5 * np.pi - half_omega)
    # Divide only once, because XLA fuses the operations before and after a quotient into separate loops.
    per_sin = 1.0 / (s * cos_half)
    per_cos = s * per_sin
    inverses = cos_half * per_sin, per_cos
    if undelayed:
        return Wave(y, q, 1.0, cos_w, 0.0, 0.0, n, half_omega, inverses)
    # Compute sine and cosine of D omega = omega + n omega by the addition theorems. This avoids cancellation near omega
    # = pi and yields correct derivatives in n at n = 0.
    x = n * half_omega
    square = x * x
    sine, cosine = x * horner(square, SINE), horner(square, COSINE)
    # Compute sine_ratio = sin(n omega)/sin omega, and cos(n omega), the new value of ``cosine``.
    sine_ratio, versine = sine * cosine * per_sin, 2.0 * sine * sine
    cosine, sin2 = 1.0 - versine, 4.0 * y * q
    tau, kappa = cosine + cos_w * sine_ratio, cos_w * cosine - sin2 * sine_ratio
    # Compute tau1 = y dtau/dy in a form that is exactly 0 for n = 0, where tau = 1 is constant.
    tau1 = (n * cos_w * cosine - sine_ratio * ((n + 1.0) * sin2 + cos_w * cos_w)) * (0.5 * per_cos * per_cos)
    return Wave(y, q, tau, kappa, versine + 2.0 * y * sine_ratio, tau1, n, half_omega, inverses)


def evaluate_wave_at(omega: Array, n: Array) -> Wave:
    """Return the terms y, q, tau and kappa (see `Wave`) at any frequency omega from 0 to pi, for an integer delay n."""
    xp = namespace(omega, n)
    s, cos_half = xp.sin(0.5 * omega), xp.abs(xp.cos(0.5 * omega))
    y, q = s * s, cos_half * cos_half
    D = n + 1.0
    # For omega > 2, compute from pi - omega. Add the low-order digits of pi separately, because np.pi has a rounding
    # error.
    sign, near_pi = 1.0 - 2.0 * xp.mod(D, 2.0), omega > 2.0
    x = xp.where(near_pi, (np.pi - omega) + 1.2246467991473532e-16, omega)
    tau = xp.where(near_pi, -sign, 1.0) * D * _compute_cardinal_sine(D * x) / _compute_cardinal_sine(x)
    return Wave(y, q, tau, xp.where(near_pi, sign, 1.0) * xp.cos(D * x))


def _compute_cardinal_sine(x: Array) -> Array:
    """Return ``sin(x)/x``. For small x use the power series, because the quotient would have inaccurate derivatives."""
    xp = namespace(x)
    is_small = xp.abs(x) < 1.5
    small_x, large_x = xp.where(is_small, x, 0.0), xp.where(is_small, 2.0, x)
    return xp.where(is_small, horner(small_x * small_x, SINE), xp.sin(large_x) / large_x)


class CurveTerms(NamedTuple):
    """V alpha, V b and V at one point of the curve (b = beta + delta, V = |M|^2), and their derivatives in y."""

    alpha: Array  # V alpha
    b: Array  # V b
    V: Array
    d_alpha: Array  # derivative of V alpha
    d_b: Array  # derivative of V b
    dV: Array

    def divide(self, s: Array) -> CurvePoint:
        """Return alpha and b at s = sin(omega/2), and their derivatives in s, by dividing by V."""
        inverse = 1.0 / self.V
        alpha, b, slope = self.alpha * inverse, self.b * inverse, 2.0 * s * inverse
        return CurvePoint(alpha, b, (self.d_alpha - alpha * self.dV) * slope, (self.d_b - b * self.dV) * slope)


class CurvePoint(NamedTuple):
    """A point of the boundary curve: alpha and b = beta + delta, with their derivatives in s = sin(omega/2)."""

    alpha: Array
    b: Array
    d_alpha: Array
    d_b: Array


class Polynomials(NamedTuple):
    """The polynomials E, H and V at one point of the curve, and their derivatives in y."""

    E: Array
    H: Array
    V: Array
    dE: Array
    dH: Array
    dV: Array


def evaluate_polynomials(wave: Wave, curve: Curve) -> Polynomials:
    """Return the polynomials E, H and V at one point of the curve, and their derivatives in y, for arrays."""
    y, mu_squared, xp = wave.y, curve.mu * curve.mu, namespace(wave.y, curve.sigma)
    E0, E1, E2 = curve.E
    # Compute m, the real part of M, by the one of two equal formulas in which no digits cancel.
    m = xp.where(y < 0.5, curve.at_one - 2.0 * curve.sigma * y, 2.0 * curve.sigma * wave.q - curve.gap)
    V, dV = m * m + mu_squared * (4.0 * y * wave.q), 4.0 * (mu_squared * (wave.q - y) - curve.sigma * m)
    return Polynomials(E0 + y * (E1 + y * E2), curve.H[0] + y * curve.H[1], V, E1 + 2.0 * y * E2, curve.H[1], dV)


def _evaluate_stiffness(wave: Wave, curve: Curve) -> tuple[Polynomials, Array, Array]:
    """Return the polynomials E, H and V, the quantity Q = V alpha/(4 y), and y dQ/dy at one point of the curve."""
    at = evaluate_polynomials(wave, curve)
    # The derivative of kappa in y is -2 (n + 1) tau.
    tau_slope = wave.tau * (at.dE - 2.0 * (wave.n + 1.0) * at.H)
    Q, yQ1 = wave.tau * at.E + wave.kappa * at.H, wave.tau1 * at.E + wave.y * (tau_slope + wave.kappa * at.dH)
    return at, Q, yQ1


def evaluate_curve(wave: Wave, curve: Curve) -> CurveTerms:
    """Return V alpha and V b at one point of the curve, and their derivatives in y.

    ``wave`` is from `evaluate_wave`, ``curve`` from `expand_curve_with_offset`.
    """
    y, q, tau, kappa, drop, tau1, n, *_ = wave
    (E, H, V, dE, dH, dV), Q, yQ1 = _evaluate_stiffness(wave, curve)
    excess0, excess1 = curve.excess
    R = 2.0 * q * tau - kappa
    b = y * (excess0 + y * excess1) + drop * E + 2.0 * y * R * H
    # With derivatives in y denoted by ', drop' = 2 n tau - 2 y tau' and y R' = 2 q y tau' + 2 n y tau.
    d_b = excess0 + 2.0 * y * excess1 + 2.0 * (n * tau - tau1) * E + drop * dE
    d_b = d_b + 2.0 * (R + 2.0 * (q * tau1 + n * y * tau)) * H + 2.0 * y * R * dH
    return CurveTerms(4.0 * y * Q, b, V, 4.0 * (Q + yQ1), d_b, dV)


def evaluate_short_delay_curve(y: Array, curve: ShortDelayCurve) -> CurveTerms:
    """Return V alpha and V b at one point of the curve for n = 0, and their derivatives in y."""
    (u0, u1), (v0, v1, v2), (a, s, t) = curve
    return CurveTerms(
        4.0 * y * (a + y * (s + y * t)),
        y * (u0 + y * u1),
        v0 + y * (v1 + y * v2),
        4.0 * (a + y * (2.0 * s + 3.0 * y * t)),
        u0 + 2.0 * y * u1,
        v1 + 2.0 * y * v2,
    )


def evaluate_wall(wave: Wave, curve: Curve) -> tuple[Array, Array]:
    """Return the stiffness alpha and the damping beta of the wall on the boundary curve at one frequency."""
    E, H, V, *_ = evaluate_polynomials(wave, curve)
    inverse = 1.0 / V
    alpha = 4.0 * wave.y * (wave.tau * E + wave.kappa * H) * inverse
    return recover_wall(alpha, -(wave.kappa * E - 4.0 * wave.y * wave.q * wave.tau * H) * inverse - 0.5 * alpha)


def evaluate_stationarity(s: Array, curve: Curve, n: Array, undelayed: bool = False) -> tuple[Array, Array]:
    """Return ``T = V^2 (dalpha/dy)/4``, which is 0 at a maximum of alpha, and dT/ds (docs/theory/boundary.md, B2)."""
    wave = evaluate_wave(s, n, undelayed)
    (E, H, V, dE, dH, dV), Q, yQ1 = _evaluate_stiffness(wave, curve)
    y, tau, tau1, (per_s, per_cos), D = wave.y, wave.tau, wave.tau1, wave.inverses, n + 1.0
    # tau2 is y^2 times the second derivative of tau in y; yQ2 is y^2 times that of Q.
    tau2 = 0.0
    if not undelayed:
        tau2 = -(1.5 * (wave.q - y) * tau1 + n * (n + 2.0) * y * tau) * (per_cos * per_cos)
    yQ2 = tau2 * E + 2.0 * y * (tau1 * (dE - D * H) + y * tau * (curve.E[2] - 2.0 * D * dH))
    ddV = 8.0 * (curve.sigma * curve.sigma - curve.mu * curve.mu)
    return V * (Q + yQ1) - y * Q * dV, 2.0 * per_s * (V * (2.0 * yQ1 + yQ2) - y * y * Q * ddV)
