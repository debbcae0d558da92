"""Resuming a run: finished studies are kept, failed or damaged ones recomputed, and other configurations rejected."""

import contextlib
import json
import os
import shutil
import threading

import numpy as np
import pytest
from run_folders import SMALL_WITH_SWEEP, list_contents, read_record, read_states
from sweeping import chunk_file, flip_byte

from zwidth.core.errors import StoreError
from zwidth.runs import run

pytestmark = pytest.mark.usefixtures("unpainted")


def test_resuming_a_finished_run_computes_nothing(finished, config_with_sweep):
    before = list_contents(finished)
    result = run(config_with_sweep, out=finished, resume=True)
    assert result.ok
    assert [study.state for study in result.studies] == ["kept", "kept", "done"]
    assert result.sweeps["swept"].computed == 0
    after = list_contents(finished)
    assert {name for name in before if before[name] != after[name]} == {"run.json", "config.yaml"}
    assert read_states(finished) == {"one": "done", "two": "done", "swept": "done"}


def test_failed_study_is_recomputed(config_with_sweep, tmp_path, fail):
    out = tmp_path / "out"
    assert [study.name for study in run(config_with_sweep, out=out).failed] == ["one"]
    kept = list_contents(out)["two.npz"]
    assert [study.name for study in run(config_with_sweep, out=out, resume=True).failed] == ["one"]
    fail.undo()
    result = run(config_with_sweep, out=out, resume=True)
    assert result.ok
    assert [study.state for study in result.studies] == ["done", "kept", "done"]
    assert list_contents(out)["two.npz"] == kept
    assert read_states(out) == {"one": "done", "two": "done", "swept": "done"}


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda out: (out / "one.npz").unlink(), "one: one.npz is missing"),
        (lambda out: flip_byte(out / "one_stable.png"), "one: one_stable.png is damaged"),
        (lambda out: flip_byte(chunk_file(out / "swept.zarr")), "swept/wall/0 "),
    ],
)
def test_only_damaged_results_are_recomputed(finished, config_with_sweep, damage, message):
    values = np.load(finished / "two.npz")["stable"]
    before = list_contents(finished)
    damage(finished)
    result = run(config_with_sweep, out=finished, resume=True)
    assert result.ok
    assert len(result.repaired) == 1
    assert result.repaired[0].startswith(message)
    after = list_contents(finished)
    assert after.keys() == before.keys()
    assert after["two.npz"] == before["two.npz"]
    np.testing.assert_array_equal(np.load(finished / "one.npz")["alpha"], [0.1, 0.2])
    np.testing.assert_array_equal(np.load(finished / "two.npz")["stable"], values)


def test_failure_during_recomputation_keeps_other_files(finished, config_with_sweep, fail):
    before = list_contents(finished)
    (finished / "one_stable.svg").unlink()
    assert [study.name for study in run(config_with_sweep, out=finished, resume=True).failed] == ["one"]
    after = list_contents(finished)
    assert {name: after[name] for name in ("one.npz", "one_stable.png")} == {
        name: before[name] for name in ("one.npz", "one_stable.png")
    }
    fail.undo()
    assert run(config_with_sweep, out=finished, resume=True).ok
    assert list_contents(finished).keys() == before.keys()


@pytest.mark.parametrize(
    "old, new, key",
    [
        ("name: two, alpha: 0.1", "name: two, alpha: 0.2", "studies[two].alpha"),
        ("alpha: [0.1, 0.9]", "alpha: [0.1, 0.8]", "studies[swept].axes.alpha[1]"),
    ],
)
def test_resuming_with_another_configuration_raises(finished, config_with_sweep, old, new, key):
    before = list_contents(finished)
    text = config_with_sweep.read_text(encoding="utf-8")
    assert old in text
    config_with_sweep.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(StoreError) as caught:
        run(config_with_sweep, out=finished, resume=True)
    assert f"{key}: the run was created with" in str(caught.value)
    assert "change the configuration back, or choose another folder with --out DIR" in str(caught.value)
    assert list_contents(finished) == before


def test_added_study_is_computed_and_removed_one_is_kept(finished, config_with_sweep, config):
    three = "  - {kind: map, name: three, alpha: 0.1, beta: [0.1, 0.4], delta: 0, d: 0}\n"
    config_with_sweep.write_text(
        SMALL_WITH_SWEEP + three + "  - {kind: sweep, name: more, axes: {alpha: 0.1, beta: 0.1, delta: 0.1, d: 0}}\n"
    )
    result = run(config_with_sweep, out=finished, resume=True)
    assert [study.state for study in result.studies] == ["kept", "kept", "done", "done", "done"]
    before = list_contents(finished)
    assert run(config, out=finished, resume=True).ok
    assert list_contents(finished)["three.npz"] == before["three.npz"]
    # The files of the removed study still belong to the run and are overwritten.
    assert run(config, out=finished, overwrite=True).ok
    assert not (finished / "three.npz").exists()


def test_resuming_with_another_release_raises(finished, config_with_sweep, monkeypatch):
    monkeypatch.setattr("zwidth.sweep.files.__version__", "99.0")
    with pytest.raises(
        StoreError, match=r"run\.json: created with zwidth .*, now 99\.0 is installed; install the same release"
    ):
        run(config_with_sweep, out=finished, resume=True)


def test_run_of_an_old_format_is_overwritten_but_not_resumed(finished, config_with_sweep):
    record = read_record(finished)
    record["format"] = 1
    (finished / "run.json").write_text(json.dumps(record), encoding="utf-8")
    with pytest.raises(StoreError, match="without checksums, which cannot be resumed; start again with --overwrite"):
        run(config_with_sweep, out=finished, resume=True)
    assert run(config_with_sweep, out=finished, overwrite=True).ok


@pytest.mark.parametrize("content", ["{", "[]", '{"studies": 1}'])
def test_unreadable_record_raises(finished, config_with_sweep, content):
    (finished / "run.json").write_text(content, encoding="utf-8")
    for resume, overwrite in ((True, False), (False, True), (False, False)):
        with pytest.raises(StoreError, match=r"run\.json: .*choose another folder with --out DIR, or remove it"):
            run(config_with_sweep, out=finished, resume=resume, overwrite=overwrite)


def test_interrupt_keeps_finished_studies(config_with_sweep, tmp_path):
    out = tmp_path / "out"

    def interrupt(event):
        if event.name == "two":
            raise KeyboardInterrupt

    result = run(config_with_sweep, out=out, progress=interrupt)
    assert result.interrupted
    assert not result.ok
    assert [study.name for study in result.studies] == ["one"]
    assert read_states(out) == {"one": "done"}
    kept = list_contents(out)["one.npz"]
    result = run(config_with_sweep, out=out, resume=True)
    assert [study.state for study in result.studies] == ["kept", "done", "done"]
    assert list_contents(out)["one.npz"] == kept


def test_run_killed_at_any_file_is_resumed(config_with_sweep, tmp_path, monkeypatch):
    real, remove = os.replace, shutil.rmtree
    remaining = 0

    def replace(source, target):
        nonlocal remaining
        # Zarr writes in another thread, where SystemExit would end only that thread.
        remaining -= threading.current_thread() is threading.main_thread()
        if remaining < 0:
            # Simulate a killed process: nothing after this is executed.
            raise SystemExit
        real(source, target)

    undisturbed = run(config_with_sweep, out=tmp_path / "undisturbed").folder
    names = list_contents(undisturbed).keys()
    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(shutil, "rmtree", lambda path, ignore_errors=False: None)
    for moment in range(0, 40, 3):
        out = tmp_path / str(moment)
        remaining = moment
        with contextlib.suppress(SystemExit):
            run(config_with_sweep, out=out)
        remaining = 10**6
        with monkeypatch.context() as patch:
            patch.setattr(shutil, "rmtree", remove)
            assert run(config_with_sweep, out=out, resume=True).ok, moment
        assert list_contents(out).keys() == names, moment
        assert read_states(out) == {"one": "done", "two": "done", "swept": "done"}
        np.testing.assert_array_equal(np.load(out / "two.npz")["stable"], np.load(undisturbed / "two.npz")["stable"])


def test_partial_files_of_a_killed_run_are_removed(finished, config_with_sweep):
    (finished / ".one.12345678.partial").mkdir()
    (finished / ".one.12345678.partial" / "one.npz").write_bytes(b"half")
    (finished / ".run.json.12345678.partial").write_bytes(b"{")
    assert run(config_with_sweep, out=finished, resume=True).ok
    assert list(finished.glob(".*.partial")) == []


def test_damaged_record_is_restored(finished, config_with_sweep):
    before = read_record(finished)
    text = (finished / "run.json").read_text(encoding="utf-8")
    (finished / "run.json").write_text(text.replace('"kind": "map"', '"kind": "mop"'), encoding="utf-8")
    result = run(config_with_sweep, out=finished, resume=True)
    assert result.ok
    assert result.repaired == ("run.json is damaged",)
    assert [study.state for study in result.studies] == ["done", "done", "done"]
    assert result.sweeps["swept"].computed == 0
    after = read_record(finished)
    for name in ("kind", "answer", "files", "inputs", "state"):
        assert [entry.get(name) for entry in after["studies"]] == [entry.get(name) for entry in before["studies"]], name
    assert run(config_with_sweep, out=finished, resume=True).repaired == ()
