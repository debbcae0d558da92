"""Figs. 6 and 9: stability boundaries in the (delta, beta) plane for alpha -> 0."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import grid, style
from zwidth.figures.table import Table, curves


@style.house_style()
def draw_zero_stiffness(table: Table, ax: Axes | None = None) -> Axes:
    """Draw the virtual damping that is stable for alpha -> 0 over delta, with the stable side shaded.

    Solid: held delay; dashed: the fractional power; dash-dotted: the passivity condition. The lower bound
    ``beta = -delta`` is common to all delays.

    Args:
        table: columns of a boundary study in the plane delta_beta: curve, d, delay_model, delta, beta_lower,
            beta_upper.
        ax: an Axes of yours; the function returns one, not an array of them.
    """
    ax = ax or style.panels(None, 1, 5.4, 4.1)[0]
    assert ax is not None
    stable = curves(table, "d", "delay_model", curve="stable")
    passive = curves(table, "d", curve="passive")
    colors = style.color_by_value([interval.d for interval in stable])
    for interval in stable:
        if interval.delay_model == "held":
            _shade(ax, interval, colors[interval.d], zorder=1)
        label = f"beta_upper, d = {interval.d:g}, {interval.delay_model}"
        look = {"color": colors[interval.d], "linestyle": style.dash_of(interval), "zorder": 3}
        ax.plot(interval.delta, interval.beta_upper, label=label, **look)
    look = {"color": style.VERMILION, "linestyle": style.DASH_DOTTED, "linewidth": 1.3, "zorder": 4}
    for interval in passive:
        _shade(ax, interval, style.VERMILION)
        for name in ("beta_lower", "beta_upper"):
            ax.plot(interval.delta, getattr(interval, name), label=f"passive {name}, d = {interval.d:g}", **look)
    _draw_lower_bound(ax, stable[0], several=len(colors) > 1)
    deltas = np.concatenate([interval.delta for interval in stable])
    grid.scale_axis(ax, "x", np.unique(deltas))
    values = np.concatenate([np.r_[interval.beta_lower, interval.beta_upper] for interval in stable])
    ax.set_ylim(*style.span(float(values.min()), float(values.max())))
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    style.label_ends(ax, stable, [interval.beta_upper[-1] for interval in stable], colors)
    ax.set(title=r"$\alpha \to 0$", xlabel=style.DELTA_LABEL, ylabel=style.BETA_LABEL)
    handles = style.delay_model_handles(stable)
    if passive:
        handles.append(style.line("passivity condition", style.DASH_DOTTED, 1.3, style.VERMILION))
    if handles:
        ax.legend(handles=handles, loc="upper left")
    return ax


def _shade(ax: Axes, interval: Any, color: Any, **keywords: Any) -> None:
    look = {"color": color, "alpha": 0.08, "linewidth": 0.0, **keywords}
    ax.fill_between(interval.delta, interval.beta_lower, interval.beta_upper, **look)


def _draw_lower_bound(ax: Axes, first: Any, *, several: bool) -> None:
    """One line for all delays, where they agree."""
    ax.plot(first.delta, first.beta_lower, color=style.BLACK, label="beta_lower", zorder=2.5)
    middle = int(0.55 * first.delta.size)
    text = r"$\beta = -\delta$ for every $d$" if several else r"$\beta = -\delta$"
    place = (first.delta[middle], first.beta_lower[middle])
    ax.annotate(text, place, xytext=(8, 6), textcoords="offset points", fontsize=8)
