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

    Its state is "done"; "kept", where an earlier run had done it; "failed"; or "open", a sweep of which chunks are left
    to do, by another shard or because the run was stopped.
    """

    name: str
    kind: str
    state: Literal["done", "kept", "failed", "open"]
    seconds: float = 0.0  # the sweeps of a run are computed together
    files: tuple[str, ...] = ()  # written in the run's folder; a sweep's is its store
    notes: tuple[str, ...] = ()  # what a reader of the results must know, such as points without an answer
    answer: tuple[str, ...] = ()  # what was found, where a line or two can say it
    error: str = ""  # type and message of what went wrong
    exception: Exception | None = field(default=None, repr=False, compare=False)  # of a study that is no sweep
    sweep: SweepResult | None = None


@dataclass(frozen=True)
class RunResult:
    """A finished run."""

    folder: Path
    studies: tuple[StudyResult, ...]  # how each of them went, those that are sweeps last
    seconds: float
    repaired: tuple[str, ...] = ()  # files and chunks that were damaged or missing, and that were made again
    hopeless: str = ""  # the error that ended the run early, for nothing else would have escaped it, as a full disk
    interrupted: bool = False  # whether somebody stopped the run, with Ctrl-C; what was done by then is kept
    lost: str = ""  # why a cluster could not go on, its scheduler having died say; what was done by then is kept

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
        return not (self.failed or self.interrupted or self.hopeless or self.lost)


@dataclass(frozen=True)
class StudyEvent:
    """The start or the end of a study, or a chunk of a sweep."""

    index: int  # number of the study, from 1
    total: int  # how many there are
    name: str
    kind: str
    result: StudyResult | None = None  # how it went, when it ends
    progress: Progress | None = None  # how far the sweeps are, after a chunk


ProgressCallback: TypeAlias = Callable[[StudyEvent], None]
