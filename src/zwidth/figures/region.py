"""Regions within closed outlines, which are known exactly: their shape, and whether cells of a plane agree with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.path import Path
from numpy.lib.stride_tricks import sliding_window_view

# Points (x, y) of each closed line, and whether it surrounds a hole.
Outlines: TypeAlias = Sequence[tuple[np.ndarray, bool]]
# So many points a step of an outline bend it as a logarithmic axis does.
_BEND = 32


def to_path(outlines: Outlines) -> Path:
    """The shape of a region; holes run the other way round, so that they stay empty."""
    return Path.make_compound_path(*(Path(_wind(points, hole), closed=True) for points, hole in outlines))


def _wind(points: np.ndarray, hole: bool) -> np.ndarray:
    closed = points if np.array_equal(points[0], points[-1]) else np.append(points, points[:1], 0)
    x, y = closed[:-1].T
    turn = float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))
    return closed if (turn > 0) != hole else closed[::-1]


def agrees(outlines: Outlines, x: np.ndarray, y: np.ndarray, good: np.ndarray) -> bool:
    """Whether the cells (y, x) that are good lie within, but for those next to a change, which the outline parts."""
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    inside = np.zeros(good.shape, dtype=bool)
    for closed, _ in outlines:
        inside ^= Path(closed).contains_points(points).reshape(good.shape)
    return not np.any((inside != good) & ~_changes(inside) & ~_changes(good))


def _changes(cells: np.ndarray) -> np.ndarray:
    """Cells that differ from one beside them."""
    around = sliding_window_view(np.pad(cells, 1, mode="edge"), (3, 3))
    return around.min(axis=(2, 3)) != around.max(axis=(2, 3))


def fit_axes(outlines: Outlines, ax: Axes) -> Outlines:
    """Outlines as they can be drawn on logarithmic axes: what is not positive lies beyond the frame."""
    least = [
        0.1 * min(limits) if scale == "log" else -np.inf
        for scale, limits in ((ax.get_xscale(), ax.get_xlim()), (ax.get_yscale(), ax.get_ylim()))
    ]
    if not np.isfinite(least).any():
        return outlines
    return [(np.maximum(_refine(points), least), hole) for points, hole in outlines]


def _refine(points: np.ndarray) -> np.ndarray:
    at = np.linspace(0, len(points), _BEND * len(points) + 1)
    closed = np.append(points, points[:1], 0)
    return np.stack([np.interp(at, np.arange(len(closed)), values) for values in closed.T], -1)
