"""Read and write the record of a run, ``run.json``: its studies, inputs, package versions, outcomes and written files.

The record contains one *entry* per study. It is written again after every study, so that a run that is killed at any
time leaves a correct record. The files of a study are created in a hidden folder, then entered in the record, and only
then moved to their names in the folder of the run. So no file of a run is ever incomplete under its name, and a file
that is not in the record, a file *of the user*, is never replaced or removed. *Inputs* of a study are its configuration
and the files that this configuration reads; the folder ``inputs`` contains copies of them.
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
from zwidth.core.errors import InputError, StoreError, StoreExistsError
from zwidth.io.files import remove_quietly, write_atomically
from zwidth.model.measured_device import SUFFIXES
from zwidth.model.mujoco_model import MODEL_SUFFIXES, pack_model
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
from zwidth.units.formatting import describe

RUN_FILE = "run.json"  # name of the file with the record
CONFIG_FILE = "config.yaml"  # name of the copy of the configuration, in which file names are those of the copied inputs
INPUTS = "inputs"  # name of the folder with copies of the files that the configuration reads
RUN_FORMAT = 2  # format version of the record
_CHECKSUM = "record_sha256"  # key of the checksum in the record
_MOVE = f"move it away, or {ELSEWHERE}"  # remedy in messages about files of the user
_PACKAGES = ("scipy", "matplotlib", "optimistix", "jaxopt")  # further packages whose versions are recorded
_TEMPORARY = re.compile(
    r"\..+\.[0-9a-f]{8}\.partial"
)  # names of unfinished files and folders, from `temporary_sibling`
_KEYS = ("csv", "device", "model")  # keys of the configuration whose value may be the name of a file


class Record:
    """The record in the folder of a run; empty if the folder contains none."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.content: dict[str, Any] = {}
        self.damaged = False  # True if the checksum of the record is wrong
        self._read()

    def _read(self) -> None:
        """Read the record, if any; raise `StoreError` if the file is unreadable or not a record."""
        where, remedy = self.folder / RUN_FILE, f"{ELSEWHERE}, or remove it"
        try:
            content = json.loads(where.read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            return
        except (OSError, ValueError) as error:
            raise StoreError(f"{where}: cannot be read ({error}); {remedy}") from error
        if not isinstance(content, dict) or not isinstance(content.get("studies"), list):
            raise StoreError(f"{where}: no record of a run; {remedy}")
        checksum = content.pop(_CHECKSUM, None)
        if checksum is not None and hash_json(content) != checksum:
            self.damaged = True
            if content.get("format") == RUN_FORMAT:
                # Mark all studies as unfinished, so that they are computed again. Keep only entries with a list of
                # files, because a run may replace only the files that its record lists.
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
        """True if the folder contains a record."""
        return bool(self.content)

    def entry(self, name: str) -> dict[str, Any] | None:
        """Return the entry of a study by its name; None if the record contains no such study."""
        return next((entry for entry in self.content.get("studies", ()) if entry.get("name") == name), None)

    def check_free(self, config: str, *, overwrite: bool, resume: bool) -> None:
        """Raise `StoreExistsError` if the folder is not empty, unless its content is a run to be replaced or resumed.

        Args:
            config: Text of the configuration, which identifies a run whose record is lost.
            overwrite: True if an existing run may be replaced.
            resume: True if an existing run may be resumed.
        """
        if (self.folder.exists() or self.folder.is_symlink()) and not self.folder.is_dir():
            raise StoreExistsError(f"out: {self.folder} is a file, a folder is needed; choose another with --out DIR")
        check_folder(self.folder)
        if resume or not self.folder.is_dir():
            return
        # The record may be lost: accept a folder that contains only files that a run writes. The stores are checked
        # later (`check_stores`), because each store contains its own study.
        names, expected = [path.name for path in self.folder.iterdir()], (LOCKS, CONFIG_FILE, "figures")
        strange = [name for name in names if not name.endswith((SUFFIX, ".partial")) and name not in expected]
        fault = ""
        if strange and not self.exists and not self._contains_config(config):
            fault = f"is not empty and contains no run (no {RUN_FILE}), and no {CONFIG_FILE} of this configuration; "
            fault += ELSEWHERE
        elif self.exists and not overwrite:
            fault = f"already contains a run; {ELSEWHERE}, continue it with --resume, or replace it with --overwrite"
        elif strange and not overwrite:
            fault = f"contains a run of this configuration without its record {RUN_FILE}; replace its files with "
            fault += f"--overwrite, keep its sweeps with --resume, or {ELSEWHERE}"
        if fault:
            raise StoreExistsError(f"out: {self.folder} {fault}")

    def _contains_config(self, text: str) -> bool:
        """Return whether the configuration file in the folder exists and has the given text."""
        with suppress(OSError):
            return (self.folder / CONFIG_FILE).read_bytes() == text.encode("utf-8")
        return False

    def check_same(self, inputs: dict[str, dict[str, Any]]) -> None:
        """Raise `StoreError` if the run cannot be resumed, because other releases or other inputs produced it.

        ``inputs`` contains the inputs of each study in the current configuration, by name of the study.
        """
        if not self.exists:
            return
        if self.content.get("format") != RUN_FORMAT:
            raise StoreError(
                f"{self.folder}: run of an earlier release without checksums, which cannot be resumed; start again "
                f"with --overwrite, or {ELSEWHERE}"
            )
        if self.damaged:
            # Do not compare a damaged record: all studies are computed again, and sweeps are compared with the study in
            # their store.
            return
        where = self.folder / RUN_FILE
        for name, now in inputs.items():
            entry = self.entry(name)
            if entry is not None:
                refuse_changes(where, name, "run", entry["inputs"], now)
        refuse_versions(where, self.content.get("versions", {}))

    def start(self, **about: Any) -> None:
        """Record the start of a run: its time, the package versions, and the further entries ``about``."""
        about |= {"format": RUN_FORMAT, "started": datetime.now(UTC).isoformat(timespec="seconds")}
        about |= {"precision": "float64", "versions": list_versions(*_PACKAGES)}
        self._update({**about, "started": self.content.get("started", about["started"])})

    def keep_config(self, text: str, inputs: Mapping[str, bytes]) -> None:
        """Write the configuration and copies of the files that it reads into the folder.

        Args:
            text: Text of the configuration.
            inputs: Content of each file by the name of its copy.

        Raises:
            StoreExistsError: A file of the user has the name of a copy.
        """
        path, input_dir = self.folder / CONFIG_FILE, self.folder / INPUTS
        digests = {name: hashlib.sha256(data).hexdigest() for name, data in inputs.items()}
        missing = {name: data for name, data in inputs.items() if hash_file(input_dir / name) != digests[name]}
        recorded = {} if input_dir.is_symlink() else self.content.get("inputs", {})
        strange = [
            name for name in missing if name not in recorded and (input_dir.is_symlink() or (input_dir / name).exists())
        ]
        if strange:
            raise StoreExistsError(f"out: {input_dir / strange[0]} was not written by this run; {_MOVE}")
        written = CONFIG_FILE in self.files()
        # If the folder contains this configuration but the record does not list it, the record was lost. Record this,
        # so that files with the names of the run's results count as files of the run.
        lost = not written and self._contains_config(text)
        self._update(({"inputs": {**recorded, **digests}} if digests else {}) | ({"lost": True} if lost else {}))
        for name, data in missing.items():
            write_atomically(input_dir / name, data)
        if written or lost or not path.exists():
            self._update({"config_file": CONFIG_FILE})
            write_atomically(path, text.encode("utf-8"))

    def note(self, entry: dict[str, Any]) -> None:
        """Write the entry of a study to the record, in place of an earlier entry of this study."""
        self._update({}, entry)

    def _update(self, about: dict[str, Any], entry: dict[str, Any] | None = None) -> None:
        """Update the record and write its file.

        Args:
            about: Entries of the record to be set, apart from those of the studies.
            entry: Entry of a study, which replaces an earlier entry of the same study; None for no change.
        """
        content = {**self.content, **about}
        studies = [old for old in content.get("studies", ()) if entry is None or old["name"] != entry["name"]]
        content["studies"] = [*studies, *([] if entry is None else [entry])]
        self.content = content
        text = json.dumps(content | {_CHECKSUM: hash_json(content)}, indent=2) + "\n"
        write_atomically(self.folder / RUN_FILE, text.encode())

    def faults(self, name: str) -> list[str]:
        """Return a list of texts that state the damaged and missing files of a study, each with its fault."""
        entry = self.entry(name)
        files = entry["files"] if entry else {}
        return [
            f"{file} is {'damaged' if (self.folder / file).exists() else 'missing'}"
            for file, expected in files.items()
            if expected is not None and hash_file(self.folder / file) != expected
        ]

    def keep(self, stage: Path, entry: dict[str, Any]) -> None:
        """Move the files of a study into the folder of the run, and record its entry.

        If the study is done, its earlier files that were not written again are removed.

        Args:
            stage: Hidden folder with the files.
            entry: Entry of the study, without its files.

        Raises:
            StoreExistsError: A file of the user has the name of one of the files.
        """
        before = self.entry(entry["name"]) or {}
        files = {path.name: hash_file(path) for path in sorted(stage.iterdir())}
        for file in files:
            if (self.folder / file).exists() and file not in self.files() and not self.content.get("lost"):
                raise StoreExistsError(f"out: {self.folder / file} was not written by this run; {_MOVE}")
        # Record the names before moving the files, so that the record is complete even if the run is killed in between.
        both = {**before.get("files", {}), **files}
        self.note({**entry, "state": "open", "files": both})
        for file in files:
            os.replace(stage / file, self.folder / file)
        if entry["state"] == "done":
            self._remove(file for file in both if file not in files)
            both = files
        self.note({**entry, "files": both})

    def files(self) -> set[str]:
        """Return the names of all files that the run has written, as listed in the record."""
        names = {RUN_FILE}
        if self.content.get("config_file"):
            names.add(CONFIG_FILE)
        for entry in self.content.get("studies", ()):
            names |= {str(file) for file in entry.get("files", ())}
        return names

    def clear(self) -> None:
        """Remove all files that the run has written, the record last; keep all other files."""
        if self.exists:
            self._remove(sorted(self.files() - {RUN_FILE}))
            input_dir = self.folder / INPUTS
            if not input_dir.is_symlink():
                for name in self.content.get("inputs", {}):
                    (input_dir / name).unlink(missing_ok=True)
                with suppress(OSError):
                    input_dir.rmdir()
            self._remove([RUN_FILE])
            self.content = {}

    def _remove(self, names: Iterable[str]) -> None:
        """Remove files and stores of the folder; keep folders that are not stores."""
        for name in names:
            path = self.folder / name
            if name.endswith(SUFFIX) and (path / "zarr.json").is_file() and not path.is_symlink():
                shutil.rmtree(path)
            elif not path.is_dir():
                path.unlink(missing_ok=True)

    def remove_leftovers(self) -> None:
        """Remove the incomplete files and folders of killed runs."""
        for left in self.folder.glob(".*.partial"):
            if _TEMPORARY.fullmatch(left.name):
                remove_quietly(left)


def _find_fault(content: Any) -> str:
    """Return a phrase that states why a JSON value is not the record of a run; "" if it is a record."""
    kinds = {"studies": list, "versions": dict, "inputs": dict}
    if not all(isinstance(content.get(key, kind()), kind) for key, kind in kinds.items()):
        return "no record of a run"
    names = list(content.get("inputs", ()))
    for entry in content["studies"]:
        if not isinstance(entry, dict) or not isinstance(entry.get("files", {}), dict):
            return "a damaged record of a run"
        names += [entry.get("name"), *entry.get("files", ())]
    # Reject names of files outside the folder, because a run removes and replaces the files named in its record.
    outside = [name for name in names if not isinstance(name, str) or not is_plain_name(name)]
    return f"lists {describe(outside[0])}, which is not the name of a file in its folder" if outside else ""


def find_config(folder: Path) -> Path:
    """Return the path of the configuration in the folder of a run; raise `InputError` if there is none."""
    if CONFIG_FILE not in Record(folder).files():
        raise InputError(f"{folder}: no run with a recorded configuration ({RUN_FILE}, {CONFIG_FILE}); name a file")
    return folder / CONFIG_FILE


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file; "" for links and for files that cannot be read."""
    with suppress(OSError):
        if not path.is_symlink():
            with open(path, "rb") as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()
    return ""


def gather_inputs(text: str, folder: Path) -> tuple[str, dict[str, bytes], dict[str, str]]:
    """Collect the files that a valid configuration reads, to copy them into the folder of the run.

    Args:
        text: Text of the configuration.
        folder: Folder to which the names in the configuration are relative.

    Returns:
        The text with the names of the copies in place of the original names, the content of each copy by its name in
        the folder of inputs, and the path of each copy by the original name.
    """
    files: dict[str, bytes] = {}
    names: dict[str, str] = {}
    spans = [*find_values(text, "csv"), *find_values(text, "model")]
    spans += [span for span in find_values(text, "device") if span[0].endswith(SUFFIXES)]
    spans.sort(key=lambda span: span[1])
    for name, _, _ in spans:
        if name not in names and (folder / name).is_file():
            content, suffix = _read_input(folder / name)
            copy = _choose_name(str(PurePath(name).with_suffix(suffix)), files)
            files[copy] = content
            names[name] = f"{INPUTS}/{copy}"
    for name, first, last in reversed(spans):
        if name in names:
            text = f"{text[:first]}{names[name]}{text[last:]}"
    return text, files, names


def _read_input(file: Path) -> tuple[bytes, str]:
    """Return the content of the copy of a file, and the suffix of its name."""
    return pack_model(file) if file.suffix in MODEL_SUFFIXES else (file.read_bytes(), file.suffix)


def _choose_name(name: str, taken: dict[str, bytes]) -> str:
    """Return a name for the copy of a file that is valid on all file systems and in YAML, and not yet ``taken``."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", PurePath(name).name)
    stem, suffix = PurePath(plain).stem, PurePath(plain).suffix
    number = 1
    # Compare the names in lower case, because some file systems do not distinguish upper and lower case.
    while plain.lower() in {each.lower() for each in taken}:
        number += 1
        plain = f"{stem}-{number}{suffix}"
    return plain


def rename_inputs(value: Any, names: dict[str, str]) -> Any:
    """Replace the names of files in the JSON value of a configuration; ``names`` contains the new names by old name."""
    if isinstance(value, list):
        return [rename_inputs(item, names) for item in value]
    if not isinstance(value, dict):
        return value
    return {
        key: names.get(item, item) if key in _KEYS and isinstance(item, str) else rename_inputs(item, names)
        for key, item in value.items()
    }
