"""One chunk of one store, from nothing to done: the same function in this process, a worker and a cluster."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path

from zwidth.sweep.plan import Task
from zwidth.sweep.store import Store


@lru_cache(maxsize=4)
def _open_store(path: str, made: int) -> Store:
    """A store that this process works on; ``made`` tells it from another one that took its place."""
    return Store(Path(path))


def perform(path: str, family: str, index: int) -> None:
    """Compute and write one chunk of a store, by its number in a family of outputs, unless it is done already."""
    store = _open_store(path, os.stat(os.path.join(path, "zarr.json")).st_ino)
    task = Task("device" if family == "device" else "wall", index)
    if store.is_done(task):
        return
    plan = store.plan.family(family)
    if store.study.with_parts:
        from zwidth.sweep.scenes import compute_scenes

        block = store.grid.scene_block(plan.place(index))
        values = compute_scenes(plan.family, plan.outputs, store.study, block)
    else:
        # Loads JAX, which a process that only hands out work has no use for.
        from zwidth.sweep.compute import compute

        values = compute(plan.family, plan.outputs, store.grid.block(plan.place(index)), store.study.accuracy)
    # A scheduler that restarts, or a run that goes on, may have handed it out twice.
    if not store.is_done(task):
        store.write(task, values)
