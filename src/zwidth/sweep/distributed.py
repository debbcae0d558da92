"""Compute the chunks of sweeps on the workers of an existing dask.distributed cluster.

A *job* is the computation of one chunk of one store (`sweep.jobs`). The *scheduler* of the cluster assigns jobs to
*worker* processes, each with one or more threads. A *future* is dask's handle of a submitted job. The workers write the
chunks into the stores themselves, so they need access to the stores under the same path as this process. Only this
module imports distributed.
"""

from __future__ import annotations

import logging
import os
import queue
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from zwidth.core.errors import InputError, format_install_command
from zwidth.sweep.jobs import Finished, Job, LostSchedulerError, Perform, describe_failure

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_SECONDS = 30  # timeout for connecting to the scheduler, in s
# Time in s without a finished job after which the scheduler is queried; the scheduler must reply within the same time.
_REPLY_SECONDS = 15
# Longest time in s without any worker. It is long, because workers may have to wait in the queue of a batch system.
_NO_WORKER_SECONDS = 600
# Number of submitted jobs per worker thread, large enough to keep every worker busy and small enough to limit the
# memory of the scheduler.
_JOBS_PER_THREAD = 4
_KILLED = "KilledWorker"  # name of dask's exception for a job whose worker died repeatedly
_GONE = "no longer replies, or has been restarted"  # end of a message that begins with the scheduler's address


class _MissingFolderError(InputError):
    """Error of a worker that has no access to the stores."""


@contextmanager
def connect(address: str) -> Iterator[Client]:
    """Connect to a scheduler within the context; raise `InputError` if the scheduler does not reply."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        remedy = format_install_command("distributed")
        raise InputError(f"scheduler: needs distributed, which is not installed; install it: {remedy}") from error

    with _silence_logs():
        try:
            client = Client(address, timeout=_CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise InputError(f"scheduler: no answer from {address!r} ({error}); check the address") from error
        try:
            yield client
        finally:
            # Ignore the error if the scheduler no longer replies, because the connection is closed in any case.
            with suppress(OSError):
                client.close(timeout=_REPLY_SECONDS)


@contextmanager
def _silence_logs() -> Iterator[None]:
    """Silence the log messages of distributed in the terminal within the context, because zwidth reports its errors."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado")]
    terminal = (sys.stderr, sys.__stderr__)
    before = {logging.getLogger(name): logging.getLogger(name).handlers for name in (*names, "asyncio")}
    for logger, handlers in before.items():
        # Add a NullHandler, because Python writes the messages of a logger without any handler to the terminal.
        others = (one for one in handlers if getattr(one, "stream", None) not in terminal)
        logger.handlers = [logging.NullHandler(), *others]
    try:
        yield
    finally:
        for logger, handlers in before.items():
            logger.handlers = handlers


def run_on_cluster(jobs: list[Job], client: Client, perform: Perform) -> Generator[Finished]:
    """Run jobs on the workers of a cluster and yield their outcomes, in the order of completion."""
    # Before reporting a failure, repeat each job that dask has abandoned, one at a time after all others. Dask abandons
    # a job if its worker dies several times, even if another job on this worker is the cause.
    given_up = []
    for finished in _submit_jobs(client, jobs, perform):
        if finished.error.startswith(_KILLED):
            given_up.append(finished.job)
        else:
            yield finished
    for job in given_up:
        yield from _submit_jobs(client, [job], perform)


def _submit_jobs(client: Client, jobs: list[Job], perform: Perform) -> Generator[Finished]:
    """Submit jobs to the cluster, a bounded number at a time, and yield their outcomes.

    Only the names of chunks are transferred, not their values.
    """
    waiting = iter(jobs)
    # Keep a reference to each future, because dask cancels a job whose future is deleted.
    jobs_by_key: dict[str, tuple[Job, Any]] = {}
    ended: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def submit_next() -> None:
        """Submit the next waiting job, if any."""
        job = next(waiting, None)
        if job is not None:
            key = f"{os.path.basename(job.path)}-{job.task.family}-{job.task.index}-{os.urandom(4).hex()}"
            arguments = (perform, job.path, job.task.family, job.task.index)
            future = client.submit(_perform_on_worker, *arguments, key=key, pure=False)
            jobs_by_key[key] = job, future
            future.add_done_callback(ended.put)

    # Assume at least four threads, because a starting cluster has no workers yet.
    for _ in range(_JOBS_PER_THREAD * max(4, sum(_count_threads(client).values()))):
        submit_next()
    with_workers = time.monotonic()
    while jobs_by_key:
        try:
            future = ended.get(timeout=_REPLY_SECONDS)
        except queue.Empty:
            if _count_threads(client):
                with_workers = time.monotonic()
            elif time.monotonic() - with_workers > _NO_WORKER_SECONDS:
                raise LostSchedulerError("has no workers") from None
            continue
        job, _ = jobs_by_key.pop(future.key)
        if future.status == "cancelled":
            raise LostSchedulerError(_GONE)
        # Do not fetch the result of the future, which is None; `sweep.engine` checks in the stores which chunks are
        # done.
        yield _describe_error(job, future.exception()) if future.status == "error" else Finished(job)
        with_workers = time.monotonic()
        submit_next()


def _count_threads(client: Client) -> dict[str, int]:
    """Return the number of threads per worker; raise `LostSchedulerError` if the scheduler does not reply."""
    try:
        return client.sync(client.scheduler.ncores, callback_timeout=_REPLY_SECONDS)  # pyright: ignore
    except (OSError, AttributeError, RuntimeError) as error:
        raise LostSchedulerError(_GONE) from error


def _perform_on_worker(perform: Perform, path: str, family: str, index: int) -> None:
    """Compute one chunk in a worker process; raise `_MissingFolderError` if the worker has no access to the store."""
    if not os.path.isdir(path):
        from distributed import get_worker

        raise _MissingFolderError(
            f"scheduler: its worker {get_worker().address} cannot access {path}; choose a folder shared by all "
            "machines with --out DIR"
        )
    perform(path, family, index)


def _describe_error(job: Job, error: Any) -> Finished:
    """Return the outcome of a job that failed on the cluster; raise the error of a worker without access to stores."""
    if isinstance(error, _MissingFolderError):
        raise error
    if type(error).__name__ == _KILLED:
        return Finished(job, f"{_KILLED}: the worker process died in every attempt")
    return describe_failure(job, error)
