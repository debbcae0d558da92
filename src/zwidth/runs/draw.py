"""Figures from the store of a sweep: which of its variables are drawn, over what, within which exact edges."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.figures.curves import draw_curves, draw_outlines, find_family
from zwidth.figures.grid import choose_axes
from zwidth.figures.plane import Edges, draw_plane
from zwidth.figures.stable_set import Outlines
from zwidth.figures.style import Size, save, style_sheet
from zwidth.parts.checks import check_number
from zwidth.runs.record import RUN_FILE
from zwidth.studies.ridge import find_edges
from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.store import SUFFIX, Store, list_stores
from zwidth.words.errors import InputError, StoreError
from zwidth.words.formatting import short
from zwidth.words.quantities import ANY, OUTPUTS, VARIABLES

if TYPE_CHECKING:
    import xarray

_PLANES = ({"alpha", "beta"}, {"stiffness", "virtual_damping"})
FOLDER = "figures"

# Fewer values than this along both axes are curves rather than a surface.
_SURFACE = 6


def make_edges(store: Store) -> Edges:
    """What gives the outlines of the stable and the passive walls of a part of a sweep, at one device and delay."""
    # The part is one of `zwidth.figures.grid.prepare`. Outlines are in its units, stiffness first. Of what is not a
    # plane of walls, and where nothing is proved, there are none.
    grid = store.plan.grid
    known, dims = grid.coordinates(), [dim.replace(".", "_") for dim in grid.device_dims]
    at_device = cache(lambda place: _outline(store, place))

    def edges(part: xarray.Dataset) -> dict[str, Outlines]:
        walls = {str(dim) for dim in part.dims}
        if walls not in _PLANES:
            return {}
        places = [_find_place(known[dim][1], part[dim]) if dim in part.coords else 0 for dim in dims]
        order = sorted(walls, key=lambda dim: dim not in ("alpha", "stiffness"))
        factors = [part[dim].attrs["factor"] for dim in order]
        found = at_device(tuple(places))
        return {name: [(points * factors, hole) for points, hole in outlines] for name, outlines in found.items()}

    return edges


def _find_place(values: np.ndarray, coordinate: xarray.DataArray) -> int:
    """The index of a part's value among those of the sweep."""
    if values.dtype.kind == "U":
        return values.tolist().index(str(coordinate.values))
    return int(np.argmin(np.abs(values - float(coordinate) / coordinate.attrs["factor"])))


def _outline(store: Store, place: tuple[int, ...]) -> dict[str, Outlines]:
    parameters = store.plan.grid.scene_block(tuple(slice(k, k + 1) for k in place)).parameters
    try:
        return find_edges(store.study.make_scene({name: float(values[0]) for name, values in parameters.items()}))
    except InputError:
        return {}


def draw_stores(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    at: Mapping[str, float | str] | None = None,
    formats: Sequence[str] = ("png", "svg"),
    dpi: float | None = None,
    size: Size | None = None,
    style: Path | None = None,
    progress: Callable[[Path], None] = lambda file: None,
    note: Callable[[str], None] = lambda text: None,
) -> tuple[Path, ...]:
    """Draw the sweeps in a store, or in all stores of a folder, into ``figures`` beside them if ``out`` is left out."""
    # ``at`` chooses slices, by name: the nearest value that the sweep has to one in the units of the store or with one,
    # as "1 ms", or the label of a device; of a parameter that is not given up to three values are shown. ``progress``
    # is called with every file, ``note`` with what a reader should know: other values than those wanted, stores without
    # a figure.
    folder = Path(os.fsdecode(path))
    if (folder / RUN_FILE).is_file() and not any(folder.glob(f"*{SUFFIX}")):
        remedy = "to change their look, run again: zwidth run CONFIG --overwrite --size 85mm --dpi 300"
        raise StoreError(f"{folder}: contains no sweep; the figures of its studies exist already; {remedy}")
    stores = list_stores(folder)
    beside = folder.parent if stores == [folder] else folder
    target = beside / FOLDER if out is None else Path(os.fsdecode(out))
    # As stores spell them.
    wanted = {name.replace(".", "_"): value for name, value in (at or {}).items()}
    datasets = {store: open_dataset(store).reset_coords(drop=True) for store in stores}
    for store in (store for store, data in datasets.items() if not data.attrs["complete"]):
        note(f"{store.name}: chunks are missing and left blank; 'zwidth run CONFIG --resume' computes them")
    known = dict.fromkeys(str(dim) for data in datasets.values() for dim in data.dims)
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise InputError(f"at: no sweep in {folder} varies {unknown[0]!r}; choose from {', '.join(known)}")
    slices = {store: _cut(store, data, wanted, note) for store, data in datasets.items()}
    files = []
    with style_sheet(style, size):
        for store, data in slices.items():
            drawn = list(figures_of(data, make_edges(Store(store))))
            if not drawn:
                note(f"{store.name}: no figure, for {_explain_absence(data)}")
            for name, draw in drawn:
                target.mkdir(parents=True, exist_ok=True)
                stem = target / f"{store.name.removesuffix(SUFFIX)}_{name}"
                for file in save(draw(), stem, formats, dpi):
                    files.append(file)
                    progress(file)
    return tuple(files)


def _explain_absence(data: xarray.Dataset) -> str:
    # A store lists its dimensions in any order.
    varied = [name for name in ("device", *VARIABLES) if data.sizes.get(name, 0) > 1]
    return f"it varies over {', '.join(varied)}, which draws none of its outputs" if varied else "it is a single point"


def figures_of(data: xarray.Dataset, edges: Edges | None = None) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The name of each figure of a sweep, or of a part of one, and what draws it."""
    # A store lists its variables in any order.
    for name in OUTPUTS:
        if name not in data or name == "kind" or (name == "passive" and "stable" in data):
            continue
        over = choose_axes(data, name)
        few = OUTPUTS[name].family == "device" and min((data.sizes[axis] for axis in over), default=0) < _SURFACE
        if len(over) == 2 and not few:
            yield name, partial(draw_plane, data, name, edges=edges)
        elif over and OUTPUTS[name].dtype == "float64":
            yield name, partial(draw_curves, data, name)
    if find_family(data):
        yield "boundaries", partial(draw_outlines, data, edges=edges)


def _cut(
    store: Path, data: xarray.Dataset, wanted: Mapping[str, float | str], note: Callable[[str], None]
) -> xarray.Dataset:
    """The slice of a sweep that is nearest to what is wanted of it."""
    found = {str(dim): _nearest(data, str(dim), wanted[str(dim)]) for dim in data.dims if dim in wanted}
    for dim, (place, exact) in found.items():
        if not exact:
            taken = _spell(float(data[dim][place]), data[dim].attrs["units"])
            note(f"{store.name}: {dim} = {taken}, the nearest to {wanted[dim]} that the sweep has")
    return data.isel({dim: place for dim, (place, _) in found.items()})


def _spell(value: float, unit: str) -> str:
    return f"{short(value)} {unit}".removesuffix(" 1")


def _nearest(data: xarray.Dataset, dim: str, value: float | str) -> tuple[int, bool]:
    """The index of the value that the sweep has and that is closest to the one wanted, and whether it is that."""
    if dim == "device":
        labels = [str(label) for label in data["device"].values]
        if str(value) not in labels:
            raise InputError(f"at: there is no device {str(value)!r}; choose from {', '.join(labels)}")
        return labels.index(str(value)), True
    unit = data[dim].attrs["units"]
    try:
        wanted = float(value)
    except ValueError:
        if unit in ("1", "sampling periods"):
            remedy = f"write a number in {unit}".removesuffix(" in 1")
            raise InputError(f"at: {dim}: got {value!r}; {remedy}") from None
        wanted = check_number(f"at: {dim}", value, unit, ANY)
    if not np.isfinite(wanted):
        raise InputError(f"at: {dim}: got {value!r}; write a finite number")
    values = np.asarray(data[dim].values, dtype=float)
    place, ordered = int(np.argmin(np.abs(values - wanted))), np.sort(values)
    # Half a step beyond either end; a single value has none.
    steps = np.diff(ordered) if values.size > 1 else np.zeros(1)
    slack = 1e-9 * abs(wanted)
    if not ordered[0] - 0.5 * steps[0] - slack <= wanted <= ordered[-1] + 0.5 * steps[-1] + slack:
        has = " to ".join(_spell(float(end), unit) for end in dict.fromkeys((ordered[0], ordered[-1])))
        raise InputError(f"at: {dim}: got {_spell(wanted, unit)}, the sweep has {has}; choose a value that it has")
    return place, bool(np.isclose(values[place], wanted, rtol=1e-9, atol=0.0))
