"""The (alpha, beta) plane: stability boundaries (Figs. 5, 7 and 8), and maps of an output."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.plane import Panel, draw_panels, panel_grid
from zwidth.figures.stable_set import Outlines, draw_zeros, mark_wall, shade_region
from zwidth.figures.table import Table, curves, draws_tables, select, si_scale
from zwidth.words.errors import InputError
from zwidth.words.formatting import round_safely
from zwidth.words.quantities import OUTPUTS
from zwidth.words.status import Status

# A legend of more entries than this is harder to read than a color bar.
_LEGEND_ENTRIES = 8
# A grid of more panels than this says nothing on a page: evenly spaced deltas and delays stand for all.
_PANELS = 3


@draws_tables
def draw_boundary(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw stability boundaries, one panel for every delay, with the stable side shaded.

    Solid: a complex pair of poles crosses the unit circle; dotted: a real pole at z = -1; dashed: the path of maximum
    stiffness; dash-dotted: the passivity condition.

    Args:
        table: columns of a boundary study: curve, d, delta, delay_model, omega in radians a period, alpha, beta; with
            stiffness_N_per_m and virtual_damping_N_s_per_m the axes are in SI units as well.
        axes: an Axes of yours for all delays together, or one for each delay.

    Raises:
        InputError: several Axes, but not one for each delay.
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
    apart = len(panels) == len(delays)
    if not apart and len(panels) > 1:
        raise InputError(f"axes: got {len(panels)} for {len(delays)} delays; give one for all, or one for each")
    for panel, d in zip(panels, delays, strict=False):
        _draw_boundaries(panel, select(table, d=d) if apart else select(table), colors, scale)
        if apart:
            panel.set_title(f"$d = {d:g}$")
    style.label_axes(panels, style.ALPHA_LABEL, style.BETA_LABEL, once=axes is None)
    if scale is not None:
        for panel in panels:
            style.add_si_axes(panel, scale)
    handles = _legend_handles(table, colors if len(colors) <= _LEGEND_ENTRIES else {})
    if len(colors) > _LEGEND_ENTRIES:
        bar = ScalarMappable(Normalize(min(colors), max(colors)), ListedColormap(list(colors.values())))
        panels[0].figure.colorbar(bar, ax=list(panels), label=style.DELTA_LABEL)
    style.legend(panels, handles, outside=axes is None and len(panels) > 1, ncols=min(6, len(handles)))
    return panels


def _draw_boundaries(ax: Axes, table: Table, colors: dict[float, Any], scale: tuple[float, float] | None) -> None:
    """Draw all of a table into one Axes, without labels."""
    edges = curves(table, "d", "delta", "delay_model", curve="boundary")
    # From the largest region to the smallest, so that none hides another.
    shade = min(0.10, 0.7 / len(edges))
    for edge in sorted(edges, key=lambda edge: -edge.delta):
        _draw_edge(ax, edge, colors[edge.delta], shade)
    for path in curves(table, "d", "delay_model", curve="ridge_path"):
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
    """The shaded region, its curve, and the straight part where a real pole is at z = -1."""
    shade_region(ax, [(np.stack([edge.alpha, edge.beta], -1), False)], color, alpha=shade)
    line = np.flatnonzero(edge.omega >= np.pi)
    curve = slice(None) if line.size < 2 else slice(0, line[0] + 1)
    device = f"delta = {edge.delta:g}, d = {edge.d:g}"
    look: dict[str, Any] = {"color": color, "zorder": 3}
    ax.plot(edge.alpha[curve], edge.beta[curve], linestyle=style.dash_of(edge), label=f"boundary, {device}", **look)
    if line.size >= 2:
        look |= {"linestyle": style.DOTTED, "linewidth": 1.9, "dash_capstyle": "butt"}
        ax.plot(edge.alpha[line], edge.beta[line], label=f"z = -1, {device}", **look)


def _mark_maximum(ax: Axes, edge: Any, scale: tuple[float, float] | None) -> None:
    """A dot at the stiffest stable wall, labelled inside the region."""
    top = int(np.argmax(edge.alpha))
    place = (edge.alpha[top], edge.beta[top])
    text = rf"$\alpha_{{\max}} = {round_safely(place[0], 'below'):.4g}$"
    if scale is not None:
        factor, unit = style.si_unit(place[0] * scale[0], "N/m")
        text += "\n" + rf"$K_{{\max}} = {round_safely(place[0] * scale[0] * factor, 'below'):.4g}$ {unit}"
    mark_wall(ax, place, "alpha_max", kind="stiffest", text=text)


def _legend_handles(table: Table, colors: dict[float, Any]) -> list[Line2D]:
    """What the colors and the line styles of the drawn curves mean."""
    edges = curves(table, "d", "delta", "delay_model", curve="boundary")
    handles = [style.line(rf"$\delta = {delta:g}$", color=color) for delta, color in colors.items()]
    handles += style.delay_model_handles(edges)
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
    """Draw one output over alpha and beta: panels for delta (columns) and d (rows), three of each at most.

    Args:
        arrays: what the npz file of a map study holds: alpha, beta, delta, d, and the output and its status along
            these; with stiffness_N_per_m and virtual_damping_N_s_per_m a single panel is in SI units as well.
        output: "stable", "spectral_radius" or "passive".
        axes: an Axes of yours for the first delta and d alone, or one for each panel.
        edges: gives the exact edge of what is stable, or for "passive" passive, at a delta and d, drawn in place of
            that of the cells where all cells agree with it.
    """
    delta, d = arrays["delta"], arrays["d"]
    rows, columns = style.pick_evenly(d.size, _PANELS), style.pick_evenly(delta.size, _PANELS)
    places = list(product(rows, columns))
    panels = panel_grid(axes, len(places), len(columns))
    known = arrays["status"] == Status.OK if "status" in arrays else np.isfinite(arrays[output])
    values = np.ma.masked_array(arrays[output].astype(float), ~known)
    shown = []
    for ax, (row, column) in zip(panels, places, strict=False):
        exact = edges(float(delta[column]), float(d[row]))
        outlines = {} if exact is None else {"passive" if output == "passive" else "stable": exact}
        shown.append(Panel(arrays["alpha"], arrays["beta"], {output: values[:, :, column, row].T}, outlines))
        ax.set_title(rf"$\delta = {delta[column]:g}$,  $d = {d[row]:g}$")
    style.label_axes(panels, style.ALPHA_LABEL, style.BETA_LABEL, once=axes is None)
    draw_panels(panels, shown, output, rf"{OUTPUTS[output].words}  ${OUTPUTS[output].symbol}$", outside=axes is None)
    if len(places) == 1 and (scale := si_scale(arrays)) is not None:
        style.add_si_axes(panels[0], scale)
    return panels
