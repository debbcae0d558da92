"""Eq. (22): how fast maximum stiffness grows with damping, once the damping is strong."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from zwidth.figures import style
from zwidth.figures.data import SlopeData

# Below, alpha_max hardly depends on delta and the ratio says nothing.
_LEAST_DELTA = 0.1


def draw_slope(data: SlopeData, ax: Axes | None = None) -> Figure:
    """Draw alpha_max/delta over delta beside its limit g(d), and g over the delay.

    Args:
        data: paths of maximum stiffness with their limits, and g over a range of delays.
        ax: draw the first of the two panels alone, into this Axes.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is not None:
            _draw_ratio(ax, data)
            return style.figure_of(ax)
        figure, axes = style.new_figure(style.WIDTH, 3.6, 1, 2, gridspec_kw={"width_ratios": [1.15, 1.0]})
        _draw_ratio(axes[0, 0], data)
        _draw_limit(axes[0, 1], data)
        axes[0, 0].set_title("(a)")
        axes[0, 1].set_title("(b)")
        return figure


def _draw_ratio(ax: Axes, data: SlopeData) -> None:
    """alpha_max/delta on logarithmic axes, the limits dotted across."""
    colors = style.color_by_value([path.d for path in data.paths])
    drawn = [path.delta >= _LEAST_DELTA for path in data.paths]
    for path, limit, shown in zip(data.paths, data.limits, drawn, strict=True):
        held = path.delay_model == "held"
        color, dash = colors[path.d], style.SOLID if held else style.DASHED
        label = f"alpha_max/delta, d = {path.d:g}, {path.delay_model}"
        delta = path.delta[shown]
        ax.plot(delta, path.alpha_max[shown] / delta, color=color, linestyle=dash, label=label, zorder=3)
        ax.axhline(limit, color=color, linestyle=style.DOTTED, linewidth=0.9, label=f"g, d = {path.d:g}", zorder=2)
    ax.set_xscale("log")
    ax.set_yscale("log")
    largest = max(float(path.delta.max()) for path in data.paths)
    ax.set_xlim(_LEAST_DELTA, largest)
    ax.set_ylim(0.7 * min(data.limits), 3.0 * max(data.limits))
    # Ticks as plain numbers: the axis spans a decade or two.
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())
    _label_limits(ax, data, colors)
    ax.set_xlabel(style.DELTA_LABEL)
    ax.set_ylabel(r"$\alpha_{\max}/\delta = K_{\max}T/b$")
    handles = [
        Line2D([], [], color=style.GRAY, label=r"$\alpha_{\max}/\delta$"),
        Line2D([], [], color=style.GRAY, linestyle=style.DOTTED, linewidth=0.9, label=r"its limit $g(d)$"),
    ]
    ax.legend(handles=handles, loc="upper right")


def _label_limits(ax: Axes, data: SlopeData, colors: dict[float, object]) -> None:
    """The delay of each curve to the right of its end, on an axis whose heights are logarithms."""
    low, high = np.log(ax.get_ylim())
    heights = [(float(np.log(limit)) - low) / (high - low) for limit in data.limits]
    named: dict[float, float] = {}
    # Where both models are drawn the held one, which comes first, is named.
    for path, height in sorted(zip(data.paths, heights, strict=True), key=lambda pair: pair[0].delay_model != "held"):
        named.setdefault(path.d, height)
    places = style.spread(list(named.values()), 0.05)
    for d, place in zip(named, places, strict=True):
        at = (1.015, float(place))
        ax.annotate(
            f"$d = {d:g}$",
            at,
            xycoords="axes fraction",
            color=colors[d],  # pyright: ignore[reportArgumentType]  (any color of matplotlib)
            fontsize=8,
            va="center",
            annotation_clip=False,
        )


def _draw_limit(ax: Axes, data: SlopeData) -> None:
    """g over the delay, with the delays of the paths marked."""
    for curve in data.curves:
        dash = style.SOLID if curve.delay_model == "held" else style.DASHED
        ax.plot(curve.d, curve.slope, color=style.GRAY, linestyle=dash, label=f"g, {curve.delay_model}", zorder=2)
    colors = style.color_by_value([path.d for path in data.paths])
    for path, limit in zip(data.paths, data.limits, strict=True):
        ax.plot([path.d], [limit], "o", color=colors[path.d], markersize=5, zorder=3, clip_on=False)
    longest = max(float(curve.d.max()) for curve in data.curves)
    ax.set_xlim(0.0, longest)
    ax.set_ylim(0.0, 1.04 * max(float(curve.slope.max()) for curve in data.curves))
    ax.set_xlabel(r"delay  $d = t_d/T$")
    ax.set_ylabel(r"limit slope  $g(d)$")
    if len(data.curves) > 1:
        ax.legend(handles=style.delay_model_handles(), loc="upper right")
