"""What a run tells about itself: events while it goes on, and a result at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias


@dataclass(frozen=True)
class StudyResult:
    """How one study went.

    Attributes:
        name: the study's name in the configuration; "published" for the comparison with the paper's numbers.
        kind: the study's kind; "report" for that comparison.
        state: "done" or "failed".
        seconds: time it took.
        files: names of the files written, in the run's folder.
        notes: what a reader of the results must know, such as points without an answer.
        error: type and message of what went wrong, "" for a study that is done.
        exception: the error itself.
    """

    name: str
    kind: str
    state: Literal["done", "failed"]
    seconds: float
    files: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    error: str = ""
    exception: Exception | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class RunResult:
    """A finished run: its folder and how each study went."""

    folder: Path
    studies: tuple[StudyResult, ...]
    seconds: float

    @property
    def failed(self) -> tuple[StudyResult, ...]:
        """The studies that have no results."""
        return tuple(study for study in self.studies if study.state == "failed")

    @property
    def ok(self) -> bool:
        """Whether every study is done."""
        return not self.failed


@dataclass(frozen=True)
class StudyEvent:
    """The start or the end of a study.

    Attributes:
        index: number of the study, from 1.
        total: how many there are.
        name: name of the study.
        kind: kind of the study.
        result: None when the study starts, how it went when it ends.
    """

    index: int
    total: int
    name: str
    kind: str
    result: StudyResult | None = None


ProgressCallback: TypeAlias = Callable[[StudyEvent], None]
