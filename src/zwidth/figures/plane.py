"""Outputs over two parameters: regions with their boundaries, contours of margins, ridge surfaces, workspaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize, TwoSlopeNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator

from zwidth.figures import grid, stable_set, style
from zwidth.figures.grid import MISSING, label_contours
from zwidth.figures.stable_set import SHADES
from zwidth.figures.table import Table, draws_tables
from zwidth.words.errors import InputError
from zwidth.words.quantities import OUTPUTS, Output

if TYPE_CHECKING:
    import xarray

# Gives the outlines of the "stable" and the "passive" walls of a panel, in its units and stiffness first.
Edges: TypeAlias = "Callable[[xarray.Dataset], Mapping[str, stable_set.Outlines]]"

# Numbers whose contour is the boundary of the stable walls, smoother than that of truth values.
SMOOTH = ("margin", "spectral_radius")
_SMOOTH = {"stable": SMOOTH, "passive": ("passivity_margin",)}
# What is finite for stable walls alone.
_FINITE_IF_STABLE = ("settling_time", "delay_margin")
# The stiffest stable wall in a plane of walls.
_PEAKS = {"alpha": ("alpha_max", "beta_at_max"), "stiffness": ("stiffness_max", "virtual_damping_at_max")}
# Beyond this multiple of the smallest, a output that grows without end has one color.
_STEEP = 100.0
LEAST_POSITIVE = 1e-300  # smallest value shown on a logarithmic scale
# A color bar of fewer decades than this has 2 and 5 between them.
_FEW_TICKS = 1000.0
# A region that fills less of its panel than this has no room for labels.
_LABELLED = 0.1
# Less than this cannot be seen.
_SEEN = 0.003
# The boundary where it is known.
_EDGE: dict[str, Any] = {"color": style.BLACK, "linestyle": style.SOLID, "linewidth": 1.3, "zorder": 2.2}
_PEAK: dict[str, Any] = {"marker": "o", "markersize": 5, "markerfacecolor": "white", "markeredgecolor": style.BLACK}


class ColorScale(NamedTuple):
    """Mapping of an output's values to colors; values outside [low, high] have the color of the nearer end."""

    colormap: str  # name in matplotlib
    low: float  # value of the first color
    high: float  # value of the last color
    logarithmic: bool
    extend: Literal["neither", "min", "max", "both"]  # ends of the color bar with an arrow, because values lie outside


class Panel(NamedTuple):
    """What one panel shows: variables over y and x, masked where they are not known, and exact outlines, x first."""

    x: np.ndarray
    y: np.ndarray
    variables: Mapping[str, np.ma.MaskedArray]
    outlines: Mapping[str, stable_set.Outlines]
    peak: tuple[float, ...] = ()  # the stiffest stable wall, where it is known and within the axes


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
    """Draw an output of a sweep over two parameters, a panel for each of some values of the others.

    Truth values are shown as regions within their boundary, ``passive`` over ``stable`` where both are known; numbers
    as colors under labelled contours, the edge of what is stable or passive as the bold one. The stiffest stable wall
    is marked where it is known; in a ridge surface, corner optima are hatched.

    Args:
        data: results of a sweep, as `zwidth.open_dataset` gives them, or a part of them.
        name: the output.
        axes: Axes of yours, one for each panel or fewer.
        x: the parameter from left to right; stiffness or the first that varies where left out.
        y: the one from bottom to top.
        col: the one of the panels; all others are then at their first value.
        edges: gives the exact outlines of the stable and the passive walls of a panel, which are drawn in place of
            contours and of the edges of cells where all cells agree with them.

    Raises:
        InputError: the output varies over less than two parameters.
    """
    dims = grid.choose_axes(data, name, x, y, but=(col,))
    if len(dims) < 2:
        raise InputError(f"name: {name!r} varies over less than two parameters, a plane needs them")
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
    """A part (y, x) of a dataset."""
    up, across = map(str, part[name].dims)
    variables = {str(each): np.ma.masked_invalid(values.values) for each, values in part.items() if values.ndim}
    peak = {str(each).removesuffix("_peak"): float(values) for each, values in part.items() if not values.ndim}
    inside = all(part[dim].min() <= value <= part[dim].max() for dim, value in peak.items())
    # Outlines have the stiffness first.
    turn, found = -1 if across in ("beta", "virtual_damping") else 1, edges(part) if edges else {}
    outlines = {kind: [(points[:, ::turn], hole) for points, hole in each] for kind, each in found.items()}
    axes = part[across].values, part[up].values
    return Panel(*axes, variables, outlines, tuple(peak.values()) if inside else ())


def _select_drawn(data: xarray.Dataset, name: str) -> xarray.Dataset:
    """The output, and what is drawn along with it."""
    shown = ("stable", "passive") if name == "stable" else [each for each in _SMOOTH if each == name]
    smooth = [next((edge for edge in _SMOOTH[each] if edge in data), each) for each in shown]
    beside = [name, *shown, *smooth, *(["kind"] if OUTPUTS[name].family == "device" else [])]
    data = grid.prepare(data, [each for each in dict.fromkeys(beside) if each in data])
    if name in ("settling_time", "gain_margin", "delay_margin"):
        data[name] = data[name].where(np.isfinite(data[name]) & (data[name] > 0))
    return data


def _add_peak(data: xarray.Dataset, drawn: xarray.Dataset, x: str, y: str) -> xarray.Dataset:
    """The stiffest stable wall of every panel, where the plane is one of walls."""
    names = dict(zip((x, y), _PEAKS.get(x, ()), strict=False))
    if y not in ("beta", "virtual_damping") or not names or not all(name in data for name in names.values()):
        return drawn
    data = grid.in_order(data)
    peaks = {dim: data[name].squeeze().variable * drawn[dim].attrs["factor"] for dim, name in names.items()}
    return drawn.assign({f"{dim}_peak": peak for dim, peak in peaks.items()})


def boundary_level(name: str) -> float:
    """The level at which the contour of an output is the boundary of what is stable or passive."""
    return OUTPUTS[name].center if OUTPUTS[name].look == "diverging" else 0.5


def panel_grid(given: style.AnyAxes | None, count: int, columns: int) -> np.ndarray:
    """So many panels in columns, which share their axes, or those that are given."""
    columns = min(count, columns)
    rows = -(-count // columns)
    width, height = (5.9, 4.5) if count == 1 else (max(5.0, 0.9 + 2.5 * columns), 1.2 + 2.2 * rows)
    return style.panels(given, count, width, height, columns, sharex=True, sharey=True)


def draw_panels(axes: np.ndarray, panels: Sequence[Panel], name: str, label: str, *, outside: bool) -> None:
    """Draw an output into panels, whose colors and axes mean the same, and explain it."""
    norm, image = _norm(panels, name), None
    for ax, panel in zip(axes, panels, strict=True):
        ax.set_facecolor(MISSING)
        grid.scale_axis(ax, "x", panel.x)
        grid.scale_axis(ax, "y", panel.y)
        if OUTPUTS[name].look == "truth":
            image = _draw_regions(ax, panel, name)
        else:
            shown = panel.variables[name]
            image = grid.draw_cells(ax, panel.x, panel.y, shown, cmap=_colors(OUTPUTS[name]), norm=norm)
            if min(shown.shape) > 1 and shown.count():
                # Labelled contours where the number is good, and the bold one at which it ceases to be.
                others = draw_edge(ax, panel, name, **_EDGE) + ([np.array([panel.peak])] if panel.peak else [])
                draw_contours(ax, panel.x, panel.y, shown, OUTPUTS[name], norm, others)
            corner = np.ma.filled(panel.variables.get("kind", np.zeros(1)) == 1, False)
            if min(shown.shape) > 1 and corner.any():
                with matplotlib.rc_context({"hatch.linewidth": 0.5, "hatch.color": "#606060"}):
                    hatched: Any = {"levels": [0.5, 1.5], "colors": "none", "hatches": ["////"]}
                    ax.contourf(panel.x, panel.y, corner.astype(float), **hatched)
        if panel.peak:
            ax.plot(*panel.peak, linestyle="", zorder=5, clip_on=False, label="stiffest stable wall", **_PEAK)
    _explain(axes, panels, name, image, label, outside=outside)


def _draw_regions(ax: Axes, panel: Panel, name: str) -> Any:
    """Stable and passive walls as areas, each with its boundary."""
    image = None
    x, y, variables = panel.x, panel.y, panel.variables
    for each, dash in (("stable", style.SOLID), ("passive", style.DASH_DOTTED)):
        if each not in variables or (each != name and name != "stable"):
            continue
        shown = variables[each]
        edge = next((edge for edge in _SMOOTH[each] if edge in variables), each)
        smooth, level = variables[edge], boundary_level(edge)
        # Where a part is missing, its cells are all that says where.
        whole = min(smooth.shape) > 1 and shown.count() == smooth.count() == shown.size
        outside = "white" if image is None else (0, 0, 0, 0)
        shades = ListedColormap([outside, outside if whole else SHADES[each]])
        image = grid.draw_cells(ax, x, y, shown, cmap=shades, vmin=0, vmax=1)
        known = panel.outlines.get(each) if whole else None
        look = {**_EDGE, "linestyle": dash}
        if not stable_set.draw_exact(ax, known, x, y, shown.data > 0.5, SHADES[each], **look):
            if whole and smooth.min() < level < smooth.max():
                ends = [-np.inf, level] if OUTPUTS[edge].below else [level, np.inf]
                ax.contourf(x, y, smooth, levels=ends, colors=[SHADES[each]])
            elif whole and np.all(shown):
                ax.set_facecolor(SHADES[each])
                image.set_cmap(ListedColormap([SHADES[each], SHADES[each]]))
            _draw_line(ax, panel, edge, look)
    return image


def _draw_line(ax: Axes, panel: Panel, name: str, look: Mapping[str, Any]) -> Any:
    """The boundary: the contour on which something changes, where the panel has one."""
    values, level = panel.variables[name], boundary_level(name)
    if min(values.shape) < 2 or not values.count() or not values.min() < level < values.max():
        return None
    plain: Any = {f"{key}s": [look[key]] for key in ("color", "linestyle", "linewidth")}
    return ax.contour(panel.x, panel.y, values, levels=[level], **plain)


def draw_contours(
    ax: Axes, x: np.ndarray, y: np.ndarray, values: Any, output: Output, norm: Any, others: Sequence[np.ndarray] = ()
) -> None:
    """Labelled contours of an output at round numbers; labels keep away from the points of other lines."""
    levels = _levels(values, output, norm)
    if not levels.size:
        return
    # Over a dark color a light line, over a light one a dark line.
    shades = _colors(output)(norm(levels))
    luminance = shades[:, :3] @ np.array([0.299, 0.587, 0.114])
    colors = [("white" if dark < 0.5 else "#303030") for dark in luminance]
    drawn = ax.contour(x, y, values, levels=levels, colors=colors, linewidths=0.7)
    within = (values < levels.max()) if output.below or output.look == "steep" else (values > levels.min())
    if np.ma.filled(within, False).mean() > _LABELLED:
        label_contours(ax, drawn, colors, shades, others)


def draw_edge(ax: Axes, panel: Panel, name: str, **look: Any) -> list[np.ndarray]:
    """The edge of what is stable or passive, exactly where it is known, or as a contour; returns its lines."""
    output, values, level = OUTPUTS[name], panel.variables[name], boundary_level(name)
    crossed = output.look in ("diverging", "truth")
    if not crossed and name not in _FINITE_IF_STABLE:
        return []
    known = panel.outlines.get("passive" if name == "passivity_margin" else "stable")
    good = np.ma.filled(values < level if output.below else values > level, False)
    good = good if crossed else ~np.ma.getmaskarray(values)
    exact = stable_set.draw_exact(ax, known, panel.x, panel.y, good, **look)
    if exact:
        return [points for points, _ in exact]
    drawn = _draw_line(ax, panel, name, look) if crossed else None
    return drawn.get_paths()[0].to_polygons(closed_only=False) if drawn else []


def _levels(values: Any, output: Output, norm: Any) -> np.ndarray:
    """Round numbers at which contours are drawn."""
    low, high = float(values.min()), float(values.max())
    if output.logarithmic:
        # Short of where a steep number rises without end, but not of the values where these are close together.
        end = min(high, max(norm.vmax / 2.0, (low * high) ** 0.5)) if output.look == "steep" else high
        levels = np.asarray(LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, end))
        levels = levels[levels <= end]
    elif output.look == "diverging":
        ends = (low, output.center) if output.below else (output.center, high)
        levels = np.asarray(MaxNLocator(6).tick_values(*ends)) if ends[0] < ends[1] else np.empty(0)
        levels = levels[levels != output.center]
        levels = levels[(levels < output.center) == output.below]
    else:
        levels = np.asarray(MaxNLocator(8).tick_values(low, high))
    return levels[(levels > low) & (levels < high)]


def _colors(output: Output) -> Any:
    return matplotlib.colormaps[_name_colormap(output)]


def _name_colormap(output: Output) -> str:
    if output.look == "diverging":
        return "PuOr_r" if output.below else "PuOr"
    return "viridis_r" if output.look == "steep" else "viridis"


def choose_scale(output: Output, finite: np.ndarray) -> ColorScale:
    """Choose the color scale of an output from its finite values, for figures and reports."""
    finite = finite[finite >= LEAST_POSITIVE] if output.logarithmic else finite
    least, most = _range(finite) or ((1.0, 10.0) if output.logarithmic else (0.0, 1.0))
    if output.look == "diverging":
        # Both sides get the range of the favorable side, if it has values; values beyond it share one color.
        sides = [output.center - least, most - output.center]
        good, bad = sides if output.below else reversed(sides)
        span = max(good if good > 0 else bad, 1e-6)
        low, high = output.center - span, output.center + span
    elif output.logarithmic:
        low, high = least, min(most, _STEEP * least) if output.look == "steep" else most
        high = max(high, 1.001 * low)
    else:
        low, high = least, most if most > least else least + 1.0
    beyond: Any = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    return ColorScale(_name_colormap(output), low, high, output.logarithmic, beyond[least < low, most > high])


def _finite(panels: Sequence[Panel], name: str) -> np.ndarray:
    return np.concatenate([panel.variables[name].compressed() for panel in panels])


def _norm(panels: Sequence[Panel], name: str) -> Any:
    output = OUTPUTS[name]
    scale = choose_scale(output, _finite(panels, name))
    if output.look == "diverging":
        return TwoSlopeNorm(output.center, scale.low, scale.high)
    return (LogNorm if scale.logarithmic else Normalize)(scale.low, scale.high)


def _range(finite: np.ndarray) -> tuple[float, float] | None:
    return (float(finite.min()), float(finite.max())) if finite.size else None


def _explain(axes: np.ndarray, panels: Sequence[Panel], name: str, image: Any, label: str, *, outside: bool) -> None:
    handles: list[Any] = []
    output, ends = OUTPUTS[name], _range(finite := _finite(panels, name))
    if output.look == "truth":
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
    exact = any(line.get_label() == "exact edge" for ax in axes for line in ax.lines)
    crossed = ends is not None and ends[0] < output.center < ends[1]
    if crossed if output.look == "diverging" else (exact and output.look != "truth"):
        what = "passive" if name == "passivity_margin" else "stable"
        handles.append(style.line(f"edge of what is {what}", width=1.3, color=style.BLACK))
    if name in ("settling_time", "delay_margin"):
        handles.append(Patch(facecolor=MISSING, label="unstable"))
    elif any(np.ma.is_masked(panel.variables[name]) for panel in panels):
        handles.append(Patch(facecolor=MISSING, label="no answer"))
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
) -> np.ndarray:
    """Draw the stiffest stable wall over two coordinates of a device's pose, the weakest pose marked.

    Poses on a grid are a surface with contours, others dots.

    Args:
        table: columns of a workspace study.
        across: the column from left to right.
        up: the one from bottom to top.
        axes: an Axes of yours.
        names: name and unit of both, "" of no unit; where left out, a column's unit is behind its last underscore.
    """
    (ax,) = panels = style.panels(axes, 1, 5.9, 4.3)
    # Behind the coordinates, which may be called anything.
    wanted = [str(name) for name in table if str(name).startswith("stiffness_")][-1]
    x, y, stiffness = (np.asarray(table[name], float) for name in (across, up, wanted))
    factor, unit = style.si_unit(stiffness, "N/m")
    # A pose without an answer stays empty, which no smooth shading can show.
    stiffness = np.ma.masked_invalid(stiffness)
    shading = "nearest" if np.ma.is_masked(stiffness) else "gouraud"
    norm, weakest = LogNorm(factor * stiffness.min(), factor * stiffness.max()), int(stiffness.argmin())
    columns, rows = np.unique(x), np.unique(y)
    order = np.lexsort((x, y))
    shape = rows.size, columns.size
    grid = np.stack(np.meshgrid(columns, rows)).reshape(2, -1)
    if min(shape) > 1 and np.array_equal(np.stack([x, y])[:, order], grid):
        values = factor * stiffness[order].reshape(shape)
        image = ax.pcolormesh(columns, rows, values, shading=shading, rasterized=True, norm=norm)
        draw_contours(ax, columns, rows, values, OUTPUTS["stiffness_max"], norm, [np.array([[x[weakest], y[weakest]]])])
    else:
        image = ax.scatter(x, y, c=factor * stiffness, s=9.0, norm=norm, label="poses")
    ax.plot(x[weakest], y[weakest], linestyle="", label="weakest pose", clip_on=False, zorder=5, **_PEAK)
    for which, (name, own) in zip("xy", names or map(_split_column, (across, up)), strict=True):
        ax.set(**{f"{which}label": style.literal(name) + (f"  in {style.literal(own)}" if own else "")})
    label = rf"maximum stable stiffness  $K_{{\max}}$  in {unit}"
    bar = style.figure_of(panels).colorbar(image, ax=ax, label=label)
    style.use_logarithmic(bar.ax, "y", factor * stiffness)
    style.legend(panels, [style.line("weakest pose", "", **_PEAK)], outside=axes is None)
    return panels


def _split_column(column: str) -> tuple[str, str]:
    """The name of a column and its unit, as it is likely to be written."""
    name, _, unit = column.rpartition("_")
    return (name.replace("_", " "), unit) if name else (column, "")
