"""Figures of outputs over two parameters: regions with boundaries, contours of margins, ridge surfaces, workspaces.

A plane has two parameters of a sweep as axes; values of a third parameter have one panel each. Boundaries of regions
are drawn from exact outlines if the cells agree with them, otherwise as contours or along the cells. The boundary of
the stable walls is the contour 0 or 1 of a smooth output (margin, spectral radius), if the data contain one. A *ridge
surface* shows the stiffest stable wall over two parameters of the device; a *corner optimum* is such a wall at a corner
of the stability boundary.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from zwidth.core.errors import InputError
from zwidth.plotting import grid, stable_set, style
from zwidth.plotting.color_scale import choose_levels, choose_scale, find_colormap, make_norm
from zwidth.plotting.grid import MISSING, label_contours
from zwidth.plotting.stable_set import SHADES
from zwidth.plotting.table import Table, draws_tables
from zwidth.units.outputs import OUTPUTS, Output

if TYPE_CHECKING:
    import xarray

Edges: TypeAlias = "Callable[[xarray.Dataset], Mapping[str, stable_set.Outlines]]"
"""Returns the outlines of the "stable" and the "passive" walls of a panel in its units, stiffness first."""

# Outputs that have a contour along the boundary of the stable walls. This contour is smoother than that of the Boolean
# output "stable".
SMOOTH = ("margin", "spectral_radius")
# Smooth outputs that have a contour along the boundary of the region of each Boolean output.
_SMOOTH_OUTPUTS = {"stable": SMOOTH, "passive": ("passivity_margin",)}
# Outputs that are finite for stable walls only.
_FINITE_IF_STABLE = ("settling_time", "delay_margin")
# Names of the outputs with the stiffness and the damping of the stiffest stable wall, by the name of the stiffness.
_PEAKS = {"alpha": ("alpha_max", "beta_at_max"), "stiffness": ("stiffness_max", "virtual_damping_at_max")}
_FEW_TICKS = 1000.0  # ratio of largest to smallest value below which a color bar also has ticks at 2 and 5
_LABELLED = 0.1  # fraction of a panel that a region must fill for contour labels
# A number of poses per axis. If both axes have at least this number, colors are interpolated between the poses.
# Otherwise each pose is a cell of one color, and an axis with at most this number of poses has a tick at each pose.
_SMOOTH_GRID = 12
_SEEN = 0.003  # fraction of a panel that corner optima must fill for a legend entry
# Line style of boundaries, and style of the marker at the stiffest stable wall.
_EDGE: dict[str, Any] = {"color": style.BLACK, "linestyle": style.SOLID, "linewidth": 1.3, "zorder": 2.2}
_PEAK: dict[str, Any] = {"marker": "o", "markersize": 5, "markerfacecolor": "white", "markeredgecolor": style.BLACK}


class Panel(NamedTuple):
    """Content of one panel."""

    x: np.ndarray  # values along the x axis
    y: np.ndarray  # values along the y axis
    variables: Mapping[str, np.ma.MaskedArray]  # arrays over (y, x), masked if undecided
    outlines: Mapping[str, stable_set.Outlines]  # exact outlines of the "stable" and "passive" walls, x first
    peak: tuple[float, ...] = ()  # (x, y) of the stiffest stable wall if it lies within the axes


@draws_tables
def draw_plane(
    data: xarray.Dataset,
    name: str,
    axes: style.AnyAxes | None = None,
    *,
    x: str | None = None,
    y: str | None = None,
    col: str | None = None,
    edges: Edges | None = None,
) -> np.ndarray:
    """Draw an output of a sweep over two parameters, in panels for up to a few values of the other parameters.

    The outputs ``stable`` and ``passive`` are drawn as regions with their boundaries, ``passive`` over ``stable``.
    Other outputs are drawn as colors with labeled contours; a bold contour is the boundary of the stable or passive
    walls. The stiffest stable wall is marked if the data contain it. In a ridge surface, corner optima are hatched.

    Args:
        data: results of a sweep as returned by `zwidth.open_dataset`, or a part of them.
        name: the output.
        axes: existing Axes, one per panel; further panels are omitted.
        x: parameter along the x axis. Default: the stiffness, or the first parameter that varies.
        y: parameter along the y axis.
        col: parameter whose values have one panel each; all other parameters have their first value.
        edges: function that returns the exact outlines of the stable and the passive walls of a panel. If all cells
            agree with them, they replace contours and cell edges.

    Raises:
        InputError: if the output varies over fewer than two parameters.

    Returns:
        The Axes of the panels.
    """
    dims = grid.choose_axes(data, name, x, y, but=(col,))
    if len(dims) < 2:
        raise InputError(f"name: {name!r} varies over fewer than two parameters; choose another output")
    x, y = dims
    parts, columns = grid.panels(_add_peak(data, _select_drawn(data, name), x, y), dims, plane=dims, col=col)
    panels = panel_grid(axes, len(parts), columns)
    parts = [part.compute().transpose(y, x) for part in parts[: len(panels)]]
    shown = [read_panel(part, name, edges) for part in parts]
    grid.name_panels(panels, parts)
    style.label_axes(panels, grid.axis_label(parts[0], x), grid.axis_label(parts[0], y), once=axes is None)
    draw_panels(panels, shown, name, grid.output_label(parts[0], name), outside=axes is None)
    return panels


def read_panel(part: xarray.Dataset, name: str, edges: Edges | None) -> Panel:
    """Return the panel of a part (y, x) of a dataset."""
    up, across = map(str, part[name].dims)
    variables = {str(each): np.ma.masked_invalid(values.values) for each, values in part.items() if values.ndim}
    peak = {str(each).removesuffix("_peak"): float(values) for each, values in part.items() if not values.ndim}
    inside = all(part[dim].min() <= value <= part[dim].max() for dim, value in peak.items())
    # The first column of an outline is the stiffness. Swap the columns if the stiffness is not along x.
    step, outlines_of_part = -1 if across in ("beta", "virtual_damping") else 1, edges(part) if edges else {}
    outlines = {kind: [(points[:, ::step], hole) for points, hole in each] for kind, each in outlines_of_part.items()}
    axes = part[across].values, part[up].values
    return Panel(*axes, variables, outlines, tuple(peak.values()) if inside else ())


def _select_drawn(data: xarray.Dataset, name: str) -> xarray.Dataset:
    """Return a dataset of the output and of the variables drawn with it."""
    shown = ("stable", "passive") if name == "stable" else [each for each in _SMOOTH_OUTPUTS if each == name]
    smooth = [next((edge for edge in _SMOOTH_OUTPUTS[each] if edge in data), each) for each in shown]
    beside = [name, *shown, *smooth, *(["kind"] if OUTPUTS[name].family == "device" else [])]
    data = grid.prepare(data, [each for each in dict.fromkeys(beside) if each in data])
    if name in ("settling_time", "gain_margin", "delay_margin"):
        data[name] = data[name].where(np.isfinite(data[name]) & (data[name] > 0))
    return data


def _add_peak(data: xarray.Dataset, drawn: xarray.Dataset, x: str, y: str) -> xarray.Dataset:
    """Return the dataset ``drawn`` with the stiffest stable walls of ``data`` added, if the axes are K and B."""
    names = dict(zip((x, y), _PEAKS.get(x, ()), strict=False))
    if y not in ("beta", "virtual_damping") or not names or not all(name in data for name in names.values()):
        return drawn
    data = grid.in_order(data)
    peaks = {dim: data[name].squeeze().variable * drawn[dim].attrs["factor"] for dim, name in names.items()}
    return drawn.assign({f"{dim}_peak": peak for dim, peak in peaks.items()})


def boundary_level(name: str) -> float:
    """Return the level of an output whose contour is the boundary of the stable or passive walls."""
    return OUTPUTS[name].center if OUTPUTS[name].color_scale == "diverging" else 0.5


def panel_grid(given: style.AnyAxes | None, count: int, columns: int) -> np.ndarray:
    """Return ``count`` panels in columns with shared axes, or the given Axes."""
    columns = min(count, columns)
    rows = -(-count // columns)
    width, height = (5.9, 4.5) if count == 1 else (max(5.0, 0.9 + 2.5 * columns), 1.2 + 2.2 * rows)
    return style.panels(given, count, width, height, columns, sharex=True, sharey=True)


def draw_panels(axes: np.ndarray, panels: Sequence[Panel], name: str, label: str, *, outside: bool) -> None:
    """Draw an output into panels with a common color scale and a legend."""
    output = OUTPUTS[name]
    norm, image = make_norm(output, choose_scale(output, _collect_finite(panels, name))), None
    for ax, panel in zip(axes, panels, strict=True):
        ax.set_facecolor(MISSING)
        grid.scale_axis(ax, "x", panel.x)
        grid.scale_axis(ax, "y", panel.y)
        if output.color_scale == "truth":
            image = _draw_regions(ax, panel, name)
        else:
            shown = panel.variables[name]
            image = grid.draw_cells(ax, panel.x, panel.y, shown, cmap=find_colormap(output), norm=norm)
            if min(shown.shape) > 1 and shown.count():
                # Draw the boundary first, because contour labels must not be too close to it.
                others = draw_edge(ax, panel, name, **_EDGE) + ([np.array([panel.peak])] if panel.peak else [])
                draw_contours(ax, panel.x, panel.y, shown, output, norm, others)
            corner = np.ma.filled(panel.variables.get("kind", np.zeros(1)) == 1, False)
            if min(shown.shape) > 1 and corner.any():
                with matplotlib.rc_context({"hatch.linewidth": 0.5, "hatch.color": "#606060"}):
                    hatched: Any = {"levels": [0.5, 1.5], "colors": "none", "hatches": ["////"]}
                    ax.contourf(panel.x, panel.y, corner.astype(float), **hatched)
        if panel.peak:
            ax.plot(*panel.peak, linestyle="", zorder=5, clip_on=False, label="stiffest stable wall", **_PEAK)
    _add_legend(axes, panels, name, image, label, outside=outside)


def _draw_regions(ax: Axes, panel: Panel, name: str) -> Any:
    """Draw the stable and the passive walls as areas with their boundaries; return the image of the area drawn last."""
    image = None
    x, y, variables = panel.x, panel.y, panel.variables
    for each, dash in (("stable", style.SOLID), ("passive", style.DASH_DOTTED)):
        if each not in variables or (each != name and name != "stable"):
            continue
        shown = variables[each]
        edge = next((edge for edge in _SMOOTH_OUTPUTS[each] if edge in variables), each)
        smooth, level = variables[edge], boundary_level(edge)
        # If some cells have no value, draw cell by cell, because a filled contour would hide the gaps.
        whole = min(smooth.shape) > 1 and shown.count() == smooth.count() == shown.size
        outside = "white" if image is None else (0, 0, 0, 0)
        shades = ListedColormap([outside, outside if whole else SHADES[each]])
        image = grid.draw_cells(ax, x, y, shown, cmap=shades, vmin=0, vmax=1)
        outlines = panel.outlines.get(each) if whole else None
        look = {**_EDGE, "linestyle": dash}
        if not stable_set.draw_exact(ax, outlines, x, y, shown.data > 0.5, SHADES[each], **look):
            if whole and smooth.min() < level < smooth.max():
                ends = [-np.inf, level] if OUTPUTS[edge].below else [level, np.inf]
                ax.contourf(x, y, smooth, levels=ends, colors=[SHADES[each]])
            elif whole and np.all(shown):
                ax.set_facecolor(SHADES[each])
                image.set_cmap(ListedColormap([SHADES[each], SHADES[each]]))
            _draw_line(ax, panel, edge, look)
    return image


def _draw_line(ax: Axes, panel: Panel, name: str, look: Mapping[str, Any]) -> Any:
    """Draw the contour of an output at the boundary level; return it, or None if the values do not cross the level."""
    values, level = panel.variables[name], boundary_level(name)
    if min(values.shape) < 2 or not values.count() or not values.min() < level < values.max():
        return None
    plain: Any = {f"{key}s": [look[key]] for key in ("color", "linestyle", "linewidth")}
    return ax.contour(panel.x, panel.y, values, levels=[level], **plain)


def draw_contours(
    ax: Axes, x: np.ndarray, y: np.ndarray, values: Any, output: Output, norm: Any, others: Sequence[np.ndarray] = ()
) -> None:
    """Draw contours at round values, with labels that are not too close to the points of other lines."""
    levels = choose_levels(values, output, norm)
    if not levels.size:
        return
    # Draw contours light on dark colors and dark on light colors, so that they are visible.
    shades = find_colormap(output)(norm(levels))
    luminance = shades[:, :3] @ np.array([0.299, 0.587, 0.114])
    colors = [("white" if dark < 0.5 else "#303030") for dark in luminance]
    drawn = ax.contour(x, y, values, levels=levels, colors=colors, linewidths=0.7)
    within = (values < levels.max()) if output.below or output.color_scale == "steep" else (values > levels.min())
    if np.ma.filled(within, False).mean() > _LABELLED:
        label_contours(ax, drawn, colors, shades, others)


def draw_edge(ax: Axes, panel: Panel, name: str, **look: Any) -> list[np.ndarray]:
    """Draw the boundary of the stable or passive walls, exactly or as a contour; return its lines."""
    output, values, level = OUTPUTS[name], panel.variables[name], boundary_level(name)
    crossed = output.color_scale in ("diverging", "truth")
    if not crossed and name not in _FINITE_IF_STABLE:
        return []
    outlines = panel.outlines.get("passive" if name == "passivity_margin" else "stable")
    good = np.ma.filled(values < level if output.below else values > level, False)
    good = good if crossed else ~np.ma.getmaskarray(values)
    exact = stable_set.draw_exact(ax, outlines, panel.x, panel.y, good, **look)
    if exact:
        return [points for points, _ in exact]
    drawn = _draw_line(ax, panel, name, look) if crossed else None
    return drawn.get_paths()[0].to_polygons(closed_only=False) if drawn else []


def _collect_finite(panels: Sequence[Panel], name: str) -> np.ndarray:
    """Return the finite values of an output in all panels."""
    return np.concatenate([panel.variables[name].compressed() for panel in panels])


def _add_legend(axes: np.ndarray, panels: Sequence[Panel], name: str, image: Any, label: str, *, outside: bool) -> None:
    """Add a color bar, and a legend of all regions, lines and markers that the panels contain.

    Args:
        axes: Axes of the panels.
        panels: their contents.
        name: the output.
        image: colored image, for the color bar.
        label: label of the color bar.
        outside: place the legend outside of the Axes.
    """
    handles: list[Any] = []
    output, finite = OUTPUTS[name], _collect_finite(panels, name)
    if output.color_scale == "truth":
        for each, dash in (("stable", "-"), ("passive", "-.")):
            if each == name or each in panels[0].variables:
                edge: dict[str, Any] = {"edgecolor": style.BLACK, "linewidth": 0.8, "linestyle": dash}
                handles.append(Patch(facecolor=SHADES[each], label=each, **edge))
    else:
        extend = choose_scale(output, finite).extend
        bar = axes[0].figure.colorbar(image, ax=list(axes), label=label, extend=extend)
        if output.logarithmic:
            style.use_logarithmic(bar.ax, "y", (image.norm.vmin, image.norm.vmax), _FEW_TICKS)
        bar.ax.tick_params(labelsize=8)
    exact = any(line.get_label() == "exact boundary" for ax in axes for line in ax.lines)
    crossed = finite.size and finite.min() < output.center < finite.max()
    if crossed if output.color_scale == "diverging" else (exact and output.color_scale != "truth"):
        walls = "passive" if name == "passivity_margin" else "stable"
        handles.append(style.line(f"boundary of the {walls} walls", width=1.3, color=style.BLACK))
    if name in ("settling_time", "delay_margin"):
        handles.append(Patch(facecolor=MISSING, label="unstable"))
    elif any(np.ma.is_masked(panel.variables[name]) for panel in panels):
        handles.append(Patch(facecolor=MISSING, label="no result"))
    if any(np.mean(panel.variables["kind"] == 1) > _SEEN for panel in panels if "kind" in panel.variables):
        handles.append(Patch(facecolor="white", hatch="////", edgecolor="#606060", linewidth=0, label="corner optimum"))
    if any(panel.peak for panel in panels):
        handles.append(Line2D([], [], linestyle="", label="stiffest stable wall", **_PEAK))
    style.legend(axes, handles, outside=outside, ncols=len(handles))


@draws_tables
def draw_workspace(
    table: Table,
    across: str,
    up: str,
    axes: style.AnyAxes | None = None,
    *,
    names: tuple[tuple[str, str], tuple[str, str]] | None = None,
    quantity: str = r"maximum stable stiffness  $K_{\max}$",
    weakest_pose: str = "weakest pose",
) -> np.ndarray:
    """Draw the maximum stiffness over two coordinates of a device's pose, and mark the weakest pose.

    A fine grid of poses is drawn as a surface with contours, a coarse grid as cells, and other poses as dots. The
    weakest pose has the smallest maximum stiffness.

    Args:
        table: columns of a workspace study.
        across: column along the x axis.
        up: column along the y axis.
        axes: an existing Axes.
        names: name and unit of both coordinates; "" for no unit. By default the unit follows the last underscore of
            the column.
        quantity: label of the color bar, without the unit.
        weakest_pose: legend entry of the pose with the smallest stiffness.
    """
    (ax,) = panels = style.panels(axes, 1, 5.9, 4.3)
    # Use the last column whose name begins with "stiffness_", because the coordinates precede it and may have any name.
    wanted = [str(name) for name in table if str(name).startswith("stiffness_")][-1]
    x, y, stiffness = (np.asarray(table[name], float) for name in (across, up, wanted))
    factor, unit = style.si_unit(stiffness, "N/m")
    stiffness = np.ma.masked_invalid(stiffness)
    norm, weakest = LogNorm(factor * stiffness.min(), factor * stiffness.max()), int(stiffness.argmin())
    columns, rows = np.unique(x), np.unique(y)
    order = np.lexsort((x, y))
    shape = rows.size, columns.size
    grid = np.stack(np.meshgrid(columns, rows)).reshape(2, -1)
    if min(shape) > 1 and np.array_equal(np.stack([x, y])[:, order], grid):
        values = factor * stiffness[order].reshape(shape)
        # Draw a coarse grid as cells, because interpolation between very different colors yields colors that are not
        # in the color map. Also draw cells if some poses have no result, because a cell can be left blank.
        is_fine = min(shape) >= _SMOOTH_GRID
        shading = "gouraud" if is_fine and not np.ma.is_masked(stiffness) else "nearest"
        image = ax.pcolormesh(columns, rows, values, shading=shading, rasterized=True, norm=norm)
        if is_fine:
            marker = np.array([[x[weakest], y[weakest]]])
            draw_contours(ax, columns, rows, values, OUTPUTS["stiffness_max"], norm, [marker])
        else:
            few = {"xticks": columns, "yticks": rows}
            ax.set(**{name: ticks for name, ticks in few.items() if ticks.size <= _SMOOTH_GRID})
    else:
        image = ax.scatter(x, y, c=factor * stiffness, s=9.0, norm=norm, label="poses")
    ax.plot(x[weakest], y[weakest], linestyle="", label=weakest_pose, clip_on=False, zorder=5, **_PEAK)
    for axis, (name, unit_name) in zip("xy", names or map(_split_column, (across, up)), strict=True):
        ax.set(**{f"{axis}label": style.literal(name) + (f"  in {style.literal(unit_name)}" if unit_name else "")})
    bar = style.figure_of(panels).colorbar(image, ax=ax, label=f"{quantity}  in {unit}")
    style.use_logarithmic(bar.ax, "y", factor * stiffness)
    style.legend(panels, [style.line(weakest_pose, "", **_PEAK)], outside=axes is None)
    return panels


def _split_column(column: str) -> tuple[str, str]:
    """Split a column such as ``elbow_deg`` into name and unit."""
    name, _, unit = column.rpartition("_")
    return (name.replace("_", " "), unit) if name else (column, "")
