"""Open the results of a sweep as an xarray dataset, export them to netCDF and CSV, and verify their files.

A *store* is the Zarr group ``<study>.zarr`` with the results of one sweep (`sweep.store`). Its arrays, the *variables*,
are divided into *chunks*, rectangular blocks of the grid with one file each.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.core.errors import StoreError, StoreExistsError
from zwidth.io.files import temporary_sibling
from zwidth.sweep.store import (
    CHECKSUM,
    Store,
    check_installed,
    find_store,
    list_stores,
    silence_zarr,
)
from zwidth.units.formatting import header, to_cell
from zwidth.units.outputs import NOT_COMPUTED, OUTPUTS
from zwidth.units.quantities import VARIABLES

if TYPE_CHECKING:
    import xarray

MAX_CSV_POINTS = 1_000_000  # largest number of rows of an exported CSV table; spreadsheets open about as many


def open_dataset(path: str | os.PathLike[str]) -> xarray.Dataset:
    """Open the results of a sweep; values are read on first access.

    Each file is compared with its checksum when it is read. A damaged or missing file raises a `StoreError` that names
    it; `zwidth.run` with ``resume`` computes it again.

    Args:
        path: A store ``<study>.zarr``, or the folder of a run that contains exactly one store.

    Returns:
        An `xarray.Dataset` backed by dask, with one dask chunk per chunk of the store. ``attrs["complete"]`` is 1 if
        all chunks are computed, otherwise 0; points of missing chunks have the status 255, "not computed".

    Raises:
        StoreError: The path contains no store or several stores, or the description or the coordinates of the store
            are damaged.
        InputError: A library needed for stores is not installed.

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

    # Import `sweep.checked` only after `check_installed`, which reports a missing Zarr, because the import loads Zarr.
    from zwidth.sweep.checked import CheckedStore

    checked = CheckedStore(store)
    with silence_zarr():
        dataset = xarray.open_zarr(checked, consolidated=store.has_checksums, chunks={})
    # Select the variables of the plan, because stores of the old format also contain arrays with checksums.
    dataset = dataset[[name for family in store.plan.families for name in family.variables]]
    if "device" in dataset.coords:
        # Convert the labels, because netCDF and pandas do not support NumPy's strings of variable length.
        labels = np.array([str(label) for label in dataset["device"].values])
        dataset = dataset.assign_coords(device=("device", labels, dataset["device"].attrs))
    hidden = CHECKSUM, "file_checksums", "coordinates"
    dataset.attrs = {key: value for key, value in store.attributes.items() if key not in hidden}
    return dataset.assign_attrs(complete=int(checked.complete))


def to_netcdf(path: str | os.PathLike[str], file: str | os.PathLike[str]) -> None:
    """Write the results of a sweep to a new netCDF-4 file, chunk by chunk.

    Boolean values are written as bytes, and nested attributes as JSON. Raise `StoreExistsError` if the file exists.
    """
    target = _check_target(file)
    dataset = open_dataset(path)
    packed = {name: {"zlib": True, "complevel": 1} for name, variable in dataset.data_vars.items() if variable.ndim}
    for variable in (dataset, *dataset.variables.values()):
        variable.attrs = {key: _convert_attribute(value) for key, value in variable.attrs.items()}
    with temporary_sibling(target) as partial:
        # Use one thread, because the HDF5 library serializes all calls with a global lock.
        import dask

        with dask.config.set(scheduler="synchronous"):  # pyright: ignore[reportPrivateImportUsage]
            dataset.to_netcdf(partial, engine="h5netcdf", encoding=packed)
        os.replace(partial, target)


def to_csv(path: str | os.PathLike[str], file: str | os.PathLike[str]) -> None:
    """Write the results of a small sweep to a new CSV table: one row per point, one column per parameter and output.

    The name of a column ends with its unit, for example ``stiffness_N_per_m``; normalized quantities have no unit.

    Raises:
        StoreError: The sweep has more than a million points.
        StoreExistsError: The file exists.
    """
    target = _check_target(file)
    dataset = open_dataset(path)
    points = int(np.prod(list(dataset.sizes.values()), dtype=float))
    if points > MAX_CSV_POINTS:
        remedy = "export to netCDF, or select a part with zwidth.open_dataset"
        raise StoreError(f"{os.fspath(path)}: {points} points, CSV allows at most {MAX_CSV_POINTS}; {remedy}")
    if "device" in dataset.coords:
        labels = [to_cell(str(label)) for label in np.atleast_1d(dataset["device"].values)]
        dataset["device"] = (dataset["device"].dims, np.reshape(labels, dataset["device"].shape))
    rows = dataset if dataset.sizes else dataset.expand_dims("point")
    with temporary_sibling(target) as partial:
        # Sort the columns, because the order in which a store lists its variables differs between file systems.
        table = rows.to_dataframe(dim_order=sorted(map(str, rows.sizes), key=_rank_variable))
        table = table[sorted(map(str, table.columns), key=_rank_variable)]
        units = {name: str(values.attrs.get("units", "")) for name, values in rows.variables.items()}
        table.columns = [header(name, units[name]) for name in table.columns]
        table.index.names = [header(str(name), units.get(name, "")) for name in table.index.names]
        table.to_csv(partial, index=bool(dataset.sizes))
        os.replace(partial, target)


_ORDER = (*VARIABLES, *OUTPUTS)


def _rank_variable(name: str) -> int:
    """Return the rank of a variable in the order of `units.quantities`; variables not listed there rank last."""
    return _ORDER.index(name) if name in _ORDER else len(_ORDER)


def _convert_attribute(value: Any) -> Any:
    """Convert an attribute to a type that netCDF supports: lists of integers to arrays, nested values to JSON."""
    if isinstance(value, list) and all(isinstance(item, int) for item in value):
        return np.array(value, dtype=np.int64 if max(value, default=0) > NOT_COMPUTED else np.uint8)
    return json.dumps(value) if value is None or isinstance(value, dict | list) else value


def _check_target(file: str | os.PathLike[str]) -> Path:
    """Return the path of a file to be written; raise `StoreExistsError` if it exists."""
    target = Path(os.fsdecode(file))
    if target.exists():
        raise StoreExistsError(f"{target} already exists; choose another name or remove it")
    return target


@dataclass(frozen=True)
class Verification:
    """The result of verifying the files of one store."""

    path: Path
    chunks: int = 0  # number of chunks of the whole sweep
    done: int = 0  # number of chunks marked as done
    damaged: tuple[str, ...] = ()  # names of damaged and missing chunks and files, each with its fault
    error: str = ""  # reason why the store is unreadable; empty if it is readable

    @property
    def ok(self) -> bool:
        """True if all chunks are done and no file is damaged."""
        return not self.error and not self.damaged and self.done == self.chunks


def verify(path: str | os.PathLike[str]) -> tuple[Verification, ...]:
    """Verify the checksum of every file of one store, or of all stores in a folder, without changing any file."""
    return tuple(map(_verify_store, list_stores(path)))


def _verify_store(path: Path) -> Verification:
    """Verify the checksums of one store; report an unreadable store in the field ``error`` of the result."""
    store = Store(path)
    try:
        if not store.has_checksums:
            return Verification(path, error="old format, whose checksums this release cannot read; compute it again")
        tasks = list(store.plan.tasks())
        damaged = [f"{name} is damaged or missing" for name in store.damaged_files()]
    except StoreError as error:
        return Verification(path, error=str(error))
    done = [task for task in tasks if store.is_done(task)]
    damaged += [f"{task}: {fault}" for task in done if (fault := store.find_task_faults(task))]
    return Verification(path, len(tasks), len(done), tuple(damaged))
