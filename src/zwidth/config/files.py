"""Files that a configuration names, relative to its own folder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from zwidth.config.faults import LocatedProblem, problem
from zwidth.config.fields import Strict

# Names of files in a configuration are relative to its folder, which no value of it knows.
_folder: ContextVar[Path] = ContextVar("folder", default=Path())


@contextmanager
def files_relative_to(folder: Path) -> Iterator[None]:
    """Let the files that a configuration names be looked for in its own folder."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


def find_file(name: str) -> Path:
    """A file that the configuration being read names."""
    return _folder.get() / name


class FileSection(Strict):
    """A file that is read once, and by its digest the same one ever after."""

    csv: str
    """Name of the file, relative to the configuration."""

    sha256: str | None = None
    """Digest of the file; another file is refused. Where left out it is the file's own, for the record."""

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        digest = _digest(raw.get("csv"))
        return {**raw, "sha256": digest} if digest and "sha256" not in raw else raw

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        return f"{cls.what} is a file", f"add 'csv: {cls.what.rpartition(' ')[2]}.csv'"

    def limits(self) -> Iterable[LocatedProblem]:
        digest = _digest(self.csv)
        if digest and digest != self.sha256:
            what = f"{self.csv} has another digest, {digest[:12]}..."
            yield ("sha256",), problem(what, "it is the file that was read before", "remove sha256 if it may change")


def _digest(name: Any) -> str:
    """Of a file's bytes; "" where it cannot be read."""
    try:
        file = find_file(name) if isinstance(name, str) else None
        return hashlib.sha256(file.read_bytes()).hexdigest() if file is not None and file.is_file() else ""
    except (OSError, ValueError):
        return ""
