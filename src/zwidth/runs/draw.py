"""Draw figures from the store of a sweep: choose its variables, their axes and slices, and add exact boundaries.

A *store* is the Zarr group with the results of one sweep. A *plane* is a figure of an output over two parameters; a
plane *of walls* has the axes stiffness and damping. *Edges* are the exact boundaries of the stable and of the passive
walls, drawn as lines on a plane of walls; an *outline* is one of their closed lines. A *slice* is the part of a sweep
at selected values of some parameters.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.core.errors import InputError, StoreError, UnusableValueError
from zwidth.model.checks import check_number, read_span
from zwidth.plotting.curves import draw_curves, draw_outlines, find_family
from zwidth.plotting.grid import choose_axes
from zwidth.plotting.plane import Edges, draw_plane
from zwidth.plotting.stable_set import Outlines
from zwidth.plotting.style import Size, save, style_sheet
from zwidth.runs.record import RUN_FILE
from zwidth.studies.ridge import find_edges
from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.store import SUFFIX, Store, list_stores
from zwidth.units.formatting import short
from zwidth.units.outputs import OUTPUTS
from zwidth.units.quantities import ANY, VARIABLES

if TYPE_CHECKING:
    import xarray

_PLANES = ({"alpha", "beta"}, {"stiffness", "virtual_damping"})  # dimensions of a plane of walls
FOLDER = "figures"  # default name of the folder of the figures, next to the stores
# Smallest number of values along both axes for which an output of devices is drawn as a plane. With fewer values, the
# output is drawn as curves.
_MIN_SURFACE = 6


def make_edges(store: Store) -> Edges:
    """Return a function that computes the edges for a part of a sweep with one device.

    The part must be prepared by `zwidth.plotting.grid.prepare`. The function returns outlines by name ("stable",
    "passive"), as points (stiffness, damping) in the units of the part. It returns an empty dict if the part is not a
    plane of walls, or if the parameters of its device are invalid.
    """
    grid = store.plan.grid
    coordinates, dims = grid.coordinates(), [dim.replace(".", "_") for dim in grid.device_dims]
    outlines_of_device = cache(lambda indices: _compute_outlines(store, indices))

    def edges(part: xarray.Dataset) -> dict[str, Outlines]:
        walls = {str(dim) for dim in part.dims}
        if walls not in _PLANES:
            return {}
        indices = [_find_index(coordinates[dim][1], part[dim]) if dim in part.coords else 0 for dim in dims]
        order = sorted(walls, key=lambda dim: dim not in ("alpha", "stiffness"))
        factors = [part[dim].attrs["factor"] for dim in order]
        outlines_by_name = outlines_of_device(tuple(indices))
        return {
            name: [(points * factors, hole) for points, hole in outlines] for name, outlines in outlines_by_name.items()
        }

    return edges


def _find_index(values: np.ndarray, coordinate: xarray.DataArray) -> int:
    """Return the index of the scalar coordinate of a part in the array of all values of this parameter in the sweep."""
    if values.dtype.kind == "U":
        return values.tolist().index(str(coordinate.values))
    return int(np.argmin(np.abs(values - float(coordinate) / coordinate.attrs["factor"])))


def _compute_outlines(store: Store, indices: tuple[int, ...]) -> dict[str, Outlines]:
    """Compute the edges of the device with the given index along each device dimension; {} for an invalid device."""
    parameters = store.plan.grid.scene_block(tuple(slice(k, k + 1) for k in indices)).parameters
    try:
        return find_edges(store.study.make_scene({name: float(values[0]) for name, values in parameters.items()}))
    except InputError:
        return {}


def draw_stores(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    selection: Mapping[str, float | str] | None = None,
    formats: Sequence[str] = ("png", "svg"),
    dpi: float | None = None,
    size: Size | None = None,
    style: Path | None = None,
    progress: Callable[[Path], None] = lambda file: None,
    note: Callable[[str], None] = lambda text: None,
) -> tuple[Path, ...]:
    """Draw figures of the sweep in a store, or of all sweeps in a folder.

    Args:
        path: Store, or folder with stores.
        out: Folder of the figures; by default ``figures`` next to the stores.
        selection: Values by name of the parameter that select a slice: a number in the units of the store, a quantity
            with its unit such as "1 ms", or the label of a device. The nearest value of the sweep is drawn. For every
            other parameter that is not an axis, up to three values are drawn.
        formats: File formats.
        dpi: Resolution of pixel graphics, in dots per inch.
        size: Width of the figures, or width and height, in inches.
        style: Path of a matplotlib style sheet.
        progress: Function that is called with the path of every figure.
        note: Function that is called with messages for the user: a value other than the requested one is drawn, chunks
            are missing, or a sweep has no figure.

    Returns:
        The paths of the figures.
    """
    folder = Path(os.fsdecode(path))
    if (folder / RUN_FILE).is_file() and not any(folder.glob(f"*{SUFFIX}")):
        remedy = "to change their look, run again: zwidth run CONFIG --overwrite --size 85mm --dpi 300"
        raise StoreError(f"{folder}: contains no sweep; the figures of its studies already exist; {remedy}")
    stores = list_stores(folder)
    beside = folder.parent if stores == [folder] else folder
    target = beside / FOLDER if out is None else Path(os.fsdecode(out))
    # Replace dots by underscores, because the names of dimensions in stores have underscores in place of dots.
    wanted = {name.replace(".", "_"): value for name, value in (selection or {}).items()}
    datasets = {store: open_dataset(store).reset_coords(drop=True) for store in stores}
    for store in (store for store, data in datasets.items() if not data.attrs["complete"]):
        note(f"{store.name}: chunks are missing and left blank; 'zwidth run CONFIG --resume' computes them")
    varied = dict.fromkeys(str(dim) for data in datasets.values() for dim in data.dims)
    unknown = [name for name in wanted if name not in varied]
    if unknown:
        raise InputError(f"at: no sweep in {folder} varies {unknown[0]!r}; choose from {', '.join(varied)}")
    slices = {store: _select_slice(store, data, wanted, note) for store, data in datasets.items()}
    files = []
    with style_sheet(style, size):
        for store, data in slices.items():
            drawn = list(list_figures(data, make_edges(Store(store))))
            if not drawn:
                note(f"{store.name}: no figure, because {_explain_absence(data)}")
            for name, draw in drawn:
                target.mkdir(parents=True, exist_ok=True)
                stem = target / f"{store.name.removesuffix(SUFFIX)}_{name}"
                for file in save(draw(), stem, formats, dpi):
                    files.append(file)
                    progress(file)
    return tuple(files)


def _explain_absence(data: xarray.Dataset) -> str:
    """Return a phrase with the reason why a sweep has no figure."""
    # Use the order of `VARIABLES`, because the order in which a store lists its variables differs between file systems.
    varied = [name for name in ("device", *VARIABLES) if data.sizes.get(name, 0) > 1]
    return f"no figure shows its outputs over {', '.join(varied)}" if varied else "it is a single point"


def list_figures(data: xarray.Dataset, edges: Edges | None = None) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield pairs: the name of each figure of a sweep or slice, and the function that draws it."""
    # Use the order of `OUTPUTS`, because the order in which a store lists its variables differs between file systems.
    for name in OUTPUTS:
        if name not in data or name == "kind" or (name == "passive" and "stable" in data):
            continue
        over = choose_axes(data, name)
        few = OUTPUTS[name].family == "device" and min((data.sizes[axis] for axis in over), default=0) < _MIN_SURFACE
        if len(over) == 2 and not few:
            yield name, partial(draw_plane, data, name, edges=edges)
        elif over and OUTPUTS[name].dtype == "float64":
            yield name, partial(draw_curves, data, name)
    if find_family(data):
        yield "boundaries", partial(draw_outlines, data, edges=edges)


def _select_slice(
    store: Path, data: xarray.Dataset, wanted: Mapping[str, float | str], note: Callable[[str], None]
) -> xarray.Dataset:
    """Return the slice of a sweep at the values nearest to the requested ones.

    Args:
        store: Path of the store, for messages.
        data: Dataset of the sweep.
        wanted: Requested values by name of the parameter; parameters that the sweep does not vary are ignored.
        note: Function that is called with a message for every parameter whose value differs from the requested one.
    """
    nearest = {str(dim): _find_nearest(data, str(dim), wanted[str(dim)]) for dim in data.dims if dim in wanted}
    for dim, (index, exact) in nearest.items():
        if not exact:
            drawn = _format_value(float(data[dim][index]), data[dim].attrs["units"])
            note(f"{store.name}: {dim} = {drawn}, the value of the sweep nearest to {wanted[dim]}")
    return data.isel({dim: index for dim, (index, _) in nearest.items()})


def _format_value(value: float, unit: str) -> str:
    """Return a value with its unit as text, without the unit if this is 1."""
    return f"{short(value)} {unit}".removesuffix(" 1")


def _count_periods(data: xarray.Dataset, dim: str, value: str) -> float:
    """Return the number of sampling periods of a text with a unit, such as "1 ms" or "1 periods".

    Raise `InputError` if the text is in seconds and the sweep has several sampling periods.
    """
    try:
        span = read_span(value, ANY)
    except UnusableValueError as error:
        raise InputError(f"at: {dim}: {error}") from None
    period = data.attrs["study"]["axes"].get("period")
    if span.unit == "s" and not isinstance(period, float):
        raise InputError(f"at: {dim}: got {value!r}; write a number of sampling periods, because the period varies")
    return span.periods(period)


def _find_nearest(data: xarray.Dataset, dim: str, value: float | str) -> tuple[int, bool]:
    """Return the index of the value of the sweep nearest to the requested one, and whether the two are equal.

    Raise `InputError` if the requested value lies outside the range of the sweep by more than half a step.
    """
    if dim == "device":
        labels = [str(label) for label in data["device"].values]
        if str(value) not in labels:
            raise InputError(f"at: no device {str(value)!r} in the sweep; choose from {', '.join(labels)}")
        return labels.index(str(value)), True
    unit = data[dim].attrs["units"]
    try:
        wanted = float(value)
    except ValueError:
        if unit == "1":
            raise InputError(f"at: {dim}: got {value!r}; write a number") from None
        wanted = (
            _count_periods(data, dim, str(value))
            if unit == "sampling periods"
            else check_number(f"at: {dim}", value, unit, ANY)
        )
    if not np.isfinite(wanted):
        raise InputError(f"at: {dim}: got {value!r}; write a finite number")
    values = np.asarray(data[dim].values, dtype=float)
    index, ordered = int(np.argmin(np.abs(values - wanted))), np.sort(values)
    # Accept requested values up to half a grid step outside the range; if the sweep has a single value, only this
    # value.
    steps = np.diff(ordered) if values.size > 1 else np.zeros(1)
    slack = 1e-9 * abs(wanted)
    if not ordered[0] - 0.5 * steps[0] - slack <= wanted <= ordered[-1] + 0.5 * steps[-1] + slack:
        limits = " to ".join(_format_value(float(end), unit) for end in dict.fromkeys((ordered[0], ordered[-1])))
        raise InputError(f"at: {dim}: got {_format_value(wanted, unit)}, the sweep has {limits}; choose such a value")
    return index, bool(np.isclose(values[index], wanted, rtol=1e-9, atol=0.0))
