"""Regions within closed outlines, which are known exactly, and the walls that are marked in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.lib.stride_tricks import sliding_window_view

from zwidth.figures import style

# Points (x, y) of each closed line, and whether it surrounds a hole.
Outlines: TypeAlias = Sequence[tuple[np.ndarray, bool]]
# So many points a step of an outline bend it as a logarithmic axis does.
_BEND = 32
# How walls that matter are marked, in a legend as well.
MARKS: dict[str, dict[str, Any]] = {
    "stiffest": {"marker": "o", "markersize": 4.5},
    "recommended": {"marker": "D", "markersize": 5.0},
}


def draw_region(ax: Axes, outlines: Outlines, face: Any, *, under: float = 1.0, **look: Any) -> None:
    """Shade what lies within outlines, and draw these closed."""
    shade_region(ax, outlines, face, zorder=under)
    for points, _ in outlines:
        ax.plot(*_close(points).T, **look)


def shade_region(ax: Axes, outlines: Outlines, face: Any, *, alpha: float | None = None, zorder: float = 1.0) -> None:
    """Shade what lies within outlines, and not in their holes."""
    if outlines and face != "none":
        ax.add_patch(PathPatch(to_path(outlines), facecolor=face, alpha=alpha, linewidth=0.0, zorder=zorder))


def to_path(outlines: Outlines) -> Path:
    """The shape of a region; holes run the other way round, so that they stay empty."""
    return Path.make_compound_path(*(Path(_wind(points, hole), closed=True) for points, hole in outlines))


def _wind(points: np.ndarray, hole: bool) -> np.ndarray:
    closed = _close(points)
    x, y = closed[:-1].T
    turn = float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))
    return closed if (turn > 0) != hole else closed[::-1]


def _close(points: np.ndarray) -> np.ndarray:
    return points if np.array_equal(points[0], points[-1]) else np.append(points, points[:1], 0)


def mark_wall(
    ax: Axes, wall: Any, label: str, *, kind: str, color: Any = style.BLACK, text: str = "", right: bool = False
) -> None:
    """Mark a wall, its stiffness and damping, with words to the left of it or to the right."""
    ax.plot(*wall, linestyle="", color=color, label=label, zorder=5, clip_on=False, **MARKS[kind])
    if text:
        place: Any = {"xytext": (6 if right else -8, 0), "ha": "left" if right else "right"}
        ax.annotate(text, wall, textcoords="offset points", va="center", fontsize=8, zorder=6, **place)


def draw_zeros(ax: Axes) -> None:
    """Lines where stiffness and damping are zero."""
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)


def name_axes(ax: Axes, spring: str, damper: str = "N s/m") -> None:
    """Label the axes of stiffness and damping, normalized where they have no unit, with lines where these are zero."""
    draw_zeros(ax)
    in_si = f"stiffness  $K$  in {spring}", f"virtual damping  $B$  in {damper}"
    style.label_axes(np.array([ax]), *(in_si if spring else (style.ALPHA_LABEL, style.BETA_LABEL)), once=False)


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
