"""Chunks of stores, from nothing to done: in this process, or in workers, replaced when something kills them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from functools import lru_cache
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.config.sweep import SweepStudy
from zwidth.loops.rigid.normalization import wall_status
from zwidth.scenes.scene import Scene
from zwidth.sweep.files import content, hopeless
from zwidth.sweep.grid import SceneBlock
from zwidth.sweep.plan import Task
from zwidth.sweep.store import Store
from zwidth.words.errors import InputError, ZwidthError
from zwidth.words.quantities import OUTPUTS, STATUS_OF, Family
from zwidth.words.status import Status

Perform: TypeAlias = Callable[[str, str, int], None]
"""What computes one chunk: `zwidth.sweep.jobs.perform`, or in a test something that fails."""

MAX_ATTEMPTS = 3
"""How often a chunk is tried whose worker is killed."""
# Never fork a process in which JAX may have started: its threads do not survive, its locks do.
_CONTEXT = multiprocessing.get_context("spawn")
# Seconds that a worker may take to end by itself.
_PATIENCE = 3.0


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
    return Finished(job, f"{type(error).__name__}: {error}", hopeless(error))


@lru_cache(maxsize=4)
def _open_store(path: str, described: bytes) -> Store:
    """A store that this process works on; its description tells it from another one that took its place."""
    return Store(Path(path))


def perform(path: str, family: str, index: int) -> None:
    """Compute and write one chunk of a store, by its number in a family of outputs, unless it is done already."""
    # Not by the file's number, which the next store may get.
    store = _open_store(path, content(Path(path) / "zarr.json"))
    task = Task(plan := store.plan.family(family), index)
    if store.is_done(task):
        return
    if store.study.with_parts:
        block = store.plan.grid.scene_block(task.place)
        values = compute_scenes(plan.family, plan.outputs, store.study, block)
    else:
        # Loads JAX, which a process that only hands out work has no use for.
        from zwidth.sweep.compute import compute

        values = compute(plan.family, plan.outputs, store.plan.grid.block(task.place), store.study.accuracy)
    # A scheduler that restarts, or a run that goes on, may have handed it out twice.
    if not store.is_done(task):
        store.write(task, values)


def in_workers(jobs: Iterable[Job], count: int, perform: Perform) -> Generator[Finished]:
    """Do jobs in ``count`` processes; a job whose worker dies is tried again, at the end and a few times at most."""
    waiting = deque(jobs)
    deaths: Counter[Job] = Counter()
    workers = [_Worker(number, count, perform) for number in range(min(count, len(waiting)))]
    try:
        while waiting or any(worker.job for worker in workers):
            for worker in workers:
                if worker.job is None and waiting:
                    worker.start(waiting.popleft())
            busy = [worker for worker in workers if worker.job]
            ready = wait([part for worker in busy for part in (worker.pipe, worker.process.sentinel)])
            for worker in (worker for worker in busy if worker.pipe in ready or worker.process.sentinel in ready):
                job, finished = worker.job, worker.result()
                if finished is not None:
                    yield finished
                    continue
                assert job is not None, "a busy worker has a job"
                deaths[job] += 1
                worker.process.join()
                code = worker.process.exitcode or 0
                workers[workers.index(worker)] = _Worker(worker.number, count, perform)
                if deaths[job] < MAX_ATTEMPTS:
                    waiting.append(job)
                else:
                    why = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
                    yield Finished(job, f"its worker died each of {MAX_ATTEMPTS} times ({why})")
    finally:
        for worker in workers:
            worker.stop()


class _Worker:
    """One process of ``count``, and what it is doing."""

    def __init__(self, number: int, count: int, perform: Perform) -> None:
        self.number = number
        self.job: Job | None = None
        self.pipe, theirs = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_work, args=(theirs, number, count, perform), daemon=True)
        self.process.start()
        theirs.close()

    def start(self, job: Job) -> None:
        self.job = job
        # Where the worker is dead already, its sentinel says so.
        with suppress(OSError):
            self.pipe.send(job)

    def result(self) -> Finished | None:
        """How the job went; None where the worker died over it."""
        self.job = None
        with suppress(EOFError, OSError):
            return self.pipe.recv() if self.pipe.poll() else None
        return None

    def stop(self) -> None:
        """End the process; what it was writing is not there yet under its name."""
        # An idle one ends by itself when nobody can send it anything any more.
        if self.job is None:
            self.pipe.close()
        else:
            self.process.terminate()
        self.process.join(_PATIENCE)
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _work(pipe: Connection, number: int, count: int, perform: Perform) -> None:
    # Ctrl-C reaches the whole group of processes; the parent decides what becomes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Ends as a program does, so that Python has no leaked semaphore to complain about.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Its share of the processors: JAX would start a thread on each of them in every worker.
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else []
    if 1 < count <= len(available):
        os.sched_setaffinity(0, available[number::count])
    while True:
        try:
            job: Any = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(attempt(perform, job))


def _end_with_parent() -> None:
    """A parent that is killed cannot end its workers."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has a parent"
    parent.join()
    os._exit(1)


@lru_cache(maxsize=64)
def _keep(scene: Scene) -> Scene:
    """The scene that has laid out its boundary already, where an equal one has."""
    return scene


def compute_scenes(
    family: Family, outputs: tuple[str, ...], study: SweepStudy, block: SceneBlock
) -> dict[str, np.ndarray]:
    """Every output of a family on a block, and its status; walls in shape (D, A, B), devices in shape (D,)."""
    devices = block.stiffness.shape[0]
    shape = (devices, block.stiffness.shape[1], block.virtual_damping.shape[1]) if family == "wall" else (devices,)
    found = {
        name: np.zeros(shape, bool) if OUTPUTS[name].dtype == "bool" else np.full(shape, np.nan) for name in outputs
    }
    status = np.full(shape, Status.OK, np.uint8)
    for k in range(devices):
        values = {name: float(column[k]) for name, column in block.parameters.items()}
        try:
            scene = _keep(study.make_scene(values))
            if family == "wall":
                walls = block.stiffness[k][:, None], block.virtual_damping[k][None, :]
                one, told = _compute_walls(scene, outputs, *walls)
            else:
                top = scene.max_stiffness()
                one, told = {"stiffness_max": top.stiffness, "virtual_damping_at_max": top.virtual_damping}, top.status
        except InputError:
            status[k] = Status.INVALID_INPUT
            continue
        except (ZwidthError, ArithmeticError):
            status[k] = Status.NOT_CONVERGED
            continue
        status[k] = told
        for name in outputs:
            found[name][k] = one[name]
    return {**found, STATUS_OF[family]: status}


def _compute_walls(
    scene: Scene, outputs: tuple[str, ...], stiffness: np.ndarray, virtual_damping: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The outputs of one device's walls, and their status."""
    found: dict[str, np.ndarray] = {}
    alpha, beta = scene.normalize_walls(stiffness, virtual_damping)
    status = wall_status(alpha, beta, np.float64(0.0), np.float64(0.0))
    if "stable" in outputs:
        # With a row a damping its intervals serve all of its walls. A measured response leaves some of them undecided.
        labels = scene.loop.decide(alpha.T, beta.T, "auto", (stiffness.T, virtual_damping.T))
        found["stable"], status = np.asarray(labels.stable).T, np.asarray(labels.status).T
    unknown = np.zeros(status.shape, bool)
    if "spectral_radius" in outputs:
        found["spectral_radius"] = radius = np.asarray(scene.spectral_radius(stiffness, virtual_damping))
        unknown |= np.isnan(radius)
    if "passive" in outputs:
        margin = np.asarray(scene.passivity_margin(stiffness, virtual_damping))
        found["passive"] = margin > 0
        unknown |= np.isnan(margin)
    return found, np.where(unknown & (status == Status.OK), Status.NOT_CONVERGED, status)
