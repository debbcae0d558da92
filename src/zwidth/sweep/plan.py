"""Plan a sweep: divide its grid into chunks, choose the methods, and estimate time, memory and disk space.

The outputs of a sweep belong to two *families*, "wall" (one value per wall) and "device" (one value per device). Each
family has its own grid, which is divided into *chunks*: rectangular blocks that are computed, written and repaired as a
unit. A *point* is one point of a grid. The plan depends only on the study (the sweep as configured), so that every
machine computes the same chunks by the same methods. A *worker* is a process that computes chunks.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from zwidth.config.sweep import SweepStudy
from zwidth.core.errors import ResourceError
from zwidth.sweep.files import ELSEWHERE, check_folder, find_existing
from zwidth.sweep.grid import Grid
from zwidth.units.outputs import MARGIN_OUTPUTS, OUTPUTS, RADIUS_OUTPUTS, STATUS_OF, Family

MEMORY = 2**28  # default memory for the computation of one chunk, in bytes, in addition to `IDLE_MEMORY`
IDLE_MEMORY = 500 * 2**20  # memory of a worker before its first chunk, in bytes: Python, JAX and compiled kernels
_CHUNK_SECONDS = 10.0  # longest computing time of a chunk on one core, in s; a killed worker loses its chunk
_MAX_CHUNK = 2**25  # largest number of points per chunk
_MIN_CHUNKS = 16  # desired number of chunks per family, so that workers share the work and progress is visible
_MIN_CHUNK = 2**15  # smallest number of points per chunk; writing smaller chunks takes longer than computing them
_BUFFER_BYTES = 96 * 2**20  # memory for the points that `sweep.compute` processes at once, in bytes
_MIN_SECONDS = 0.01  # shortest estimated time in s that is printed as a number
_SCENE_SECONDS = 0.1  # estimated time to compute the stability boundary of one device with further parts, in s


@dataclass(frozen=True)
class FamilyPlan:
    """The division of the outputs of one family into chunks."""

    family: Family
    outputs: tuple[str, ...]
    dims: tuple[str, ...]  # names of the dimensions of the grid
    shape: tuple[int, ...]  # number of points along each dimension of the grid
    chunks: tuple[int, ...]  # number of points along each dimension of a chunk

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of chunks along each dimension."""
        return tuple(-(-size // chunk) for size, chunk in zip(self.shape, self.chunks, strict=True))

    @property
    def count(self) -> int:
        """Number of chunks."""
        return math.prod(self.counts)

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of the outputs and of the status of the family; each of these variables has one file per chunk."""
        return (*self.outputs, STATUS_OF[self.family])

    @property
    def extent(self) -> str:
        """The dimensions of the grid and their sizes as text, for messages."""
        return " x ".join(f"{dim} {size}" for dim, size in zip(self.dims, self.shape, strict=True)) or "one point"


@dataclass(frozen=True)
class Task:
    """One chunk of one family of outputs, computed, written and repaired as a unit."""

    plan: FamilyPlan
    index: int

    @property
    def family(self) -> Family:
        """Family of the outputs."""
        return self.plan.family

    @property
    def position(self) -> tuple[int, ...]:
        """Index of the chunk along each dimension."""
        return tuple(map(int, np.unravel_index(self.index, self.plan.counts))) if self.plan.counts else ()

    @property
    def slices(self) -> tuple[slice, ...]:
        """Range of the grid that the chunk covers, one slice per dimension."""
        starts = zip(self.position, self.plan.chunks, self.plan.shape, strict=True)
        return tuple(slice(index * chunk, min((index + 1) * chunk, size)) for index, chunk, size in starts)

    @property
    def points(self) -> int:
        """Number of points of the chunk."""
        return math.prod(part.stop - part.start for part in self.slices)

    def __str__(self) -> str:
        parts = zip(self.plan.dims, self.slices, strict=True)
        ranges = ", ".join(f"{dim} {part.start}:{part.stop}" for dim, part in parts)
        return f"{self.family}/{self.index}{f' ({ranges})' if ranges else ''}"


@dataclass(frozen=True)
class Plan:
    """The plan of a sweep: chunks, methods and estimated costs."""

    study: SweepStudy
    grid: Grid
    families: tuple[FamilyPlan, ...]
    methods: dict[str, tuple[str, str]]  # method and its reason, for each output that several methods can compute
    model: str  # description of the device model, for the printed plan
    memory: int  # upper bound of the memory for the computation of one chunk, in bytes
    disk: int  # upper estimate of the size of the store, in bytes
    seconds: float  # rough estimate of the computing time on one core, in s

    def family(self, name: str) -> FamilyPlan:
        """Return the plan of one family by its name."""
        return next(family for family in self.families if family.family == name)

    def tasks(self) -> Iterator[Task]:
        """Yield every chunk, in the order of computation."""
        for family in self.families:
            yield from (Task(family, index) for index in range(family.count))

    @property
    def extent(self) -> str:
        """The dimensions of the largest grid and their sizes as text, for messages."""
        return max(self.families, key=lambda family: math.prod(family.shape)).extent

    def as_dict(self) -> dict[str, Any]:
        """Return chunks and methods, which a store records because a resumed run must use the same ones."""
        return {
            "chunks": {family.family: list(family.chunks) for family in self.families},
            "methods": {name: method for name, (method, _) in sorted(self.methods.items())},
        }

    def lines(self) -> Iterator[str]:
        """Yield the lines of the printed plan."""
        yield f"study {self.study.name}"
        for family in self.families:
            chunk = " x ".join(map(str, family.chunks))
            points = math.prod(family.shape)
            yield f"  {', '.join(family.outputs)}"
            yield f"    points   {points:,} ({family.extent})"
            yield f"    chunks   {family.count:,} of {chunk or '1'}"
        yield f"  model      {self.model}"
        for name, (method, reason) in sorted(self.methods.items()):
            yield f"  method     {name} by {method}: {reason}"
        yield f"  memory     {_format_size(self.memory)} per chunk, and {_format_size(IDLE_MEMORY)} per worker"
        yield f"  disk       {_format_size(self.disk)} at most"
        yield f"  time       {_format_time(self.seconds)} on one core"


def make_plan(study: SweepStudy, *, memory: int = MEMORY) -> Plan:
    """Plan a sweep.

    The size of chunks follows from the memory and from the computing speed of each output (`units.outputs.OUTPUTS`).

    Args:
        study: The sweep.
        memory: Memory available for the computation of one chunk, in bytes.
    """
    grid = Grid(study)
    families, seconds = [], 0.0
    for family, outputs in study.families.items():
        sources = {OUTPUTS[name].source or name for name in outputs}
        slowness = sum(1.0 / OUTPUTS[name].rates[study.with_parts] for name in sources)
        if study.with_parts:
            slowness += _SCENE_SECONDS * grid.size_of("device") / grid.size_of(family)
        per_point = _bytes_per_point(outputs)
        size = grid.size_of(family)
        target = min((memory - _BUFFER_BYTES) // per_point, _MAX_CHUNK, int(_CHUNK_SECONDS / slowness))
        target = max(1, min(target, max(size // _MIN_CHUNKS, _MIN_CHUNK)))
        shape = grid.shape_of(family)
        families.append(FamilyPlan(family, outputs, grid.dims_of(family), shape, chunk_shape(shape, target)))
        seconds += size * slowness
    largest = max(math.prod(plan.chunks) * _bytes_per_point(plan.outputs) for plan in families)
    # Estimate the size on disk per point: 64 bits for a float64, which compression does not shrink; 1 bit for a
    # Boolean; at most 1 bit for the status, which is 0 for nearly all points and therefore compressed.
    bits = [1 + sum(64 if OUTPUTS[name].dtype == "float64" else 1 for name in plan.outputs) for plan in families]
    disk = sum(math.prod(plan.shape) * each for plan, each in zip(families, bits, strict=True)) // 8 + 2**16
    longest, model = study.axes.most_periods, "device with parts, held delay"
    if not study.with_parts:
        part = "" if longest == math.floor(longest) else ", also fractional"
        model = f"damped mass, zero-order hold, held delay{part}: polynomials of degree up to {math.ceil(longest) + 3}"
    return Plan(study, grid, tuple(families), choose_methods(study), model, largest + _BUFFER_BYTES, disk, seconds)


def restore_plan(study: SweepStudy, recorded: dict[str, Any]) -> Plan:
    """Return the plan of an existing store, with the chunks that the store records (`Plan.as_dict`)."""
    fresh = make_plan(study)
    families = tuple(replace(plan, chunks=tuple(recorded["chunks"][plan.family])) for plan in fresh.families)
    return replace(fresh, families=families)


def chunk_shape(shape: tuple[int, ...], target: int) -> tuple[int, ...]:
    """Return the shape of chunks of about equal size, with at most ``target`` points each.

    The first dimensions of the grid ``shape`` are divided first, because the points of the last ones are adjacent in
    memory.
    """
    chunks, room = [], target
    for size in reversed(shape):
        chunk = max(1, min(size, room))
        # Divide the dimension into nearly equal parts, so that no chunk is much smaller than the others.
        chunk = -(-size // -(-size // chunk)) if size else 1
        chunks.append(chunk)
        room = room // chunk if chunk == size else 1
    return tuple(reversed(chunks))


def choose_methods(study: SweepStudy) -> dict[str, tuple[str, str]]:
    """Return the method and its reason for each output that several methods can compute."""
    methods = {}
    if study.with_parts:
        reason = "one stability boundary per device; unstable poles are counted along lines of constant B"
        return {name: ("crossings", reason) for name in study.outputs if name in ("stable", "stiffness_max")}
    if "stable" in study.outputs:
        methods["stable"] = ("crossover", "stability limit of each line of constant B in closed form, without poles")
    if RADIUS_OUTPUTS & set(study.outputs):
        proof = f"certified to {study.accuracy:g} by counting poles inside circles; the cost does not depend on d"
        methods["spectral_radius"] = ("newton", proof)
    return methods


def check_resources(plans: list[Plan], folder: Path, workers: int, begun: Collection[str] = ()) -> None:
    """Raise `ResourceError` if the results of sweeps do not fit on the disk, or the workers do not fit into memory.

    Args:
        plans: The plan of each sweep.
        folder: Folder of the results.
        workers: Number of worker processes.
        begun: Names of the studies whose stores exist already; their disk space is not counted.
    """
    check_folder(folder)
    if not plans:
        return
    free = shutil.disk_usage(find_existing(folder)).free
    new = [plan for plan in plans if plan.study.name not in begun]
    disk = sum(plan.disk for plan in new)
    if disk > free:
        largest = max(new, key=lambda plan: plan.disk)
        raise ResourceError(
            f"out: {folder} has {_format_size(free)} free, but the results may take {_format_size(disk)}, most "
            f"of them for studies[{largest.study.name}].axes ({largest.extent}); {ELSEWHERE}, fewer outputs or fewer "
            "axis values"
        )
    total = _available_memory()
    memory = max(workers * (plan.memory + IDLE_MEMORY) for plan in plans)
    if memory > total:
        raise ResourceError(
            f"workers: {workers} workers may take {_format_size(memory)} of memory, but {_format_size(total)} are "
            "available; choose fewer with --workers N"
        )


def _available_memory() -> int:
    """Return the memory available to this process in bytes: that of the machine, or the limit of its container."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    # Ignore errors, because the file does not exist outside of containers and contains "max" if no limit is set.
    with suppress(OSError, ValueError):
        return min(total, int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    return total


def _bytes_per_point(outputs: tuple[str, ...]) -> int:
    """Return the memory per point of a chunk in bytes: results, intermediate values, and copies during writing."""
    floats = sum(OUTPUTS[name].dtype == "float64" for name in outputs)
    intermediate = 56 if RADIUS_OUTPUTS & set(outputs) else 0
    intermediate += 32 if MARGIN_OUTPUTS & set(outputs) else 0
    intermediate += 8 if {"passive", "passivity_margin"} & set(outputs) else 0
    return 8 * floats + intermediate + (16 if floats else 0) + len(outputs) + 4


def _format_size(count: float) -> str:
    """Format a number of bytes as text with a binary prefix."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if count < 1024:
            return f"{count:.3g} {unit}"
        count /= 1024
    return f"{count:.3g} TiB"


def _format_time(seconds: float) -> str:
    """Format an estimated time in s as text with a suitable unit."""
    if seconds < _MIN_SECONDS:
        return f"less than {_MIN_SECONDS:g} s"
    for limit, unit, length in ((120, "s", 1.0), (7200, "min", 60.0), (172800, "h", 3600.0)):
        if seconds < limit:
            return f"about {seconds / length:.2g} {unit}"
    return f"about {seconds / 86400:.2g} days"
