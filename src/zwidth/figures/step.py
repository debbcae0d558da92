"""Fig. 11: the response of the position to a step of force, and the force of the wall."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.data import Response, StepData

# In gray these differ in lightness from one to the next.
_COLORS = (style.BLUE, style.ORANGE, style.BLACK, style.GREEN, style.VERMILION, style.SKY, style.PURPLE)
_STYLES = (style.SOLID, style.DASHED, style.DASH_DOTTED, style.DOTTED)


SETTLED = "settled to 2 %"


def draw_step(data: StepData, ax: Axes | None = None) -> Figure:
    """Draw step responses from force to position, with final values (thin) and settling times (dots).

    Args:
        data: the responses.
        ax: draw the positions alone, into this Axes.

    Returns:
        The figure; a new one, unknown to pyplot, unless ``ax`` is given.
    """
    with style.house_style():
        if ax is not None:
            draw_positions(ax, data)
            _label_time(ax, data)
            ax.legend(handles=_legend_handles(ax, data))
            return style.figure_of(ax)
        figure, axes = style.new_figure(5.6, 5.0, 2, 1, height_ratios=(1.8, 1.2), sharex=True)
        draw_positions(axes[0, 0], data)
        draw_forces(axes[1, 0], data)
        _label_time(axes[1, 0], data)
        # Responses swing over all of the panel.
        figure.legend(handles=_legend_handles(axes[0, 0], data), loc="outside upper center", ncols=2)
        return figure


def draw_positions(ax: Axes, data: StepData) -> None:
    """The position of every response over time."""
    factor, unit = _position_unit(data)
    clock, _ = _time_unit(data)
    for response, look in zip(data.responses, _looks(len(data.responses)), strict=True):
        ax.plot(response.time * clock, response.position * factor, **look, label=_text(response), zorder=3)
        if np.isfinite(response.final_position):
            ax.axhline(response.final_position * factor, color=look["color"], linewidth=0.5, zorder=2)
        if response.settles_in_view:
            at = np.interp(response.settling_time, response.time, response.position)
            ax.plot(response.settling_time * clock, at * factor, "o", color=look["color"], markersize=4.5, zorder=4)
    ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
    ax.set_ylabel(f"position  $x$  in {unit} for 1 N" if data.physical else r"position  $x$  in $F\,T^2\!/m$")


def draw_forces(ax: Axes, data: StepData) -> None:
    """The force of the wall over time."""
    clock, _ = _time_unit(data)
    for response, look in zip(data.responses, _looks(len(data.responses)), strict=True):
        label = f"wall_force, {response.label}"
        # Steps are too short for dashes: lightness has to do.
        ax.plot(response.time * clock, response.wall_force, color=look["color"], linewidth=1.1, label=label, zorder=3)
    ax.axhline(-1.0, color=style.GRAY, linewidth=0.5, zorder=2)
    ax.set_ylabel("wall force in N" if data.physical else r"wall force  in $F$")


def _label_time(ax: Axes, data: StepData) -> None:
    clock, unit = _time_unit(data)
    # The last sample ends before the time that was asked for.
    ax.set_xlim(0.0, max(float(response.time[-1] + response.time[1]) for response in data.responses) * clock)
    ax.set_xlabel(f"time  $t$  in {unit}" if data.physical else "time  $t/T$  in sampling periods")


def _looks(count: int) -> list[dict[str, Any]]:
    """A color and a line style for every response."""
    return [{"color": _COLORS[k % len(_COLORS)], "linestyle": _STYLES[k % len(_STYLES)]} for k in range(count)]


def _legend_handles(ax: Axes, data: StepData) -> list[Line2D]:
    """The responses, and what the dots mean."""
    handles, _ = ax.get_legend_handles_labels()
    lines = [handle for handle in handles if isinstance(handle, Line2D)]
    if any(response.settles_in_view for response in data.responses):
        lines.append(Line2D([], [], linestyle="", marker="o", markersize=4.5, color=style.GRAY, label=SETTLED))
    return lines


def _text(response: Response) -> str:
    settles = "" if response.settles_in_view else ", not settled"
    return rf"{response.label}  ($\alpha = {response.alpha:.3g}$, $\beta = {response.beta:.3g}$){settles}"


def _time_unit(data: StepData) -> tuple[float, str]:
    if not data.physical:
        return 1.0, ""
    return style.si_unit(max(float(response.time[-1]) for response in data.responses), "s")


def _position_unit(data: StepData) -> tuple[float, str]:
    if not data.physical:
        return 1.0, ""
    # The final position: an unstable response has no largest one worth a unit.
    finals = [abs(response.final_position) for response in data.responses if np.isfinite(response.final_position)]
    return style.si_unit(max(finals, default=0.0), "m")
