"""Stable sets of devices with parts, in SI units: outlines with their islands and holes, and walls that matter."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import PathPatch

from zwidth.figures import style
from zwidth.figures.region import to_path
from zwidth.figures.table import SI_COLUMNS, Table, curves, select

_MARKS: dict[str, dict[str, Any]] = {
    "stiffest": {"marker": "o", "markersize": 4.5},
    "recommended": {"marker": "D", "markersize": 5.0},
}


@style.house_style()
def draw_stable_set(outlines: Table, walls: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stable walls of one or several devices over stiffness and virtual damping.

    Solid: the largest outline; dashed: islands, stable walls apart from it; dotted: holes, unstable walls within.

    Args:
        outlines: columns label, number, piece (outline, island or hole), stiffness_N_per_m, virtual_damping_N_s_per_m.
        walls: columns label, wall (stiffest or recommended) and the same two.
        axes: an Axes of yours.
    """
    labels = list(dict.fromkeys(np.asarray(outlines["label"]).tolist()))
    (ax,) = panels = style.panels(axes, 1, 5.6, 4.0)
    colors = {label: style.DISTINCT[k % len(style.DISTINCT)] for k, label in enumerate(labels)}
    factor, unit = style.si_unit(float(np.max(np.abs(outlines[SI_COLUMNS[0]]))), "N/m")
    pieces = set()
    for label in labels:
        pieces |= _draw_pieces(ax, select(outlines, label=label), colors[label], factor, 0.5 / (1 + len(labels)))
    for label in labels:
        _mark_walls(ax, select(walls, label=label), colors[label], factor, unit, spell=len(labels) == 1)
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    ax.set(xlabel=f"stiffness  $K$  in {unit}", ylabel="virtual damping  $B$  in N s/m")
    ax.margins(0.04)
    handles = [style.line(style.literal(label), color=color) for label, color in colors.items() if len(labels) > 1]
    dashes = {"island": style.DASHED, "hole": style.DOTTED}
    handles += [style.line(name, dash) for name, dash in dashes.items() if name in pieces]
    if len(labels) > 1:
        handles.append(style.line("stiffest wall", "", color=style.GRAY, marker="o", markersize=4.5))
    style.legend(panels, handles, outside=axes is None, ncols=3)
    return panels


def _draw_pieces(ax: Axes, table: Table, color: Any, factor: float, shade: float) -> set[str]:
    """One device's outlines, shaded inside; returns which kinds of them there are."""
    found = curves(table, "number", "piece")
    paths = [np.stack([getattr(one, SI_COLUMNS[0]) * factor, getattr(one, SI_COLUMNS[1])], -1) for one in found]
    inside = to_path([(path, one.piece == "hole") for path, one in zip(paths, found, strict=True)])
    ax.add_patch(PathPatch(inside, facecolor=color, alpha=shade, linewidth=0.0, zorder=1))
    dashes = {"outline": style.SOLID, "island": style.DASHED, "hole": style.DOTTED}
    for path, one in zip(paths, found, strict=True):
        look = {"color": color, "linestyle": dashes[one.piece], "zorder": 3}
        ax.plot(path[:, 0], path[:, 1], label=f"{one.piece} {one.number}", **look)
    return {str(one.piece) for one in found}


def _mark_walls(ax: Axes, walls: Table, color: Any, factor: float, unit: str, *, spell: bool) -> None:
    rows = zip(walls["wall"], walls[SI_COLUMNS[0]] * factor, walls[SI_COLUMNS[1]], strict=True)
    for name, stiffness, damping in rows:
        shade = style.BLACK if spell else color
        ax.plot(stiffness, damping, linestyle="", color=shade, label=name, zorder=5, clip_on=False, **_MARKS[str(name)])
        if spell:
            text = f"{name}\n$K = {stiffness:.3g}$ {unit}\n$B = {damping:.3g}$ N s/m"
            ax.annotate(
                text,
                (stiffness, damping),
                xytext=(-8, 0),
                textcoords="offset points",
                ha="right",
                va="center",
                fontsize=8,
            )
