"""Labels of contours: upright, and apart from each other, from other lines and from the frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet

_FONT = 7.0
# Of a panel, what its labels and the color bar may leave when it is laid out.
_LEFT = 0.72
# In units of a label: how far its middle is from lines and from the middle of other labels.
_FROM_LINES, _FROM_LABELS = 0.6, 1.2
# Points between which a label is placed, in dots.
_STEP = 3.0
_CANDIDATES = 60


def label_contours(
    ax: Axes, drawn: ContourSet, colors: Sequence[Any], shades: Sequence[Any], others: Sequence[np.ndarray] = ()
) -> None:
    """Write the level of each contour on its longest line where there is room, once.

    The range and the spacing of the axes must be set: where lines are on the page decides on what has room.

    Args:
        ax: the panel.
        drawn: its contours.
        colors: of each contour.
        shades: what is behind each, which the label covers its line with.
        others: points (x, y) of further lines and marks, which labels keep away from.
    """
    frame = ax.get_window_extent()
    lines = [
        _list_lines(ax, [np.asarray(part) for part in path.to_polygons(closed_only=False)])
        for path in drawn.get_paths()
    ]
    taken = _list_lines(ax, [np.atleast_2d(points) for points in others if len(points)])
    placed: list[tuple[np.ndarray, np.ndarray]] = []
    for k, (level, own) in enumerate(zip(drawn.levels, lines, strict=True)):
        text = f"{level:.4g}"
        dots = ax.figure.dpi / 72.0 / _LEFT
        size = dots * _FONT * np.array([0.62 * len(text) + 0.4, 1.3])
        if not own:
            continue
        line = max(own, key=len)
        if np.ptp(line, axis=0).max() < 1.5 * size[0]:
            continue
        off = [each for j, near in enumerate(lines) if j != k for each in near] + taken
        at = _find_place(line, size, frame, off, placed)
        if at is None:
            continue
        placed.append((at, size))
        x, y = ax.transData.inverted().transform(at)
        box = {"facecolor": shades[k], "edgecolor": "none", "pad": 0.6}
        ax.text(x, y, text, fontsize=_FONT, color=colors[k], ha="center", va="center", bbox=box, zorder=2.5)


def _list_lines(ax: Axes, lines: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Lines in dots, their points so close that a label between two of them touches one."""
    found = []
    for line in lines:
        dots = np.asarray(ax.transData.transform(line))
        dots = dots[np.isfinite(dots).all(axis=1)]
        if not len(dots):
            continue
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(dots, axis=0).T)))
        at = np.linspace(0.0, along[-1], 2 + int(min(along[-1] / _STEP, 1000)))
        found.append(np.stack([np.interp(at, along, values) for values in dots.T], -1))
    return found


def _find_place(
    line: np.ndarray, size: np.ndarray, frame: Any, lines: list[np.ndarray], labels: list[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray | None:
    """The point of a line with most room, the one closest to the middle of the frame where several have enough."""
    low, high = np.array([frame.x0, frame.y0]) + 0.6 * size, np.array([frame.x1, frame.y1]) - 0.6 * size
    inside = line[np.all((line > low) & (line < high), axis=1)]
    inside = inside[:: max(1, len(inside) // _CANDIDATES)]
    if not len(inside):
        return None
    room = np.full(len(inside), np.inf)
    if lines:
        away = np.abs(inside[:, None] - np.concatenate(lines)[None]) / size
        room = away.max(axis=2).min(axis=1) / _FROM_LINES
    for at, other in labels:
        room = np.minimum(room, (np.abs(inside - at) / (0.5 * (size + other))).max(axis=1) / _FROM_LABELS)
    # Twice the room that is needed is as good as more.
    off_middle = np.hypot(*((inside - 0.5 * (low + high)) / (high - low)).T)
    best = int(np.argmax(np.minimum(room, 2.0) - 0.2 * off_middle))
    return inside[best] if room[best] >= 1.0 else None
