"""What the engines hand out and get back."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import NamedTuple, TypeAlias

from zwidth.sweep.files.whole import hopeless
from zwidth.sweep.plan import Task
from zwidth.words.errors import ZwidthError

Perform: TypeAlias = Callable[[str, str, int], None]
"""What computes one chunk: `zwidth.sweep.chunks.perform`, or in a test something that fails."""

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
