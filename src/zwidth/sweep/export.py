"""The results of a sweep in other formats: one netCDF file, or a table."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.sweep.dataset import open_dataset
from zwidth.sweep.files.whole import hidden_beside
from zwidth.words.errors import StoreError, StoreExistsError
from zwidth.words.formatting import header, to_cell
from zwidth.words.quantities import NOT_COMPUTED, OUTPUTS, VARIABLES

MAX_CSV_POINTS = 1_000_000


def to_netcdf(path: str | os.PathLike[str], file: str | os.PathLike[str]) -> None:
    """Write the results of a sweep into one netCDF-4 file, chunk by chunk.

    Args:
        path: as for `open_dataset`.
        file: the file to make; truth values become bytes, and what is nested in the attributes JSON.

    Raises:
        StoreError: as `open_dataset`.
        StoreExistsError: the file exists.
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
    """Write the results of a small sweep as a table, one row a point, all parameters and outputs in columns.

    Columns in SI units carry their unit, as ``stiffness_N_per_m``; those of normalized quantities none.

    Args:
        path: as for `open_dataset`.
        file: the file to make.

    Raises:
        StoreError: as `open_dataset`, or more than a million points.
        StoreExistsError: the file exists.
    """
    target = _free_place(file)
    dataset = open_dataset(path)
    points = int(np.prod(list(dataset.sizes.values()), dtype=float))
    if points > MAX_CSV_POINTS:
        raise StoreError(
            f"{os.fspath(path)}: {points} points, a table may have {MAX_CSV_POINTS}; export to netCDF, or select "
            "a part with zwidth.open_dataset"
        )
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
    """An attribute of a kind that netCDF knows."""
    if isinstance(value, list) and all(isinstance(item, int) for item in value):
        return np.array(value, dtype=np.int64 if max(value, default=0) > NOT_COMPUTED else np.uint8)
    return json.dumps(value) if value is None or isinstance(value, dict | list) else value


def _free_place(file: str | os.PathLike[str]) -> Path:
    target = Path(os.fsdecode(file))
    if target.exists():
        raise StoreExistsError(f"{target} exists already; choose another name or remove it")
    return target
