"""Draw the largest stable stiffness of the environment of admittance displays.

A display is a robot that moves like a virtual mass M with virtual damping D. The environment is a spring K and a damper
B between the robot and ground. d is the delay in sampling periods.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm, Normalize

from zwidth.plotting import grid, style
from zwidth.plotting.table import SI_COLUMNS, Table, draws_tables, in_order, select
from zwidth.units.formatting import short, with_unit

# Parameters that the horizontal axis can show: column of the table, symbol, name, and unit for linear devices.
_MASS = ("virtual_mass_kg", "M", "virtual mass", "kg")
_DAMPING = ("virtual_damping_N_s_per_m", "D", "virtual damping", "N s/m")
_ENVIRONMENT = "environment_damping_N_s_per_m"
_MOST_NAMES = 8  # largest number of curve colors that the legend names; for more, a color bar shows their values


@draws_tables
def draw_environment_limits(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the largest stable stiffness of the environment over the virtual mass, with one curve per virtual damping.

    A legend names the virtual dampings; for more than 8 of them, a color bar shows their values instead. If the table
    contains a single virtual mass, the horizontal axis is the virtual damping. Each combination of delay and damping of
    the environment has its own line style.

    Args:
        table: Columns of an admittance study.
        axes: An existing Axes.

    Returns:
        Array with the Axes.

    Example:
        >>> import numpy as np, zwidth
        >>> from zwidth import plotting
        >>> mass, timing = np.geomspace(1, 50, 30), zwidth.Timing(rate="500 Hz", delay="4 periods")
        >>> display = zwidth.AdmittanceDisplay(20, 60, zwidth.Actuator(time_constant="20 ms"), timing)
        >>> table = {"delay_periods": np.full(30, 4.0), "virtual_mass_kg": mass}
        >>> table |= {"virtual_damping_N_s_per_m": np.full(30, 60.0), "environment_damping_N_s_per_m": np.zeros(30)}
        >>> table["stiffness_N_per_m"] = display.max_environment_stiffness(virtual_mass=mass).stiffness
        >>> (ax,) = plotting.draw_environment_limits(table)
        >>> ax.get_xlabel()
        'virtual mass  $M$  in kg'
    """
    (ax,) = panels = style.panels(axes, 1, 5.6, 4.0)
    over, hue = (_MASS, _DAMPING) if np.unique(table[_MASS[0]]).size > 1 else (_DAMPING, _MASS)
    factor, unit = style.si_unit(table[SI_COLUMNS[0]], "N/m")
    colors = style.color_by_value(table[hue[0]])
    scale = _scale_colors(np.array(list(colors))) if len(colors) > _MOST_NAMES else None
    if scale is not None:
        shades: Any = scale.to_rgba(np.array(list(colors)))
        colors = dict(zip(colors, shades, strict=True))
    cases = sorted(
        set(zip(*(np.asarray(table[name]).tolist() for name in ("delay_periods", _ENVIRONMENT)), strict=True))
    )
    dashes = {case: style.STYLES[k % len(style.STYLES)] for k, case in enumerate(cases)}
    width = None if scale is None else 0.8  # points; None for the width of the house style
    for value, color in colors.items():
        for (d, B), dash in dashes.items():
            rows = in_order(select(table, **{hue[0]: value, "delay_periods": d, _ENVIRONMENT: B}), over[0])
            label = f"{hue[1]} = {value:g}, d = {d:g}, B = {B:g}"
            stiffness = rows[SI_COLUMNS[0]] * factor
            ax.plot(rows[over[0]], stiffness, color=color, linestyle=dash, linewidth=width, label=label)
    values = np.unique(table[over[0]])
    if grid.logarithmic(values):
        style.use_logarithmic(ax, "x", values, style.DECADES)
    style.use_logarithmic(ax, "y", np.asarray(table[SI_COLUMNS[0]]) * factor, style.DECADES)
    ax.set_xlabel(f"{over[2]}  ${over[1]}$  in {style.units()[over[3]]}")
    ax.set_ylabel(f"largest stable stiffness  $K$  of the environment in {unit}")
    if scale is not None:
        label = f"{hue[2]}  ${hue[1]}$  in {style.units()[hue[3]]}"
        drawn = style.figure_of(panels).colorbar(scale, ax=list(panels), label=label)
        if isinstance(scale.norm, LogNorm):
            style.use_logarithmic(drawn.ax, "y", list(colors), style.DECADES)
    named = colors if scale is None else {}
    handles = [style.line(f"${hue[1]}$ = {_spell(value, hue[3])}", color=color) for value, color in named.items()]
    handles += [style.line(_name_case(case, cases), dash) for case, dash in dashes.items()] if len(cases) > 1 else []
    style.legend(panels, handles, outside=axes is None, ncols=3)
    return panels


def _scale_colors(values: np.ndarray) -> ScalarMappable:
    """Return the color scale of curves for values in ascending order; colors of larger values are darker."""
    shades = matplotlib.colormaps["viridis"](np.linspace(style.LIGHTEST, 0.0, 256))
    norm = (LogNorm if grid.logarithmic(values) else Normalize)(values[0], values[-1])
    return ScalarMappable(norm, ListedColormap(shades))


def _spell(value: float, unit: str) -> str:
    """Return a value with three digits and its unit as text, for the legend."""
    return with_unit(value, style.units()[unit], 3)


def _name_case(case: tuple[float, float], cases: list[tuple[float, float]]) -> str:
    """Return the legend entry of a case (d, B), without d or B if all cases have the same value."""
    varied: list[Any] = [len(set(column)) > 1 for column in zip(*cases, strict=True)]
    words = [f"delay {short(case[0])} period{'' if case[0] == 1 else 's'}"] if varied[0] else []
    words += [f"$B$ = {_spell(case[1], 'N s/m')}"] if varied[1] else []
    return ", ".join(words)
