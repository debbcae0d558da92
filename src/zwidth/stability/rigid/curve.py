"""Find points of the stability lobe of a rigid device: its end, its peak, and its points at given beta or alpha.

A point of the lobe is given by s = sin(omega/2); y = s^2, b = beta + delta. The boundary curve starts at omega = 0 in
(alpha, beta) = (0, -delta). Its first part, the lobe, bounds the stable set. The lobe ends where alpha is 0 again or,
for short delays and strong damping, at omega = pi in the *corner*, a wall with a double pole at z = -1. Along the lobe,
``b = beta + delta`` increases, and alpha has a single maximum, the *peak* (docs/theory/one-lobe.md, Theorems A and B).
Therefore the stable walls on lines of constant beta (rows) and of constant alpha (columns) are intervals (Theorem C),
and each root below is the only one in its bracket. If the lobe ends in the corner, some of these intervals end on the
line of walls with a pole at z = -1, which passes through the corner.

The delay is d = n + f. Other notation is that of `stability.rigid.boundary_curve`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import iterate, namespace, stop_gradient
from zwidth.plant.rigid_mass import DelayClasses, DiscretePlant, discretize_plant
from zwidth.stability.rigid.boundary_curve import (
    CurvePoint,
    evaluate_curve,
    evaluate_short_delay_curve,
    evaluate_wave,
    expand_curve_with_offset,
    expand_short_delay_curve,
)
from zwidth.stability.rigid.characteristic_polynomial import expand_wall, recover_wall
from zwidth.stability.rigid.ridge_newton import guess_start, solve_ridge
from zwidth.stability.rigid.stiffness_limit import (
    build_long_lobe,
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
    end: Array  # s at the end of the lobe
    to_corner: Array  # the lobe ends in the corner, at omega = pi with alpha > 0


class Peak(NamedTuple):
    """The point of the lobe with the largest alpha."""

    s: Array
    alpha: Array


def build_lobe(delta: Array, d: Array, kind: DelayClasses) -> Lobe:
    """Return the lobe of each device; ``kind`` states if delays d < 1, delays d >= 1 and fractional delays occur."""
    xp = namespace(delta, d)
    plant = discretize_plant(delta, d, kind)
    is_short = plant.whole < 1
    short_curve, long_lobe, ends = None, None, []
    to_corner = plant.delta < 0
    if kind.short:
        short_curve = expand_short_delay_curve(plant)
        root, to_corner = _find_short_end(stop_gradient(short_curve, xp))
        ends.append(root)
    if kind.long:
        # Compute the end of the lobe and the starting values of Newton's method without derivatives (`stop_gradient`),
        # because converged solutions do not depend on starting values.
        long_lobe = build_long_lobe(stop_gradient(plant, xp))
        if xp is not np:
            long_lobe = long_lobe._replace(delta=plant.delta, curve=expand_curve_with_offset(plant))
        ends.append(long_lobe.end)
    if len(ends) < 2:
        return Lobe(plant, d, None, short_curve, long_lobe, ends[0], to_corner)
    return Lobe(plant, d, is_short, short_curve, long_lobe, xp.where(is_short, *ends), to_corner & is_short)


def _find_short_end(short_curve: Any) -> tuple[Array, Array]:
    """Return s at the end of the lobe for n = 0, and True if that is the corner s = 1, with alpha > 0 up to it."""
    a, s, t = short_curve[2]
    xp = namespace(a)
    discriminant = s * s - 4.0 * a * t
    root = 2.0 * a / (xp.sqrt(xp.maximum(discriminant, 0.0)) - s)
    stays_positive = (discriminant < 0) | (root >= 1.0)
    return xp.where(stays_positive, 1.0, xp.sqrt(root)), stays_positive


def evaluate_lobe(s: Array, lobe: Lobe) -> CurvePoint:
    """Return the point of the lobe at s = sin(omega/2), with derivatives."""
    if lobe.long_lobe is None:
        return evaluate_short_delay_curve(s * s, lobe.short_curve).divide(s)
    if lobe.short_curve is None:
        return evaluate_curve(evaluate_wave(s, lobe.plant.whole, low=True), lobe.long_lobe.curve).divide(s)
    xp = namespace(s, lobe.d)
    # Evaluate both formulas, d < 1 and d >= 1, for all devices. Replace s by 0.5 in the formula that is not selected,
    # because its NaN would make the derivatives of the selected values NaN, too.
    short_s, long_s = xp.where(lobe.is_short, s, 0.5), xp.where(lobe.is_short, 0.5, s)
    short = evaluate_short_delay_curve(short_s * short_s, lobe.short_curve).divide(short_s)
    long = evaluate_curve(evaluate_wave(long_s, lobe.plant.whole, low=True), lobe.long_lobe.curve).divide(long_s)
    return CurvePoint(*(xp.where(lobe.is_short, *pair) for pair in zip(short, long, strict=True)))


def compute_frequency(s: Array) -> Array:
    """Return omega = 2 arcsin(s); its derivative is set to 0 at s = 1, because the corner stays at omega = pi."""
    xp = namespace(s)
    inside = s < 1.0
    s = xp.where(inside, s, 0.5)
    return xp.where(inside, 2.0 * xp.arctan2(s, xp.sqrt((1.0 - s) * (1.0 + s))), np.pi)


def find_on_corner_line(given: Array, lobe: Lobe, is_row: bool) -> tuple[Array, Array]:
    """Return the wall with a pole at z = -1 and a given beta (``is_row``) or alpha; arbitrary without a corner."""
    # On the line of walls with a pole at z = -1, alpha + 2 beta is constant (the factor -W of P at z = -1).
    total = 1.0 / namespace(lobe.d).where(lobe.to_corner, lobe.plant.minus_one_coefficient, 1.0)
    if is_row:
        return total - 2.0 * expand_wall(0.0, given).beta, given
    return recover_wall(given, 0.5 * (total - given))


class RowLimit(NamedTuple):
    """The largest stable alpha at one beta: on the lobe or, beyond the corner, on the line of poles at -1."""

    s: Array  # s = sin(omega/2) of the point; of the nearer end of the lobe if no point of the lobe has this beta
    meets_lobe: Array  # a point of the lobe has this beta
    beyond: Array  # the limit is on the line of walls with a pole at z = -1
    alpha: Array  # the value that `zwidth.is_stable` compares alpha with


def compute_offset(beta: Array, lobe: Lobe) -> Array:
    """Return b = beta + delta for the damping beta of a wall."""
    return expand_wall(0.0, beta).beta + lobe.plant.delta


def compute_damping(b: Array, lobe: Lobe) -> Array:
    """Return the damping beta = b - delta of a wall."""
    return recover_wall(0.0, b - lobe.plant.delta)[1]


def find_row_end(beta: Array, lobe: Lobe) -> RowLimit:
    """Return the largest stable alpha at one beta, from the only point of the lobe with this beta."""
    xp = namespace(beta, lobe.d)
    b = compute_offset(beta, lobe)
    limits = []
    if lobe.short_curve is not None:
        y, is_real = find_on_short_lobe(b, lobe.short_curve)
        s = xp.sqrt(xp.maximum(y, 0.0))
        limits.append(RowLimit(s, is_real & (s <= lobe.end), lobe.to_corner, limit_short_delay(beta, lobe.plant)))
    if lobe.long_lobe is not None:
        alpha, s = find_limit_long_delay(beta, lobe.long_lobe)
        limits.append(RowLimit(s, b < lobe.long_lobe.end_b, b != b, alpha))
    limit = limits[0]
    if lobe.is_short is not None:
        limit = RowLimit(*(xp.where(lobe.is_short, *pair) for pair in zip(*limits, strict=True)))
    meets_lobe, beyond = (b > 0) & limit.meets_lobe, (b > 0) & ~limit.meets_lobe & limit.beyond
    s = xp.where(meets_lobe, limit.s, xp.where(b > 0, lobe.end, 0.0))
    return RowLimit(s, meets_lobe, beyond, limit.alpha)


def find_peak(lobe: Lobe, kind: DelayClasses) -> Peak:
    """Return the point of the lobe with the largest alpha, i.e. of maximum stiffness; it may be the corner."""
    plant = lobe.plant
    ridge = solve_ridge(plant, plant.whole, guess_start(plant.delta, lobe.d, plant.f, kind), kind)
    return Peak(ridge.s, ridge.alpha)


def find_column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> tuple[Array, Array]:
    """Return s of the lobe point with a given alpha, and whether the lobe ends in the corner before such a point.

    Args:
        alpha: Normalized stiffness, 0 < alpha < ``top.alpha``.
        top: Point of largest alpha.
        lobe: The lobe.
        upper: Return the point with the larger beta, i.e. after the peak; otherwise the one before the peak.

    Returns:
        s = sin(omega/2) of the point; and True if no such point exists after the peak, so that the interval of stable
        beta ends on the line of walls with a pole at z = -1 instead.
    """
    xp = namespace(alpha, lobe.d)
    never = alpha < 0
    if lobe.long_lobe is None:
        return _find_short_column_end(alpha, top, lobe, upper)
    s = _find_long_column_end(alpha, top, lobe, upper)
    if lobe.is_short is None:
        return s, never
    short_s, on_line = _find_short_column_end(alpha, top, lobe, upper)
    return xp.where(lobe.is_short, short_s, s), xp.where(lobe.is_short, on_line, never)


def _find_short_column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> tuple[Array, Array]:
    """Return s of the point with a given alpha before or after the peak, from a zero of a cubic in y, for n = 0.

    The cubic is ``V (alpha(y) - alpha) = -c0 + c1 y + c2 y^2 + c3 y^3``. The second result is as in `find_column_end`.
    """
    xp = namespace(alpha, lobe.d)
    _, (v0, v1, v2), (a, s, t) = lobe.short_curve
    c0, c1, c2, c3 = alpha * v0, 4.0 * a - alpha * v1, 4.0 * s - alpha * v2, 4.0 * t
    y = 2.0 * c0 / (c1 + xp.sqrt(xp.maximum(c1 * c1 + 4.0 * c2 * c0, 0.0)))
    top_y = top.s * top.s
    y = xp.minimum(y, top_y)
    # In each step, solve for the zero of the quadratic with the value and first two derivatives of the cubic at y.
    # Newton's method would converge slowly near the peak, where two zeros of the cubic are close together.
    for _ in range(CUBIC_STEPS):
        value, slope = -c0 + y * (c1 + y * (c2 + y * c3)), c1 + y * (2.0 * c2 + 3.0 * y * c3)
        curvature = 2.0 * c2 + 6.0 * y * c3
        y = y - 2.0 * value / (slope + xp.sqrt(xp.maximum(slope * slope - 2.0 * value * curvature, 0.0)))
        y = xp.minimum(xp.maximum(y, 0.0), top_y)
    if not upper:
        return xp.minimum(xp.sqrt(y), top.s), alpha < 0
    # For the zero after the peak, divide the cubic by its linear factor with the first zero and solve the quotient c3
    # y^2 + e y + k = 0.
    k, e = c0 / y, c2 + c3 * y
    discriminant = e * e - 4.0 * c3 * k
    second = 2.0 * k / (xp.sqrt(xp.maximum(discriminant, 0.0)) - e)
    on_line = lobe.to_corner & ((discriminant < 0) | (second > 1.0))
    return xp.maximum(xp.minimum(xp.sqrt(second), lobe.end), top.s), on_line


def _find_long_column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> Array:
    """Return s of the lobe point with a given alpha for n >= 1, by Newton's method in nearly linear variables."""
    # With alpha(s) on the lobe and share = alpha/top.alpha, solve one of two equivalent equations. After the peak,
    # solve sqrt(1 - alpha(s)/top.alpha) = sqrt(1 - share) = S for s, because the left side is nearly linear in s.
    # Before the peak, solve sqrt(top.alpha/alpha(s) - 1) = sqrt(1/share - 1) = G for 1/s, because the left side is
    # nearly linear in 1/s.
    xp = namespace(alpha, lobe.d)
    share = alpha / top.alpha
    S = xp.sqrt(xp.maximum(1.0 - share, 0.0))
    if upper:
        s = top.s + (lobe.end - top.s) * S

        def outwards(s: Array) -> Array:
            point = evaluate_lobe(s, lobe)
            root = xp.sqrt(xp.maximum(1.0 - point.alpha / top.alpha, 0.0))
            step = 2.0 * root / (root + S) * (point.alpha - alpha) / point.d_alpha
            return xp.minimum(xp.maximum(s - xp.where(point.d_alpha < 0, step, 0.0), top.s), lobe.end)

        return iterate(COLUMN_STEPS, outwards, s, xp)
    # Near s = 0, the lobe is approximately alpha = alpha_rate s^2. Start from an interpolation between this parabola
    # and the peak.
    curve = lobe.long_lobe.curve
    alpha_rate = 4.0 * ((lobe.plant.whole + 1.0) * curve.E[0] + curve.H[0]) / curve.at_one**2
    start_ratio = 2.0 * top.alpha / (alpha_rate * top.s * top.s)
    half_share = share / (1.0 + S)
    s = top.s * xp.sqrt(half_share) * xp.sqrt(start_ratio + (1.0 - start_ratio) * half_share)
    G = S / xp.sqrt(share)

    def inwards(s: Array) -> Array:
        point = evaluate_lobe(s, lobe)
        root = xp.sqrt(xp.maximum(top.alpha / point.alpha - 1.0, 0.0))
        step = 2.0 * root / (root + G) * (point.alpha / alpha) * (point.alpha - alpha) / (point.d_alpha * s)
        return xp.minimum(s / (1.0 + xp.where(point.d_alpha > 0, step, 0.0)), top.s)

    return iterate(COLUMN_STEPS, inwards, s, xp)
