"""Find points of the stability lobe of a rigid device: its end, its peak, and its points at given beta or alpha.

The boundary curve starts at omega = 0 in (alpha, beta) = (0, -delta). Its first part, the lobe, bounds the stable set.
The lobe ends where alpha is 0 again or, for short delays and strong damping, at omega = pi in the *corner*, a wall with
a double pole at z = -1. Along the lobe, ``b = beta + delta`` increases, and alpha has a single maximum, the *peak*
(docs/theory/one-lobe.md, Theorems A and B). Therefore the stable walls on lines of constant beta (rows) and of constant
alpha (columns) are intervals (Theorem C), and each root below is the only one in its bracket. If the lobe ends in the
corner, some of these intervals end on the line of walls with a pole at z = -1, which passes through the corner.

The delay is d = n + f. A parameter ``x`` selects a point of the lobe: ``x = y = sin^2(omega/2)`` for n = 0, where alpha
and b are rational in y with the denominator V, and ``x = omega`` for n >= 1. Other notation as in
`stability.rigid.stiffness_limit`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import horner, iterate, materialize, namespace, stop_gradient
from zwidth.plant.rigid_mass import DelayClasses, DiscretePlant, discretize_plant
from zwidth.stability.rigid.crossover import expand_short_delay_curve
from zwidth.stability.rigid.ridge_newton import guess_start, solve_ridge
from zwidth.stability.rigid.stiffness_limit import (
    LobeTerms,
    LongLobe,
    build_long_lobe,
    evaluate_alpha_terms,
    evaluate_offset,
    expand_long_lobe,
    find_limit_long_delay,
    find_on_short_lobe,
    limit_short_delay,
)

CUBIC_STEPS = 4  # steps to the point with a given alpha for n = 0; the relative error of the start is at most 28 %
COLUMN_STEPS = 3  # the same for n >= 1, Newton steps; the relative error of the start is at most 0.3 %


class Lobe(NamedTuple):
    """The stability lobe of each device; the fields for d < 1 or d >= 1 are None if no delay is in that range."""

    plant: DiscretePlant
    d: Array
    is_short: Array | None  # d < 1; None unless both forms occur
    short_curve: Any  # `expand_short_delay_curve`
    long_lobe: Any  # `LongLobe`
    end: Array  # x at the end of the lobe
    to_corner: Array  # the lobe ends in the corner, at omega = pi with alpha > 0


class LobePoint(NamedTuple):
    """A point of the lobe: alpha, b = beta + delta, and their derivatives in x."""

    alpha: Array
    b: Array
    d_alpha: Array
    d_b: Array


class Peak(NamedTuple):
    """The point of the lobe with the largest alpha."""

    x: Array
    alpha: Array


def build_lobe(delta: Array, d: Array, kind: DelayClasses) -> Lobe:
    """Return the lobe of each device; ``kind`` states if delays d < 1, delays d >= 1 and fractional delays occur."""
    xp = namespace(delta, d)
    plant = materialize(discretize_plant(delta, d, kind), delta)
    is_short = plant.whole < 1
    short_curve, long_lobe, ends = None, None, []
    to_corner = plant.delta < 0
    if kind.short:
        short_curve = expand_short_delay_curve(plant)
        root, to_corner = _find_short_end(stop_gradient(short_curve, xp))
        ends.append(root)
    if kind.long:
        # Compute the last five fields (end of the lobe, starting values of Newton's method) without derivatives,
        # because the solution does not depend on its starting values.
        frozen_lobe = build_long_lobe(stop_gradient(plant, xp))
        long_lobe = frozen_lobe if xp is np else LongLobe(*expand_long_lobe(plant)[:-5], *frozen_lobe[-5:])
        ends.append(long_lobe.end)
    if len(ends) < 2:
        return Lobe(plant, d, None, short_curve, long_lobe, ends[0], to_corner)
    return Lobe(plant, d, is_short, short_curve, long_lobe, xp.where(is_short, *ends), to_corner & is_short)


def _find_short_end(short_curve: Any) -> tuple[Array, Array]:
    """Return, for n = 0, y at the end of the lobe (1, or the zero of alpha), and whether alpha > 0 up to y = 1."""
    a, s, t = short_curve[2]
    xp = namespace(a)
    discriminant = s * s - 4.0 * a * t
    root = 2.0 * a / (xp.sqrt(xp.maximum(discriminant, 0.0)) - s)
    stays_positive = (discriminant < 0) | (root >= 1.0)
    return xp.where(stays_positive, 1.0, root), stays_positive


def evaluate_lobe(x: Array, lobe: Lobe) -> LobePoint:
    """Return the point of the lobe at the parameter x."""
    if lobe.long_lobe is None:
        return _evaluate_short(x, lobe.short_curve)
    if lobe.short_curve is None:
        return _evaluate_long(x, lobe.long_lobe)
    xp = namespace(x, lobe.d)
    # Evaluate the form that is not selected at a valid x, because a NaN in it would make the derivatives of the
    # selected one NaN, too.
    low = _evaluate_short(xp.where(lobe.is_short, x, 0.25), lobe.short_curve)
    high = _evaluate_long(xp.where(lobe.is_short, xp.minimum(1.0, 1.0 / lobe.long_lobe.k), x), lobe.long_lobe)
    return LobePoint(
        *(xp.where(lobe.is_short, short_value, long_value) for short_value, long_value in zip(low, high, strict=True))
    )


def _evaluate_short(y: Array, short_curve: Any) -> LobePoint:
    """Return the point of the lobe at y, for n = 0."""
    (u0, u1), modulus_terms, (a, s, t) = short_curve
    dV, inverse = modulus_terms[1] + 2.0 * y * modulus_terms[2], 1.0 / horner(y, modulus_terms)
    alpha, b = 4.0 * y * (a + y * (s + y * t)) * inverse, y * (u0 + y * u1) * inverse
    d_alpha = (4.0 * (a + y * (2.0 * s + 3.0 * y * t)) - alpha * dV) * inverse
    return LobePoint(alpha, b, d_alpha, (u0 + 2.0 * y * u1 - b * dV) * inverse)


def _evaluate_long(omega: Array, long_lobe: LongLobe) -> LobePoint:
    """Return the point of the lobe at omega, for n >= 1."""
    terms = LobeTerms(omega, long_lobe)
    alpha_terms = evaluate_alpha_terms(terms)
    numerator, d_numerator, denominator, d_denominator = evaluate_offset(terms)
    inverse = 1.0 / denominator
    alpha, b = 2.0 * terms.s * alpha_terms.projection * inverse, numerator * inverse
    d_alpha = (
        terms.c * alpha_terms.projection + 2.0 * terms.s * alpha_terms.d_projection - alpha * d_denominator
    ) * inverse
    return LobePoint(alpha, b, d_alpha, (d_numerator - b * d_denominator) * inverse)


def compute_frequency(x: Array, lobe: Lobe) -> Array:
    """Return omega at x, with the derivative 0 at the corner, because the corner is always at omega = pi."""
    if lobe.short_curve is None:
        return x
    xp = namespace(x)
    y = x if lobe.is_short is None else xp.where(lobe.is_short, x, 0.25)
    inside = y < 1.0
    y = xp.where(inside, y, 0.25)
    angle = xp.where(inside, 2.0 * xp.arctan2(xp.sqrt(y), xp.sqrt(1.0 - y)), np.pi)
    return angle if lobe.is_short is None else xp.where(lobe.is_short, angle, x)


def compute_corner_line(lobe: Lobe) -> Array:
    """Return ``alpha + 2 beta`` of the walls with a pole at z = -1; arbitrary if the lobe ends without a corner."""
    return 1.0 / namespace(lobe.d).where(lobe.to_corner, lobe.plant.minus_one_coefficient, 1.0)


class RowLimit(NamedTuple):
    """The largest stable alpha at one beta: on the lobe or, beyond the corner, on the line of poles at -1."""

    x: Array  # the nearer end of the lobe if no point of the lobe has this beta
    meets_lobe: Array  # a point of the lobe has this beta
    beyond: Array  # the limit is on the line of walls with a pole at z = -1
    alpha: Array  # the value that `zwidth.is_stable` compares alpha with


def find_row_end(beta: Array, lobe: Lobe) -> RowLimit:
    """Return the largest stable alpha at one beta, from the only point of the lobe with ``b = beta + delta``."""
    xp = namespace(beta, lobe.d)
    b = beta + lobe.plant.delta
    limits = []
    if lobe.short_curve is not None:
        y, is_real = find_on_short_lobe(b, lobe.short_curve)
        limits.append(RowLimit(y, is_real & (y <= lobe.end), lobe.to_corner, limit_short_delay(beta, lobe.plant)))
    if lobe.long_lobe is not None:
        alpha, x = find_limit_long_delay(beta, lobe.long_lobe)
        limits.append(RowLimit(x, b < lobe.long_lobe.end_b, b != b, alpha))
    limit = limits[0]
    if lobe.is_short is not None:
        limit = RowLimit(
            *(xp.where(lobe.is_short, short_value, long_value) for short_value, long_value in zip(*limits, strict=True))
        )
    meets_lobe, beyond = (b > 0) & limit.meets_lobe, (b > 0) & ~limit.meets_lobe & limit.beyond
    x = xp.where(meets_lobe, limit.x, xp.where(b > 0, lobe.end, 0.0))
    return RowLimit(x, meets_lobe, beyond, limit.alpha)


def find_peak(lobe: Lobe, kind: DelayClasses) -> Peak:
    """Return the point of the lobe with the largest alpha, i.e. of maximum stiffness; it may be the corner."""
    plant = lobe.plant
    start = guess_start(plant.delta, lobe.d, plant.f, kind)
    ridge = solve_ridge(plant, plant.whole, start, kind)
    if lobe.short_curve is None:
        return Peak(ridge.omega, ridge.alpha)
    y = ridge.s * ridge.s
    x = y if lobe.is_short is None else namespace(lobe.d).where(lobe.is_short, y, ridge.omega)
    return Peak(x, ridge.alpha)


def find_column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> tuple[Array, Array]:
    """Return x of the point of the lobe with a given alpha, and whether the lobe ends in the corner before this point.

    Args:
        alpha: Normalized stiffness, 0 < alpha < ``top.alpha``.
        top: Point of largest alpha.
        lobe: The lobe.
        upper: Return the point with the larger beta, i.e. after the peak; otherwise the one before the peak.

    Returns:
        x; and whether the stable interval ends on the line of walls with a pole at z = -1 instead.
    """
    xp = namespace(alpha, lobe.d)
    never = alpha < 0
    if lobe.long_lobe is None:
        return _find_short_column_end(alpha, top, lobe, upper)
    x = _find_long_column_end(alpha, top, lobe, upper)
    if lobe.is_short is None:
        return x, never
    y, on_line = _find_short_column_end(alpha, top, lobe, upper)
    return xp.where(lobe.is_short, y, x), xp.where(lobe.is_short, on_line, never)


def _find_short_column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> tuple[Array, Array]:
    """Return y of the point with a given alpha before or after the peak, as a zero of a cubic, for n = 0.

    The cubic ``(alpha(y) - alpha) V`` is ``-c0 + c1 y + c2 y^2 + c3 y^3``. The second value is that of
    `find_column_end`.
    """
    xp = namespace(alpha, lobe.d)
    _, (v0, v1, v2), (a, s, t) = lobe.short_curve
    c0, c1, c2, c3 = alpha * v0, 4.0 * a - alpha * v1, 4.0 * s - alpha * v2, 4.0 * t
    y = 2.0 * c0 / (c1 + xp.sqrt(xp.maximum(c1 * c1 + 4.0 * c2 * c0, 0.0)))
    y = xp.minimum(y, top.x)
    # In each step, solve for the zero of the quadratic with the value and first two derivatives of the cubic at y.
    # Newton's method would converge slowly near the peak, where two zeros of the cubic are close together.
    for _ in range(CUBIC_STEPS):
        value, slope = -c0 + y * (c1 + y * (c2 + y * c3)), c1 + y * (2.0 * c2 + 3.0 * y * c3)
        curvature = 2.0 * c2 + 6.0 * y * c3
        y = y - 2.0 * value / (slope + xp.sqrt(xp.maximum(slope * slope - 2.0 * value * curvature, 0.0)))
        y = xp.minimum(xp.maximum(y, 0.0), top.x)
    if not upper:
        return y, alpha < 0
    # For the zero after the peak, divide the cubic by its linear factor with the first zero and solve the quotient c3
    # y^2 + e y + k = 0.
    k, e = c0 / y, c2 + c3 * y
    discriminant = e * e - 4.0 * c3 * k
    second = 2.0 * k / (xp.sqrt(xp.maximum(discriminant, 0.0)) - e)
    on_line = lobe.to_corner & ((discriminant < 0) | (second > 1.0))
    return xp.maximum(xp.minimum(second, lobe.end), top.x), on_line


def _find_long_column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> Array:
    """Return omega of the point with a given alpha, by Newton's method in variables in which alpha is nearly linear."""
    # After the peak, solve sqrt(1 - alpha(omega)/top.alpha) = S for omega. Before the peak, solve
    # sqrt(top.alpha/alpha(omega) - 1) = G for 1/omega. The left sides are nearly linear in omega and in 1/omega.
    xp = namespace(alpha, lobe.d)
    share = alpha / top.alpha
    S = xp.sqrt(xp.maximum(1.0 - share, 0.0))
    if upper:
        x = top.x + (lobe.end - top.x) * S

        def outwards(x: Array) -> Array:
            point = evaluate_lobe(x, lobe)
            root = xp.sqrt(xp.maximum(1.0 - point.alpha / top.alpha, 0.0))
            step = 2.0 * root / (root + S) * (point.alpha - alpha) / point.d_alpha
            return xp.minimum(xp.maximum(x - xp.where(point.d_alpha < 0, step, 0.0), top.x), lobe.end)

        return iterate(COLUMN_STEPS, outwards, x, xp)
    # Near omega = 0, alpha is approximately alpha_rate omega^2. Start from an interpolation between this parabola and
    # the peak.
    long_lobe = lobe.long_lobe
    alpha_rate = ((long_lobe.k + 0.5) * long_lobe.E0 + long_lobe.H0) / long_lobe.V0
    start_ratio = 2.0 * top.alpha / (alpha_rate * top.x * top.x)
    half_share = share / (1.0 + S)
    x = top.x * xp.sqrt(half_share) * xp.sqrt(start_ratio + (1.0 - start_ratio) * half_share)
    G = S / xp.sqrt(share)

    def inwards(x: Array) -> Array:
        point = evaluate_lobe(x, lobe)
        root = xp.sqrt(xp.maximum(top.alpha / point.alpha - 1.0, 0.0))
        step = 2.0 * root / (root + G) * (point.alpha / alpha) * (point.alpha - alpha) / (point.d_alpha * x)
        return xp.minimum(x / (1.0 + xp.where(point.d_alpha > 0, step, 0.0)), top.x)

    return iterate(COLUMN_STEPS, inwards, x, xp)
