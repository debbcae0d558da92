"""The recommended wall of a device: its place in the stable region, and its response, in SI units."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zwidth.figures import style
from zwidth.figures.data import RecommendationData, StepData
from zwidth.figures.step import draw_positions


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
    outline = data.region.outlines[0]
    factor, unit = style.si_unit(data.stiffness_max, "N/m")
    k = outline.alpha * si.stiffness * factor
    b = outline.beta * si.virtual_damping
    ax.fill(k, b, facecolor=style.SKY, alpha=0.25, linewidth=0.0, zorder=1)
    ax.plot(k, b, color=style.BLUE, label="boundary", zorder=3)
    for passive in data.region.passive:
        passive_k, passive_b = passive.alpha * si.stiffness * factor, passive.beta * si.virtual_damping
        ax.plot(
            passive_k, passive_b, color=style.VERMILION, linestyle=style.DASH_DOTTED, linewidth=1.2, label="passive"
        )
        ax.annotate("passive", (passive_k.max(), passive_b[np.argmax(passive_k)]), **_beside(6), color=style.VERMILION)
    stiffness = data.stiffness * factor
    interval = (data.virtual_damping_lower, data.virtual_damping_upper)
    ax.plot([stiffness, stiffness], interval, color=style.GRAY, linewidth=1.0, label="virtual_damping_interval")
    top = (data.stiffness_max * factor, data.virtual_damping_at_max)
    ax.plot(*top, "o", color=style.BLACK, markersize=4.5, label="stiffness_max", zorder=5, clip_on=False)
    ax.annotate(r"$K_{\max}$", top, **_beside(6))
    ax.plot(stiffness, data.virtual_damping, "D", color=style.BLACK, markersize=5.0, label="recommended", zorder=5)
    text = rf"${100 * data.stiffness_fraction:g}\,\%$ of $K_{{\max}}$"
    ax.annotate(text, (stiffness, data.virtual_damping), xytext=(-7, 0), ha="right", **_beside())
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    ax.set_xlim(-0.02 * top[0], 1.18 * top[0])
    ax.set_xlabel(f"stiffness  $K$  in {unit}")
    ax.set_ylabel("virtual damping  $B$  in N s/m")


def _beside(right: float | None = None) -> dict[str, Any]:
    """Where an annotation stands, relative to its point."""
    place = {} if right is None else {"xytext": (right, 0)}
    return {"textcoords": "offset points", "va": "center", "fontsize": 8, "zorder": 6, **place}


def _draw_response(ax: Axes, data: RecommendationData) -> None:
    response = data.response
    step = StepData((response,), physical=True)
    draw_positions(ax, step)
    clock, unit = style.si_unit(float(response.time[-1]), "s")
    ax.set_xlim(0.0, float(response.time[-1]) * clock)
    ax.set_xlabel(f"time  $t$  in {unit}")
    if np.isfinite(response.settling_time):
        settled = response.settling_time * clock
        ax.annotate(
            f"settled (2 %)\nafter {settled:.3g} {unit}",
            (settled, ax.get_ylim()[1] * 0.5),
            xytext=(settled, ax.get_ylim()[1] * 0.45),
            fontsize=8,
        )
