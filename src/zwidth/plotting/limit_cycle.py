"""Draw limit cycles of walls: amplitude over two parameters, and amplitude and frequency over one parameter.

A *condition* is a set of simulation conditions, such as friction and encoder resolution; each condition has its own
panel, or column of panels. Each point of a figure is a wall whose simulated motion has an amplitude. The *bounds* are
the smallest and the largest amplitude that counts as a limit cycle. Below them the motion counts as at rest; above
them it is not drawn as a limit cycle (in the plane of two parameters such points are hatched). *Edges* are the
stability boundary of the linear theory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter

from zwidth.plotting import grid, style
from zwidth.plotting.table import Table, curves, draws_tables, grid_in_order
from zwidth.simulation.result import MotionKind
from zwidth.units.formatting import count_digits_apart, format_short, header
from zwidth.units.quantities import FIELDS

# Parameters that may be an axis of the figures, by the name of their array.
AXES = {
    header(name, FIELDS[name].unit): FIELDS[name] for name in ("stiffness", "virtual_damping", "resolution", "coulomb")
}
_MAX_DOTS = 12  # largest number of points of a curve for which each point is drawn as a large dot
_CYCLES = ("amplitude_m", "frequency_Hz", "outcome", "linearly_stable")  # names of the arrays with one value per wall
# Colors and hatching of the walls whose motion has an amplitude above the upper bound.
_BEYOND: dict[str, Any] = {"facecolor": grid.MISSING, "edgecolor": "#A8A8A8", "hatch": "////", "linewidth": 0.0}
_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")  # formatter of tick labels without powers of ten


@draws_tables
def draw_limit_cycles(
    arrays: Mapping[str, np.ndarray], edges: Table, bounds: tuple[float, float], axes: style.AnyAxes | None = None
) -> np.ndarray:
    """Draw the amplitude of limit cycles over two parameters, one panel per condition.

    White marks walls at rest, hatching amplitudes above the upper bound, a line the boundary of the linear theory.

    Args:
        arrays: Arrays of the npz file of a limit_cycle study.
        edges: Columns condition, number and those of the two parameters; empty if there is no linear boundary.
        bounds: Smallest and largest amplitude counted as a limit cycle, in m.
        axes: Existing Axes, one per condition.
    """
    across, along = names = [name for name in AXES if name in arrays]
    arrays = grid_in_order(arrays, names)
    labels = arrays["condition"].tolist()
    columns = len(labels) if len(labels) <= 3 else 2
    rows = -(-len(labels) // columns)
    size = (max(1.3 + 2.5 * columns, 5.6), 1.3 + 2.4 * rows) if len(labels) > 1 else (5.8, 4.3)
    panels = style.panels(axes, len(labels), *size, columns, sharex=True, sharey=True)
    scales = {name: style.si_unit(arrays[name], AXES[name].unit) for name in names}
    beyond = _find_beyond(arrays, bounds)
    factor, meter = style.si_unit(np.sqrt(bounds[0] * bounds[1]), "m")
    norm = LogNorm(bounds[0] * factor, bounds[1] * factor)
    colors = matplotlib.colormaps["viridis_r"].with_extremes(under="white", bad=(0, 0, 0, 0))
    image: Any = None
    for k, (ax, label) in enumerate(zip(panels, labels, strict=False)):
        x, y = arrays[across] * scales[across][0], arrays[along] * scales[along][0]
        if beyond[k].any():
            # Hatch the whole panel before drawing colored cells, which cover the hatching except for large amplitudes.
            ax.fill_between([x.min(), x.max()], y.min(), y.max(), **_BEYOND, zorder=0.5)
        shown = np.where(beyond[k], np.nan, np.maximum(arrays["amplitude_m"][k], 1e-300)) * factor
        look: dict[str, Any] = {"shading": "nearest", "rasterized": True, "zorder": 1}
        image = ax.pcolormesh(x, y, shown.T, cmap=colors, norm=norm, **look)
        for edge_curve in curves(edges, "number", condition=label) if edges else ():
            ends = (getattr(edge_curve, name) * scales[name][0] for name in names)
            ax.plot(*ends, color=style.VERMILION, linewidth=1.2, label=f"linear, {edge_curve.number}", zorder=3)
        if len(labels) > 1:
            ax.set_title(style.literal(label))
        grid.scale_axis(ax, "x", x)
        grid.scale_axis(ax, "y", y)
    style.label_axes(
        panels, *(f"{AXES[name].label_in(style.units())}  in {scales[name][1]}" for name in names), once=axes is None
    )
    figure = style.figure_of(panels)
    label = f"amplitude of the limit cycle  in {meter}"
    figure.colorbar(image, ax=list(panels), label=label, shrink=0.9, format=_PLAIN)
    edge: dict[str, Any] = {"edgecolor": style.BLACK, "linewidth": 0.6}
    handles: list[Any] = [
        Patch(facecolor="white", label="at rest", **edge),
        Patch(**_BEYOND, label=f"larger than {format_short(bounds[1], style.units()['m'])}"),
    ]
    handles += [style.line("boundary of the linear theory", width=1.2, color=style.VERMILION)] if edges else []
    style.legend(panels, handles, outside=axes is None, ncols=3)
    return panels


def _find_beyond(arrays: Mapping[str, np.ndarray], bounds: tuple[float, float]) -> np.ndarray:
    """Return a mask of the motions that diverge, have no amplitude, or have an amplitude above the upper bound."""
    return (arrays["outcome"] == MotionKind.DIVERGED) | ~(arrays["amplitude_m"] <= bounds[1])


@draws_tables
def draw_limit_cycle_curves(
    arrays: Mapping[str, np.ndarray],
    edges: Table,
    bounds: tuple[float, float],
    family: str = "",
    axes: style.AnyAxes | None = None,
) -> np.ndarray:
    """Draw amplitude (top) and frequency (bottom) of limit cycles over one parameter, one column per condition.

    A curve has a gap where the motion is at rest or its amplitude exceeds the upper bound. A text in a panel names the
    curves without any limit cycle. A vertical line marks the stability boundary of the linear theory.

    Args:
        arrays: Arrays of the npz file of a limit_cycle study.
        edges: Columns condition, number and the parameter; empty if there is no linear boundary.
        bounds: Smallest and largest amplitude counted as a limit cycle, in m.
        family: Name of the array of a second parameter, with one curve per value; "" if there is none.
        axes: Existing Axes, those of the amplitudes first.
    """
    names = [name for name in AXES if name in arrays]
    arrays = grid_in_order(arrays, names)
    labels = arrays["condition"].tolist()
    (over,) = (name for name in names if name != family)
    size = (max(1.0 + 2.7 * len(labels), 5.8), 4.8)
    panels = style.panels(axes, 2 * len(labels), *size, len(labels), sharex=True, sharey="row")
    scale, unit = style.si_unit(arrays[over], AXES[over].unit)
    # Arrange all arrays with the axes condition, curve and point of the curve.
    grids = {name: arrays[name] if family else arrays[name][:, None] for name in _CYCLES}
    cycles = {name: values.swapaxes(1, 2) if names[-1] == family else values for name, values in grids.items()}
    oscillating = ~_find_beyond(cycles, bounds) & (cycles["amplitude_m"] >= bounds[0])
    factor, meter = style.si_unit(cycles["amplitude_m"][oscillating], "m")
    # Choose the ticks from the amplitudes of all panels, because the panels of a row share the axis.
    amplitudes = cycles["amplitude_m"][oscillating] * factor
    quantities = (("amplitude_m", factor, f"amplitude  in {meter}"), ("frequency_Hz", 1.0, "frequency  in Hz"))
    looks = _list_looks(arrays, family, cycles["linearly_stable"])
    # Draw dots in addition to lines, because a wall with a limit cycle between two walls at rest has no line segment.
    dots = {"marker": "o", "markersize": 3.5 if arrays[over].size <= _MAX_DOTS else 1.25, "clip_on": False}
    largest = format_short(bounds[1], style.units()["m"])
    for row, (name, scaling, words) in enumerate(quantities):
        for column, ax in enumerate(panels[row * len(labels) : (row + 1) * len(labels)]):
            for curve, is_cycle, look in zip(cycles[name][column], oscillating[column], looks, strict=True):
                shown = np.where(is_cycle, curve, np.nan) * scaling
                ax.plot(arrays[over] * scale, shown, linewidth=1.0, **dots, **look)
            grid.scale_axis(ax, "x", arrays[over] * scale)
            for edge_curve in curves(edges, "number", condition=labels[column]) if edges and not family else ():
                ax.axvline(getattr(edge_curve, over)[0] * scale, color=style.VERMILION, linewidth=1.0, label="linear")
            if row == 0:
                _name_absent(ax, looks, oscillating[column], cycles[name][column] < bounds[0], largest)
                if amplitudes.size:
                    style.use_logarithmic(ax, "y", amplitudes)
                ax.set_title(style.literal(labels[column]) if len(labels) > 1 else "")
            else:
                ax.set_xlabel(f"{AXES[over].label_in(style.units())}  in {unit}")
            if column == 0:
                ax.set_ylabel(words)
    handles = [style.line(look["label"], look["linestyle"], color=look["color"]) for look in looks]
    boundary = [style.line("boundary of the linear theory", width=1.0, color=style.VERMILION)] if edges else []
    gap = style.line(f"gap: at rest, or larger than {largest}", "")
    style.legend(panels, [*(handles if family else boundary), gap], outside=axes is None, ncols=4)
    return panels


def _name_absent(
    ax: Axes, looks: list[dict[str, Any]], cycles: np.ndarray, rest: np.ndarray, largest_amplitude: str
) -> None:
    """Write the labels of the curves without any limit cycle into a panel, with the reason.

    Args:
        ax: Axes of the panel.
        looks: Line properties and label of each curve.
        cycles: Mask of the points that are limit cycles, of shape (curve, point).
        rest: Mask of the points at rest, of shape (curve, point).
        largest_amplitude: Upper bound of the amplitude, as text.
    """
    reasons: dict[str, list[str]] = {}
    for look, cycle, resting in zip(looks, cycles, rest, strict=True):
        if not cycle.any():
            too_large = f"larger than {largest_amplitude}"
            reason = (
                f"{'at rest' if resting.all() else too_large} everywhere"
                if resting.all() or not resting.any()
                else (f"at rest or {too_large}")
            )
            reasons.setdefault(reason, []).append(look["label"])
    blocks = []
    for reason, names in reasons.items():
        lines = [", ".join(names[k : k + 2]) for k in range(0, len(names), 2)]
        blocks.append(reason + (":\n" + ",\n".join(lines) if len(looks) > 1 else ""))
    if blocks:
        look: dict[str, Any] = {"fontsize": 7.5, "color": style.GRAY, "va": "center"}
        ax.text(0.04, 0.5, "\n".join(blocks), transform=ax.transAxes, **look)


def _list_looks(arrays: Mapping[str, np.ndarray], family: str, stable: np.ndarray) -> list[dict[str, Any]]:
    """Return a list of line properties, including the label, with one entry per curve.

    The label states the value of the parameter, and whether all walls of the curve are unstable.

    Args:
        arrays: Arrays of the npz file of a limit_cycle study.
        family: Name of the array of the parameter with one curve per value; "" if there is none.
        stable: Mask of the walls that are stable by the linear theory, of shape (condition, curve, point).
    """
    if not family:
        return [{**style.look(0), "label": "limit cycle"}]
    values, parameter = arrays[family], AXES[family]
    scaling, unit = style.si_unit(values, parameter.unit)
    colors = style.ordered_colors(values.size)
    unstable = [not np.any(stable[:, k]) for k in range(values.size)]
    digits = count_digits_apart((values * scaling).tolist())
    texts = [f"${parameter.symbol} = {value * scaling:.{digits}g}$ {unit}" for value in values]
    return [
        {**style.look(k), "color": color, "label": text + (", unstable" if all_unstable else "")}
        for k, (color, text, all_unstable) in enumerate(zip(colors, texts, unstable, strict=True))
    ]
