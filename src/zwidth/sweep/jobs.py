"""One chunk of one store, from nothing to done: what all engines hand out, do and get back."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeAlias

from zwidth.sweep.files import hopeless
from zwidth.sweep.plan import Task
from zwidth.sweep.store import Store
from zwidth.words.errors import ZwidthError

Perform: TypeAlias = Callable[[str, str, int], None]
"""What computes one chunk: `zwidth.sweep.jobs.perform`, or in a test something that fails."""

MAX_ATTEMPTS = 3
"""How often a chunk is tried whose worker is killed."""


class LostSchedulerError(ZwidthError):
    """An engine that cannot go on; the message follows on its name."""


class Job(NamedTuple):
    """One chunk of one store."""

    path: str
    task: Task


class Finished(NamedTuple):
    """How one chunk went: no error, or what went wrong; ``hopeless`` where the other chunks would fare the same."""

    job: Job
    error: str = ""
    hopeless: bool = False


def attempt(perform: Perform, job: Job) -> Finished:
    """Do one job; whatever goes wrong is told, for the other jobs do not depend on it."""
    try:
        perform(job.path, job.task.family, job.task.index)
    except Exception as error:
        return describe_failure(job, error)
    return Finished(job)


def describe_failure(job: Job, error: BaseException) -> Finished:
    """What an exception means for a job and the others."""
    return Finished(job, f"{type(error).__name__}: {error}", hopeless(error))


def in_this_process(jobs: Iterable[Job], perform: Perform) -> Generator[Finished]:
    """Do one job after the other."""
    for job in jobs:
        yield attempt(perform, job)


@lru_cache(maxsize=4)
def _open_store(path: str, made: int) -> Store:
    """A store that this process works on; ``made`` tells it from another one that took its place."""
    return Store(Path(path))


def perform(path: str, family: str, index: int) -> None:
    """Compute and write one chunk of a store, by its number in a family of outputs, unless it is done already."""
    store = _open_store(path, os.stat(os.path.join(path, "zarr.json")).st_ino)
    task = Task("device" if family == "device" else "wall", index)
    if store.is_done(task):
        return
    plan = store.plan.family(family)
    if store.study.with_parts:
        from zwidth.sweep.scenes import compute_scenes

        block = store.grid.scene_block(plan.place(index))
        values = compute_scenes(plan.family, plan.outputs, store.study, block)
    else:
        # Loads JAX, which a process that only hands out work has no use for.
        from zwidth.sweep.compute import compute

        values = compute(plan.family, plan.outputs, store.grid.block(plan.place(index)), store.study.accuracy)
    # A scheduler that restarts, or a run that goes on, may have handed it out twice.
    if not store.is_done(task):
        store.write(task, values)
