"""The recommended wall of a device: its place in the stable region, and its response, in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.region import mark_wall, name_axes, shade_region
from zwidth.figures.step import draw_positions
from zwidth.figures.table import SI_COLUMNS, Table, curves


@style.house_style()
def draw_recommendation(
    found: Mapping[str, Any], region: Table, response: Table, axes: style.AnyAxes | None = None
) -> np.ndarray:
    """Draw the stable region over K and B with the recommended wall, and the response of the position to 1 N.

    Args:
        found: the recommendation, as its JSON file holds it.
        region: columns of a boundary study of the device, in SI units.
        response: columns of a step study of the device with this wall.
        axes: an Axes of yours for the region alone, or two.
    """
    panels = style.panels(axes, 2, style.WIDTH, 3.5, 2)
    _draw_region(panels[0], found, region)
    for ax in panels[1:]:
        _draw_response(ax, found, response)
    style.letter(panels)
    return panels


def _draw_region(ax: Axes, found: Mapping[str, Any], region: Table) -> None:
    factor, unit = style.si_unit(found["maximum"]["stiffness"], "N/m")
    for curve in curves(region, "curve"):
        stiffness, damping = getattr(curve, SI_COLUMNS[0]) * factor, getattr(curve, SI_COLUMNS[1])
        if curve.curve == "passive":
            _draw_passive(ax, stiffness, damping)
        elif curve.curve == "boundary":
            shade_region(ax, [(np.stack([stiffness, damping], -1), False)], style.SKY, alpha=0.25)
            ax.plot(stiffness, damping, color=style.BLUE, label="boundary", zorder=3)
            ax.set_xlim(-0.02 * float(stiffness.max()), 1.26 * float(stiffness.max()))
    _mark_walls(ax, found, factor, unit)
    name_axes(ax, unit)


def _draw_passive(ax: Axes, stiffness: np.ndarray, virtual_damping: np.ndarray) -> None:
    """The passive walls among the stable ones."""
    look: dict[str, Any] = {"color": style.VERMILION, "linestyle": style.DASH_DOTTED, "linewidth": 1.2, "zorder": 3}
    shade_region(ax, [(np.stack([stiffness, virtual_damping], -1), False)], style.VERMILION, alpha=0.15, zorder=1.5)
    ax.plot(stiffness, virtual_damping, label="passive", **look)
    # Above the upper edge, which runs from the stiffest passive wall back to K = 0.
    tip = int(np.argmax(stiffness))
    middle = tip + int(np.argmin(np.abs(stiffness[tip:] - 0.5 * stiffness[tip])))
    place = (stiffness[middle], virtual_damping[middle])
    above: dict[str, Any] = {"xytext": (0, 8), "textcoords": "offset points", "ha": "center", "va": "center"}
    ax.annotate("passive", place, color=style.VERMILION, fontsize=8, zorder=6, **above)


def _mark_walls(ax: Axes, found: Mapping[str, Any], factor: float, unit: str) -> None:
    """The stiffest wall, the recommended one, and the damping that may go with its stiffness."""
    wall, maximum = found["recommended"], found["maximum"]
    stiffness, damping = wall["stiffness"] * factor, wall["virtual_damping"]
    # A bound that is not known is None in JSON.
    interval = np.array([wall["virtual_damping_lower"], wall["virtual_damping_upper"]], dtype=np.float64)
    ax.plot([stiffness, stiffness], interval, color=style.GRAY, linewidth=1.0, label="virtual_damping_interval")
    top = (maximum["stiffness"] * factor, maximum["virtual_damping"])
    words = r"$K_{\max} =$" + f"\n{top[0]:.3g} {unit}"
    mark_wall(ax, top, "stiffness_max", kind="stiffest", text=words, right=True)
    share = f"{100 * wall['stiffness_fraction']:g} %"
    text = f"recommended ({share}):\n$K = {stiffness:.3g}$ {unit}\n$B = {damping:.3g}$ N s/m"
    mark_wall(ax, (stiffness, damping), "recommended", kind="recommended", text=text)


def _draw_response(ax: Axes, found: Mapping[str, Any], response: Table) -> None:
    clock, unit = draw_positions(ax, response)
    time, settled = np.asarray(response["time_s"]), found["recommended"]["settling_time"]
    ax.set_xlim(0.0, float(time[-1] + time[1]) * clock)
    ax.set_xlabel(f"time  $t$  in {unit}")
    if settled is not None and settled <= time[-1]:
        dot = Line2D([], [], linestyle="", marker="o", markersize=4.5, color=ax.lines[0].get_color())
        text = f"settled to 2 % after {settled * clock:.3g} {unit}"
        ax.legend([dot], [text], loc="upper right", handletextpad=0.2)
