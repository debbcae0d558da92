"""The recommended wall of a device: its place in the stable region, and its response, in SI units."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.data import RecommendationData, StepData
from zwidth.figures.step import SETTLED, draw_positions


def draw_recommendation(data: RecommendationData, ax: Axes | None = None) -> Figure:
    """Draw the stable region over K and B with the recommended wall, and the response of the position to 1 N.

    Args:
        data: the recommended wall, the region and the response.
        ax: draw the region alone, into this Axes.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is not None:
            _draw_region(ax, data)
            return style.figure_of(ax)
        figure, axes = style.new_figure(style.WIDTH, 3.5, 1, 2)
        _draw_region(axes[0, 0], data)
        _draw_response(axes[0, 1], data)
        axes[0, 0].set_title("(a)")
        axes[0, 1].set_title("(b)")
        return figure


def _draw_region(ax: Axes, data: RecommendationData) -> None:
    si = data.region.si
    assert si is not None, "a recommendation is in SI units"
    factor, unit = style.si_unit(data.stiffness_max, "N/m")
    outline = data.region.outlines[0]
    edge = (outline.alpha * si.stiffness * factor, outline.beta * si.virtual_damping)
    ax.fill(*edge, facecolor=style.SKY, alpha=0.25, linewidth=0.0, zorder=1)
    ax.plot(*edge, color=style.BLUE, label="boundary", zorder=3)
    for passive in data.region.passive:
        _draw_passive(ax, passive.alpha * si.stiffness * factor, passive.beta * si.virtual_damping)
    _mark_walls(ax, data, factor, unit)
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    ax.set_xlim(-0.02 * float(edge[0].max()), 1.26 * float(edge[0].max()))
    ax.set_xlabel(f"stiffness  $K$  in {unit}")
    ax.set_ylabel("virtual damping  $B$  in N s/m")


def _draw_passive(ax: Axes, stiffness: np.ndarray, virtual_damping: np.ndarray) -> None:
    """The passive walls among the stable ones."""
    ax.fill(stiffness, virtual_damping, facecolor=style.VERMILION, alpha=0.15, linewidth=0.0, zorder=1.5)
    ax.plot(
        stiffness,
        virtual_damping,
        color=style.VERMILION,
        linestyle=style.DASH_DOTTED,
        linewidth=1.2,
        label="passive",
        zorder=3,
    )
    # Above the upper edge, which runs from the stiffest passive wall back to K = 0.
    tip = int(np.argmax(stiffness))
    middle = tip + int(np.argmin(np.abs(stiffness[tip:] - 0.5 * stiffness[tip])))
    place = (stiffness[middle], virtual_damping[middle])
    ax.annotate("passive", place, xytext=(0, 8), ha="center", color=style.VERMILION, **_TEXT)


def _mark_walls(ax: Axes, data: RecommendationData, factor: float, unit: str) -> None:
    """The stiffest wall, the recommended one, and the damping that may go with its stiffness."""
    stiffness = data.stiffness * factor
    interval = (data.virtual_damping_lower, data.virtual_damping_upper)
    ax.plot([stiffness, stiffness], interval, color=style.GRAY, linewidth=1.0, label="virtual_damping_interval")
    top = (data.stiffness_max * factor, data.virtual_damping_at_max)
    ax.plot(*top, "o", color=style.BLACK, markersize=4.5, label="stiffness_max", zorder=5, clip_on=False)
    ax.annotate(r"$K_{\max} =$" + f"\n{top[0]:.3g} {unit}", top, xytext=(6, 0), **_TEXT)
    ax.plot(stiffness, data.virtual_damping, "D", color=style.BLACK, markersize=5.0, label="recommended", zorder=5)
    share = f"{100 * data.stiffness_fraction:g} %"
    text = f"recommended ({share}):\n$K = {stiffness:.3g}$ {unit}\n$B = {data.virtual_damping:.3g}$ N s/m"
    ax.annotate(text, (stiffness, data.virtual_damping), xytext=(-8, 0), ha="right", **_TEXT)


_TEXT: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 8, "zorder": 6}


def _draw_response(ax: Axes, data: RecommendationData) -> None:
    response = data.response
    draw_positions(ax, StepData((response,), physical=True))
    clock, unit = style.si_unit(float(response.time[-1]), "s")
    ax.set_xlim(0.0, float(response.time[-1] + response.time[1]) * clock)
    ax.set_xlabel(f"time  $t$  in {unit}")
    if response.settles_in_view:
        settled = response.settling_time * clock
        dot = Line2D([], [], linestyle="", marker="o", markersize=4.5, color=ax.lines[0].get_color())
        ax.legend([dot], [f"{SETTLED} after {settled:.3g} {unit}"], loc="upper right", handletextpad=0.2)
