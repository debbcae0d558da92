"""The lobe of the boundary curve of the rigid loop: its points, end and peak, and its points at one beta or alpha.

The curve starts at (0, -delta), omega = 0, and bounds the stable set until it returns to alpha = 0 or, for short
delays and strong damping, until omega = pi, where a double pole sits at z = -1 (the corner). ``b = beta + delta`` grows
along it and alpha has one maximum (docs/theory/one-lobe.md, Theorems A and B), so that rows and columns are intervals
(Theorem C), and each root below is the only one where it is sought.

Places on the lobe are counted by ``x``: ``y = sin^2(omega/2)`` for n = 0, where alpha and b are rational in y, and
omega itself from one period on. Notation of `loops.rigid.row_limit`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.held_mass import DelayClasses, DeviceTerms, device
from zwidth.loops.rigid.crossover import short_curve
from zwidth.loops.rigid.ridge_newton import guess_start, solve
from zwidth.loops.rigid.row_limit import (
    Angles,
    LongLobe,
    long_lobe,
    long_row_point,
    offset,
    open_lobe,
    short_place,
    short_row,
    turn_angles,
)
from zwidth.words.types import Array
from zwidth.words.xp import frozen, horner, namespace, repeat, store_once

_CUBIC_STEPS = 4  # steps for n = 0; the start is within 28 % of x
_COLUMN_STEPS = 3  # Newton steps for n >= 1; the start is within 0.3 % of x


class Lobe(NamedTuple):
    """The boundary curve of one device; fields for delays that do not occur are None."""

    here: DeviceTerms
    d: Array
    is_short: Array | None  # d < 1; None unless both forms occur
    short: Any  # `short_curve`
    long: Any  # `LongLobe`
    end: Array  # the last x
    to_corner: Array  # the lobe ends at omega = pi with alpha > 0


class LobePoint(NamedTuple):
    """A point of the curve and its derivatives in x."""

    alpha: Array
    b: Array
    d_alpha: Array
    d_b: Array


class Peak(NamedTuple):
    """The point of the lobe with the largest alpha: the ridge."""

    x: Array
    alpha: Array


def lobe(delta: Array, d: Array, kind: DelayClasses) -> Lobe:
    """Return the lobe of one device, or of arrays of one shape, for the delays that `DelayClasses` allows."""
    xp = namespace(delta, d)
    here = store_once(device(delta, d, kind), delta)
    is_short = here.whole < 1
    short, long, ends = None, None, []
    to_corner = here.delta < 0
    if kind.short:
        short = short_curve(here)
        root, to_corner = _short_end(frozen(short, xp))
        ends.append(root)
    if kind.long:
        # Freeze the end and the fields after it, because they are only starting values of solvers.
        still = long_lobe(frozen(here, xp))
        long = still if xp is np else LongLobe(*open_lobe(here)[:-5], *still[-5:])
        ends.append(long.end)
    if len(ends) < 2:
        return Lobe(here, d, None, short, long, ends[0], to_corner)
    return Lobe(here, d, is_short, short, long, xp.where(is_short, *ends), to_corner & is_short)


def _short_end(short: Any) -> tuple[Array, Array]:
    """The first y at which alpha returns to 0, 1 where it does not before, and whether it does not."""
    a, s, t = short[2]
    xp = namespace(a)
    square = s * s - 4.0 * a * t
    root = 2.0 * a / (xp.sqrt(xp.maximum(square, 0.0)) - s)
    beyond = (square < 0) | (root >= 1.0)
    return xp.where(beyond, 1.0, root), beyond


def wall(x: Array, lobe: Lobe) -> LobePoint:
    """Return the point of the curve at x."""
    if lobe.long is None:
        return _short_wall(x, lobe.short)
    if lobe.short is None:
        return _long_wall(x, lobe.long)
    xp = namespace(x, lobe.d)
    # Evaluate the form that is not selected at a valid x, because NaN would spoil the derivatives of the other one.
    low = _short_wall(xp.where(lobe.is_short, x, 0.25), lobe.short)
    high = _long_wall(xp.where(lobe.is_short, xp.minimum(1.0, 1.0 / lobe.long.k), x), lobe.long)
    return LobePoint(*(xp.where(lobe.is_short, mine, other) for mine, other in zip(low, high, strict=True)))


def _short_wall(y: Array, short: Any) -> LobePoint:
    (u0, u1), size, (a, s, t) = short
    dV, over = size[1] + 2.0 * y * size[2], 1.0 / horner(y, size)
    alpha, b = 4.0 * y * (a + y * (s + y * t)) * over, y * (u0 + y * u1) * over
    d_alpha = (4.0 * (a + y * (2.0 * s + 3.0 * y * t)) - alpha * dV) * over
    return LobePoint(alpha, b, d_alpha, (u0 + 2.0 * y * u1 - b * dV) * over)


def _long_wall(omega: Array, long: LongLobe) -> LobePoint:
    at = Angles(omega, long)
    turn = turn_angles(at)
    total, d_total, scale, d_scale = offset(at)
    over = 1.0 / scale
    alpha, b = 2.0 * at.s * turn.across * over, total * over
    d_alpha = (at.c * turn.across + 2.0 * at.s * turn.d_across - alpha * d_scale) * over
    return LobePoint(alpha, b, d_alpha, (d_total - b * d_scale) * over)


def frequency(x: Array, lobe: Lobe) -> Array:
    """omega of a place, with the derivative of an end at a corner left out."""
    if lobe.short is None:
        return x
    xp = namespace(x)
    y = x if lobe.is_short is None else xp.where(lobe.is_short, x, 0.25)
    inside = y < 1.0
    y = xp.where(inside, y, 0.25)
    angle = xp.where(inside, 2.0 * xp.arctan2(xp.sqrt(y), xp.sqrt(1.0 - y)), np.pi)
    return angle if lobe.is_short is None else xp.where(lobe.is_short, angle, x)


def on_line(lobe: Lobe) -> Array:
    """``alpha + 2 beta`` on the line of a real pole at z = -1, of no meaning where no corner is reached."""
    return 1.0 / namespace(lobe.d).where(lobe.to_corner, lobe.here.tilt, 1.0)


class RowEnd(NamedTuple):
    """The largest stable alpha at one beta: on the lobe, or after the corner on the line with a pole at z = -1."""

    x: Array  # the nearer end of the lobe if no point of the lobe has this beta
    meets: Array  # a point of the lobe has this beta
    beyond: Array  # the limit is on the line with a pole at z = -1
    alpha: Array  # the value that `zwidth.is_stable` compares alpha with


def row_end(beta: Array, lobe: Lobe) -> RowEnd:
    """Return the largest stable alpha at one beta, from the only zero of ``b - beta - delta`` on the lobe."""
    xp = namespace(beta, lobe.d)
    b = beta + lobe.here.delta
    ends = []
    if lobe.short is not None:
        y, real = short_place(b, lobe.short)
        ends.append(RowEnd(y, real & (y <= lobe.end), lobe.to_corner, short_row(beta, lobe.here)))
    if lobe.long is not None:
        alpha, x = long_row_point(beta, lobe.long)
        ends.append(RowEnd(x, b < lobe.long.top, b != b, alpha))
    row = ends[0]
    if lobe.is_short is not None:
        row = RowEnd(*(xp.where(lobe.is_short, mine, other) for mine, other in zip(*ends, strict=True)))
    meets, beyond = (b > 0) & row.meets, (b > 0) & ~row.meets & row.beyond
    x = xp.where(meets, row.x, xp.where(b > 0, lobe.end, 0.0))
    return RowEnd(x, meets, beyond, row.alpha)


def peak(lobe: Lobe, kind: DelayClasses) -> Peak:
    """Return the largest alpha of the lobe: the ridge, which may be the corner."""
    here = lobe.here
    start = guess_start(here.delta, lobe.d, here.f, kind)
    ridge = solve(here, here.whole, start, kind)
    if lobe.short is None:
        return Peak(ridge.omega, ridge.alpha)
    y = ridge.s * ridge.s
    x = y if lobe.is_short is None else namespace(lobe.d).where(lobe.is_short, y, ridge.omega)
    return Peak(x, ridge.alpha)


def column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> tuple[Array, Array]:
    """Return x where the lobe has 0 < alpha < ``top.alpha``, and a mask of ends on the line z = -1 instead."""
    xp = namespace(alpha, lobe.d)
    nowhere = alpha < 0
    if lobe.long is None:
        return _short_end_of_column(alpha, top, lobe, upper)
    x = _long_end_of_column(alpha, top, lobe, upper)
    if lobe.is_short is None:
        return x, nowhere
    y, on_line = _short_end_of_column(alpha, top, lobe, upper)
    return xp.where(lobe.is_short, y, x), xp.where(lobe.is_short, on_line, nowhere)


def _short_end_of_column(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> tuple[Array, Array]:
    """The first or the second zero of ``(alpha(y) - alpha) V``, a cubic ``-c0 + c1 y + c2 y^2 + c3 y^3``."""
    xp = namespace(alpha, lobe.d)
    _, (v0, v1, v2), (a, s, t) = lobe.short
    c0, c1, c2, c3 = alpha * v0, 4.0 * a - alpha * v1, 4.0 * s - alpha * v2, 4.0 * t
    y = 2.0 * c0 / (c1 + xp.sqrt(xp.maximum(c1 * c1 + 4.0 * c2 * c0, 0.0)))
    y = xp.minimum(y, top.x)
    # Each step solves the quadratic that touches the cubic to second order: near the ridge two zeros are close.
    for _ in range(_CUBIC_STEPS):
        value, slope = -c0 + y * (c1 + y * (c2 + y * c3)), c1 + y * (2.0 * c2 + 3.0 * y * c3)
        bend = 2.0 * c2 + 6.0 * y * c3
        y = y - 2.0 * value / (slope + xp.sqrt(xp.maximum(slope * slope - 2.0 * value * bend, 0.0)))
        y = xp.minimum(xp.maximum(y, 0.0), top.x)
    if not upper:
        return y, alpha < 0
    # Divided by the first zero, c3 y^2 + e y + k is left.
    k, e = c0 / y, c2 + c3 * y
    square = e * e - 4.0 * c3 * k
    second = 2.0 * k / (xp.sqrt(xp.maximum(square, 0.0)) - e)
    on_line = lobe.to_corner & ((square < 0) | (second > 1.0))
    return xp.maximum(xp.minimum(second, lobe.end), top.x), on_line


def _long_end_of_column(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> Array:
    """Newton's method in variables in which alpha is nearly linear, from the ridge to where it vanishes."""
    # Behind the ridge ``S = sqrt(1 - alpha/top)`` over omega; before it ``G = sqrt(top/alpha - 1)`` over 1/omega.
    xp = namespace(alpha, lobe.d)
    share = alpha / top.alpha
    S = xp.sqrt(xp.maximum(1.0 - share, 0.0))
    if upper:
        x = top.x + (lobe.end - top.x) * S

        def outwards(x: Array) -> Array:
            at = wall(x, lobe)
            here = xp.sqrt(xp.maximum(1.0 - at.alpha / top.alpha, 0.0))
            step = 2.0 * here / (here + S) * (at.alpha - alpha) / at.d_alpha
            return xp.minimum(xp.maximum(x - xp.where(at.d_alpha < 0, step, 0.0), top.x), lobe.end)

        return repeat(_COLUMN_STEPS, outwards, x, xp)
    # alpha = rate omega^2 + ... at the start; of the ridge nothing is used but its place.
    long = lobe.long
    rate = ((long.k + 0.5) * long.g0 + long.h0) / long.v0
    begin = 2.0 * top.alpha / (rate * top.x * top.x)
    part = share / (1.0 + S)
    x = top.x * xp.sqrt(part) * xp.sqrt(begin + (1.0 - begin) * part)
    G = S / xp.sqrt(share)

    def inwards(x: Array) -> Array:
        at = wall(x, lobe)
        here = xp.sqrt(xp.maximum(top.alpha / at.alpha - 1.0, 0.0))
        step = 2.0 * here / (here + G) * (at.alpha / alpha) * (at.alpha - alpha) / (at.d_alpha * x)
        return xp.minimum(x / (1.0 + xp.where(at.d_alpha > 0, step, 0.0)), top.x)

    return repeat(_COLUMN_STEPS, inwards, x, xp)
