"""Find the stiffest stable wall of many loops at once, and confirm each wall by pole counts.

A wall has the normalized stiffness alpha and damping beta. On the *boundary curve* a wall has a pole at ``e^(jw)``. The
*nodes* are the angles w at which the curve is tabulated. The search has three steps:

1. Bisection for the largest alpha at which the line of constant K has a stable interval of beta.
2. Newton's method for the two conditions that hold at the ends of this interval (`stability.linear.ridge`).
3. Confirmation of the wall by pole counts along three lines, with the relative margin `MARGIN` (V24):

    the ray to the wall          has no crossing below the wall, so the wall is stable and connected to K = 0
    the line of constant K       slightly above the wall has no stable wall, so no set of stable walls that is
                                 connected to K = 0 extends above this line
    the line beta = 0            has no stable wall above the line of constant K; needed if only beta >= 0 is allowed
                                 and the line of constant K has a stable wall with beta < 0

A *crossing* is a wall on one of these lines with a pole on the unit circle. If the ray has a crossing below the wall,
another path from the wall to K = 0 is searched for, a sequence of straight *sections*. The alpha of a confirmed wall is
within `MARGIN` of that of the stiffest wall. Symbols and shapes are those of `stability.linear.batch_lines`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.core.status import RidgeKind
from zwidth.core.types import Array
from zwidth.core.xp import iterate, namespace
from zwidth.numerics.root_finding import illinois
from zwidth.stability.linear.batch_lines import (
    Line,
    LineCrossings,
    combine,
    count_far,
    cross_end,
    find_crossings,
    list_changes,
    pad_index,
    sort_crossings,
    tabulate,
)
from zwidth.stability.linear.loop_batch import Form, LoopBatch, Sampled, Sizes, Values, evaluate, sample

MARGIN = 4e-10  # relative distance in alpha between a maximum and the line of constant K that confirms it
LOG_RANGE = (-9.0, 2.0)  # log10 alpha of the first bracket of the maximum
BISECTIONS = 20  # steps of the bisection for the largest alpha
CLOSE_CELLS = 4  # largest number of nodes between two crossings that may enclose a smooth maximum of alpha
NEWTON_STEPS = 8  # for the angles of a corner
SECANT_STEPS = 24  # at most, for the angle w of a smooth maximum of alpha; most loops need 10 to 15 steps
# Largest last step of the angle w of a smooth maximum, relative to w. An error of w changes the maximum of alpha only
# by its square, because alpha is stationary there.
CONVERGED_PEAK = 1e-7
CONVERGED_STEP = 1e-13  # last Newton step of an angle w, relative to w
# Values of alpha on the path of stable walls from a maximum to K = 0, relative to the alpha of the maximum.
LEVELS = (0.96, 0.8, 0.55, 0.3, 0.1, 0.02)
# Least width of a stable interval of beta in the bisection, relative to its upper end. Thinner intervals may be errors
# of the interpolation between nodes.
THINNEST = 1e-4
# Largest beta at the upper end of a stable interval. Crossings near zeros of the velocity estimate have a larger beta.
LARGEST_BETA = 50.0
LEAST = -2  # code for the lower end of an interval at beta = 0, in place of the index of a node
CLEAR = 1e-12  # smallest relative distance between two crossings of a line at which their order is certain


class Stiffest(NamedTuple):
    """Stiffest stable wall of each loop: arrays of shape (loops,), valid only if ``confirmed`` is True."""

    alpha: Array
    beta: Array
    omega: Array  # angle w of the poles on the unit circle
    kind: Array  # code of `RidgeKind`
    confirmed: Array  # True if pole counts confirm the wall
    angles: Array  # angles w of the poles of the two active constraints, shape (2, loops)


class _OptimumRange(NamedTuple):
    """The widest stable interval of beta on one line of constant K per loop, as the nodes next to its ends."""

    exists: Array
    low: Array  # index of the node before the lower end; -1 for a pole at z = -1; `LEAST` for beta = 0
    high: Array  # index of the node before the upper end; -1 for a pole at z = -1


def find_stiffest(form: Form, loop: LoopBatch, sizes: Sizes, negative: bool) -> Stiffest:
    """Return the stiffest stable wall connected to K = 0 of each loop.

    Args:
        form: orders, integer delay and window, which all loops share.
        loop: coefficients and roots of the loops.
        sizes: numbers of nodes.
        negative: False to require beta >= 0.
    """
    loops = sample(form, loop, sizes)
    xp, n = namespace(loops.w), loop.gain.size
    axis, start = find_crossings(loops, Line(a1=1.0)), loops.count_start(loops.parts[0][0])
    least = -np.inf if negative else 0.0
    on_axis = _place_axis(axis, loops.w)

    def halve(state: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, left, right = state
        middle = 0.5 * (low + high)
        found = _find_interval(loops, axis, on_axis, start, 10.0**middle, least)
        kept = (xp.where(found.exists, new, old) for new, old in ((found.low, left), (found.high, right)))
        return xp.where(found.exists, middle, low), xp.where(found.exists, high, middle), *kept

    none = xp.full((n,), -1)
    begin = xp.full((n,), LOG_RANGE[0]), xp.full((n,), LOG_RANGE[1]), none, none
    low, _, left, right = iterate(BISECTIONS, halve, begin, xp)
    alpha, beta, angles, kind = _solve(loops, axis, 10.0**low, left, right)
    omega = xp.where(kind == RidgeKind.CORNER, xp.max(angles, 0), angles[0])
    confirmed = _confirm(loops, axis, start, alpha, beta, negative)
    return Stiffest(alpha, beta, omega, kind, confirmed, angles)


def _place_axis(axis: LineCrossings, w: Array) -> Array:
    """Return the alpha at which the boundary curve crosses beta = 0 between each node and the next.

    The result has the shape (nodes, loops); it is NaN between two nodes without such a crossing.
    """
    xp, (nodes, n) = namespace(w), w.shape
    # Write crossings that do not lie between two nodes into the last row, because no interval starts at the last node.
    row = xp.where(xp.isfinite(axis.t) & (axis.cell >= 0), axis.cell, nodes - 1)
    index = row, xp.broadcast_to(xp.arange(n), row.shape)
    table = xp.full((nodes, n), np.nan)
    if xp is not np:
        return table.at[index].set(axis.t)
    table[index] = axis.t
    return table


def _interpolate_level(loops: Sampled, alpha: Array, on_axis: Array) -> LineCrossings:
    """Return the crossings of the boundary curve by one line of constant K per loop, interpolated between nodes.

    Args:
        loops: the loops.
        alpha: normalized stiffness of the line of each loop.
        on_axis: alpha at which the curve crosses beta = 0 between each node and the next, from `_place_axis`.
    """
    xp, n = namespace(loops.w), alpha.size
    k = loops.parts[1] + alpha * loops.parts[2]
    positive = k > 0
    cells = list_changes(loops, positive)
    before, after = (k[cells.cell + offset, cells.loop] for offset in (0, 1))
    share, level = before / (before - after), alpha[cells.loop]
    ends = [
        loops.levels[0][cells.cell + offset, cells.loop] - level * loops.levels[1][cells.cell + offset, cells.loop]
        for offset in (0, 1)
    ]
    # If the curve crosses beta = 0 between two nodes, the interpolated beta must have the sign of beta at the node on
    # the same side of this crossing. Otherwise the pole count, which starts at beta = 0, would be wrong.
    t, axis = (1.0 - share) * ends[0] + share * ends[1], on_axis[cells.cell, cells.loop]
    nodes = [tuple(part[cells.cell + offset, cells.loop] for part in loops.parts) for offset in (0, 1)]
    (low_beta, low_alpha), (high_beta, high_alpha) = ((q / f, -cross / f) for q, cross, f in nodes)
    beta = xp.where((level > axis) == (high_alpha > low_alpha), high_beta, low_beta)
    kept = xp.isnan(axis) | (nodes[0][2] * nodes[1][2] <= 0) | (t * beta > 0)
    t = xp.where(kept, t, 1e-9 * beta)
    end, end_slope = cross_end(loops, Line(a0=alpha, b1=1.0))
    columns = (
        (t, np.inf, end),
        (xp.where(after > before, 2.0, -2.0), 0.0, xp.sign(end_slope)),
        (loops.w[cells.cell, cells.loop], np.nan, xp.full((n,), np.pi)),
        (cells.cell, -1, xp.full((n,), -1)),
    )
    t, leaving, w, cell = (xp.concatenate([tabulate(cells, each, fill), last[None]]) for each, fill, last in columns)
    return sort_crossings(t, leaving, w, cell, cells.crowded)


def _find_interval(
    loops: Sampled, axis: LineCrossings, on_axis: Array, start: Array, alpha: Array, least: float
) -> _OptimumRange:
    """Return the widest stable interval of beta >= ``least`` on the line of constant K with this alpha, per loop."""
    xp, n = namespace(loops.w), alpha.size
    crossings = _interpolate_level(loops, alpha, on_axis)
    counts = crossings.count_gaps(axis.count_at(start, alpha))
    infinite = xp.full((1, n), np.inf)
    low, high = xp.concatenate([-infinite, crossings.t]), xp.concatenate([crossings.t, infinite])
    none = xp.full((1, n), -1)
    place = xp.concatenate([none, crossings.cell]), xp.concatenate([crossings.cell, none])
    width = high - xp.maximum(low, least)
    width = xp.where((counts == 0) & (high < LARGEST_BETA) & (width > THINNEST * xp.abs(high)), width, -1.0)
    best = xp.argmax(width, 0)[None]
    exists = (xp.take_along_axis(width, best, 0)[0] > 0) & ~crossings.doubtful
    left, right = (xp.take_along_axis(part, best, 0)[0] for part in (xp.where(low < least, LEAST, place[0]), place[1]))
    return _OptimumRange(exists, left, right)


class _CurveNodes(NamedTuple):
    """Walls (alpha, beta) with a pole at ``e^(jw)``, and their derivatives in the angle w."""

    alpha: Array
    beta: Array
    alpha_slope: Array
    beta_slope: Array


def _trace(values: Values) -> _CurveNodes:
    """Return the walls on the boundary curve, from the values of q and F at angles w (docs/theory/scenes.md, V8)."""
    q, q_slope, f, f_slope = values
    beta = q.imag / f.imag
    beta_slope = (q_slope.imag - beta * f_slope.imag) / f.imag
    alpha_slope = q_slope.real - beta_slope * f.real - beta * f_slope.real
    return _CurveNodes(q.real - beta * f.real, beta, alpha_slope, beta_slope)


def _solve(loops: Sampled, axis: LineCrossings, alpha: Array, left: Array, right: Array) -> tuple[Array, ...]:
    """Compute the stiffest wall, starting from the last stable interval of beta that the bisection found.

    Args:
        loops: the loops.
        axis: crossings of the boundary curve with the line beta = 0.
        alpha: normalized stiffness at which the interval was found.
        left: lower end of the interval, the field ``low`` of `_OptimumRange`.
        right: upper end of the interval, the field ``high`` of `_OptimumRange`.

    Returns:
        alpha, beta, the two angles and the kind of the maximum; NaN if no active constraints were found.
    """
    xp, w = namespace(loops.w), loops.w
    form, loop, nodes = loops.form, loops.loop, w.shape[0]
    clipped = left == LEAST
    # If the interval ends at beta = 0, a smooth maximum may lie between the two nodes at which the curve crosses beta =
    # 0.
    undamped = xp.argmin(xp.abs(xp.log(xp.where(axis.t > 0, axis.t, np.inf) / alpha)), 0)[None]
    undamped, rest, crossed = (xp.take_along_axis(part, undamped, 0)[0] for part in (axis.t, axis.w, axis.cell))
    first = xp.where(clipped, crossed, xp.minimum(left, right))
    second = xp.where(clipped, crossed, xp.maximum(left, right))
    close = (first >= 0) & (second - first <= CLOSE_CELLS)

    def pick(index: Array) -> Array:
        return xp.take_along_axis(w, xp.clip(index, 0, nodes - 1)[None], 0)[0]

    peak, converged = _find_peak(form, loop, [(pick(first - more), pick(second + 1 + more)) for more in (0, 1, 2)])
    top = _trace(evaluate(form, loop, peak))
    # At a corner, either two pole pairs are on the unit circle, or one pole pair is, together with a pole at z = -1.
    pair = first >= 0
    starts = [0.5 * (pick(cell) + pick(cell + 1)) for cell in (xp.where(pair, first, second), second)]
    end, f_end = loops.ends.q.real, loops.ends.f.real

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        one, other = (_trace(evaluate(form, loop, x)) for x in state)
        gap = one.alpha - other.alpha, one.beta - other.beta
        determinant = other.alpha_slope * one.beta_slope - one.alpha_slope * other.beta_slope
        moves = [
            (other.alpha_slope * gap[1] - other.beta_slope * gap[0]) / determinant,
            (one.alpha_slope * gap[1] - one.beta_slope * gap[0]) / determinant,
        ]
        at_end = (one.alpha + one.beta * f_end - end) / (one.alpha_slope + one.beta_slope * f_end)
        new = state[0] - xp.where(pair, moves[0], at_end), state[1] - moves[1]
        return tuple(
            xp.where(xp.abs(after - before) <= CONVERGED_STEP * before, before, after)
            for after, before in zip(new, state, strict=True)
        )

    corner = iterate(NEWTON_STEPS, step, tuple(starts), xp, lambda old, new: bool(np.all(old[0] == new[0])))
    meeting = _trace(evaluate(form, loop, corner[0]))
    # Two crossings with many nodes between them enclose a corner or, where nodes are dense, a smooth maximum of alpha.
    # Use the one whose alpha is closer to that of the bisection.
    distance = [
        xp.where(ok, xp.abs(xp.log(one.alpha / alpha)), np.inf) for one, ok in ((top, converged), (meeting, ~clipped))
    ]
    smooth = xp.where(close | clipped, distance[0] < 0.1, ~(distance[0] > distance[1]))
    smooth = smooth & converged & (first >= 0) & (~clipped | ((top.beta > 0) & (top.alpha > undamped)))
    kinds = [smooth, clipped, ~clipped & (second >= 0)]
    found = [
        xp.select(kinds, choices, np.nan)
        for choices in (
            [top.alpha, undamped, meeting.alpha],
            [top.beta, 0.0 * undamped, meeting.beta],
            [peak, rest, corner[0]],
            [peak, rest, xp.where(pair, corner[1], np.pi)],
        )
    ]
    codes = [int(kind) for kind in (RidgeKind.SMOOTH, RidgeKind.NO_DAMPING, RidgeKind.CORNER)]
    return found[0], found[1], xp.stack(found[2:]), xp.select(kinds, codes, int(RidgeKind.NONE))


def _find_peak(form: Form, loop: LoopBatch, brackets: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the angle w at which alpha is maximal along the boundary curve, and whether the search converged.

    The search uses the narrowest of the ``brackets``, ordered by their width, in which alpha has a maximum. The
    Illinois method (a variant of regula falsi) then solves for the angle at which the derivative of alpha is 0.
    """
    xp = namespace(loop.gain)

    def slope(w: Array) -> Array:
        return _trace(evaluate(form, loop, w)).alpha_slope

    # Use the narrowest bracket over which the derivative of alpha changes from positive to negative.
    low, high = brackets[-1]
    first, last = slope(low), slope(high)
    for bracket in brackets[-2::-1]:
        ends = slope(bracket[0]), slope(bracket[1])
        better = (ends[0] > 0) & (ends[1] < 0)
        pairs = zip((*bracket, *ends), (low, high, first, last), strict=True)
        low, high, first, last = (xp.where(better, new, old) for new, old in pairs)
    x, move = illinois(slope, low, high, first, last, SECANT_STEPS, CONVERGED_STEP)
    return x, (first > 0) & (last < 0) & (move <= CONVERGED_PEAK * x)


def _confirm(loops: Sampled, axis: LineCrossings, start: Array, alpha: Array, beta: Array, negative: bool) -> Array:
    """Return whether pole counts confirm that each wall is the stiffest one within `MARGIN` (docs/theory, V24)."""
    xp, above = namespace(loops.w), alpha * (1.0 + MARGIN)
    level = find_crossings(loops, Line(a0=above, b1=1.0))
    outside = axis.count_at(start, above)
    counts, axis_counts = level.count_gaps(outside), axis.count_gaps(start)
    infinite = xp.full((1, alpha.size), np.inf)
    bounded = xp.all(counts > 0, 0)
    if not negative:
        right = xp.all((counts > 0) | (xp.concatenate([level.t, infinite]) < 0), 0)
        beyond = xp.concatenate([axis.t, infinite]) > above
        bounded = bounded | (right & xp.all((axis_counts > 0) | ~beyond, 0))
    far = count_far(loops)
    consistent = (axis_counts[-1] >= far[0]) & (axis_counts[-1] <= far[1]) & xp.all(counts >= 0, 0)
    # Reject a loop in which two crossings are so close that rounding errors may exchange their order.
    clear = xp.all(level.t[1:] - level.t[:-1] > CLEAR * xp.abs(level.t[1:]), 0, where=xp.isfinite(level.t[1:]))
    highest = loops.resolved & ~axis.doubtful & ~level.doubtful & consistent & clear & bounded & (alpha > 0)
    direction = Line(a1=alpha, b1=beta)
    ray = find_crossings(loops, direction)
    first = loops.count_start(combine(direction, tuple(part[:1] for part in loops.parts))[0])
    connected = (first == 0) & ~xp.any((ray.t > 0) & (ray.t < 1.0 - MARGIN), 0) & ~ray.doubtful
    if xp is not np:
        return highest & (connected | _are_connected(loops, axis, start, alpha, beta))
    # Search for a path of several sections only for the few loops with a crossing on the straight line from K = B = 0
    # to the wall.
    index = pad_index(np.flatnonzero(highest & ~connected))
    if index.size:
        few = loops.take(index), axis.take(index), start[index], alpha[index], beta[index]
        connected[index] = _are_connected(*few)
    return highest & connected


def _are_connected(loops: Sampled, axis: LineCrossings, start: Array, alpha: Array, beta: Array) -> Array:
    """Return whether a path of stable walls leads from the wall just below each maximum of alpha to K = B = 0.

    A *level* is the line of constant alpha at one of the fractions `LEVELS` of the maximum. The path descends from
    level to level in straight sections. On each level it passes through one stable interval of beta: the interval that
    overlaps most with the interval of the level above or, if none overlaps, the nearest interval. The last section is a
    straight line from the level with the smallest alpha to K = B = 0.
    """
    xp, n, count = namespace(alpha), alpha.size, len(LEVELS)
    # Repeat the loops once per level. One call then finds the crossings on all levels, another those on all sections.
    each = xp.tile(xp.arange(n), count)
    below = xp.asarray(LEVELS)[:, None] * alpha
    level = find_crossings(loops.take(each), Line(a0=below.reshape(-1), b1=1.0))
    stable = level.count_gaps(axis.take(each).count_at(start[each], below.reshape(-1))) == 0
    infinite = xp.full((1, each.size), np.inf)
    ends = xp.concatenate([-infinite, level.t]), xp.concatenate([level.t, infinite])
    stable, *ends = (part.reshape(-1, count, n) for part in (stable & xp.isfinite(ends[0] - ends[1]), *ends))
    connected, low, high, sections = xp.all(~level.doubtful.reshape(count, n), 0), beta, beta, []
    for k in range(count):
        overlap = xp.minimum(ends[1][:, k], high) - xp.maximum(ends[0][:, k], low)
        best = xp.argmax(xp.where(stable[:, k], overlap, -np.inf), 0)[None]
        reached, shared, new_low, new_high = (
            xp.take_along_axis(part, best, 0)[0] for part in (stable[:, k], overlap, ends[0][:, k], ends[1][:, k])
        )
        # If the intervals of both levels overlap, the section has constant beta. Otherwise it connects their centers.
        middle, center = 0.5 * (xp.maximum(new_low, low) + xp.minimum(new_high, high)), 0.5 * (new_low + new_high)
        sections.append([xp.where(shared >= 0, middle, other) for other in (0.5 * (low + high), center)])
        connected, low, high = connected & reached, new_low, new_high
    # The last section is the straight line from K = B = 0 to the level with the smallest alpha.
    above, zero = xp.concatenate([alpha[None], below[:-1], 0.0 * alpha[None]]), 0.0 * alpha
    below = xp.concatenate([below, below[-1:]])
    first, last = (xp.stack(column) for column in zip(*sections, (zero, 0.5 * (low + high)), strict=True))
    line = Line(*(part.reshape(-1) for part in (above, first, below - above, last - first)))
    path = find_crossings(loops.take(xp.tile(xp.arange(n), count + 1)), line)
    # Ignore the crossing at which the first section starts, because the maximum is on the stability boundary.
    origin = xp.concatenate([MARGIN * alpha / (alpha - below[0]), xp.tile(zero, count)])
    free = ~xp.any((path.t > origin) & (path.t < 1.0), 0) & ~path.doubtful
    softest = combine(Line(a1=below[-1], b1=last[-1]), tuple(part[:1] for part in loops.parts))[0]
    return connected & xp.all(free.reshape(count + 1, n), 0) & (loops.count_start(softest) == 0)
