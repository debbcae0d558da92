"""Runs without rendering figures, for tests of other things: rendering takes most of the time of such runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from zwidth import plotting


def _write_name(
    drawn: Any, stem: Path, formats: Sequence[str] = ("png", "svg"), dpi: float | None = None
) -> tuple[Path, ...]:
    """Write files that contain their own names, in place of `zwidth.plotting.save`."""
    files = tuple(stem.with_name(f"{stem.name}.{ending}") for ending in formats)
    for file in files:
        file.write_text(file.name, encoding="utf-8")
    return files


@contextmanager
def painting_nothing() -> Iterator[None]:
    """Draw figures without rendering them; their files contain only their names."""
    with patch.object(plotting, "save", _write_name):
        yield
