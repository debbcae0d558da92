"""Reading and resuming stores with damaged files: every damage is reported, repaired or harmless."""

import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from sweeping import chunk_file, flip_byte, limit_chunk_sizes, make_config, read_values, run_main, run_sweeps, study

from zwidth.core.errors import StoreError
from zwidth.sweep.dataset import open_dataset, verify

AXES = {"alpha": [0.1, 0.3, 0.9], "beta": [-0.1, 0.2, 0.5], "delta": [0.1, 1.0], "d": [0, 1]}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return configuration, folder and contents of a finished run of several chunks."""
    folder = tmp_path_factory.mktemp("finished")
    config = make_config(study(axes=AXES, outputs=("stable", "passivity_margin", "alpha_max")))
    with pytest.MonkeyPatch.context() as patch:
        limit_chunk_sizes(patch, 5, 2)
        assert run_sweeps(config, folder).computed > 5
    return config, folder, read(folder)


@pytest.fixture
def store(finished, tmp_path):
    """Return the store in a copy of the finished run, to be damaged by the test."""
    shutil.copytree(finished[1], tmp_path / "run")
    return tmp_path / "run" / "map.zarr"


def read(folder):
    """Return all contents of a store, floats as bytes."""
    with open_dataset(folder) as data:
        others = {name: values.values.tolist() for name, values in data.variables.items() if values.dtype.kind != "f"}
        floats = {name: values.values.tobytes() for name, values in data.variables.items() if values.dtype.kind == "f"}
        return others, floats, {name: dict(values.attrs) for name, values in data.variables.items()}, dict(data.attrs)


DAMAGES = {
    "deleted": lambda file: file.unlink(),
    "cut off": lambda file: file.write_bytes(file.read_bytes()[:-1]),
    "empty": lambda file: file.write_bytes(b""),
    "zeros": lambda file: file.write_bytes(bytes(file.stat().st_size)),
    "flipped": flip_byte,
    "grown": lambda file: file.write_bytes(file.read_bytes() + b"0"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("name", ["stable", "status", "alpha_max"])
def test_reading_a_damaged_chunk_raises_with_its_name(store, damage, name):
    file = chunk_file(store, name, 1)
    damage(file)
    if name == "status" and not file.exists():
        # The status file marks its chunk as done; without it the chunk counts as missing.
        assert open_dataset(store).attrs["complete"] == 0
        return
    with open_dataset(store) as data, pytest.raises(StoreError) as caught:
        data[name].load()
    state = "damaged" if file.exists() else "missing"
    assert str(caught.value) == f"{file}: {state}; 'zwidth run CONFIG --resume' computes it again"


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("name", ["stable", "status", "alpha_max"])
def test_damaged_metadata_of_an_array_is_harmless(finished, store, damage, name):
    damage(store / name / "zarr.json")
    assert read(store) == finished[2]
    assert verify(store)[0].ok


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_coordinates_raise_on_opening(store, damage):
    damage(store / "beta" / "c" / "0")
    with pytest.raises(StoreError, match=r"beta/c/0: (damaged|missing)"):
        open_dataset(store)


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("name", ["zarr.json", "zwidth.json"])
def test_damaged_group_metadata_is_replaced_by_its_copy(finished, store, damage, name):
    damage(store / name)
    assert read(store) == finished[2]


def test_unfinished_chunk_is_read_as_missing(finished, store):
    chunk_file(store, "status", 1).unlink()
    with open_dataset(store) as data:
        assert data.attrs["complete"] == 0
        missing_points = data.status.values == 255
        assert 0 < missing_points.sum() <= 5
        assert not data.stable.values[missing_points].any()
        stable = [
            value for value, missing in zip(data.stable.values.flat, missing_points.flat, strict=True) if not missing
        ]
    before = read_values(finished[1])["stable"][~missing_points]
    assert stable == before.tolist()


def test_variables_of_a_chunk_are_consistent_while_a_run_continues(store):
    flag = chunk_file(store, "status", 1)
    kept = flag.read_bytes()
    flag.unlink()
    with open_dataset(store) as data:
        stable = data.stable.values
        # Simulate a run that finishes the chunk now.
        flag.write_bytes(kept)
        assert not stable[data.status.values == 255].any()
        assert (data.status.values == 255).any()


def test_random_damage_is_reported_or_repaired(finished, tmp_path):
    config, source, before = finished
    choice = random.Random(42)
    files = sorted(file.relative_to(source) for file in source.glob("map.zarr/**/*") if file.is_file())
    reported = 0
    for number in range(30):
        run = tmp_path / str(number)
        shutil.copytree(source, run)
        file = run / choice.choice(files)
        choice.choice(list(DAMAGES.values()))(file)
        contents, error = None, ""
        try:
            contents = read(run)
        except StoreError as caught:
            reported, error = reported + 1, str(caught)
        # Without its status file a chunk is correctly reported as missing.
        lost = contents is not None and contents[3]["complete"] == 0 and not file.exists()
        assert contents == before or lost or f"{run / 'map.zarr'}/" in error, file
        if number % 10 == 0:
            assert run_sweeps(config, run, resume=True).ok
            assert read(run) == before
    assert reported > 15


@pytest.mark.parametrize(
    "arguments", [["export", "--csv", "x.csv"], ["export", "--netcdf", "x.nc"], ["figures"], ["report"]]
)
def test_commands_report_damage_in_one_line(store, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = chunk_file(store, "stable", 1)
    file.unlink()
    assert run_main(arguments[0], store.parent, *arguments[1:]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"Error: {store.parent / 'map.zarr'}{str(file)[len(str(store)) :]}: missing; " + (
        "'zwidth run CONFIG --resume' computes it again"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_export_of_an_incomplete_store_warns(store, tmp_path, capsys):
    chunk_file(store, "status", 1).unlink()
    assert run_main("export", store, "--csv", tmp_path / "x.csv") == 0
    assert "1 chunks are missing; their points have status 255" in capsys.readouterr().err


def test_store_of_an_old_format_is_readable_but_not_resumable(tmp_path):
    # Written by zwidth 0.1.0, with the checksums in separate arrays.
    shutil.unpack_archive(Path(__file__).parents[2] / "reference" / "store_of_format_1.zip", tmp_path)
    axes = {"alpha": [0.1, 0.3, 0.9], "beta": [-0.1, 0.2], "delta": [0.1, 1.0], "d": [0, 1]}
    config = make_config(study(axes=axes, outputs=("stable", "passivity_margin", "alpha_max")))
    assert run_sweeps(config, tmp_path / "new").ok
    old, new = read_values(tmp_path / "map.zarr"), read_values(tmp_path / "new")
    assert old.keys() == new.keys()
    assert all(np.allclose(old[name], new[name], rtol=1e-12, equal_nan=True) for name in new)
    assert open_dataset(tmp_path / "map.zarr").attrs["complete"] == 1
    assert "old format" in verify(tmp_path / "map.zarr")[0].error
    with pytest.raises(StoreError, match="old format, which can be read but not continued; choose another folder"):
        run_sweeps(config, tmp_path, resume=True)
