"""Simulated motions: position and force over time, position over velocity, and energy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import style
from zwidth.figures.table import Table, curves

# A motion this much wider than the smallest is cut, so that the smallest is still seen.
_CUT = 8.0
_MOST_PANELS = 6
_ENERGIES = {
    "energy_J": ("energy of the bodies", style.BLACK, style.SOLID),
    "wall_work_J": ("given by the wall", style.VERMILION, style.DASHED),
    "push_work_J": ("given by the hand", style.GREEN, style.DOTTED),
    "damping_loss_J": ("taken by dampers", style.BLUE, style.DASH_DOTTED),
    "friction_loss_J": ("taken by friction", style.PURPLE, style.SOLID),
}


@style.house_style()
def draw_motion(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the position of every motion over time and the force of the wall; thin: the bodies behind links.

    Args:
        table: columns of a simulate study.
        axes: an Axes of yours for the positions alone, or two.
    """
    motions = _read_motions(table)
    panels = style.panels(axes, 2, 6.4, 4.8, height_ratios=(1.6, 1.0), sharex=True)
    clock, second = style.si_unit([each.time_s[-1] for each in motions], "s")
    behind = [name for name in ("tip_position_m", "hand_position_m") if hasattr(motions[0], name)]
    quantities = (("position_m", "position  $x$", behind), ("wall_force_N", "wall force", []))
    for ax, (name, words, others) in zip(panels, quantities, strict=False):
        factor, unit = _limit(ax, "y", [getattr(each, one) for each in motions for one in (name, *others)], name[-1])
        for each in motions:
            # Steps of a force are too short for dashes: lightness has to do.
            look = each.look if name == "position_m" else {"color": each.look["color"], "linewidth": 1.1}
            ax.plot(each.time_s * clock, getattr(each, name) * factor, label=each.label, zorder=3, **look)
            for other in others:
                look = {"color": each.look["color"], "linewidth": 0.6}
                ax.plot(each.time_s * clock, getattr(each, other) * factor, label=f"{other}, {each.label}", **look)
        ax.axhline(0.0, color=style.GRAY, linewidth=0.6, zorder=2)
        ax.set_ylabel(f"{words}  in {unit}")
        ax.set_xlim(0.0, max(float(each.time_s[-1]) for each in motions) * clock)
    _mark_wall(panels[0], "y", motions)
    panels[-1].set_xlabel(f"time  $t$  in {second}")
    handles = [*_explain(motions), *([style.line("bodies behind links", width=0.6)] if behind else [])]
    style.legend(panels, handles, outside=axes is None, ncols=_count_columns(motions))
    return panels


@style.house_style()
def draw_phase_plane(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the velocity of every motion over its position, with the wall; a dot where each starts.

    Args:
        table: columns of a simulate study.
        axes: an Axes of yours.
    """
    motions = _read_motions(table)
    (ax,) = panels = style.panels(axes, 1, 5.6, 4.2)
    x, meter = _limit(ax, "x", [each.position_m for each in motions], "m")
    y, speed = _limit(ax, "y", [each.velocity_m_per_s for each in motions], "m/s")
    for each in motions:
        look = {**each.look, "linewidth": 1.1}
        ax.plot(each.position_m * x, each.velocity_m_per_s * y, label=each.label, zorder=3, **look)
    for each in motions:
        start = each.position_m[0] * x, each.velocity_m_per_s[0] * y
        ax.plot(*start, linestyle="", marker="o", markersize=4.0, color=style.BLACK, label="start", zorder=4)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.6, zorder=2)
    _mark_wall(ax, "x", motions)
    ax.set(xlabel=f"position  $x$  in {meter}", ylabel=f"velocity  $v$  in {speed}")
    start = style.line("start", "", color=style.BLACK, marker="o", markersize=4.0)
    style.legend(panels, [*_explain(motions), start], outside=axes is None, ncols=_count_columns(motions))
    return panels


@style.house_style()
def draw_energy(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw for every motion what wall and hand have given, what dampers and friction have taken, and what there is.

    Args:
        table: columns of a simulate study.
        axes: Axes of yours, one for each motion.
    """
    motions = _read_motions(table)
    motions = [motions[k] for k in style.pick_evenly(len(motions), _MOST_PANELS)]
    columns = min(3, len(motions))
    rows = -(-len(motions) // columns)
    panels = style.panels(axes, len(motions), 0.9 + 2.5 * columns if columns > 1 else 5.6, 0.9 + 2.4 * rows, columns)
    shown = [name for name in _ENERGIES if any(np.any(getattr(each, name) != 0) for each in motions)]
    clock, second = style.si_unit([each.time_s[-1] for each in motions], "s")
    for ax, each in zip(panels, motions, strict=False):
        factor, joule = style.si_unit([getattr(each, name) for name in shown], "J")
        for name in shown:
            words, color, dash = _ENERGIES[name]
            values = getattr(each, name) * factor
            ax.plot(each.time_s * clock, values, color=color, linestyle=dash, linewidth=1.2, label=words)
        ax.axhline(0.0, color=style.GRAY, linewidth=0.6, zorder=1)
        ax.set_xlim(0.0, float(each.time_s[-1]) * clock)
        title = _in_math(each.label).replace(", ", "\n" if columns > 1 else ", ")
        ax.set(title=title, xlabel=f"time  $t$  in {second}", ylabel=f"energy  in {joule}")
    handles = [style.line(words, dash, 1.2, color) for words, color, dash in (_ENERGIES[name] for name in shown)]
    style.legend(panels, handles, outside=axes is None, ncols=min(len(handles), 2 + columns))
    return panels


def _read_motions(table: Table) -> list[Any]:
    """The motions in a table, each with its look; two of them may be alike in all but that each begins at time 0."""
    columns = {str(name): np.asarray(table[name]) for name in table}
    motions = curves({**columns, "number": np.cumsum(columns["time_s"] == 0.0)}, "number")
    for k, each in enumerate(motions):
        each.label = style.literal(each.label[0])
        each.look = style.look(k)
    return motions


def _limit(ax: Axes, which: str, values: list[np.ndarray], unit: str) -> tuple[float, str]:
    """Set the range of an axis, so that one that grows without end does not hide the others; returns its unit."""
    finite = [each[np.isfinite(each)] for each in values]
    largest = [float(np.abs(each).max(initial=0.0)) for each in finite]
    most = _CUT * min((size for size in largest if size > 0), default=1.0)
    low = min(float(np.clip(each.min(initial=0.0), -most, 0.0)) for each in finite)
    high = max(float(np.clip(each.max(initial=0.0), 0.0, most)) for each in finite)
    factor, unit = style.si_unit((low, high), unit)
    getattr(ax, f"set_{which}lim")(*style.span(low * factor, high * factor))
    return factor, unit


def _mark_wall(ax: Axes, which: str, motions: list[Any]) -> None:
    """Mark the wall's surface, and where the wall is unless it acts on both sides."""
    line = ax.axhline if which == "y" else ax.axvline
    line(0.0, color=style.GRAY, linewidth=1.0, zorder=2)
    if all(np.all(each.contact) for each in motions):
        return
    far = max(getattr(ax, f"get_{which}lim")())
    shade = ax.axhspan if which == "y" else ax.axvspan
    shade(0.0, far, color=style.GRAY, alpha=0.10, linewidth=0.0, zorder=0.5)
    place = {"y": (0.99, 0.97, "right", "top"), "x": (0.99, 0.03, "right", "bottom")}[which]
    ax.text(*place[:2], "wall", transform=ax.transAxes, ha=place[2], va=place[3], color=style.GRAY, fontsize=8)


def _in_math(label: str) -> str:
    return label.replace("K_max", r"$K_{\max}$")


def _count_columns(motions: list[Any]) -> int:
    """How many names of motions a legend has side by side."""
    return 2 if max(len(each.label) for each in motions) > 20 else 4


def _explain(motions: Iterable[Any]) -> list[Any]:
    """An entry of a legend for each motion that has a name."""
    named = [each for each in motions if each.label]
    return [style.line(_in_math(each.label), each.look["linestyle"], color=each.look["color"]) for each in named]
