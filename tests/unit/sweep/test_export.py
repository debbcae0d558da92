"""Access to finished stores: lazy xarray datasets, netCDF and CSV."""

import csv

import numpy as np
import pytest
import xarray
from sweeping import make_config, run_sweeps, study

from zwidth.core.errors import StoreError, StoreExistsError
from zwidth.sweep import dataset
from zwidth.sweep.dataset import open_dataset, to_csv, to_netcdf

AXES = {"devices": {"label": ["a", "b"], "mass": [0.1, 1], "damping": [1, 2]}, "rate": 1000, "stiffness": [10, 20, 1e6]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    assert run_sweeps(make_config(study(axes=AXES), study("other", axes=AXES)), folder).ok
    return folder


def test_dataset_is_lazy_with_metadata(folder):
    data = open_dataset(folder / "map.zarr")
    assert data.stable.chunks is not None
    assert data.stable.dtype == bool
    assert data.stable.dims == ("device", "stiffness")
    assert list(data.device.values) == ["a", "b"]
    assert data.mass.attrs["units"] == "kg"
    assert data.attrs["complete"] == 1
    assert data.attrs["precision"] == "float64"
    assert {"zwidth", "jax", "numpy"} <= set(data.attrs["versions"])
    assert data.attrs["config"]["name"] == "test"
    assert len(data.attrs["config_sha256"]) == 64
    for name in ("status", "stable"):
        assert len(data[name].attrs["flag_values"]) == len(data[name].attrs["flag_meanings"].split())
    assert data.stable.attrs["flag_meanings"] == "unstable stable"
    assert not data.stable.sel(stiffness=1e6).values.any()


def test_netcdf_has_equal_contents(folder, tmp_path):
    to_netcdf(folder / "map.zarr", tmp_path / "map.nc")
    with xarray.open_dataset(tmp_path / "map.nc") as read, open_dataset(folder / "map.zarr") as data:
        assert read.stable.dtype == bool
        np.testing.assert_array_equal(read.stable, data.stable)
        np.testing.assert_array_equal(read.status, data.status)
        np.testing.assert_array_equal(read.mass, data.mass)
    with pytest.raises(StoreExistsError, match=r"map\.nc already exists"):
        to_netcdf(folder / "map.zarr", tmp_path / "map.nc")
    assert [path.name for path in tmp_path.iterdir()] == ["map.nc"]


def test_csv_has_one_row_per_point(folder, tmp_path, monkeypatch):
    to_csv(folder / "map.zarr", tmp_path / "map.csv")
    with open(tmp_path / "map.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert {"device", "stiffness_N_per_m", "stable", "status", "mass_kg", "rate_Hz", "damping_N_s_per_m"} <= set(
        rows[0]
    )
    assert not {"stiffness", "mass", "rate"} & set(rows[0])
    assert rows[-1]["stable"] == "False"
    monkeypatch.setattr(dataset, "MAX_CSV_POINTS", 5)
    with pytest.raises(StoreError, match="6 points, CSV allows at most 5; export to netCDF"):
        to_csv(folder / "map.zarr", tmp_path / "again.csv")


def test_folder_without_a_unique_store_raises(folder, tmp_path):
    with pytest.raises(StoreError, match=r"contains several stores; name one of map\.zarr, other\.zarr"):
        open_dataset(folder)
    with pytest.raises(StoreError, match="contains no store of a sweep"):
        open_dataset(tmp_path)
    with pytest.raises(StoreError, match=r"it has no zarr\.json"):
        open_dataset(tmp_path / "missing.zarr")
