"""The one run: folders, events, failures, the record, and going on with what is there."""

import contextlib
import json
import os
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import zwidth
from sweeping import chunk_file, flip
from zwidth.errors import ConfigError, StoreError, StoreExistsError
from zwidth.runs import run
from zwidth.runs.run import _pieces
from zwidth.studies import Config, Outcome, load_config
from zwidth.studies.map import MapStudy

SMALL = """
version: 1
name: small
studies:
  - {kind: map, name: one, alpha: [0.1, 0.2], beta: [0.1, 0.4], delta: 0.1, d: 0}
  - {kind: map, name: two, alpha: 0.1, beta: [0.1, 0.4], delta: 0.1, d: 0}
"""


@pytest.fixture
def config(tmp_path):
    file = tmp_path / "small.yaml"
    file.write_text(SMALL, encoding="utf-8")
    return file


def record_of(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def test_a_run_writes_what_its_record_lists(config, tmp_path):
    clock = time.perf_counter()
    result = zwidth.run(config, out=tmp_path / "out")
    assert 0 < result.seconds <= time.perf_counter() - clock
    assert result.ok
    assert result.folder == tmp_path / "out"
    record = record_of(result.folder)
    listed = {file for study in record["studies"] for file in study["files"]}
    assert listed == {"one.npz", "one_stable.png", "one_stable.svg", "two.npz"}
    assert {file.name for file in result.folder.iterdir()} == listed | {"run.json", "config.yaml", ".locks"}
    assert [study["state"] for study in record["studies"]] == ["done", "done"]
    assert record["precision"] == "float64"
    assert record["versions"]["zwidth"] == zwidth.__version__
    assert (result.folder / "config.yaml").read_text(encoding="utf-8") == SMALL


def test_the_folder_is_named_after_the_configuration(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert zwidth.run(config).folder == Path("runs", "small")
    assert (tmp_path / "runs" / "small" / "run.json").is_file()


def test_a_configuration_in_memory_leaves_a_file_that_can_be_run(config, tmp_path):
    result = run(load_config(config), out=tmp_path / "out")
    assert load_config(result.folder / "config.yaml") == load_config(config)


def test_a_run_tells_when_studies_start_and_end(config, tmp_path):
    events = []
    run(config, out=tmp_path / "out", progress=events.append)
    assert [(event.index, event.total, event.name) for event in events[::2]] == [(1, 2, "one"), (2, 2, "two")]
    assert [event.result is None for event in events] == [True, False] * 2
    assert events[1].result.state == "done"


def test_a_run_is_never_overwritten_unasked(config, tmp_path):
    out = tmp_path / "out"
    run(config, out=out)
    before = (out / "run.json").read_bytes()
    with pytest.raises(StoreExistsError, match=r"already holds a run.*--out") as caught:
        run(config, out=out)
    assert str(out) in str(caught.value)
    assert (out / "run.json").read_bytes() == before
    (out / "one.npz").unlink()
    assert run(config, out=out, overwrite=True).ok
    assert (out / "one.npz").is_file()
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def test_a_folder_without_a_run_is_not_touched(config, tmp_path):
    out = tmp_path / "precious"
    out.mkdir()
    (out / "thesis.txt").write_text("words", encoding="utf-8")
    for overwrite in (False, True):
        with pytest.raises(StoreExistsError, match="holds no run"):
            run(config, out=out, overwrite=overwrite)
    assert [file.name for file in out.iterdir()] == ["thesis.txt"]
    with pytest.raises(StoreExistsError, match="is a file"):
        run(config, out=out / "thesis.txt")


def test_an_empty_folder_is_used(config, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    assert run(config, out=out).ok


def test_a_broken_configuration_makes_no_folder(tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text("version: 1\n", encoding="utf-8")
    with pytest.raises(ConfigError):
        run(file, out=tmp_path / "out")
    assert [entry.name for entry in tmp_path.iterdir()] == ["bad.yaml"]


@pytest.fixture
def fail(monkeypatch):
    """Makes the study ``one`` fail until the test is done with it."""
    real = MapStudy.compute

    def compute(self, scene, alone):
        if self.name == "one":
            raise FloatingPointError("no such luck")
        return real(self, scene, alone)

    monkeypatch.setattr(MapStudy, "compute", compute)
    return monkeypatch


def test_one_failure_does_not_lose_the_other_studies(config, tmp_path, fail):
    result = zwidth.run(config, out=tmp_path / "out")
    assert not result.ok
    assert [study.name for study in result.failed] == ["one"]
    assert isinstance(result.failed[0].exception, FloatingPointError)
    assert (result.folder / "two.npz").is_file()
    assert states(result.folder) == {"one": "failed", "two": "done"}
    entry = next(entry for entry in record_of(result.folder)["studies"] if entry["name"] == "one")
    assert entry["error"] == "FloatingPointError: no such luck"


def states(folder):
    return {entry["name"]: entry["state"] for entry in record_of(folder)["studies"]}


def contents(folder):
    """Every file of a run, with what would change if it were written again."""
    files = [path for path in folder.rglob("*") if path.is_file() and ".locks" not in path.parts]
    return {path.relative_to(folder).as_posix(): (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


def test_data_stay_when_the_drawing_fails(config, tmp_path, monkeypatch):
    def broken():
        raise ValueError("no ink")

    outcome = Outcome(table={"x": np.ones(1)}, figures={"": broken})
    monkeypatch.setattr(MapStudy, "compute", lambda self, scene, alone: outcome)
    result = run(config, out=tmp_path / "out")
    assert result.failed[0].files == ("one.csv",)
    assert (result.folder / "one.csv").is_file()


def test_repeated_figures_of_the_paper_bring_its_numbers():
    study = {"kind": "ridge", "name": "r", "delta": [0, 1], "d": 0, "figure": "fig10"}
    config = Config.model_validate({"version": 1, "name": "p", "studies": [study]})
    assert [piece.name for piece in _pieces(config)] == ["r", "published"]
    del study["figure"]
    plain = Config.model_validate({"version": 1, "name": "p", "studies": [study]})
    assert [piece.name for piece in _pieces(plain)] == ["r"]


# A sweep as well: what holds for one kind of study holds for every other.
BOTH = (
    SMALL
    + """
  - {kind: sweep, name: swept, axes: {alpha: [0.1, 0.9], beta: [0.1, 0.4], delta: 0.1, d: [0, 1]}}
"""
)


@pytest.fixture
def both(tmp_path):
    file = tmp_path / "both.yaml"
    file.write_text(BOTH, encoding="utf-8")
    return file


@pytest.fixture
def finished(both, tmp_path):
    """The folder of a run that nothing disturbed."""
    result = run(both, out=tmp_path / "out")
    assert result.ok
    assert [(study.name, study.state) for study in result.studies] == [
        (name, "done") for name in ("one", "two", "swept")
    ]
    return result.folder


def test_every_kind_of_study_is_in_the_record_and_the_result(finished):
    assert states(finished) == {"one": "done", "two": "done", "swept": "done"}
    assert {path.name for path in finished.iterdir()} == {
        *("one.npz", "one_stable.png", "one_stable.svg", "two.npz", "swept.zarr", "run.json", "config.yaml", ".locks")
    }
    assert zwidth.open_dataset(finished / "swept.zarr").attrs["complete"] == 1


def test_overwriting_leaves_what_no_run_has_written(finished, both):
    inner = finished / "another"
    shutil.copytree(finished, inner)
    (finished / "notes.txt").write_text("mine", encoding="utf-8")
    (finished / "photos").mkdir()
    (finished / "photos" / "device.jpg").write_bytes(b"jpg")
    before, of_the_run = contents(inner), contents(finished)
    assert run(both, out=finished, overwrite=True).ok
    after = contents(finished)
    assert contents(inner) == before
    assert {name for name in after if after[name] == of_the_run.get(name)} == {
        *("notes.txt", "photos/device.jpg"),
        *(f"another/{name}" for name in before),
    }
    assert after.keys() == of_the_run.keys()


def test_overwriting_with_another_configuration_removes_what_the_run_had(finished, config):
    assert run(config, out=finished, overwrite=True).ok
    assert not (finished / "swept.zarr").exists()
    assert states(finished) == {"one": "done", "two": "done"}


def test_a_strangers_file_in_the_place_of_a_result_is_not_replaced(both, tmp_path):
    run(both, out=tmp_path / "out", resume=True)
    out = tmp_path / "out"
    changed = both.read_text(encoding="utf-8").replace("name: two", "name: thesis")
    both.write_text(changed, encoding="utf-8")
    (out / "thesis.npz").write_bytes(b"years of work")
    result = run(both, out=out, resume=True)
    (failed,) = result.failed
    assert failed.error.startswith(
        f"StoreExistsError: out: {out / 'thesis.npz'} was not written by this run; move it away"
    )
    assert (out / "thesis.npz").read_bytes() == b"years of work"
    assert states(out)["thesis"] == "failed"
    (out / "thesis.npz").unlink()
    assert run(both, out=out, resume=True).ok


def test_somebodys_own_config_yaml_is_never_replaced(both, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "config.yaml").write_text("mine", encoding="utf-8")
    for resume, overwrite in ((False, False), (True, False), (False, True)):
        assert run(both, out=out, resume=resume, overwrite=overwrite).ok
        assert (out / "config.yaml").read_text(encoding="utf-8") == "mine"
    (out / "config.yaml").unlink()
    assert run(both, out=out, overwrite=True).ok
    assert (out / "config.yaml").read_text(encoding="utf-8") == BOTH
    assert run(both, out=out, overwrite=True).ok
    assert (out / "config.yaml").read_text(encoding="utf-8") == BOTH


def test_a_strangers_store_of_the_same_name_is_never_replaced(both, tmp_path):
    import zarr

    store = tmp_path / "out" / "swept.zarr"
    zarr.create_group(store).create_array("mine", data=np.arange(3.0))
    for overwrite in (False, True):
        with pytest.raises(StoreExistsError, match=r"swept\.zarr exists already"):
            run(both, out=tmp_path / "out", overwrite=overwrite)
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name != ".locks"] == ["swept.zarr"]
    np.testing.assert_array_equal(zarr.open_array(store, path="mine")[:], [0, 1, 2])


def test_a_record_that_names_files_elsewhere_removes_none(finished, both, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("mine", encoding="utf-8")
    record = record_of(finished)
    record["studies"][0]["files"] |= {"../precious.txt": "", str(precious): ""}
    (finished / "run.json").write_text(json.dumps(record), encoding="utf-8")
    assert run(both, out=finished, overwrite=True).ok
    assert precious.read_text(encoding="utf-8") == "mine"


def test_a_finished_run_is_resumed_without_any_work(finished, both):
    before = contents(finished)
    result = run(both, out=finished, resume=True)
    assert result.ok
    assert [study.state for study in result.studies] == ["kept", "kept", "done"]
    assert result.sweeps["swept"].computed == 0
    after = contents(finished)
    assert {name for name in before if before[name] != after[name]} == {"run.json", "config.yaml"}
    assert states(finished) == {"one": "done", "two": "done", "swept": "done"}


def test_what_failed_is_tried_again(both, tmp_path, fail):
    out = tmp_path / "out"
    assert [study.name for study in run(both, out=out).failed] == ["one"]
    kept = contents(out)["two.npz"]
    assert [study.name for study in run(both, out=out, resume=True).failed] == ["one"]
    fail.undo()
    result = run(both, out=out, resume=True)
    assert result.ok
    assert [study.state for study in result.studies] == ["done", "kept", "done"]
    assert contents(out)["two.npz"] == kept
    assert states(out) == {"one": "done", "two": "done", "swept": "done"}


@pytest.mark.parametrize(
    "damage, says",
    [
        (lambda out: (out / "one.npz").unlink(), "one: one.npz is missing"),
        (lambda out: flip(out / "one_stable.png"), "one: one_stable.png is damaged"),
        (lambda out: flip(chunk_file(out / "swept.zarr")), "swept/wall/0 "),
    ],
)
def test_what_is_damaged_is_made_again_and_nothing_else(finished, both, damage, says):
    values = np.load(finished / "two.npz")["stable"]
    before = contents(finished)
    damage(finished)
    result = run(both, out=finished, resume=True)
    assert result.ok
    assert len(result.repaired) == 1
    assert result.repaired[0].startswith(says)
    after = contents(finished)
    assert after.keys() == before.keys()
    assert after["two.npz"] == before["two.npz"]
    np.testing.assert_array_equal(np.load(finished / "one.npz")["alpha"], [0.1, 0.2])
    np.testing.assert_array_equal(np.load(finished / "two.npz")["stable"], values)


def test_what_fails_when_it_is_made_again_loses_nothing(finished, both, fail):
    before = contents(finished)
    (finished / "one_stable.svg").unlink()
    assert [study.name for study in run(both, out=finished, resume=True).failed] == ["one"]
    after = contents(finished)
    assert {name: after[name] for name in ("one.npz", "one_stable.png")} == {
        name: before[name] for name in ("one.npz", "one_stable.png")
    }
    fail.undo()
    assert run(both, out=finished, resume=True).ok
    assert contents(finished).keys() == before.keys()


@pytest.mark.parametrize(
    "old, new, key",
    [
        ("name: two, alpha: 0.1", "name: two, alpha: 0.2", "studies[two].alpha"),
        ("alpha: [0.1, 0.9]", "alpha: [0.1, 0.8]", "studies[swept].axes.alpha[1]"),
    ],
)
def test_another_configuration_is_refused_before_anything_is_computed(finished, both, old, new, key):
    before = contents(finished)
    text = both.read_text(encoding="utf-8")
    assert old in text
    both.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(StoreError) as caught:
        run(both, out=finished, resume=True)
    assert f"{key}: the run was made with" in str(caught.value)
    assert "change the configuration back, or choose another folder with --out DIR" in str(caught.value)
    assert contents(finished) == before


def test_a_study_that_is_added_is_computed_and_one_that_is_removed_stays(finished, both, config):
    three = "  - {kind: map, name: three, alpha: 0.1, beta: [0.1, 0.4], delta: 0, d: 0}\n"
    both.write_text(BOTH + three + "  - {kind: sweep, name: more, axes: {alpha: 0.1, beta: 0.1, delta: 0.1, d: 0}}\n")
    result = run(both, out=finished, resume=True)
    assert [study.state for study in result.studies] == ["kept", "kept", "done", "done", "done"]
    before = contents(finished)
    assert run(config, out=finished, resume=True).ok
    assert contents(finished)["three.npz"] == before["three.npz"]
    # Its files are the run's own all the same.
    assert run(config, out=finished, overwrite=True).ok
    assert not (finished / "three.npz").exists()


def test_another_release_is_refused(finished, both, monkeypatch):
    monkeypatch.setattr("zwidth.files.provenance.__version__", "99.0")
    with pytest.raises(
        StoreError, match=r"run\.json: made with zwidth .*, now there is 99\.0; install the same release"
    ):
        run(both, out=finished, resume=True)


def test_a_run_of_an_earlier_release_is_replaced_but_not_resumed(finished, both):
    record = record_of(finished)
    record["format"] = 1
    for entry in record["studies"]:
        entry["files"] = list(entry["files"])
    (finished / "run.json").write_text(json.dumps(record), encoding="utf-8")
    with pytest.raises(StoreError, match="kept no checksums to go on from; start again with --overwrite"):
        run(both, out=finished, resume=True)
    assert run(both, out=finished, overwrite=True).ok


@pytest.mark.parametrize("content", ["{", "[]", '{"studies": 1}'])
def test_a_damaged_record_is_refused(finished, both, content):
    (finished / "run.json").write_text(content, encoding="utf-8")
    for resume, overwrite in ((True, False), (False, True), (False, False)):
        with pytest.raises(StoreError, match=r"run\.json: .*choose another folder with --out DIR, or remove it"):
            run(both, out=finished, resume=resume, overwrite=overwrite)


def test_ctrl_c_keeps_every_finished_study(both, tmp_path):
    out = tmp_path / "out"

    def interrupt(event):
        if event.name == "two":
            raise KeyboardInterrupt

    result = run(both, out=out, progress=interrupt)
    assert result.interrupted
    assert not result.ok
    assert [study.name for study in result.studies] == ["one"]
    assert states(out) == {"one": "done"}
    kept = contents(out)["one.npz"]
    result = run(both, out=out, resume=True)
    assert [study.state for study in result.studies] == ["kept", "done", "done"]
    assert contents(out)["one.npz"] == kept


def test_a_run_that_ends_at_any_file_is_gone_on_with(both, tmp_path, monkeypatch):
    real, remove = os.replace, shutil.rmtree
    left = 0

    def replace(source, target):
        nonlocal left
        # Zarr writes in a thread of its own, where the end of the program would only end the thread.
        left -= threading.current_thread() is threading.main_thread()
        if left < 0:
            # As if the process were killed here: nothing after this happens.
            raise SystemExit
        real(source, target)

    undisturbed = run(both, out=tmp_path / "undisturbed").folder
    names = contents(undisturbed).keys()
    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(shutil, "rmtree", lambda path, ignore_errors=False: None)
    for moment in range(0, 40, 3):
        out = tmp_path / str(moment)
        left = moment
        with contextlib.suppress(SystemExit):
            run(both, out=out)
        left = 10**6
        with monkeypatch.context() as whole:
            whole.setattr(shutil, "rmtree", remove)
            assert run(both, out=out, resume=True).ok, moment
        assert contents(out).keys() == names, moment
        assert states(out) == {"one": "done", "two": "done", "swept": "done"}
        np.testing.assert_array_equal(np.load(out / "two.npz")["stable"], np.load(undisturbed / "two.npz")["stable"])


def test_what_a_killed_run_leaves_is_swept_up(finished, both):
    (finished / ".one.12345678.partial").mkdir()
    (finished / ".one.12345678.partial" / "one.npz").write_bytes(b"half")
    (finished / ".run.json.12345678.partial").write_bytes(b"{")
    assert run(both, out=finished, resume=True).ok
    assert list(finished.glob(".*.partial")) == []
