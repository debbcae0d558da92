"""Figures from the store of a sweep: which of its variables are drawn, over what, and at which values of the rest."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.errors import InputError, StoreError
from zwidth.figures.curves import draw_curves, draw_outlines, find_outlines
from zwidth.figures.grid import choose_axes
from zwidth.figures.plane import draw_plane
from zwidth.figures.style import save
from zwidth.quantities import OUTPUTS
from zwidth.sweep.store import SUFFIX, find_stores, open_dataset

if TYPE_CHECKING:
    import xarray

FOLDER = "figures"

# Fewer values than this along both axes are curves rather than a surface.
_SURFACE = 6


def draw_stores(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    at: Mapping[str, float | str] | None = None,
    progress: Callable[[Path], None] | None = None,
) -> tuple[Path, ...]:
    """Draw the sweeps in a store, or in all stores of a folder, as PNG and SVG.

    Args:
        path: a store ``<study>.zarr`` or the folder of a run.
        out: where the figures go; ``figures`` beside the stores where left out. Figures that are there are replaced.
        at: values of parameters by name, in the units of the store, or the label of a device: the slices to draw. The
            nearest values that the sweep has are taken; of a parameter that is not given, up to three are shown.
        progress: called with every file when it is there.

    Returns:
        The files.

    Raises:
        StoreError: there is no store, or one is damaged.
        InputError: no sweep has a parameter of ``at``, or not the device.
    """
    folder = Path(os.fsdecode(path))
    stores = find_stores(folder)
    if not stores:
        raise StoreError(f"{folder}: holds no store of a sweep; name the folder of a run, or a store in it")
    beside = folder.parent if stores == [folder] else folder
    target = beside / FOLDER if out is None else Path(os.fsdecode(out))
    wanted = {name.replace(".", "_"): value for name, value in (at or {}).items()}
    datasets = {store: open_dataset(store).reset_coords(drop=True) for store in stores}
    known = dict.fromkeys(str(dim) for data in datasets.values() for dim in data.dims)
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise InputError(f"at: no sweep in {folder} varies {unknown[0]!r}; choose from {', '.join(known)}")
    slices = {
        store: data.isel({str(dim): _nearest(data, str(dim), wanted[str(dim)]) for dim in data.dims if dim in wanted})
        for store, data in datasets.items()
    }
    target.mkdir(parents=True, exist_ok=True)
    files = []
    for store, data in slices.items():
        for name, draw in figures_of(data):
            for file in save(draw(), target / f"{store.name.removesuffix(SUFFIX)}_{name}"):
                files.append(file)
                (progress or (lambda file: None))(file)
    return tuple(files)


def figures_of(data: xarray.Dataset) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The name of each figure of a sweep, or of a part of one, and what draws it."""
    for name in map(str, data.data_vars):
        if name not in OUTPUTS or name == "kind" or (name == "passive" and "stable" in data):
            continue
        axes = choose_axes(data, name)
        few = OUTPUTS[name].family == "device" and min((data.sizes[axis] for axis in axes), default=0) < _SURFACE
        if len(axes) == 2 and not few:
            yield name, partial(draw_plane, data, name)
        elif axes and OUTPUTS[name].dtype == "float64":
            yield name, partial(draw_curves, data, name)
    if find_outlines(data):
        yield "boundaries", partial(draw_outlines, data)


def _nearest(data: xarray.Dataset, dim: str, value: float | str) -> int:
    """The index of the value that the sweep has and that is closest to the one wanted."""
    if dim == "device":
        labels = [str(label) for label in data["device"].values]
        if str(value) not in labels:
            raise InputError(f"at: there is no device {str(value)!r}; choose from {', '.join(labels)}")
        return labels.index(str(value))
    try:
        wanted = float(value)
    except ValueError as error:
        raise InputError(f"at: {dim}: got {value!r}; write a number in {data[dim].attrs['units']}") from error
    if not np.isfinite(wanted):
        raise InputError(f"at: {dim}: got {value!r}; write a finite number")
    return int(np.argmin(np.abs(np.asarray(data[dim].values, dtype=float) - wanted)))
