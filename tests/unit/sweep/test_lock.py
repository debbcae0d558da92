"""The lock of an output folder: exclusive between runs, and released if the process is killed."""

import errno
import os
import shutil
import signal
import socket
import subprocess
import sys

import pytest
import yaml
from sweeping import assert_equal_stores, make_config, read_values, run_main, run_sweeps, study

import zwidth
from zwidth.core.errors import InputError, StoreBusyError
from zwidth.sweep import files
from zwidth.sweep.dataset import verify
from zwidth.sweep.files import lock_folder
from zwidth.sweep.jobs import perform
from zwidth.sweep.store import Store

# Locks the folder until the process is killed; prints "held" once locked.
HOLD = """
import sys, time
from pathlib import Path
from zwidth.sweep.files import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    monkeypatch.setattr(files, "LOCK_TIMEOUT", 0.1)


@pytest.fixture
def holder():
    """Return a function that starts a process locking a folder; all processes end with the test."""
    started = []

    def start(folder):
        process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        return process

    yield start
    for process in started:
        kill(process)


def kill(process):
    if process.poll() is None:
        process.send_signal(signal.SIGKILL)
        process.communicate()


def test_second_run_raises_with_the_holder_of_the_lock(holder, tmp_path):
    process = holder(tmp_path)
    with pytest.raises(StoreBusyError) as caught:
        run_sweeps(make_config(), tmp_path, resume=True)
    message = str(caught.value)
    assert message.startswith(f"out: {tmp_path}: another run is writing to this folder (process {process.pid} on ")
    assert f" on {socket.gethostname()}, since 20" in message
    assert message.endswith(" UTC); wait until it ends, stop it, or choose another folder with --out DIR")
    assert list(tmp_path.glob("*.zarr")) == []


def test_killed_holder_does_not_block_a_run(holder, tmp_path):
    kill(holder(tmp_path))
    # The files of the killed process remain.
    assert f" on {socket.gethostname()}, since " in (tmp_path / ".locks" / "holder").read_text(encoding="utf-8")
    assert run_sweeps(make_config(), tmp_path, resume=True).ok


def test_lock_is_released_after_success_and_failure(tmp_path):
    assert run_sweeps(make_config(), tmp_path).ok
    with pytest.raises(ZeroDivisionError), lock_folder(tmp_path):
        raise ZeroDivisionError
    assert run_sweeps(make_config(), tmp_path, resume=True).ok


def test_two_runs_of_one_process_exclude_each_other(tmp_path):
    busy = pytest.raises(StoreBusyError, match=f"process {os.getpid()} on")
    with lock_folder(tmp_path), busy, lock_folder(tmp_path):
        pass


def test_command_reports_a_locked_folder_with_exit_code_2(holder, tmp_path, capsys):
    path, out = tmp_path / "sweep.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump({"version": 1, "name": "sweep", "studies": [study()]}), encoding="utf-8")
    assert run_main("run", path, "--out", out) == 0
    before = read_values(out)
    process = holder(out)
    capsys.readouterr()
    for arguments in (["--resume"], ["--overwrite"]):
        assert run_main("run", path, "--out", out, *arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"Error: out: {out}: another run is writing to this folder (process {process.pid} on ")
    # Commands that only read need no lock.
    assert run_main("verify", out) == 0
    assert run_main("export", out, "--csv", tmp_path / "table.csv") == 0
    assert run_main("run", path, "--out", out, "--dry-run") == 0
    assert read_values(out).keys() == before.keys()
    kill(process)
    assert run_main("run", path, "--out", out, "--overwrite") == 0


def test_locked_folder_is_neither_overwritten_nor_extended(holder, tmp_path, capsys):
    ridge = {"kind": "ridge", "name": "r", "delta": [0, 1], "d": 0}
    path, out = tmp_path / "both.yaml", tmp_path / "out"
    path.write_text(yaml.safe_dump({"version": 1, "name": "both", "studies": [ridge, study()]}), encoding="utf-8")
    process = holder(out)
    assert run_main("run", path, "--out", out) == 2
    assert f"another run is writing to this folder (process {process.pid} " in capsys.readouterr().err
    kill(process)
    assert run_main("run", path, "--out", out) == 0
    holder(out)
    with pytest.raises(StoreBusyError):
        zwidth.run(path, out=out, overwrite=True)
    assert (out / "run.json").is_file()
    assert verify(out)[0].ok


def test_store_copied_over_another_is_computed_from_its_own_files(tmp_path):
    for name, alpha in (("first", 0.1), ("second", 0.3)):
        axes = {"alpha": [alpha, 2 * alpha], "beta": 0.1, "delta": 0.1, "d": 1}
        assert run_sweeps(make_config(study(axes=axes, outputs=["spectral_radius"])), tmp_path / name).ok
    path = tmp_path / "first" / "map.zarr"
    # The copied files keep their inode numbers; a new store may reuse those of a deleted one.
    shutil.copytree(tmp_path / "second" / "map.zarr", path, dirs_exist_ok=True)
    store = Store(path)
    for task in store.plan.tasks():
        store.status_file(task).unlink()
        perform(str(path), task.family, task.index)
    assert_equal_stores(path.parent, tmp_path / "second")


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK])
def test_file_system_without_locks_is_accepted(tmp_path, monkeypatch, number):
    def raise_unsupported(file, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", raise_unsupported)
    with lock_folder(tmp_path), lock_folder(tmp_path):
        pass


def test_missing_holder_file_shortens_the_message_only(holder, tmp_path):
    holder(tmp_path)
    (tmp_path / ".locks" / "holder").unlink()
    with (
        pytest.raises(StoreBusyError, match="another run is writing to this folder; wait until"),
        lock_folder(tmp_path),
    ):
        pass


def test_file_instead_of_a_folder_raises(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(InputError, match="is a file"), lock_folder(tmp_path / "out"):
        pass


# Increments a number in a file, protected by the lock only.
COUNT = """
import sys, time
from pathlib import Path
from zwidth.sweep import files
files.LOCK_TIMEOUT = 60.0
folder, number = Path(sys.argv[1]), Path(sys.argv[1]) / "number"
for _ in range(10):
    with files.lock_folder(folder):
        before = int(number.read_text())
        time.sleep(0.01)
        number.write_text(str(before + 1))
"""


def test_competing_processes_lock_the_folder_one_at_a_time(tmp_path):
    (tmp_path / "number").write_text("0", encoding="utf-8")
    processes = [subprocess.Popen([sys.executable, "-c", COUNT, str(tmp_path)]) for _ in range(4)]
    assert [process.wait() for process in processes] == [0] * 4
    assert (tmp_path / "number").read_text(encoding="utf-8") == "40"
