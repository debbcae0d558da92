"""Stable intervals of any linear loop, of the stiffness in a row and of the damping in a column; many walls' labels."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from zwidth.arrays.roots import bisect, zeros_between
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.curve import curve_at
from zwidth.loops.linear.poles import log_size, poles_less_one
from zwidth.words.quantities import WALL_RANGE
from zwidth.words.showing import shown

# Rows whose crossings are laid out at one time, or more of few arcs: so many pairs of both.
_ROWS, _PAIRS = 1 << 12, 1 << 16
# With fewer walls a row than this, each wall is compared with its own crossings.
_FEW_WALLS = 4


class BoundIntervals(NamedTuple):
    """Stable intervals of alpha: shape (rows, most intervals of a row), NaN where a row has fewer."""

    # With each stands the column of the crossings that ends it, -1 where there is none, and the angle there.

    low: np.ndarray
    high: np.ndarray
    w_below: np.ndarray
    w_above: np.ndarray
    below: np.ndarray
    above: np.ndarray


def bound_intervals(boundary: Boundary, beta: np.ndarray) -> BoundIntervals:
    """Where the rows of these dampings, shape (rows,), are stable, and what of the boundary ends each interval."""
    columns = lay_lines(partial(_some_intervals, boundary), _ROWS, beta)
    return BoundIntervals(*columns[:4], *np.where(np.isnan(columns[4:]), -1.0, columns[4:]).astype(int))


def lay_lines(find: Callable[..., tuple[np.ndarray, ...]], together: int, *lines: np.ndarray) -> np.ndarray:
    """What is found of lines, so many at a time: columns (lines, most of one), NaN where one has fewer."""
    starts = range(0, max(lines[0].size, 1), together)
    parts = [find(*(values[start : start + together] for values in lines)) for start in starts]
    line, *found = (np.concatenate(column) for column in zip(*parts, strict=True))
    line += np.repeat(starts, [part[0].size for part in parts])
    return np.moveaxis(side_by_side(lines[0].size, line, np.stack(found, -1)), -1, 0)


def _some_intervals(boundary: Boundary, beta: np.ndarray) -> tuple[np.ndarray, ...]:
    """One after another: the row that each is of, its ends, the angles there, and what of the boundary ends it."""
    known = np.where(np.isfinite(beta), beta, 0.0)
    found = boundary.crossings(known)
    order = np.argsort(found.alpha, axis=1)
    alpha = np.take_along_axis(found.alpha, order, 1)
    leaving = np.take_along_axis(found.leaving, order, 1)
    sides = (0, 0), (1, 1)
    ends = np.pad(np.where(np.isnan(alpha), np.inf, alpha), sides, constant_values=(-np.inf, np.inf))
    met = np.pad(order, sides, constant_values=-1)
    w = np.pad(np.take_along_axis(found.w, order, 1), sides, constant_values=np.nan)
    below = np.broadcast_to(boundary.count_below(beta), beta.shape)[:, None]
    outside = below + np.concatenate([np.zeros((beta.size, 1)), np.cumsum(leaving, 1)], 1)
    # Closer than any alpha in range two crossings are one: the rounding of 0 on an undamped device's own row.
    wide = ends[:, 1:] > ends[:, :-1] + WALL_RANGE[0]
    sound = np.isfinite(beta) & found.sound & ~boundary.are_lossless(beta)
    stable = (np.round(outside) == 0) & wide & sound[:, None]
    # Neighbors that touch, where one pole leaves as another enters, stay apart: their common end is on the boundary.
    row, gap = np.nonzero(stable)
    return row, *(part[row, gap] for both in (ends, w, met) for part in (both[:, :-1], both[:, 1:]))


def side_by_side(lines: int, line: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values that belong to ascending lines by line: (lines, most of one, ...), NaN where one has fewer."""
    place = np.arange(line.size) - np.searchsorted(line, line)
    out = np.full((lines, int(place.max(initial=-1)) + 1, *values.shape[1:]), np.nan)
    out[line, place] = values
    return out


def label_walls(boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Whether each wall is stable; arrays that broadcast. Dampings that repeat are solved once."""
    shape = np.broadcast_shapes(alpha.shape, beta.shape)
    rows, place = np.unique(beta, return_inverse=True)
    many = rows.size * _FEW_WALLS > np.prod(shape)
    if many or not boundary.settle(np.where(np.isfinite(rows), rows, 0.0))[1].all():
        return _count_walls(boundary, *np.broadcast_arrays(alpha, beta))
    ends = bound_intervals(boundary, rows)
    place = place.reshape(beta.shape)
    stable = np.zeros(shape, bool)
    for low, high in zip(ends.low.T, ends.high.T, strict=True):
        inside = alpha > low[place]
        inside &= alpha < high[place]
        stable |= inside
    return stable


def _count_walls(boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """The same for walls of their own dampings each: poles are counted, and most crossings need not be solved."""
    shape = alpha.shape
    columns, good = (alpha.reshape(-1), beta.reshape(-1)), np.isfinite(alpha + beta).reshape(-1)
    stable = np.zeros(good.shape, bool)
    size = max(_ROWS, _PAIRS // max(len(boundary.arcs), 1))
    for start in range(0, good.size, size):
        part = slice(start, start + size)
        alpha, beta = (np.where(good[part], column[part], 0.0) for column in columns)
        outside = boundary.outside(alpha, beta)
        # A row whose crossings contradict each other says nothing: all poles of its walls do.
        left = np.flatnonzero(outside < 0)
        if left.size:
            outside[left] = (log_size(poles_less_one(boundary.loop, alpha[left], beta[left])) >= 0).sum(1)
        stable[part] = good[part] & (outside == 0) & ~boundary.are_lossless(beta)
    return stable.reshape(shape)


# How far beside an end, as a share of it, walls must have the labels of the intervals that it parts: their rounding is
# that of a row, which may cross where a column hardly moves.
_BESIDE = 1e-7


def stable_dampings(boundary: Boundary, alpha: float) -> np.ndarray:
    """Where a column is stable: array (intervals, 2) of beta, ascending."""
    # Every damping at which the column meets the boundary is found, for alpha is monotone along the curve between two
    # nodes once its extremes are among them; the walls between two such dampings share the label of one of them. An end
    # whose own neighbors contradict that is sought by labels alone.
    on_lines = np.array([(line.q - alpha) / line.f for line in boundary.lines if line.f != 0.0])
    w, height = boundary.heights
    above = height - alpha
    k = np.flatnonzero(np.isfinite(above[1:] + above[:-1]) & ((above[1:] > 0) != (above[:-1] > 0)))
    on_curve = zeros_between(lambda at: curve_at(boundary.loop, at).alpha - alpha, w, above, k)
    lossless = np.isfinite(boundary.lossless)
    on_curve = np.array([boundary.lossless]) if lossless else curve_at(boundary.loop, on_curve).beta
    met = np.unique(np.concatenate([on_curve, on_lines]))
    met = met[np.isfinite(met)]
    if not np.isfinite(alpha) or not met.size:
        return np.zeros((0, 2))

    def label(beta: np.ndarray) -> np.ndarray:
        return label_walls(boundary, np.full(beta.size, alpha), beta)

    reach = np.ptp(met) + np.abs(met).max() + 1.0
    between = 0.5 * (np.concatenate([[met[0] - reach], met]) + np.concatenate([met, [met[-1] + reach]]))
    stable = label(between)
    k = np.flatnonzero(stable[1:] != stable[:-1])
    room = np.minimum(met[k] - between[k], between[k + 1] - met[k])
    beside = np.minimum(_BESIDE * np.abs(met[k]), 0.5 * room)
    wrong = (label(met[k] - beside) != stable[k]) | (label(met[k] + beside) != stable[k + 1])
    # The lossless damping is exact and needs no refinement.
    wrong &= met[k] != boundary.lossless
    k, low, high = k[wrong], between[:-1][k[wrong]], between[1:][k[wrong]]
    # Twice: the last digit of a long way is not that of an end near 0.
    for _ in range(2 if k.size else 0):
        met[k] = bisect(lambda beta: label(beta) == stable[k], low, high)
        low, high = met[k] - 1e-12 * (high - low), met[k] + 1e-12 * (high - low)
    ends = np.concatenate([[-np.inf], met, [np.inf]])
    return np.stack([ends[:-1][stable], ends[1:][stable]], -1)


# A row that begins within such a share of its end begins at 0: the rounding of a sampled device's coefficients may put
# its pole at z = 1 beyond it, and the softest walls of all then do not hold it. Of 12th order up to 3e-8 was seen.
_SOFT = 1e-6


def reaches_down(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Whether stable intervals of alpha, or of K, hold soft walls, but for rounding."""
    return (low <= _SOFT * high) & (high > 0)


@shown()
class Island(NamedTuple):
    """A piece of the stable set without soft walls: its extent in stiffness and in damping."""

    stiffness: tuple[float, float]
    virtual_damping: tuple[float, float]
