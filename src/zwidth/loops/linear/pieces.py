"""The pieces of the stable set: what soft walls belong to, and islands, which no rising stiffness reaches.

A row of the plane is stable in intervals. As the damping moves, an interval keeps the arcs that end it, but at the
dampings of corners and of turns of the boundary, where one of its ends passes to another arc, or where it begins, ends,
parts or joins. So intervals of neighboring rows belong together that share an end (docs/theory/scenes.md, V20).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.rows import BoundIntervals, bound_intervals, join_rows

# Rows between two neighboring corners, as shares of the way; and rows across the whole of the plane.
_SHARES, _ROWS = np.array([1e-3, 0.5, 1.0 - 1e-3]), 65
# Two rows between corners with different ends are halved so often, until a corner that was not seen is between them.
_HALVINGS = 48
# A corner is known to such a share, and so many rows may lie within it.
_NEAR, _BESIDE = 1e-9, 4


class Island(NamedTuple):
    """A piece of the stable set without soft walls: its extent in stiffness and in damping."""

    stiffness: tuple[float, float]
    virtual_damping: tuple[float, float]


@dataclass(frozen=True)
class StablePieces:
    """The stable set of one loop, piece by piece.

    Args:
        boundary: of the loop.
        corners: dampings at which the set's edge has ends or turns, or passes from K > 0 to K < 0.
    """

    boundary: Boundary
    corners: np.ndarray

    @cached_property
    def _rows(self) -> tuple[np.ndarray, BoundIntervals]:
        """Rows with their intervals, so many that between corners neighbors have the same ends."""
        corners = self.corners
        rows = (corners[:-1, None] + np.diff(corners)[:, None] * _SHARES).ravel()
        across = np.linspace(corners[0], corners[-1], _ROWS + 2)[1:-1] if corners.size else corners
        rows = np.unique(np.concatenate([rows, across]))
        rows = rows[self.boundary.is_sound(rows)]
        found = bound_intervals(self.boundary, rows)
        for _ in range(_HALVINGS):
            same = (found.below[1:] == found.below[:-1]).all(1) & (found.above[1:] == found.above[:-1]).all(1)
            parted = np.searchsorted(corners, rows[1:], side="left") != np.searchsorted(corners, rows[:-1], side="left")
            middle = 0.5 * (rows[1:] + rows[:-1])
            new = middle[~same & ~parted & (middle > rows[:-1]) & (middle < rows[1:])]
            new = new[self.boundary.is_sound(new)]
            if not new.size:
                break
            order = np.argsort(np.append(rows, new))
            found = join_rows((found, bound_intervals(self.boundary, new)), order)
            rows = np.append(rows, new)[order]
        return rows, found

    @cached_property
    def _labels(self) -> tuple[np.ndarray, np.ndarray]:
        """The number of the piece of each interval of `_rows`, -1 for none; and the pieces with soft walls."""
        _, found = self._rows
        there = found.above >= 0
        number = np.where(there, np.cumsum(there).reshape(there.shape) - 1, -1)
        joined = [np.zeros((2, 0), int)]
        for ends in (found.below, found.above):
            row, one, other = np.nonzero((ends[:-1, :, None] == ends[1:, None, :]) & (ends[:-1, :, None] >= 0))
            joined.append(np.stack([number[row, one], number[row + 1, other]]))
        pairs, count = np.concatenate(joined, 1), int(there.sum())
        # The least number that each is joined to; a graph of SciPy's would take a third of a second to load.
        piece, before = np.arange(count), np.full(count, -1)
        while not np.array_equal(piece, before):
            before = piece.copy()
            for one, other in (pairs, pairs[::-1]):
                np.minimum.at(piece, one, before[other])
            piece = piece[piece]
        labels = np.full(there.shape, -1)
        labels[there] = piece
        soft = (found.low <= 0) & (found.high > 0)
        return labels, np.unique(labels[soft])

    def main_intervals(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows of the plane, and up to which alpha each is stable in a piece with soft walls; NaN where it is not."""
        rows, found = self._rows
        labels, main = self._labels
        high = np.where(np.isin(labels, main), found.high, -np.inf).max(1, initial=-np.inf)
        return rows, np.where(np.isfinite(high), high, np.nan)

    def piece_at(self, beta: float, place: int) -> int:
        """The piece at the point of a row on one column of its crossings, -1 where none is beside it."""
        rows, found = self._rows
        after = int(np.searchsorted(rows, beta))
        # Of a corner two edges tell nearly the same damping, with rows between them.
        near = range(max(after - _BESIDE, 0), min(after + _BESIDE, rows.size))
        for row in sorted(near, key=lambda row: abs(rows[row] - beta)):
            met = (found.below[row] == place) | (found.above[row] == place)
            if met.any() and (row in (after - 1, after) or abs(rows[row] - beta) <= _NEAR * abs(beta)):
                return int(self._labels[0][row, int(np.argmax(met))])
        return -1

    def extents(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """The least and the largest alpha and beta that rows meet in each piece without soft walls."""
        rows, found = self._rows
        labels, main = self._labels
        extents = {}
        for piece in np.setdiff1d(labels[labels >= 0], main).tolist():
            row, column = np.nonzero(labels == piece)
            low, high, beta = found.low[row, column], found.high[row, column], rows[row]
            extents[piece] = np.array([low.min(), beta.min()]), np.array([high.max(), beta.max()])
        return extents

    def holds_softly(self, alpha: float, beta: float) -> bool:
        """Whether a wall is stable in a piece with soft walls."""
        found = bound_intervals(self.boundary, np.array([beta]))
        above = found.above[0, (found.low[0] < alpha) & (alpha < found.high[0])]
        return any(self.is_main(self.piece_at(beta, place)) for place in above.tolist())

    def is_main(self, piece: int) -> bool:
        """Whether a piece contains soft walls."""
        return bool(np.isin(piece, self._labels[1]))
