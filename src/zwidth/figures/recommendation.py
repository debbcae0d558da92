"""The recommended wall of a device: its place in the stable region, and its response, in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from zwidth.figures import style
from zwidth.figures.stable_set import draw_stable_set
from zwidth.figures.step import draw_positions
from zwidth.figures.table import SI_COLUMNS, Table


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
    wall, maximum = found["recommended"], found["maximum"]
    curve = np.asarray(region["curve"])
    outlines = {name: region[name] for name in SI_COLUMNS} | {"number": np.zeros(curve.size, int)}
    outlines |= {"label": np.full(curve.size, ""), "piece": np.where(curve == "passive", curve, "outline")}
    kinds = np.array(["stiffest", f"recommended ({100 * wall['stiffness_fraction']:g} %)"])
    walls = {name: np.array([row[key] for row in (maximum, wall)]) for name, key in zip(SI_COLUMNS, _WALL, strict=True)}
    draw_stable_set(outlines, {"label": np.array(["", ""]), "wall": kinds, **walls}, panels[:1])
    factor, _ = style.si_unit(maximum["stiffness"], "N/m")
    # A bound that is not known is None in JSON.
    interval = np.array([wall["virtual_damping_lower"], wall["virtual_damping_upper"]], dtype=np.float64)
    look = {"color": style.GRAY, "linewidth": 1.0, "label": "virtual_damping_interval"}
    panels[0].plot([wall["stiffness"] * factor] * 2, interval, **look)
    for ax in panels[1:]:
        _draw_response(ax, found, response)
    style.letter(panels)
    return panels


_WALL = ("stiffness", "virtual_damping")


def _draw_response(ax: Axes, found: Mapping[str, Any], response: Table) -> None:
    clock, unit = draw_positions(ax, response)
    time, settled = np.asarray(response["time_s"]), found["recommended"]["settling_time"]
    ax.set_xlim(0.0, float(time[-1] + time[1]) * clock)
    ax.set_xlabel(f"time  $t$  in {unit}")
    if settled is not None and settled <= time[-1]:
        dot = Line2D([], [], linestyle="", marker="o", markersize=4.5, color=ax.lines[0].get_color())
        text = f"settled to 2 % after {settled * clock:.3g} {unit}"
        ax.legend([dot], [text], loc="upper right", handletextpad=0.2)
