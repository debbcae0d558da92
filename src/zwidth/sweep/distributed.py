"""An existing dask.distributed cluster as the engine; the only module that imports distributed."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from zwidth.errors import InputError
from zwidth.sweep.jobs import Finished, Job, Perform, describe_failure

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_SECONDS = 30
# Enough to keep every worker busy, few enough that a scheduler never holds a whole sweep.
_AHEAD = 4


@contextmanager
def connected(address: str) -> Iterator[Client]:
    """A connection to a scheduler while the block runs; an `InputError` where nobody answers."""
    from distributed import Client

    try:
        client = Client(address, timeout=_CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise InputError(f"scheduler: no answer from {address!r} ({error}); check the address") from error
    try:
        yield client
    finally:
        client.close()


def on_cluster(jobs: list[Job], client: Client, perform: Perform) -> Generator[Finished]:
    """Do jobs on the workers of a scheduler; they must see the stores under the same path.

    A worker that dies may take innocent chunks with it, those that it had just begun: what dask gives up is tried
    again at the end, one by one, before it is called a failure.
    """
    _check_folder(client, jobs)
    given_up = []
    for finished in _submit_jobs(client, jobs, perform):
        if finished.error and _tells_of_death(finished.error):
            given_up.append(finished.job)
        else:
            yield finished
    for job in given_up:
        yield from _submit_jobs(client, [job], perform)


def _tells_of_death(error: str) -> bool:
    return error.startswith("KilledWorker")


def _submit_jobs(client: Client, jobs: list[Job], perform: Perform) -> Generator[Finished]:
    """Keep a bounded number of chunks on the cluster; only their names travel."""
    from distributed import as_completed

    waiting = iter(jobs)
    of_future: dict[Any, Job] = {}
    # A cluster that is still starting has no workers yet, and may have more later.
    threads: Any = client.nthreads()
    ahead = _AHEAD * max(4, sum(threads.values()))
    completed = as_completed(with_results=False)

    def hand_out() -> None:
        job = next(waiting, None)
        if job is not None:
            future = client.submit(
                perform,
                job.path,
                job.task.family,
                job.task.index,
                key=f"{_name_job(job)}-{os.urandom(4).hex()}",
                pure=False,
            )
            of_future[future.key] = job
            completed.add(future)

    for _ in range(ahead):
        hand_out()
    for future in completed:
        job = of_future.pop(future.key)
        # The result is nothing: to fetch it would only fail where its worker has died since.
        error = None if future.status == "finished" else future.exception()
        yield Finished(job) if error is None else _describe_death(job, error)
        hand_out()


def _describe_death(job: Job, error: Any) -> Finished:
    """What dask says of a task that it could not do, in words of ours where its worker died."""
    if type(error).__name__ == "KilledWorker":
        return Finished(job, "KilledWorker: its worker died every time it was tried")
    return describe_failure(job, error)


def _name_job(job: Job) -> str:
    return f"{os.path.basename(job.path)}-{job.task.family}-{job.task.index}"


def _check_folder(client: Client, jobs: list[Job]) -> None:
    """Refuse workers that do not see the stores."""
    if not jobs or not client.nthreads():
        return
    path = jobs[0].path
    seen: Any = client.run(os.path.exists, path)
    blind = [worker for worker, sees in seen.items() if not sees]
    if blind:
        raise InputError(
            f"scheduler: its worker {blind[0]} does not see {path}; choose a folder that all machines share with "
            "--out DIR"
        )
