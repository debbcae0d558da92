"""What a run tells about itself: events while it goes on, and a result at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from zwidth.sweep.engine import Progress, SweepResult


@dataclass(frozen=True)
class StudyResult:
    """How one study went.

    Attributes:
        name: the study's name in the configuration; "published" for the comparison with the paper's numbers.
        kind: the study's kind; "report" for that comparison.
        state: "done"; "kept", where an earlier run had done it; "failed"; or "open", a sweep of which chunks are left
            to do, by another shard or because the run was stopped.
        seconds: time it took; the sweeps of a run are computed together.
        files: names of the files written, in the run's folder; a sweep's is its store.
        notes: what a reader of the results must know, such as points without an answer.
        error: type and message of what went wrong, "" for a study that did not fail.
        exception: the error itself, of a study that is no sweep.
        sweep: the chunks of a sweep.
    """

    name: str
    kind: str
    state: Literal["done", "kept", "failed", "open"]
    seconds: float = 0.0
    files: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    error: str = ""
    exception: Exception | None = field(default=None, repr=False, compare=False)
    sweep: SweepResult | None = None


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    Attributes:
        folder: where the results are.
        studies: how each study went, those that are sweeps last.
        seconds: time it took.
        repaired: files and chunks that were damaged or missing, and that were made again.
        hopeless: the error that ended the run early, for nothing else would have escaped it, as a full disk.
        interrupted: whether somebody stopped the run, with Ctrl-C; what was done by then is kept.
    """

    folder: Path
    studies: tuple[StudyResult, ...]
    seconds: float
    repaired: tuple[str, ...] = ()
    hopeless: str = ""
    interrupted: bool = False

    @property
    def failed(self) -> tuple[StudyResult, ...]:
        """The studies that lack results because something went wrong."""
        return tuple(study for study in self.studies if study.state == "failed")

    @property
    def sweeps(self) -> dict[str, SweepResult]:
        """The sweeps by their names."""
        return {study.name: study.sweep for study in self.studies if study.sweep is not None}

    @property
    def ok(self) -> bool:
        """Whether everything that this run was to do is done."""
        return not self.failed and not self.interrupted and not self.hopeless


@dataclass(frozen=True)
class StudyEvent:
    """The start or the end of a study, or a chunk of a sweep.

    Attributes:
        index: number of the study, from 1.
        total: how many there are.
        name: name of the study.
        kind: kind of the study.
        result: how it went, when it ends.
        progress: how far the sweeps are, after a chunk.
    """

    index: int
    total: int
    name: str
    kind: str
    result: StudyResult | None = None
    progress: Progress | None = None


ProgressCallback: TypeAlias = Callable[[StudyEvent], None]
