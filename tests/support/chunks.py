"""Chunks that go wrong, in a file that a run's processes load in no time: they find them by their names."""

import os
import signal
import time
from pathlib import Path

from zwidth.sweep.jobs import perform


def slowly(path, family, index):
    """A chunk that takes a moment, so that something can happen meanwhile."""
    time.sleep(0.02)
    perform(path, family, index)


def failing_on_2(path, family, index):
    """Chunk 2 always fails."""
    if index == 2:
        raise ArithmeticError("no number is good enough")
    perform(path, family, index)


def killed_on_2(path, family, index):
    """Chunk 2 always kills the process that computes it."""
    if index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    perform(path, family, index)


def killed_once_on_2(path, family, index):
    """Chunk 2 kills its first process only."""
    mark = Path(path).with_suffix(".killed")
    if index == 2 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    perform(path, family, index)


def disturb(path, number):
    """Send the scheduler a signal, once it has heard of the chunks before."""
    time.sleep(0.5)
    os.kill(int((Path(path).parents[1] / "pid").read_text(encoding="utf-8")), number)


def killing_the_scheduler_on_2(path, family, index):
    """The scheduler dies while chunk 2 is computed."""
    if index == 2:
        disturb(path, signal.SIGKILL)
    perform(path, family, index)


def stopping_the_scheduler_on_2(path, family, index):
    """The scheduler falls silent while chunk 2 is computed."""
    if index == 2:
        disturb(path, signal.SIGSTOP)
    perform(path, family, index)


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
