"""Draw normalized figures of the paper: (alpha, beta) planes (Figs. 5, 7, 8), and walls over delta (Figs. 6, 9, 10).

alpha and beta are the normalized stiffness and damping of the wall, delta the normalized physical damping of the
device, d its delay in sampling periods, and alpha_max the largest stable alpha. g(d) is the limit of alpha_max/delta
for large delta. The *delay model* is "held" (exact fractional delay) or "fractional_power" (the paper's z^d). The
*curves* of a table are groups of rows with equal delay (`plotting.table`), with the columns as attributes. In an
(alpha, beta) plane, the boundary of the stable walls is parameterized by omega, the angle of the pole on the unit
circle, and the *path of maximum stiffness* (ridge) consists of the stiffest walls for all delta.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D

from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.plotting import grid, style
from zwidth.plotting.plane import Panel, draw_panels, panel_grid
from zwidth.plotting.stable_set import Outlines, draw_zeros, mark_wall, shade_region
from zwidth.plotting.table import Table, curves, draws_tables, grid_in_order, select, si_scale
from zwidth.units.formatting import round_conservatively
from zwidth.units.outputs import OUTPUTS

_ZOOM = 0.1  # fraction of the range of delta that the enlarged panel of Fig. 10 shows
_MIN_DELTA = 0.1  # smallest delta for which alpha_max/delta is drawn; below, alpha_max itself is nearly constant


def _list_curves(table: Table, **wanted: object) -> list[Any]:
    """Return the curves of a table over delta, one per delay and, if the table has this column, per delay model.

    ``wanted`` selects the rows with the given values, by column.
    """
    models = ("delay_model",) if "delay_model" in table else ()
    return curves(table, "d", *models, over="delta", **wanted)


@draws_tables
def draw_zero_stiffness(table: Table, ax: Axes | None = None) -> Axes:
    """Draw over delta the interval of virtual damping beta that is stable for alpha -> 0, and shade it.

    Solid lines are for exact delays, dashed ones for the paper's fractional power, dash-dotted ones for the passivity
    condition. The lower bound ``beta = -delta`` is the same for all delays.

    Args:
        table: Columns of a boundary study in the plane delta_beta: curve, d, delta, beta_lower, beta_upper; or of a
            study of kind paper_fig6, which also has delay_model ("held" or "fractional_power").
        ax: An existing Axes; the function returns one, not an array of them.
    """
    ax = ax or style.panels(None, 1, 5.4, 4.1)[0]
    assert ax is not None
    stable, passive = _list_curves(table, curve="stable"), curves(table, "d", over="delta", curve="passive")
    colors = style.color_by_value([interval.d for interval in stable])
    for interval in stable:
        if style.is_exact(interval):
            _shade(ax, interval, colors[interval.d], zorder=1)
        _draw_curve(ax, interval, interval.delta, interval.beta_upper, colors, "beta_upper")
    look = {"color": style.VERMILION, "linestyle": style.DASH_DOTTED, "linewidth": 1.3, "zorder": 4}
    for interval in passive:
        _shade(ax, interval, style.VERMILION)
        for name in ("beta_lower", "beta_upper"):
            ax.plot(interval.delta, getattr(interval, name), label=f"passive {name}, d = {interval.d:g}", **look)
    # Draw only one lower bound, because beta = -delta is the lower bound for all delays.
    lower, middle = stable[0].beta_lower, int(0.55 * stable[0].delta.size)
    ax.plot(stable[0].delta, lower, color=style.BLACK, label="beta_lower", zorder=2.5)
    text = r"$\beta = -\delta$ for every $d$" if len(colors) > 1 else r"$\beta = -\delta$"
    place = stable[0].delta[middle], lower[middle]
    ax.annotate(text, place, xytext=(8, 6), textcoords="offset points", fontsize=8)
    grid.scale_axis(ax, "x", np.unique(np.concatenate([interval.delta for interval in stable])))
    values = np.concatenate([np.r_[interval.beta_lower, interval.beta_upper] for interval in stable])
    ax.set_ylim(*style.span(float(values.min()), float(values.max())))
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    style.label_ends(ax, stable, [interval.beta_upper[-1] for interval in stable], colors)
    ax.set(title=r"$\alpha \to 0$", xlabel=style.label_quantity("delta"), ylabel=style.label_quantity("beta"))
    handles = style.delay_model_handles(stable)
    if passive:
        handles.append(style.line("passivity condition", style.DASH_DOTTED, 1.3, style.VERMILION))
    style.legend([ax], handles, outside=False, loc="upper left")
    return ax


def _draw_curve(ax: Axes, curve: Any, x: Any, y: Any, colors: dict[float, Any], words: str, **look: Any) -> None:
    """Draw the curve of a delay in its color, dashed for the fractional power; a single point becomes a dot.

    Args:
        ax: Axes to draw into.
        curve: Curve of a table, with the attribute ``d`` and optionally ``delay_model``.
        x: Horizontal coordinates.
        y: Vertical coordinates.
        colors: Color of each delay.
        words: Name of the quantity in the label of the line.
        look: Further properties of the line.
    """
    look |= {"marker": "o", "clip_on": False} if np.size(x) == 1 else {}
    label = ", ".join([f"{words}, d = {curve.d:g}", *([curve.delay_model] if hasattr(curve, "delay_model") else [])])
    dash = style.SOLID if style.is_exact(curve) else style.DASHED
    ax.plot(x, y, label=label, **{"color": colors[curve.d], "linestyle": dash, "zorder": 3, **look})


def _shade(ax: Axes, interval: Any, color: Any, **keywords: Any) -> None:
    """Shade the interval of beta over delta between the columns beta_lower and beta_upper of a curve."""
    look = {"color": color, "alpha": 0.08, "linewidth": 0.0, **keywords}
    ax.fill_between(interval.delta, interval.beta_lower, interval.beta_upper, **look)


@draws_tables
def draw_ridge(table: Table, axes: style.AnyAxes | None = None, *, two_scalings: bool = False) -> np.ndarray:
    """Draw alpha_max over delta, one curve per delay; for each alpha below a curve some wall is stable.

    Args:
        table: Columns of a ridge study: d, delta, alpha_max; or of a study of kind paper_fig10, which also has
            delay_model ("held" or "fractional_power").
        axes: An existing Axes; or two Axes if there are two scalings, that of the small deltas first.
        two_scalings: Show small deltas, if the table contains any, in a separate enlarged panel, as the paper does.
    """
    delta = np.asarray(table["delta"])
    two_scalings = bool(two_scalings and delta.min() <= _ZOOM * delta.max())
    width, height = (style.WIDTH, 3.6) if two_scalings else (5.4, 4.1)
    panels = style.panels(axes, 1 + two_scalings, width, height, columns=1 + two_scalings)
    for panel, share in zip(panels, (_ZOOM, 1.0)[-len(panels) :], strict=True):
        _draw_scaling(panel, table, share)
    style.letter(panels)
    for panel in panels[1:]:
        panel.set_ylabel("")
    return panels


def _draw_scaling(ax: Axes, table: Table, share: float) -> None:
    """Draw the curves of alpha_max up to the fraction ``share`` of the largest delta."""
    delta = np.asarray(table["delta"])
    end = share * float(delta.max())
    columns = {name: column[delta <= end * (1.0 + 1e-12)] for name, column in select(table).items()}
    shown = _list_curves(columns)
    colors = style.color_by_value([path.d for path in shown])
    for path in shown:
        _draw_curve(ax, path, path.delta, path.alpha_max, colors, "alpha_max")
        if style.is_exact(path):
            ax.fill_between(path.delta, 0.0, path.alpha_max, color=colors[path.d], alpha=0.07, linewidth=0.0, zorder=1)
    if columns["delta"].min() < end:
        ax.set_xlim(float(columns["delta"].min()), end)
    if grid.logarithmic(shown[0].delta):
        style.use_logarithmic(ax, "x", columns["delta"])
    _scale_stiffness(ax, shown[0].delta, columns["alpha_max"])
    style.label_ends(ax, shown, [path.alpha_max[-1] for path in shown], colors)
    ax.set(xlabel=style.label_quantity("delta"), ylabel=style.label_quantity("alpha_max"))
    style.legend([ax], style.delay_model_handles(shown), outside=False, loc="upper left")


def _scale_stiffness(ax: Axes, delta: np.ndarray, stiffness: np.ndarray) -> None:
    """Set the range of the stiffness axis from 0; make the axis logarithmic if delta is spaced logarithmically."""
    highest = float(np.nanmax(stiffness))
    ax.set_ylim(0.0, 1.04 * highest)
    if grid.logarithmic(delta):
        style.use_logarithmic(ax, "y", stiffness)
        ax.set_ylim(float(np.nanmin(stiffness)), 1.2 * highest)


@draws_tables
def draw_slope(table: Table, slopes: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw alpha_max/delta over delta with its limit g(d) for large delta, and g over the delay d.

    Args:
        table: Columns of a ridge study: d, delta, alpha_max. If it is the table of a study of kind paper_fig10, only
            its curves for the exact delay are drawn.
        slopes: Columns d and slope, the limit g(d), over a range of delays that includes those of ``table``.
        axes: An existing Axes for the first panel only, or two.
    """
    panels = style.panels(axes, 2, style.WIDTH, 3.6, 2, gridspec_kw={"width_ratios": [1.15, 1.0]})
    paths, limits = list(filter(style.is_exact, _list_curves(table))), select(slopes)
    colors = style.color_by_value([path.d for path in paths])
    for path in paths:
        path.limit = float(limits["slope"][limits["d"] == path.d][0])
    _draw_ratio(panels[0], paths, colors)
    for ax in panels[1:]:
        _draw_limit(ax, paths, limits["d"], limits["slope"], colors)
    style.letter(panels)
    return panels


def _draw_ratio(ax: Axes, paths: list[Any], colors: dict[float, Any]) -> None:
    """Draw alpha_max/delta over delta on logarithmic axes, with dotted lines at its limits g(d) for large delta."""
    for path in paths:
        shown = path.delta >= _MIN_DELTA
        delta = path.delta[shown]
        _draw_curve(ax, path, delta, path.alpha_max[shown] / delta, colors, "alpha_max/delta")
        look = {"color": colors[path.d], "linestyle": style.DOTTED, "linewidth": 0.9, "zorder": 2}
        ax.axhline(path.limit, label=f"g, d = {path.d:g}", **look)
    limits = [path.limit for path in paths]
    ends = _MIN_DELTA, max(float(path.delta.max()) for path in paths)
    style.use_logarithmic(ax, "x", ends)
    style.use_logarithmic(ax, "y", limits)
    ax.set_xlim(*ends)
    ax.set_ylim(0.7 * min(limits), 3.0 * max(limits))
    style.label_ends(ax, paths, [path.limit for path in paths], colors)
    ax.set(xlabel=style.label_quantity("delta"), ylabel=r"$\alpha_{\max}/\delta = K_{\max}T/b$")
    limit = style.line(r"its limit $g(d)$", style.DOTTED, 0.9)
    ax.legend(handles=[style.line(r"$\alpha_{\max}/\delta$"), limit], loc="upper right")


def _draw_limit(ax: Axes, paths: list[Any], d: np.ndarray, slope: np.ndarray, colors: dict[float, Any]) -> None:
    """Draw the limit g over the delay d.

    Args:
        ax: Axes to draw into.
        paths: Curves of alpha_max over delta, whose delays are marked by dots.
        d: Delays.
        slope: g at these delays.
        colors: Color of each delay in ``paths``.
    """
    ax.plot(d, slope, label="g", color=style.GRAY, zorder=2)
    for path in paths:
        ax.plot([path.d], [path.limit], "o", color=colors[path.d], markersize=5, zorder=3, clip_on=False)
    ax.set_xlim(0.0, float(d.max()))
    ax.set_ylim(0.0, 1.04 * float(slope.max()))
    ax.set(xlabel=r"delay  $d = t_d/T$", ylabel=r"limit slope  $g(d)$")


@draws_tables
def draw_passivity_cost(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stiffest stable (solid) and the stiffest passive wall (dash-dotted) over delta, and their ratio.

    Args:
        table: Columns of a passivity study: d, delta, alpha_max, alpha_max_passive.
        axes: An existing Axes for the two maxima only, or two.
    """
    panels = style.panels(axes, 2, style.WIDTH, 3.6, 2)
    costs = curves(table, "d", over="delta")
    colors = style.color_by_value([cost.d for cost in costs])
    maxima, *shares = panels
    for cost in costs:
        best, passive = cost.alpha_max, cost.alpha_max_passive
        _draw_curve(maxima, cost, cost.delta, best, colors, "alpha_max")
        _draw_curve(maxima, cost, cost.delta, passive, colors, "alpha_max_passive", linestyle=style.DASH_DOTTED)
        maxima.fill_between(cost.delta, passive, best, color=colors[cost.d], alpha=0.12, linewidth=0.0, zorder=1)
        for ax in shares:
            _draw_curve(ax, cost, cost.delta, 100.0 * passive / best, colors, "passive share")
    every = np.concatenate([[*cost.alpha_max, *cost.alpha_max_passive] for cost in costs])
    _scale_stiffness(maxima, costs[0].delta, every)
    style.label_ends(maxima, costs, [cost.alpha_max[-1] for cost in costs], colors)
    maxima.set_ylabel(style.label_quantity("alpha"))
    stable = style.line(r"stiffest stable wall, $\alpha_{\max}$")
    # Place the legend where it does not cover data: a single point is in the middle of the panel; curves rise to the
    # right.
    place = "upper left" if costs[0].delta.size > 1 else "center left"
    maxima.legend(handles=[stable, style.line("stiffest passive wall", style.DASH_DOTTED)], loc=place)
    for ax in shares:
        ax.set(ylim=(0.0, 100.0), ylabel=r"stiffest passive wall in % of $\alpha_{\max}$")
        style.label_ends(ax, costs, [100.0 * cost.alpha_max_passive[-1] / cost.alpha_max[-1] for cost in costs], colors)
    for ax in panels:
        grid.scale_axis(ax, "x", np.unique(table["delta"]))
        ax.set_xlabel(style.label_quantity("delta"))
    style.letter(panels)
    return panels


_MAX_LEGEND_ENTRIES = 8  # largest number of deltas in a legend; for more deltas a color bar is easier to read
# Largest number of deltas, and of delays, in a grid of panels. If there are more, evenly spaced ones are drawn.
_MAX_PANELS = 3


@draws_tables
def draw_boundary(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw stability boundaries in (alpha, beta) planes, one panel per delay, with the stable side shaded.

    On solid lines a complex pair of poles is on the unit circle, on dotted lines a real pole is at z = -1. A dashed
    line is the path of maximum stiffness, a dash-dotted one the passivity condition.

    Args:
        table: Columns of a boundary study: curve, d, delta, omega in rad per sample, alpha, beta; with
            stiffness_N_per_m and virtual_damping_N_s_per_m, the panels also have axes in SI units.
        axes: An existing Axes for all delays together, or one per delay.

    Raises:
        InputError: Several Axes are given, but not one per delay.
    """
    edges = curves(table, "d", "delta", curve="boundary")
    delays, colors = sorted({edge.d for edge in edges}), style.color_by_value([edge.delta for edge in edges])
    scale = si_scale(table)
    if len(delays) == 1:
        wide = scale is not None
        panels = style.panels(axes, 1, 5.0 + 0.6 * wide, 3.6 + 0.4 * wide)
    else:
        columns = 2 if len(delays) <= 4 else 3
        panels = style.panels(axes, len(delays), style.WIDTH, 2.4 * -(-len(delays) // columns) + 0.7, columns)
    one_per_delay = len(panels) == len(delays)
    if not one_per_delay and len(panels) > 1:
        raise InputError(f"axes: got {len(panels)} for {len(delays)} delays; pass one for all, or one for each")
    for panel, d in zip(panels, delays, strict=False):
        _draw_boundaries(panel, select(table, d=d) if one_per_delay else select(table), colors, scale)
        if one_per_delay:
            panel.set_title(f"$d = {d:g}$")
    style.label_axes(panels, style.label_quantity("alpha"), style.label_quantity("beta"), once=axes is None)
    if scale is not None:
        for panel in panels:
            style.add_si_axes(panel, scale)
    handles = _legend_handles(table, colors if len(colors) <= _MAX_LEGEND_ENTRIES else {})
    if len(colors) > _MAX_LEGEND_ENTRIES:
        bar = ScalarMappable(Normalize(min(colors), max(colors)), ListedColormap(list(colors.values())))
        panels[0].figure.colorbar(bar, ax=list(panels), label=style.label_quantity("delta"))
    style.legend(panels, handles, outside=axes is None and len(panels) > 1, ncols=min(6, len(handles)))
    return panels


def _draw_boundaries(ax: Axes, table: Table, colors: dict[float, Any], scale: tuple[float, float] | None) -> None:
    """Draw all boundaries, paths of maximum stiffness and passivity conditions of a table into one Axes.

    Args:
        ax: Axes to draw into.
        table: Columns of a boundary study.
        colors: Color of each delta.
        scale: K at alpha = 1 and B at beta = 1, in SI units; None if unknown.
    """
    edges = curves(table, "d", "delta", curve="boundary")
    # Draw the largest region, that of the largest delta, first, so that it does not hide the others.
    shade = min(0.10, 0.7 / len(edges))
    for edge in sorted(edges, key=lambda edge: -edge.delta):
        _draw_edge(ax, edge, colors[edge.delta], shade)
    for path in curves(table, "d", curve="ridge_path"):
        look = {"color": style.BLACK, "linestyle": style.DASHED, "linewidth": 1.1, "zorder": 4}
        ax.plot(path.alpha, path.beta, label=f"path of alpha_max, d = {path.d:g}", **look)
    for passive in curves(table, "d", "delta", curve="passive"):
        color = colors.get(passive.delta, style.BLACK)
        look = {"color": color, "linestyle": style.DASH_DOTTED, "linewidth": 1.2, "zorder": 3}
        ax.plot(passive.alpha, passive.beta, label=f"passive, delta = {passive.delta:g}, d = {passive.d:g}", **look)
    if len(edges) == 1:
        _mark_maximum(ax, edges[0], scale)
    draw_zeros(ax)
    low, high = style.span(0.0, max(float(edge.alpha.max()) for edge in edges), 0.06)
    ax.set_xlim(0.4 * low, high)
    betas = np.concatenate([edge.beta for edge in edges])
    ax.set_ylim(*style.span(float(betas.min()), float(betas.max()), 0.06))


def _draw_edge(ax: Axes, edge: Any, color: Any, shade: float) -> None:
    """Draw a stability boundary with the shaded region inside.

    The part with a real pole at z = -1, a straight line, is dotted.

    Args:
        ax: Axes to draw into.
        edge: Boundary, with the attributes omega, alpha, beta, delta and d.
        color: Color of the boundary and of the region.
        shade: Opacity of the region.
    """
    shade_region(ax, [(np.stack([edge.alpha, edge.beta], -1), False)], color, alpha=shade)
    line = np.flatnonzero(edge.omega >= np.pi)
    curve = slice(None) if line.size < 2 else slice(0, line[0] + 1)
    device = f"delta = {edge.delta:g}, d = {edge.d:g}"
    look: dict[str, Any] = {"color": color, "zorder": 3}
    ax.plot(edge.alpha[curve], edge.beta[curve], label=f"boundary, {device}", **look)
    if line.size >= 2:
        look |= {"linestyle": style.DOTTED, "linewidth": 1.9, "dash_capstyle": "butt"}
        ax.plot(edge.alpha[line], edge.beta[line], label=f"z = -1, {device}", **look)


def _mark_maximum(ax: Axes, edge: Any, scale: tuple[float, float] | None) -> None:
    """Mark the stiffest wall of a stability boundary with a dot, and write alpha_max inside the region.

    ``scale`` contains K at alpha = 1, by which the text also states K_max in SI units; None if unknown.
    """
    top = int(np.argmax(edge.alpha))
    place = (edge.alpha[top], edge.beta[top])
    text = rf"$\alpha_{{\max}} = {round_conservatively(place[0], 'below'):.4g}$"
    if scale is not None:
        factor, unit = style.si_unit(place[0] * scale[0], "N/m")
        text += "\n" + rf"$K_{{\max}} = {round_conservatively(place[0] * scale[0] * factor, 'below'):.4g}$ {unit}"
    mark_wall(ax, place, "alpha_max", kind="stiffest", text=text)


def _legend_handles(table: Table, colors: dict[float, Any]) -> list[Line2D]:
    """Return legend entries for the color of each delta, and for the line styles of the curves in a table."""
    edges = curves(table, "d", "delta", curve="boundary")
    handles = [style.line(rf"$\delta = {delta:g}$", color=color) for delta, color in colors.items()]
    if any(np.count_nonzero(edge.omega >= np.pi) >= 2 for edge in edges):
        handles.append(style.line("real pole at $z = -1$", style.DOTTED, 1.9))
    kinds = np.asarray(table["curve"])
    if "ridge_path" in kinds:
        handles.append(style.line(r"path of $\alpha_{\max}$", style.DASHED, 1.1, style.BLACK))
    if "passive" in kinds:
        handles.append(style.line("passivity condition", style.DASH_DOTTED, 1.2))
    return handles


@draws_tables
def draw_map(
    arrays: Mapping[str, np.ndarray],
    output: str,
    axes: style.AnyAxes | None = None,
    *,
    edges: Callable[[float, float], Outlines | None] = lambda delta, d: None,
) -> np.ndarray:
    """Draw one output over alpha and beta, with columns of panels for up to three deltas and rows for up to three d.

    Args:
        arrays: Arrays of the npz file of a map study: alpha, beta, delta, d, and the output and its status over these;
            with stiffness_N_per_m and virtual_damping_N_s_per_m, a single panel also has axes in SI units.
        output: "stable", "spectral_radius" or "passive".
        axes: An existing Axes for the first delta and d only, or one per panel.
        edges: Function of delta and d that returns the exact boundary of the stable walls, or of the passive walls if
            the output is "passive"; None if there is none. A boundary is drawn in place of the edges of the cells if
            all cells agree with it.
    """
    scale = si_scale(arrays)
    arrays = grid_in_order(arrays, ("alpha", "beta", "delta", "d"))
    delta, d = arrays["delta"], arrays["d"]
    rows, columns = style.pick_evenly(d.size, _MAX_PANELS), style.pick_evenly(delta.size, _MAX_PANELS)
    cells = list(product(rows, columns))
    panels = panel_grid(axes, len(cells), len(columns))
    computed = arrays["status"] == Status.OK if "status" in arrays else np.isfinite(arrays[output])
    values = np.ma.masked_array(arrays[output].astype(float), ~computed)
    shown = []
    for ax, (row, column) in zip(panels, cells, strict=False):
        exact = edges(float(delta[column]), float(d[row]))
        outlines = {} if exact is None else {"passive" if output == "passive" else "stable": exact}
        shown.append(Panel(arrays["alpha"], arrays["beta"], {output: values[:, :, column, row].T}, outlines))
        ax.set_title(rf"$\delta = {delta[column]:g}$,  $d = {d[row]:g}$")
    style.label_axes(panels, style.label_quantity("alpha"), style.label_quantity("beta"), once=axes is None)
    draw_panels(panels, shown, output, rf"{OUTPUTS[output].words}  ${OUTPUTS[output].symbol}$", outside=axes is None)
    if len(cells) == 1 and scale is not None:
        style.add_si_axes(panels[0], scale)
    return panels
