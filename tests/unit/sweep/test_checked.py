"""Stores whose files were damaged after they were written: nobody reads them without a word."""

import random
import shutil
from pathlib import Path

import numpy as np
import pytest
from sweeping import chunk_file, config_of, cut, flip, main_of, run_sweeps, study, values_of

from zwidth.core.errors import StoreError
from zwidth.sweep.dataset import open_dataset, verify

AXES = {"alpha": [0.1, 0.3, 0.9], "beta": [-0.1, 0.2, 0.5], "delta": [0.1, 1.0], "d": [0, 1]}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of several chunks, and what reading it gives."""
    folder = tmp_path_factory.mktemp("finished")
    config = config_of(study(axes=AXES, outputs=("stable", "passivity_margin", "alpha_max")))
    with pytest.MonkeyPatch.context() as patch:
        cut(patch, 5, 2)
        assert run_sweeps(config, folder).computed > 5
    return config, folder, read(folder)


@pytest.fixture
def store(finished, tmp_path):
    """A copy of its store, to be damaged."""
    shutil.copytree(finished[1], tmp_path / "run")
    return tmp_path / "run" / "map.zarr"


def read(folder):
    """All that a store tells, bit by bit."""
    with open_dataset(folder) as data:
        told = {name: values.values.tolist() for name, values in data.variables.items() if values.dtype.kind != "f"}
        numbers = {name: values.values.tobytes() for name, values in data.variables.items() if values.dtype.kind == "f"}
        return told, numbers, {name: dict(values.attrs) for name, values in data.variables.items()}, dict(data.attrs)


DAMAGES = {
    "deleted": lambda file: file.unlink(),
    "cut off": lambda file: file.write_bytes(file.read_bytes()[:-1]),
    "empty": lambda file: file.write_bytes(b""),
    "zeros": lambda file: file.write_bytes(bytes(file.stat().st_size)),
    "flipped": flip,
    "grown": lambda file: file.write_bytes(file.read_bytes() + b"0"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("name", ["stable", "status", "alpha_max"])
def test_a_damaged_chunk_is_named_where_it_is_read(store, damage, name):
    file = chunk_file(store, name, 1)
    damage(file)
    if name == "status" and not file.exists():
        # Its existence marks a chunk as done.
        assert open_dataset(store).attrs["complete"] == 0
        return
    with open_dataset(store) as data, pytest.raises(StoreError) as caught:
        data[name].load()
    state = "damaged" if file.exists() else "missing"
    assert str(caught.value) == f"{file}: {state}; 'zwidth run CONFIG --resume' computes it again"


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("name", ["stable", "status", "alpha_max"])
def test_a_damaged_description_of_an_array_does_no_harm(finished, store, damage, name):
    damage(store / name / "zarr.json")
    assert read(store) == finished[2]
    assert verify(store)[0].ok


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_coordinates_are_named_at_once(store, damage):
    damage(store / "beta" / "c" / "0")
    with pytest.raises(StoreError, match=r"beta/c/0: (damaged|missing)"):
        open_dataset(store)


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("name", ["zarr.json", "zwidth.json"])
def test_of_two_descriptions_the_sound_one_is_read(finished, store, damage, name):
    damage(store / name)
    assert read(store) == finished[2]


def test_a_chunk_that_is_not_done_is_absent_whatever_lies_there(finished, store):
    chunk_file(store, "status", 1).unlink()
    with open_dataset(store) as data:
        assert data.attrs["complete"] == 0
        unknown = data.status.values == 255
        assert 0 < unknown.sum() <= 5
        assert not data.stable.values[unknown].any()
        stable = [value for value, left in zip(data.stable.values.flat, unknown.flat, strict=True) if not left]
    before = values_of(finished[1])["stable"][~unknown]
    assert stable == before.tolist()


def test_all_variables_of_a_chunk_are_of_the_moment_when_it_was_opened(store):
    flag = chunk_file(store, "status", 1)
    kept = flag.read_bytes()
    flag.unlink()
    with open_dataset(store) as data:
        stable = data.stable.values
        # A run does it now.
        flag.write_bytes(kept)
        assert not stable[data.status.values == 255].any()
        assert (data.status.values == 255).any()


def test_random_damages_are_told_or_mended_and_none_is_read(finished, tmp_path):
    config, source, before = finished
    choice = random.Random(42)
    files = sorted(file.relative_to(source) for file in source.glob("map.zarr/**/*") if file.is_file())
    told = 0
    for number in range(30):
        run = tmp_path / str(number)
        shutil.copytree(source, run)
        file = run / choice.choice(files)
        choice.choice(list(DAMAGES.values()))(file)
        now, error = None, ""
        try:
            now = read(run)
        except StoreError as caught:
            told, error = told + 1, str(caught)
        # Whoever has lost the mark of a chunk knows as much.
        lost = now is not None and now[3]["complete"] == 0 and not file.exists()
        assert now == before or lost or f"{run / 'map.zarr'}/" in error, file
        if number % 10 == 0:
            assert run_sweeps(config, run, resume=True).ok
            assert read(run) == before
    assert told > 15


@pytest.mark.parametrize(
    "words", [["export", "--csv", "x.csv"], ["export", "--netcdf", "x.nc"], ["figures"], ["report"]]
)
def test_on_the_command_line_a_damage_is_one_line(store, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    file = chunk_file(store, "stable", 1)
    file.unlink()
    assert main_of(words[0], store.parent, *words[1:]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"Error: {store.parent / 'map.zarr'}{str(file)[len(str(store)) :]}: missing; " + (
        "'zwidth run CONFIG --resume' computes it again"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_export_of_a_store_that_is_not_complete_says_so(store, tmp_path, capsys):
    chunk_file(store, "status", 1).unlink()
    assert main_of("export", store, "--csv", tmp_path / "x.csv") == 0
    assert "1 chunks are missing; their points have status 255" in capsys.readouterr().err


def test_a_store_of_an_old_format_is_read_and_not_continued(tmp_path):
    # Written by zwidth 0.1.0, with the checksums in arrays of their own.
    shutil.unpack_archive(Path(__file__).parents[2] / "reference" / "store_of_format_1.zip", tmp_path)
    axes = {"alpha": [0.1, 0.3, 0.9], "beta": [-0.1, 0.2], "delta": [0.1, 1.0], "d": [0, 1]}
    config = config_of(study(axes=axes, outputs=("stable", "passivity_margin", "alpha_max")))
    assert run_sweeps(config, tmp_path / "new").ok
    old, new = values_of(tmp_path / "map.zarr"), values_of(tmp_path / "new")
    assert old.keys() == new.keys()
    assert all(np.allclose(old[name], new[name], rtol=1e-12, equal_nan=True) for name in new)
    assert open_dataset(tmp_path / "map.zarr").attrs["complete"] == 1
    assert "old format" in verify(tmp_path / "map.zarr")[0].error
    with pytest.raises(StoreError, match="old format, which can be read but not continued; choose another folder"):
        run_sweeps(config, tmp_path, resume=True)
