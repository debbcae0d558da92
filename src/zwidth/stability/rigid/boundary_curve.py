"""The boundary curve of the rigid loop: the walls with a pole pair at z = e^(+-j omega), with derivatives.

On the unit circle, the factor W of the characteristic polynomial P (`stability.rigid.characteristic_polynomial`)
follows from P = 0. With its coefficients alpha and beta, and with M, c, n and delta as there (docs/theory/boundary.md,
B1),

    V alpha = 4 y Q                              Q = tau E + kappa H
    V beta = 4 y q tau H - kappa E - 2 y Q
    V b = y excess + drop E + 2 y (2 q tau - kappa) H       b = beta + delta

    (z - c) conj(M) = E + j H sin omega          V = |M|^2       excess = (delta V - E)/y
    y = s^2       s = sin(omega/2)       q = 1 - y       D = n + 1
    tau = sin(D omega)/sin omega         kappa = cos(D omega)    drop = 1 - kappa - 2 y tau

The form with b keeps the relative accuracy of b, which vanishes like y at omega = 0. E, H and `excess` are polynomials
in y that do not depend on n. Names that begin with d denote derivatives in y. For n = 0, alpha and b are rational in y
(`ShortDelayCurve`). All expansions work in any arithmetic: arrays, float64 numbers with an error bound, and balls.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import ARCSINE, COSINE, SINE, horner, namespace
from zwidth.stability.rigid.characteristic_polynomial import recover_wall


class Curve(NamedTuple):
    """The terms of the boundary curve of one device that do not depend on n; polynomials in y, lowest power first."""

    E: tuple[Any, ...]
    H: tuple[Any, ...]
    at_one: Any  # N(1)
    sigma: Any  # a2 + a0
    mu: Any  # a2 - a0
    gap: Any  # N(-1)
    excess: Any = None  # the polynomial (delta V - E)/y; None if b is not required


def expand_curve(plant: Any, at_one: Any = None) -> Curve:
    """Return the terms of alpha and beta for one plant, whose N(1) may be given; a0 is None for integer delays."""
    c, em, a2, a1, a0, gap = plant.c, plant.em, plant.a2, plant.a1, plant.a0, plant.gap
    if a0 is None:
        return Curve((em * at_one, (gap - em * a2) * 2.0), (a1 + a2 * c,), at_one, a2, a2, gap)
    sigma = a2 + a0
    at_one = sigma + a1 if at_one is None else at_one
    E = em * at_one, (a0 * 4.0 - gap + em * sigma) * -2.0, a0 * 8.0
    return Curve(E, (a1 + a2 * c + a0 * (1.0 + em), a0 * -4.0), at_one, sigma, a2 - a0, gap)


def expand_curve_with_offset(plant: Any) -> Curve:
    """Return the terms of alpha, beta and b for one `DiscretePlant`; a0 is None for integer delays."""
    p1, a2, a1, a0, curve = plant.p1, plant.a2, plant.a1, plant.a0, expand_curve(plant, plant.p1)
    # The constant terms of delta V - E cancel exactly, because em = delta phi1.
    if a0 is None:
        # For f = 0 use 1 - delta a2 = phi1.
        return curve._replace(excess=(p1 * plant.gap * -2.0,))
    excess0 = p1 * 2.0 - curve.mu * 4.0 + plant.delta * (curve.sigma * (curve.sigma - a1) - a2 * a0 * 8.0) * 2.0
    return curve._replace(excess=(excess0, a0 * (1.0 - plant.delta * a2 * 2.0) * -8.0))


def compute_squared_modulus(y: Any, q: Any, curve: Curve) -> Any:
    """Return V for y <= 1/2, in any arithmetic."""
    m, double_mu = curve.at_one - curve.sigma * y * 2.0, curve.mu * 2.0
    return m * m + double_mu * double_mu * (y * q)


class ShortDelayCurve(NamedTuple):
    """The boundary curve for n = 0, as polynomials in y with the lowest power first."""

    damping: tuple[Any, Any]  # V b/y
    modulus: tuple[Any, Any, Any]  # V
    stiffness: tuple[Any, Any, Any]  # V alpha/(4 y)


def expand_short_delay_curve(plant: Any) -> ShortDelayCurve:
    """Expand the boundary curve for d < 1 in powers of y, in any arithmetic.

    The coefficients are those of B1 for n = 0, in a form in which no digits cancel: in the general form, those of b
    lose digits for strong damping.
    """
    p1, em, a2, a1, a0, f = plant.p1, plant.em, plant.a2, plant.a1, plant.a0, plant.f
    t = 1.0 - f
    total = f * (f * em + p1) + t * (f * plant.p1_t + t * plant.psi_t) + a0
    damping = p1 * total * 4.0, a0 * (f + t * plant.p1_t) * -16.0
    modulus = p1 * p1, (a1 * (a2 + a0) + a2 * a0 * 4.0) * -4.0, a2 * a0 * 16.0
    stiffness = p1 * (em + f * em + p1), (a1 + a0 * 3.0 + a0 * em) * -4.0, a0 * 16.0
    return ShortDelayCurve(damping, modulus, stiffness)


class Wave(NamedTuple):
    """The terms of the boundary curve that depend only on the frequency omega and on n."""

    y: Array
    q: Array
    tau: Array
    kappa: Array
    # The following terms are computed by `evaluate_wave` only.
    drop: Any = None
    tau1: Any = None  # y d tau/dy
    n: Any = None
    half_omega: Any = None  # omega/2; this and the next field are arbitrary at the corner
    inverses: Any = None  # 1/s and 1/cos(omega/2)


def evaluate_wave(s: Array, n: Array, undelayed: bool = False, low: bool = False) -> Wave:
    """Return the terms of a frequency on the lobe, with derivatives that are finite up to omega = pi.

    Args:
        s: sin(omega/2), 0 < s <= 1; s = 1 only for n = 0.
        n: Integer delay, or the delay d for the paper's z^(1+d).
        undelayed: True if n = 0 for all points.
        low: True if omega < pi/2 for all points, as on the lobe for n >= 1.
    """
    xp = namespace(s, n)
    y, q = s * s, (1.0 - s) * (1.0 + s)
    cos_w = q - y
    # Replace cos(omega/2) by 1 at the corner (y = 1) to avoid a division by 0. The quotients are not used there,
    # because n is 0.
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
    # Expand sine and cosine of D omega = omega + n omega, which avoids cancellation near pi and has the right
    # derivatives in D at D = 1.
    x = n * half_omega
    square = x * x
    sine, cosine = x * horner(square, SINE), horner(square, COSINE)
    # sine_ratio = sin(n omega)/sin omega and cosine = cos(n omega)
    sine_ratio, versine = sine * cosine * per_sin, 2.0 * sine * sine
    cosine, sin2 = 1.0 - versine, 4.0 * y * q
    tau, kappa = cosine + cos_w * sine_ratio, cos_w * cosine - sin2 * sine_ratio
    # Use a form of tau1 that is exactly 0 for D = 1, where kappa = cos omega and D kappa - tau cos omega = 0.
    tau1 = (n * cos_w * cosine - sine_ratio * ((n + 1.0) * sin2 + cos_w * cos_w)) * (0.5 * per_cos * per_cos)
    return Wave(y, q, tau, kappa, versine + 2.0 * y * sine_ratio, tau1, n, half_omega, inverses)


def evaluate_wave_at(omega: Array, n: Array) -> Wave:
    """Return y, q, tau and kappa at any frequency from 0 to pi, for an integer delay n."""
    xp = namespace(omega, n)
    s, cos_half = xp.sin(0.5 * omega), xp.abs(xp.cos(0.5 * omega))
    y, q = s * s, cos_half * cos_half
    D = n + 1.0
    # For omega > 2 use pi - omega, with the low-order digits of pi added separately, because np.pi has a rounding
    # error.
    sign, near_pi = 1.0 - 2.0 * xp.mod(D, 2.0), omega > 2.0
    x = xp.where(near_pi, (np.pi - omega) + 1.2246467991473532e-16, omega)
    tau = xp.where(near_pi, -sign, 1.0) * D * _compute_cardinal_sine(D * x) / _compute_cardinal_sine(x)
    return Wave(y, q, tau, xp.where(near_pi, sign, 1.0) * xp.cos(D * x))


def _compute_cardinal_sine(x: Array) -> Array:
    """Return ``sin(x)/x``; by its series for small x, because the quotient has inaccurate derivatives there."""
    xp = namespace(x)
    is_small = xp.abs(x) < 1.5
    small_x, large_x = xp.where(is_small, x, 0.0), xp.where(is_small, 2.0, x)
    return xp.where(is_small, horner(small_x * small_x, SINE), xp.sin(large_x) / large_x)


class CurveTerms(NamedTuple):
    """V alpha, V b and V at one frequency, and their derivatives in y."""

    alpha: Array
    b: Array
    V: Array
    d_alpha: Array
    d_b: Array
    dV: Array

    def divide(self, s: Array) -> CurvePoint:
        """Return alpha and b at s, and their derivatives in s."""
        inverse = 1.0 / self.V
        alpha, b, slope = self.alpha * inverse, self.b * inverse, 2.0 * s * inverse
        return CurvePoint(alpha, b, (self.d_alpha - alpha * self.dV) * slope, (self.d_b - b * self.dV) * slope)


class CurvePoint(NamedTuple):
    """A point of the boundary curve: alpha, b = beta + delta, and their derivatives in s."""

    alpha: Array
    b: Array
    d_alpha: Array
    d_b: Array


class Polynomials(NamedTuple):
    """E, H and V at one frequency, and their derivatives in y."""

    E: Array
    H: Array
    V: Array
    dE: Array
    dH: Array
    dV: Array


def evaluate_polynomials(wave: Wave, curve: Curve) -> Polynomials:
    """Return E, H and V at one frequency, and their derivatives in y, for arrays."""
    y, mu_squared, xp = wave.y, curve.mu * curve.mu, namespace(wave.y, curve.sigma)
    E0, E1, E2 = curve.E
    # Choose the form of m = Re M without cancellation.
    m = xp.where(y < 0.5, curve.at_one - 2.0 * curve.sigma * y, 2.0 * curve.sigma * wave.q - curve.gap)
    V, dV = m * m + mu_squared * (4.0 * y * wave.q), 4.0 * (mu_squared * (wave.q - y) - curve.sigma * m)
    return Polynomials(E0 + y * (E1 + y * E2), curve.H[0] + y * curve.H[1], V, E1 + 2.0 * y * E2, curve.H[1], dV)


def _evaluate_stiffness(wave: Wave, curve: Curve) -> tuple[Polynomials, Array, Array]:
    """Return the polynomials, Q = V alpha/(4 y), and y dQ/dy, at one frequency of `evaluate_wave`."""
    at = evaluate_polynomials(wave, curve)
    # kappa' = -2 (n + 1) tau
    tau_slope = wave.tau * (at.dE - 2.0 * (wave.n + 1.0) * at.H)
    Q, yQ1 = wave.tau * at.E + wave.kappa * at.H, wave.tau1 * at.E + wave.y * (tau_slope + wave.kappa * at.dH)
    return at, Q, yQ1


def evaluate_curve(wave: Wave, curve: Curve) -> CurveTerms:
    """Return alpha and b, multiplied by V, at one frequency of `evaluate_wave`, and their derivatives in y.

    The curve is one of `expand_curve_with_offset`.
    """
    y, q, tau, kappa, drop, tau1, n, *_ = wave
    (E, H, V, dE, dH, dV), Q, yQ1 = _evaluate_stiffness(wave, curve)
    excess0, excess1 = curve.excess
    R = 2.0 * q * tau - kappa
    b = y * (excess0 + y * excess1) + drop * E + 2.0 * y * R * H
    # drop' = 2 n tau - 2 y tau' and y R' = 2 q y tau' + 2 n y tau
    d_b = excess0 + 2.0 * y * excess1 + 2.0 * (n * tau - tau1) * E + drop * dE
    d_b = d_b + 2.0 * (R + 2.0 * (q * tau1 + n * y * tau)) * H + 2.0 * y * R * dH
    return CurveTerms(4.0 * y * Q, b, V, 4.0 * (Q + yQ1), d_b, dV)


def evaluate_short_delay_curve(y: Array, curve: ShortDelayCurve) -> CurveTerms:
    """Return alpha and b, multiplied by V, and their derivatives in y, for n = 0."""
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
    """Return stiffness and damping of the wall on the boundary curve at one frequency."""
    E, H, V, *_ = evaluate_polynomials(wave, curve)
    inverse = 1.0 / V
    alpha = 4.0 * wave.y * (wave.tau * E + wave.kappa * H) * inverse
    return recover_wall(alpha, -(wave.kappa * E - 4.0 * wave.y * wave.q * wave.tau * H) * inverse - 0.5 * alpha)


def evaluate_stationarity(s: Array, curve: Curve, n: Array, undelayed: bool = False) -> tuple[Array, Array]:
    """Return ``T = V^2 alpha'/4``, which is 0 where alpha is stationary, and dT/ds (docs/theory/boundary.md, B2)."""
    wave = evaluate_wave(s, n, undelayed)
    (E, H, V, dE, dH, dV), Q, yQ1 = _evaluate_stiffness(wave, curve)
    y, tau, tau1, (per_s, per_cos), D = wave.y, wave.tau, wave.tau1, wave.inverses, n + 1.0
    # tau2 = y^2 tau'' and yQ2 = y^2 Q''
    tau2 = 0.0
    if not undelayed:
        tau2 = -(1.5 * (wave.q - y) * tau1 + n * (n + 2.0) * y * tau) * (per_cos * per_cos)
    yQ2 = tau2 * E + 2.0 * y * (tau1 * (dE - D * H) + y * tau * (curve.E[2] - 2.0 * D * dH))
    ddV = 8.0 * (curve.sigma * curve.sigma - curve.mu * curve.mu)
    return V * (Q + yQ1) - y * Q * dV, 2.0 * per_s * (V * (2.0 * yQ1 + yQ2) - y * y * Q * ddV)
