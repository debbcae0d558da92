"""Find the ridge, the point of maximum stiffness, by Newton's method on its closed-form optimality condition.

The stability *lobe* is the first part of the boundary curve, on which the loop has a pole at z = e^(j omega). With the
plant's numerator N(z) = a2 z^2 + a1 z + a0 and pole c, M = N(z)/z, and D = n + 1 for the integer part n of the delay,

    alpha = 4 y (tau E + kappa H)/V      E + j H sin omega = (z - c) conj(M)      V = |M|^2 = m^2 + (mu sin omega)^2
    y = s^2    s = sin(omega/2)    q = 1 - y    tau = sin(D omega)/sin omega    kappa = cos(D omega)    mu = a2 - a0

where m = Re M, sigma = a2 + a0 and gap = N(-1) (docs/theory/boundary.md, B1). T is the derivative of alpha in y, up to
a positive factor (B2). A prime on that page is a trailing digit or a leading d in the code.

The lobe has a single maximum of alpha (docs/theory/one-lobe.md, Theorem B), so no search is needed: a fitted start and
three Newton steps suffice. The maximum is smooth (T = 0), or it is the *corner* at y = 1, the wall with a double pole
at z = -1. The number of steps is fixed, because in a batch all points take the same steps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import ARCSINE, COSINE, SINE, epsilon, horner, iterate, materialize, namespace, stop_gradient
from zwidth.plant.rigid_mass import ANY, DelayClasses, DiscretePlant, Plant


class Curve(NamedTuple):
    """The coefficients of E, H and V of one device, which do not depend on the integer delay."""

    E: tuple[Array, Array, Array]  # in powers of y
    H: tuple[Array, Array]  # in powers of y
    at_one: Array  # N(1)
    sigma: Array  # a2 + a0
    mu: Array  # a2 - a0
    gap: Array  # N(-1)


def expand_curve(plant: Plant | DiscretePlant) -> Curve:
    """Return the coefficients of E, H and V of one plant, in a form without cancellation in the range of the ridge."""
    c, em, a2, a1, a0, gap = plant.c, plant.em, plant.a2, plant.a1, plant.a0, plant.gap
    sigma = a2 + a0
    at_one = sigma + a1
    E = (em * at_one, -2.0 * (4.0 * a0 - gap + em * sigma), 8.0 * a0)
    H = (a1 + a2 * c + a0 * (1.0 + em), -4.0 * a0)
    return Curve(E, H, at_one, sigma, a2 - a0, gap)


class Wave(NamedTuple):
    """The terms of the boundary curve that depend only on the frequency omega and on D."""

    y: Array
    q: Array
    tau: Array
    kappa: Array
    # For the ridge only:
    half_omega: Any = None  # omega/2; arbitrary at the corner
    per_sin: Any = None  # 1/sin omega; arbitrary at the corner
    tau1: Any = None  # d tau/dy


def evaluate_wave(s: Array, n: Array, undelayed: bool) -> Wave:
    """Return y, q, tau, kappa and d tau/dy at s, with derivatives that are finite up to the corner.

    ``undelayed`` is True if D = 1 for all points.
    """
    xp = namespace(s, n)
    y, q = s * s, (1.0 - s) * (1.0 + s)
    cos_w = q - y
    # Replace cos(omega/2) by 1 at the corner (y = 1) to avoid a division by 0. The quotients are not used there,
    # because D is 1.
    cos_half = xp.sqrt(xp.where(s < 1.0, q, 1.0))
    is_low = y < 0.5
    small = xp.where(is_low, s, cos_half)
    half_omega = small * horner(4.0 * small * small - 1.0, ARCSINE)
    half_omega = xp.where(is_low, half_omega, 0.5 * np.pi - half_omega)
    per_sin = 0.5 / (s * cos_half)
    if undelayed:
        return Wave(y, q, 1.0, cos_w, half_omega, per_sin, 0.0)
    # Expand sine and cosine of D omega = omega + n omega, which avoids cancellation near pi and has the right
    # derivatives in D at D = 1.
    D, x = n + 1.0, n * half_omega
    square = x * x
    sine, cosine = x * horner(square, SINE), horner(square, COSINE)
    sine_ratio, cosine = 2.0 * sine * cosine * per_sin, 1.0 - 2.0 * sine * sine
    sin2 = 4.0 * y * q
    tau, kappa = cosine + cos_w * sine_ratio, cos_w * cosine - sin2 * sine_ratio
    # Use a form of tau1 that is exactly 0 for D = 1, where kappa = cos omega and D kappa - tau cos omega = 0.
    tau1 = (n * cos_w * cosine - sine_ratio * (D * sin2 + cos_w * cos_w)) * (2.0 * per_sin * per_sin)
    return Wave(y, q, tau, kappa, half_omega, per_sin, tau1)


def evaluate_wave_at(omega: Array, n: Array) -> Wave:
    """Return y, q, tau and kappa at a frequency from 0 to pi, for an integer delay n."""
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


def _evaluate_polynomials(wave: Wave, curve: Curve) -> tuple[Array, Array, Array, Array]:
    """Return E, H, m and V at one frequency, from its terms and the coefficients of the curve."""
    xp = namespace(wave.y, curve.sigma)
    E = curve.E[0] + wave.y * (curve.E[1] + wave.y * curve.E[2])
    H = curve.H[0] + wave.y * curve.H[1]
    # Choose the form of m without cancellation.
    m = xp.where(wave.y < 0.5, curve.at_one - 2.0 * curve.sigma * wave.y, 2.0 * curve.sigma * wave.q - curve.gap)
    return E, H, m, m * m + curve.mu * curve.mu * (4.0 * wave.y * wave.q)


def evaluate_wall(wave: Wave, curve: Curve) -> tuple[Array, Array]:
    """Return alpha and beta of the boundary curve at one s."""
    E, H, _, V = _evaluate_polynomials(wave, curve)
    per_V = 1.0 / V
    alpha = 4.0 * wave.y * (wave.tau * E + wave.kappa * H) * per_V
    return alpha, -(wave.kappa * E - 4.0 * wave.y * wave.q * wave.tau * H) * per_V - 0.5 * alpha


def evaluate_stationarity(s: Array, curve: Curve, n: Array, undelayed: bool = False) -> tuple[Array, Array]:
    """Return T, which is 0 where alpha is stationary, and dT/ds, both at one s."""
    wave = evaluate_wave(s, n, undelayed)
    y, q, tau, kappa, tau1 = wave.y, wave.q, wave.tau, wave.kappa, wave.tau1
    E, H, m, V = _evaluate_polynomials(wave, curve)
    cos_w, mu_squared, two_D = q - y, curve.mu * curve.mu, 2.0 * (n + 1.0)
    tau2 = 0.0 if undelayed else -(1.5 * cos_w * tau1 + n * (n + 2.0) * tau) * (4.0 * wave.per_sin * wave.per_sin)
    dE, dH = curve.E[1] + 2.0 * y * curve.E[2], curve.H[1]
    dV, ddV = 4.0 * (mu_squared * cos_w - curve.sigma * m), 8.0 * (curve.sigma * curve.sigma - mu_squared)
    Q = tau * E + kappa * H
    Q1 = tau1 * E + tau * (dE - two_D * H) + kappa * dH
    Q2 = tau2 * E + tau1 * (2.0 * dE - two_D * H) + 2.0 * tau * (curve.E[2] - two_D * dH)
    yQ = y * Q
    T = V * (Q + y * Q1) - yQ * dV
    return T, 2.0 * s * (V * (2.0 * Q1 + y * Q2) - yQ * ddV)


class Corner(NamedTuple):
    """The wall with a double pole at z = -1, P(-1) = P'(-1) = 0."""

    alpha: Array
    beta: Array
    reached: Array  # True if the lobe ends in the corner
    is_ridge: Array  # True if the corner is the wall of maximum stiffness


def find_corner(curve: Curve, n: Array) -> Corner:
    """Return the corner, in which the lobe may end; it is the ridge if alpha increases up to the corner."""
    # The lobe ends in the corner only if D = 1 and arg M increases up to pi, i.e. gap > 0 and mu > 0.
    xp = namespace(curve.sigma, n)
    E = sum(curve.E[1:], curve.E[0])
    H = curve.H[0] + curve.H[1]
    value, slope = E - H, curve.E[1] + 2.0 * curve.E[2] - 2.0 * H - curve.H[1]
    V, dV = curve.gap**2, 4.0 * (curve.sigma * curve.gap - curve.mu**2)
    reached = (n <= 0.0) & (curve.gap > 0.0) & (curve.mu > 0.0) & (value > 0.0)
    is_ridge = reached & (V * (value + slope) - value * dV >= 0.0)
    # Replace V by 1 for devices without corner, because an overflow would have NaN derivatives, which would make the
    # selected derivatives NaN, too.
    V = xp.where(reached, V, 1.0)
    alpha = 4.0 * value / V
    return Corner(alpha, E / V - 0.5 * alpha, reached, is_ridge)


class Start(NamedTuple):
    """The starting point of Newton's method."""

    scale: Array  # u = 1/(d + 1): s lies between 0.5 u and 1.3 u
    s: Array
    power: Array  # Newton's method is applied to T s^power
    corner: Array  # 1: (delta, d) implies that the ridge is the corner; -1: that it is smooth; 0: unknown


# Value of delta above which, for d = 0, the ridge is the corner. The exact threshold, 3.6593616274217835070, is 4e-18
# larger. The code compares delta, because a comparison of rounded coefficients of the curve would be wrong for
# neighboring float64 values of delta.
CORNER_DELTA = 3.6593616274217835

# Start of Newton's method: s/u as a polynomial in t and u, with t = r/(r + 3), r = delta (d + 1), u = 1/(d + 1), fitted
# over all devices. The error is at most 0.8 % for d < 1 and 1.1 % for d >= 1. Each row contains the coefficients of a
# polynomial in u, which is the coefficient of one power of t.
SHORT_START = (
    (0.3748, 0.6572, -0.7317, -0.01088, 0.2558),
    (-0.1878, 3.83, -4.872, 1.835),
    (1.511, -6.996, 5.233),
    (0.2643, 1.186),
    (-0.4501,),
)
LONG_START = ((0.542, -0.06693, 0.1218), (0.6279, 0.002018), (-0.1571,))
# Exponent ``power`` for d < 1, where Newton's method is applied to T s^power, because T alone is more curved. The
# exponent is fitted in the same form as the start.
SHORT_POWER = ((4.61, -11.6, 6.73), (-6.78, 10.3), (0.712,))
# Number of Newton steps; after two steps the error would be 5e-9.
NEWTON_STEPS = 3


def _evaluate_bivariate(t: Array, u: Array, rows: tuple[tuple[float, ...], ...]) -> Array:
    """Evaluate a polynomial in t whose coefficients are polynomials in u (``rows``), lowest powers first."""
    return horner(t, [horner(u, list(row)) for row in rows])


def guess_start(
    delta: Array, d: Array, fraction: Array, kind: DelayClasses = ANY, strength: Array | None = None
) -> Start:
    """Return the starting point of Newton's method from a fit over delta and d.

    ``strength``, if given, replaces t of `SHORT_START`; 1 is the limit delta -> infinity.
    """
    xp = namespace(delta, d)
    delta, d, f = stop_gradient((delta, d, fraction), xp)
    r = delta * (d + 1.0)
    u, t = 1.0 / (d + 1.0), r / (r + 3.0) if strength is None else strength
    s = power = corner = zero = 0.0 * u
    if kind.long:
        s = _evaluate_bivariate(t, u, LONG_START) + 0.4702 * f * (1.0 - f) * u * u * t
    if kind.short:
        short, low, bent = d < 1.0, _evaluate_bivariate(t, u, SHORT_START), _evaluate_bivariate(t, u, SHORT_POWER)
        s, power = (xp.where(short, low, s), xp.where(short, bent, zero)) if kind.long else (low, bent)
        corner = xp.where(d == 0.0, xp.where(delta > CORNER_DELTA, 1.0, -1.0), zero)
    return Start(u, s * u, power, corner)


class Ridge(NamedTuple):
    """The point of maximum stiffness of one plant."""

    alpha: Array
    beta: Array
    omega: Array
    s: Array  # sin(omega/2), exactly 1 at a corner
    last: Array  # the last step taken in s


def _find_stationary(curve: Curve, n: Array, start: Start, undelayed: bool) -> tuple[Array, Array]:
    """Return s at the smooth maximum and the last step in s, by Newton's method in a bracket around all ridges."""
    xp = namespace(curve.sigma, n)
    lower, upper = 0.5 * start.scale, xp.minimum(1.3 * start.scale, 1.0)
    s = xp.minimum(xp.maximum(start.s, lower), upper)

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        s, _ = state
        first, second = evaluate_stationarity(s, curve, n, undelayed)
        new = s - first * s / (second * s + start.power * first)
        return xp.minimum(xp.maximum(new, lower), upper), s

    s, before = iterate(NEWTON_STEPS, step, (s, s), xp)
    return s, s - before


def solve_ridge(plant: Plant | DiscretePlant, n: Array, start: Start, kind: DelayClasses) -> Ridge:
    """Return the ridge of one plant with a delay of n periods."""
    xp = namespace(plant.a2, n)
    undelayed = not kind.long
    curve = expand_curve(materialize(plant, start.scale))
    s, last = _find_stationary(curve, n, start, undelayed)
    # Keep s below 1, because a smooth maximum near the corner may round to 1.
    s = xp.minimum(s, 1.0 - 0.5 * epsilon(s))
    wave = evaluate_wave(s, n, undelayed)
    ridge = Ridge(*evaluate_wall(wave, curve), 2.0 * wave.half_omega, s, last)
    if not kind.short:
        return ridge
    corner = find_corner(curve, n)
    is_corner = xp.where(start.corner == 0.0, corner.is_ridge, start.corner > 0.0)
    corner_ridge = Ridge(corner.alpha, corner.beta, np.pi, 1.0, 0.0)
    return Ridge(*(xp.where(is_corner, end, value) for end, value in zip(corner_ridge, ridge, strict=True)))
