"""Runs that are killed or stopped at any moment, and what becomes of them."""

import json
import os
import random
import shlex
import signal
import time

import pytest
import yaml
from sweeping import assert_equal_stores, list_status_files, run_main, start_command, study
from waiting import LONGEST, wait_for

# Few, for each of them costs the start of a program: scripts/kill_and_resume.py tries a hundred.
MOMENTS = 3
# Fifty chunks of a million points: a second of work, and enough steps to be stopped between.
AXES = {
    "alpha": {"linear": {"start": 0.0, "stop": 1.0, "num": 1000}},
    "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 1000}},
    "delta": {"linear": {"start": 0.0, "stop": 2.0, "num": 25}},
    "d": [1, 2],
}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """The file of a sweep over many chunks."""
    path = tmp_path_factory.mktemp("config") / "sweep.yaml"
    text = yaml.safe_dump({"version": 1, "name": "sweep", "studies": [study("map", AXES)]})
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def undisturbed(config, tmp_path_factory):
    """Its results, and how long it took to begin and then to end."""
    folder = tmp_path_factory.mktemp("undisturbed") / "out"
    started = time.monotonic()
    process = start_command("run", config, "--out", folder)
    begun = wait_for_chunks(process, folder, 1)
    errors = process.communicate(timeout=LONGEST)[1]
    assert process.returncode == 0, errors
    return folder, begun - started, time.monotonic() - begun


def wait_for_chunks(process, folder, count):
    """The time at which a run has done some chunks, or is at its end."""
    wait_for(lambda: len(list_status_files(folder)) >= count or process.poll() is not None)
    return time.monotonic()


def kill_group(process):
    """Kill a run; one that was quicker than the moment has ended by itself, and well."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode in (0, -signal.SIGKILL)


def test_killed_at_any_moment_a_run_resumes(config, undisturbed, tmp_path):
    reference, beginning, working = undisturbed
    moments = random.Random(20061)
    before = {}
    for number in range(MOMENTS):
        process = start_command("run", config, "--out", tmp_path, "--resume")
        if number % 3 == 0:
            # While it starts, makes its store or checks what is there.
            time.sleep(moments.uniform(0.1, 1.2) * beginning)
        else:
            wait_for_chunks(process, tmp_path, len(before) + 1)
            time.sleep(moments.uniform(0, 0.5 / MOMENTS) * working)
        kill_group(process)
        assert before.items() <= list_status_files(tmp_path).items()
        before = list_status_files(tmp_path)
    assert run_main("run", config, "--out", tmp_path, "--resume") == 0
    # Nothing that was marked as done was computed again.
    assert before.items() <= list_status_files(tmp_path).items()
    assert run_main("verify", tmp_path) == 0
    assert_equal_stores(reference, tmp_path)
    assert list(tmp_path.rglob("*.partial")) == []


def test_a_folder_in_which_a_run_computes_is_refused_until_it_is_killed(config, undisturbed, tmp_path, capsys):
    process = start_command("run", config, "--out", tmp_path)
    wait_for_chunks(process, tmp_path, 2)
    # It holds still, so that it is not done too soon.
    os.killpg(process.pid, signal.SIGSTOP)
    assert process.poll() is None
    before = list_status_files(tmp_path)
    for words in (["--resume"], ["--overwrite"]):
        assert run_main("run", config, "--out", tmp_path, *words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"Error: out: {tmp_path}: another run is writing to this folder (process {process.pid} ")
    assert list_status_files(tmp_path) == before
    kill_group(process)
    assert run_main("run", config, "--out", tmp_path, "--resume") == 0
    assert before.items() <= list_status_files(tmp_path).items()
    assert_equal_stores(undisturbed[0], tmp_path)


def test_a_parent_that_is_killed_takes_its_workers_along(config, undisturbed, tmp_path):
    process = start_command("run", config, "--out", tmp_path, "--workers", "2")
    wait_for_chunks(process, tmp_path, 2)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    wait_for(lambda: not group_lives(process.pid))
    assert run_main("run", config, "--out", tmp_path, "--resume") == 0
    assert_equal_stores(undisturbed[0], tmp_path)


def group_lives(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_every_kind_of_study_survives_kills_at_any_moment(tmp_path, undisturbed):
    studies = [
        {"kind": "ridge", "name": "ridge", "delta": {"linear": {"start": 0, "stop": 2, "num": 50}}, "d": [0, 1]},
        {"kind": "boundary", "name": "boundary", "delta": [0, 0.5], "d": [0, 2]},
        {"kind": "map", "name": "map", "alpha": [0.1, 0.2, 0.9], "beta": [0.1, 0.4], "delta": 0.1, "d": [0, 0.5]},
        study("swept", {**AXES, "delta": [0.0, 0.5], "d": [1]}),
    ]
    config, out = tmp_path / "all.yaml", tmp_path / "out"
    config.write_text(yaml.safe_dump({"version": 1, "name": "all", "studies": studies}), encoding="utf-8")
    started = time.monotonic()
    assert run_main("run", config, "--out", tmp_path / "undisturbed") == 0
    # As a program of its own it would have begun like the other one.
    whole = undisturbed[1] + time.monotonic() - started
    out.mkdir()
    (out / ".mine").write_text("not the run's", encoding="utf-8")
    moments, kept = random.Random(20062), {}
    # One in every part of a run, but for the first fifth, in which nothing is there yet.
    for part in moments.sample(range(MOMENTS + 1), MOMENTS + 1):
        process = start_command("run", config, "--out", out, "--resume")
        time.sleep((0.2 + 0.8 * (part + moments.random()) / (MOMENTS + 1)) * whole)
        kill_group(process)
        for name, before in kept.items():
            path = out / name
            assert (path.stat().st_ino, path.stat().st_mtime_ns) == before, f"{name} was made again"
        kept = done_files(out)
    assert run_main("run", config, "--out", out, "--resume") == 0
    expected = set(os.listdir(tmp_path / "undisturbed"))
    assert set(os.listdir(out)) == expected | {".mine"}
    for name in expected:
        if name.endswith((".csv", ".npz")):
            assert (out / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes(), name
    assert_equal_stores(tmp_path / "undisturbed", out)
    assert (out / ".mine").read_text(encoding="utf-8") == "not the run's"


def done_files(out):
    """The files of the studies that the record calls done, each with what would change if it were written again."""
    if not (out / "run.json").is_file():
        return {}
    entries = json.loads((out / "run.json").read_text(encoding="utf-8"))["studies"]
    names = [
        name for entry in entries if entry["state"] == "done" and entry["kind"] != "sweep" for name in entry["files"]
    ]
    return {name: ((out / name).stat().st_ino, (out / name).stat().st_mtime_ns) for name in names}


@pytest.mark.parametrize(
    "number, options", [(signal.SIGINT, ["--size", "85mm", "--workers", "1"]), (signal.SIGTERM, [])]
)
def test_stopped_a_run_says_how_to_go_on(config, tmp_path, number, options):
    process = start_command("run", config, "--out", tmp_path / "an out", *options)
    wait_for_chunks(process, tmp_path / "an out", 1)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    _, errors = process.communicate(timeout=LONGEST)
    assert process.returncode == 128 + number, errors
    again = shlex.join(["zwidth", "run", str(config), "--out", str(tmp_path / "an out"), "--resume", *options])
    assert errors.endswith(f"zwidth: stopped; results so far are kept. Resume with: {again}\n")
    assert "Traceback" not in errors


def test_stopped_before_its_first_chunk_a_run_says_the_same(config, tmp_path, monkeypatch, capsys):
    def stopped(store, tasks):
        raise KeyboardInterrupt

    process = start_command("run", config, "--out", tmp_path)
    wait_for_chunks(process, tmp_path, 1)
    kill_group(process)
    monkeypatch.setattr("zwidth.sweep.engine.repair_store", stopped)
    assert run_main("run", config, "--out", tmp_path, "--resume") == 130
    says = f"zwidth: stopped; results so far are kept. Resume with: zwidth run {config} --out {tmp_path} --resume\n"
    assert capsys.readouterr().err == says


def test_the_plan_is_printed_without_doing_anything(config, tmp_path, capsys):
    assert run_main("run", config, "--out", tmp_path / "out", "--dry-run") == 0
    assert "50,000,000 (d 2 x delta 25 x alpha 1000 x beta 1000)" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
