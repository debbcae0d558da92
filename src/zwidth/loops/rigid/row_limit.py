"""Where a row of the (alpha, beta) plane ends: the stiffest wall of each damping, in closed form (rigid loop).

For a held delay d = n + f the stable walls of one (beta, delta, d) are ``0 < alpha < limit``: the limit is the first
lobe of the boundary curve, cut by the line on which a real pole crosses at z = -1 (docs/theory/one-lobe.md,
Theorem C).

The boundary is taken in the form of docs/theory/boundary.md, B1, by half angles, with its letters and k = n + 1/2.
Rows are told apart by ``b = beta + delta``, which vanishes with w^2: ``V b = delta V - cos(k w)/cos(w/2) E + ...`` is
rearranged below so that nothing cancels, for every damping.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import FEW, Route, evaluate_columns
from zwidth.arrays.held_mass import DeviceTerms, device
from zwidth.loops.rigid.crossover import expand_long_delay_curve, expand_short_delay_curve
from zwidth.loops.rigid.folding import Points, group_by
from zwidth.words.quantities import WALL_RANGE
from zwidth.words.types import Array
from zwidth.words.xp import COSINE, SINE, horner, namespace, nan_beyond, repeat

# From the starting points below each sequence doubles its digits a step: 6 steps end a lobe, the last one to confirm;
# 2 leave a row with some 2e-9 of its frequency, which the step in alpha behind them squares.
_END_STEPS = 6
_ROW_STEPS = 2

# Abramowitz, Stegun 1964, eq. (4.4.47): arctan t on [0, 1] within 1e-5.
_ARCTAN = [0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351]


class LongLobe(NamedTuple):
    """The lobe of a device with d >= 1: E, H, V and ``(delta V - E)/y`` by powers of y, and what rows start from."""

    delta: Array
    k: Array
    g0: Array
    g1: Array
    g2: Array
    h0: Array
    h1: Array
    v0: Array
    v1: Array
    v2: Array
    b1: Array
    b2: Array
    end: Any = None  # the lobe's last w
    top: Any = None  # b there
    bow: Any = None  # how the start of a row bends
    sin_bow: Any = None
    bend: Any = None


def _sin_cos(x: Array) -> tuple[Array, Array]:
    """Sine and cosine for 0 <= x <= pi/4 by their series."""
    square = x * x
    return x * horner(square, SINE[:8]), horner(square, COSINE[:9])


def short_place(b: Array, curve: Any) -> tuple[Array, Array]:
    """The y of a row on the lobe of `expand_short_delay_curve`, the first zero of a quadratic, and whether there is one."""
    (u0, u1), (v0, v1, v2), _ = curve
    xp = namespace(b, u0)
    linear = u0 - b * v1
    square = linear * linear + 4.0 * b * v0 * (u1 - b * v2)
    return 2.0 * b * v0 / (linear + xp.sqrt(xp.maximum(square, 0.0))), square >= 0


def short_row(beta: Array, device: DeviceTerms) -> Array:
    """The limit for d < 1, beyond the corner that of the line; 0 where no alpha is stable, NaN for bad input."""
    p1, psi, tilt = device.p1, device.psi, device.tilt
    xp = namespace(beta, device.delta)
    b = beta + device.delta
    # For d = 0 the row ends at phi1 b (1 - psi beta)/(psi (phi1 + phi2 b)).
    whole = p1 * b * (1.0 - psi * beta) / (psi * (p1 + device.p2 * b))
    (u0, u1), size, shape = curve = expand_short_delay_curve(device)
    y, real = short_place(b, curve)
    # V = |N|^2 vanishes where the curve runs to infinity; rounding must not turn its sign there.
    limit = 4.0 * y * horner(y, shape) / xp.abs(horner(y, size))
    corner_reached = (tilt > 0) & (shape[0] + shape[1] + shape[2] > 0)
    beyond = xp.where(corner_reached, xp.inf, 0.0)
    # Behind the lobe the curve comes from infinity with b < 0: a row above all of the lobe must not end there.
    fractional = xp.where(real & (y <= 1) & (u0 + u1 * y > 0), limit, beyond)
    limit = xp.where(device.f == 0, whole, fractional)
    line = 1.0 / xp.where(tilt > 0, tilt, 1.0) - 2.0 * beta
    limit = xp.where(tilt > 0, xp.minimum(limit, line), limit)
    return _finish(limit, b)


def _finish(limit: Array, b: Array) -> Array:
    xp = namespace(b)
    return xp.where(xp.isfinite(b), xp.where((b > 0) & (limit > 0), limit, 0.0), xp.nan)


def open_lobe(device: DeviceTerms) -> LongLobe:
    """The curve alone, whose end is not known yet."""
    g, h, v, base = expand_long_delay_curve(device)
    return LongLobe(device.delta, device.whole + 0.5, *g, *h, *v, *base)


def long_lobe(device: DeviceTerms) -> LongLobe:
    """What rows with d >= 1 need of a device, its lobe's end included."""
    lobe = open_lobe(device)
    em, p1, whole, f = device.em, device.p1, device.whole, device.f
    xp = namespace(lobe.delta)
    end = _lobe_end(lobe, em / (p1 + f * em), whole + f)
    total, d_total, scale, d_scale = offset(Angles(end, lobe))
    top = total / scale
    # Rows start from sqrt(b/top) = sin(bow w/end)/sin(bow), with the slope of the curve at the lobe's end, where
    # strong damping makes it nearly flat; `bend` adds the slope at w = 0. Right to 0.4 %. The relative slope at the
    # end, bow/tan(bow), is inverted by a rational function.
    flat = xp.clip(1.0 - 0.5 * end * (d_total / total - d_scale / scale), 0.0, 1.0)
    bow = xp.sqrt(3.0 * flat / (1.0 + flat * (0.2 + 0.01585 * flat)))
    sin_bow = xp.sin(bow)
    # As the rows compute it, so that they start exact at the lobe's end, where strong damping and a long delay leave b
    # no slope and Newton's steps would only halve an error.
    bow = _arcsine(sin_bow)
    slope = (0.25 * lobe.b1 + 0.5 * lobe.g0 * (lobe.k * lobe.k - 0.25) + lobe.k * lobe.h0) / lobe.v0
    bend = xp.sqrt(top / slope) / end - sin_bow / bow
    # As one array: the compiler computes a device once, and not again for every row.
    return LongLobe(*xp.stack([*lobe[:-5], end, top, bow, sin_bow, bend]))


class Angles:
    """The trigonometric terms of one frequency, from two short series."""

    def __init__(self, omega: Array, lobe: LongLobe):
        _, k, g0, g1, g2, h0, h1, v0, v1, v2, b1, b2, *_ = lobe
        self.k = k
        s4, c4 = _sin_cos(0.25 * omega)
        sk4, ck4 = _sin_cos(0.25 * k * omega)
        # Differences of cosines are formed from half angles, which keeps their relative accuracy at small w.
        s_half = 2.0 * sk4 * ck4
        self.s, self.c = 2.0 * s4 * c4, 1.0 - 2.0 * s4 * s4
        self.sin_k = 2.0 * s_half * (1.0 - 2.0 * sk4 * sk4)
        self.cos_k = 1.0 - 2.0 * s_half * s_half
        # cos(w/2) - cos(k w)
        self.drop = 2.0 * (s_half * s_half - s4 * s4)
        y = self.s * self.s
        self.E, self.H, self.V = g0 + y * (g1 + y * g2), h0 + y * h1, v0 + y * (v1 + y * v2)
        # Derivatives with respect to w: dy/dw = sin(w/2) cos(w/2).
        dy = self.s * self.c
        self.dE, self.dH, self.dV = dy * (g1 + 2.0 * y * g2), dy * h1, dy * (v1 + 2.0 * y * v2)
        self.base, self.dbase = y * (b1 + y * b2), dy * (b1 + 2.0 * y * b2)


def offset(at: Angles) -> tuple[Array, Array, Array, Array]:
    """``b = beta + delta`` on the curve as T/Q, accurate relative to b itself, with the derivatives of T and Q."""
    k, s, c = at.k, at.s, at.c
    total = c * at.base + at.E * at.drop + s * c * 2.0 * at.sin_k * at.H
    d_total = c * at.dbase - 0.5 * s * at.base + at.dE * at.drop + at.E * (k * at.sin_k - 0.5 * s)
    d_total += at.H * (at.sin_k * (1.0 - 2.0 * s * s) + 2.0 * k * s * c * at.cos_k) + 2.0 * s * c * at.sin_k * at.dH
    return total, d_total, c * at.V, c * at.dV - 0.5 * s * at.V


class _Turned(NamedTuple):
    """``X = sin((n+1) w) E + cos((n+1) w) sin w H``, proportional to alpha, its companion a quarter turn on, and dX."""

    across: Array
    along: Array
    d_across: Array
    F: Array
    dF: Array


def turn_angles(at: Angles) -> _Turned:
    # (n + 1) w = k w + w/2
    turns = at.k + 0.5
    sine = at.sin_k * at.c + at.cos_k * at.s
    cosine = at.cos_k * at.c - at.sin_k * at.s
    sin_w, cos_w = 2.0 * at.s * at.c, 1.0 - 2.0 * at.s * at.s
    F, dF = sin_w * at.H, cos_w * at.H + sin_w * at.dH
    along = cosine * at.E - sine * F
    return _Turned(sine * at.E + cosine * F, along, turns * along + sine * at.dE + cosine * dF, F, dF)


def _lobe_end(lobe: LongLobe, ratio: Array, d: Array) -> Array:
    """The first w at which alpha returns to 0: the phase of ``e^(j (n+1) w) (E + j sin w H)`` reaches pi there."""
    # Newton's method on that phase, nearly linear in w; ``ratio`` is E/H at w = 0 and places the start between pi/(2
    # (n+1)), for no damping, and pi/(n+1).
    turns = lobe.k + 0.5
    xp = namespace(turns)
    limit = np.pi / (d + 0.5)

    def step(omega: Array) -> Array:
        at = Angles(omega, lobe)
        x = turn_angles(at)
        size = at.E * at.E + x.F * x.F
        # Less than a quarter turn away sin cos is a safe stand-in for the phase left; farther off, creep up.
        left = xp.where(x.along < 0, x.across * x.along, -0.2 * size)
        return xp.minimum(omega - left / (turns * size + (at.E * x.dF - x.F * at.dE)), limit)

    # A loop, not a long expression: a device is solved once, and a short program compiles in a fifth of the time.
    start = 0.5 * np.pi / turns * (1.0 + 0.7 * ratio / (ratio + 1.0 / turns))
    return repeat(_END_STEPS, step, start, xp)


def long_row_point(beta: Array, lobe: LongLobe) -> tuple[Array, Array]:
    """The limit for d >= 1, 0 where no alpha is stable and NaN for bad input; and its frequency w, if there is one."""
    # b grows with w along the whole lobe, so Newton's method on sqrt(b), nearly linear in w, needs no bracket but the
    # lobe itself. It is clipped to it: a midpoint at convergence would undo the last step.
    delta, end, top, bow, sin_bow, bend = lobe.delta, *lobe[-5:]
    xp = namespace(beta, delta)
    b = beta + delta
    inside = (b > 0) & (b < top)
    goal = xp.where(inside, b, 0.5 * top)
    share = goal / top
    r = xp.sqrt(share)
    omega = xp.minimum(end * (_arcsine(r * sin_bow) / bow + bend * r * (1.0 - share)), end)
    for _ in range(_ROW_STEPS):
        omega = xp.clip(omega - _newton_step(goal, Angles(omega, lobe)), 0.0, end)
    at = Angles(omega, lobe)
    x = turn_angles(at)
    numerator, denominator = 2.0 * at.s * x.across, at.c * at.V
    # The last step is taken in alpha itself.
    step = _newton_step(goal, at)
    numerator -= step * (at.c * x.across + 2.0 * at.s * x.d_across)
    denominator -= step * (at.c * at.dV - 0.5 * at.s * at.V)
    return _finish(xp.where(inside, numerator / denominator, 0.0), b), omega - step


def _arcsine(x: Array) -> Array:
    """Three to four digits of arcsin x for 0 <= x <= 1, half of it by its tangent; good enough for a start."""
    xp = namespace(x)
    t = x / (1.0 + xp.sqrt(xp.maximum((1.0 - x) * (1.0 + x), 0.0)))
    return 2.0 * t * horner(t * t, _ARCTAN)


def _newton_step(goal: Array, at: Angles) -> Array:
    """``2 (b - sqrt(goal b))/b'`` with sqrt(goal/b) as (1 + 3 goal/b)/(3 + goal/b): one division in all."""
    # XLA fuses a chain of such steps into one loop over the rows only while no quotient is used twice.
    total, d_total, scale, d_scale = offset(at)
    part = goal * scale
    return 4.0 * total * scale * (total - part) / ((d_total * scale - total * d_scale) * (3.0 * total + part))


# Smaller maps, and of fewer rows, are compared as they are: a pattern of two rows would be a cost of its own.
_LARGE, _ENOUGH_ROWS = 1 << 16, 8


def boundary_map(points: Points) -> np.ndarray:
    """Labels of all points, False out of range: stable walls are those with ``0 < alpha < limit`` of their row."""
    # The limit is right to about 1e-15 relative, and to 1e-15 of the largest limit near the lobe's end.
    alpha, beta = nan_beyond(WALL_RANGE, points.alpha, points.beta)
    return _compare(alpha, row_limits(beta, points.delta, points.d))


def row_limits(beta: np.ndarray, delta: np.ndarray, d: np.ndarray, route: Route = "auto") -> np.ndarray:
    """The stiffest stable wall of every (beta, delta, d), of their broadcast shape; NaN where out of range."""
    shape = np.broadcast_shapes(beta.shape, delta.shape, d.shape)
    out = np.empty(shape)
    for long, points, place in group_by((beta, delta, d), d >= 1):
        kernel = _long_limit if long else _short_limit
        if route == "numpy" or (route == "auto" and out.size <= FEW):
            # Each device is computed once.
            with np.errstate(all="ignore"):
                out[place] = kernel(points[0], *np.broadcast_arrays(*points[1:]))
        else:
            whole = np.broadcast_arrays(*points)
            limits = evaluate_columns(kernel, [array.reshape(-1) for array in whole], route="jax")
            out[place] = limits.reshape(whole[0].shape)
    return out


def _short_limit(beta: Array, delta: Array, d: Array) -> Array:
    return short_row(beta, device(delta, d))


def _long_limit(beta: Array, delta: Array, d: Array) -> Array:
    return long_row_point(beta, long_lobe(device(delta, d)))[0]


def _compare(alpha: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """``0 < alpha < limit``, broadcast."""
    shape, values = np.broadcast_shapes(alpha.shape, limit.shape), alpha.reshape(-1)
    rising = slice(None, None, -1 if values.size and values[0] > values[-1] else 1)
    values = values[rising]
    varying = [axis for axis, length in enumerate(alpha.shape) if length > 1]
    large = np.prod(shape) >= _LARGE and limit.size >= _ENOUGH_ROWS
    if not (large and len(varying) == 1 and limit.shape[varying[0]] == 1 and np.all(values[1:] >= values[:-1])):
        stable = alpha < limit
        stable &= alpha > 0
        return stable
    # A row is true in its first places: a piece of one pattern that is true up to its middle, copied at memory speed.
    pattern = np.arange(2 * values.size) < values.size
    # No alpha lies below NaN, which would sort last.
    count = np.searchsorted(values, np.where(np.isnan(limit), -np.inf, limit).reshape(-1))
    stable = np.lib.stride_tricks.sliding_window_view(pattern, values.size)[values.size - count]
    stable[:, : np.searchsorted(values, 0.0, side="right")] = False
    rows = [length for axis, length in enumerate(limit.shape) if axis != varying[0]]
    return np.moveaxis(stable[:, rising].reshape(*rows, values.size), -1, varying[0])
