"""Figs. 5, 7 and 8: stability boundaries in the (alpha, beta) plane."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.data import BoundaryData, Outline, PassiveOutline, RidgePath, SIScale

# A legend of more entries than this is harder to read than a color bar.
_LEGEND_ENTRIES = 8


def draw_boundary(data: BoundaryData, ax: Axes | None = None) -> Figure:
    """Draw stability boundaries, one panel for every delay, with the stable side shaded.

    Solid: a complex pair of poles crosses the unit circle; dotted: a real pole at z = -1; dashed: the path of maximum
    stiffness; dash-dotted: the passivity condition.

    Args:
        data: outlines and what is drawn beside them.
        ax: draw everything into this Axes instead, whatever the delay.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        colors = style.color_by_value([outline.delta for outline in data.outlines])
        if ax is not None:
            draw_panel(ax, data, colors)
            ax.legend(handles=_legend_handles(data, colors))
            return style.figure_of(ax)
        delays = sorted({outline.d for outline in data.outlines})
        figure, axes = _panels(len(delays), data.si is not None)
        for panel, d in zip(axes, delays, strict=True):
            draw_panel(panel, _of_delay(data, d), colors)
            panel.set_title(f"$d = {d:g}$")
            if len(delays) > 1:
                panel.set(xlabel="", ylabel="")
        if len(delays) > 1:
            figure.supxlabel(style.ALPHA_LABEL, fontsize=9.0)
            figure.supylabel(style.BETA_LABEL, fontsize=9.0)
        _explain(figure, axes, data, colors)
        return figure


def _panels(count: int, wide: bool) -> tuple[Figure, list[Axes]]:
    """As many panels as there are delays; those left over in the last row are removed."""
    if count == 1:
        figure, axes = style.new_figure(5.0 + 0.6 * wide, 3.6 + 0.4 * wide)
        return figure, [axes[0, 0]]
    columns = 2 if count <= 4 else 3
    rows = math.ceil(count / columns)
    figure, axes = style.new_figure(style.WIDTH, 2.4 * rows + 0.7, rows, columns)
    for unused in axes.flat[count:]:
        unused.remove()
    return figure, list(axes.flat[:count])


def _of_delay(data: BoundaryData, d: float) -> BoundaryData:
    return BoundaryData(
        tuple(outline for outline in data.outlines if outline.d == d),
        tuple(path for path in data.ridge_paths if path.d == d),
        tuple(passive for passive in data.passive if passive.d == d),
        data.si,
    )


def draw_panel(ax: Axes, data: BoundaryData, colors: dict[float, Any]) -> None:
    """Draw all of ``data`` into one Axes, with its labels but without a legend."""
    # From the largest region to the smallest, so that none hides another.
    shade = min(0.10, 0.7 / max(len(data.outlines), 1))
    for outline in sorted(data.outlines, key=lambda outline: -outline.delta):
        _draw_outline(ax, outline, colors[outline.delta], shade)
    for path in data.ridge_paths:
        _draw_ridge_path(ax, path)
    for passive in data.passive:
        _draw_passive(ax, passive, colors.get(passive.delta, style.BLACK))
    if len(data.outlines) == 1:
        _mark_maximum(ax, data.outlines[0], data.si)
    ax.axvline(0.0, color=style.GRAY, linewidth=0.6, zorder=0.5)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.4, zorder=0.5)
    low, high = style.span(0.0, max(float(outline.alpha.max()) for outline in data.outlines), 0.06)
    ax.set_xlim(0.4 * low, high)
    betas = np.concatenate([outline.beta for outline in data.outlines])
    ax.set_ylim(*style.span(float(betas.min()), float(betas.max()), 0.06))
    ax.set_xlabel(style.ALPHA_LABEL)
    ax.set_ylabel(style.BETA_LABEL)
    if data.si is not None:
        style.add_si_axes(ax, data.si)


def _draw_outline(ax: Axes, outline: Outline, color: Any, shade: float) -> None:
    """The shaded region, its curve, and the straight part where a real pole is at z = -1."""
    ax.fill(outline.alpha, outline.beta, facecolor=color, alpha=shade, linewidth=0.0, zorder=1)
    dash = style.SOLID if outline.delay_model == "held" else style.DASHED
    line = np.flatnonzero(outline.omega >= np.pi)
    curve = slice(None) if line.size < 2 else slice(0, line[0] + 1)
    label = f"boundary, delta = {outline.delta:g}, d = {outline.d:g}"
    ax.plot(outline.alpha[curve], outline.beta[curve], color=color, linestyle=dash, label=label, zorder=3)
    if line.size >= 2:
        label = f"z = -1, delta = {outline.delta:g}, d = {outline.d:g}"
        ax.plot(
            outline.alpha[line],
            outline.beta[line],
            color=color,
            linestyle=style.DOTTED,
            linewidth=1.9,
            dash_capstyle="butt",
            label=label,
            zorder=3,
        )


def _draw_ridge_path(ax: Axes, path: RidgePath) -> None:
    label = f"path of alpha_max, d = {path.d:g}"
    ax.plot(path.alpha_max, path.beta, color=style.BLACK, linestyle=style.DASHED, linewidth=1.1, label=label, zorder=4)


def _draw_passive(ax: Axes, passive: PassiveOutline, color: Any) -> None:
    label = f"passive, delta = {passive.delta:g}, d = {passive.d:g}"
    ax.plot(passive.alpha, passive.beta, color=color, linestyle=style.DASH_DOTTED, linewidth=1.2, label=label, zorder=3)


def _mark_maximum(ax: Axes, outline: Outline, si: SIScale | None) -> None:
    """A dot at the stiffest stable wall, labelled inside the region."""
    top = int(np.argmax(outline.alpha))
    place = (outline.alpha[top], outline.beta[top])
    ax.plot(*place, "o", color=style.BLACK, markersize=4.0, label="alpha_max", zorder=5, clip_on=False)
    text = rf"$\alpha_{{\max}} = {place[0]:.4g}$"
    if si is not None:
        factor, unit = style.si_unit(place[0] * si.stiffness, "N/m")
        text += "\n" + rf"$K_{{\max}} = {place[0] * si.stiffness * factor:.4g}$ {unit}"
    ax.annotate(text, place, xytext=(-8, 0), textcoords="offset points", ha="right", va="center", fontsize=8)


def _legend_handles(data: BoundaryData, colors: dict[float, Any], with_colors: bool = True) -> list[Line2D]:
    """What the colors and the line styles of the drawn curves mean."""
    handles = []
    if with_colors:
        handles = [Line2D([], [], color=color, label=rf"$\delta = {delta:g}$") for delta, color in colors.items()]
    if any(outline.delay_model == "fractional_power" for outline in data.outlines):
        handles += style.delay_model_handles()
    if any(np.count_nonzero(outline.omega >= np.pi) >= 2 for outline in data.outlines):
        handles.append(_gray_line("real pole at $z = -1$", style.DOTTED, 1.9))
    if data.ridge_paths:
        handles.append(_gray_line(r"path of $\alpha_{\max}$", style.DASHED, 1.1, style.BLACK))
    if data.passive:
        handles.append(_gray_line("passivity condition", style.DASH_DOTTED, 1.2))
    return handles


def _gray_line(label: str, dash: Any, width: float, color: str = style.GRAY) -> Line2D:
    return Line2D([], [], color=color, linestyle=dash, linewidth=width, label=label)


def _explain(figure: Figure, axes: list[Axes], data: BoundaryData, colors: dict[float, Any]) -> None:
    """A legend in a single panel or above several; a color bar where delta takes too many values for one."""
    many = len(colors) > _LEGEND_ENTRIES
    handles = _legend_handles(data, colors, with_colors=not many)
    if many:
        bar = ScalarMappable(Normalize(min(colors), max(colors)), ListedColormap(list(colors.values())))
        figure.colorbar(bar, ax=axes, label=style.DELTA_LABEL)
    if handles and len(axes) == 1:
        axes[0].legend(handles=handles, loc="best")
    elif handles:
        figure.legend(handles=handles, loc="outside upper center", ncols=min(6, len(handles)))
