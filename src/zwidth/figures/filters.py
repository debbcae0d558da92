"""The stiffest wall behind velocity filters: over the cut-off, over the window, and over the noise that they let by."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.figures import grid, style
from zwidth.figures.table import SI_COLUMNS, Table, select

_STIFFNESS = SI_COLUMNS[0]
# From so many times its least value on, an axis has powers of ten only.
_WIDE = 3000.0
_OVER = {
    "low_pass": ("cutoff_Hz", "cut-off of the low-pass  $f_c$  in Hz"),
    "windowed_difference": ("samples", "length of the window  $n$  in periods"),
}
_WORDS = {"low_pass": "low-pass", "windowed_difference": "window", "backward_difference": "one-sample difference"}


@style.house_style()
def draw_filters(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the stiffest stable wall over the cut-off of a low-pass and over the length of a window.

    Args:
        table: columns of a filters study.
        axes: Axes of yours, one for each kind of filter that the table has.
    """
    kinds = [kind for kind in _OVER if kind in np.asarray(table["estimate"])]
    panels = style.panels(axes, len(kinds), 3.6 * len(kinds) + 0.4, 3.6, len(kinds), sharey=True)
    colors = style.color_by_value(table["damping_N_s_per_m"])
    factor, unit = style.si_unit(float(np.nanmax(table[_STIFFNESS])), "N/m")
    for ax, kind in zip(panels, kinds, strict=False):
        for damping, color in colors.items():
            rows = select(table, damping_N_s_per_m=damping, estimate=kind)
            ax.plot(
                rows[_OVER[kind][0]], rows[_STIFFNESS] * factor, color=color, label=f"b = {damping:g}", **_dots(rows)
            )
            (bare,) = select(table, damping_N_s_per_m=damping, estimate="backward_difference")[_STIFFNESS]
            ax.axhline(
                bare * factor, color=color, linewidth=0.9, linestyle=style.DASHED, label=f"difference, b = {damping:g}"
            )
        ax.set_xlabel(_OVER[kind][1])
        over = select(table, estimate=kind)[_OVER[kind][0]]
        _use_logarithmic(ax, "y", table[_STIFFNESS])
        if kind == "low_pass" or grid.logarithmic(np.unique(over)):
            _use_logarithmic(ax, "x", over)
    panels[0].set_ylabel(f"maximum stable stiffness  $K_{{\\max}}$  in {unit}")
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
    colors = style.color_by_value(table["damping_N_s_per_m"])
    factor, unit = style.si_unit(float(np.nanmax(table[_STIFFNESS])), "N/m")
    dashes = {"low_pass": style.SOLID, "windowed_difference": style.DOTTED, "backward_difference": ""}
    kinds = [kind for kind in dashes if kind in np.asarray(table["estimate"])]
    handles: list[Any] = []
    for damping, color in colors.items():
        for kind in kinds:
            rows = select(table, damping_N_s_per_m=damping, estimate=kind)
            mark = {"marker": "s", "markersize": 4.5} if kind == "backward_difference" else _dots(rows)
            noise = rows["velocity_noise_m_per_s"] * 1e3
            ax.plot(
                noise,
                rows[_STIFFNESS] * factor,
                linestyle=dashes[kind],
                color=color,
                label=f"{kind}, b = {damping:g}",
                **mark,
            )
        best = _mark_best(ax, select(table, damping_N_s_per_m=damping, best=True), color, factor, unit)
        handles.append(style.line(rf"$b = {damping:g}$ N s/m{best}", color=color))
    if np.isfinite(limit):
        ax.axvline(limit * 1e3, color=style.GRAY, linewidth=0.9, linestyle=style.DASHED, zorder=0.5, label="limit")
    _use_logarithmic(ax, "x", table["velocity_noise_m_per_s"])
    _use_logarithmic(ax, "y", table[_STIFFNESS])
    ax.set(
        xlabel=r"noise of the velocity  $\sigma_v$  in mm/s",
        ylabel=f"maximum stable stiffness  $K_{{\\max}}$  in {unit}",
    )
    handles += [
        style.line(_WORDS[kind], dashes[kind], marker="s" if not dashes[kind] else "", markersize=4.5) for kind in kinds
    ]
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def _mark_best(ax: Axes, rows: Table, color: Any, factor: float, unit: str) -> str:
    """Mark the stiffest wall within the limit; returns the filter that allows it, for the legend."""
    spelled = ""
    for row in zip(rows["velocity_noise_m_per_s"], rows[_STIFFNESS], rows["cutoff_Hz"], rows["samples"], strict=True):
        noise, stiffness, cutoff, samples = (float(value) for value in row)
        which = f"n = {samples:g}" if np.isfinite(samples) else rf"f_c = {cutoff:.3g}\,\mathrm{{Hz}}"
        look = {"marker": "o", "markersize": 7, "markerfacecolor": "white", "markeredgecolor": color, "zorder": 5}
        ax.plot(noise * 1e3, stiffness * factor, linestyle="", label="best", **look)
        spelled = f":  ${which}$,  {stiffness * factor:.3g} {unit}"
    return spelled


def _dots(rows: Table) -> dict[str, Any]:
    """Few values are dots on their line."""
    return {"marker": "o", "markersize": 3.5} if len(rows[_STIFFNESS]) <= 24 else {}


def _use_logarithmic(ax: Axes, which: str, values: Any) -> None:
    style.use_logarithmic(ax, which, float(np.nanmin(values)), float(np.nanmax(values)), _WIDE)
