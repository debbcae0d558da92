"""Rows of any linear loop: the stable intervals of the stiffness at a damping, and labels of many walls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zwidth.loops.domain import WALL_RANGE
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.poles import log_size, poles_less_one
from zwidth.loops.rigid.boundary_map import copy_rows

# Rows whose crossings are laid out at one time.
_ROWS = 1 << 12
# With fewer walls a row than this, each wall is compared with its own crossings.
_FEW_WALLS = 4


class BoundIntervals(NamedTuple):
    """Stable intervals of alpha: shape (rows, most intervals of a row), NaN where a row has fewer.

    With each stands the column of the crossings that ends it, -1 where there is none.
    """

    low: np.ndarray
    high: np.ndarray
    below: np.ndarray
    above: np.ndarray


def bound_intervals(boundary: Boundary, beta: np.ndarray) -> BoundIntervals:
    """Where the rows of these dampings, shape (rows,), are stable, and what of the boundary ends each interval."""
    return join_rows([_some_intervals(boundary, beta[k : k + _ROWS]) for k in range(0, max(beta.size, 1), _ROWS)])


def join_rows(parts: Sequence[BoundIntervals], order: np.ndarray | slice = slice(None)) -> BoundIntervals:
    """The rows of several parts in one, in an order of their own."""
    most = max(part.low.shape[1] for part in parts)

    def widen(column: np.ndarray, none: float) -> np.ndarray:
        return np.pad(column, ((0, 0), (0, most - column.shape[1])), constant_values=none)

    columns = zip(zip(*parts, strict=True), (np.nan, np.nan, -1, -1), strict=True)
    return BoundIntervals(*(np.concatenate([widen(c, none) for c in own])[order] for own, none in columns))


def _some_intervals(boundary: Boundary, beta: np.ndarray) -> BoundIntervals:
    known = np.where(np.isfinite(beta), beta, 0.0)
    found = boundary.crossings(known)
    order = np.argsort(found.alpha, axis=1)
    alpha = np.take_along_axis(found.alpha, order, 1)
    leaving = np.take_along_axis(found.leaving, order, 1)
    least, most = np.full((beta.size, 1), -np.inf), np.full((beta.size, 1), np.inf)
    ends = np.concatenate([least, np.where(np.isnan(alpha), np.inf, alpha), most], 1)
    met = np.concatenate([np.full((beta.size, 1), -1), order, np.full((beta.size, 1), -1)], 1)
    outside = boundary.base + np.concatenate([np.zeros((beta.size, 1)), np.cumsum(leaving, 1)], 1)
    # Closer than any alpha in range two crossings are one: the rounding of 0 on an undamped device's own row.
    wide = ends[:, 1:] > ends[:, :-1] + WALL_RANGE[0]
    stable = (np.round(outside) == 0) & wide & (np.isfinite(beta) & found.sound)[:, None]
    # Neighbors that touch, where one pole leaves as another enters, stay apart: their common end is on the boundary.
    place = np.cumsum(stable, 1) - 1
    shape = beta.size, int(stable.sum(1).max(initial=0))
    out = BoundIntervals(*(np.full(shape, np.nan) for _ in range(2)), *(np.full(shape, -1) for _ in range(2)))
    row, gap = np.nonzero(stable)
    for whole, values in zip(out, (ends[:, :-1], ends[:, 1:], met[:, :-1], met[:, 1:]), strict=True):
        whole[row, place[row, gap]] = values[row, gap]
    return out


def label_walls(boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Whether each wall is stable; arrays that broadcast. Dampings that repeat are solved once."""
    shape = np.broadcast_shapes(alpha.shape, beta.shape)
    rows, place = np.unique(beta, return_inverse=True)
    sound = boundary.is_sound(np.where(np.isfinite(rows), rows, 0.0))
    if rows.size * _FEW_WALLS > np.prod(shape) or not sound.all():
        return _count_walls(boundary, *np.broadcast_arrays(alpha, beta))
    ends = bound_intervals(boundary, rows)
    place = place.reshape(beta.shape)
    steps = np.diff(alpha.reshape(-1)) if alpha.size > 1 else np.ones(1)
    in_rows = bool(shape) and alpha.size == shape[-1] and beta.shape == (*shape[:-1], 1)
    if in_rows and np.all(steps >= 0):
        return _mark_rows(alpha.reshape(-1), ends, place.reshape(-1)).reshape(shape)
    stable = np.zeros(shape, bool)
    for k in range(ends.low.shape[1]):
        stable |= (alpha > ends.low[:, k][place]) & (alpha < ends.high[:, k][place])
    return stable


def _count_walls(boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """The same for walls of their own dampings each: poles are counted, and most crossings need not be solved."""
    shape = alpha.shape
    columns, good = (alpha.reshape(-1), beta.reshape(-1)), np.isfinite(alpha + beta).reshape(-1)
    stable = np.zeros(good.shape, bool)
    for start in range(0, good.size, _ROWS):
        part = slice(start, start + _ROWS)
        alpha, beta = (np.where(good[part], column[part], 0.0) for column in columns)
        outside = boundary.outside(alpha, beta)
        # A row whose crossings contradict each other says nothing: all poles of its walls do.
        left = np.flatnonzero(outside < 0)
        if left.size:
            outside[left] = (log_size(poles_less_one(boundary.loop, alpha[left], beta[left])) >= 0).sum(1)
        stable[part] = good[part] & (outside == 0)
    return stable.reshape(shape)


def _mark_rows(alpha: np.ndarray, ends: BoundIntervals, place: np.ndarray) -> np.ndarray:
    """The same for ascending alpha along the last axis, at the speed at which rows are copied."""
    stable = np.zeros((place.size, alpha.size), bool)
    for k in range(ends.low.shape[1]):
        missing = np.isnan(ends.high[:, k])
        until = np.searchsorted(alpha, np.where(missing, -np.inf, ends.high[:, k]))
        start = np.searchsorted(alpha, np.where(missing, -np.inf, ends.low[:, k]), side="right")
        held = copy_rows(until[place], alpha.size)
        if start.any():
            held &= ~copy_rows(np.minimum(start, until)[place], alpha.size)
        stable = held if k == 0 else stable | held
    return stable
