"""The plan of a sweep: its chunks, its methods, what it will take, and whether that fits."""

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
from zwidth.sweep.files import ELSEWHERE, check_folder, existing
from zwidth.sweep.grid import Grid
from zwidth.words.errors import ResourceError
from zwidth.words.quantities import MARGIN_OUTPUTS, OUTPUTS, RADIUS_OUTPUTS, STATUS_OF, Family

MEMORY = 2**28
"""Bytes that one chunk may take while it is computed, beside what an idle worker takes."""

IDLE_MEMORY = 500 * 2**20
"""Bytes that a worker takes before its first chunk: Python, JAX and its compiled kernels."""

# What a killed worker loses is the chunk it was at.
_CHUNK_SECONDS = 10.0
_LARGEST_CHUNK = 2**25
# Enough chunks to share among workers and to show progress, none so small that its files cost more than its points.
_FEWEST_CHUNKS = 16
_SMALLEST_CHUNK = 2**15
_LAID_OUT_BYTES = 96 * 2**20

# A guess below this says no more than that.
_INSTANT = 0.01

# To lay out the boundary of a device with parts.
_SCENE_SECONDS = 0.1


@dataclass(frozen=True)
class FamilyPlan:
    """How the outputs of one family are cut into chunks."""

    family: Family
    outputs: tuple[str, ...]
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        return tuple(-(-size // chunk) for size, chunk in zip(self.shape, self.chunks, strict=True))

    @property
    def count(self) -> int:
        return math.prod(self.counts)

    @property
    def variables(self) -> tuple[str, ...]:
        """The outputs and the status: every one of them has a file for each chunk."""
        return (*self.outputs, STATUS_OF[self.family])

    @property
    def extent(self) -> str:
        """Its dimensions and their sizes, for messages."""
        return " x ".join(f"{dim} {size}" for dim, size in zip(self.dims, self.shape, strict=True)) or "one point"


@dataclass(frozen=True)
class Task:
    """One chunk of one family of outputs: what is computed, written and repaired as a whole."""

    plan: FamilyPlan
    index: int

    @property
    def family(self) -> Family:
        return self.plan.family

    @property
    def position(self) -> tuple[int, ...]:
        """Its number along each dimension."""
        return tuple(map(int, np.unravel_index(self.index, self.plan.counts))) if self.plan.counts else ()

    @property
    def place(self) -> tuple[slice, ...]:
        starts = zip(self.position, self.plan.chunks, self.plan.shape, strict=True)
        return tuple(slice(at * chunk, min((at + 1) * chunk, size)) for at, chunk, size in starts)

    @property
    def points(self) -> int:
        return math.prod(part.stop - part.start for part in self.place)

    def __str__(self) -> str:
        parts = zip(self.plan.dims, self.place, strict=True)
        place = ", ".join(f"{dim} {part.start}:{part.stop}" for dim, part in parts)
        return f"{self.family}/{self.index}{f' ({place})' if place else ''}"


@dataclass(frozen=True)
class Plan:
    """What a sweep will do."""

    study: SweepStudy
    grid: Grid
    families: tuple[FamilyPlan, ...]
    methods: dict[str, tuple[str, str]]  # of every output that has a choice, and why it is that one
    model: str  # what is modelled, in words
    memory: int  # bytes that a chunk takes while it is computed, at most
    disk: int  # bytes that the store takes, estimated from above
    seconds: float  # on one core, a rough guess

    def family(self, name: str) -> FamilyPlan:
        return next(family for family in self.families if family.family == name)

    def tasks(self) -> Iterator[Task]:
        """Every chunk, in the order of the work."""
        for family in self.families:
            yield from (Task(family, index) for index in range(family.count))

    @property
    def extent(self) -> str:
        """The axes of the largest family and how many values each has, for messages."""
        return max(self.families, key=lambda family: math.prod(family.shape)).extent

    def as_dict(self) -> dict[str, Any]:
        """What a store keeps of the plan: later work on it must follow the same."""
        return {
            "chunks": {family.family: list(family.chunks) for family in self.families},
            "methods": {name: method for name, (method, _) in sorted(self.methods.items())},
        }

    def lines(self) -> Iterator[str]:
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
        yield f"  memory     {_size(self.memory)} a chunk, and {_size(IDLE_MEMORY)} a worker"
        yield f"  disk       {_size(self.disk)} at most"
        yield f"  time       {_time(self.seconds)} on one core"


def make_plan(study: SweepStudy, *, memory: int = MEMORY) -> Plan:
    """Cut a study into chunks of so many bytes, by the points a second of each output."""
    grid = Grid(study)
    families, seconds = [], 0.0
    for family, outputs in study.families.items():
        sources = {OUTPUTS[name].source or name for name in outputs}
        slowness = sum(1.0 / OUTPUTS[name].rates[study.with_parts] for name in sources)
        if study.with_parts:
            slowness += _SCENE_SECONDS * grid.size_of("device") / grid.size_of(family)
        per_point = _bytes_per_point(outputs)
        size = grid.size_of(family)
        target = min((memory - _LAID_OUT_BYTES) // per_point, _LARGEST_CHUNK, int(_CHUNK_SECONDS / slowness))
        target = max(1, min(target, max(size // _FEWEST_CHUNKS, _SMALLEST_CHUNK)))
        shape = grid.shape_of(family)
        families.append(FamilyPlan(family, outputs, grid.dims_of(family), shape, chunk_shape(shape, target)))
        seconds += size * slowness
    largest = max(math.prod(plan.chunks) * _bytes_per_point(plan.outputs) for plan in families)
    # Numbers hardly shrink, truth values are packed, a status is nearly always 0.
    bits = [1 + sum(64 if OUTPUTS[name].dtype == "float64" else 1 for name in plan.outputs) for plan in families]
    disk = sum(math.prod(plan.shape) * each for plan, each in zip(families, bits, strict=True)) // 8 + 2**16
    longest, model = study.axes.most_periods, "device with parts, held delay"
    if not study.with_parts:
        part = "" if longest == math.floor(longest) else ", also in part of a period"
        model = f"damped mass, zero-order hold, held delay{part}: polynomials of degree up to {math.ceil(longest) + 3}"
    return Plan(study, grid, tuple(families), choose_methods(study), model, largest + _LAID_OUT_BYTES, disk, seconds)


def kept_plan(study: SweepStudy, kept: dict[str, Any]) -> Plan:
    """The plan that a store was made with, from what it keeps of it."""
    fresh = make_plan(study)
    families = tuple(replace(plan, chunks=tuple(kept["chunks"][plan.family])) for plan in fresh.families)
    return replace(fresh, families=families)


def chunk_shape(shape: tuple[int, ...], target: int) -> tuple[int, ...]:
    """Cut a grid into chunks of about equal size and at most ``target`` points; fast dimensions stay whole first."""
    chunks, room = [], target
    for size in reversed(shape):
        chunk = max(1, min(size, room))
        # Equal parts: no chunk is a sliver.
        chunk = -(-size // -(-size // chunk)) if size else 1
        chunks.append(chunk)
        room = room // chunk if chunk == size else 1
    return tuple(reversed(chunks))


def choose_methods(study: SweepStudy) -> dict[str, tuple[str, str]]:
    """The method of every output that has a choice, and why; it depends on the study alone, never on the machine."""
    methods = {}
    if study.with_parts:
        reason = "one boundary for each device, on which the poles that cross are counted along every row"
        return {name: ("crossings", reason) for name in study.outputs if name in ("stable", "stiffness_max")}
    if "stable" in study.outputs:
        methods["stable"] = ("crossover", "no pole is needed: the end of each row in closed form, then a comparison")
    if RADIUS_OUTPUTS & set(study.outputs):
        proof = f"each value proved to {study.accuracy:g} by counts of poles inside circles, at a cost flat in d"
        methods["spectral_radius"] = ("newton", proof)
    return methods


def check_resources(plans: list[Plan], folder: Path, workers: int, begun: Collection[str] = ()) -> None:
    """Refuse, before any work, what cannot fit on the disk or in memory; ``begun`` studies have their disk space."""
    check_folder(folder)
    if not plans:
        return
    free = shutil.disk_usage(existing(folder)).free
    new = [plan for plan in plans if plan.study.name not in begun]
    disk = sum(plan.disk for plan in new)
    if disk > free:
        largest = max(new, key=lambda plan: plan.disk)
        raise ResourceError(
            f"out: {folder} has {_size(free)} free, but the results may take {_size(disk)}, most of them of "
            f"studies[{largest.study.name}].axes ({largest.extent}); {ELSEWHERE}, fewer outputs or fewer values on an "
            "axis"
        )
    total = _machine_memory()
    memory = max(workers * (plan.memory + IDLE_MEMORY) for plan in plans)
    if memory > total:
        raise ResourceError(
            f"workers: {workers} of them may take {_size(memory)} of memory, but there are {_size(total)}; "
            "choose fewer with --workers N"
        )


def _machine_memory() -> int:
    """The memory that this process may use: the machine's, or less in a container."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    # Else no container, or one without a limit.
    with suppress(OSError, ValueError):
        return min(total, int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    return total


def _bytes_per_point(outputs: tuple[str, ...]) -> int:
    """Memory for a point of a chunk: results, what they are made of, and copies while they are written."""
    floats = sum(OUTPUTS[name].dtype == "float64" for name in outputs)
    hidden = 56 if RADIUS_OUTPUTS & set(outputs) else 0
    hidden += 32 if MARGIN_OUTPUTS & set(outputs) else 0
    hidden += 8 if {"passive", "passivity_margin"} & set(outputs) else 0
    return 8 * floats + hidden + (16 if floats else 0) + len(outputs) + 4


def _size(count: float) -> str:
    for unit in ("B", "KiB", "MiB", "GiB"):
        if count < 1024:
            return f"{count:.3g} {unit}"
        count /= 1024
    return f"{count:.3g} TiB"


def _time(seconds: float) -> str:
    if seconds < _INSTANT:
        return f"less than {_INSTANT:g} s"
    for limit, unit, length in ((120, "s", 1.0), (7200, "min", 60.0), (172800, "h", 3600.0)):
        if seconds < limit:
            return f"about {seconds / length:.2g} {unit}"
    return f"about {seconds / 86400:.2g} days"
