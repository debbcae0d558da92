"""Prepare and annotate figures of sweeps: choose axes and panels, scale units, draw cells, and label contours.

A figure of a sweep shows a *variable* (an output) of an `xarray.Dataset` over one or two parameters, the *axes*; a
*plane* is a figure over two parameters. A *panel* is one Axes of a figure; further parameters that vary have one panel
per value. A *cell* is the colored rectangle that a plane shows for one point of the grid. *Dots* are pixels of the
drawing. The *clearance* of a label is its distance from other lines and labels, relative to the least allowed distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet

from zwidth.core.status import Status
from zwidth.plotting import style
from zwidth.units.formatting import count_digits_apart
from zwidth.units.outputs import NOT_COMPUTED, OUTPUTS, STATUS_OF
from zwidth.units.quantities import OF_PARTS, VARIABLES, WALL

if TYPE_CHECKING:
    import xarray

    Data = TypeVar("Data", xarray.Dataset, xarray.DataArray)

MISSING = "#D9D9D9"  # color of cells without a value

# Largest numbers of values and panels in a figure. If a sweep has more, only evenly spaced ones are drawn.
_MAX_VALUES = 1000  # number of values along an axis, in a figure with a single panel
_MAX_VALUES_OF_MANY = 500  # number of values along an axis, in a figure with several panels
_MAX_COLUMNS = 3  # number of columns of panels, and of values per parameter if two parameters vary between panels
_MAX_PANELS = 9  # number of panels if one parameter varies between panels
_MAX_TITLE_VALUES = 3  # number of parameter values that fit into the title of one of several panels

# Settings of axes.
_MIN_RATIO = 5.0  # least ratio of the ends of a logarithmic axis if its values have unequal ratios, as 1, 2, 5, 10
_FEW_DECADES = 50.0  # ratio of the ends of a logarithmic axis; below it, 2 and 5 times powers of ten have ticks, too
# The first two varying parameters in the following order become the axes of a plane. The others vary between panels.
_WALL_PARAMETERS = ("alpha", "stiffness", "beta", "virtual_damping")
_PARTS = tuple(parameter.variable for parameter in VARIABLES.values() if parameter.name in OF_PARTS)
_ORDER = (*_WALL_PARAMETERS, *_PARTS, "delta", "damping", "d", "delay", "rate", "period", "mass")

# Settings of contour labels.
_LABEL_FONT = 7.0  # font size, in points
# Factor by which the layout shrinks a panel to make space for axis labels and color bar. Contour labels are placed
# before the layout; therefore their sizes are divided by this factor.
_LAYOUT_SHRINKAGE = 0.72
_LINE_DISTANCE = 0.6  # least distance of the center of a label from other lines, relative to the size of the label
_LABEL_DISTANCE = 1.2  # least distance between the centers of two labels, relative to their mean size
_LABEL_STEP = 3.0  # spacing of the points on a contour at which a label may be placed, in dots
_MAX_CANDIDATES = 60  # largest number of such points that are compared per contour


def list_varied(data: xarray.Dataset, name: str) -> list[str]:
    """Return the dimensions of a variable with more than one value."""
    return [str(dim) for dim in data[name].dims if data.sizes[dim] > 1]


def choose_axes(
    data: xarray.Dataset, name: str, x: str | None = None, y: str | None = None, *, but: Sequence[str | None] = ()
) -> list[str]:
    """Choose the one or two axes over which a variable is drawn.

    Args:
        data: Results of a sweep.
        name: Name of the variable.
        x: Horizontal axis; by default the first parameter that varies, in the order of `_ORDER`.
        y: Vertical axis; by default the next parameter that varies.
        but: Parameters that must not become axes.
    """
    dims = list_varied(data, name)
    free = iter([dim for dim in _ORDER if dim in dims and dim not in (x, y, *but)])
    axes = [x or next(free, None), y or next(free, None)]
    return [dim for dim in axes if dim is not None]


def in_order(data: Data) -> Data:
    """Sort results in ascending order of every parameter; devices keep their order."""
    mixed = [dim for dim, index in data.indexes.items() if dim != "device" and not index.is_monotonic_increasing]
    return data.sortby(mixed) if mixed else data


def prepare(data: xarray.Dataset, names: list[str]) -> xarray.Dataset:
    """Return the variables ``names`` of one family of outputs (walls or devices), prepared for drawing.

    Dimensions with a single value become scalar coordinates; the others are sorted in ascending order. Values and
    coordinates are scaled to units with SI prefixes that keep the numbers short. The attribute ``units`` is the new
    unit, the attribute ``factor`` of a coordinate its scaling factor. Booleans become 0 and 1, and points that were not
    computed NaN.
    """
    family = OUTPUTS[names[0]].family
    status = STATUS_OF[family]
    data = data[[*names, status]]
    unused = [name for name, values in data.coords.items() if values.ndim and name not in data.dims]
    unused += [name for name in WALL if family == "device" and name not in data.dims]
    data = in_order(data.drop_vars(unused, errors="ignore").squeeze())
    for name in names:
        values, output = data[name], OUTPUTS[name]
        if output.dtype == "bool":
            values = values.astype(float).where(data[status] == Status.OK)
        elif output.dtype == "float64":
            # Choose a unit that suits the median of the first plane only, because reading all values of a large store
            # is slow.
            part = values.isel({dim: slice(0, 1) for dim in values.dims[:-2]}).values
            part = np.abs(part[np.isfinite(part) & (part != 0)])
            middle = np.median(part) if part.size else 1.0
            factor, unit = style.si_unit(middle, str(values.attrs.get("units", "1")))
            values = (values * factor).where(data[status] != NOT_COMPUTED).assign_attrs(units=unit)
        data[name] = values
    for name, values in data.coords.items():
        if name in VARIABLES:
            # On a logarithmic axis, choose the unit that suits the geometric mean of both ends instead of the largest
            # value.
            numbers_along = values.values
            numbers_along = (
                np.sqrt(numbers_along.min() * numbers_along.max()) if logarithmic(numbers_along) else numbers_along
            )
            factor, unit = style.si_unit(numbers_along, str(values.attrs.get("units", "1")))
            # Assign NumPy arrays, because assigning a DataArray would replace scaled coordinates of the dataset by
            # unscaled ones.
            numbers = values.values * factor
            digits = count_digits_apart(numbers.ravel().tolist())
            scaled = (values.dims, numbers, {**values.attrs, "units": unit, "factor": factor, "digits": digits})
            data = data.assign_coords({name: scaled})
    return data.drop_vars(status)


def panels(
    data: xarray.Dataset, over: list[str], plane: Sequence[str] = (), col: str | None = None
) -> tuple[list[xarray.Dataset], int]:
    """Return a list with the part of a dataset for each panel, and the number of columns of panels.

    Args:
        data: Results that `prepare` returns.
        over: Dimensions within a panel.
        plane: Dimensions among ``over`` that are axes of a plane; of these, only as many values are kept as a panel can
            resolve.
        col: Parameter that varies between panels; by default the last two dimensions that are not in ``over``. All
            other parameters have their first value.
    """
    free = [str(dim) for dim in next(iter(data.data_vars.values())).dims if dim not in over]
    if col is not None:
        data = data.isel(dict.fromkeys([dim for dim in free if dim != col], 0))
        free = [col]
    data = data.isel(dict.fromkeys(free[:-2], 0))
    free = free[-2:]
    picked = [style.pick_evenly(data.sizes[dim], _MAX_PANELS if len(free) == 1 else _MAX_COLUMNS) for dim in free]
    indices = [dict(zip(free, index, strict=True)) for index in product(*picked)]
    most = _MAX_VALUES if len(indices) == 1 else _MAX_VALUES_OF_MANY
    thinned = {dim: slice(None, None, -(-data.sizes[dim] // most)) for dim in plane}
    parts = [data.isel({**index, **thinned}) for index in indices]
    if len(free) == 2:
        return parts, len(picked[1])
    return parts, 2 if len(parts) == 4 else min(_MAX_COLUMNS, len(parts))


def spell(value: xarray.DataArray) -> str:
    """Return a parameter value as text with symbol and unit; for a device, return its label.

    The text has enough digits to distinguish the values of the parameter.
    """
    if value.name == "device":
        return style.literal(value.values)
    number = f"{float(value):.{value.attrs.get('digits', 4)}g}"
    unit = style.write_unit(value.attrs["units"]).removeprefix("sampling ")
    unit = unit.removesuffix("s") if unit == "periods" and number == "1" else unit
    # Use \mathrm and ~ for the unit, because TeX mathematics is italic and drops spaces.
    unit = rf"\,\mathrm{{{unit.replace(' ', '~').replace('$', '')}}}" if unit else ""
    return rf"${VARIABLES[str(value.name)].symbol_in(style.units())} = {number}{unit}$"


def name_panels(axes: np.ndarray, parts: Sequence[xarray.Dataset]) -> None:
    """Write each panel's parameter values as its title; if they are too many, only those that differ between panels."""
    first = parts[0]
    names = [name for name in ("device", *VARIABLES) if name in first.coords and not first[name].ndim]
    if len(names) > _MAX_TITLE_VALUES and len(parts) > 1:
        names = [name for name in names if any(part[name].values != first[name].values for part in parts)]
    for ax, part in zip(axes, parts, strict=False):
        ax.set_title(",  ".join(spell(part[name]) for name in names))


def axis_label(data: xarray.Dataset, name: str) -> str:
    """Return the axis label of a parameter: words, symbol and unit."""
    return VARIABLES[name].label_in(style.units()) + _in_unit(data, name)


def output_label(data: xarray.Dataset, name: str) -> str:
    """Return the axis label of an output: words, symbol and unit."""
    return f"{OUTPUTS[name].words}  ${OUTPUTS[name].symbol}$" + _in_unit(data, name)


def _in_unit(data: xarray.Dataset, name: str) -> str:
    """Return the end of an axis label that states the unit of a variable; "" if the variable is dimensionless."""
    unit = style.write_unit(data[name].attrs.get("units", "1"))
    return f"  in {unit}" if unit else ""


def logarithmic(values: np.ndarray) -> bool:
    """Return whether the given values of a parameter suggest a logarithmic axis.

    They do if successive values have equal ratios, or if the ratios are nearly equal and that of the last to the first
    value is large, as for 1, 2, 5, 10.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.size < 3 or not (values > 0).all():
        return False
    steps, ratios = np.diff(values), np.diff(np.log(values))
    if not ((ratios > 0).all() or (ratios < 0).all()):
        return False
    if np.allclose(ratios, ratios[0], rtol=1e-6):
        return not np.allclose(steps, steps[0], rtol=1e-6)
    uneven, unequal = (float(np.ptp(each) / np.abs(each.mean())) for each in (steps, ratios))
    return bool(unequal < 0.5 * uneven and values.max() >= _MIN_RATIO * values.min())


def find_edges(values: np.ndarray) -> np.ndarray:
    """Return the edges of the cells along an axis of a plane, each halfway between two values.

    The first and the last value are in the middle of their cells. On logarithmic axes halfway refers to logarithms.
    """
    scaled = np.log(values) if logarithmic(values) else np.asarray(values, dtype=np.float64)
    middle = 0.5 * (scaled[1:] + scaled[:-1])
    edges = np.concatenate([[2 * scaled[0] - middle[0]], middle, [2 * scaled[-1] - middle[-1]]])
    return np.exp(edges) if logarithmic(values) else edges


def scale_axis(ax: Axes, which: str, values: Any) -> None:
    """Set the range of an axis ("x" or "y") to that of its values; make it logarithmic if the values suggest it."""
    low, high = float(np.min(values)), float(np.max(values))
    if logarithmic(values):
        style.use_logarithmic(ax, which, values, _FEW_DECADES)
    if low < high:
        getattr(ax, f"set_{which}lim")(low, high)


def draw_cells(ax: Axes, x: np.ndarray, y: np.ndarray, values: Any, **look: Any) -> Any:
    """Draw a plane as one colored cell per value.

    The limits of the axes are kept; if they are the range of the values, they cut the outer cells in half.

    Args:
        ax: Axes with their limits set.
        x: Horizontal coordinates of the cells.
        y: Vertical coordinates of the cells.
        values: Values or colors, of shape (y, x).
        look: Further arguments of `matplotlib.axes.Axes.pcolormesh`.
    """
    limits = ax.get_xlim(), ax.get_ylim()
    image = ax.pcolormesh(find_edges(x), find_edges(y), values, shading="flat", rasterized=True, **look)
    ax.set(xlim=limits[0], ylim=limits[1])
    return image


def label_contours(
    ax: Axes, drawn: ContourSet, colors: Sequence[Any], shades: Sequence[Any], others: Sequence[np.ndarray] = ()
) -> None:
    """Write the level of each contour once, on its longest line, unless the label would be too close to other lines.

    The limits and scales of the axes must be set before, because distances are measured on the page.

    Args:
        ax: Axes of the contours.
        drawn: The contours, whose levels are round numbers.
        colors: Color of each label.
        shades: Background color of each label, that of the region around its contour.
        others: Points (x, y) of further lines and marks, to which the labels keep a distance.
    """
    frame = ax.get_window_extent()
    lines = [_list_lines(ax, path.to_polygons(closed_only=False)) for path in drawn.get_paths()]
    taken = _list_lines(ax, [np.atleast_2d(points) for points in others if len(points)])
    placed: list[tuple[np.ndarray, np.ndarray]] = []
    for k, (level, pieces) in enumerate(zip(drawn.levels, lines, strict=True)):
        text = f"{level:.12g}"
        dots = ax.figure.dpi / 72.0 / _LAYOUT_SHRINKAGE
        size = dots * _LABEL_FONT * np.array([0.62 * len(text) + 0.4, 1.3])
        line = max(pieces, key=len, default=None)
        if line is None or np.ptp(line, axis=0).max() < 1.5 * size[0]:
            continue
        off = [each for j, near in enumerate(lines) if j != k for each in near] + taken
        center = _place_label(line, size, frame, off, placed)
        if center is None:
            continue
        placed.append((center, size))
        x, y = ax.transData.inverted().transform(center)
        box = {"facecolor": shades[k], "edgecolor": "none", "pad": 0.6}
        ax.text(x, y, text, fontsize=_LABEL_FONT, color=colors[k], ha="center", va="center", bbox=box, zorder=2.5)


def _list_lines(ax: Axes, lines: Sequence[Any]) -> list[np.ndarray]:
    """Convert lines from coordinates of the axes to dots, and resample them with a spacing smaller than a label."""
    resampled = []
    for line in lines:
        dots = np.asarray(ax.transData.transform(line))
        dots = dots[np.isfinite(dots).all(axis=1)]
        if not len(dots):
            continue
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(dots, axis=0).T)))
        steps = np.linspace(0.0, along[-1], 2 + int(min(along[-1] / _LABEL_STEP, 1000)))
        resampled.append(np.stack([np.interp(steps, along, values) for values in dots.T], -1))
    return resampled


def _place_label(
    line: np.ndarray, size: np.ndarray, frame: Any, lines: list[np.ndarray], labels: list[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray | None:
    """Choose the center of a label on a line.

    The chosen point is that with the largest clearance. Clearances of 2 and more count as equal, and points near the
    middle of the frame are preferred.

    Args:
        line: Points of the line, in dots.
        size: Width and height of the label, in dots.
        frame: Bounding box of the panel, in dots.
        lines: Points of other lines and marks, in dots.
        labels: Center and size of the labels placed before, in dots.

    Returns:
        The center of the label in dots; None if no point has a clearance of at least 1.
    """
    low, high = np.array([frame.x0, frame.y0]) + 0.6 * size, np.array([frame.x1, frame.y1]) - 0.6 * size
    inside = line[np.all((line > low) & (line < high), axis=1)]
    inside = inside[:: max(1, len(inside) // _MAX_CANDIDATES)]
    if not len(inside):
        return None
    room = np.full(len(inside), np.inf)
    if lines:
        away = np.abs(inside[:, None] - np.concatenate(lines)[None]) / size
        room = away.max(axis=2).min(axis=1) / _LINE_DISTANCE
    for center, other in labels:
        room = np.minimum(room, (np.abs(inside - center) / (0.5 * (size + other))).max(axis=1) / _LABEL_DISTANCE)
    # Clip the clearance at 2, because among points with a larger one those near the middle of the frame are preferred.
    off_middle = np.hypot(*((inside - 0.5 * (low + high)) / (high - low)).T)
    best = int(np.argmax(np.minimum(room, 2.0) - 0.2 * off_middle))
    return inside[best] if room[best] >= 1.0 else None
