"""The results of a sweep: as a dataset, in other formats, and verified file by file."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.sweep.store import (
    SEAL,
    Store,
    check_installed,
    find_store,
    list_stores,
    silence_zarr,
)
from zwidth.words.errors import StoreError, StoreExistsError
from zwidth.words.files import hidden_beside
from zwidth.words.formatting import header, to_cell
from zwidth.words.quantities import NOT_COMPUTED, OUTPUTS, VARIABLES

if TYPE_CHECKING:
    import xarray

MAX_CSV_POINTS = 1_000_000


def open_dataset(path: str | os.PathLike[str]) -> xarray.Dataset:
    """Open the results of a sweep, without reading them yet.

    Every file is compared with its checksum when it is read, values when they are asked for. What is damaged or missing
    is a `StoreError` that names it; `zwidth.run` with ``resume`` mends it.

    Args:
        path: a store ``<study>.zarr``, or the folder of a run that holds only one.

    Returns:
        An `xarray.Dataset` backed by dask, one dask chunk a chunk of the store. ``attrs["complete"]`` is 1 where every
        chunk is there; the points of the others have the status 255, "not computed".

    Raises:
        StoreError: there is no store, there are several, or its descriptions or coordinates are damaged.
        InputError: the libraries for stores are not installed.

    Example:
        >>> import tempfile, zwidth
        >>> from zwidth.studies import Config
        >>> axes = {"alpha": [0.1, 0.9], "beta": 0.1, "delta": 0.1, "d": 1}
        >>> studies = [{"kind": "sweep", "name": "small", "axes": axes}]
        >>> config = Config.model_validate({"version": 1, "name": "example", "studies": studies})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = zwidth.run(config, out=folder)
        ...     zwidth.open_dataset(folder).stable.values
        array([ True, False])
    """
    store = find_store(path)
    check_installed()
    import xarray

    # Loads Zarr.
    from zwidth.sweep.checked import CheckedStore

    checked = CheckedStore(store)
    with silence_zarr():
        dataset = xarray.open_zarr(checked, consolidated=store.has_checksums, chunks={})
    # Drop the arrays in which an old store keeps its checksums.
    dataset = dataset[[name for family in store.plan.families for name in family.variables]]
    if "device" in dataset.coords:
        # Neither netCDF nor pandas knows NumPy's strings of variable length.
        labels = np.array([str(label) for label in dataset["device"].values])
        dataset = dataset.assign_coords(device=("device", labels, dataset["device"].attrs))
    hidden = SEAL, "file_checksums", "coordinates"
    dataset.attrs = {key: value for key, value in store.attributes.items() if key not in hidden}
    return dataset.assign_attrs(complete=int(checked.complete))


def to_netcdf(path: str | os.PathLike[str], file: str | os.PathLike[str]) -> None:
    """Write the results of a sweep into one new netCDF-4 file, chunk by chunk.

    Truth values become bytes, and what is nested in the attributes JSON.
    """
    target = _free_place(file)
    dataset = open_dataset(path)
    packed = {name: {"zlib": True, "complevel": 1} for name, variable in dataset.data_vars.items() if variable.ndim}
    for variable in (dataset, *dataset.variables.values()):
        variable.attrs = {key: _plain_attribute(value) for key, value in variable.attrs.items()}
    with hidden_beside(target) as partial:
        # One thread: the HDF5 library is not made for several, and lets only one of them in at a time.
        import dask

        with dask.config.set(scheduler="synchronous"):  # pyright: ignore[reportPrivateImportUsage]
            dataset.to_netcdf(partial, engine="h5netcdf", encoding=packed)
        os.replace(partial, target)


def to_csv(path: str | os.PathLike[str], file: str | os.PathLike[str]) -> None:
    """Write the results of a small sweep as a new table, one row a point, all parameters and outputs in columns.

    Columns in SI units carry their unit, as ``stiffness_N_per_m``; those of normalized quantities none.
    """
    target = _free_place(file)
    dataset = open_dataset(path)
    points = int(np.prod(list(dataset.sizes.values()), dtype=float))
    if points > MAX_CSV_POINTS:
        remedy = "export to netCDF, or select a part with zwidth.open_dataset"
        raise StoreError(f"{os.fspath(path)}: {points} points, a table may have {MAX_CSV_POINTS}; {remedy}")
    if "device" in dataset.coords:
        labels = [to_cell(str(label)) for label in np.atleast_1d(dataset["device"].values)]
        dataset["device"] = (dataset["device"].dims, np.reshape(labels, dataset["device"].shape))
    rows = dataset if dataset.sizes else dataset.expand_dims("point")
    with hidden_beside(target) as partial:
        # What a folder lists first differs from one machine to the next; a table has one order.
        table = rows.to_dataframe(dim_order=sorted(map(str, rows.sizes), key=_place))
        table = table[sorted(map(str, table.columns), key=_place)]
        units = {name: str(values.attrs.get("units", "")) for name, values in rows.variables.items()}
        table.columns = [header(name, units[name]) for name in table.columns]
        table.index.names = [header(str(name), units.get(name, "")) for name in table.index.names]
        table.to_csv(partial, index=bool(dataset.sizes))
        os.replace(partial, target)


_ORDER = (*VARIABLES, *OUTPUTS)


def _place(name: str) -> int:
    """Where a variable stands in the declared order; others come last."""
    return _ORDER.index(name) if name in _ORDER else len(_ORDER)


def _plain_attribute(value: Any) -> Any:
    if isinstance(value, list) and all(isinstance(item, int) for item in value):
        return np.array(value, dtype=np.int64 if max(value, default=0) > NOT_COMPUTED else np.uint8)
    return json.dumps(value) if value is None or isinstance(value, dict | list) else value


def _free_place(file: str | os.PathLike[str]) -> Path:
    target = Path(os.fsdecode(file))
    if target.exists():
        raise StoreExistsError(f"{target} exists already; choose another name or remove it")
    return target


@dataclass(frozen=True)
class Verification:
    """What a store holds, and in which state."""

    path: Path
    chunks: int = 0  # how many it is to have
    done: int = 0  # how many of them are marked as done
    damaged: tuple[str, ...] = ()  # chunks and files that are not what was written, each with what is wrong
    error: str = ""  # why the store cannot be read at all; empty where it can

    @property
    def ok(self) -> bool:
        """Whether everything is there and undamaged."""
        return not self.error and not self.damaged and self.done == self.chunks


def verify(path: str | os.PathLike[str]) -> tuple[Verification, ...]:
    """Read every file of one store, or of all stores in a folder, and compare its checksum; nothing is changed."""
    return tuple(map(_verify_store, list_stores(path)))


def _verify_store(path: Path) -> Verification:
    store = Store(path)
    try:
        if not store.has_checksums:
            return Verification(path, error="old format; this release does not read its checksums")
        tasks = list(store.plan.tasks())
        damaged = [f"{name} is damaged or missing" for name in store.damaged_files()]
    except StoreError as error:
        return Verification(path, error=str(error))
    done = [task for task in tasks if store.is_done(task)]
    damaged += [f"{task}: {fault}" for task in done if (fault := store.fault_of(task))]
    return Verification(path, len(tasks), len(done), tuple(damaged))
