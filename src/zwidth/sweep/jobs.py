"""Compute single chunks of stores, in this process or in worker processes that are replaced if they are killed.

A *job* is the computation of one *chunk*, a block of the grid of a sweep, and its *store* the Zarr group of that sweep.
`perform` computes and writes a chunk. Sweeps over rigid devices use the kernels of `sweep.compute`; sweeps over devices
with further parts evaluate one *scene*, a device with its timing and walls, per device (`compute_scenes`). The *family*
of an output is "wall" (one value per wall) or "device" (one value per device).
"""

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

from zwidth.analysis.batch import stiffest_walls
from zwidth.analysis.scene import Scene
from zwidth.config.sweep import SweepStudy
from zwidth.core.errors import InputError, ZwidthError
from zwidth.core.status import Status
from zwidth.stability.rigid.normalization import wall_status
from zwidth.stability.rigid.step_response import decay_time
from zwidth.sweep.files import is_fatal, read_or_empty
from zwidth.sweep.grid import SceneBlock
from zwidth.sweep.plan import Task
from zwidth.sweep.store import Store
from zwidth.units.outputs import MARGIN_OUTPUTS, OUTPUTS, RADIUS_OUTPUTS, STATUS_OF, Family

# Function that computes and writes one chunk, given the path of the store, the family and the index of the chunk. It is
# `perform`, or a failing replacement in tests.
Perform: TypeAlias = Callable[[str, str, int], None]

MAX_ATTEMPTS = 3  # largest number of attempts to compute a chunk whose worker process is killed
# Spawn the workers instead of forking this process, because a fork after the start of JAX inherits the locks of JAX but
# not the threads that release them.
_CONTEXT = multiprocessing.get_context("spawn")
_STOP_TIMEOUT = 3.0  # longest time in s for a worker to end by itself, after which it is killed


class LostSchedulerError(ZwidthError):
    """Error that the scheduler of the cluster no longer replies during a run.

    Its message continues a sentence that begins with the address of the scheduler.
    """


class Job(NamedTuple):
    """Computation of one chunk of one store."""

    path: str  # path of the store
    task: Task  # chunk


class Finished(NamedTuple):
    """The outcome of one job."""

    job: Job
    error: str = ""  # error message; empty if the job succeeded
    fatal: bool = False  # True if the error would affect every other job, too


def try_job(perform: Perform, job: Job) -> Finished:
    """Run one job and return its outcome.

    An exception becomes the error of the outcome, because other jobs must still run.
    """
    try:
        perform(job.path, job.task.family, job.task.index)
    except Exception as error:
        return describe_failure(job, error)
    return Finished(job)


def describe_failure(job: Job, error: BaseException) -> Finished:
    """Return the outcome of a job that raised an exception."""
    return Finished(job, f"{type(error).__name__}: {error}", is_fatal(error))


@lru_cache(maxsize=4)
def _open_store(path: str, described: bytes) -> Store:
    """Open a store, or return it from the cache if its description has not changed.

    The key of the cache contains the text ``described`` of the description, because another store may have replaced the
    one at the same path.
    """
    return Store(Path(path))


def perform(path: str, family: str, index: int) -> None:
    """Compute one chunk of a store and write it, unless it is done.

    Args:
        path: Path of the store.
        family: "wall" or "device".
        index: Index of the chunk among those of the family.
    """
    # Identify the store in the cache by its description and not by an inode number, because a later store may have the
    # same number.
    store = _open_store(path, read_or_empty(Path(path) / "zarr.json"))
    task = Task(plan := store.plan.family(family), index)
    if store.is_done(task):
        return
    if store.study.with_parts:
        block = store.plan.grid.scene_block(task.slices)
        values = compute_scenes(plan.family, plan.outputs, store.study, block)
    else:
        # Import `sweep.compute` only here, because it loads JAX, which the parent process of workers does not need.
        from zwidth.sweep.compute import compute_block

        values = compute_block(plan.family, plan.outputs, store.plan.grid.block(task.slices), store.study.accuracy)
    # Check again before writing, because a restarted scheduler or a resumed run may have assigned the chunk twice.
    if not store.is_done(task):
        store.write(task, values)


def run_in_workers(jobs: Iterable[Job], count: int, perform: Perform) -> Generator[Finished]:
    """Run jobs in ``count`` worker processes and yield their outcomes, in the order of completion.

    A job whose worker process dies is run again after all waiting jobs, in at most `MAX_ATTEMPTS` attempts.
    """
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
                    yield Finished(job, f"the worker process died in all {MAX_ATTEMPTS} attempts ({why})")
    finally:
        for worker in workers:
            worker.stop()


class _Worker:
    """Worker process ``number`` of ``count``, and its current job."""

    def __init__(self, number: int, count: int, perform: Perform) -> None:
        self.number = number
        self.job: Job | None = None
        self.pipe, child_pipe = _CONTEXT.Pipe()
        self.process = _CONTEXT.Process(target=_run_worker, args=(child_pipe, number, count, perform), daemon=True)
        self.process.start()
        child_pipe.close()

    def start(self, job: Job) -> None:
        """Send a job to the process."""
        self.job = job
        # Ignore the error of sending to a dead process, because `run_in_workers` detects its death by its sentinel.
        with suppress(OSError):
            self.pipe.send(job)

    def result(self) -> Finished | None:
        """Return the outcome of the current job; None if the process died."""
        self.job = None
        with suppress(EOFError, OSError):
            return self.pipe.recv() if self.pipe.poll() else None
        return None

    def stop(self) -> None:
        """End the process.

        Interrupting a write is harmless, because a file appears under its name only when it is complete.
        """
        # Close the pipe of an idle process; the process then ends by itself.
        if self.job is None:
            self.pipe.close()
        else:
            self.process.terminate()
        self.process.join(_STOP_TIMEOUT)
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _run_worker(pipe: Connection, number: int, count: int, perform: Perform) -> None:
    """Run the jobs that arrive through a pipe until it is closed; this is the main function of a worker process.

    Args:
        pipe: Connection to the parent process.
        number: Number of the worker, from 0.
        count: Number of workers.
        perform: Function that computes one chunk.
    """
    # Ignore Ctrl-C, which the terminal sends to all processes of the group, because the parent ends the workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Exit by `sys.exit` on SIGTERM, so that Python's resource tracker does not report leaked semaphores.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # Restrict the worker to a subset of the processors, because otherwise JAX starts one thread per processor in each
    # worker.
    available = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else []
    if 1 < count <= len(available):
        os.sched_setaffinity(0, available[number::count])
    while True:
        try:
            job: Any = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(try_job(perform, job))


def _end_with_parent() -> None:
    """End this worker as soon as its parent has ended, because a killed parent cannot end its workers."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has a parent"
    parent.join()
    os._exit(1)


@lru_cache(maxsize=64)
def _reuse_equal_scene(scene: Scene) -> Scene:
    """Return an equal scene from the cache, whose stability boundary is known, or add this scene to the cache."""
    return scene


def compute_scenes(
    family: Family, outputs: tuple[str, ...], study: SweepStudy, block: SceneBlock
) -> dict[str, np.ndarray]:
    """Compute outputs of one family on a block with one scene per device, and their status.

    Args:
        family: "wall" or "device".
        outputs: Names of the outputs.
        study: The sweep, which creates the scenes.
        block: Parameters of D devices with A x B walls each.

    Returns:
        The outputs and the status of the family by name: arrays of shape (D, A, B) for walls, (D,) for devices.
    """
    devices = block.stiffness.shape[0]
    shape = (devices, block.stiffness.shape[1], block.virtual_damping.shape[1]) if family == "wall" else (devices,)
    results = {
        name: np.zeros(shape, bool) if OUTPUTS[name].dtype == "bool" else np.full(shape, np.nan) for name in outputs
    }
    status = np.full(shape, Status.OK, np.uint8)
    if family == "device":
        return _compute_stiffest(results, status, study, block)
    for k in range(devices):
        values = {name: float(column[k]) for name, column in block.parameters.items()}
        try:
            scene = _reuse_equal_scene(study.make_scene(values))
            walls = block.stiffness[k][:, None], block.virtual_damping[k][None, :]
            outputs_k, status_k = _compute_walls(scene, outputs, *walls)
        except InputError:
            status[k] = Status.INVALID_INPUT
            continue
        except (ZwidthError, ArithmeticError):
            status[k] = Status.NOT_CONVERGED
            continue
        status[k] = status_k
        for name in outputs:
            results[name][k] = outputs_k[name]
    return {**results, STATUS_OF[family]: status}


def _compute_stiffest(
    results: dict[str, np.ndarray], status: np.ndarray, study: SweepStudy, block: SceneBlock
) -> dict[str, np.ndarray]:
    """Compute the stiffest stable wall of each of the D devices of a block; write to arrays of shape (D,)."""
    scenes = []
    for k in range(status.size):
        try:
            scenes.append(study.make_scene({name: float(column[k]) for name, column in block.parameters.items()}))
        except InputError:
            status[k] = Status.INVALID_INPUT
    valid = np.flatnonzero(status == Status.OK)
    walls = stiffest_walls(scenes)
    status[valid] = walls.status
    values = {"stiffness_max": walls.stiffness, "virtual_damping_at_max": walls.virtual_damping}
    for name, column in results.items():
        column[valid] = values[name]
    return {**results, STATUS_OF["device"]: status}


def _compute_walls(
    scene: Scene, outputs: tuple[str, ...], stiffness: np.ndarray, virtual_damping: np.ndarray
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Compute outputs of the walls of one device.

    Args:
        scene: The scene of the device.
        outputs: Names of the outputs.
        stiffness: K or alpha, of shape (A, 1).
        virtual_damping: B or beta, of shape (1, B).

    Returns:
        The outputs by name and the status, all of shape (A, B).
    """
    results: dict[str, np.ndarray] = {}
    alpha, beta = scene.normalize_walls(stiffness, virtual_damping)
    status = wall_status(alpha, beta, np.float64(0.0), np.float64(0.0))
    if "stable" in outputs:
        # Transpose the walls, so that all walls of a row have the same damping: `decide` computes the stable intervals
        # of K once per row. With a measured response, walls may remain undecided, which the status reports.
        labels = scene.loop.decide(alpha.T, beta.T, "auto", (stiffness.T, virtual_damping.T))
        results["stable"], status = np.asarray(labels.stable).T, np.asarray(labels.status).T
    unknown = np.zeros(status.shape, bool)
    wanted = RADIUS_OUTPUTS & set(outputs)
    if wanted - {"spectral_radius"}:
        pole = scene.dominant_pole(stiffness, virtual_damping)
        results |= {"spectral_radius": pole.radius, "pole_angle": pole.angle, "frequency": pole.frequency}
        # Compute the margin 1 - radius and the settling time from the decay rate of the pole, because the radius of a
        # slowly decaying pole rounds to 1.
        margin, settling_time = -np.expm1(-pole.decay_rate * scene.timing.period), decay_time(pole.decay_rate)
        results |= {"decay_rate": pole.decay_rate, "margin": margin, "settling_time": settling_time}
    elif wanted:
        results["spectral_radius"] = np.asarray(scene.spectral_radius(stiffness, virtual_damping))
    for name in wanted:
        unknown |= np.isnan(results[name])
    if names := MARGIN_OUTPUTS & set(outputs):
        # Add the stability margins after the check for NaN, because NaN is also the correct value of a margin that does
        # not exist.
        walls = np.broadcast_arrays(alpha, beta)
        margins = scene.loop.margins(walls[0], walls[1], names)
        results |= {name: np.asarray(getattr(margins, name)) for name in names}
        if "delay_margin" in names:
            results["delay_margin"] = results["delay_margin"] * scene.timing.period
    if "passive" in outputs:
        margin = np.asarray(scene.passivity_margin(stiffness, virtual_damping))
        results["passive"] = margin > 0
        unknown |= np.isnan(margin)
    return results, np.where(unknown & (status == Status.OK), Status.NOT_CONVERGED, status)
