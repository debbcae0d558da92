"""Eq. (22): how fast maximum stiffness grows with damping, once the damping is strong."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import style
from zwidth.figures.table import Table, curves

# Below, alpha_max hardly depends on delta and the ratio says nothing.
_LEAST_DELTA = 0.1


@style.house_style()
def draw_slope(table: Table, slopes: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw alpha_max/delta over delta beside its limit g(d), and g over the delay.

    Args:
        table: columns of a ridge study: d, delay_model, delta, alpha_max.
        slopes: delay_model, d and slope, which is g(d): over a range of delays, those of ``table`` among them.
        axes: an Axes of yours for the first panel alone, or two.
    """
    panels = style.panels(axes, 2, style.WIDTH, 3.6, 2, gridspec_kw={"width_ratios": [1.15, 1.0]})
    paths, models = curves(table, "d", "delay_model"), curves(slopes, "delay_model")
    colors = style.color_by_value([path.d for path in paths])
    for path in paths:
        own = next(model for model in models if model.delay_model == path.delay_model)
        path.limit = float(own.slope[own.d == path.d][0])
    _draw_ratio(panels[0], paths, colors)
    for ax in panels[1:]:
        _draw_limit(ax, paths, models, colors)
    style.letter(panels)
    return panels


def _draw_ratio(ax: Axes, paths: list[Any], colors: dict[float, Any]) -> None:
    """alpha_max/delta on logarithmic axes, the limits dotted across."""
    for path in paths:
        color, dash = colors[path.d], style.dash_of(path)
        label = f"alpha_max/delta, d = {path.d:g}, {path.delay_model}"
        shown = path.delta >= _LEAST_DELTA
        delta = path.delta[shown]
        ax.plot(delta, path.alpha_max[shown] / delta, color=color, linestyle=dash, label=label, zorder=3)
        ax.axhline(path.limit, color=color, linestyle=style.DOTTED, linewidth=0.9, label=f"g, d = {path.d:g}", zorder=2)
    limits = [path.limit for path in paths]
    ends = _LEAST_DELTA, max(float(path.delta.max()) for path in paths)
    style.use_logarithmic(ax, "x", ends)
    style.use_logarithmic(ax, "y", limits)
    ax.set_xlim(*ends)
    ax.set_ylim(0.7 * min(limits), 3.0 * max(limits))
    style.label_ends(ax, paths, [path.limit for path in paths], colors)
    ax.set(xlabel=style.DELTA_LABEL, ylabel=r"$\alpha_{\max}/\delta = K_{\max}T/b$")
    limit = style.line(r"its limit $g(d)$", style.DOTTED, 0.9)
    ax.legend(handles=[style.line(r"$\alpha_{\max}/\delta$"), limit], loc="upper right")


def _draw_limit(ax: Axes, paths: list[Any], models: list[Any], colors: dict[float, Any]) -> None:
    """g over the delay, with the delays of the paths marked."""
    for model in models:
        look = {"color": style.GRAY, "linestyle": style.dash_of(model), "zorder": 2}
        ax.plot(model.d, model.slope, label=f"g, {model.delay_model}", **look)
    for path in paths:
        ax.plot([path.d], [path.limit], "o", color=colors[path.d], markersize=5, zorder=3, clip_on=False)
    ax.set_xlim(0.0, max(float(model.d.max()) for model in models))
    ax.set_ylim(0.0, 1.04 * max(float(model.slope.max()) for model in models))
    ax.set(xlabel=r"delay  $d = t_d/T$", ylabel=r"limit slope  $g(d)$")
    if handles := style.delay_model_handles(models):
        ax.legend(handles=handles, loc="upper right")
