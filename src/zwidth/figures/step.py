"""Fig. 11: the response of the position to a step of force, and the force of the wall."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.table import Table, curves

_UNITS = {"time": "_s", "position": "_m", "wall_force": "_N", "final_position": "_m", "settling_time": "_s"}
_DOT: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 4.5}


@style.house_style()
def draw_step(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw step responses from force to position, with final values (thin) and settling times (dots).

    Args:
        table: columns of a step study: label, alpha, beta, time, position, wall_force, final_position, settling_time;
            those of a device in SI units have their units behind their names, as in time_s and position_m. The times
            of settling may be left out, and for positions alone the forces.
        axes: an Axes of yours for the positions alone, or two.
    """
    panels = style.panels(axes, 2, 5.6, 5.0, height_ratios=(1.8, 1.2), sharex=True)
    clock, unit = draw_positions(panels[0], table)
    responses = _read_responses(table)
    for ax in panels[1:]:
        _draw_forces(ax, responses, clock)
        ax.set_ylabel("wall force in N" if unit else "wall force  in $F$")
    for ax in panels:
        # The last sample ends before the time that was asked for.
        ax.set_xlim(0.0, max(float(each.time[-1] + each.time[1]) for each in responses) * clock)
    panels[-1].set_xlabel(f"time  $t$  in {unit}" if unit else "time  $t/T$  in sampling periods")
    handles = [line for line in panels[0].lines if not line.get_label().startswith("_")]
    if any(each.settled for each in responses):
        handles.append(Line2D([], [], color=style.GRAY, label="settled to 2 %", **_DOT))
    # Responses swing over all of the panel.
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def draw_positions(ax: Axes, table: Table) -> tuple[float, str]:
    """Draw the position of every response over time; returns the scale and the unit of time, "" where normalized."""
    responses, physical = _read_responses(table), "time_s" in table
    clock, unit, factor, length = 1.0, "", 1.0, ""
    if physical:
        clock, unit = style.si_unit([each.time[-1] for each in responses], "s")
        # The final position: an unstable response has no largest one worth a unit.
        finals = [abs(each.final_position) for each in responses if np.isfinite(each.final_position)]
        largest = max(float(np.nanmax(np.abs(each.position))) for each in responses)
        factor, length = style.si_unit(max(finals, default=largest), "m")
    for each in responses:
        text = rf"{style.literal(each.label)}  ($\alpha = {each.alpha:.3g}$, $\beta = {each.beta:.3g}$)"
        text += ", not settled" if each.settled is False else ""
        ax.plot(each.time * clock, each.position * factor, label=text, zorder=3, **each.look)
        if np.isfinite(each.final_position):
            ax.axhline(each.final_position * factor, color=each.look["color"], linewidth=0.5, zorder=2)
        if each.settled:
            at = np.interp(each.settling_time, each.time, each.position)
            ax.plot(each.settling_time * clock, at * factor, color=each.look["color"], zorder=4, **_DOT)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    ax.set_ylabel(f"position  $x$  in {length} for 1 N" if physical else r"position  $x$  in $F\,T^2\!/m$")
    return clock, unit


def _read_responses(table: Table) -> list[Any]:
    """The responses in a table; ``settled``: for good, at the end of the time shown; None where that is not known."""
    spelled = ((name, key) for name, unit in _UNITS.items() for key in (name + unit, name))
    columns = {name: np.asarray(table[key]) for name, key in spelled if key in table}
    columns |= {name: np.asarray(table[name]) for name in ("label", "alpha", "beta")}
    # Each begins at time 0: two of them may be alike in all but that.
    columns["number"] = np.cumsum(columns["time"] == 0.0)
    responses = curves(columns, "number")
    for k, each in enumerate(responses):
        each.look = style.look(k)
        for name in {"label", "alpha", "beta", "final_position", "settling_time"} & set(columns):
            setattr(each, name, getattr(each, name)[0])
        each.settled = bool(each.settling_time <= each.time[-1]) if "settling_time" in columns else None
    return responses


def _draw_forces(ax: Axes, responses: list[Any], clock: float) -> None:
    """The force of the wall over time."""
    for each in responses:
        # Steps are too short for dashes: lightness has to do.
        look = {"color": each.look["color"], "linewidth": 1.1, "label": f"wall_force, {style.literal(each.label)}"}
        ax.plot(each.time * clock, each.wall_force, zorder=3, **look)
    ax.axhline(-1.0, color=style.GRAY, linewidth=0.5, zorder=2)
