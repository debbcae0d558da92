"""The engine: every sweep of a configuration, chunk by chunk, in this process, in workers or on a cluster."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from zwidth.errors import InputError, StoreExistsError
from zwidth.sweep.document import Config
from zwidth.sweep.jobs import Finished, Job, Perform, in_this_process
from zwidth.sweep.lock import holding
from zwidth.sweep.plan import MEMORY, Plan, Task, check_resources, make_plan
from zwidth.sweep.resume import check_same, new_store, remove, repair, store_path, sweep_up
from zwidth.sweep.store import Store
from zwidth.sweep.sweeps import SweepStudy


@dataclass(frozen=True)
class SweepEvent:
    """How far the sweeps are, sent after every chunk.

    Attributes:
        study: name of the study that the chunk belongs to.
        chunks, total_chunks: how many are done and how many there are in this run.
        points, total_points: the same in points.
        rate: points a second since the start.
        seconds_left: at this rate; NaN before the first chunk.
        error: what went wrong with the chunk; empty where nothing did.
    """

    study: str
    chunks: int
    total_chunks: int
    points: int
    total_points: int
    rate: float
    seconds_left: float
    error: str = ""


@dataclass(frozen=True)
class SweepResult:
    """What became of the sweeps.

    Attributes:
        stores: the folder of each study's store by the study's name.
        computed: how many chunks this run computed.
        skipped: how many were done before.
        total: how many this run was to see done.
        repaired: the chunks whose files were damaged, and that were computed again.
        failed: the chunks that could not be computed, with the reason.
        hopeless: the error that ended the run early, for no other chunk would have escaped it, as a full disk.
        interrupted: whether somebody stopped the run.
    """

    stores: dict[str, Path]
    computed: int
    skipped: int
    total: int
    repaired: tuple[str, ...] = ()
    failed: dict[str, str] = field(default_factory=dict)
    hopeless: str = ""
    interrupted: bool = False

    @property
    def ok(self) -> bool:
        """Whether everything that this run was to do is done."""
        return not self.failed and not self.interrupted


def sweeps_of(config: Config) -> list[SweepStudy]:
    """The sweep studies of a configuration."""
    return [study for study in config.studies if isinstance(study, SweepStudy)]


def plan_sweeps(config: Config, *, memory: int = MEMORY) -> list[Plan]:
    """The plans of all sweeps, without doing anything."""
    return [make_plan(study, memory=memory) for study in sweeps_of(config)]


def run_sweeps(
    config: Config,
    out: str | os.PathLike[str],
    *,
    resume: bool = False,
    overwrite: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    shard: tuple[int, int] | None = None,
    memory: int = MEMORY,
    progress: Callable[[SweepEvent], None] | None = None,
    perform: Perform | None = None,
) -> SweepResult:
    """Compute the sweeps of a configuration into stores ``<out>/<study>.zarr``.

    Args:
        config: the configuration; studies of other kinds are left alone.
        out: the folder of the stores.
        resume: go on with stores that exist: chunks that are done and undamaged are not computed again.
        overwrite: remove stores that exist, and start again.
        workers: how many processes compute on this machine; this process itself where left out. They are spawned: a
            script that asks for them does its work below ``if __name__ == "__main__":``.
        scheduler: address of a dask.distributed scheduler whose workers compute, and see the same folder.
        shard: (i, n), 1 <= i <= n: compute every n-th chunk only, one of n such runs on the same stores.
        memory: bytes that a chunk may take while it is computed.
        progress: called with a `SweepEvent` after every chunk.
        perform: what computes one chunk; for tests.

    Returns:
        SweepResult: where the stores are, and what was computed, skipped, repaired and failed. A chunk that fails
        does not keep the others from being computed; Ctrl-C ends the run with ``interrupted`` set.

    Raises:
        StoreExistsError: a store exists and neither ``resume`` nor ``overwrite`` is set.
        StoreBusyError: another run computes in this folder; shards (i, n) of one n do not exclude each other.
        StoreError: a store is damaged, or was made from another configuration or by other releases.
        ResourceError: the results do not fit on the disk, or the workers not into memory.
        InputError: options that exclude each other.

    Numerics:
        Float64. The values do not depend on chunks, workers or engine; on another kind of processor or with another
        release of JAX the last digits may differ.
    """
    _check_options(workers, scheduler, shard, going_on=resume or shard is not None, overwrite=overwrite)
    folder = Path(os.path.abspath(os.fsdecode(out)))
    studies = sweeps_of(config)
    plans = {study.name: make_plan(study, memory=memory) for study in studies}
    # What does not fit is refused before anything is made.
    check_resources(list(plans.values()), folder, workers or 1, begun=_found(studies, folder))
    if not studies:
        return SweepResult({}, 0, 0, 0)
    with holding(folder, shard):
        if overwrite:
            for study in studies:
                remove(folder, study)
        stores, repaired = _stores(config, folder, plans, resume=resume, shard=shard)
        engine = partial(_engine, workers=workers, scheduler=scheduler, perform=perform)
        return _compute(stores, repaired, shard, engine, progress or (lambda event: None))


def _compute(
    stores: dict[str, Store],
    repaired: list[str],
    shard: tuple[int, int] | None,
    engine: Callable[[list[Job]], Generator[Finished]],
    progress: Callable[[SweepEvent], None],
) -> SweepResult:
    """Compute what is missing in the stores."""
    jobs, points, total = [], {}, 0
    for store in stores.values():
        tasks = _share(store.plan, shard)
        total += len(tasks)
        for task in (task for task in tasks if not store.is_done(task)):
            jobs.append(Job(str(store.path), task))
            points[jobs[-1]] = store.plan.points(task)
    names = {str(store.path): name for name, store in stores.items()}
    follower = _Follower(names, points, progress)
    interrupted = follower.follow(engine(jobs)) if jobs else False
    failed = {
        f"{names[job.path]}/{stores[names[job.path]].plan.describe(job.task)}": error
        for job, error in follower.failed.items()
    }
    paths = {name: store.path for name, store in stores.items()}
    return SweepResult(
        paths, follower.done, total - len(jobs), total, tuple(repaired), failed, follower.hopeless, interrupted
    )


def _check_options(
    workers: int | None, scheduler: str | None, shard: tuple[int, int] | None, *, going_on: bool, overwrite: bool
) -> None:
    if workers is not None and scheduler is not None:
        raise InputError("workers, scheduler: got both; the cluster has its own workers, give one of the two")
    if workers is not None and workers < 1:
        raise InputError(f"workers: got {workers}; at least 1")
    if shard is not None and not 1 <= shard[0] <= shard[1]:
        raise InputError(f"shard: got {shard[0]}/{shard[1]}; give i/n with 1 <= i <= n")
    if overwrite and going_on:
        raise InputError("overwrite: it starts again, resume and shard go on; give one of them")


def _share(plan: Plan, shard: tuple[int, int] | None) -> list[Task]:
    """The chunks that are this run's to compute."""
    tasks = list(plan.tasks())
    return tasks if shard is None else tasks[shard[0] - 1 :: shard[1]]


def _found(studies: list[SweepStudy], folder: Path) -> set[str]:
    """The studies that have a store."""
    return {study.name for study in studies if store_path(folder, study).exists()}


def _stores(
    config: Config, folder: Path, plans: dict[str, Plan], *, resume: bool, shard: tuple[int, int] | None
) -> tuple[dict[str, Store], list[str]]:
    """The stores of all sweeps, made or found, and what was repaired in them."""
    studies = sweeps_of(config)
    found = _found(studies, folder)
    if found and not resume and shard is None:
        first = next(store_path(folder, study) for study in studies if study.name in found)
        raise StoreExistsError(
            f"out: {first} exists already; go on with it with --resume, or choose another folder with --out DIR"
        )
    # Everything is checked before anything is made or changed.
    for study in studies:
        if study.name in found:
            check_same(Store(store_path(folder, study)), study)
    stores, repaired = {}, []
    for study in studies:
        if shard is None:
            sweep_up(folder, study)
        if study.name in found:
            stores[study.name] = store = Store(store_path(folder, study))
            repaired += [f"{study.name}/{what}" for what in repair(store, _share(store.plan, shard))]
        else:
            stores[study.name] = new_store(folder, study, plans[study.name], config, shared=shard is not None)
    return stores, repaired


def _engine(
    jobs: list[Job], *, workers: int | None, scheduler: str | None, perform: Perform | None
) -> Generator[Finished]:
    if perform is None:
        from zwidth.sweep.chunks import perform
    if scheduler is not None:
        from zwidth.sweep.distributed import on_cluster

        return on_cluster(jobs, scheduler, perform)
    if workers is not None:
        from zwidth.sweep.pool import in_workers

        return in_workers(jobs, workers, perform)
    return in_this_process(jobs, perform)


class _Follower:
    """Keeps count of chunks while an engine works.

    Args:
        names: the study of each store.
        points: the points of every chunk that is to be computed.
        progress: told after every chunk.
    """

    def __init__(self, names: dict[str, str], points: dict[Job, int], progress: Callable[[SweepEvent], None]) -> None:
        self.names = names
        self.points = points
        self.progress = progress
        self.done = 0
        self.failed: dict[Job, str] = {}
        self.hopeless = ""

    def follow(self, results: Generator[Finished]) -> bool:
        """Take the results of an engine to the end; returns whether somebody stopped it."""
        start, ended, computed = time.perf_counter(), 0, 0
        total = sum(self.points.values())
        try:
            for finished in results:
                self._count(finished)
                ended += self.points[finished.job]
                computed += 0 if finished.error else self.points[finished.job]
                rate = computed / max(time.perf_counter() - start, 1e-9)
                left = (total - ended) / rate if rate else math.nan
                name = self.names[finished.job.path]
                self.progress(
                    SweepEvent(
                        name,
                        self.done + len(self.failed),
                        len(self.points),
                        ended,
                        total,
                        rate,
                        left,
                        finished.error,
                    )
                )
                if finished.hopeless:
                    self.hopeless = finished.error
                    break
        except KeyboardInterrupt:
            return True
        finally:
            # Ends the workers.
            results.close()
        return False

    def _count(self, finished: Finished) -> None:
        if finished.error:
            self.failed[finished.job] = finished.error
        else:
            self.done += 1
