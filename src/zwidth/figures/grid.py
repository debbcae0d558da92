"""Common parts of figures of sweeps: axes, panels, values in units with few digits, and labels of contours."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.contour import ContourSet

from zwidth.figures import style
from zwidth.words.formatting import count_digits_apart
from zwidth.words.quantities import NOT_COMPUTED, OF_PARTS, OUTPUTS, STATUS_OF, VARIABLES, WALL
from zwidth.words.status import Status

if TYPE_CHECKING:
    import xarray

    Data = TypeVar("Data", xarray.Dataset, xarray.DataArray)

# The color of a panel where it shows nothing.
MISSING = "#D9D9D9"
# As many values as one panel, or one of several, resolves; of a finer grid every n-th is drawn.
_RESOLVED, _RESOLVED_BY_MANY = 1000, 500
# A grid of more panels than this says nothing on a page: evenly spaced values stand for all.
_ACROSS = 3
_MANY_PANELS = 9
# So many values fit above one of several panels.
_FITTING = 3
# Values that are no exact ratios of each other are on a logarithmic axis from here on, which has 2 and 5 up to there.
_WIDE, _FEW_DECADES = 5.0, 50.0
# What an axis of a plane is, rather than a choice of panels: the first two that vary.
_FIRST = ("alpha", "stiffness", "beta", "virtual_damping")
_PARTS = tuple(parameter.variable for parameter in VARIABLES.values() if parameter.name in OF_PARTS)
_ORDER = (*_FIRST, *_PARTS, "delta", "damping", "d", "delay", "rate", "period", "mass")
_LABEL_FONT = 7.0
# Of a panel, what its labels and the color bar may leave when it is laid out.
_LEFT = 0.72
# In units of a label: how far its middle is from lines and from the middle of other labels.
_FROM_LINES, _FROM_LABELS = 0.6, 1.2
# Points between which a label is placed, in dots.
_LABEL_STEP = 3.0
_CANDIDATES = 60


def list_varied(data: xarray.Dataset, name: str) -> list[str]:
    return [str(dim) for dim in data[name].dims if data.sizes[dim] > 1]


def choose_axes(
    data: xarray.Dataset, name: str, x: str | None = None, y: str | None = None, *, but: Sequence[str | None] = ()
) -> list[str]:
    """Return the one or two parameters over which a variable is drawn: the given ones, then the first that vary."""
    dims = list_varied(data, name)
    free = iter([dim for dim in _ORDER if dim in dims and dim not in (x, y, *but)])
    axes = [x or next(free, None), y or next(free, None)]
    return [dim for dim in axes if dim is not None]


def in_order(data: Data) -> Data:
    """Return results in ascending order of each parameter; devices keep their order."""
    mixed = [dim for dim, index in data.indexes.items() if dim != "device" and not index.is_monotonic_increasing]
    return data.sortby(mixed) if mixed else data


def prepare(data: xarray.Dataset, names: list[str]) -> xarray.Dataset:
    """Return some variables of one family, prepared for drawing."""
    # Only dimensions with two values or more remain, in rising order, single values of the others beside them. All is
    # in units with few digits, which the attribute ``units`` names. What was not computed is NaN; truth values are 0
    # and 1.
    family = OUTPUTS[names[0]].family
    status = STATUS_OF[family]
    data = data[[*names, status]]
    beside = [name for name, values in data.coords.items() if values.ndim and name not in data.dims]
    beside += [name for name in WALL if family == "device" and name not in data.dims]
    data = in_order(data.drop_vars(beside, errors="ignore").squeeze())
    for name in names:
        values, output = data[name], OUTPUTS[name]
        if output.dtype == "bool":
            values = values.astype(float).where(data[status] == Status.OK)
        elif output.dtype == "float64":
            # Two digits of the first slice are enough to choose a prefix.
            part = values.isel({dim: slice(0, 1) for dim in values.dims[:-2]}).values
            part = np.abs(part[np.isfinite(part) & (part != 0)])
            middle = np.median(part) if part.size else 1.0
            factor, unit = style.si_unit(middle, str(values.attrs.get("units", "1")))
            values = (values * factor).where(data[status] != NOT_COMPUTED).assign_attrs(units=unit)
        data[name] = values
    for name, values in data.coords.items():
        if name in VARIABLES:
            # Over many decades the middle has few digits.
            known = values.values
            known = np.sqrt(known.min() * known.max()) if logarithmic(known) else known
            factor, unit = style.si_unit(known, str(values.attrs.get("units", "1")))
            # Without the coordinates of its own, which would bring back those that are scaled already.
            numbers = values.values * factor
            digits = count_digits_apart(numbers.ravel().tolist())
            scaled = (values.dims, numbers, {**values.attrs, "units": unit, "factor": factor, "digits": digits})
            data = data.assign_coords({name: scaled})
    return data.drop_vars(status)


def panels(
    data: xarray.Dataset, over: list[str], plane: Sequence[str] = (), col: str | None = None
) -> tuple[list[xarray.Dataset], int]:
    """Return the part of a dataset for each panel, and the number of panels per row."""
    # A panel has the dimensions ``over``, of which those of a ``plane`` resolve so many values and no more. The last
    # two others vary from panel to panel, or ``col`` alone, all others at their first value.
    free = [str(dim) for dim in next(iter(data.data_vars.values())).dims if dim not in over]
    if col is not None:
        data = data.isel(dict.fromkeys([dim for dim in free if dim != col], 0))
        free = [col]
    data = data.isel(dict.fromkeys(free[:-2], 0))
    free = free[-2:]
    picked = [style.pick_evenly(data.sizes[dim], _MANY_PANELS if len(free) == 1 else _ACROSS) for dim in free]
    places = [dict(zip(free, place, strict=True)) for place in product(*picked)]
    most = _RESOLVED if len(places) == 1 else _RESOLVED_BY_MANY
    thin = {dim: slice(None, None, -(-data.sizes[dim] // most)) for dim in plane}
    parts = [data.isel({**place, **thin}) for place in places]
    if len(free) == 2:
        return parts, len(picked[1])
    return parts, 2 if len(parts) == 4 else min(_ACROSS, len(parts))


def spell(value: xarray.DataArray) -> str:
    """Return a value of a parameter with symbol and unit, with enough digits to distinguish it from the others."""
    if value.name == "device":
        return style.literal(value.values)
    number = f"{float(value):.{value.attrs.get('digits', 4)}g}"
    unit = style.write_unit(value.attrs["units"]).removeprefix("sampling ")
    unit = unit.removesuffix("s") if unit == "periods" and number == "1" else unit
    # Write the unit upright within the formula.
    unit = rf"\,\mathrm{{{unit.replace(' ', '~').replace('$', '')}}}" if unit else ""
    return rf"${VARIABLES[str(value.name)].symbol_in(style.units())} = {number}{unit}$"


def name_panels(axes: np.ndarray, parts: Sequence[xarray.Dataset]) -> None:
    """Write the parameter values of each panel above it; if there are many, only those that differ."""
    first = parts[0]
    names = [name for name in ("device", *VARIABLES) if name in first.coords and not first[name].ndim]
    if len(names) > _FITTING and len(parts) > 1:
        names = [name for name in names if any(part[name].values != first[name].values for part in parts)]
    for ax, part in zip(axes, parts, strict=False):
        ax.set_title(",  ".join(spell(part[name]) for name in names))


def axis_label(data: xarray.Dataset, name: str) -> str:
    """Return the axis label of a parameter, with symbol and unit."""
    return VARIABLES[name].label_in(style.units()) + _in_unit(data, name)


def output_label(data: xarray.Dataset, name: str) -> str:
    """Return the axis label of an output, with symbol and unit."""
    return f"{OUTPUTS[name].words}  ${OUTPUTS[name].symbol}$" + _in_unit(data, name)


def _in_unit(data: xarray.Dataset, name: str) -> str:
    unit = style.write_unit(data[name].attrs.get("units", "1"))
    return f"  in {unit}" if unit else ""


def logarithmic(values: np.ndarray) -> bool:
    """Return whether values have equal ratios, or approximately equal ones over a wide range, such as 1, 2, 5, 10."""
    values = np.asarray(values, dtype=np.float64)
    if values.size < 3 or not (values > 0).all():
        return False
    steps, ratios = np.diff(values), np.diff(np.log(values))
    if not ((ratios > 0).all() or (ratios < 0).all()):
        return False
    if np.allclose(ratios, ratios[0], rtol=1e-6):
        return not np.allclose(steps, steps[0], rtol=1e-6)
    uneven, unequal = (float(np.ptp(each) / np.abs(each.mean())) for each in (steps, ratios))
    return bool(unequal < 0.5 * uneven and values.max() >= _WIDE * values.min())


def find_edges(values: np.ndarray) -> np.ndarray:
    """Where the cells of a plane end, half way between values, up to the first and the last one's own half."""
    scaled = np.log(values) if logarithmic(values) else np.asarray(values, dtype=np.float64)
    middle = 0.5 * (scaled[1:] + scaled[:-1])
    edges = np.concatenate([[2 * scaled[0] - middle[0]], middle, [2 * scaled[-1] - middle[-1]]])
    return np.exp(edges) if logarithmic(values) else edges


def scale_axis(ax: Axes, which: str, values: Any) -> None:
    """The range of an axis, and its spacing."""
    low, high = float(np.min(values)), float(np.max(values))
    if logarithmic(values):
        style.use_logarithmic(ax, which, values, _FEW_DECADES)
    if low < high:
        getattr(ax, f"set_{which}lim")(low, high)


def draw_cells(ax: Axes, x: np.ndarray, y: np.ndarray, values: Any, **look: Any) -> Any:
    """A cell round each point of (y, x); the frame, whose axes are scaled, cuts those at the ends in half."""
    limits = ax.get_xlim(), ax.get_ylim()
    image = ax.pcolormesh(find_edges(x), find_edges(y), values, shading="flat", rasterized=True, **look)
    ax.set(xlim=limits[0], ylim=limits[1])
    return image


def label_contours(
    ax: Axes, drawn: ContourSet, colors: Sequence[Any], shades: Sequence[Any], others: Sequence[np.ndarray] = ()
) -> None:
    """Write the level of each contour, a round number, on its longest line where there is room, once."""
    # The range and the spacing of the axes must be set: where lines are on the page decides on what has room. Each
    # label covers its line with the shade behind it, and keeps away from the points (x, y) of other lines and marks.
    frame = ax.get_window_extent()
    lines = [_list_lines(ax, path.to_polygons(closed_only=False)) for path in drawn.get_paths()]
    taken = _list_lines(ax, [np.atleast_2d(points) for points in others if len(points)])
    placed: list[tuple[np.ndarray, np.ndarray]] = []
    for k, (level, own) in enumerate(zip(drawn.levels, lines, strict=True)):
        text = f"{level:.12g}"
        dots = ax.figure.dpi / 72.0 / _LEFT
        size = dots * _LABEL_FONT * np.array([0.62 * len(text) + 0.4, 1.3])
        line = max(own, key=len, default=None)
        if line is None or np.ptp(line, axis=0).max() < 1.5 * size[0]:
            continue
        off = [each for j, near in enumerate(lines) if j != k for each in near] + taken
        at = _find_place(line, size, frame, off, placed)
        if at is None:
            continue
        placed.append((at, size))
        x, y = ax.transData.inverted().transform(at)
        box = {"facecolor": shades[k], "edgecolor": "none", "pad": 0.6}
        ax.text(x, y, text, fontsize=_LABEL_FONT, color=colors[k], ha="center", va="center", bbox=box, zorder=2.5)


def _list_lines(ax: Axes, lines: Sequence[Any]) -> list[np.ndarray]:
    """Lines in dots, their points so close that a label between two of them touches one."""
    found = []
    for line in lines:
        dots = np.asarray(ax.transData.transform(line))
        dots = dots[np.isfinite(dots).all(axis=1)]
        if not len(dots):
            continue
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(dots, axis=0).T)))
        at = np.linspace(0.0, along[-1], 2 + int(min(along[-1] / _LABEL_STEP, 1000)))
        found.append(np.stack([np.interp(at, along, values) for values in dots.T], -1))
    return found


def _find_place(
    line: np.ndarray, size: np.ndarray, frame: Any, lines: list[np.ndarray], labels: list[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray | None:
    """The point of a line with most room, the one closest to the middle of the frame where several have enough."""
    low, high = np.array([frame.x0, frame.y0]) + 0.6 * size, np.array([frame.x1, frame.y1]) - 0.6 * size
    inside = line[np.all((line > low) & (line < high), axis=1)]
    inside = inside[:: max(1, len(inside) // _CANDIDATES)]
    if not len(inside):
        return None
    room = np.full(len(inside), np.inf)
    if lines:
        away = np.abs(inside[:, None] - np.concatenate(lines)[None]) / size
        room = away.max(axis=2).min(axis=1) / _FROM_LINES
    for at, other in labels:
        room = np.minimum(room, (np.abs(inside - at) / (0.5 * (size + other))).max(axis=1) / _FROM_LABELS)
    # Twice the room that is needed is as good as more.
    off_middle = np.hypot(*((inside - 0.5 * (low + high)) / (high - low)).T)
    best = int(np.argmax(np.minimum(room, 2.0) - 0.2 * off_middle))
    return inside[best] if room[best] >= 1.0 else None
