"""The engine: sweeps chunk by chunk, in this process, in workers or on a cluster."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zwidth.sweep.jobs import Finished, Job, LostSchedulerError, in_this_process
from zwidth.sweep.plan import Plan, Task
from zwidth.sweep.resume import check_same, new_store, remove_partials, repair, store_path
from zwidth.sweep.store import Store
from zwidth.sweep.study import SweepStudy
from zwidth.words.errors import StoreExistsError


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
    planned: Sequence[tuple[SweepStudy, Plan]],
    folder: Path,
    about: Mapping[str, Any],
    *,
    shard: tuple[int, int] | None,
    workers: int | None,
    scheduler: str | None,
    progress: Callable[[Progress], None],
) -> Sweeps:
    """Compute what is missing in the stores ``<folder>/<study>.zarr``, made where they are not there (`check_stores`).

    Args:
        planned: the studies with their plans.
        folder: held by the caller.
        about: ``name``, ``description`` and ``config`` of the configuration, for the stores' attributes.
        shard, workers, scheduler, progress: as in `zwidth.run`.

    Raises:
        InputError: the scheduler does not answer, or its workers do not see the folder.
    """
    from zwidth.sweep.chunks import perform

    with ExitStack() as stack:
        client = None
        if scheduler is not None:
            # Before anything is made that a scheduler that does not answer would leave behind.
            from zwidth.sweep.distributed import connected

            client = stack.enter_context(connected(scheduler))
        stores, repaired = _prepare_stores(planned, folder, about, shard)
        results = {name: SweepResult(store.path, repaired=tuple(repaired[name])) for name, store in stores.items()}
        names = {str(store.path): name for name, store in stores.items()}
        points: dict[Job, int] = {}
        for name, store in stores.items():
            tasks = _pick_share(store.plan, shard)
            missing = [task for task in tasks if not store.is_done(task)]
            points |= {Job(str(store.path), task): store.plan.points(task) for task in missing}
            results[name].total, results[name].skipped = len(tasks), len(tasks) - len(missing)
        sweeps = Sweeps(results)
        if points:
            if client is not None:
                from zwidth.sweep.distributed import on_cluster

                finished = on_cluster(list(points), client, perform)
            elif workers is not None:
                from zwidth.sweep.pool import in_workers

                finished = in_workers(list(points), workers, perform)
            else:
                finished = in_this_process(list(points), perform)
            try:
                _follow(finished, points, sweeps, stores, names, progress)
            except LostSchedulerError as error:
                sweeps.lost = f"scheduler: {scheduler} {error}"
            _count(list(points), sweeps, stores, names)
        return sweeps


def _pick_share(plan: Plan, shard: tuple[int, int] | None) -> list[Task]:
    """The chunks that are this run's to compute."""
    tasks = list(plan.tasks())
    return tasks if shard is None else tasks[shard[0] - 1 :: shard[1]]


def check_stores(studies: Sequence[SweepStudy], folder: Path, *, going_on: bool) -> None:
    """Refuse stores that exist, unless the run goes on with them, and those that `check_same` refuses."""
    for study in studies:
        path = store_path(folder, study)
        if not path.exists():
            continue
        if not going_on:
            raise StoreExistsError(
                f"out: {path} exists already; go on with it with --resume, or choose another folder with --out DIR"
            )
        check_same(Store(path), study)


def _prepare_stores(
    planned: Sequence[tuple[SweepStudy, Plan]], folder: Path, about: Mapping[str, Any], shard: tuple[int, int] | None
) -> tuple[dict[str, Store], dict[str, list[str]]]:
    """The stores of all sweeps, made or found, and what was repaired in them."""
    stores, repaired = {}, {}
    for study, plan in planned:
        path = store_path(folder, study)
        if path.exists():
            stores[study.name] = store = Store(path)
            if shard is None:
                remove_partials(path)
            repaired[study.name] = [f"{study.name}/{what}" for what in repair(store, _pick_share(store.plan, shard))]
        else:
            stores[study.name] = new_store(folder, study, plan, about, shared=shard is not None)
            repaired[study.name] = []
    return stores, repaired


def _follow(
    results: Generator[Finished],
    points: dict[Job, int],
    sweeps: Sweeps,
    stores: dict[str, Store],
    names: dict[str, str],
    progress: Callable[[Progress], None],
) -> None:
    """Keep count of chunks while they are computed."""
    start, ended, computed, total = time.perf_counter(), 0, 0, sum(points.values())
    try:
        for number, finished in enumerate(results, start=1):
            name = names[finished.job.path]
            sweep = sweeps.results[name]
            ended += points[finished.job]
            if finished.error:
                sweep.failed[f"{name}/{stores[name].plan.describe(finished.job.task)}"] = finished.error
            else:
                computed += points[finished.job]
            rate = computed / max(time.perf_counter() - start, 1e-9)
            left = (total - ended) / rate if rate else math.nan
            progress(Progress(name, number, len(points), ended, total, rate, left, finished.error))
            if finished.hopeless:
                sweeps.hopeless = finished.error
                return
    except KeyboardInterrupt:
        sweeps.interrupted = True
    finally:
        # Ends the workers.
        results.close()


def _count(jobs: list[Job], sweeps: Sweeps, stores: dict[str, Store], names: dict[str, str]) -> None:
    """Count the chunks that are done: not those that an engine calls so, but those that the stores hold."""
    over = sweeps.hopeless or sweeps.interrupted or sweeps.lost
    for job in jobs:
        name = names[job.path]
        sweep, store = sweeps.results[name], stores[name]
        chunk = f"{name}/{store.plan.describe(job.task)}"
        if store.holds(job.task):
            sweep.computed += 1
            # Somebody else has done it in the meantime, a worker that was given up say.
            sweep.failed.pop(chunk, None)
        elif not over:
            sweep.failed.setdefault(chunk, "it was computed, and is not in the store")
