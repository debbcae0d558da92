"""Find the stable intervals on lines of constant B and of constant K in any linear loop, and label many walls.

The ends of an interval are crossings with the stability boundary (`stability.linear.boundary`, where *row*, *column*
and ``leaving`` are defined). An interval of alpha is stable if no pole is outside the unit circle, counted from below
all crossings (docs/theory/scenes.md, V13). A wall is *connected to K = 0* if a path of stable walls leads from it to K
= 0.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from zwidth.numerics.root_finding import bisect, find_zeros_between
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.curve import evaluate_curve
from zwidth.stability.linear.poles import compute_poles_minus_one, log_modulus
from zwidth.units.display import compact_repr
from zwidth.units.quantities import WALL_RANGE

# Sizes of batches, chosen so that their arrays fit in the cache.
BATCH_LINES = 1 << 12  # lines of constant B per batch
BATCH_PAIRS = 1 << 16  # pairs of lines and arcs per batch, which allows more lines if there are few arcs
# Number of walls per line of constant B below which it is faster to count the unstable poles of each wall than to solve
# for all crossings of the line.
FEW_WALLS = 4


class StableIntervals(NamedTuple):
    """Stable intervals of alpha on lines of constant B: shape (rows, most intervals of a row), NaN if there are fewer.

    ``below`` and ``above`` are the columns of the crossings at the lower and upper end, -1 if an end is infinite.
    """

    low: np.ndarray
    high: np.ndarray
    w_below: np.ndarray  # angle of the pole on the unit circle at the lower end
    w_above: np.ndarray  # the same at the upper end
    below: np.ndarray
    above: np.ndarray


def find_stable_intervals(boundary: Boundary, beta: np.ndarray) -> StableIntervals:
    """Return the stable intervals of alpha for each damping, shape (rows,)."""
    columns = collect_by_line(partial(_list_intervals, boundary), BATCH_LINES, beta)
    return StableIntervals(*columns[:4], *np.where(np.isnan(columns[4:]), -1.0, columns[4:]).astype(int))


def collect_by_line(find: Callable[..., tuple[np.ndarray, ...]], batch: int, *lines: np.ndarray) -> np.ndarray:
    """Call a search with batches of lines, and arrange its results in one array by line.

    Args:
        find: maps the values of some lines to columns of results, one result after another. The first column is the
            index of the line, ascending; the others are the quantities of the result.
        batch: number of lines per call.
        *lines: values of each line, shape (lines,) each.

    Returns:
        Array of shape (quantities, lines, most results of a line); NaN if a line has fewer.
    """
    starts = range(0, max(lines[0].size, 1), batch)
    parts = [find(*(values[start : start + batch] for values in lines)) for start in starts]
    line, *results = (np.concatenate(column) for column in zip(*parts, strict=True))
    line += np.repeat(starts, [part[0].size for part in parts])
    return np.moveaxis(arrange_by_line(lines[0].size, line, np.stack(results, -1)), -1, 0)


def _list_intervals(boundary: Boundary, beta: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return all stable intervals of some lines of constant B as columns, one entry per interval.

    The columns are the row, and for the lower and the upper end: alpha, angle and column of the crossing.
    """
    finite = np.where(np.isfinite(beta), beta, 0.0)
    crossings = boundary.find_crossings(finite)
    order = np.argsort(crossings.alpha, axis=1)
    alpha = np.take_along_axis(crossings.alpha, order, 1)
    leaving = np.take_along_axis(crossings.leaving, order, 1)
    sides = (0, 0), (1, 1)
    ends = np.pad(np.where(np.isnan(alpha), np.inf, alpha), sides, constant_values=(-np.inf, np.inf))
    columns = np.pad(order, sides, constant_values=-1)
    w = np.pad(np.take_along_axis(crossings.w, order, 1), sides, constant_values=np.nan)
    below = np.broadcast_to(boundary.count_below(beta), beta.shape)[:, None]
    outside = below + np.concatenate([np.zeros((beta.size, 1)), np.cumsum(leaving, 1)], 1)
    # Treat two crossings as one if the difference of their alphas is below the smallest alpha in range. For example, at
    # beta = 0 of an undamped device both alphas are 0 up to rounding errors.
    wide = ends[:, 1:] > ends[:, :-1] + WALL_RANGE[0]
    usable = np.isfinite(beta) & crossings.consistent & ~boundary.are_lossless(beta)
    stable = (np.round(outside) == 0) & wide & usable[:, None]
    # Do not join neighboring intervals with a common end, at which one pole leaves the circle and another enters it,
    # because the wall at this end is on the stability boundary.
    row, gap = np.nonzero(stable)
    return row, *(part[row, gap] for both in (ends, w, columns) for part in (both[:, :-1], both[:, 1:]))


def arrange_by_line(lines: int, line: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values of all lines in one array, with one row per line.

    Args:
        lines: number of lines.
        line: line of each value, ascending, shape (values,).
        values: shape (values, ...).

    Returns:
        Array of shape (lines, most values of a line, ...); NaN if a line has fewer.
    """
    position = np.arange(line.size) - np.searchsorted(line, line)
    out = np.full((lines, int(position.max(initial=-1)) + 1, *values.shape[1:]), np.nan)
    out[line, position] = values
    return out


def label_walls(boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return a mask of the stable walls, for arrays that broadcast; crossings are solved once per damping."""
    shape = np.broadcast_shapes(alpha.shape, beta.shape)
    dampings, row = np.unique(beta, return_inverse=True)
    scattered = dampings.size * FEW_WALLS > np.prod(shape)
    if scattered or not boundary.shift_ambiguous(np.where(np.isfinite(dampings), dampings, 0.0))[1].all():
        return _count_poles(boundary, *np.broadcast_arrays(alpha, beta))
    intervals = find_stable_intervals(boundary, dampings)
    row = row.reshape(beta.shape)
    stable = np.zeros(shape, bool)
    for low, high in zip(intervals.low.T, intervals.high.T, strict=True):
        inside = alpha > low[row]
        inside &= alpha < high[row]
        stable |= inside
    return stable


def _count_poles(boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return a mask of the walls without poles outside the unit circle, by counting, for arrays of one shape.

    Most walls are so far from all crossings that the count does not require the exact crossings.
    """
    shape = alpha.shape
    columns, finite = (alpha.reshape(-1), beta.reshape(-1)), np.isfinite(alpha + beta).reshape(-1)
    stable = np.zeros(finite.shape, bool)
    size = max(BATCH_LINES, BATCH_PAIRS // max(len(boundary.arcs), 1))
    for start in range(0, finite.size, size):
        part = slice(start, start + size)
        alpha, beta = (np.where(finite[part], column[part], 0.0) for column in columns)
        outside = boundary.count_outside(alpha, beta)
        # Compute all poles of walls on lines with inconsistent crossings, because counting by crossings failed there.
        left = np.flatnonzero(outside < 0)
        if left.size:
            outside[left] = (log_modulus(compute_poles_minus_one(boundary.loop, alpha[left], beta[left])) >= 0).sum(1)
        stable[part] = finite[part] & (outside == 0) & ~boundary.are_lossless(beta)
    return stable.reshape(shape)


# Relative distance from an end of a stable interval of beta within which walls must change from stable to unstable. It
# is much larger than the rounding errors of the test, which are errors in alpha: they correspond to larger errors in
# beta where the boundary is nearly parallel to the line of constant K.
END_TOLERANCE = 1e-7


def find_stable_dampings(boundary: Boundary, alpha: float) -> np.ndarray:
    """Return the stable intervals of beta on a line of constant K, ascending, as an array of shape (intervals, 2)."""
    # Compute the intersections of the line with the boundary. None is missed, because alpha is monotone between the
    # nodes, which include its extrema along the curve. Between two intersections, the walls are all stable or all
    # unstable; test the middle one. If walls next to an end contradict this, bisect for the end with the stability
    # test.
    on_lines = np.array([(line.q - alpha) / line.f for line in boundary.lines if line.f != 0.0])
    w, node_alpha = boundary.alpha_nodes
    above = node_alpha - alpha
    k = np.flatnonzero(np.isfinite(above[1:] + above[:-1]) & ((above[1:] > 0) != (above[:-1] > 0)))
    on_curve = find_zeros_between(lambda angles: evaluate_curve(boundary.loop, angles).alpha - alpha, w, above, k)
    lossless = np.isfinite(boundary.lossless)
    on_curve = np.array([boundary.lossless]) if lossless else evaluate_curve(boundary.loop, on_curve).beta
    crossed = np.unique(np.concatenate([on_curve, on_lines]))
    crossed = crossed[np.isfinite(crossed)]
    if not np.isfinite(alpha) or not crossed.size:
        return np.zeros((0, 2))

    def label(beta: np.ndarray) -> np.ndarray:
        """Return a mask of the stable walls among those with the given betas and this alpha."""
        return label_walls(boundary, np.full(beta.size, alpha), beta)

    reach = np.ptp(crossed) + np.abs(crossed).max() + 1.0
    middle = 0.5 * (np.concatenate([[crossed[0] - reach], crossed]) + np.concatenate([crossed, [crossed[-1] + reach]]))
    stable = label(middle)
    k = np.flatnonzero(stable[1:] != stable[:-1])
    room = np.minimum(crossed[k] - middle[k], middle[k + 1] - crossed[k])
    offset = np.minimum(END_TOLERANCE * np.abs(crossed[k]), 0.5 * room)
    wrong = (label(crossed[k] - offset) != stable[k]) | (label(crossed[k] + offset) != stable[k + 1])
    # Do not refine an end at the lossless damping, because this damping is exact.
    wrong &= crossed[k] != boundary.lossless
    k, low, high = k[wrong], middle[:-1][k[wrong]], middle[1:][k[wrong]]
    # Bisect twice, because in a very wide first bracket the last bisection step is too coarse for an end near 0.
    for _ in range(2 if k.size else 0):
        crossed[k] = bisect(lambda beta: label(beta) == stable[k], low, high)
        low, high = crossed[k] - 1e-12 * (high - low), crossed[k] + 1e-12 * (high - low)
    ends = np.concatenate([[-np.inf], crossed, [np.inf]])
    return np.stack([ends[:-1][stable], ends[1:][stable]], -1)


# An interval counts as starting at K = 0 if its lower end is below this fraction of its upper end. Rounding errors of
# the coefficients of a sampled device may move its pole at z = 1 outside the circle, so that the softest walls are
# unstable. Lower ends of up to 3e-8 of the upper end were observed for devices of 12th order.
CONNECTED_START = 1e-6


def are_connected(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return a mask of the stable intervals of alpha (or K) that start at K = 0 or below, up to rounding errors."""
    return (low <= CONNECTED_START * high) & (high > 0)


@compact_repr()
class Island(NamedTuple):
    """A piece of the stable set that is not connected to K = 0, described by its ranges of stiffness and damping."""

    stiffness: tuple[float, float]
    virtual_damping: tuple[float, float]
