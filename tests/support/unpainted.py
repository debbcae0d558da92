"""Runs without their pictures, for tests that look at something else: painting takes most of the time of such runs."""

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
    """In place of `zwidth.plotting.save`."""
    files = tuple(stem.with_name(f"{stem.name}.{ending}") for ending in formats)
    for file in files:
        file.write_text(file.name, encoding="utf-8")
    return files


@contextmanager
def painting_nothing() -> Iterator[None]:
    """Meanwhile figures are drawn as ever, and their files hold their names alone."""
    with patch.object(plotting, "save", _write_name):
        yield
