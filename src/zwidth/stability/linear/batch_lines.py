"""Count unstable poles along lines of walls ``(a0 + a1 t, b0 + b1 t)`` for many loops at once, in NumPy or JAX.

A pole is at ``z = e^(jw)`` only if ``k(w) = 0``; k is tabulated at angles w, the *nodes*. On a *line*, the walls have
the normalized stiffness ``alpha = a0 + a1 t`` and damping ``beta = b0 + b1 t`` with real t. Examples are lines of
constant K, lines of constant B, and *rays*, which start at K = B = 0. With the critical controller q and the velocity
estimate F, a wall of the line has a pole at ``z = e^(jw)`` if and only if (docs/theory/scenes.md, V23)

    k(w) = Im((q - c0) conj c1) = 0      t = Re((q - c0) conj c1)/|c1|^2      c0 = a0 + b0 F,  c1 = a1 + b1 F

Such a wall is a *crossing* of the line and the stability boundary. As t increases past a crossing, a pole pair leaves
the unit circle if k increases with w, and enters it if k decreases. The number of poles outside the unit circle
therefore follows from the sign changes of k between nodes. A result is *doubtful* if the nodes do not resolve k; the
caller then has to use `stability.linear.boundary`, whose nodes are adapted to one loop. Symbols, nodes and shapes are
those of `stability.linear.loop_batch`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import namespace
from zwidth.model.circle_functions import distances_inside
from zwidth.numerics.root_finding import illinois, newton
from zwidth.stability.linear.loop_batch import Sampled, Values, evaluate, split_values

MOST_CROSSINGS = 12  # sign changes of k per line without delay; the result of a line with more is doubtful
MOST_TURNS = 3  # node intervals per line in which an extremum of k is computed; a line with more is doubtful
TURN_STEPS = 10  # steps of the search for an extremum of k
TURN_TOLERANCE = 1e-12  # |k| at an extremum, relative to the terms of k, below which the sign of k is unclear
STEPS = 10  # largest number of Newton steps for the angle w of a crossing
CONVERGED_STEP = 1e-13  # last Newton step, relative to w
LARGEST_STEP = 1e-9  # last Newton step, relative to w, above which a crossing is doubtful
# Arrays are padded to a multiple of this length, because NumPy may round the elements after the last full vector
# differently.
VECTOR_SIZE = 16
ON_CIRCLE = 1e-6  # distance from the unit circle below which a zero of G counts as neither inside nor outside


class Line(NamedTuple):
    """A line of walls ``(a0 + a1 t, b0 + b1 t)``; each field is a number, or an array with one value per loop."""

    a0: Any = 0.0
    b0: Any = 0.0
    a1: Any = 0.0
    b1: Any = 0.0


def combine(line: Line, parts: tuple[Array, Array, Array]) -> Array:
    """Return k(w) of a line, or its derivative, as a linear combination of the three functions of `split_values`."""
    a0, b0, a1, b1 = line
    weights = a1, b1, a0 * b1 - b0 * a1
    return sum(
        weight * part for weight, part in zip(weights, parts, strict=True) if not isinstance(weight, float) or weight
    )


def find_position(line: Line, values: Values) -> Array:
    """Return the parameter t of that wall on a line which has a pole at the angle w, from the values q and F at w."""
    xp = namespace(values.q)
    direction = line.a1 + line.b1 * values.f
    distance = values.q - line.a0 - line.b0 * values.f
    return (distance * xp.conj(direction)).real / (direction.real**2 + direction.imag**2)


def pad_index(index: np.ndarray) -> np.ndarray:
    """Return an array of indices, padded with copies of its last entry to a multiple of `VECTOR_SIZE`."""
    return np.concatenate([index, np.repeat(index[-1:], -index.size % VECTOR_SIZE)])


class NodeCells(NamedTuple):
    """Selected intervals between neighboring nodes, listed one after the other for all loops."""

    cell: Array  # index of the node at the lower end of the interval
    loop: Array  # index of the loop
    slot: Array  # number of the interval among those of its loop
    valid: Array  # False for padding
    crowded: Array  # for each loop: True if it has more selected intervals than are listed
    most: int  # largest number of listed intervals per loop


def list_cells(selected: Array, most: int) -> NodeCells:
    """List the node intervals that a mask of shape (nodes - 1, loops) selects, up to ``most`` per loop."""
    xp, (count, n) = namespace(selected), selected.shape
    if xp is np:
        cell, loop = np.nonzero(selected)
        slot = np.cumsum(selected, 0, dtype=np.int32)[cell, loop] - 1
        crowded = np.bincount(loop, minlength=n) > most
        padding = np.zeros(-cell.size % VECTOR_SIZE, int)
        cell, loop, slot, valid = (np.concatenate([part, padding]) for part in (cell, loop, slot, slot < most))
        return NodeCells(cell, loop, slot, valid > 0, crowded, most)
    first = xp.sort(xp.where(selected, xp.arange(count)[:, None], count), 0)[:most]
    slot, loop = xp.meshgrid(xp.arange(most), xp.arange(n), indexing="ij")
    valid = first < count
    columns = (part.reshape(-1) for part in (xp.where(valid, first, 0), loop, slot, valid))
    return NodeCells._make([*columns, xp.sum(selected, 0) > most, most])


def list_changes(loops: Sampled, positive: Array) -> NodeCells:
    """List the node intervals in which k changes its sign; ``positive`` is True at the nodes with k > 0."""
    # Each period of delay adds one revolution of the phase of q, and with it up to two crossings.
    most = MOST_CROSSINGS + 2 * (loops.form.lag + loops.form.window)
    return list_cells(positive[1:] != positive[:-1], most)


def tabulate(cells: NodeCells, values: Array, fill: float) -> Array:
    """Arrange one value per listed node interval in an array of shape (most, loops), filled up with ``fill``."""
    xp, shape = namespace(values), (cells.most, cells.crowded.size)
    if xp is np:
        table = np.full(shape, fill, np.result_type(values, type(fill)))
        table[cells.slot[cells.valid], cells.loop[cells.valid]] = values[cells.valid]
        return table
    return xp.where(cells.valid, values, fill).reshape(shape)


class LineCrossings(NamedTuple):
    """Crossings of the stability boundary by one line of walls per loop, in ascending order of the position t."""

    t: Array  # shape (crossings, loops); infinite for unused entries
    leaving: Array  # number of poles that leave the unit circle as t increases, minus those that enter it
    w: Array  # angle of the poles on the unit circle; for interpolated crossings the angle of the node below
    cell: Array  # index of the node below the angle of the crossing; -1 for a pole at z = -1
    doubtful: Array  # True for loops whose nodes do not resolve k, shape (loops,)

    def take(self, index: Array) -> LineCrossings:
        """Return the crossings of a selection of loops, given the indices of these loops."""
        return LineCrossings(*(part[..., index] for part in self))

    def count_gaps(self, outside: Array, origin: Array | float = 0.0) -> Array:
        """Return the number of poles outside the unit circle between crossings, shape (crossings + 1, loops).

        Args:
            outside: number of poles outside the unit circle at ``t = origin``, for each loop.
            origin: position on the line at which the number of poles outside is known.
        """
        xp = namespace(self.t)
        leaving = xp.where(xp.isfinite(self.t), self.leaving, 0.0)
        first = outside - xp.sum(xp.where(self.t < origin, leaving, 0.0), 0)
        return xp.concatenate([first[None], first + xp.cumsum(leaving, 0)])

    def count_at(self, start: Array, t: Array) -> Array:
        """Return the number of poles outside the unit circle at t > 0 on a ray; ``start`` is the number for t -> 0."""
        xp = namespace(self.t)
        return start + xp.sum(xp.where((self.t > 0) & (self.t < t), self.leaving, 0.0), 0)


def sort_crossings(t: Array, leaving: Array, w: Array, cell: Array, doubtful: Array) -> LineCrossings:
    """Sort crossings by their position t on the line, in ascending order."""
    xp = namespace(t)
    t = xp.where(xp.isnan(t), np.inf, t)
    order = xp.argsort(t, 0)
    return LineCrossings._make([*(xp.take_along_axis(part, order, 0) for part in (t, leaving, w, cell)), doubtful])


def find_crossings(loops: Sampled, line: Line) -> LineCrossings:
    """Compute all crossings of the stability boundary by one line per loop, to full accuracy."""
    xp, w, n = namespace(loops.w), loops.w, loops.w.shape[1]
    k, slope = combine(line, loops.parts), combine(line, loops.slopes)
    positive = k > 0
    cells = list_changes(loops, positive)
    turns, wavy = _select_turns(w[1:] - w[:-1], k, slope)
    turns = list_cells(turns, MOST_TURNS)
    middle, unclear = _find_turns(loops, line, turns, k, slope)
    # Search for zeros of k in three lists of brackets: between nodes with opposite signs of k, from a node to an
    # extremum of k, and from an extremum to the next node.
    lists = cells, turns, turns
    index = [xp.concatenate([getattr(part, name) for part in lists]) for name in ("cell", "loop")]
    ends = (cells.cell, cells.cell + 1), (turns.cell, None), (None, turns.cell + 1)
    brackets = []
    for side in (0, 1):
        nodes = [
            middle if end[side] is None else (w[end[side], part.loop], k[end[side], part.loop])
            for part, end in zip(lists, ends, strict=True)
        ]
        brackets += [xp.concatenate(column) for column in zip(*nodes, strict=True)]
    low, first, high, last = brackets
    part, each = loops.loop.take(index[1]), _take_line(line, index[1], n)
    rising = last > first
    sign = xp.where(rising, 1.0, -1.0)

    def rise(x: Array) -> tuple[Array, Array]:
        """Return k and dk/dw, both multiplied by the sign that makes k increase over the bracket."""
        k, slope = (combine(each, values) for values in split_values(evaluate(loops.form, part, x)))
        return sign * k, sign * slope

    # Start from the zero of the secant; next to an extremum, start from the zero of a parabola with its vertex there.
    share = first / xp.where(first == last, 1.0, first - last)
    near, far = xp.sqrt(xp.maximum(share, 0.0)), 1.0 - xp.sqrt(xp.maximum(1.0 - share, 0.0))
    splits = cells.cell.size, cells.cell.size + turns.cell.size
    share = xp.concatenate([share[: splits[0]], far[splits[0] : splits[1]], near[splits[1] :]])
    start = low + share * (high - low)
    crossing, move = newton(rise, low, high, start, STEPS, CONVERGED_STEP)
    crosses = (first > 0) != (last > 0)
    t = xp.where(crosses, find_position(each, evaluate(loops.form, part, crossing)), np.inf)
    leaving = xp.where(crosses, xp.where(rising, 2.0, -2.0), 0.0)
    poor = crosses & (move > LARGEST_STEP * crossing)
    columns = [
        _tabulate_lists(lists, values, fill)
        for values, fill in ((t, np.inf), (leaving, 0.0), (crossing, np.nan), (index[0], -1), (poor, False))
    ]
    # Add the wall of the line that has a pole at z = -1. A loop is doubtful if k changes its sign between the last node
    # and z = -1.
    end, end_slope = cross_end(loops, line)
    turned = (end_slope != 0) & xp.isfinite(end_slope) & ((k[-1] > 0) != (end_slope < 0))
    doubtful = unclear | wavy | cells.crowded | turns.crowded | xp.any(columns[4], 0) | turned
    doubtful = doubtful | xp.any(~xp.isfinite(k), 0)
    last_row = end[None], xp.sign(end_slope)[None], xp.full((1, n), np.pi), xp.full((1, n), -1)
    t, leaving, angle, cell = (xp.concatenate(both) for both in zip(columns[:4], last_row, strict=True))
    return sort_crossings(t, leaving, angle, cell, doubtful)


def _select_turns(step: Array, k: Array, slope: Array) -> tuple[Array, Array]:
    """Select the intervals between neighboring nodes in which k may have two zeros, one on each side of an extremum.

    Args:
        step: lengths of the intervals.
        k: values of k at the nodes.
        slope: derivatives of k at the nodes.

    Returns:
        A mask of the selected intervals; and for each loop, whether k may have more zeros in some interval than the
        code searches for.
    """
    # Let p be the cubic polynomial that has the values and slopes of k at both nodes, multiplied by the sign of k at
    # the lower node. Its Bernstein coefficients b0 .. b3 bound p, and their differences bound the derivative p'.
    # The cubic term c of p yields an estimate of the difference between k and p: if the nodes resolve k, the
    # fourth-order term of k is at most c. It changes k by at most c/16 and the derivative by less than 3 c/4.
    xp = namespace(k)
    sign = xp.where(k[:-1] > 0, 1.0, -1.0)
    b0, b3, falls, rises = k[:-1] * sign, k[1:] * sign, slope[:-1] * sign < 0, slope[1:] * sign > 0
    b1, b2 = b0 + step * slope[:-1] * sign / 3.0, b3 - step * slope[1:] * sign / 3.0
    c = xp.abs(b3 - b0 + 3.0 * (b1 - b2))
    low, changes = xp.minimum(b1, b2) <= c / 16.0, b3 <= 0
    # If k has the same sign at both nodes, it may have two zeros if |k| has a minimum between the nodes. If the signs
    # differ, k may have three zeros if p has a minimum below 0 and a maximum above 0.
    monotone = xp.where(falls, b1 - b2, b2 - b1) > c / 4.0
    wavy = xp.where(changes, (b1 <= c / 16.0) & (b2 >= -c / 16.0), low & (falls != rises) & ~monotone)
    return ~changes & low & falls & rises, xp.any(wavy, 0)


def _take_line(line: Line, index: Array, n: int) -> Line:
    """Return the lines of walls of the loops with the given indices."""
    xp = namespace(index, *line)
    return Line(*(xp.broadcast_to(xp.asarray(part), (n,))[index] for part in line))


def _tabulate_lists(lists: tuple[NodeCells, ...], values: Array, fill: float) -> Array:
    """Apply `tabulate` to each of several lists, whose ``values`` are concatenated, and stack the resulting arrays."""
    tables, start = [], 0
    for cells in lists:
        tables.append(tabulate(cells, values[start : start + cells.cell.size], fill))
        start += cells.cell.size
    return namespace(values).concatenate(tables)


def _find_turns(
    loops: Sampled, line: Line, turns: NodeCells, k: Array, slope: Array
) -> tuple[tuple[Array, Array], Array]:
    """Return angle and value of the extremum of k in each listed interval, and per loop if its sign is unclear."""
    xp, w = namespace(loops.w), loops.w
    part, each = loops.loop.take(turns.loop), _take_line(line, turns.loop, w.shape[1])

    def evaluate_slope(x: Array) -> Array:
        """Return the derivative of k, which is 0 at an extremum of k."""
        return combine(each, split_values(evaluate(loops.form, part, x))[1])

    low, high, first, last = (values[turns.cell + k, turns.loop] for values in (w, slope) for k in (0, 1))
    x, _ = illinois(evaluate_slope, low, high, first, last, TURN_STEPS if turns.cell.size else 0, CONVERGED_STEP)
    parts = split_values(evaluate(loops.form, part, x))[0]
    value, node = combine(each, parts), k[turns.cell, turns.loop]
    size = sum(
        abs(weight * term)
        for weight, term in zip((each.a1, each.b1, each.a0 * each.b1 - each.b0 * each.a1), parts, strict=True)
    )
    unclear = xp.any(tabulate(turns, xp.abs(value) <= TURN_TOLERANCE * size, False), 0)
    return (xp.where(turns.valid, x, low), xp.where(turns.valid, value, node)), unclear


def cross_end(loops: Sampled, line: Line) -> tuple[Array, Array]:
    """Return the position t of the wall with a pole at z = -1, infinite if none exists, and dk/dw at z = -1."""
    xp = namespace(loops.w)
    t = find_position(line, loops.ends)
    return xp.where(xp.isfinite(t), t, np.inf), combine(line, split_values(loops.ends)[1])


def count_far(loops: Sampled) -> tuple[Array, Array]:
    """Return a lower and an upper bound of the number of poles outside the unit circle for alpha -> inf."""
    # One pole approaches each zero of the plant G, and the other poles go to infinity (V14). A pole near a zero on the
    # unit circle may be inside or outside.
    xp, loop = namespace(loops.w), loops.loop
    depth = distances_inside(loop.plant_zeros)
    excess = loops.form.lag + loop.denominator.shape[0] - 1 - loop.plant_zeros.shape[0]
    return excess + xp.sum(depth < -ON_CIRCLE, 0), excess + xp.sum(depth <= ON_CIRCLE, 0)


def count_outside(loops: Sampled, alpha: Array, beta: Array) -> tuple[Array, Array]:
    """Return the number of poles outside the unit circle of one wall (alpha > 0) per loop, and if it is doubtful."""
    xp, ray = namespace(loops.w), Line(a1=alpha, b1=beta)
    crossings = find_crossings(loops, ray)
    start = loops.count_start(combine(ray, tuple(part[:1] for part in loops.parts))[0])
    near = xp.any(xp.abs(crossings.t - 1.0) < LARGEST_STEP, 0)
    return crossings.count_at(start, 1.0), crossings.doubtful | near | ~loops.resolved


def find_stiffness_limits(loops: Sampled, beta: Array) -> tuple[Array, Array]:
    """Return the upper end of the stable interval of alpha that starts at K = 0, and whether the end is doubtful.

    Each loop has one line of constant B, given by ``beta``. The end is 0 if the softest walls of this line are
    unstable.
    """
    xp = namespace(loops.w)
    row = find_crossings(loops, Line(b0=beta, a1=1.0))
    # Start from the pole count of one wall of the line, which is determined along a ray to this wall. Its alpha is well
    # above 0, because at alpha = 0 a pole may be at z = 1.
    alpha = 0.1 * (xp.abs(beta) + 0.1)
    outside, doubtful = count_outside(loops, alpha, beta)
    t = xp.concatenate([xp.full((1, beta.size), -np.inf), row.t])
    gap = xp.sum(row.t <= 0, 0)[None]
    start = xp.take_along_axis(row.count_gaps(outside, alpha), gap, 0)[0]
    end = xp.take_along_axis(xp.concatenate([t[1:], xp.full((1, beta.size), np.inf)]), gap, 0)[0]
    near = xp.any(xp.abs(row.t - alpha) < LARGEST_STEP * alpha, 0) | (end < 1e-5 * alpha)
    return xp.where(start == 0, end, 0.0), doubtful | row.doubtful | near | ~xp.isfinite(end) | (start < 0)
