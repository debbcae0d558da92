"""What passivity costs: the stiffest passive wall beside the stiffest stable one."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import grid, style
from zwidth.figures.table import Table, curves


@style.house_style()
def draw_passivity_cost(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stiffest stable (solid) and the stiffest passive wall (dash-dotted) over delta, and their ratio.

    Args:
        table: columns of a passivity study: d, delta, alpha_max, alpha_max_passive.
        axes: an Axes of yours for the two maxima alone, or two.
    """
    panels = style.panels(axes, 2, style.WIDTH, 3.6, 2)
    costs = curves(table, "d")
    colors = style.color_by_value([cost.d for cost in costs])
    for ax, draw in zip(panels, (_draw_maxima, _draw_ratio), strict=False):
        draw(ax, costs, colors)
        deltas = np.asarray(table["delta"])
        grid.scale_axis(ax, "x", np.unique(deltas))
        ax.set_xlabel(style.DELTA_LABEL)
    style.letter(panels)
    return panels


def _draw_maxima(ax: Axes, costs: list[Any], colors: dict[float, Any]) -> None:
    for cost in costs:
        color, d = colors[cost.d], f"d = {cost.d:g}"
        ax.plot(cost.delta, cost.alpha_max, color=color, label=f"alpha_max, {d}", zorder=3)
        passive: dict[str, Any] = {"linestyle": style.DASH_DOTTED, "label": f"alpha_max_passive, {d}"}
        ax.plot(cost.delta, cost.alpha_max_passive, color=color, zorder=3, **passive)
        gap = (cost.delta, cost.alpha_max_passive, cost.alpha_max)
        ax.fill_between(*gap, color=color, alpha=0.12, linewidth=0.0, zorder=1)
    ax.set_ylim(0.0, 1.04 * max(float(np.nanmax(cost.alpha_max)) for cost in costs))
    style.label_ends(ax, costs, [cost.alpha_max[-1] for cost in costs], colors)
    ax.set_ylabel(style.ALPHA_LABEL)
    passive_line = style.line("stiffest passive wall", style.DASH_DOTTED)
    handles = [style.line(r"stiffest stable wall, $\alpha_{\max}$"), passive_line]
    ax.legend(handles=handles, loc="upper left")


def _draw_ratio(ax: Axes, costs: list[Any], colors: dict[float, Any]) -> None:
    """The share of the stable stiffness that a passive wall reaches."""
    ratios = [100.0 * cost.alpha_max_passive / cost.alpha_max for cost in costs]
    for cost, ratio in zip(costs, ratios, strict=True):
        ax.plot(cost.delta, ratio, color=colors[cost.d], label=f"passive share, d = {cost.d:g}", zorder=3)
    ax.set_ylim(0.0, 100.0)
    style.label_ends(ax, costs, [ratio[-1] for ratio in ratios], colors)
    ax.set_ylabel(r"stiffest passive wall in % of $\alpha_{\max}$")
