"""An existing dask.distributed cluster as the engine; the only module that imports distributed."""

from __future__ import annotations

import logging
import os
import queue
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from zwidth.sweep.jobs import Finished, Job, LostSchedulerError, Perform, describe_failure
from zwidth.words.errors import InputError, how_to_install

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_SECONDS = 30
# A scheduler that tells nothing for so long is asked whether it is there, and has as long to answer.
_SILENT_SECONDS = 15
# Workers may wait in a queue of batch jobs; who has none for so long is not to wait for ever.
_NO_WORKER_SECONDS = 600
# Enough to keep every worker busy, few enough that a scheduler never holds a whole sweep.
_AHEAD = 4
_KILLED = "KilledWorker"
_GONE = "does not answer any more, or has started again"


class _BlindWorkerError(InputError):
    """A worker that does not see the stores."""


@contextmanager
def connected(address: str) -> Iterator[Client]:
    """A connection to a scheduler while the block runs; an `InputError` where nobody answers."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        remedy = how_to_install("distributed")
        raise InputError(f"scheduler: needs distributed, which is not installed; install it: {remedy}") from error

    with _terminal_without_logs():
        try:
            client = Client(address, timeout=_CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise InputError(f"scheduler: no answer from {address!r} ({error}); check the address") from error
        try:
            yield client
        finally:
            # One that does not answer is not told.
            with suppress(OSError):
                client.close(timeout=_SILENT_SECONDS)


@contextmanager
def _terminal_without_logs() -> Iterator[None]:
    """Take distributed's own handlers off the terminal: what matters of its log is said in one line of ours."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado")]
    terminal = (sys.stderr, sys.__stderr__)
    before = {logging.getLogger(name): logging.getLogger(name).handlers for name in (*names, "asyncio")}
    for logger, handlers in before.items():
        # With no handler at all Python itself would write to the terminal.
        others = (one for one in handlers if getattr(one, "stream", None) not in terminal)
        logger.handlers = [logging.NullHandler(), *others]
    try:
        yield
    finally:
        for logger, handlers in before.items():
            logger.handlers = handlers


def on_cluster(jobs: list[Job], client: Client, perform: Perform) -> Generator[Finished]:
    """Do jobs on the workers of a scheduler, which must see the stores under the same path."""
    # A worker that dies may take innocent chunks with it, those that it had just begun: what dask gives up is tried
    # again at the end, one by one, before it is called a failure.
    given_up = []
    for finished in _submit_jobs(client, jobs, perform):
        if finished.error.startswith(_KILLED):
            given_up.append(finished.job)
        else:
            yield finished
    for job in given_up:
        yield from _submit_jobs(client, [job], perform)


def _submit_jobs(client: Client, jobs: list[Job], perform: Perform) -> Generator[Finished]:
    """Keep a bounded number of chunks on the cluster; only their names travel."""
    waiting = iter(jobs)
    # Of futures that nobody holds, dask forgets the chunks.
    of_key: dict[str, tuple[Job, Any]] = {}
    ended: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def hand_out() -> None:
        job = next(waiting, None)
        if job is not None:
            key = f"{os.path.basename(job.path)}-{job.task.family}-{job.task.index}-{os.urandom(4).hex()}"
            words = (perform, job.path, job.task.family, job.task.index)
            future = client.submit(_perform_there, *words, key=key, pure=False)
            of_key[key] = job, future
            future.add_done_callback(ended.put)

    # A cluster that is still starting has no workers yet, and may have more later.
    for _ in range(_AHEAD * max(4, sum(_ask_for_threads(client).values()))):
        hand_out()
    with_workers = time.monotonic()
    while of_key:
        try:
            future = ended.get(timeout=_SILENT_SECONDS)
        except queue.Empty:
            if _ask_for_threads(client):
                with_workers = time.monotonic()
            elif time.monotonic() - with_workers > _NO_WORKER_SECONDS:
                raise LostSchedulerError("has no workers") from None
            continue
        job, _ = of_key.pop(future.key)
        if future.status == "cancelled":
            raise LostSchedulerError(_GONE)
        # Done or not, the store knows: the result is nothing, and may be lost with its worker.
        yield _describe_error(job, future.exception()) if future.status == "error" else Finished(job)
        with_workers = time.monotonic()
        hand_out()


def _ask_for_threads(client: Client) -> dict[str, int]:
    """The threads of every worker; a `LostSchedulerError` where the scheduler does not answer."""
    try:
        return client.sync(client.scheduler.ncores, callback_timeout=_SILENT_SECONDS)  # pyright: ignore
    except (OSError, AttributeError, RuntimeError) as error:
        raise LostSchedulerError(_GONE) from error


def _perform_there(perform: Perform, path: str, family: str, index: int) -> None:
    if not os.path.isdir(path):
        from distributed import get_worker

        raise _BlindWorkerError(
            f"scheduler: its worker {get_worker().address} does not see {path}; choose a folder that all machines "
            "share with --out DIR"
        )
    perform(path, family, index)


def _describe_error(job: Job, error: Any) -> Finished:
    """What dask says of a task that it could not do, in words of ours where its worker died."""
    if isinstance(error, _BlindWorkerError):
        raise error
    if type(error).__name__ == _KILLED:
        return Finished(job, f"{_KILLED}: its worker died every time it was tried")
    return describe_failure(job, error)
