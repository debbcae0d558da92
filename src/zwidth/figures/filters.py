"""The stiffest wall behind velocity filters: over the cut-off, over the window, and over the noise that they let by."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import grid, style
from zwidth.figures.table import SI_COLUMNS, Table, select

_STIFFNESS, _NOISE = SI_COLUMNS[0], "velocity_noise_m_per_s"
_OVER = {
    "low_pass": ("cutoff_Hz", "cut-off of the low-pass  $f_c$  in Hz"),
    "windowed_difference": ("samples", "length of the window  $n$  in periods"),
}
# The look of each over the noise, and its name in a legend.
_KINDS: dict[str, tuple[Any, str, str]] = {
    "low_pass": (style.SOLID, "", "low-pass"),
    "windowed_difference": (style.DOTTED, "", "window"),
    "backward_difference": ("", "s", "one-sample difference"),
}


@style.house_style()
def draw_filters(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stiffest stable wall over the cut-off of a low-pass and over the length of a window.

    Args:
        table: columns of a filters study.
        axes: Axes of yours, one for each kind of filter that the table has.
    """
    kinds = [kind for kind in _OVER if kind in np.asarray(table["estimate"])]
    panels = style.panels(axes, len(kinds), 3.6 * len(kinds) + 0.4, 3.6, len(kinds), sharey=True)
    colors, factor, words = _scale(table)
    for ax, kind in zip(panels, kinds, strict=False):
        over, label = _OVER[kind]
        for damping, color in colors.items():
            rows = select(table, damping_N_s_per_m=damping, estimate=kind)
            look = {"color": color, "label": f"b = {damping:g}", **_dots(rows)}
            ax.plot(rows[over], rows[_STIFFNESS] * factor, **look)
            (bare,) = select(table, damping_N_s_per_m=damping, estimate="backward_difference")[_STIFFNESS]
            look = {"linewidth": 0.9, "linestyle": style.DASHED, "label": f"difference, b = {damping:g}"}
            ax.axhline(bare * factor, color=color, **look)
        ax.set_xlabel(label)
        values = select(table, estimate=kind)[over]
        style.use_logarithmic(ax, "y", table[_STIFFNESS], style.DECADES)
        if kind == "low_pass" or grid.logarithmic(np.unique(values)):
            style.use_logarithmic(ax, "x", values, style.DECADES)
    panels[0].set_ylabel(words)
    handles = [style.line(rf"$b = {damping:g}$ N s/m", color=color) for damping, color in colors.items()]
    handles.append(style.line("one-sample difference", style.DASHED, 0.9))
    style.legend(panels, handles, outside=axes is None, ncols=len(handles))
    return panels


@style.house_style()
def draw_filter_noise(table: Table, limit: float, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stiffest stable wall over the noise of the velocity that its filter lets through.

    Args:
        table: columns of a filters study with a resolution.
        limit: the noise that is allowed, in m/s; NaN where there is none.
        axes: an Axes of yours.
    """
    (ax,) = panels = style.panels(axes, 1, 5.6, 4.0)
    colors, factor, words = _scale(table)
    kinds = {kind: look for kind, look in _KINDS.items() if kind in np.asarray(table["estimate"])}
    handles: list[Any] = []
    for damping, color in colors.items():
        for kind, (dash, marker, _) in kinds.items():
            rows = select(table, damping_N_s_per_m=damping, estimate=kind)
            mark = {"marker": marker, "markersize": 4.5} if marker else _dots(rows)
            look = {"linestyle": dash, "color": color, "label": f"{kind}, b = {damping:g}", **mark}
            ax.plot(rows[_NOISE] * 1e3, rows[_STIFFNESS] * factor, **look)
        best = _mark_best(ax, select(table, damping_N_s_per_m=damping, best=True), color, factor, words)
        handles.append(style.line(rf"$b = {damping:g}$ N s/m{best}", color=color))
    if np.isfinite(limit):
        ax.axvline(limit * 1e3, color=style.GRAY, linewidth=0.9, linestyle=style.DASHED, zorder=0.5, label="limit")
    style.use_logarithmic(ax, "x", table[_NOISE], style.DECADES)
    style.use_logarithmic(ax, "y", table[_STIFFNESS], style.DECADES)
    ax.set(xlabel=r"noise of the velocity  $\sigma_v$  in mm/s", ylabel=words)
    handles += [style.line(words, dash, marker=marker, markersize=4.5) for dash, marker, words in kinds.values()]
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def _scale(table: Table) -> tuple[dict[float, Any], float, str]:
    """Colors of the dampings, and the factor and the label of the axis of stiffnesses."""
    factor, unit = style.si_unit(table[_STIFFNESS], "N/m")
    words = f"maximum stable stiffness  $K_{{\\max}}$  in {unit}"
    return style.color_by_value(table["damping_N_s_per_m"]), factor, words


def _mark_best(ax: Axes, rows: Table, color: Any, factor: float, words: str) -> str:
    """Mark the stiffest wall within the limit; returns the filter that allows it, for the legend."""
    spelled = ""
    for row in zip(*(rows[name] for name in (_NOISE, _STIFFNESS, "cutoff_Hz", "samples")), strict=True):
        noise, stiffness, cutoff, samples = map(float, row)
        which = f"n = {samples:g}" if np.isfinite(samples) else rf"f_c = {cutoff:.3g}\,\mathrm{{Hz}}"
        look = {"marker": "o", "markersize": 7, "markerfacecolor": "white", "markeredgecolor": color, "zorder": 5}
        ax.plot(noise * 1e3, stiffness * factor, linestyle="", label="best", **look)
        spelled = f":  ${which}$,  {stiffness * factor:.3g} {words.rpartition('  in ')[2]}"
    return spelled


def _dots(rows: Table) -> dict[str, Any]:
    """Few values are dots on their line."""
    return {"marker": "o", "markersize": 3.5} if len(rows[_STIFFNESS]) <= 24 else {}
