"""Going on with a run: what is done is kept, what failed or is damaged is made again, what differs is refused."""

import contextlib
import json
import os
import shutil
import threading

import numpy as np
import pytest
from run_folders import BOTH, contents, record_of, states
from sweeping import chunk_file, flip

from zwidth.core.errors import StoreError
from zwidth.runs import run

pytestmark = pytest.mark.usefixtures("unpainted")


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
    assert f"{key}: the run was created with" in str(caught.value)
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
    monkeypatch.setattr("zwidth.sweep.files.__version__", "99.0")
    with pytest.raises(
        StoreError, match=r"run\.json: created with zwidth .*, now 99\.0 is installed; install the same release"
    ):
        run(both, out=finished, resume=True)


def test_a_run_of_an_earlier_release_is_replaced_but_not_resumed(finished, both):
    record = record_of(finished)
    record["format"] = 1
    (finished / "run.json").write_text(json.dumps(record), encoding="utf-8")
    with pytest.raises(StoreError, match="without checksums, which cannot be resumed; start again with --overwrite"):
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


def test_what_a_damaged_record_says_is_found_again(finished, both):
    before = record_of(finished)
    text = (finished / "run.json").read_text(encoding="utf-8")
    (finished / "run.json").write_text(text.replace('"kind": "map"', '"kind": "mop"'), encoding="utf-8")
    result = run(both, out=finished, resume=True)
    assert result.ok
    assert result.repaired == ("run.json is damaged",)
    assert [study.state for study in result.studies] == ["done", "done", "done"]
    assert result.sweeps["swept"].computed == 0
    after = record_of(finished)
    for name in ("kind", "answer", "files", "inputs", "state"):
        assert [one.get(name) for one in after["studies"]] == [one.get(name) for one in before["studies"]], name
    assert run(both, out=finished, resume=True).repaired == ()
