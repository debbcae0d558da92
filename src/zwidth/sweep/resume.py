"""Stores at the beginning of a run: made anew, or found, compared with the configuration, and repaired."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zwidth.errors import StoreError
from zwidth.sweep.document import Config
from zwidth.sweep.faults import describe
from zwidth.sweep.plan import Plan, Task
from zwidth.sweep.record import differences, digest, versions
from zwidth.sweep.store import SUFFIX, Store, create
from zwidth.sweep.sweeps import SweepStudy

_SHOWN_DIFFERENCES = 10


def store_path(folder: Path, study: SweepStudy) -> Path:
    """Where a study's results are kept."""
    return folder / f"{study.name}{SUFFIX}"


def new_store(folder: Path, study: SweepStudy, plan: Plan, config: Config, *, shared: bool) -> Store:
    """Make the store of a study; where other runs share it, one of them may have been faster."""
    whole = _spelled(config)
    attributes = {
        "title": f"{config.name}: {study.name}",
        "comment": config.description,
        "source": f"zwidth {versions()['zwidth']}",
        "history": f"{datetime.now(UTC).isoformat(timespec='seconds')} made by zwidth run",
        "precision": "float64",
        "versions": versions(),
        "config": whole,
        "config_sha256": digest(whole),
        "study": _spelled(study),
        "plan": plan.as_dict(),
    }
    store = create(store_path(folder, study), attributes, may_exist=shared)
    check_same(store, study)
    return store


def check_same(store: Store, study: SweepStudy) -> None:
    """Refuse a store that was made from another study or by other releases.

    Raises:
        StoreError: the message names every key that differs.
    """
    changed = list(differences(store.attributes["study"], _spelled(study)))
    if changed:
        lines = [
            f"{store.path}: studies[{study.name}].{key}: the store was made with {_shown(old)}, the configuration has "
            f"{_shown(new)}"
            for key, old, new in changed[:_SHOWN_DIFFERENCES]
        ]
        more = len(changed) - _SHOWN_DIFFERENCES
        lines += [f"{store.path}: {more} more keys differ"] if more > 0 else []
        remedy = f"{store.path}: change the configuration back, or choose another folder with --out DIR"
        raise StoreError("\n".join([*lines, remedy]))
    for key, old, new in differences(store.attributes["versions"], versions()):
        # A store whose chunks come from two releases is not what either of them would compute.
        if key != "python":
            raise StoreError(
                f"{store.path}: made with {key} {old}, now there is {new}; install the same release, or choose another "
                "folder with --out DIR"
            )


def _spelled(model: Config | SweepStudy) -> dict[str, Any]:
    return model.model_dump(mode="json", exclude_none=True)


def _shown(value: Any) -> str:
    return "nothing" if value is None else describe(value)


def repair(store: Store, tasks: Iterable[Task]) -> list[str]:
    """Take back the marks of chunks that are damaged, and write damaged coordinates again; returns what was found."""
    found = []
    names = store.damaged_files()
    if names:
        store.restore(names)
        found += [f"{name} (restored)" for name in names]
    for task in tasks:
        fault = store.fault_of(task) if store.is_done(task) else ""
        if fault:
            store.forget(task)
            found.append(f"{store.plan.describe(task)}: {fault}")
    return found


def sweep_up(folder: Path, study: SweepStudy) -> None:
    """Remove the unfinished files of a run that was killed."""
    path = store_path(folder, study)
    for left in folder.glob(f".{path.name}.*.partial"):
        shutil.rmtree(left, ignore_errors=True)
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)


def remove(folder: Path, study: SweepStudy) -> None:
    """Make room for a store to be made again; what is no store stays, and is then refused."""
    path = store_path(folder, study)
    if (path / "zarr.json").is_file() and not path.is_symlink():
        shutil.rmtree(path)
