"""The results of a sweep as a dataset."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from zwidth.sweep.store import FILES, SEAL, check_installed, find_store, name_checksums, silence_zarr

if TYPE_CHECKING:
    import xarray


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

    attributes = store.attributes
    checked = CheckedStore(store)
    with silence_zarr():
        dataset = xarray.open_zarr(checked, consolidated=False, chunks={})
    dataset = dataset.drop_vars([name_checksums(family.family) for family in store.plan.families])
    if "device" in dataset.coords:
        # Neither netCDF nor pandas knows NumPy's strings of variable length.
        labels = np.array([str(label) for label in dataset["device"].values])
        dataset = dataset.assign_coords(device=("device", labels, dataset["device"].attrs))
    dataset.attrs = {key: value for key, value in attributes.items() if key not in (SEAL, FILES, "coordinates")}
    return dataset.assign_attrs(complete=int(checked.complete))
