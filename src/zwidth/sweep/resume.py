"""Stores at the beginning of a run: made anew, or found, compared with the configuration, and repaired."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from zwidth.sweep.files.provenance import differences, digest, versions
from zwidth.sweep.plan import Plan, Task
from zwidth.sweep.store import SUFFIX, Store, create
from zwidth.sweep.study import SweepStudy
from zwidth.words.errors import StoreError
from zwidth.words.formatting import describe

_SHOWN_DIFFERENCES = 10


def store_path(folder: Path, study: SweepStudy) -> Path:
    """Where a study's results are kept."""
    return folder / f"{study.name}{SUFFIX}"


def new_store(folder: Path, study: SweepStudy, plan: Plan, about: Mapping[str, Any], *, shared: bool) -> Store:
    """Make the store of a study; where other runs share it, one of them may have been faster."""
    attributes = {
        "title": f"{about['name']}: {study.name}",
        "comment": about["description"],
        "source": f"zwidth {versions()['zwidth']}",
        "history": f"{datetime.now(UTC).isoformat(timespec='seconds')} made by zwidth run",
        "precision": "float64",
        "versions": versions(),
        "config": about["config"],
        "config_sha256": digest(about["config"]),
        "study": study.model_dump(mode="json", exclude_none=True),
        "plan": plan.as_dict(),
    }
    store = create(store_path(folder, study), attributes, may_exist=shared)
    check_same(store, study)
    return store


def check_same(store: Store, study: SweepStudy) -> None:
    """Refuse a store that was made from another study or by other releases."""
    now = study.model_dump(mode="json", exclude_none=True)
    refuse_changes(store.path, study.name, "store", store.attributes["study"], now)
    refuse_versions(store.path, store.attributes["versions"])


def refuse_changes(where: Path, name: str, what: str, old: Any, new: Any) -> None:
    """Raise a `StoreError` that names every key in which results were made from another study."""
    changed = list(differences(old, new))
    if changed:
        lines = [
            f"{where}: studies[{name}].{key}: the {what} was made with {_spell_value(before)}, the configuration has "
            f"{_spell_value(after)}"
            for key, before, after in changed[:_SHOWN_DIFFERENCES]
        ]
        more = len(changed) - _SHOWN_DIFFERENCES
        lines += [f"{where}: {more} more keys differ"] if more > 0 else []
        remedy = f"{where}: change the configuration back, or choose another folder with --out DIR"
        raise StoreError("\n".join([*lines, remedy]))


def refuse_versions(where: Path, old: dict[str, str]) -> None:
    """Refuse to go on with results of other releases: together they are not what either of them would compute."""
    now = versions()
    for key in (key for key in now if key != "python" and old.get(key) != now[key]):
        raise StoreError(
            f"{where}: made with {key} {old.get(key)}, now there is {now[key]}; install the same release, or choose "
            "another folder with --out DIR"
        )


def _spell_value(value: Any) -> str:
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


def remove_partials(path: Path) -> None:
    """Remove the unfinished files of a run that was killed from a store."""
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)


def remove(folder: Path, study: SweepStudy) -> None:
    """Make room for a store to be made again; what is no store of a sweep stays, and is then refused."""
    path = store_path(folder, study)
    if path.is_dir() and not path.is_symlink():
        with suppress(StoreError):
            Store(path).attributes  # noqa: B018  (raises where the store is not one of ours)
            shutil.rmtree(path)
