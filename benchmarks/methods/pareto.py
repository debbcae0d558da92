"""Figure of speed against error of each method, with one panel per delay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

from zwidth.plotting import style

# Distance of adjacent names in points.
_LETTERS = 11.0
# Position of marks without errors, left of all measured errors.
_NONE_SEEN = 1e-17
_LEAST = 3e-18
_TICKS = [_NONE_SEEN, 1e-15, 1e-13, 1e-11, 1e-9, 1e-7, 1e-5, 1e-3, 1e-1]
_COLORS = {"stable": style.BLUE, "spectral_radius": style.VERMILION, "passive": style.PURPLE, "alpha_max": style.GREEN}
_NAMES = {
    "stable": "stable or not",
    "spectral_radius": "spectral radius",
    "passive": "passive or not",
    "alpha_max": "stiffest wall",
}


class Mark(NamedTuple):
    """One measurement."""

    quantity: str
    method: str
    layout: str
    d: float
    rate: float
    error: float


@style.house_style()
def draw_pareto(marks: Sequence[Mark], axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw points per second over the largest error, both logarithmic: up and to the left is better.

    Filled marks are maps (with axes alpha and beta), open marks are scattered points.

    Args:
        marks: measurements; the first of several with the same name is drawn.
        axes: existing Axes, at most one per delay.
    """
    delays = sorted({mark.d for mark in marks})
    columns = min(3, len(delays))
    rates = min(mark.rate for mark in marks) / 3, max(mark.rate for mark in marks) * 5
    # Choose the height of a panel such that the names of its methods do not overlap.
    names = max(len({mark[:2] for mark in marks if mark.d == d}) for d in delays)
    height = max(3.6, 1.5 * names * _LETTERS / 72.0)
    size = (max(4.0 * columns, 5.0), height * -(-len(delays) // columns) + 0.5)
    panels = style.panels(axes, len(delays), *size, columns, sharex=True, sharey=True)
    for ax, d in zip(panels, delays, strict=False):
        _scale(ax, marks, rates)
        _draw_panel(ax, [mark for mark in marks if mark.d == d], rates)
        ax.set_title(f"d = {d:,.10g}")
    for lowest in panels[-columns:]:
        lowest.set_xlabel("worst error seen")
    for ax in panels[::columns]:
        ax.set_ylabel("points per second")
    style.legend(panels, _legend(marks), outside=axes is None, loc="outside lower center", ncols=4)
    return panels


def _draw_panel(ax: Axes, marks: Sequence[Mark], rates: tuple[float, float]) -> None:
    drawn: dict[tuple[str, ...], Mark] = {}
    for mark in marks:
        drawn.setdefault(mark[:3], mark)
    labelled: dict[str, list[Mark]] = {}
    for mark in drawn.values():
        color = _COLORS[mark.quantity]
        ax.plot(
            max(mark.error, _NONE_SEEN),
            mark.rate,
            "o",
            color=color,
            markerfacecolor=color if mark.layout == "map" else "white",
            markersize=5.5,
            markeredgewidth=1.1,
        )
        labelled.setdefault(f"{mark.quantity} {mark.method}", []).append(mark)
    for group in (each for each in labelled.values() if len(each) > 1):
        line = {"color": _COLORS[group[0].quantity], "linewidth": 0.6, "zorder": 1}
        ax.plot([max(mark.error, _NONE_SEEN) for mark in group], [mark.rate for mark in group], **line)
    _name_methods(ax, [max(group, key=lambda mark: mark.rate) for group in labelled.values()], rates)
    ax.axvline(10 * _NONE_SEEN, color=style.GRAY, linewidth=0.5, linestyle=style.DOTTED)


def _name_methods(ax: Axes, tops: Sequence[Mark], rates: tuple[float, float]) -> None:
    """Write the name of each method next to the panel, with a thin line from its faster mark."""
    low, high = np.log10(rates)
    gap = _LETTERS / (72.0 * ax.get_window_extent().height / style.figure_of(ax).dpi)
    heights = [(np.log10(top.rate) - low) / (high - low) for top in tops]
    # Not below the panel, where the title of the next panel is.
    ranks = np.argsort(np.argsort(heights, kind="stable"))
    for top, place in zip(tops, style.spread(np.maximum(heights, gap * ranks).tolist(), gap), strict=True):
        color = _COLORS[top.quantity]
        ax.annotate(
            top.method,
            (max(top.error, _NONE_SEEN), top.rate),
            xytext=(1.03, place),
            textcoords="axes fraction",
            va="center",
            fontsize=6.8,
            color=color,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": color, "linewidth": 0.4, "alpha": 0.6, "shrinkA": 1, "shrinkB": 3},
        )


def _scale(ax: Axes, marks: Sequence[Mark], rates: tuple[float, float]) -> None:
    right = max(1e-11, 30 * max(mark.error for mark in marks))
    ax.set(xscale="log", yscale="log", xlim=(_LEAST, right), ylim=rates)
    ax.xaxis.set_major_locator(FixedLocator([tick for tick in _TICKS if tick < right]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: "none" if x < 1e-16 else f"$10^{{{round(np.log10(x))}}}$"))
    ax.yaxis.set_major_locator(LogLocator(numticks=12))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.grid(axis="y", color="#E8E8E8", linewidth=0.6)


def _legend(marks: Sequence[Mark]) -> list[Line2D]:
    def dot(label: str, **options: object) -> Line2D:
        return Line2D([], [], linestyle="none", markersize=5.5, label=label, **options)  # type: ignore[arg-type]

    quantities = {mark.quantity for mark in marks}
    handles = [dot(_NAMES[name], marker="o", color=color) for name, color in _COLORS.items() if name in quantities]
    handles.append(dot("map", marker="o", color=style.GRAY))
    handles.append(dot("scattered points", marker="o", color=style.GRAY, markerfacecolor="white"))
    return handles
