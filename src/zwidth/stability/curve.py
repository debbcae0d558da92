"""The lobe of the boundary curve: its points, its end, its peak, and where a column meets it.

The curve starts at (0, -delta), omega = 0, and bounds the stable set until it returns to alpha = 0 or, for short
delays and strong damping, until omega = pi, where a double pole sits at z = -1 (the corner). ``b = beta + delta`` grows
along it and alpha has one maximum (docs/theory/one-lobe.md, Theorem 3), so that rows and columns are intervals, and
each root below is the only one where it is sought.

Places on the lobe are counted by ``x``: ``y = sin^2(omega/2)`` for n = 0, where alpha and b are rational in y, and
omega itself from one period on. Notation of `zwidth.stability.row_limit`; with V over phi1^2, for n = 0,

    b = y (u0 + u1 y)/V     alpha = 4 y (a + y (s + t y))/V     V = 1 + y (v1 + v2 y)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.batching import tree_map
from zwidth.loop import FrequencyLoop, frequency_boundary
from zwidth.stability.devices import Device, Kind, device
from zwidth.stability.row_limit import LONG_FIELDS, Angles, long_device, long_row_point, offset, turned
from zwidth.xp import epsilon, namespace, repeat

# Where the fit of the peak puts it to 4 %, the secant method needs so many steps for 1e-9 of x, 1e-17 of alpha.
_PEAK_STEPS, _PEAK_STEPS_SHORT = 5, 9
# From starts within 28 % (the cubic for n = 0) and 0.3 % of x.
_CUBIC_STEPS, _COLUMN_STEPS = 4, 3
# Halvings of a logarithm that spans 32 decades: what is left is rounding.
_HALVINGS = 60
_SMALLEST = 1e-32
_END, _TOP = LONG_FIELDS.index("end"), LONG_FIELDS.index("top")


class Short(NamedTuple):
    """The rational curve for n = 0, see the head of this file."""

    u0: Array
    u1: Array
    a: Array
    s: Array
    t: Array
    v1: Array
    v2: Array


class Lobe(NamedTuple):
    """The curve of one device; what does not occur among the delays of a kernel is None."""

    delta: Array
    d: Array
    is_short: Array | None  # where both forms occur
    short: Short | None
    long: Any  # `LONG_FIELDS`
    end: Array  # the last x
    to_corner: Array  # whether it ends at omega = pi with alpha > 0
    tilt: Array  # P(-1) has the stable sign where tilt (alpha + 2 beta) < 1


class Wall(NamedTuple):
    """A point of the curve, and how it moves with x."""

    alpha: Array
    b: Array
    d_alpha: Array
    d_b: Array


class Peak(NamedTuple):
    """Where alpha is largest on the lobe: the ridge."""

    x: Array
    alpha: Array


def device_of(delta: Array, d: Array, delay: str, kind: Kind) -> Device:
    """The device whose curve is meant. A fractional power is the formula of whole delays at any other number."""
    if delay == "held":
        return device(delta, d, kind)
    return device(delta, 0.0 * d, Kind(True, False, False))._replace(whole=d)


def creeps(delay: str, kind: Kind) -> bool:
    """Whether there may be a fractional power of less than one, whose lobe ends within any distance of pi.

    No fit holds for it: it is solved by halving.
    """
    return delay == "fractional_power" and kind.short and kind.fractional


def lobe(here: Device, d: Array, delay: str, kind: Kind) -> Lobe:
    """The lobe of a device, or of arrays of one shape, from the delays that `Kind` says may occur."""
    xp = namespace(here.delta, d)
    creeping = creeps(delay, kind)
    has_long = kind.long or creeping
    is_short = here.whole < 1 if delay == "held" else here.whole == 0
    short, long, ends = None, None, []
    to_corner = here.delta < 0
    if kind.short:
        short = _short(here)
        root, to_corner = _short_end(short)
        ends.append(root)
    if has_long:
        long = list(long_device(here))
        if creeping:
            limit = np.pi / xp.maximum(1.0, d + 0.5)
            crept = bisect_place(lambda x: _long_wall(x, long).alpha > 0, _SMALLEST * limit, limit, xp)
            long[_END] = xp.where(d < 1, crept, long[_END])
        ends.append(long[_END])
    if len(ends) < 2:
        return Lobe(here.delta, d, None, short, long, ends[0], to_corner, here.tilt)
    end = xp.where(is_short, ends[0], ends[1])
    return Lobe(here.delta, d, is_short, short, long, end, to_corner & is_short, here.tilt)


def _short(here: Device) -> Short:
    f, t, em, p1 = here.f, 1.0 - here.f, here.em, here.p1
    over = 1.0 / (p1 * p1)
    a2, a1, a0 = here.a2, here.a1, here.a0
    # Sums of terms of one sign.
    u0 = 4.0 * (f * f * em + f * p1 + t * (f * here.p1_t + t * here.psi_t) + a0) / p1
    u1 = -16.0 * a0 * (f + t * here.p1_t) * over
    v1, v2 = -4.0 * (a1 * (a2 + a0) + 4.0 * a2 * a0) * over, 16.0 * a2 * a0 * over
    return Short(u0, u1, ((1.0 + f) * em + p1) / p1, -4.0 * (a1 + (3.0 + em) * a0) * over, 16.0 * a0 * over, v1, v2)


def _short_end(short: Short) -> tuple[Array, Array]:
    """The first y at which alpha returns to 0, 1 where it does not before, and whether it does not."""
    xp = namespace(short.a)
    square = short.s * short.s - 4.0 * short.a * short.t
    root = 2.0 * short.a / (xp.sqrt(xp.maximum(square, 0.0)) - short.s)
    beyond = (square < 0) | (root >= 1.0)
    return xp.where(beyond, 1.0, root), beyond


def wall(x: Array, lobe: Lobe) -> Wall:
    """The point of the curve at one place."""
    if lobe.long is None:
        return _short_wall(x, lobe.short)
    if lobe.short is None:
        return _long_wall(x, lobe.long)
    xp = namespace(x, lobe.delta)
    # Each form gets a place that is harmless where the other one holds.
    low = _short_wall(xp.where(lobe.is_short, x, 0.25), lobe.short)
    high = _long_wall(xp.where(lobe.is_short, xp.minimum(1.0, 1.0 / lobe.long[1]), x), lobe.long)
    return Wall(*(xp.where(lobe.is_short, mine, other) for mine, other in zip(low, high, strict=True)))


def _short_wall(y: Array, short: Short | None) -> Wall:
    assert short is not None
    u0, u1, a, s, t, v1, v2 = short
    V, dV = 1.0 + y * (v1 + y * v2), v1 + 2.0 * y * v2
    over = 1.0 / V
    alpha, b = 4.0 * y * (a + y * (s + y * t)) * over, y * (u0 + y * u1) * over
    d_alpha = (4.0 * (a + y * (2.0 * s + 3.0 * y * t)) - alpha * dV) * over
    return Wall(alpha, b, d_alpha, (u0 + 2.0 * y * u1 - b * dV) * over)


def _long_wall(omega: Array, fields: Any) -> Wall:
    at = Angles(omega, fields)
    turn = turned(at, fields[1] + 0.5)
    total, d_total, scale, d_scale = offset(at, fields)
    over = 1.0 / scale
    alpha, b = 2.0 * at.s * turn.across * over, total * over
    d_alpha = (at.c * turn.across + 2.0 * at.s * turn.d_across - alpha * d_scale) * over
    return Wall(alpha, b, d_alpha, (d_total - b * d_scale) * over)


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


def spread(lobe: Lobe) -> Lobe:
    """The same with a new last axis, for many places of each lobe."""
    parts = lobe._replace(long=None if lobe.long is None else tuple(lobe.long))
    return tree_map(lambda value: None if value is None else value[..., None], parts)


def bisect_place(before: Any, low: Array, high: Array, xp: Any) -> Array:
    """Where a condition ceases to hold between two positive places, by halving the logarithm of their ratio."""

    def halve(ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = xp.sqrt(low) * xp.sqrt(high)
        holds = before(middle)
        return xp.where(holds, middle, low), xp.where(holds, high, middle)

    low, high = repeat(_HALVINGS, halve, (low, high), xp)
    return xp.sqrt(low) * xp.sqrt(high)


def _crept(lobe: Lobe) -> Array:
    """Where `creeps` holds."""
    return (lobe.long[1] > 0.5) & (lobe.long[1] < 1.5)


class RowEnd(NamedTuple):
    """Where a row ends: on the lobe, or beyond the corner on the line of z = -1, or nowhere."""

    x: Array  # where it does not meet the lobe, the nearer end of it
    meets: Array
    beyond: Array
    alpha: Array  # for n >= 1 what `zwidth.stability.row_limit.long_row` gives


def row_end(beta: Array, lobe: Lobe, creeping: bool = False) -> RowEnd:
    """The end of a row: the one zero of ``b - beta - delta``, a quadratic in y for n = 0."""
    xp = namespace(beta, lobe.delta)
    b = beta + lobe.delta
    if lobe.short is not None:
        u0, u1, *_, v1, v2 = lobe.short
        linear = u0 - b * v1
        square = linear * linear + 4.0 * b * (u1 - b * v2)
        y = 2.0 * b / (linear + xp.sqrt(xp.maximum(square, 0.0)))
        meets = (b > 0) & (square >= 0) & (y <= lobe.end)
        y = xp.where(meets, y, xp.where(b > 0, lobe.end, 0.0))
        beyond = (b > 0) & ~meets & lobe.to_corner
        if lobe.long is None:
            return RowEnd(y, meets, beyond, b)
    alpha, omega = long_row_point(beta, lobe.long)
    on_lobe = (b > 0) & (b < (wall(lobe.end, lobe).b if creeping else lobe.long[_TOP]))
    if creeping:
        crept = bisect_place(lambda x: wall(x, lobe).b < b, _SMALLEST * lobe.end, lobe.end, xp)
        omega = xp.where(_crept(lobe), crept, omega)
    x = xp.where(on_lobe, omega, xp.where(b > 0, lobe.end, 0.0))
    if lobe.short is None:
        return RowEnd(x, on_lobe, b != b, alpha)
    is_short = lobe.is_short
    return RowEnd(xp.where(is_short, y, x), xp.where(is_short, meets, on_lobe), is_short & beyond, alpha)


def peak(lobe: Lobe, creeping: bool = False) -> Peak:
    """The largest alpha of the lobe: the zero of ``x alpha'/alpha``, which falls, or the corner."""
    xp = namespace(lobe.delta)
    u = 1.0 / (lobe.d + 1.0)
    r = lobe.delta * (lobe.d + 1.0)
    t = r / (r + 3.0)
    # A fit of sin(omega/2), within 4 % for every delta and d.
    s = (0.551 + 0.493 * t + (t * u) ** 2 * (1.204 * u - 0.701)) * u
    start = s * s
    if lobe.short is None:
        start = 2.0 * s * (1.0 + s * s / 6.0)
    elif lobe.is_short is not None:
        start = xp.where(lobe.is_short, start, 2.0 * s * (1.0 + s * s / 6.0))
    low, high = 0.3 * lobe.end, xp.where(lobe.to_corner, 1.0, 0.98) * lobe.end
    start = xp.minimum(xp.maximum(start, low), high)

    def slope(x: Array) -> Array:
        at = wall(x, lobe)
        return x * at.d_alpha / at.alpha

    def secant(state: tuple[Array, ...]) -> tuple[Array, ...]:
        before, now, slope_before, slope_now = state
        change = slope_now - slope_before
        # Once both are rounding their quotient means nothing.
        step = slope_now * (now - before) / xp.where(xp.abs(change) < 1e4 * epsilon(change), 1.0, change)
        new = xp.minimum(xp.maximum(now - step, low), high)
        return now, new, slope_now, slope(new)

    first = 0.99 * start
    steps = _PEAK_STEPS if lobe.short is None else _PEAK_STEPS_SHORT
    x = repeat(steps, secant, (start, first, slope(start), slope(first)), xp)[1]
    if creeping:
        crept = bisect_place(lambda x: wall(x, lobe).d_alpha > 0, _SMALLEST * lobe.end, lobe.end, xp)
        x = xp.where(_crept(lobe), crept, x)
    if lobe.short is not None:
        x = xp.where(lobe.to_corner & (wall(lobe.end, lobe).d_alpha >= 0), lobe.end, x)
    return Peak(x, wall(x, lobe).alpha)


def column_end(alpha: Array, top: Peak, lobe: Lobe, upper: bool, creeping: bool = False) -> tuple[Array, Array]:
    """The place where a column of 0 < alpha < ``top.alpha`` meets the lobe, and whether the line ends it instead."""
    xp = namespace(alpha, lobe.delta)
    nowhere = alpha < 0
    if lobe.long is None:
        return _short_end_of_column(alpha, top, lobe, upper)
    x = _long_end_of_column(alpha, top, lobe, upper)
    if creeping:
        low, high = (top.x, lobe.end) if upper else (_SMALLEST * top.x, top.x)
        crept = bisect_place(lambda x: (wall(x, lobe).alpha < alpha) != upper, low, high, xp)
        x = xp.where(_crept(lobe), crept, x)
    if lobe.short is None:
        return x, nowhere
    y, on_line = _short_end_of_column(alpha, top, lobe, upper)
    return xp.where(lobe.is_short, y, x), xp.where(lobe.is_short, on_line, nowhere)


def _short_end_of_column(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> tuple[Array, Array]:
    """The first or the second zero of ``(alpha(y) - alpha) V``, a cubic that begins ``-alpha + c1 y + c2 y^2``."""
    xp = namespace(alpha, lobe.delta)
    assert lobe.short is not None
    _, _, a, s, t, v1, v2 = lobe.short
    c1, c2, c3 = 4.0 * a - alpha * v1, 4.0 * s - alpha * v2, 4.0 * t
    y = 2.0 * alpha / (c1 + xp.sqrt(xp.maximum(c1 * c1 + 4.0 * c2 * alpha, 0.0)))
    y = xp.minimum(y, top.x)
    # Each step solves the quadratic that touches the cubic to second order: near the ridge two zeros are close.
    for _ in range(_CUBIC_STEPS):
        value, slope = -alpha + y * (c1 + y * (c2 + y * c3)), c1 + y * (2.0 * c2 + 3.0 * y * c3)
        bend = 2.0 * c2 + 6.0 * y * c3
        y = y - 2.0 * value / (slope + xp.sqrt(xp.maximum(slope * slope - 2.0 * value * bend, 0.0)))
        y = xp.minimum(xp.maximum(y, 0.0), top.x)
    if not upper:
        return y, alpha < 0
    # Divided by the first zero, c3 y^2 + e y + k is left.
    k, e = alpha / y, c2 + c3 * y
    square = e * e - 4.0 * c3 * k
    second = 2.0 * k / (xp.sqrt(xp.maximum(square, 0.0)) - e)
    on_line = lobe.to_corner & ((square < 0) | (second > 1.0))
    return xp.maximum(xp.minimum(second, lobe.end), top.x), on_line


def _long_end_of_column(alpha: Array, top: Peak, lobe: Lobe, upper: bool) -> Array:
    """Newton's method in variables in which alpha is nearly linear, from the ridge to where it vanishes.

    Behind the ridge ``S = sqrt(1 - alpha/top)`` over omega; before it ``G = sqrt(top/alpha - 1)`` over 1/omega.
    """
    xp = namespace(alpha, lobe.delta)
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
    _, k, g0, _, _, h0, _, v0, *_ = lobe.long
    rate = ((k + 0.5) * g0 + h0) / v0
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


class Corner(NamedTuple):
    """The wall with a double pole at z = -1, and whether it is the stiffest stable one."""

    alpha: Array
    beta: Array
    reached: Array
    is_ridge: Array


def corner(loop: FrequencyLoop) -> Corner:
    """Solve P(-1) = P'(-1) = 0, linear in (alpha, beta), and decide whether the ridge sits there.

    On z = -e^s, s = -j (pi - omega), the curve is ``alpha = 2 tan(omega/2) Im E`` with
    ``E(s) = (-1)^(n+1) e^(s (n+2)) (e^s + c)/N(-e^s)``, real for real s. With E1, E3 the first and third derivative
    at s = 0, ``alpha = -4 E1 + (2 E3 + E1) v^2/3 + ...``: the curve reaches omega = pi as part of the stable set's
    edge when alpha stays positive, and has a maximum there when ``2 E3 + E1 < 0``. Both come from those of log E.
    Only n = 0 reaches omega = pi on the first lobe, so the sign (-1)^(n+1) is -1.
    """
    plant = loop.plant
    xp = namespace(plant.gap)
    # Where N(-1) is not clearly positive there is no corner, and nothing below may overflow: its derivative would
    # be NaN and spoil the branch that is chosen instead.
    usable = plant.gap > 1e-9 * plant.a2
    gap = xp.where(usable, plant.gap, 1.0)
    sigma = 1.0 / (1.0 + plant.c)
    q1, q2, q3 = ((m * plant.a2 - plant.a1) / gap for m in (2.0, 4.0, 8.0))
    log1 = 2.0 + sigma - q1
    log2 = sigma * (1.0 - sigma) - (q2 - q1 * q1)
    log3 = sigma * (1.0 - sigma) * (1.0 - 2.0 * sigma) - (q3 - 3.0 * q1 * q2 + 2.0 * q1**3)
    e0 = -(1.0 + plant.c) / gap
    alpha = -4.0 * e0 * log1
    beta = -e0 - 0.5 * alpha
    reached = usable & (loop.lag == 0) & (plant.a2 > plant.a0) & (log1 > 0)
    # e0 < 0: 2 E3 + E1 < 0 exactly where this is positive.
    curvature = 2.0 * (log1**3 + 3.0 * log1 * log2 + log3) + log1
    return Corner(alpha, beta, reached, reached & (curvature >= 0))


def lobe_end(loop: FrequencyLoop, d: Array, delay: str) -> Array:
    """The frequency at which the curve first returns to alpha = 0, pi where it does not before.

    For kernels of one point in JAX, from the frequency response alone: what the general solvers start from.
    """
    from zwidth.stability.bracketing import bisect

    xp = namespace(d, loop.lag)
    limit = xp.minimum(np.pi, np.pi / (d + 0.5))
    end, found = bisect(lambda omega, loop: frequency_boundary(omega, loop, delay).alpha, 1e-6 * limit, limit, loop)
    return xp.where(found & ~corner(loop).reached, end, np.pi)
