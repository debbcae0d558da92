"""The record of a run: what ran, from what, in which versions, and which files are its own.

``run.json`` is written anew after every study, so that a run that ends at any moment leaves a true account. A study's
files are made in a hidden folder, named in the record, and only then given their names: no file of the run is ever half
written under its name, and no file that the record does not name is ever replaced or removed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import Any

from zwidth.config.reader import find_values
from zwidth.parts.measured import SUFFIXES
from zwidth.sweep.engine import refuse_changes, refuse_versions
from zwidth.sweep.files import (
    ELSEWHERE,
    LOCKS,
    check_folder,
    hash_json,
    is_plain_name,
    list_versions,
)
from zwidth.sweep.store import SUFFIX
from zwidth.words.errors import InputError, StoreError, StoreExistsError
from zwidth.words.files import remove_quietly, write_whole
from zwidth.words.formatting import describe

RUN_FILE = "run.json"
CONFIG_FILE = "config.yaml"
INPUTS = "inputs"
RUN_FORMAT = 2
_SEAL = "record_sha256"
_MOVE = f"move it away, or {ELSEWHERE}"

# Recorded in addition to the packages that can change a result.
_PACKAGES = ("scipy", "matplotlib", "optimistix", "jaxopt")

# As `hidden_beside` calls what is not finished.
_HALF_MADE = re.compile(r"\..+\.[0-9a-f]{8}\.partial")
# What may name a file; a device may be named otherwise than by its table.
_KEYS = ("csv", "device")


class Record:
    """The record in the folder of a run, whether it exists or not."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.content: dict[str, Any] = {}
        self.damaged = False  # whether the record was not what was written
        self._read()

    def _read(self) -> None:
        where, remedy = self.folder / RUN_FILE, f"{ELSEWHERE}, or remove it"
        try:
            content = json.loads(where.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return
        except (OSError, ValueError) as error:
            raise StoreError(f"{where}: cannot be read ({error}); {remedy}") from error
        if not isinstance(content, dict) or not isinstance(content.get("studies"), list):
            raise StoreError(f"{where}: no record of a run; {remedy}")
        seal = content.pop(_SEAL, None)
        if seal is not None and hash_json(content) != seal:
            self.damaged = True
            if content.get("format") == RUN_FORMAT:
                # Which files are the run's can be believed, for they are made anew; what was found cannot.
                entries = [entry for entry in content["studies"] if isinstance(entry, dict)]
                content["studies"] = [
                    {**entry, "state": "open"}
                    for entry in entries
                    if isinstance(entry.get("name"), str) and isinstance(entry.get("files"), dict)
                ]
        fault = _find_fault(content)
        if fault:
            raise StoreError(f"{where}: {fault}; {remedy}")
        self.content = content

    @property
    def exists(self) -> bool:
        return bool(self.content)

    def entry(self, name: str) -> dict[str, Any] | None:
        return next((entry for entry in self.content.get("studies", ()) if entry.get("name") == name), None)

    def check_free(self, config: str, *, overwrite: bool, going_on: bool) -> None:
        """Refuse a folder that holds something, unless it is a run that may be replaced or gone on with."""
        # A run without its record is known by its configuration: the one of the text ``config``.
        if (self.folder.exists() or self.folder.is_symlink()) and not self.folder.is_dir():
            raise StoreExistsError(f"out: {self.folder} is a file, a folder is needed; choose another with --out DIR")
        check_folder(self.folder)
        if going_on or not self.folder.is_dir():
            return
        # What a run without a record leaves; stores are refused or replaced one by one: they say what they are.
        names, known = [path.name for path in self.folder.iterdir()], (LOCKS, CONFIG_FILE, "figures")
        strange = [name for name in names if not name.endswith((SUFFIX, ".partial")) and name not in known]
        why = ""
        if strange and not self.exists and not self._holds_config(config):
            why = f"is not empty and holds no run (no {RUN_FILE}), and no {CONFIG_FILE} of this configuration; "
            why += ELSEWHERE
        elif self.exists and not overwrite:
            why = f"already holds a run; {ELSEWHERE}, go on with it with --resume, or replace it with --overwrite"
        elif strange and not overwrite:
            why = f"holds a run of this configuration without its record {RUN_FILE}; replace its files with "
            why += f"--overwrite, keep its sweeps with --resume, or {ELSEWHERE}"
        if why:
            raise StoreExistsError(f"out: {self.folder} {why}")

    def _holds_config(self, text: str) -> bool:
        with suppress(OSError):
            return (self.folder / CONFIG_FILE).read_bytes() == text.encode("utf-8")
        return False

    def check_same(self, inputs: dict[str, dict[str, Any]]) -> None:
        """Refuse to go on with a run that other releases made, or whose studies, given by name, had other inputs."""
        if not self.exists:
            return
        if self.content.get("format") != RUN_FORMAT:
            raise StoreError(
                f"{self.folder}: an earlier release made this run and kept no checksums to go on from; start again "
                f"with --overwrite, or {ELSEWHERE}"
            )
        if self.damaged:
            # Everything is computed again, and stores know by themselves what they are for.
            return
        where = self.folder / RUN_FILE
        for name, now in inputs.items():
            entry = self.entry(name)
            if entry is not None:
                refuse_changes(where, name, "run", entry["inputs"], now)
        refuse_versions(where, self.content.get("versions", {}))

    def start(self, **about: Any) -> None:
        about |= {"format": RUN_FORMAT, "started": datetime.now(UTC).isoformat(timespec="seconds")}
        about |= {"precision": "float64", "versions": list_versions(*_PACKAGES)}
        self._update({**about, "started": self.content.get("started", about["started"])})

    def keep_config(self, text: str, inputs: Mapping[str, bytes]) -> None:
        """Write the configuration beside its results, and the files that it reads; what is somebody's own stays."""
        # Where the folder held this configuration and no record, the record was lost: the run's files are its own.
        path, place = self.folder / CONFIG_FILE, self.folder / INPUTS
        digests = {name: hashlib.sha256(data).hexdigest() for name, data in inputs.items()}
        wanted = {name: data for name, data in inputs.items() if file_hash(place / name) != digests[name]}
        known = {} if place.is_symlink() else self.content.get("inputs", {})
        strange = [name for name in wanted if name not in known and (place.is_symlink() or (place / name).exists())]
        if strange:
            raise StoreExistsError(f"out: {place / strange[0]} was not written by this run; {_MOVE}")
        own = CONFIG_FILE in self.files()
        lost = not own and self._holds_config(text)
        self._update(({"inputs": {**known, **digests}} if digests else {}) | ({"lost": True} if lost else {}))
        for name, data in wanted.items():
            write_whole(place / name, data)
        if own or lost or not path.exists():
            self._update({"config_file": CONFIG_FILE})
            write_whole(path, text.encode("utf-8"))

    def note(self, entry: dict[str, Any]) -> None:
        """Write down how a study went, in place of what was there before."""
        self._update({}, entry)

    def _update(self, about: dict[str, Any], entry: dict[str, Any] | None = None) -> None:
        """Update the content, replacing the entry of the same study if ``entry`` is given, and write it to the file."""
        content = {**self.content, **about}
        studies = [old for old in content.get("studies", ()) if entry is None or old["name"] != entry["name"]]
        content["studies"] = [*studies, *([] if entry is None else [entry])]
        self.content = content
        sealed = json.dumps(content | {_SEAL: hash_json(content)}, indent=2) + "\n"
        write_whole(self.folder / RUN_FILE, sealed.encode())

    def faults(self, name: str) -> list[str]:
        """The files of a study that are not what was written."""
        entry = self.entry(name)
        files = entry["files"] if entry else {}
        return [
            f"{file} is {'damaged' if (self.folder / file).exists() else 'missing'}"
            for file, expected in files.items()
            if expected is not None and file_hash(self.folder / file) != expected
        ]

    def keep(self, stage: Path, entry: dict[str, Any]) -> None:
        """Give the files in ``stage`` their names; when the study is done, take away what else it had before."""
        # A file of somebody's own that has one of these names is a `StoreExistsError`.
        before = self.entry(entry["name"]) or {}
        files = {path.name: file_hash(path) for path in sorted(stage.iterdir())}
        for file in files:
            if (self.folder / file).exists() and file not in self.files() and not self.content.get("lost"):
                raise StoreExistsError(f"out: {self.folder / file} was not written by this run; {_MOVE}")
        # First the names, so that a run that is killed between two files still knows them for its own.
        both = {**before.get("files", {}), **files}
        self.note({**entry, "state": "open", "files": both})
        for file in files:
            os.replace(stage / file, self.folder / file)
        if entry["state"] == "done":
            self._remove(file for file in both if file not in files)
            both = files
        self.note({**entry, "files": both})

    def files(self) -> set[str]:
        """All files that the run has written, by the record."""
        found = {RUN_FILE}
        if self.content.get("config_file"):
            found.add(CONFIG_FILE)
        for entry in self.content.get("studies", ()):
            found |= {str(file) for file in entry.get("files", ())}
        return found

    def clear(self) -> None:
        """Remove what the run has written, the record last; whatever else is in the folder stays."""
        if self.exists:
            self._remove(sorted(self.files() - {RUN_FILE}))
            place = self.folder / INPUTS
            if not place.is_symlink():
                for name in self.content.get("inputs", {}):
                    (place / name).unlink(missing_ok=True)
                with suppress(OSError):
                    place.rmdir()
            self._remove([RUN_FILE])
            self.content = {}

    def _remove(self, names: Iterable[str]) -> None:
        for name in names:
            path = self.folder / name
            if name.endswith(SUFFIX) and (path / "zarr.json").is_file() and not path.is_symlink():
                shutil.rmtree(path)
            elif not path.is_dir():
                path.unlink(missing_ok=True)

    def sweep_up(self) -> None:
        """Remove what runs that were killed have left half made."""
        for left in self.folder.glob(".*.partial"):
            if _HALF_MADE.fullmatch(left.name):
                remove_quietly(left)


def _find_fault(content: Any) -> str:
    """What keeps a JSON value from being the record of a run."""
    kinds = {"studies": list, "versions": dict, "inputs": dict}
    if not all(isinstance(content.get(key, kind()), kind) for key, kind in kinds.items()):
        return "no record of a run"
    names = list(content.get("inputs", ()))
    for entry in content["studies"]:
        if not isinstance(entry, dict) or not isinstance(entry.get("files", {}), dict):
            return "a damaged record of a run"
        names += [entry.get("name"), *entry.get("files", ())]
    # All that a run removes or replaces is named there.
    outside = [name for name in names if not isinstance(name, str) or not is_plain_name(name)]
    return f"names {describe(outside[0])}, which is no file of its folder" if outside else ""


def find_config(folder: Path) -> Path:
    """The configuration that a run keeps beside its results."""
    if CONFIG_FILE not in Record(folder).files():
        raise InputError(f"{folder}: no run with a recorded configuration ({RUN_FILE}, {CONFIG_FILE}); name a file")
    return folder / CONFIG_FILE


def file_hash(path: Path) -> str:
    with suppress(OSError):
        if not path.is_symlink():
            with open(path, "rb") as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()
    return ""


def gather_inputs(text: str, folder: Path) -> tuple[str, dict[str, bytes], dict[str, str]]:
    """What a run keeps so that it can be repeated from its own folder, of a configuration's text without faults."""
    # The text with the names of the copies; the copies' bytes by their names in the folder of inputs; and, by the names
    # that the configuration has, those that the text has now. A copy's own name stays as it is.
    files: dict[str, bytes] = {}
    names: dict[str, str] = {}
    places = find_values(text, "csv") + [place for place in find_values(text, "device") if place[0].endswith(SUFFIXES)]
    places.sort(key=lambda place: place[1])
    for name, _, _ in places:
        if name not in names and (folder / name).is_file():
            copy = _choose_name(name, files)
            files[copy] = (folder / name).read_bytes()
            names[name] = f"{INPUTS}/{copy}"
    for name, first, last in reversed(places):
        if name in names:
            text = f"{text[:first]}{names[name]}{text[last:]}"
    return text, files, names


def _choose_name(name: str, taken: dict[str, bytes]) -> str:
    """A name that any file system and YAML take as it is; files of one name in different folders are told apart."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", PurePath(name).name)
    stem, suffix = PurePath(plain).stem, PurePath(plain).suffix
    number = 1
    # Some file systems do not tell cases apart.
    while plain.lower() in {each.lower() for each in taken}:
        number += 1
        plain = f"{stem}-{number}{suffix}"
    return plain


def rename_inputs(value: Any, names: dict[str, str]) -> Any:
    """A configuration's JSON with other names of its files."""
    if isinstance(value, list):
        return [rename_inputs(item, names) for item in value]
    if not isinstance(value, dict):
        return value
    return {
        key: names.get(item, item) if key in _KEYS and isinstance(item, str) else rename_inputs(item, names)
        for key, item in value.items()
    }
