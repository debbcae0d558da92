"""Compute the sweeps of a run: create or repair their stores, then compute the missing chunks one by one.

A *chunk* is one block of the grid of a sweep, described by a `Task` of its plan (`sweep.plan`); a *job* is the
computation of one chunk of one store. Chunks are computed
in this process, in worker processes (`sweep.jobs`) or on a cluster (`sweep.distributed`). Each sweep has one *store*,
``<study>.zarr`` in the folder of the run (`sweep.store`). A chunk is done once its status file is in the store;
therefore an interrupted run can be resumed from the stores alone.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zwidth.config.sweep import SweepStudy
from zwidth.core.errors import StoreError, StoreExistsError
from zwidth.sweep.files import ELSEWHERE, list_differences, list_versions
from zwidth.sweep.jobs import Finished, Job, LostSchedulerError, run_in_workers, try_job
from zwidth.sweep.plan import Plan, Task
from zwidth.sweep.store import SUFFIX, Store, create_store
from zwidth.units.formatting import describe

_SHOWN_DIFFERENCES = 10  # largest number of differing configuration keys that one message lists


@dataclass(frozen=True)
class Progress:
    """The progress of the sweeps of a run, reported after every chunk."""

    study: str  # name of the study of this chunk
    chunks: int  # number of chunks finished so far in this run
    total_chunks: int  # number of chunks to be computed in this run
    points: int  # number of points of the grids finished so far in this run
    total_points: int  # number of points of the grids to be computed in this run
    rate: float  # mean number of points computed per second since the start
    seconds_left: float  # estimated remaining time in s; NaN before the first computed chunk
    error: str = ""  # error of this chunk; empty if it was computed


@dataclass
class SweepResult:
    """The outcome of one sweep."""

    store: Path  # path of the store of the sweep
    computed: int = 0  # number of chunks computed by this run
    skipped: int = 0  # number of chunks computed by earlier runs
    total: int = 0  # number of all chunks of the sweep
    repaired: tuple[str, ...] = ()  # damaged chunks, which are computed again, with their faults; and restored files
    failed: dict[str, str] = field(default_factory=dict)  # error of each failed chunk, by name of the chunk

    @property
    def ok(self) -> bool:
        """True if every chunk of the sweep is computed."""
        return not self.failed and self.computed + self.skipped == self.total


@dataclass
class Sweeps:
    """The outcome of all sweeps of one run."""

    results: dict[str, SweepResult]  # outcome of each sweep, by name of the study
    fatal_error: str = ""  # error that ended the run because it affects every chunk, for example a full disk
    interrupted: bool = False  # True if the user stopped the run with Ctrl-C
    cluster_error: str = ""  # error of the cluster that ended the run


def compute_sweeps(
    plans: Sequence[Plan],
    folder: Path,
    about: Mapping[str, Any],
    *,
    workers: int | None,
    scheduler: str | None,
    progress: Callable[[Progress], None],
) -> Sweeps:
    """Compute the missing chunks of the stores ``<folder>/<study>.zarr``; create stores that do not exist.

    The caller must hold the lock of the folder, and must have called `check_stores`.

    Args:
        plans: The plan of each sweep.
        folder: Folder of the run.
        about: Attributes of the stores: name, description, config, and config_sha256 (of config.yaml).
        workers: Number of worker processes; None to compute in this process. No effect with a scheduler.
        scheduler: Address of a dask.distributed scheduler; None to compute on this machine.
        progress: Function that is called after every chunk.

    Raises:
        InputError: The scheduler does not reply, or its workers have no access to the folder.
    """
    # Import `perform` here, because tests replace it in `sweep.jobs`.
    from zwidth.sweep.jobs import perform

    with ExitStack() as stack:
        client = None
        if scheduler is not None:
            # Connect before creating a store, so that an unreachable scheduler leaves no store behind.
            from zwidth.sweep.distributed import connect

            client = stack.enter_context(connect(scheduler))
        sweeps, stores, jobs = Sweeps({}), {}, []
        for plan in plans:
            store, repaired = _prepare_store(plan, folder, about)
            # Use the plan that the store records, because its chunks may differ from those of a new plan.
            tasks = list(store.plan.tasks())
            missing = [Job(str(store.path), task) for task in tasks if not store.is_done(task)]
            skipped, total = len(tasks) - len(missing), len(tasks)
            sweeps.results[plan.study.name] = SweepResult(store.path, 0, skipped, total, repaired)
            stores[str(store.path)] = store
            jobs += missing
        if jobs:
            if client is not None:
                from zwidth.sweep.distributed import run_on_cluster

                finished = run_on_cluster(jobs, client, perform)
            elif workers is not None:
                finished = run_in_workers(jobs, workers, perform)
            else:
                finished = (try_job(perform, job) for job in jobs)
            try:
                _collect_outcomes(finished, jobs, stores, sweeps, progress)
            except LostSchedulerError as error:
                sweeps.cluster_error = f"scheduler: {scheduler} {error}"
            _count_chunks(jobs, stores, sweeps)
        return sweeps


def check_stores(studies: Sequence[SweepStudy], folder: Path, *, resume: bool) -> None:
    """Raise an error if a store exists and cannot be continued.

    Args:
        studies: The sweeps of the run.
        folder: Folder of the run.
        resume: True if existing stores are to be continued.

    Raises:
        StoreExistsError: A store exists, and ``resume`` is False.
        StoreError: An existing store differs from the study or the release (`check_same`).
    """
    for study in studies:
        path = store_path(folder, study)
        if not path.exists():
            continue
        if not resume:
            raise StoreExistsError(f"out: {path} already exists; continue it with --resume, or {ELSEWHERE}")
        check_same(Store(path), study)


def _prepare_store(plan: Plan, folder: Path, about: Mapping[str, Any]) -> tuple[Store, tuple[str, ...]]:
    """Create the store of a sweep, or open and repair an existing one; return the store and the repairs."""
    path = store_path(folder, plan.study)
    if not path.exists():
        attributes = {
            "title": f"{about['name']}: {plan.study.name}",
            "comment": about["description"],
            "source": f"zwidth {list_versions()['zwidth']}",
            "history": f"{datetime.now(UTC).isoformat(timespec='seconds')} created by zwidth run",
            "precision": "float64",
            "versions": list_versions(),
            "config": about["config"],
            "config_sha256": about["config_sha256"],
            "study": plan.study.model_dump(mode="json", exclude_none=True),
            "plan": plan.as_dict(),
        }
        return create_store(path, attributes), ()
    store = Store(path)
    # Remove files that a killed run left unfinished, because nothing else removes them.
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)
    return store, tuple(f"{plan.study.name}/{each}" for each in repair_store(store, store.plan.tasks()))


def _collect_outcomes(
    results: Generator[Finished],
    jobs: list[Job],
    stores: dict[str, Store],
    sweeps: Sweeps,
    progress: Callable[[Progress], None],
) -> None:
    """Record the outcomes of jobs and report the progress after each of them; stop at a fatal error or Ctrl-C.

    Args:
        results: Outcomes of the jobs, in the order of completion.
        jobs: All jobs.
        stores: The stores by path.
        sweeps: Outcome of all sweeps, which is updated.
        progress: Function that is called after every chunk.
    """
    start, ended, computed = time.perf_counter(), 0, 0
    total = sum(job.task.points for job in jobs)
    try:
        for number, finished in enumerate(results, start=1):
            store, task = stores[finished.job.path], finished.job.task
            points, name = task.points, store.study.name
            ended += points
            if finished.error:
                sweeps.results[name].failed[store.label(task)] = finished.error
            else:
                computed += points
            rate = computed / max(time.perf_counter() - start, 1e-9)
            left = (total - ended) / rate if rate else math.nan
            progress(Progress(name, number, len(jobs), ended, total, rate, left, finished.error))
            if finished.fatal:
                sweeps.fatal_error = finished.error
                return
    except KeyboardInterrupt:
        sweeps.interrupted = True
    finally:
        # Close the generator of the outcomes, because this ends the worker processes.
        results.close()


def _count_chunks(jobs: list[Job], stores: dict[str, Store], sweeps: Sweeps) -> None:
    """Count the computed chunks of each sweep from the files in its store, not from the outcomes of the jobs.

    Args:
        jobs: All jobs of the run.
        stores: The stores by path.
        sweeps: Outcome of all sweeps, which is updated.
    """
    over = sweeps.fatal_error or sweeps.interrupted or sweeps.cluster_error
    for path, task in jobs:
        store = stores[path]
        sweep = sweeps.results[store.study.name]
        # Use `is_visible` instead of `is_done`, because a file system may report the files of other machines late.
        if store.is_visible(task):
            sweep.computed += 1
            # Discard the error of the job, because the chunk is done: another process has computed it, such as a worker
            # that was assumed dead.
            sweep.failed.pop(store.label(task), None)
        elif not over:  # if the run ended early, chunks without an outcome are neither computed nor failed
            sweep.failed.setdefault(store.label(task), "reported as computed but missing from the store")


def store_path(folder: Path, study: SweepStudy) -> Path:
    """Return the path of the store of a sweep in the folder of a run."""
    return folder / f"{study.name}{SUFFIX}"


def check_same(store: Store, study: SweepStudy) -> None:
    """Raise `StoreError` if a store has the old format, or was created from another study or by another release."""
    if not store.has_checksums:
        raise StoreError(f"{store.path}: old format, which can be read but not continued; {ELSEWHERE}")
    now = study.model_dump(mode="json", exclude_none=True)
    refuse_changes(store.path, study.name, "store", store.attributes["study"], now)
    refuse_versions(store.path, store.attributes["versions"])


def refuse_changes(where: Path, name: str, noun: str, old: Any, new: Any) -> None:
    """Raise a `StoreError` with all differences if results were computed from another study.

    Args:
        where: File with the recorded study, for the message.
        name: Name of the study.
        noun: Noun for the results, "store" or "run".
        old: Recorded study, as JSON.
        new: Study of the current configuration, as JSON.
    """
    # Ignore the keys delay_model and delay_models of earlier releases if they have the value that is now the only one.
    ignored = ("delay_model", "held", None), ("delay_models", ["held"], None)
    differences = list_differences(old, new)
    changed = [(key, *values) for key, *values in differences if (key.rpartition(".")[2], *values) not in ignored]
    if changed:
        lines = [
            f"{where}: studies[{name}].{key}: the {noun} was created with {describe(before)}, the configuration has "
            f"{describe(after)}"
            for key, before, after in changed[:_SHOWN_DIFFERENCES]
        ]
        more = len(changed) - _SHOWN_DIFFERENCES
        lines += [f"{where}: {more} more keys differ"] if more > 0 else []
        remedy = f"{where}: change the configuration back, or {ELSEWHERE}"
        raise StoreError("\n".join([*lines, remedy]))


def refuse_versions(where: Path, old: dict[str, str]) -> None:
    """Raise `StoreError` if results were computed by other releases of zwidth or of the packages it computes with.

    The reason is that no set of releases could reproduce results of mixed origin. The version of Python, which does not
    compute the results, may differ. ``where`` is the file that records
    the releases ``old``, by package.
    """
    for key, now in list_versions().items():
        if key != "python" and old.get(key) != now:
            fault = f"{where}: created with {key} {old.get(key)}, now {now} is installed"
            raise StoreError(f"{fault}; install the same release, or {ELSEWHERE}")


def repair_store(store: Store, tasks: Iterable[Task]) -> list[str]:
    """Restore damaged coordinates and descriptions, mark damaged chunks as not done, and list the repairs."""
    repairs = []
    names = store.damaged_files()
    if names:
        store.restore(names)
        repairs += [f"{name} (restored)" for name in names]
    for task in tasks:
        fault = store.find_task_faults(task) if store.is_done(task) else ""
        if fault:
            store.unmark(task)
            repairs.append(f"{task}: {fault}")
    return repairs


def remove_store(folder: Path, study: SweepStudy) -> None:
    """Delete the store of a sweep; keep any folder of the same name that is not a store.

    Such a folder makes the `check_stores` that follows raise an error.
    """
    path = store_path(folder, study)
    if path.is_dir() and not path.is_symlink():
        with suppress(StoreError):
            Store(path).attributes  # noqa: B018  (raises StoreError if the folder is no store)
            shutil.rmtree(path)
