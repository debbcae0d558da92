"""Compute the physical damping that a passive wall on a rigid device needs, for any delay: a maximum over frequency.

Notation of docs/theory/passivity.md: d = n + f, k = n + 1, a = alpha/2, b = beta + a, u = 1 - cos w and
kappa = 4 f (1 - f). At one frequency the wall needs the damping N, the larger root of

    N^2 - A N - S/4 = 0,    S = kappa (a^2 + (b^2 - a^2) u/2)

A is a times a stiffness term minus beta times a damping term; both contain cos(k w) and tau = sin(k w)/sin w. The
maximum of N over frequency is at w = 0, at w = pi, or at a single *peak* in between, depending on the *direction*
beta/alpha (P1 to P3, for alpha >= 0). N is homogeneous in (alpha, beta). At the peak dN/du = 0, i.e.

    E = A' + kappa (b^2 - a^2)/(8 N) = 0

A prime denotes d/du; in the code, a digit after a name is the order of this derivative. E has the sign of dN/du.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import ARCSINE, COSINE, SINE, epsilon, horner, namespace, stop_gradient
from zwidth.numerics.root_finding import newton
from zwidth.plant.rigid_mass import ANY, DelayClasses, split_delay
from zwidth.stability.passivity import solve_larger_root

# Number of Newton steps to the peak; the error of the starting value is a few percent.
PEAK_STEPS = 3
# Number of Newton steps to the smallest direction beta/alpha with a peak; the starting value is at most twice the
# solution.
DIRECTION_STEPS = 12


class DelayTerms(NamedTuple):
    """The quantities f, k = n + 1 and kappa = 4 f (1 - f) of a delay d = n + f."""

    f: Array
    k: Array
    kappa: Array


class PeakCondition(NamedTuple):
    """The damping N that the wall needs at one frequency, and the condition E = 0 for its maximum."""

    slope: Array  # E, which has the sign of dN/du
    curvature: Array  # A'', which is dE/du if E = 0
    root: Array  # 2 N - A
    needed: Array  # N


def compute_delay_terms(d: Array) -> DelayTerms:
    """Return f, k and kappa of a delay d >= 0."""
    n, f = split_delay(d)
    return DelayTerms(f, n + 1.0, 4.0 * f * (1.0 - f))


def _evaluate_at_zero(a: Array, beta: Array, delay: DelayTerms) -> tuple[Array, Array, Array]:
    """Return N, E and the derivative of E with respect to beta, all at w = 0."""
    f, k, kappa = delay
    xp = namespace(a, f)
    n = k - 1.0
    # Compute A' at u = 0, where d cos(i w)/du = -i^2. The stiffness term combines the sums 1 + 2 cos w + ... +
    # 2 cos(m w) for m = n and m = k, and the damping term combines cos(k w) and cos((k + 1) w).
    stiffness_slope = (1.0 - f) * n * k * (2.0 * n + 1.0) + f * k * (k + 1.0) * (2.0 * k + 1.0)
    damping_slope = (1.0 - f) * k * k + f * (k + 1.0) ** 2
    needed, root = solve_larger_root(a * (2.0 * (n + f) + 1.0) - beta, kappa * a * a, xp)
    S_factor = 0.125 * kappa / xp.where(needed > 0, needed, 1.0)
    S_slope = S_factor * beta * (beta + 2.0 * a)
    E = beta * damping_slope - a * stiffness_slope / 3.0 + S_slope
    return needed, E, damping_slope + 2.0 * S_factor * (beta + a) + S_slope / xp.where(root > 0, root, 1.0)


def evaluate_ends(a: Array, beta: Array, delay: DelayTerms) -> tuple[Array, Array, Array, Array]:
    """Return N at w = 0, E there, N at w = pi, and whether the latter is the maximum, for the wall ``(2 a, beta)``."""
    f, k, _ = delay
    xp = namespace(a, f)
    at_zero, E, _ = _evaluate_at_zero(a, beta, delay)
    b = beta + a
    E_at_pi = beta * (1.0 - 5.0 * f) - 2.0 * a * f + 0.5 * f * beta * (beta + 2.0 * a) / xp.where(b > 0, b, 1.0)
    return at_zero, xp.where(beta > 0, E, -1.0), b * (1.0 - f), (k == 1) & (E_at_pi >= 0)


def evaluate_condition(u: Array, a: Array, beta: Array, delay: DelayTerms) -> PeakCondition:
    """Evaluate N, E and A'' at ``u = 1 - cos w``, in (0, 2] for n = 0 and in (0, 1] for n >= 1."""
    f, k, kappa = delay
    xp = namespace(u, a)
    cos_w, sin_squared = 1.0 - u, u * (2.0 - u)
    # For n = 0 use that tau = 1 and all terms are polynomials in u, which can be evaluated up to w = pi.
    undelayed = k == 1
    safe_sin_squared = xp.where(undelayed, 1.0, sin_squared)
    cosine, sine = _compute_cosine_and_sine(xp.minimum(u, 1.0), k, xp)
    cosine, tau = xp.where(undelayed, cos_w, cosine), xp.where(undelayed, 1.0, sine / xp.sqrt(safe_sin_squared))
    tau1 = xp.where(undelayed, 0.0, (k * cosine - tau * cos_w) / safe_sin_squared)
    quotient = (k * cosine - tau) / u
    stiffness_term, stiffness_term1 = tau * (2.0 - u) - cosine, quotient + k * tau
    stiffness_term2 = (-k * k * tau - tau1 - quotient) / u + k * tau1
    damping_term, damping_term1, damping_term2 = cosine, -k * tau, -k * tau1
    stiffness_term, stiffness_term1, stiffness_term2 = (
        stiffness_term + 2.0 * f * cosine,
        stiffness_term1 - 2.0 * f * k * tau,
        stiffness_term2 - 2.0 * f * k * tau1,
    )
    next_cosine, next_tau = cosine * cos_w - tau * sin_squared, tau * cos_w + cosine
    next_tau1 = tau1 * cos_w - tau - k * tau
    damping_term, damping_term1 = (
        damping_term + f * (next_cosine - damping_term),
        damping_term1 - f * ((k + 1.0) * next_tau + damping_term1),
    )
    damping_term2 = damping_term2 - f * ((k + 1.0) * next_tau1 + damping_term2)
    # For n = 0 use exact derivatives, because the general formulas subtract nearly equal numbers and would spoil the
    # terms of order f.
    stiffness_term1, stiffness_term2 = (
        xp.where(undelayed, -2.0 * f, stiffness_term1),
        xp.where(undelayed, 0.0, stiffness_term2),
    )
    damping_term1 = xp.where(undelayed, 4.0 * f * u - 3.0 * f - 1.0, damping_term1)
    damping_term2 = xp.where(undelayed, 4.0 * f, damping_term2)
    A, A1, A2 = (
        a * stiffness_term - beta * damping_term,
        a * stiffness_term1 - beta * damping_term1,
        a * stiffness_term2 - beta * damping_term2,
    )
    gain = beta * (beta + 2.0 * a)
    needed, root = solve_larger_root(A, kappa * (a * a + 0.5 * gain * u), xp)
    # Return E as the slope. Where N is stationary, E is 0 and the derivative of E is A''.
    slope = A1 + 0.125 * kappa * gain / xp.where(needed > 0, needed, 1.0)
    return PeakCondition(slope, A2, root, needed)


def _compute_cosine_and_sine(u: Array, k: Array, xp: Any) -> tuple[Array, Array]:
    """Return cos(k w) and sin(k w) for u in (0, 1] and 0 < k w <= pi."""
    if xp is np:
        x = 2.0 * k * np.arcsin(np.sqrt(0.5 * u))
        return np.cos(x), np.sin(x)
    half = k * xp.sqrt(0.5 * u) * horner(2.0 * u - 1.0, ARCSINE)
    square = half * half
    sine, cosine = half * horner(square, SINE), horner(square, COSINE)
    return (cosine - sine) * (cosine + sine), 2.0 * sine * cosine


def find_peak(a: Array, beta: Array, delay: DelayTerms, rise: Array) -> Array:
    """Return u of the only peak between w = 0 and pi, if a peak exists; ``rise`` is E at u = 0."""
    # Compute a starting value, within a few percent of the peak, from ``(1 - x cot x)/x^2 = 2 sum_i 1/(i^2 pi^2 -
    # x^2)`` with x = (d + 1) w. The error of N is of second order in that of u.
    f, k, _ = delay
    xp = namespace(a, f)
    periods = k + f
    # Solve b/(2 a (d + 1)) = (1 - x cot x)/x^2 for y = x^2, with both sides inverted because a may be 0.
    ratio = 2.0 * a * periods / (beta + a)
    y = np.pi**2 - 2.0 * ratio / xp.maximum(1.0 - 0.1307 * ratio, 0.5)
    y = np.pi**2 - 2.0 * ratio / xp.maximum(1.0 - (0.1307 + 0.00216 * y) * ratio, 0.5)
    largest_u = xp.where(k == 1, 2.0, 2.0 * xp.sin(0.5 * np.pi / k) ** 2)
    # If u at the peak is below this value, N at the peak equals N at w = 0 within rounding error.
    floor = epsilon(a) ** 0.5 * largest_u
    # Convert y = w^2 to u by the series of 1 - cos w, whose error is below 1e-3.
    y = xp.maximum(y, 0.0) / (periods * periods)
    u = xp.minimum(xp.maximum(0.5 * y * (1.0 - y * (1.0 / 12.0 - y * (1.0 / 360.0))), floor), largest_u)
    # Unroll the Newton steps, because XLA then fuses all of them into a single loop over the points.
    for _ in range(PEAK_STEPS):
        point = evaluate_condition(u, a, beta, delay)
        # Near u = 0, E is nearly linear, and Newton's method may leave (0, largest_u]; then use the secant from u = 0.
        new = u - point.slope / xp.where(point.curvature < 0, point.curvature, -1.0)
        chord = u * rise / xp.where(point.slope < 0, rise - point.slope, 1.0)
        u = xp.where(new > 0, new, chord)
        u = xp.minimum(xp.maximum(u, floor), largest_u)
    return u


def compute_needed_damping(alpha: Array, beta: Array, d: Array, kind: DelayClasses = ANY) -> Array:
    """Return the supremum over frequency of the needed damping N, for alpha >= 0, elementwise, with derivatives."""
    xp = namespace(alpha, beta, d)
    if not (kind.long or kind.fractional):
        return 0.5 * alpha + xp.abs(beta)
    delay = compute_delay_terms(d)
    scale = stop_gradient(alpha + xp.abs(beta), xp)
    scale = xp.where(scale > 0, scale, 1.0)
    a, beta = 0.5 * alpha / scale, beta / scale
    at_zero, E, at_pi, reaches_pi = evaluate_ends(a, beta, delay)
    rises = E > 0
    has_peak = rises & ~reaches_pi
    # If there is no peak, substitute a wall and a delay that have one; the result is not used.
    safe_a, safe_beta = xp.where(has_peak, a, 0.0), xp.where(has_peak, beta, 1.0)
    safe_f = xp.where(has_peak, delay.f, 0.5)
    safe_delay = DelayTerms(safe_f, delay.k, 4.0 * safe_f * (1.0 - safe_f))
    u = find_peak(*stop_gradient((safe_a, safe_beta, safe_delay, xp.where(has_peak, E, 1.0)), xp))
    point = evaluate_condition(u, safe_a, safe_beta, safe_delay)
    # Add the effect of one more Newton step on N, which makes the second derivatives correct as well.
    curvature = stop_gradient(xp.where(point.curvature < 0, point.curvature * point.root / point.needed, -1.0), xp)
    height = point.needed - xp.where(point.curvature < 0, 0.5 * point.slope * point.slope / curvature, 0.0)
    return scale * xp.where(rises, xp.where(reaches_pi, at_pi, height), at_zero)


def find_directions(d: Array) -> tuple[Array, Array]:
    """Return the directions ``beta/alpha`` between which the peak is inside (0, pi).

    For smaller directions the maximum is at w = 0, for larger ones at w = pi, which occurs for d < 2/9 only.
    """
    xp = namespace(d)
    delay = compute_delay_terms(d)
    f, k, _ = delay
    half, zero = 0.5 + 0.0 * d, 0.0 * d
    # E at w = 0 increases with beta. Start from the zero of E without its term in kappa, which vanishes for f = 0.
    _, E_without_S, E_by_beta = _evaluate_at_zero(half, zero, delay._replace(kappa=zero))
    largest = -E_without_S / E_by_beta
    lower, _ = newton(lambda beta: _evaluate_at_zero(half, beta, delay)[1:], zero, largest, largest, DIRECTION_STEPS)
    # The upper direction t solves (2 - 9 f) t^2 + (1 - 6 f) t = f.
    has_upper = (k == 1) & (9.0 * f < 2.0)
    safe_f = xp.where(has_upper, f, 0.0)
    upper = 2.0 * safe_f / (1.0 - 6.0 * safe_f + xp.sqrt(1.0 - 4.0 * safe_f))
    return lower, xp.where(has_upper, upper, xp.inf)
