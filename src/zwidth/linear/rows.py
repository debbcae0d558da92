"""Rows of any linear loop: the stable intervals of the stiffness at a damping, and labels of many walls."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.linear.boundary import Boundary

# Rows whose crossings are laid out at one time; and how many walls one row may hold before they are counted in places.
_ROWS = 1 << 12


class Intervals(NamedTuple):
    """Stable intervals of alpha: shape (rows, most intervals of a row), NaN where a row has fewer."""

    low: np.ndarray
    high: np.ndarray


def stable_intervals(boundary: Boundary, beta: np.ndarray) -> Intervals:
    """Where the rows of these dampings, shape (rows,), are stable."""
    pieces = [_some_intervals(boundary, beta[k : k + _ROWS]) for k in range(0, beta.size, _ROWS)]
    most = max((piece.low.shape[1] for piece in pieces), default=0)
    low, high = (np.full((beta.size, most), np.nan) for _ in range(2))
    for k, piece in enumerate(pieces):
        rows = slice(k * _ROWS, k * _ROWS + len(piece.low))
        low[rows, : piece.low.shape[1]], high[rows, : piece.low.shape[1]] = piece
    return Intervals(low, high)


def _some_intervals(boundary: Boundary, beta: np.ndarray) -> Intervals:
    known = np.where(np.isfinite(beta), beta, 0.0)
    found = boundary.crossings(known)
    order = np.argsort(found.alpha, axis=1)
    alpha = np.take_along_axis(found.alpha, order, 1)
    leaving = np.take_along_axis(found.leaving, order, 1)
    least, most = np.full((beta.size, 1), -np.inf), np.full((beta.size, 1), np.inf)
    ends = np.concatenate([least, np.where(np.isnan(alpha), np.inf, alpha), most], 1)
    outside = boundary.base + np.concatenate([np.zeros((beta.size, 1)), np.cumsum(leaving, 1)], 1)
    stable = (np.round(outside) == 0) & (ends[:, 1:] > ends[:, :-1]) & np.isfinite(beta)[:, None]
    # Neighbors that touch, where one pole leaves as another enters, stay apart: their common end is on the boundary.
    place = np.cumsum(stable, 1) - 1
    low, high = (np.full((beta.size, int(stable.sum(1).max(initial=0))), np.nan) for _ in range(2))
    row, gap = np.nonzero(stable)
    low[row, place[row, gap]], high[row, place[row, gap]] = ends[row, gap], ends[row, gap + 1]
    return Intervals(low, high)


def label_walls(boundary: Boundary, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Whether each wall is stable; arrays that broadcast. Dampings that repeat are solved once."""
    alpha, beta = np.broadcast_arrays(alpha, beta)
    rows, place = np.unique(beta, return_inverse=True)
    inside = stable_intervals(boundary, rows)
    place = place.reshape(beta.shape)
    stable = np.zeros(alpha.shape, bool)
    for k in range(inside.low.shape[1]):
        stable |= (alpha > inside.low[place, k]) & (alpha < inside.high[place, k])
    return stable
