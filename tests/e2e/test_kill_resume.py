"""Runs that are killed or interrupted at random moments resume to the same results as an undisturbed run."""

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

# Few, since each costs the start of a program; scripts/kill_and_resume.py tries a hundred.
N_KILLS = 3
# Fifty chunks of a million points: about 1 s of work, enough steps to be interrupted between.
AXES = {
    "alpha": {"linear": {"start": 0.0, "stop": 1.0, "num": 1000}},
    "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 1000}},
    "delta": {"linear": {"start": 0.0, "stop": 2.0, "num": 25}},
    "d": [1, 2],
}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Configuration file of a sweep with many chunks."""
    path = tmp_path_factory.mktemp("config") / "sweep.yaml"
    text = yaml.safe_dump({"version": 1, "name": "sweep", "studies": [study("map", AXES)]})
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def undisturbed(config, tmp_path_factory):
    """Folder of an undisturbed run, its start-up time and its computing time."""
    folder = tmp_path_factory.mktemp("undisturbed") / "out"
    start_time = time.monotonic()
    process = start_command("run", config, "--out", folder)
    first_chunk_time = wait_for_chunks(process, folder, 1)
    errors = process.communicate(timeout=LONGEST)[1]
    assert process.returncode == 0, errors
    return folder, first_chunk_time - start_time, time.monotonic() - first_chunk_time


def wait_for_chunks(process, folder, count):
    """Wait until a run has finished `count` chunks or has ended, and return the time."""
    wait_for(lambda: len(list_status_files(folder)) >= count or process.poll() is not None)
    return time.monotonic()


def kill_group(process):
    """Kill a run; if it has already ended, its exit code must be 0."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode in (0, -signal.SIGKILL)


def test_run_killed_at_random_moments_resumes(config, undisturbed, tmp_path):
    reference, startup_time, computing_time = undisturbed
    rng = random.Random(20061)
    before = {}
    for number in range(N_KILLS):
        process = start_command("run", config, "--out", tmp_path, "--resume")
        if number % 3 == 0:
            # During start-up, creation of the store or its check on resume.
            time.sleep(rng.uniform(0.1, 1.2) * startup_time)
        else:
            wait_for_chunks(process, tmp_path, len(before) + 1)
            time.sleep(rng.uniform(0, 0.5 / N_KILLS) * computing_time)
        kill_group(process)
        assert before.items() <= list_status_files(tmp_path).items()
        before = list_status_files(tmp_path)
    assert run_main("run", config, "--out", tmp_path, "--resume") == 0
    # No chunk marked as done was computed again.
    assert before.items() <= list_status_files(tmp_path).items()
    assert run_main("verify", tmp_path) == 0
    assert_equal_stores(reference, tmp_path)
    assert list(tmp_path.rglob("*.partial")) == []


def test_folder_of_a_live_run_is_refused_until_it_is_killed(config, undisturbed, tmp_path, capsys):
    process = start_command("run", config, "--out", tmp_path)
    wait_for_chunks(process, tmp_path, 2)
    # Pause the run so that it does not finish meanwhile.
    os.killpg(process.pid, signal.SIGSTOP)
    assert process.poll() is None
    before = list_status_files(tmp_path)
    for options in (["--resume"], ["--overwrite"]):
        assert run_main("run", config, "--out", tmp_path, *options) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"Error: out: {tmp_path}: another run is writing to this folder (process {process.pid} ")
    assert list_status_files(tmp_path) == before
    kill_group(process)
    assert run_main("run", config, "--out", tmp_path, "--resume") == 0
    assert before.items() <= list_status_files(tmp_path).items()
    assert_equal_stores(undisturbed[0], tmp_path)


def test_workers_end_when_their_parent_is_killed(config, undisturbed, tmp_path):
    process = start_command("run", config, "--out", tmp_path, "--workers", "2")
    wait_for_chunks(process, tmp_path, 2)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    wait_for(lambda: not group_exists(process.pid))
    assert run_main("run", config, "--out", tmp_path, "--resume") == 0
    assert_equal_stores(undisturbed[0], tmp_path)


def group_exists(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_every_kind_of_study_survives_kills_at_random_moments(tmp_path, undisturbed):
    studies = [
        {"kind": "ridge", "name": "ridge", "delta": {"linear": {"start": 0, "stop": 2, "num": 50}}, "d": [0, 1]},
        {"kind": "boundary", "name": "boundary", "delta": [0, 0.5], "d": [0, 2]},
        {"kind": "map", "name": "map", "alpha": [0.1, 0.2, 0.9], "beta": [0.1, 0.4], "delta": 0.1, "d": [0, 0.5]},
        study("swept", {**AXES, "delta": [0.0, 0.5], "d": [1]}),
    ]
    config, out = tmp_path / "all.yaml", tmp_path / "out"
    config.write_text(yaml.safe_dump({"version": 1, "name": "all", "studies": studies}), encoding="utf-8")
    start_time = time.monotonic()
    assert run_main("run", config, "--out", tmp_path / "undisturbed") == 0
    # As a separate process it would also have needed the start-up time.
    total_time = undisturbed[1] + time.monotonic() - start_time
    out.mkdir()
    (out / ".mine").write_text("not the run's", encoding="utf-8")
    rng, finished = random.Random(20062), {}
    # One kill in each interval of the run, except for the first fifth, in which nothing exists yet.
    for part in rng.sample(range(N_KILLS + 1), N_KILLS + 1):
        process = start_command("run", config, "--out", out, "--resume")
        time.sleep((0.2 + 0.8 * (part + rng.random()) / (N_KILLS + 1)) * total_time)
        kill_group(process)
        for name, before in finished.items():
            path = out / name
            assert (path.stat().st_ino, path.stat().st_mtime_ns) == before, f"{name} was made again"
        finished = finished_files(out)
    assert run_main("run", config, "--out", out, "--resume") == 0
    expected = set(os.listdir(tmp_path / "undisturbed"))
    assert set(os.listdir(out)) == expected | {".mine"}
    for name in expected:
        if name.endswith((".csv", ".npz")):
            assert (out / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes(), name
    assert_equal_stores(tmp_path / "undisturbed", out)
    assert (out / ".mine").read_text(encoding="utf-8") == "not the run's"


def finished_files(out):
    """Files of the finished studies in run.json, each with its inode and modification time, which rewriting
    would change.
    """
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
def test_interrupted_run_prints_the_resume_command(config, tmp_path, number, options):
    process = start_command("run", config, "--out", tmp_path / "an out", *options)
    wait_for_chunks(process, tmp_path / "an out", 1)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    _, errors = process.communicate(timeout=LONGEST)
    assert process.returncode == 128 + number, errors
    resume_command = shlex.join(["zwidth", "run", str(config), "--out", str(tmp_path / "an out"), "--resume", *options])
    assert errors.endswith(f"zwidth: stopped; results so far are kept. Resume with: {resume_command}\n")
    assert "Traceback" not in errors


def test_run_interrupted_before_its_first_chunk_prints_the_resume_command(config, tmp_path, monkeypatch, capsys):
    def interrupt(store, tasks):
        raise KeyboardInterrupt

    process = start_command("run", config, "--out", tmp_path)
    wait_for_chunks(process, tmp_path, 1)
    kill_group(process)
    monkeypatch.setattr("zwidth.sweep.engine.repair_store", interrupt)
    assert run_main("run", config, "--out", tmp_path, "--resume") == 130
    message = f"zwidth: stopped; results so far are kept. Resume with: zwidth run {config} --out {tmp_path} --resume\n"
    assert capsys.readouterr().err == message


def test_dry_run_prints_the_plan_and_writes_nothing(config, tmp_path, capsys):
    assert run_main("run", config, "--out", tmp_path / "out", "--dry-run") == 0
    assert "50,000,000 (d 2 x delta 25 x alpha 1000 x beta 1000)" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
