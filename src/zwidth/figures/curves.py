"""Outputs of a sweep over one parameter, and boundaries of many devices in one panel."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from zwidth.figures import style
from zwidth.figures.plane import label_outside, panel_grid, scale_axis
from zwidth.figures.sweep_data import CurvesData, PlaneData, Quantity

# Characters of names that fit beside each other above the panels.
_LINE = 56


def draw_curves(data: CurvesData, quantity: Quantity) -> Figure:
    """Draw one quantity over one parameter, a curve for each value of another one, panels for a third.

    Args:
        data: axis, curves and panels.
        quantity: which of the fields.

    Returns:
        A new figure, unknown to pyplot.
    """
    with style.house_style():
        figure, axes = panel_grid(len(data.panels), data.columns)
        colors = style.ordered_colors(len(data.names))
        few = data.x.values.size <= 12
        for panel, ax in zip(data.panels, axes, strict=True):
            for values, name, color in zip(panel.fields[quantity.name], data.names, colors, strict=True):
                shown = np.where(np.isfinite(values), values, np.nan)
                ax.plot(data.x.values, shown, color=color, marker="o" if few else "", markersize=3.5, label=name)
            scale_axis(ax, "x", data.x)
            ax.set_title(panel.title)
            ax.margins(y=0.06)
            if quantity.look in ("logarithmic", "steep"):
                ax.set_yscale("log")
                ax.yaxis.set_major_locator(LogLocator(subs=_decade(panel.fields[quantity.name])))
                ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                ax.yaxis.set_minor_formatter(NullFormatter())
            if quantity.look == "diverging":
                ax.axhline(quantity.center, color=style.GRAY, linewidth=0.7, linestyle=style.DASHED, zorder=0.5)
        if few and not data.x.logarithmic:
            axes[0].set_xlim(*style.span(float(data.x.values.min()), float(data.x.values.max())))
        label_outside(figure, axes, data.x.label, quantity.label)
        _name(figure, data.names, colors)
        return figure


def draw_outlines(data: PlaneData, field: str, level: float, names: tuple[str, ...], label: str) -> Figure:
    """Draw the boundaries of many devices into one panel: the contour of a field at a level, one a device.

    Args:
        data: the plane; a panel holds ``field`` in the shape (devices, y, x).
        field: truth values, or a number whose ``level`` is the boundary.
        level: where the boundary is.
        names: of the devices, in their order.
        label: what is inside.

    Returns:
        A new figure, unknown to pyplot.
    """
    with style.house_style():
        figure, axes = panel_grid(len(data.panels), data.columns)
        colors = style.ordered_colors(len(names))
        for panel, ax in zip(data.panels, axes, strict=True):
            for values, color in zip(panel.fields[field], colors, strict=True):
                _draw_outline(ax, data, values, level, color)
            ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
            scale_axis(ax, "x", data.x)
            scale_axis(ax, "y", data.y)
            ax.set_title(panel.title)
        label_outside(figure, axes, data.x.label, data.y.label)
        _name(figure, names, colors, label)
        return figure


def _draw_outline(ax: Axes, data: PlaneData, values: np.ndarray, level: float, color: Any) -> None:
    shown = np.ma.masked_invalid(values.astype(float))
    if shown.count() and shown.min() < level < shown.max():
        ax.contour(data.x.values, data.y.values, shown, levels=[level], colors=[color], linewidths=1.4)


def _decade(values: np.ndarray) -> tuple[float, ...]:
    """Which multiples of a power of ten are labelled: the fewer, the more powers there are."""
    positive = values[np.isfinite(values) & (values > 0)]
    return (1.0, 2.0, 5.0) if positive.size and positive.max() < 100 * positive.min() else (1.0,)


def _name(figure: Figure, names: tuple[str, ...], colors: list[Any], title: str = "") -> None:
    """Which color is which."""
    if not any(names):
        return
    handles = [Line2D([], [], color=color, label=name) for name, color in zip(names, colors, strict=True)]
    longest = max(10 if "$" in name else len(name) for name in names)
    columns = max(1, min(len(names), 6, _LINE // longest))
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, title=title or None, title_fontsize=8)
