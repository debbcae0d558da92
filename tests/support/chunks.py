"""Functions that replace `zwidth.sweep.jobs.perform` and fail in chunk 2; worker processes import them by name."""

import os
import shutil
import signal
import time
from pathlib import Path

from zwidth.sweep.jobs import perform
from zwidth.sweep.plan import Task
from zwidth.sweep.store import Store


def replay_from(finished, out):
    """Let chunks be copied from a finished run, so that processes which are soon killed need not load JAX."""
    out.with_name(f"{out.name}.finished").write_text(str(finished), encoding="utf-8")


def replay(path, family, index):
    """Copy a chunk of the finished run, its status file last; compute it if no finished run was named."""
    store = Store(Path(path))
    task = Task(store.plan.family(family), index)
    named = store.path.parent.with_name(f"{store.path.parent.name}.finished")
    if not named.exists():
        perform(path, family, index)
    elif not store.is_done(task):
        source = Store(Path(named.read_text(encoding="utf-8")) / store.path.name)
        for source_file, target_file in zip(source.files(task), store.files(task), strict=True):
            target_file.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source_file, target_file)


def fail_on_2(path, family, index):
    """Raise an error in chunk 2."""
    if index == 2:
        raise ArithmeticError("no number is good enough")
    perform(path, family, index)


def kill_worker_on_2(path, family, index):
    """Kill the process that computes chunk 2, always."""
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    replay(path, family, index)


def kill_worker_once_on_2(path, family, index):
    """Kill the first process that computes chunk 2."""
    mark = Path(path).with_suffix(".killed")
    if index == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    replay(path, family, index)


def signal_scheduler(path, number):
    """Send the scheduler a signal, after it has received the results of earlier chunks."""
    time.sleep(0.5)
    os.kill(int((Path(path).parents[1] / "pid").read_text(encoding="utf-8")), number)


def kill_scheduler_on_2(path, family, index):
    """Kill the scheduler while chunk 2 is computed."""
    if index == 2:
        signal_scheduler(path, signal.SIGKILL)
    replay(path, family, index)


def stop_scheduler_on_2(path, family, index):
    """Stop the scheduler's process while chunk 2 is computed."""
    if index == 2:
        signal_scheduler(path, signal.SIGSTOP)
    replay(path, family, index)


def store_nothing(path, family, index):
    """Return without storing the chunk."""


def interrupt_on_2(path, family, index):
    """Raise KeyboardInterrupt while chunk 2 is computed."""
    if index == 2:
        raise KeyboardInterrupt
    perform(path, family, index)


def fill_disk_on_2(path, family, index):
    """Raise the error of a full disk when chunk 2 is written."""
    if index == 2:
        raise OSError(28, "No space left on device")
    perform(path, family, index)
