"""Verification: every file of a store read again and compared with what was written."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from zwidth.sweep.store import Store, find_stores
from zwidth.words.errors import StoreError


@dataclass(frozen=True)
class Verification:
    """What a store holds, and in which state."""

    path: Path
    chunks: int = 0  # how many it is to have
    done: int = 0  # how many of them are marked as done
    damaged: tuple[str, ...] = ()  # chunks and files that are not what was written, each with what is wrong
    error: str = ""  # why the store cannot be read at all; empty where it can

    @property
    def ok(self) -> bool:
        """Whether everything is there and undamaged."""
        return not self.error and not self.damaged and self.done == self.chunks


def verify(
    path: str | os.PathLike[str], *, progress: Callable[[int, int], None] | None = None
) -> tuple[Verification, ...]:
    """Read every file of one store, or of all stores in a folder, and compare its checksum.

    Args:
        path: a store ``<study>.zarr`` or the folder of a run.
        progress: called with the number of chunks read and their total, store by store.

    Returns:
        One `Verification` a store. Nothing is changed: a run with ``resume`` repairs what is damaged.

    Raises:
        StoreError: there is no store.
    """
    folder = Path(os.fsdecode(path))
    stores = find_stores(folder)
    if not stores:
        raise StoreError(f"{folder}: holds no store of a sweep; name the folder of a run, or a store in it")
    return tuple(_verify_store(store, progress or (lambda done, total: None)) for store in stores)


def _verify_store(path: Path, progress: Callable[[int, int], None]) -> Verification:
    store = Store(path)
    try:
        tasks = list(store.plan.tasks())
        damaged = [f"{name} is damaged or missing" for name in store.damaged_files()]
    except StoreError as error:
        return Verification(path, error=str(error))
    done = 0
    for number, task in enumerate(tasks, start=1):
        if store.is_done(task):
            done += 1
            fault = store.fault_of(task)
            damaged += [f"{store.plan.describe(task)}: {fault}"] if fault else []
        progress(number, len(tasks))
    return Verification(path, len(tasks), done, tuple(damaged))
