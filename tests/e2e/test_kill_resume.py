"""Runs that are killed, stopped, or run out of room, and what becomes of them."""

import os
import random
import resource
import signal
import time

import pytest
import yaml

from sweeping import assert_same, flags, start, study, zwidth

# More of them: ZWIDTH_KILLS=50 python -m pytest tests/e2e/test_kill_resume.py
MOMENTS = int(os.environ.get("ZWIDTH_KILLS", "6"))
# Chunks of a quarter of a million points: some seconds of work in many steps.
AXES = {
    "alpha": {"linear": {"start": 0.0, "stop": 1.0, "num": 1000}},
    "beta": {"linear": {"start": -0.2, "stop": 1.0, "num": 1000}},
    "delta": {"linear": {"start": 0.0, "stop": 2.0, "num": 10}},
    "d": [0, 0.5, 1, 2, 10],
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
    process = start("run", config, "--out", folder)
    begun = wait_for_chunks(process, folder, 1)
    errors = process.communicate(timeout=300)[1]
    assert process.returncode == 0, errors
    return folder, begun - started, time.monotonic() - begun


def wait_for_chunks(process, folder, count):
    """The time at which a run has done some chunks, or is at its end."""
    deadline = time.monotonic() + 240
    while len(flags(folder)) < count and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.005)
    return time.monotonic()


def kill_group(process):
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def test_killed_at_any_moment_a_run_resumes(config, undisturbed, tmp_path):
    reference, beginning, working = undisturbed
    moments = random.Random(20061)
    before = {}
    for number in range(MOMENTS):
        process = start("run", config, "--out", tmp_path, "--resume")
        if number % 3 == 0:
            # While it starts, makes its store or checks what is there.
            time.sleep(moments.uniform(0.1, 1.2) * beginning)
        else:
            wait_for_chunks(process, tmp_path, len(before) + 1)
            time.sleep(moments.uniform(0, 0.5 / MOMENTS) * working)
        kill_group(process)
        assert before.items() <= flags(tmp_path).items()
        before = flags(tmp_path)
    result = zwidth("run", config, "--out", tmp_path, "--resume")
    assert result.returncode == 0, result.stderr
    # Nothing that was marked as done was computed again.
    assert before.items() <= flags(tmp_path).items()
    assert zwidth("verify", tmp_path).returncode == 0
    assert_same(reference, tmp_path)
    assert list(tmp_path.rglob("*.partial")) == []


def test_a_parent_that_is_killed_takes_its_workers_along(config, undisturbed, tmp_path):
    process = start("run", config, "--out", tmp_path, "--workers", "2")
    wait_for_chunks(process, tmp_path, 2)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    deadline = time.monotonic() + 60
    while group_lives(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not group_lives(process.pid)
    result = zwidth("run", config, "--out", tmp_path, "--resume")
    assert result.returncode == 0, result.stderr
    assert_same(undisturbed[0], tmp_path)


def group_lives(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_a_run_says_how_to_go_on(config, tmp_path, number):
    process = start("run", config, "--out", tmp_path / "out", "--workers", "1")
    wait_for_chunks(process, tmp_path / "out", 1)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert f"zwidth: stopped; what is done is kept, go on with: zwidth run {config} --out" in errors
    assert "--resume" in errors
    assert "Traceback" not in errors


def test_no_room_for_a_file_ends_the_run_with_a_message(config, tmp_path):
    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, 12_000))

    rough = tmp_path / "rough.yaml"
    # Random enough that its chunks do not shrink below the limit.
    text = config.read_text(encoding="utf-8").replace("- stable", "- margin").replace("num: 1000", "num: 60")
    rough.write_text(text, encoding="utf-8")
    result = zwidth("run", rough, "--out", tmp_path / "out", preexec_fn=limit)
    assert result.returncode == 1
    assert "File too large" in result.stderr
    assert "make room and go on with: zwidth run" in result.stderr
    assert "Traceback" not in result.stderr


def test_what_cannot_fit_is_refused_before_any_work(config, tmp_path):
    text = config.read_text(encoding="utf-8").replace("num: 1000", "num: 100000").replace("- stable", "- margin")
    (tmp_path / "huge.yaml").write_text(text, encoding="utf-8")
    result = zwidth("run", tmp_path / "huge.yaml", "--out", tmp_path / "out")
    assert result.returncode == 2
    assert "free, but the results may take" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_store_of_another_configuration_is_refused(config, undisturbed, tmp_path):
    changed = tmp_path / "changed.yaml"
    changed.write_text(config.read_text(encoding="utf-8").replace("num: 10\n", "num: 11\n"), encoding="utf-8")
    result = zwidth("run", changed, "--out", undisturbed[0], "--resume")
    assert result.returncode == 2
    assert "studies[map].axes.delta.linear.num: the store was made with 10, the configuration has 11" in result.stderr


def test_the_plan_is_printed_without_doing_anything(config, tmp_path):
    result = zwidth("run", config, "--out", tmp_path / "out", "--dry-run")
    assert result.returncode == 0, result.stderr
    assert "50,000,000 (d 5 x delta 10 x alpha 1000 x beta 1000)" in result.stdout
    assert list(tmp_path.iterdir()) == []
