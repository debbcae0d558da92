"""What passivity costs: the stiffest passive wall beside the stiffest stable one."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.data import PassivityData


def draw_passivity_cost(data: PassivityData, ax: Axes | None = None) -> Figure:
    """Draw the stiffest stable (solid) and the stiffest passive wall (dash-dotted) over delta, and their ratio.

    Args:
        data: both maxima for every delay.
        ax: draw the two maxima alone, into this Axes.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is not None:
            _draw_maxima(ax, data)
            return style.figure_of(ax)
        figure, axes = style.new_figure(style.WIDTH, 3.6, 1, 2)
        _draw_maxima(axes[0, 0], data)
        _draw_ratio(axes[0, 1], data)
        axes[0, 0].set_title("(a)")
        axes[0, 1].set_title("(b)")
        return figure


def _draw_maxima(ax: Axes, data: PassivityData) -> None:
    colors = style.color_by_value([cost.d for cost in data.costs])
    for cost in data.costs:
        color = colors[cost.d]
        ax.plot(cost.delta, cost.alpha_max, color=color, label=f"alpha_max, d = {cost.d:g}", zorder=3)
        label = f"alpha_max_passive, d = {cost.d:g}"
        ax.plot(cost.delta, cost.alpha_max_passive, color=color, linestyle=style.DASH_DOTTED, label=label, zorder=3)
        ax.fill_between(
            cost.delta, cost.alpha_max_passive, cost.alpha_max, color=color, alpha=0.12, linewidth=0.0, zorder=1
        )
    deltas = np.concatenate([cost.delta for cost in data.costs])
    ax.set_xlim(float(deltas.min()), float(deltas.max()))
    ax.set_ylim(0.0, 1.04 * max(float(np.nanmax(cost.alpha_max)) for cost in data.costs))
    ends = [float(cost.alpha_max[-1]) for cost in data.costs]
    _label_ends(ax, data, ends, colors)
    ax.set_xlabel(style.DELTA_LABEL)
    ax.set_ylabel(style.ALPHA_LABEL)
    handles = [
        Line2D([], [], color=style.GRAY, label=r"stiffest stable wall, $\alpha_{\max}$"),
        Line2D([], [], color=style.GRAY, linestyle=style.DASH_DOTTED, label="stiffest passive wall"),
    ]
    ax.legend(handles=handles, loc="upper left")


def _draw_ratio(ax: Axes, data: PassivityData) -> None:
    """The share of the stable stiffness that a passive wall reaches."""
    colors = style.color_by_value([cost.d for cost in data.costs])
    ratios = [100.0 * cost.alpha_max_passive / cost.alpha_max for cost in data.costs]
    for cost, ratio in zip(data.costs, ratios, strict=True):
        label = f"passive share, d = {cost.d:g}"
        ax.plot(cost.delta, ratio, color=colors[cost.d], label=label, zorder=3)
    deltas = np.concatenate([cost.delta for cost in data.costs])
    ax.set_xlim(float(deltas.min()), float(deltas.max()))
    ax.set_ylim(0.0, 100.0)
    _label_ends(ax, data, [float(ratio[-1]) for ratio in ratios], colors)
    ax.set_xlabel(style.DELTA_LABEL)
    ax.set_ylabel(r"stiffest passive wall in % of $\alpha_{\max}$")


def _label_ends(ax: Axes, data: PassivityData, ends: list[float], colors: dict[float, object]) -> None:
    style.label_ends(ax, [f"$d = {cost.d:g}$" for cost in data.costs], ends, [colors[cost.d] for cost in data.costs])
