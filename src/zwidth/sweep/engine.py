"""The engine: stores made, or found and repaired, then computed chunk by chunk: here, in workers or on a cluster."""

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
from zwidth.sweep.files import ELSEWHERE, differences, versions
from zwidth.sweep.jobs import Finished, Job, LostSchedulerError, attempt, in_workers
from zwidth.sweep.plan import Plan, Task
from zwidth.sweep.store import SUFFIX, Store, create
from zwidth.words.errors import StoreError, StoreExistsError
from zwidth.words.formatting import describe

_SHOWN_DIFFERENCES = 10


@dataclass(frozen=True)
class Progress:
    """How far the sweeps of a run are, told after every chunk."""

    study: str  # the one that the chunk belongs to
    chunks: int  # done, of all that there are to compute in this run
    total_chunks: int
    points: int
    total_points: int
    rate: float  # points a second since the start
    seconds_left: float  # at this rate; NaN before the first chunk
    error: str = ""  # what went wrong with the chunk; empty where nothing did


@dataclass
class SweepResult:
    """What became of one sweep."""

    store: Path  # its folder
    computed: int = 0  # chunks that this run computed
    skipped: int = 0  # chunks that were done before
    total: int = 0  # chunks that this run was to see done
    repaired: tuple[str, ...] = ()  # chunks whose files were damaged, and that were computed again
    failed: dict[str, str] = field(default_factory=dict)  # chunks that could not be computed, with the reason

    @property
    def ok(self) -> bool:
        """Whether everything that this run was to compute is there."""
        return not self.failed and self.computed + self.skipped == self.total


@dataclass
class Sweeps:
    """The sweeps of one run."""

    results: dict[str, SweepResult]  # by the name of the study
    hopeless: str = ""  # the error that ended the run early, for no other chunk would have escaped it, as a full disk
    interrupted: bool = False  # whether somebody stopped the run
    lost: str = ""  # why the cluster could not go on


def compute_sweeps(
    plans: Sequence[Plan],
    folder: Path,
    about: Mapping[str, Any],
    *,
    workers: int | None,
    scheduler: str | None,
    progress: Callable[[Progress], None],
) -> Sweeps:
    """Compute what is missing in the stores ``<folder>/<study>.zarr``, made where they are not there."""
    # The caller holds the lock of the folder. ``about`` contains the attributes of the stores: name, description,
    # config and config_sha256 (of config.yaml). The options are those of `zwidth.run`. Raises `InputError` if the
    # scheduler does not answer or its workers have no access to the folder.
    from zwidth.sweep.jobs import perform

    with ExitStack() as stack:
        client = None
        if scheduler is not None:
            # Before anything is made that a scheduler that does not answer would leave behind.
            from zwidth.sweep.distributed import connected

            client = stack.enter_context(connected(scheduler))
        sweeps, stores, jobs = Sweeps({}), {}, []
        for plan in plans:
            store, repaired = _prepare_store(plan, folder, about)
            tasks = list(store.plan.tasks())
            missing = [Job(str(store.path), task) for task in tasks if not store.is_done(task)]
            skipped, total = len(tasks) - len(missing), len(tasks)
            sweeps.results[plan.study.name] = SweepResult(store.path, 0, skipped, total, repaired)
            stores[str(store.path)] = store
            jobs += missing
        if jobs:
            if client is not None:
                from zwidth.sweep.distributed import on_cluster

                finished = on_cluster(jobs, client, perform)
            elif workers is not None:
                finished = in_workers(jobs, workers, perform)
            else:
                finished = (attempt(perform, job) for job in jobs)
            try:
                _follow(finished, jobs, stores, sweeps, progress)
            except LostSchedulerError as error:
                sweeps.lost = f"scheduler: {scheduler} {error}"
            _count(jobs, stores, sweeps)
        return sweeps


def check_stores(studies: Sequence[SweepStudy], folder: Path, *, going_on: bool) -> None:
    """Refuse stores that exist, unless the run goes on with them, and those that `check_same` refuses."""
    for study in studies:
        path = store_path(folder, study)
        if not path.exists():
            continue
        if not going_on:
            raise StoreExistsError(f"out: {path} exists already; go on with it with --resume, or {ELSEWHERE}")
        check_same(Store(path), study)


def _prepare_store(plan: Plan, folder: Path, about: Mapping[str, Any]) -> tuple[Store, tuple[str, ...]]:
    """The store of a sweep, made or found, and what was repaired in it."""
    path = store_path(folder, plan.study)
    if not path.exists():
        attributes = {
            "title": f"{about['name']}: {plan.study.name}",
            "comment": about["description"],
            "source": f"zwidth {versions()['zwidth']}",
            "history": f"{datetime.now(UTC).isoformat(timespec='seconds')} made by zwidth run",
            "precision": "float64",
            "versions": versions(),
            "config": about["config"],
            "config_sha256": about["config_sha256"],
            "study": plan.study.model_dump(mode="json", exclude_none=True),
            "plan": plan.as_dict(),
        }
        return create(path, attributes), ()
    store = Store(path)
    # Remove unfinished files of a killed run.
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)
    return store, tuple(f"{plan.study.name}/{what}" for what in repair(store, store.plan.tasks()))


def _follow(
    results: Generator[Finished],
    jobs: list[Job],
    stores: dict[str, Store],
    sweeps: Sweeps,
    progress: Callable[[Progress], None],
) -> None:
    start, ended, computed = time.perf_counter(), 0, 0
    total = sum(job.task.points for job in jobs)
    try:
        for number, finished in enumerate(results, start=1):
            store, task = stores[finished.job.path], finished.job.task
            points, name = task.points, store.study.name
            ended += points
            if finished.error:
                sweeps.results[name].failed[store.name(task)] = finished.error
            else:
                computed += points
            rate = computed / max(time.perf_counter() - start, 1e-9)
            left = (total - ended) / rate if rate else math.nan
            progress(Progress(name, number, len(jobs), ended, total, rate, left, finished.error))
            if finished.hopeless:
                sweeps.hopeless = finished.error
                return
    except KeyboardInterrupt:
        sweeps.interrupted = True
    finally:
        # Ends the workers.
        results.close()


def _count(jobs: list[Job], stores: dict[str, Store], sweeps: Sweeps) -> None:
    """Count the chunks that are done: not those that an engine calls so, but those that the stores hold."""
    over = sweeps.hopeless or sweeps.interrupted or sweeps.lost
    for path, task in jobs:
        store = stores[path]
        sweep = sweeps.results[store.study.name]
        if store.holds(task):
            sweep.computed += 1
            # Somebody else has done it in the meantime, a worker that was given up say.
            sweep.failed.pop(store.name(task), None)
        elif not over:
            sweep.failed.setdefault(store.name(task), "it was computed, and is not in the store")


def store_path(folder: Path, study: SweepStudy) -> Path:
    return folder / f"{study.name}{SUFFIX}"


def check_same(store: Store, study: SweepStudy) -> None:
    """Raise `StoreError` if a store has an old format, or was created for another study or by another release."""
    if not store.has_checksums:
        raise StoreError(f"{store.path}: old format, which can be read but not continued; {ELSEWHERE}")
    now = study.model_dump(mode="json", exclude_none=True)
    refuse_changes(store.path, study.name, "store", store.attributes["study"], now)
    refuse_versions(store.path, store.attributes["versions"])


def refuse_changes(where: Path, name: str, what: str, old: Any, new: Any) -> None:
    """Raise a `StoreError` that names all keys in which the study of existing results differs from the current one."""
    # Earlier releases wrote delay_model and delay_models; "held" is the exact delay, the only model of this release.
    changed = [each for each in differences(old, new) if each[1:] not in (("held", None), (["held"], None))]
    if changed:
        lines = [
            f"{where}: studies[{name}].{key}: the {what} was made with {describe(before)}, the configuration has "
            f"{describe(after)}"
            for key, before, after in changed[:_SHOWN_DIFFERENCES]
        ]
        more = len(changed) - _SHOWN_DIFFERENCES
        lines += [f"{where}: {more} more keys differ"] if more > 0 else []
        remedy = f"{where}: change the configuration back, or {ELSEWHERE}"
        raise StoreError("\n".join([*lines, remedy]))


def refuse_versions(where: Path, old: dict[str, str]) -> None:
    """Raise a `StoreError` if results are from other releases, because their values may differ."""
    for key, now in versions().items():
        if key != "python" and old.get(key) != now:
            what = f"{where}: made with {key} {old.get(key)}, now there is {now}"
            raise StoreError(f"{what}; install the same release, or {ELSEWHERE}")


def repair(store: Store, tasks: Iterable[Task]) -> list[str]:
    """Unmark damaged chunks and rewrite damaged coordinates; return descriptions of the repairs."""
    found = []
    names = store.damaged_files()
    if names:
        store.restore(names)
        found += [f"{name} (restored)" for name in names]
    for task in tasks:
        fault = store.fault_of(task) if store.is_done(task) else ""
        if fault:
            store.forget(task)
            found.append(f"{task}: {fault}")
    return found


def remove(folder: Path, study: SweepStudy) -> None:
    """Make room for a store to be made again; what is no store of a sweep stays, and is then refused."""
    path = store_path(folder, study)
    if path.is_dir() and not path.is_symlink():
        with suppress(StoreError):
            Store(path).attributes  # noqa: B018  (raises where the store is not one of ours)
            shutil.rmtree(path)
