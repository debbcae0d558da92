"""Decide the stability of rigid virtual walls in closed form, by a Nyquist test at the single gain crossover.

The inputs are the normalized stiffness alpha and damping beta of the wall, the normalized physical damping delta of the
device, and its delay of d = n + f periods (n integer, 0 <= f < 1). The characteristic polynomial P = T + B and the open
loop L = B/T have the factors of `stability.rigid.characteristic_polynomial`. For f = 0, a2 = phi2, a1 = psi and a0 = 0;
for f > 0 see docs/theory/model.md. On the unit circle, z = e^(jw) with 0 < w <= pi, the code uses

    y = sin^2(w/2)      u = 1 - cos w = 2 y      V = |M|^2
    em = 1 - c          p1 = phi1 = em/delta     phi2 = (1 - phi1)/delta      psi = (phi1 - c)/delta

and gap = N(-1) = a2 - a1 + a0. Each docstring states whether an expansion is in y or in u.

For alpha > 0, |L| decreases strictly with frequency (one-crossover.md, Theorem 1). So there is at most one gain
crossover, and the phase of the loop at that frequency decides stability (Theorem 2). Without a gain crossover, |L| > 1
up to w = pi, and the loop is unstable.

A wall on the *boundary curve* (alpha_w, beta_w) has a pole at e^(jw). The *lobe*, the part of this curve from w = 0 to
the first return to alpha_w = 0 or, for some d < 1, to w = pi, bounds the stable set. If the lobe ends at w = pi, in the
*corner*, the line of walls with a pole at z = -1 bounds the stable set beyond it.

The same source code runs in any *arithmetic*: NumPy and JAX arrays, float64 numbers with an error bound, and balls of
python-flint. In the last two (`stability.rigid.certified`) a value represents a set of numbers, and a comparison is
true only if it holds for the whole set. So ``stable`` and ``unstable`` are decided separately, and both may be false.

d >= 1: Compute the crossover as the root of the cubic |B|^2 - |T|^2 in u (a quadratic for integer d). The point
    (alpha_w, beta_w) of the boundary curve at this frequency has the same |W| as the wall. The wall is stable if
    and only if this point lies on the lobe and the wall has the larger arg W. The second condition is equivalent to
    ``beta alpha_w > alpha beta_w`` and to ``beta > beta_w`` (S15a), so arg W itself is not computed.

d < 1: Eliminate the crossover. A line of constant beta meets the lobe at the root of a quadratic in y; the wall is
    stable if and only if alpha is below the boundary there, and below the line of poles at z = -1.

References:
    docs/theory/one-crossover.md (Theorems 1 and 2, S15a, S15b), docs/theory/boundary.md (B1: E, H, V),
    docs/theory/one-lobe.md (L15, L16). Nyquist 1932, Bell Syst. Tech. J. 11 (stability criterion).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import (
    ARCSINE,
    COSINE,
    SINE,
    horner,
    invert_haversine,
    namespace,
    square_roots,
    stop_gradient,
    within,
)
from zwidth.numerics.root_finding import attach_root_derivatives
from zwidth.plant.rigid_mass import ANY, DelayClasses, DiscretePlant, discretize_plant
from zwidth.stability.rigid.boundary_curve import (
    compute_squared_modulus,
    expand_curve_with_offset,
    expand_short_delay_curve,
)
from zwidth.stability.rigid.characteristic_polynomial import (
    evaluate_at_nyquist,
    expand_gain_difference,
    expand_gain_difference_at_nyquist,
    expand_wall,
)
from zwidth.units.quantities import WALL_RANGE

# Number of Newton steps for the cubic. The starting value, also where it is replaced by 1, is within 11 % of the root
# (within 5 % in two million random cases), and each step squares the relative error: 0.11^16 < 5e-16.
NEWTON_STEPS = 4


class Verdict(NamedTuple):
    """Result of a stability test: ``stable`` and ``unstable`` are true only if certain, so both may be false."""

    stable: Any
    unstable: Any


class DelayPhase(NamedTuple):
    """The phase lag (n + 1/2) w of the integer delay n at the gain crossover w, with two guaranteed bounds on w.

    ``within`` and ``beyond`` are true only if the stated bound is certain.
    """

    cosine: Any  # cos((n + 1/2) w)
    sine: Any  # sin((n + 1/2) w)
    half_sine_squared: Any  # sin^2((n + 1/2) w/2)
    within: Any  # (n + 1/2) w <= pi: cosine and sine determine the phase lag uniquely
    beyond: Any  # w >= pi/(n + 1): above the lobe, which ends below pi/(n + 1) for d >= 1; hence unstable


# Type of functions that return the root u of the polynomial with the coefficients h0, h1, h2[, h3]
# (`expand_gain_difference`), and whether it is certain that u is the gain crossover and lies in (0, 1].
RootFinder = Callable[[tuple[Any, ...]], tuple[Any, Any]]
# Type of functions of u and n that return the phase lag at the frequency of u.
DelayPhaseFunction = Callable[[Any, Any], DelayPhase]


def decide_short_delay(alpha: Any, beta: Any, plant: Any) -> Verdict:
    """Decide stability for d < 1, alpha > 0 and beta > -delta, by comparing alpha with the boundary at this beta."""
    # Require |L(-1)| < 1, because otherwise there is no gain crossover and the wall is unstable. On lines of constant
    # beta that miss the lobe, this condition alone limits alpha. The sign of L(-1) is that of gap, so both signs occur.
    wall_at_nyquist, device_at_nyquist = evaluate_at_nyquist(alpha, beta, plant)
    crosses = (wall_at_nyquist < device_at_nyquist) & (wall_at_nyquist > -device_at_nyquist)
    crosses_nowhere = (wall_at_nyquist > device_at_nyquist) | (wall_at_nyquist < -device_at_nyquist)
    b = beta + plant.delta
    if plant.a0 is None:
        # For d = 0, y can be eliminated: alpha_w = phi1 b (1 - psi beta)/(psi (phi1 + phi2 b)), where p1 = phi1,
        # a1 = psi, a2 = phi2 and b = beta + delta. Lines of constant beta that miss the lobe need no separate case,
        # because the two conditions alpha < alpha_w and |L(-1)| < 1 are those of the Jury test for all beta.
        left, right = alpha * plant.a1 * (plant.p1 + plant.a2 * b), plant.p1 * b * (1.0 - plant.a1 * beta)
        return Verdict(crosses & (left < right), crosses_nowhere | (left > right))
    (u0, u1), modulus, stiffness = expand_short_delay_curve(plant)
    # The lobe has this beta where ``V b = y (u0 + u1 y)`` with b = beta + delta, that is, where ``quadratic y^2 -
    # linear y + constant = 0``. Compute the first positive root y, in the form of the quadratic formula that adds.
    constant, linear, quadratic = modulus[0] * b, u0 - b * modulus[1], b * modulus[2] - u1
    discriminant = linear * linear - constant * quadratic * 4.0
    y = constant * 2.0 / (linear + square_roots(discriminant)[0])
    # Compare alpha with alpha_w, both multiplied by V.
    left, right = alpha * horner(y, modulus), y * horner(y, stiffness) * 4.0
    meets_curve, misses_lobe = discriminant > 0, (discriminant < 0) | (y > 1.0)
    meets_lobe = meets_curve & (y < 1.0)
    # A line of constant beta may miss the lobe. If the lobe ends in the corner (y = 1, alpha > 0), the walls on such a
    # line are stable up to the line of poles at z = -1. If the lobe ends earlier, at alpha = 0, none of them is stable.
    # The lobe ends earlier if V alpha_w < 0 at y = 1, or if gap < 0: then the walls with a pole at z = -1 have
    # alpha + 2 beta < 0, and the lobe cannot reach their line (one-lobe.md, S17 and L15).
    stiffness_at_nyquist = stiffness[0] + stiffness[1] + stiffness[2]
    ends_at_nyquist = (stiffness_at_nyquist > 0) & (plant.gap > 0)
    ends_earlier = (stiffness_at_nyquist < 0) | (plant.gap < 0)
    # At the beta of the corner y is 1. In certified arithmetic y is then a set of numbers with values on both sides
    # of 1; if the lobe ends in the corner, ``left < right`` implies stability for all of them.
    stable = crosses & (
        (meets_lobe & (left < right)) | (ends_at_nyquist & (misses_lobe | (meets_curve & (left < right))))
    )
    unstable = crosses_nowhere | (meets_lobe & (left > right)) | (ends_earlier & (misses_lobe | (left > right)))
    return Verdict(stable, unstable)


def decide_long_delay(
    alpha: Any,
    beta: Any,
    n: Any,
    plant: Any,
    find_root: RootFinder,
    evaluate_phase: DelayPhaseFunction,
) -> Verdict:
    """Decide stability for d >= 1, alpha > 0 and beta > -delta, by comparing with the boundary at the gain crossover.

    For alpha = 0, where one pole is at z = 1, the verdict applies to the other poles. There the caller must ensure
    beta > delta, because |L| is beta/delta at w = 0 and the crossover exists only if this exceeds 1 (S15b).

    Args:
        alpha: Normalized stiffness of the wall.
        beta: Normalized damping of the wall.
        n: Integer part of the delay in periods.
        plant: `DiscretePlant` in the arithmetic of alpha and beta.
        find_root: Finds the crossover in this arithmetic.
        evaluate_phase: Evaluates the phase lag in this arithmetic.

    Returns:
        The verdict, elementwise.
    """
    gain_difference = expand_gain_difference(alpha, beta, plant)
    u, certain = find_root(gain_difference)
    y = u * 0.5
    sin_half, cos_half = square_roots(y, 1.0 - y)  # of w/2
    phase = evaluate_phase(u, n)
    curve = expand_curve_with_offset(plant)
    # Evaluate E and F = H sin w, the real and imaginary part of (z - c) conj M.
    E, F = horner(y, curve.E), sin_half * cos_half * horner(y, curve.H) * 2.0
    cos_full = phase.cosine * cos_half - phase.sine * sin_half  # cos((n + 1) w)
    # Compute the boundary point, multiplied by V cos(w/2) > 0 (boundary.md, B1, with half angles):
    #   alpha_w -> 2 sin(w/2) projection
    #   beta_w  -> sine_F - phase.cosine E
    #   beta_w + delta -> boundary_offset, rearranged so that nothing cancels
    projection = (phase.sine * cos_half + phase.cosine * sin_half) * E + cos_full * F
    sine_F = phase.sine * F
    cosine_drop = phase.half_sine_squared * 2.0 - y / (cos_half + 1.0)  # cos(w/2) - cos((n + 1/2) w)
    boundary_offset = cos_half * y * horner(y, curve.excess) + E * cosine_drop + sine_F
    # Evaluate the equivalent criteria beta alpha_w - alpha beta_w > 0 and beta - beta_w > 0, multiplied by V cos(w/2).
    cross_product = projection * beta * sin_half * 2.0 - (sine_F - phase.cosine * E) * alpha
    damping_margin = (beta + plant.delta) * cos_half * compute_squared_modulus(y, 1.0 - y, curve) - boundary_offset
    # The lobe ends where (n + 1) w + arg(E + j F) reaches pi, where E + j F = (z - c) conj M. Neither angle is
    # negative, because arg(z - c) >= w >= arg M. ``projection`` has the sign of the sine of their sum. With (n + 1/2) w
    # <= pi, the last condition excludes sums of 2 pi or more, which need both angles above pi/2.
    on_lobe = certain & phase.within & (projection > 0) & ((E > 0) | (cos_full > 0))
    # Both criteria have the same sign but different rounding errors: cross_product is accurate near the end of the
    # lobe, where alpha decreases to 0, and damping_margin next to beta = -delta. ``steep``, the condition
    # Im W > alpha, separates the two parts approximately. (``^ True`` negates arrays as well as Python's bool.)
    steep = sin_half * cos_half * beta * 2.0 > alpha
    stable = on_lobe & ((steep & (cross_product > 0)) | ((steep ^ True) & (damping_margin > 0)))
    # If |B|^2 - |T|^2 is positive at u = 1, the crossover lies above w = pi/2 >= pi/(n + 1), or does not exist. The
    # wall is unstable in both cases.
    too_fast = sum(gain_difference[1:], gain_difference[0]) > 0
    off_lobe = phase.beyond | (projection < 0)
    return Verdict(stable, too_fast | (certain & (off_lobe | (cross_product < 0) | (damping_margin < 0))))


def find_first_root(coefficients: tuple[Array, ...]) -> Array:
    """Find the root in (0, 1] at which a cubic changes its sign from + to -, or the first positive root of a quadratic.

    Args:
        coefficients: h0, h1, h2[, h3], the lowest power first.

    Returns:
        The root. The value is meaningless if there is no root in (0, 1]; callers must check the signs.
    """
    h0, h1, h2, *rest = coefficients
    xp = namespace(*coefficients)
    # Start from the quadratic in which the cubic term h3 u^3 is replaced by (h3/2) u^2, a compromise over (0, 1].
    negative_h2 = -(h2 + 0.5 * rest[0]) if rest else -h2
    discriminant_root = xp.sqrt(xp.maximum(h1 * h1 + 4.0 * negative_h2 * h0, 0.0))
    # Choose the form of the quadratic formula that adds terms of equal sign, to avoid cancellation.
    falling = h1 < 0
    root = xp.where(falling, 2.0 * h0, h1 + discriminant_root) / xp.where(
        falling, discriminant_root - h1, 2.0 * negative_h2
    )
    if not rest:
        return root
    h3 = rest[0]
    # If the start is outside (0, 1], start from 1 instead: the root, if it is in (0, 1], is then near 1.
    root = xp.where((root > 0) & (root < 1.0), root, 1.0)
    # Unroll the Newton steps, because XLA then fuses all of them into a single loop over the points.
    for _ in range(NEWTON_STEPS):
        value, slope = h0 + root * (h1 + root * (h2 + root * h3)), h1 + root * (2.0 * h2 + 3.0 * root * h3)
        new = root - value / slope
        root = xp.where(new > 0, xp.minimum(new, 1.0), 0.5 * root)
    return root


def _find_crossover(gain_difference: tuple[Array, ...]) -> tuple[Array, Array]:
    """Return the crossover u, and whether it lies in (0, 1]; for d >= 1 no wall with a larger u is stable.

    A root in (0, 1] is the only one in (0, 2) by `expand_gain_difference`, so its uniqueness needs no check.
    """
    u = find_first_root(gain_difference)
    return u, (sum(gain_difference[1:], gain_difference[0]) <= 0) & (u > 0) & (u <= 1.0)


def evaluate_phase(u: Array, n: Array) -> DelayPhase:
    """Evaluate the phase lag (n + 1/2) w at the gain crossover ``u = 1 - cos w``, in floating point."""
    xp = namespace(u, n)
    # Compute the sine of half the phase lag, because 1 - cos((n + 1/2) w) must keep its relative accuracy for low
    # crossover frequencies.
    # ``w/2 = asin sqrt(u/2)``; ARCSINE approximates asin(s)/s in powers of 4 s^2 - 1 = 2 u - 1.
    half = xp.minimum((n + 0.5) * xp.sqrt(0.5 * u) * horner(2.0 * u - 1.0, ARCSINE), 0.5 * np.pi)
    square = half * half
    sine, cosine = half * horner(square, SINE), horner(square, COSINE)
    # If the comparison is false, (n + 1) w >= pi, because u <= w^2/2. If it is true, (n + 1/2) w <= pi, because asin is
    # nearly linear at these arguments and the factor (n + 1/2)/(n + 1) outweighs the rest (certified.md, C5).
    below_bound = u * (n + 1.0) * (n + 1.0) < 0.5 * np.pi * np.pi
    return DelayPhase(
        (cosine - sine) * (cosine + sine), 2.0 * sine * cosine, sine * sine, below_bound, below_bound ^ True
    )


def find_gain_crossover(alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Find the gain crossover frequency of a wall with alpha > 0, for stability margins.

    Args:
        alpha: Normalized stiffness.
        beta: Normalized damping.
        plant: Device and delay; a0 must be an array, 0 for integer delays, so that there are always four coefficients.

    Returns:
        The crossover w in rad per sample, in (0, pi], differentiable under JAX; and whether it exists. If it does not,
        w is meaningless.
    """
    # Solve for the smaller of u = 1 - cos w and v = 1 + cos w, because computing it as 2 minus the other one would lose
    # its relative accuracy.
    xp = namespace(alpha, plant.delta)
    alpha, beta, _ = expand_wall(alpha, beta)
    in_u = expand_gain_difference(alpha, beta, plant)
    # Expand |T|^2 - |B|^2 in powers of v. At v = 0, i.e. z = -1, it is positive if the crossover exists.
    in_v = expand_gain_difference_at_nyquist(alpha, beta, plant)
    wall_at_nyquist, device_at_nyquist = evaluate_at_nyquist(alpha, beta, plant)
    # If the polynomial in u is positive at u = 1, the crossover can only lie above w = pi/2; solve for v there.
    above_half = sum(in_u[1:], in_u[0]) > 0
    coefficients = tuple(xp.where(above_half, *pair) for pair in zip(in_v, in_u, strict=True))
    root = attach_root_derivatives(
        lambda x, *powers: horner(x, powers),
        find_first_root(stop_gradient(coefficients, xp)),
        lambda x, slope, _: slope != 0,
        *coefficients,
    )
    exists = (xp.abs(wall_at_nyquist) < device_at_nyquist) & (root > 0) & (root <= 1.0)
    u, v = xp.where(above_half, 2.0 - root, root), xp.where(above_half, root, 2.0 - root)
    return invert_haversine(0.5 * u, 0.5 * v, xp), exists


def stable_kernel(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses = ANY) -> Array:
    """Return whether each wall is stable, elementwise; False if an argument is NaN or out of range."""
    return decide_in_floats(alpha, beta, discretize_plant(delta, d, kind), kind)


def decide_in_floats(alpha: Array, beta: Array, plant: DiscretePlant, kind: DelayClasses) -> Array:
    """Return whether each wall is stable on a discretized plant, elementwise, in floating point."""
    alpha, beta, _ = expand_wall(alpha, beta)
    integer_plant = plant._replace(a0=None)
    if not kind.fractional:
        plant = integer_plant
    short = decide_short_delay(alpha, beta, plant).stable if kind.short else None
    if short is not None and kind.fractional:
        # For d = 0 use the formula without y, which is more accurate near the corner, where the lobe meets the line of
        # walls with a pole at z = -1.
        short = namespace(plant.f).where(plant.f == 0, decide_short_delay(alpha, beta, integer_plant).stable, short)
    if kind.long:
        long = decide_long_delay(alpha, beta, plant.whole, plant, _find_crossover, evaluate_phase).stable
    else:
        long = short
    stable = long if short is None else namespace(plant.whole).where(plant.whole < 1, short, long)
    return stable & (alpha > 0) & (beta + plant.delta > 0) & within(alpha, WALL_RANGE) & within(beta, WALL_RANGE)
