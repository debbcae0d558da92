"""Chunks that go wrong, in a file that a run's processes load in no time: they find them by their names."""

import os
import shutil
import signal
import time
from pathlib import Path

from zwidth.sweep.jobs import perform
from zwidth.sweep.plan import Task
from zwidth.sweep.store import Store


def replay_from(finished, out):
    """Let chunks that kill others be taken from a finished run: a process that soon dies need not load JAX before."""
    out.with_name(f"{out.name}.finished").write_text(str(finished), encoding="utf-8")


def replay(path, family, index):
    """A chunk of a finished run, its mark at last; computed where none was named."""
    store = Store(Path(path))
    task = Task(store.plan.family(family), index)
    named = store.path.parent.with_name(f"{store.path.parent.name}.finished")
    if not named.exists():
        perform(path, family, index)
    elif not store.is_done(task):
        source = Store(Path(named.read_text(encoding="utf-8")) / store.path.name)
        for theirs, ours in zip(source.files(task), store.files(task), strict=True):
            ours.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(theirs, ours)


def failing_on_2(path, family, index):
    """Chunk 2 always fails."""
    if index == 2:
        raise ArithmeticError("no number is good enough")
    perform(path, family, index)


def killed_on_2(path, family, index):
    """Chunk 2 always kills the process that computes it."""
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    replay(path, family, index)


def killed_once_on_2(path, family, index):
    """Chunk 2 kills its first process only."""
    mark = Path(path).with_suffix(".killed")
    if index == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    replay(path, family, index)


def disturb(path, number):
    """Send the scheduler a signal, once it has heard of the chunks before."""
    time.sleep(0.5)
    os.kill(int((Path(path).parents[1] / "pid").read_text(encoding="utf-8")), number)


def killing_the_scheduler_on_2(path, family, index):
    """The scheduler dies while chunk 2 is computed."""
    if index == 2:
        disturb(path, signal.SIGKILL)
    replay(path, family, index)


def stopping_the_scheduler_on_2(path, family, index):
    """The scheduler falls silent while chunk 2 is computed."""
    if index == 2:
        disturb(path, signal.SIGSTOP)
    replay(path, family, index)


def doing_nothing(path, family, index):
    """A chunk that is called done, and of which nothing is kept."""


def interrupted_on_2(path, family, index):
    """Somebody presses Ctrl-C while chunk 2 is computed."""
    if index == 2:
        raise KeyboardInterrupt
    perform(path, family, index)


def disk_full_on_2(path, family, index):
    """The disk is full when chunk 2 is written."""
    if index == 2:
        raise OSError(28, "No space left on device")
    perform(path, family, index)
