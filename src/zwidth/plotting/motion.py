"""Draw motions over time: step responses (Fig. 11 of the paper), and simulated motions, phase planes and energies.

Quantities of a step response are in SI units, or normalized: time by the sampling period T, position by F T^2/m for a
force F on a mass m. Positions are positive inside the wall, whose surface is at 0. A *motion* is read from a table as
an object with one array per column as attribute. A motion *grows without bound* if its values increase much at its end
(`_grows`). alpha and beta are the normalized stiffness and virtual damping of a wall.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from zwidth.plotting import style
from zwidth.plotting.table import Table, curves, draws_tables

# Suffix of each column of a step study in SI units.
_UNITS = {"time": "_s", "position": "_m", "wall_force": "_N", "final_position": "_m", "settling_time": "_s"}
_DOT: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 4.5}  # mark of the settling time
_ZERO_ORDER_HOLD: dict[str, Any] = {"drawstyle": "steps-post", "linewidth": 1.1}  # line of the sampled wall force
# If a motion grows without bound, the axis ends at this multiple of the largest absolute value of the smallest motion.
_CLIP = 8.0
# A motion is taken to grow without bound if the ratio of the largest value in the last quarter of its time to the
# largest value before exceeds this factor. The factor must be above 4/3, the ratio for a constant velocity.
_GROWTH = 1.5
# Length of the time axis if all motions leave the wall, as a multiple of the time at which the last contact ends.
_WINDOW = 3.0
_THIN = 0.9  # width of the lines of tip, hand and tool
_BODIES = {"tip or hand": style.GREEN, "tool": style.VERMILION}  # colors of these lines in a figure of one motion
_MAX_PANELS = 6  # largest number of motions in a figure of energies; if there are more, evenly spaced ones are drawn
# Legend entry, color and line style of each energy.
_ENERGIES = {
    "energy_J": ("energy of the bodies", style.BLACK, style.SOLID),
    "wall_work_J": ("work of the wall", style.VERMILION, style.DASHED),
    "external_work_J": ("work of the external force", style.GREEN, style.DOTTED),
    "damping_loss_J": ("dissipated by dampers", style.BLUE, style.DASH_DOTTED),
    "friction_loss_J": ("dissipated by friction", style.PURPLE, style.SOLID),
}


def _name_force() -> str:
    """Return the name of the wall force, or of the wall torque of a rotary device, for axis labels."""
    return "wall torque" if style.units().rotary else "wall force"


def _name_position() -> str:
    """Return the name and the symbol of the position, or of the angle of a rotary device, for axis labels."""
    return r"angle  $\theta$" if style.units().rotary else "position  $x$"


def _name_velocity() -> str:
    """Return the name and the symbol of the velocity, linear or angular, for axis labels."""
    return r"angular velocity  $\dot\theta$" if style.units().rotary else "velocity  $v$"


@draws_tables
def draw_step(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw step responses from force to position, with final values (thin) and settling times (dots).

    Args:
        table: Columns of a step study: label, alpha, beta, time, position, wall_force, final_position, settling_time;
            names of columns in SI units end with the unit, as in time_s and position_m. The column settling_time is
            optional, and wall_force as well if only positions are drawn.
        axes: An existing Axes for the positions only, or two.
    """
    panels = style.panels(axes, 2, 5.6, 5.0, height_ratios=(1.8, 1.2), sharex=True)
    clock, unit = draw_positions(panels[0], table)
    responses = _read_responses(table)
    for ax in panels[1:]:
        for each in responses:
            look = {**each.look, **_ZERO_ORDER_HOLD, "label": f"wall_force, {each.label}"}
            ax.plot(each.time * clock, each.wall_force, zorder=3, **look)
        ax.axhline(-1.0, color=style.GRAY, linewidth=0.5, zorder=2)
        ax.set_ylabel(f"{_name_force()} in {style.units()['N']}" if unit else "wall force  in $F$")
    for ax in panels:
        # Extend the axis by one sampling period, because the wall force of the last sample is held for a period.
        ax.set_xlim(0.0, max(float(each.time[-1] + each.time[1]) for each in responses) * clock)
    panels[-1].set_xlabel(f"time  $t$  in {unit}" if unit else "time  $t/T$  in sampling periods")
    handles = [line for line in panels[0].lines if not line.get_label().startswith("_")]
    if any(each.settled for each in responses):
        handles.append(Line2D([], [], color=style.GRAY, label="settled to 2 %", **_DOT))
    # Put the legend outside of the panels, because oscillating responses fill a whole panel.
    style.legend(panels, handles, outside=axes is None, ncols=2)
    return panels


def draw_positions(ax: Axes, table: Table) -> tuple[float, str]:
    """Draw the position of each step response over time; return the scaling factor and the unit of the time axis.

    The factor is 1 and the unit "" if the table is normalized.
    """
    responses, physical = _read_responses(table), "time_s" in table
    clock, unit, factor, length = 1.0, "", 1.0, ""
    if physical:
        clock, unit = style.si_unit([each.time[-1] for each in responses], "s")
        # Choose the unit of the axis that suits the final positions, because the largest position of an unstable
        # response depends only on the simulated time.
        finals = [abs(each.final_position) for each in responses if np.isfinite(each.final_position)]
        largest = max(float(np.nanmax(np.abs(each.position))) for each in responses)
        factor, length = style.si_unit(max(finals, default=largest), "m")
    for each in responses:
        text = rf"{each.label}  ($\alpha = {each.alpha:.3g}$, $\beta = {each.beta:.3g}$)"
        text += ", not settled" if each.settled is False else ""
        ax.plot(each.time * clock, each.position * factor, label=text, zorder=3, **each.look)
        if np.isfinite(each.final_position):
            ax.axhline(each.final_position * factor, color=each.look["color"], linewidth=0.5, zorder=2)
        if each.settled:
            position = np.interp(each.settling_time, each.time, each.position)
            ax.plot(each.settling_time * clock, position * factor, color=each.look["color"], zorder=4, **_DOT)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    ax.set_ylabel(
        f"{_name_position()}  in {length} for 1 {style.units()['N']}" if physical else r"position  $x$  in $F\,T^2\!/m$"
    )
    return clock, unit


def _read_responses(table: Table) -> list[Any]:
    """Return the step responses of a table as objects with the columns and the line properties as attributes.

    The attribute ``settled`` is True if the response settles within its time; None if the table has no settling times.
    """
    keys = ((name, key) for name, unit in _UNITS.items() for key in (name + unit, name))
    columns = {name: np.asarray(table[key]) for name, key in keys if key in table}
    columns |= {name: table[name] for name in ("label", "alpha", "beta")}
    responses = _read_motions(columns, "time")
    for each in responses:
        for name in {"alpha", "beta", "final_position", "settling_time"} & set(columns):
            setattr(each, name, getattr(each, name)[0])
        each.settled = bool(each.settling_time <= each.time[-1]) if "settling_time" in columns else None
    return responses


@draws_tables
def draw_motion(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the position and the wall force of each motion over time; thin lines show tip, hand and tool.

    With a tool, the force is that of the coupling on the tool, and there is no wall. A single motion has one color per
    body; several motions have one color each.

    If all motions leave the wall, the time axis ends at three times the end of the last contact. A motion that grows
    without bound is clipped at eight times the largest value of the smallest motion.

    Args:
        table: Columns of a simulate study.
        axes: An existing Axes for the positions only, or two.
    """
    motions = _read_motions(table)
    panels = style.panels(axes, 2, 6.4, 4.8, height_ratios=(1.6, 1.0), sharex=True)
    clock, second = style.si_unit([each.time_s[-1] for each in motions], "s")
    names = {"tip_position_m": "tip or hand", "hand_position_m": "tip or hand", "tool_position_m": "tool"}
    further = [name for name in names if hasattr(motions[0], name)]
    words = ", ".join(dict.fromkeys(names[name] for name in further))
    has_tool, single = "tool_position_m" in further, len(motions) == 1
    force = _name_force().replace("wall", "coupling") if has_tool else _name_force()
    loads = "coupling_force_N" if has_tool else "wall_force_N"
    quantities = (("position_m", _name_position(), further), (loads, force, []))
    for ax, (name, label, others) in zip(panels, quantities, strict=False):
        factor, unit = _limit(ax, "y", [getattr(each, one) for each in motions for one in (name, *others)], name[-1])
        for each in motions:
            look = each.look if name == "position_m" else {**each.look, **_ZERO_ORDER_HOLD}
            ax.plot(each.time_s * clock, getattr(each, name) * factor, label=each.label, zorder=3, **look)
            for other in others:
                look = {**each.look, "linewidth": _THIN, **({"color": _BODIES[names[other]]} if single else {})}
                entry = f"{other}, {each.label}"
                ax.plot(each.time_s * clock, getattr(each, other) * factor, label=entry, zorder=4, **look)
        if not has_tool:
            ax.axhline(0.0, color=style.GRAY, linewidth=0.6, zorder=2)
        ax.set_ylabel(f"{label}  in {unit}")
        _begin_at_zero(ax, max(float(each.time_s[-1]) for each in motions) * clock)
    if not has_tool:
        _mark_wall(panels[0], "y", motions)
    panels[-1].set_xlabel(f"time  $t$  in {second}")
    entries = [style.line(f"thin: {words}", width=_THIN, color=style.BLACK)] if further else []
    if single and further:
        device = motions[0].look
        entries = [style.line("device", device["linestyle"], color=device["color"])] * (not motions[0].label)
        bodies = dict.fromkeys(names[name] for name in further)
        entries += [style.line(body, width=_THIN, color=_BODIES[body]) for body in bodies]
    _add_legend(panels, motions, *entries, outside=axes is None)
    return panels


@draws_tables
def draw_phase_plane(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the velocity of each motion over its position, with the wall; dots mark the initial states.

    Args:
        table: Columns of a simulate study.
        axes: An existing Axes.
    """
    motions = _read_motions(table)
    (ax,) = panels = style.panels(axes, 1, 5.6, 4.2)
    x, meter = _limit(ax, "x", [each.position_m for each in motions], "m")
    y, speed = _limit(ax, "y", [each.velocity_m_per_s for each in motions], "m/s")
    for each in motions:
        look = {**each.look, "linewidth": 1.1}
        ax.plot(each.position_m * x, each.velocity_m_per_s * y, label=each.label, zorder=3, **look)
    for each in motions:
        start = each.position_m[0] * x, each.velocity_m_per_s[0] * y
        ax.plot(*start, linestyle="", marker="o", markersize=4.0, color=style.BLACK, label="start", zorder=4)
    ax.axhline(0.0, color=style.GRAY, linewidth=0.6, zorder=2)
    _mark_wall(ax, "x", motions)
    ax.set(xlabel=f"{_name_position()}  in {meter}", ylabel=f"{_name_velocity()}  in {speed}")
    start = style.line("start", "", color=style.BLACK, marker="o", markersize=4.0)
    _add_legend(panels, motions, start, outside=axes is None)
    return panels


@draws_tables
def draw_energy(table: Table, axes: style.AnyAxes | None = None) -> np.ndarray:
    """Draw the energy balance of each motion: work of wall and hand, losses by dampers and friction, and energy.

    Args:
        table: Columns of a simulate study.
        axes: Existing Axes, one per motion.
    """
    motions = _read_motions(table)
    motions = [motions[k] for k in style.pick_evenly(len(motions), _MAX_PANELS)]
    columns = min(3, len(motions))
    rows = -(-len(motions) // columns)
    panels = style.panels(axes, len(motions), 0.9 + 2.5 * columns if columns > 1 else 5.6, 0.9 + 2.4 * rows, columns)
    shown = [name for name in _ENERGIES if any(np.any(getattr(each, name) != 0) for each in motions)]
    clock, second = style.si_unit([each.time_s[-1] for each in motions], "s")
    for ax, each in zip(panels, motions, strict=False):
        factor, joule = style.si_unit([getattr(each, name) for name in shown], "J")
        for name in shown:
            words, color, dash = _ENERGIES[name]
            values = getattr(each, name) * factor
            ax.plot(each.time_s * clock, values, color=color, linestyle=dash, linewidth=1.2, label=words)
        ax.axhline(0.0, color=style.GRAY, linewidth=0.6, zorder=1)
        _begin_at_zero(ax, float(each.time_s[-1]) * clock)
        title = _in_math(each.label).replace(", ", "\n" if columns > 1 else ", ")
        ax.set(title=title, xlabel=f"time  $t$  in {second}", ylabel=f"energy  in {joule}")
    handles = [style.line(words, dash, 1.2, color) for words, color, dash in (_ENERGIES[name] for name in shown)]
    style.legend(panels, handles, outside=axes is None, ncols=min(len(handles), 2 + columns))
    return panels


def _read_motions(table: Table, time: str = "time_s") -> list[Any]:
    """Return the motions of a table as objects with the columns and the line properties (``look``) as attributes."""
    columns = {str(name): np.asarray(table[name]) for name in table}
    # Separate the motions at each row with time 0, because the labels of two motions may be equal.
    motions = curves({**columns, "number": np.cumsum(columns[time] == 0.0)}, "number")
    for k, each in enumerate(motions):
        each.label = style.literal(each.label[0])
        each.look = style.look(k)
    return _trim(motions) if time == "time_s" and "contact" in columns else motions


def _trim(motions: list[Any]) -> list[Any]:
    """Truncate the motions if all of them leave the wall, so that their contacts fill a third of the time axis."""
    ends = []
    for each in motions:
        contact = np.asarray(each.contact) > 0
        if not contact.any() or contact[-max(contact.size // 4, 1) :].any():
            return motions
        ends.append(float(each.time_s[np.flatnonzero(contact)[-1]]))
    for each in motions:
        size, shown = each.time_s.size, each.time_s <= _WINDOW * max(ends)
        for name, values in vars(each).items():
            if isinstance(values, np.ndarray) and values.shape[:1] == (size,):
                setattr(each, name, values[shown])
    return motions


def _begin_at_zero(ax: Axes, end: float) -> None:
    """Set the range of a time axis to begin at 0; it ends at 1 if the motions consist of a single instant."""
    ax.set_xlim(0.0, end or 1.0)


def _limit(ax: Axes, which: str, values: list[np.ndarray], unit: str) -> tuple[float, str]:
    """Set the range of an axis so that it clips motions that grow without bound; return its scaling factor and unit.

    Args:
        ax: Axes to change.
        which: Axis, "x" or "y".
        values: Values of each motion along the axis, in SI units.
        unit: SI unit of the values, that of a linear device.
    """
    finite = [each[np.isfinite(each)] for each in values]
    largest = [float(np.abs(each).max(initial=0.0)) for each in finite]
    growing = any(_grows(np.abs(each)) for each in values)
    most = _CLIP * min((size for size in largest if size > 0), default=1.0) if growing else max(largest, default=1.0)
    low = min(float(np.clip(each.min(initial=0.0), -most, 0.0)) for each in finite)
    high = max(float(np.clip(each.max(initial=0.0), 0.0, most)) for each in finite)
    factor, unit = style.si_unit((low, high), unit)
    getattr(ax, f"set_{which}lim")(*style.span(low * factor, high * factor))
    return factor, unit


def _grows(sizes: np.ndarray) -> bool:
    """Return whether a motion grows without bound, given its absolute values over time (`_GROWTH`)."""
    early, late = np.split(sizes, [3 * sizes.size // 4])
    return not np.all(np.isfinite(sizes)) or bool(late.max(initial=0.0) > _GROWTH * early.max(initial=0.0) > 0)


def _mark_wall(ax: Axes, which: str, motions: list[Any]) -> None:
    """Mark the surface of the wall, and shade its inside unless all motions are always in contact.

    Args:
        ax: Axes with the range of the position axis set.
        which: Axis of the position, "x" or "y".
        motions: Motions in the panel.
    """
    line = ax.axhline if which == "y" else ax.axvline
    line(0.0, color=style.GRAY, linewidth=1.0, zorder=2)
    if all(np.all(each.contact) for each in motions):
        return
    far = max(getattr(ax, f"get_{which}lim")())
    shade = ax.axhspan if which == "y" else ax.axvspan
    shade(0.0, far, color=style.GRAY, alpha=0.10, linewidth=0.0, zorder=0.5)
    place = {"y": (0.99, 0.97, "right", "top"), "x": (0.99, 0.03, "right", "bottom")}[which]
    ax.text(*place[:2], "wall", transform=ax.transAxes, ha=place[2], va=place[3], color=style.GRAY, fontsize=8)


def _in_math(label: str) -> str:
    """Return a label in which K_max is typeset as mathematics."""
    return label.replace("K_max", r"$K_{\max}$")


def _add_legend(panels: np.ndarray, motions: list[Any], *more: Line2D, outside: bool) -> None:
    """Add a legend of the motions that have labels, in fewer columns if labels are long.

    Args:
        panels: The panels.
        motions: The motions.
        more: Further legend entries.
        outside: Place the legend above the panels instead of in the first one.
    """
    named = [each for each in motions if each.label]
    lines = [style.line(_in_math(each.label), each.look["linestyle"], color=each.look["color"]) for each in named]
    columns = 2 if max(len(each.label) for each in motions) > 20 else 4
    style.legend(panels, [*lines, *more], outside=outside, ncols=columns)
