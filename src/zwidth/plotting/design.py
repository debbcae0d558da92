"""Draw design aids: maximum stiffness with different velocity filters, and over the parameter to be designed.

b is the physical damping of the device, K_max the stiffness of its stiffest stable wall. A *filters study* computes
K_max and the velocity noise for velocity estimates of several *kinds*: low-pass filters, differences over windows, and
the backward difference. A *design study* computes the value of one parameter of the device at which K_max reaches a
*required* stiffness times a *reserve* (a safety factor).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from zwidth.plotting import grid, style
from zwidth.plotting.table import SI_COLUMNS, Table, draws_tables, in_order, select
from zwidth.units.formatting import (
    ENOUGH,
    count_digits_apart,
    format_sufficient,
    header,
    round_conservatively,
    with_unit,
)
from zwidth.units.quantities import PARAMETERS

_STIFFNESS = SI_COLUMNS[0]  # name of the column of K_max
_NOISE = "velocity_noise_m_per_s"  # name of the column of the velocity noise
# Column and axis label of the parameter over which K_max is drawn, for each kind of filter.
_OVER = {
    "low_pass": ("cutoff_Hz", "cut-off of the low-pass  $f_c$  in Hz"),
    "windowed_difference": ("samples", "length of the window  $n$  in periods"),
}
# Line style, marker and legend entry of each kind of velocity estimate.
_KINDS: dict[str, tuple[Any, str, str]] = {
    "low_pass": (style.SOLID, "", "low-pass"),
    "windowed_difference": (style.DOTTED, "", "window"),
    "backward_difference": ("", "s", "backward difference"),
}


@draws_tables
def draw_filters(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the maximum stable stiffness over the cut-off frequency of a low-pass and over the length of a window.

    Args:
        table: Columns of a filters study.
        axes: Existing Axes, one per kind of filter in the table.
    """
    kinds = [kind for kind in _OVER if kind in np.asarray(table["estimate"])]
    panels = style.panels(axes, len(kinds), 3.6 * len(kinds) + 0.4, 3.6, len(kinds), sharey=True)
    colors, factor, words = _scale(table)
    for ax, kind in zip(panels, kinds, strict=False):
        over, label = _OVER[kind]
        for damping, color in colors.items():
            rows = in_order(select(table, damping_N_s_per_m=damping, estimate=kind), over)
            look = {"color": color, "label": f"b = {damping:g}", **(style.POINTS if over == "samples" else _dots(rows))}
            ax.plot(rows[over], rows[_STIFFNESS] * factor, **look)
            (unfiltered,) = select(table, damping_N_s_per_m=damping, estimate="backward_difference")[_STIFFNESS]
            look = {"linewidth": 0.9, "linestyle": style.DASHED, "label": f"backward difference, b = {damping:g}"}
            ax.axhline(unfiltered * factor, color=color, **look)
        ax.set_xlabel(label)
        values = select(table, estimate=kind)[over]
        style.use_logarithmic(ax, "y", table[_STIFFNESS], style.DECADES)
        if over == "samples":
            style.use_whole(ax)
        if kind == "low_pass" or grid.logarithmic(np.unique(values)):
            style.use_logarithmic(ax, "x", values, style.DECADES)
    panels[0].set_ylabel(words)
    handles = [style.line(_name_damping(damping), color=color) for damping, color in colors.items()]
    handles.append(style.line("backward difference", style.DASHED, 0.9))
    style.legend(panels, handles, outside=axes is None, ncols=len(handles))
    return panels


@draws_tables
def draw_filter_noise(table: Table, limit: float, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the maximum stable stiffness over the velocity noise after the filter.

    Args:
        table: Columns of a filters study with a resolution.
        limit: Largest allowed noise in m/s; NaN if there is no limit.
        axes: An existing Axes.
    """
    (ax,) = panels = style.panels(axes, 1, 5.6, 4.0)
    colors, factor, words = _scale(table)
    speed, noise_unit = style.si_unit(np.append(table[_NOISE], limit), "m/s")
    kinds = {kind: look for kind, look in _KINDS.items() if kind in np.asarray(table["estimate"])}
    handles: list[Any] = []
    for damping, color in colors.items():
        for kind, (dash, marker, _) in kinds.items():
            rows = in_order(select(table, damping_N_s_per_m=damping, estimate=kind), _NOISE)
            mark = {"marker": marker, "markersize": 4.5} if marker else _dots(rows)
            look = {"linestyle": dash, "color": color, "label": f"{kind}, b = {damping:g}", **mark}
            ax.plot(rows[_NOISE] * speed, rows[_STIFFNESS] * factor, **look)
        best = _mark_best(ax, select(table, damping_N_s_per_m=damping, best=True), color, (speed, factor))
        handles.append(style.line(f"{_name_damping(damping)}{best}", color=color))
    if np.isfinite(limit):
        ax.axvline(limit * speed, color=style.GRAY, linewidth=0.9, linestyle=style.DASHED, zorder=0.5, label="limit")
    style.use_logarithmic(ax, "x", speed * np.append(table[_NOISE], limit), style.DECADES)
    style.use_logarithmic(ax, "y", table[_STIFFNESS], style.DECADES)
    ax.set(xlabel=rf"noise of the velocity  $\sigma_v$  in {noise_unit}", ylabel=words)
    handles += [style.line(words, dash, marker=marker, markersize=4.5) for dash, marker, words in kinds.values()]
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def _scale(table: Table) -> tuple[dict[float, Any], float, str]:
    """Return the color of each physical damping b, and the scaling factor and the label of the stiffness axis."""
    factor, unit = style.si_unit(table[_STIFFNESS], "N/m")
    words = f"maximum stable stiffness  $K_{{\\max}}$  in {unit}"
    return style.color_by_value(table["damping_N_s_per_m"]), factor, words


def _name_damping(damping: float) -> str:
    """Return the legend entry of a physical damping."""
    return f"$b$ = {with_unit(damping, style.units()['N s/m'], 3)}"


def _mark_best(ax: Axes, rows: Table, color: Any, factors: tuple[float, float]) -> str:
    """Mark the stiffest wall within the noise limit, and return its filter and stiffness as text for the legend.

    Args:
        ax: Axes to draw into.
        rows: Rows of the table to mark, at most one.
        color: Color of the mark.
        factors: Factors from SI units to the units of the axes, for noise and stiffness.
    """
    text = ""
    for row in zip(*(rows[name] for name in (_NOISE, _STIFFNESS, "cutoff_Hz", "samples")), strict=True):
        noise, stiffness, cutoff, samples = map(float, row)
        which = f"n = {samples:g}" if np.isfinite(samples) else rf"f_c = {cutoff:.3g}\,\mathrm{{Hz}}"
        look = {"marker": "o", "markersize": 7, "markerfacecolor": "white", "markeredgecolor": color, "zorder": 5}
        ax.plot(noise * factors[0], stiffness * factors[1], linestyle="", label="best", **look)
        text = f":  ${which}$,  {with_unit(round_conservatively(stiffness, 'below', 3), style.units()['N/m'], 3)}"
    return text


def _dots(rows: Table) -> dict[str, Any]:
    """Return line properties that mark each point of a curve with a dot; {} if the curve has many points."""
    return {"marker": "o", "markersize": 3.5} if len(rows[_STIFFNESS]) <= 24 else {}


@draws_tables
def draw_requirement(curve: Table, required: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the maximum stable stiffness over a parameter, and the value at which it reaches each required stiffness.

    Args:
        curve: Columns parameter, value with its unit (such as ``value_Hz``), stiffness_N_per_m.
        required: Columns of a design study: stiffness_N_per_m, reserve; present, value and other_crossings with the
            unit of the parameter in their names; sufficient_side; and with tolerances stable_share.
        axes: An existing Axes.
    """
    (ax,) = panels = style.panels(axes, 1, 5.6, 3.8)
    parameter = PARAMETERS[str(np.asarray(curve["parameter"])[0])]
    value_in, present_in = (header(name, parameter.unit) for name in ("value", "present"))
    values, stiffness = np.asarray(curve[value_in]), np.asarray(curve[SI_COLUMNS[0]])
    wanted = np.asarray(required[SI_COLUMNS[0]])
    targets = wanted * required["reserve"]
    factor, unit = style.si_unit(np.append(stiffness, targets), "N/m")
    all_known = np.concatenate([values, required[value_in], required[present_in]])
    scale, value_unit = style.si_unit(np.sqrt(np.nanmax(all_known) * values.min()), parameter.unit)
    ax.plot(values * scale, stiffness * factor, color=style.BLACK, label="K_max", zorder=3)
    colors = style.color_by_value(targets.tolist())
    ax.set(xscale="log", yscale="log")
    present, curve_drawn = float(required[present_in][0]) * scale, np.stack([values * scale, stiffness * factor])
    if curve_drawn[0, 0] <= present <= curve_drawn[0, -1]:
        height = np.exp(np.interp(np.log(present), *np.log(curve_drawn)))
        look: dict[str, Any] = {"marker": "s", "markersize": 5, "markerfacecolor": "white", "color": style.BLACK}
        ax.plot([present], [height], linestyle="", label="present", zorder=5, **look)
    columns = (required[name] for name in (value_in, "sufficient_side", header("other_crossings", parameter.unit)))
    names = []
    for target, value, enough, others in zip(targets, *columns, strict=True):
        all_known = enough in ENOUGH
        _mark_required(ax, curve_drawn, target * factor, value * scale if all_known else np.nan, colors[target])
        # Split the column other_crossings, in which quantities are separated by semicolons.
        crossings = [float(each.split()[0]) for each in str(others).split("; ") if each]
        name = format_sufficient(float(value), enough, crossings, style.units()[parameter.unit], 3) if all_known else ""
        names.append(name.replace("g cm^2", style.write_unit("g cm^2")))
    heights = np.append(stiffness, targets)
    for name, scaled in (("x", values * scale), ("y", heights * factor)):
        style.use_logarithmic(ax, name, scaled, style.DECADES)
    ax.set(
        xlim=(values[0] * scale, values[-1] * scale),
        xlabel=f"{parameter.label_in(style.units())}  in {value_unit}",
        ylabel=f"maximum stable stiffness  $K_{{\\max}}$  in {unit}",
    )
    # Write the required values to the right of the panel, because next to their dots they would cover the dashed lines.
    style.name_heights(ax, names, (targets * factor).tolist(), [colors[target] for target in targets])
    entries = _name_targets(required, factor, unit)
    handles = [style.line(words, style.DASHED, color=colors[target]) for target, words in entries]
    handles.append(
        style.line("current value", "", color=style.BLACK, marker="s", markerfacecolor="white", markersize=5)
    )
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def _name_targets(required: Table, factor: float, unit: str) -> Iterator[tuple[float, str]]:
    """Yield the height in N/m and the legend entry of the dashed line of each required stiffness.

    The entry states the required stiffness, its reserve, and with tolerances the percentage of stable devices.

    Args:
        required: Columns of a design study.
        factor: Factor from N/m to the unit of the axis.
        unit: Unit of the axis.
    """
    with_shares = "stable_share" in required
    shares = required["stable_share"] if with_shares else np.full(len(required["reserve"]), np.nan)
    digits = count_digits_apart(np.asarray(required[SI_COLUMNS[0]]).tolist(), 3)
    for wanted, reserve, share in zip(required[SI_COLUMNS[0]], required["reserve"], shares, strict=True):
        words = f"{wanted * factor:.{digits}g} {unit}" + (rf" $\times\,{reserve:g}$" if reserve != 1 else "")
        # Round the percentage down, because 100 % must not be printed if even one device is unstable.
        percent = f"{round_conservatively(100.0 * share, 'below', 3):.3g}"
        yield wanted * reserve, words + (f": stable on {percent} % of devices" if np.isfinite(share) else "")


def _mark_required(ax: Axes, curve: np.ndarray, target: float, value: float, color: Any) -> None:
    """Draw a required stiffness as a line, and mark the values of the parameter at which K_max reaches it.

    Args:
        ax: Axes of the curve.
        curve: Points (x, y) of the curve of K_max, of shape (2, n), in the units of the axes.
        target: Required stiffness including its reserve, in the unit of the axis.
        value: Required value of the parameter; NaN if there is none.
        color: Color of the marks.
    """
    ax.axhline(target, color=color, linewidth=0.9, linestyle=style.DASHED, zorder=2, label=f"target {target:g}")
    x, y = (np.append(part, end) for part, end in zip(curve, (value, target), strict=True))
    order = np.argsort(x)
    band = np.where(y[order] >= target, target, np.nan)
    ax.plot(x[order], band, color=color, linewidth=3.5, alpha=0.35, label="sufficient", zorder=2.5)
    if np.isfinite(value):
        ax.plot([value], [target], linestyle="", marker="o", markersize=6, color=color, label="required", zorder=6)
