"""Figs. 6 and 9: stability boundaries in the (delta, beta) plane for alpha -> 0."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.data import DampingInterval, ZeroStiffnessData


def draw_zero_stiffness(data: ZeroStiffnessData, ax: Axes | None = None) -> Figure:
    """Draw the virtual damping that is stable for alpha -> 0 over delta, with the stable side shaded.

    Solid: held delay; dashed: the fractional power; dash-dotted: the passivity condition. The lower bound
    ``beta = -delta`` is common to all delays.

    Args:
        data: the stable and the passive intervals of beta.
        ax: draw into this Axes instead of a new figure.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is None:
            _, axes = style.new_figure(5.4, 4.1)
            ax = axes[0, 0]
        assert ax is not None
        colors = style.color_by_value([interval.d for interval in data.stable])
        for interval in data.stable:
            _draw_interval(ax, interval, colors[interval.d])
        for interval in data.passive:
            _draw_passive(ax, interval)
        _draw_lower_bound(ax, data)
        deltas = np.concatenate([interval.delta for interval in data.stable])
        ax.set_xlim(float(deltas.min()), float(deltas.max()))
        values = np.concatenate([np.r_[interval.beta_lower, interval.beta_upper] for interval in data.stable])
        ax.set_ylim(*style.span(float(values.min()), float(values.max())))
        ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
        _label_curves(ax, data.stable, colors)
        ax.set_title(r"$\alpha \to 0$")
        ax.set_xlabel(style.DELTA_LABEL)
        ax.set_ylabel(style.BETA_LABEL)
        handles = _legend_handles(data)
        if handles:
            ax.legend(handles=handles, loc="upper left")
        return style.figure_of(ax)


def _draw_interval(ax: Axes, interval: DampingInterval, color: object) -> None:
    held = interval.delay_model == "held"
    if held:
        ax.fill_between(
            interval.delta, interval.beta_lower, interval.beta_upper, color=color, alpha=0.08, linewidth=0.0, zorder=1
        )
    label = f"beta_upper, d = {interval.d:g}, {interval.delay_model}"
    dash = style.SOLID if held else style.DASHED
    ax.plot(interval.delta, interval.beta_upper, color=color, linestyle=dash, label=label, zorder=3)


def _draw_lower_bound(ax: Axes, data: ZeroStiffnessData) -> None:
    """One line for all delays, where they agree."""
    first = data.stable[0]
    ax.plot(first.delta, first.beta_lower, color=style.BLACK, label="beta_lower", zorder=2.5)
    middle = int(0.55 * first.delta.size)
    several = len({interval.d for interval in data.stable}) > 1
    ax.annotate(
        r"$\beta = -\delta$ for every $d$" if several else r"$\beta = -\delta$",
        (first.delta[middle], first.beta_lower[middle]),
        xytext=(8, 6),
        textcoords="offset points",
        fontsize=8,
    )


def _draw_passive(ax: Axes, interval: DampingInterval) -> None:
    ax.fill_between(
        interval.delta, interval.beta_lower, interval.beta_upper, color=style.VERMILION, alpha=0.08, linewidth=0.0
    )
    for name, values in (("beta_lower", interval.beta_lower), ("beta_upper", interval.beta_upper)):
        label = f"passive {name}, d = {interval.d:g}"
        ax.plot(
            interval.delta,
            values,
            color=style.VERMILION,
            linestyle=style.DASH_DOTTED,
            linewidth=1.3,
            label=label,
            zorder=4,
        )


def _label_curves(ax: Axes, intervals: tuple[DampingInterval, ...], colors: dict[float, object]) -> None:
    """Name the delay of each curve at its right end; the two models of one delay share a name."""
    solid = [interval for interval in intervals if interval.delay_model == "held"] or list(intervals)
    names = [f"$d = {interval.d:g}$" for interval in solid]
    ends = [float(interval.beta_upper[-1]) for interval in solid]
    style.label_ends(ax, names, ends, [colors[interval.d] for interval in solid])


def _legend_handles(data: ZeroStiffnessData) -> list[Line2D]:
    handles = []
    if any(interval.delay_model == "fractional_power" for interval in data.stable):
        handles = style.delay_model_handles()
    if data.passive:
        label = "passivity condition"
        handles.append(Line2D([], [], color=style.VERMILION, linestyle=style.DASH_DOTTED, linewidth=1.3, label=label))
    return handles
