"""Draw outputs of a sweep over one parameter, and stability boundaries of many devices in one panel.

A *panel* is one Axes of a figure. The *family* of curves in a panel has one curve per value of a further parameter.
*Edges* are the exact boundaries of the stable walls (`plotting.plane`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.core.errors import InputError
from zwidth.plotting import grid, style
from zwidth.plotting.plane import SMOOTH, Edges, draw_edge, panel_grid, read_panel
from zwidth.plotting.table import draws_tables
from zwidth.units.outputs import OUTPUTS
from zwidth.units.quantities import VARIABLES, WALL

if TYPE_CHECKING:
    import xarray

_LEGEND_LETTERS = 56  # number of letters that fit into one row of the legend
_MAX_CURVES = 9  # largest number of curves per panel that can be distinguished; more are thinned evenly


@draws_tables
def draw_curves(
    data: xarray.Dataset,
    name: str,
    axes: style.AnyAxes | None = None,
    *,
    x: str | None = None,
    hue: str | None = None,
    col: str | None = None,
) -> np.ndarray:
    """Draw an output of a sweep over one parameter, with curves for the values of another and panels for a third one.

    Args:
        data: Results of a sweep as returned by `zwidth.open_dataset`, or a part of them.
        name: Name of an output with numeric values.
        axes: Existing Axes, at most one per panel.
        x: Parameter of the horizontal axis; by default, of the first two parameters that vary the one with more values.
        hue: Parameter of the family of curves.
        col: Parameter with one panel per value. If it is set, all parameters other than these three have their first
            value.
    """
    output, data = OUTPUTS[name], grid.prepare(data, [name])
    dims = grid.choose_axes(data, name, x, but=(hue, col))
    dims = dims if x else sorted(dims, key=lambda dim: -data.sizes[dim])
    if not dims:
        raise InputError(f"name: {name!r} varies over no parameter; choose another output, or a larger part")
    x, others = dims[0], [dim for dim in reversed(grid.list_varied(data, name)) if dim not in (*dims, col)]
    several = [hue] if hue else [*dims[1:], *others][:1]
    parts, columns = grid.panels(data, [x, *several], col=col)
    panels = panel_grid(axes, len(parts), columns)
    picked = style.pick_evenly(data.sizes[several[0]], _MAX_CURVES) if several else [0]
    labels = [grid.spell(data[several[0]][k]) for k in picked] if several else [""]
    looks = _list_looks(several[0] if several else "", len(picked))
    few, whole_numbers = data.sizes[x] <= 12, x in VARIABLES and VARIABLES[x].whole
    whole = np.concatenate([part[name].values.ravel() for part in parts])
    for part, ax in zip(parts, panels, strict=False):
        curves = [part.isel({several[0]: k}) for k in picked] if several else [part]
        values_of_curves = np.stack([curve[name].values for curve in curves])
        # On a logarithmic axis, leave out values that are not positive, such as delay margins of unstable walls.
        shown = np.where(
            np.isfinite(values_of_curves) & ((values_of_curves > 0) | (not output.logarithmic)),
            values_of_curves,
            np.nan,
        )
        for values, label, look in zip(shown, labels, looks, strict=True):
            dots = style.POINTS if whole_numbers else {"marker": "o" if few else "", "markersize": 3.5}
            ax.plot(data[x].values, values, label=label, **look | dots)
        grid.scale_axis(ax, "x", data[x])
        if whole_numbers:
            style.use_whole(ax)
        ax.margins(y=0.06)
        if output.logarithmic:
            # Choose the ticks from the values of all panels, because the panels share the axis.
            style.use_logarithmic(ax, "y", whole)
        if output.color_scale == "diverging":
            ax.axhline(output.center, color=style.GRAY, linewidth=0.7, linestyle=style.DASHED, zorder=0.5)
    values = data[x].values
    if few and not grid.logarithmic(values):
        panels[0].set_xlim(*style.span(float(values.min()), float(values.max())))
    grid.name_panels(panels, parts)
    style.label_axes(panels, grid.axis_label(data, x), grid.output_label(data, name), once=axes is None)
    _add_legend(panels, labels, looks, outside=axes is None)
    return panels


def find_family(data: xarray.Dataset) -> tuple[str, str] | None:
    """Return the output whose contours are the stability boundaries of several devices, and the parameter that varies.

    The contours are drawn over stiffness and damping. Return None if the data do not contain several devices.
    """
    planes = {name: grid.choose_axes(data, name) for name in (*SMOOTH, "stable") if name in data}
    name = next((name for name, axes in planes.items() if len(axes) == 2 and axes[1] in WALL), None)
    dims = [dim for dim in grid.list_varied(data, name) if dim not in WALL] if name else []
    first = next((dim for dim in ("delta", "damping", *reversed(dims)) if dim in dims), None)
    return (name, first) if name and first else None


@draws_tables
def draw_outlines(data: xarray.Dataset, axes: style.AnyAxes | None = None, *, edges: Edges | None = None) -> np.ndarray:
    """Draw families of stability boundaries, one curve per device, with one panel per value of a further parameter.

    Args:
        data: Results of a sweep over walls and devices as returned by `zwidth.open_dataset`, or a part of them.
        axes: Existing Axes, at most one per panel.
        edges: Function that returns the exact outlines of the stable walls; they replace contours that agree with them.
    """
    name_and_family = find_family(data)
    if name_and_family is None:
        raise InputError("data: contains no boundaries of several devices; pass a sweep over walls and devices")
    name, family = name_and_family
    data = grid.prepare(data, [name])
    x, y = dims = grid.choose_axes(data, name)
    parts, columns = grid.panels(data, [family, *dims], plane=dims)
    panels = panel_grid(axes, len(parts), columns)
    picked = style.pick_evenly(data.sizes[family], _MAX_CURVES)
    looks = _list_looks(family, len(picked))
    labels = [grid.spell(data[family][k]) for k in picked]
    for part, ax in zip(parts, panels, strict=False):
        grid.scale_axis(ax, "x", part[x])
        grid.scale_axis(ax, "y", part[y])
        for k, look in zip(picked, looks, strict=True):
            device = part.isel({family: k}).transpose(y, x)
            draw_edge(ax, read_panel(device, name, edges), name, linewidth=1.4, **look)
        ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    grid.name_panels(panels, parts)
    style.label_axes(panels, grid.axis_label(data, x), grid.axis_label(data, y), once=axes is None)
    _add_legend(panels, labels, looks, outside=axes is None, title="boundaries of the stable walls")
    return panels


def _list_looks(family: str, count: int) -> list[dict[str, Any]]:
    """Return a list with the color and line style of each of ``count`` curves.

    The colors of curves are ordered by the value of the parameter ``family``. Devices have no order; their curves
    differ in color and in line style.
    """
    if family == "device":
        return [style.look(k) for k in range(count)]
    return [{"color": color, "linestyle": style.SOLID} for color in style.ordered_colors(count)]


def _add_legend(
    axes: np.ndarray, names: list[str], looks: list[dict[str, Any]], *, outside: bool, title: str | None = None
) -> None:
    """Add a legend of the curves.

    Args:
        axes: The panels.
        names: Name of each curve; curves with an empty name get no entry.
        looks: Color and line style of each curve.
        outside: Place the legend above the panels instead of in the first one.
        title: Title of the legend.
    """
    longest = max(10 if "$" in name else len(name) for name in names)
    columns = max(1, min(len(names), 6, _LEGEND_LETTERS // max(longest, 1)))
    handles = [
        style.line(name, look["linestyle"], color=look["color"])
        for name, look in zip(names, looks, strict=True)
        if name
    ]
    style.legend(axes, handles, outside=outside, ncols=columns, title=title, title_fontsize=8)
