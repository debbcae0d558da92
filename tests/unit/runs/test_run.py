"""Runs of configurations: folders, progress events, failures, records, and protection of existing files."""

import hashlib
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_folders import SMALL, SMALL_WITH_SWEEP, list_contents, read_record, read_states

import zwidth
from zwidth.core.errors import ConfigError, InputError, StoreError, StoreExistsError
from zwidth.runs import run
from zwidth.studies import Outcome, load_config
from zwidth.studies.boundary import MapStudy
from zwidth.sweep.dataset import verify

pytestmark = pytest.mark.usefixtures("unpainted")


def test_run_writes_the_files_of_its_record(config, tmp_path):
    clock = time.perf_counter()
    result = zwidth.run(config, out=tmp_path / "out")
    assert 0 < result.seconds <= time.perf_counter() - clock
    assert result.ok
    assert result.folder == tmp_path / "out"
    record = read_record(result.folder)
    listed = {file for study in record["studies"] for file in study["files"]}
    assert listed == {"one.npz", "one_stable.png", "one_stable.svg", "two.npz"}
    assert {file.name for file in result.folder.iterdir()} == listed | {"run.json", "config.yaml", ".locks"}
    assert [study["state"] for study in record["studies"]] == ["done", "done"]
    assert record["precision"] == "float64"
    assert record["versions"]["zwidth"] == zwidth.__version__
    assert (result.folder / "config.yaml").read_text(encoding="utf-8") == SMALL


def test_default_folder_is_named_after_the_configuration(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert zwidth.run(config).folder == Path("runs", "small")
    assert (tmp_path / "runs" / "small" / "run.json").is_file()


def test_loaded_configuration_is_written_to_the_folder(config, tmp_path):
    result = run(load_config(config), out=tmp_path / "out")
    assert load_config(result.folder / "config.yaml") == load_config(config)


def test_run_of_a_dict_is_resumable(tmp_path):
    study = {"kind": "map", "name": "one", "alpha": np.array([0.1, 0.2]), "beta": (0.1, 0.4), "delta": 0.1, "d": 0}
    swept = {"kind": "sweep", "name": "swept", "axes": {"alpha": np.linspace(0.1, 0.9, 2), "beta": 0.1, "delta": 0.1}}
    swept["axes"]["d"] = np.int64(1)
    config = {"version": 1, "name": "small", "description": "1e-3", "studies": [study, swept]}
    out = tmp_path / "out"
    assert run(config, out=out).ok
    read: Any = load_config(out / "config.yaml")
    assert read.description == "1e-3"
    np.testing.assert_array_equal(read.studies[0].alpha.values(), study["alpha"])
    assert all(store.ok for store in verify(out))
    for again in (config, out / "config.yaml"):
        assert {study.state for study in run(again, out=out, resume=True).studies if not study.sweep} == {"kept"}
    (out / "one.npz").write_bytes(b"damaged")
    assert run(config, out=out, resume=True).repaired == ("one: one.npz is damaged",)
    study["alpha"] = [0.1, 0.3]
    with pytest.raises(StoreError, match="alpha"):
        run(config, out=out, resume=True)


@pytest.mark.parametrize("config", [7, None, ["version"]])
def test_invalid_configuration_type_raises(config: Any):
    with pytest.raises(InputError, match=r"config: got .*path.*dict"):
        run(config)


def test_progress_events_mark_start_and_end_of_studies(config, tmp_path):
    events = []
    run(config, out=tmp_path / "out", progress=events.append)
    assert [(event.index, event.total, event.name) for event in events[::2]] == [(1, 2, "one"), (2, 2, "two")]
    assert [event.result is None for event in events] == [True, False] * 2
    assert events[1].result.state == "done"


def test_each_sweep_reports_the_time_of_its_chunks(tmp_path):
    axes = {"alpha": {"linear": {"start": 0.1, "stop": 0.9, "num": 5}}, "beta": 0.1, "delta": 0.1, "d": 0}
    sweeps = [{"kind": "sweep", "name": name, "axes": axes} for name in ("one", "two")]
    clock = time.perf_counter()
    result = run({"version": 1, "name": "both", "studies": sweeps}, out=tmp_path / "out")
    one, two = (study.seconds for study in result.studies)
    assert min(one, two) > 0
    # The sum must not exceed the total time.
    assert one + two <= time.perf_counter() - clock
    assert [entry["seconds"] for entry in read_record(tmp_path / "out")["studies"]] == [round(one, 3), round(two, 3)]


def test_existing_run_is_overwritten_only_on_request(config, tmp_path):
    out = tmp_path / "out"
    run(config, out=out)
    before = (out / "run.json").read_bytes()
    with pytest.raises(StoreExistsError, match=r"already contains a run.*--out") as caught:
        run(config, out=out)
    assert str(out) in str(caught.value)
    assert (out / "run.json").read_bytes() == before
    (out / "one.npz").unlink()
    assert run(config, out=out, overwrite=True).ok
    assert (out / "one.npz").is_file()
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def test_folder_without_a_run_is_not_modified(config, tmp_path):
    out = tmp_path / "precious"
    out.mkdir()
    (out / "thesis.txt").write_text("words", encoding="utf-8")
    for overwrite in (False, True):
        with pytest.raises(StoreExistsError, match="contains no run"):
            run(config, out=out, overwrite=overwrite)
    assert [file.name for file in out.iterdir()] == ["thesis.txt"]
    with pytest.raises(StoreExistsError, match="is a file"):
        run(config, out=out / "thesis.txt")


def test_empty_folder_is_used(config, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    assert run(config, out=out).ok


def test_invalid_configuration_creates_no_folder(tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text("version: 1\n", encoding="utf-8")
    with pytest.raises(ConfigError):
        run(file, out=tmp_path / "out")
    assert [entry.name for entry in tmp_path.iterdir()] == ["bad.yaml"]


def test_failed_study_does_not_affect_others(config, tmp_path, fail):
    result = zwidth.run(config, out=tmp_path / "out")
    assert not result.ok
    assert [study.name for study in result.failed] == ["one"]
    assert isinstance(result.failed[0].exception, FloatingPointError)
    assert (result.folder / "two.npz").is_file()
    assert read_states(result.folder) == {"one": "failed", "two": "done"}
    entry = next(entry for entry in read_record(result.folder)["studies"] if entry["name"] == "one")
    assert entry["error"] == "FloatingPointError: no such luck"


def test_tables_are_kept_if_drawing_fails(config, tmp_path, monkeypatch):
    def broken():
        raise ValueError("no ink")

    outcome = Outcome(table={"x": np.ones(1)}, figures={"": broken})
    monkeypatch.setattr(MapStudy, "compute", lambda self, scene, alone: outcome)
    result = run(config, out=tmp_path / "out")
    assert result.failed[0].files == ("one.csv",)
    assert (result.folder / "one.csv").is_file()


def test_overwriting_keeps_files_not_written_by_the_run(finished, config_with_sweep):
    inner = finished / "another"
    shutil.copytree(finished, inner)
    (finished / "notes.txt").write_text("mine", encoding="utf-8")
    (finished / "photos").mkdir()
    (finished / "photos" / "device.jpg").write_bytes(b"jpg")
    before, original = list_contents(inner), list_contents(finished)
    assert run(config_with_sweep, out=finished, overwrite=True).ok
    after = list_contents(finished)
    assert list_contents(inner) == before
    assert {name for name in after if after[name] == original.get(name)} == {
        *("notes.txt", "photos/device.jpg"),
        *(f"another/{name}" for name in before),
    }
    assert after.keys() == original.keys()


def test_overwriting_removes_results_of_the_old_configuration(finished, config):
    assert run(config, out=finished, overwrite=True).ok
    assert not (finished / "swept.zarr").exists()
    assert read_states(finished) == {"one": "done", "two": "done"}


def test_foreign_file_with_the_name_of_a_result_is_not_replaced(config_with_sweep, tmp_path):
    run(config_with_sweep, out=tmp_path / "out", resume=True)
    out = tmp_path / "out"
    changed = config_with_sweep.read_text(encoding="utf-8").replace("name: two", "name: thesis")
    config_with_sweep.write_text(changed, encoding="utf-8")
    (out / "thesis.npz").write_bytes(b"years of work")
    result = run(config_with_sweep, out=out, resume=True)
    (failed,) = result.failed
    assert failed.error.startswith(
        f"StoreExistsError: out: {out / 'thesis.npz'} was not written by this run; move it away"
    )
    assert (out / "thesis.npz").read_bytes() == b"years of work"
    assert read_states(out)["thesis"] == "failed"
    (out / "thesis.npz").unlink()
    assert run(config_with_sweep, out=out, resume=True).ok


def test_foreign_config_yaml_is_never_replaced(config_with_sweep, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "config.yaml").write_text("mine", encoding="utf-8")
    for resume, overwrite in ((False, False), (True, False), (False, True)):
        assert run(config_with_sweep, out=out, resume=resume, overwrite=overwrite).ok
        assert (out / "config.yaml").read_text(encoding="utf-8") == "mine"
    (out / "config.yaml").unlink()
    assert run(config_with_sweep, out=out, overwrite=True).ok
    assert (out / "config.yaml").read_text(encoding="utf-8") == SMALL_WITH_SWEEP
    assert run(config_with_sweep, out=out, overwrite=True).ok
    assert (out / "config.yaml").read_text(encoding="utf-8") == SMALL_WITH_SWEEP


def test_foreign_store_of_the_same_name_is_never_replaced(config_with_sweep, tmp_path):
    import zarr

    store = tmp_path / "out" / "swept.zarr"
    zarr.create_group(store).create_array("mine", data=np.arange(3.0))
    for overwrite in (False, True):
        with pytest.raises(StoreExistsError, match=r"swept\.zarr already exists"):
            run(config_with_sweep, out=tmp_path / "out", overwrite=overwrite)
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name != ".locks"] == ["swept.zarr"]
    np.testing.assert_array_equal(zarr.open_array(store, path="mine")[:], [0, 1, 2])


def test_slow_study_reports_its_progress(tmp_path):
    events = []
    device = {"mass": 0.1, "damping": 1, "period": 1e-3, "delay": 1e-3}
    devices = [{**device, "label": str(n), "velocity": {"kind": "windowed_difference", "samples": n}} for n in (2, 3)]
    study = {"kind": "compare", "name": "c", "devices": devices}
    assert run({"version": 1, "name": "n", "studies": [study]}, out=tmp_path / "out", progress=events.append).ok
    assert [event.parts for event in events] == [None, (0, 2), (1, 2), None]


def test_record_and_store_have_equal_configuration_hashes(config_with_sweep, tmp_path):
    folder = run(config_with_sweep, out=tmp_path / "out").folder
    digest = hashlib.sha256((folder / "config.yaml").read_bytes()).hexdigest()
    assert read_record(folder)["config_sha256"] == digest
    (store,) = folder.glob("*.zarr")
    with zwidth.open_dataset(store) as data:
        assert data.attrs["config_sha256"] == digest


def test_scheduler_without_a_sweep_raises(config, tmp_path):
    with pytest.raises(InputError, match="scheduler: got 'foo', but the configuration has no sweep"):
        run(config, out=tmp_path / "out", scheduler="foo")
    assert not (tmp_path / "out").exists()
