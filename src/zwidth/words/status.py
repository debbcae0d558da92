"""Codes: statuses that accompany a result point by point, with their messages.

Traced code cannot raise, and one bad point must not spoil a batch: it gets NaN and one of these codes.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum


class Status(IntEnum):
    """Why a point has the value it has; 0 is success."""

    OK = 0
    INVALID_INPUT = 1
    NOT_CONVERGED = 2
    NO_BOUNDARY = 3
    UNDECIDED = 4
    ON_BOUNDARY = 5
    UNREACHABLE = 6
    OUT_OF_RANGE = 7

    @property
    def message(self) -> str:
        """One sentence: the cause, then the remedy."""
        return _MESSAGES[self]


def note_failures(counts: Iterable[int], of: str = "points") -> tuple[str, ...]:
    """A note of how many of a result's points, counted by their status, are not OK, and why; none where all are."""
    ok, *others = counts
    failed = [(count, Status(code).name.lower().replace("_", " ")) for code, count in enumerate(others, 1) if count]
    if not failed:
        return ()
    why = ", ".join(f"{count:,} {name}" for count, name in failed)
    return (f"{sum(others):,} of {ok + sum(others):,} {of} have no answer: {why}",)


class Method(IntEnum):
    """What decided a point, in `zwidth.decide_stability`."""

    COMPANION = 0
    CROSSOVER = 1
    CERTIFIED = 2


class RidgeKind(IntEnum):
    """Kind of optimum at the stiffest stable wall."""

    SMOOTH = 0
    CORNER = 1
    NO_DAMPING = 2  # of a scene where only B >= 0 counts: the end of the row B = 0
    NONE = 3  # no stiffest wall exists; the status contains the reason


_MESSAGES = {
    Status.OK: "The value is right to the stated accuracy.",
    Status.INVALID_INPUT: (
        "An input is NaN, infinite or negative where it must not be; alpha and beta are finite, delta and d finite "
        "and >= 0."
    ),
    Status.NOT_CONVERGED: "The solver stopped before its tolerance; ask for a nearby point or another method.",
    Status.NO_BOUNDARY: "No stable wall lies on the given line; choose another alpha or beta.",
    Status.UNDECIDED: (
        "What is given does not decide it; of a model method='certified' decides walls, with the extra 'certified' "
        "installed, of a fit or a measured response its doubts say what to measure."
    ),
    Status.ON_BOUNDARY: "A pole lies exactly on the unit circle, or too close to it for the largest precision allowed.",
    Status.OUT_OF_RANGE: (
        "An input is beyond the range that is computed; alpha and beta are 0 or 1e-60 to 1e60 in magnitude, delta is "
        "at most 1e12 and d at most 1e5, SI quantities are 0 or 1e-30 to 1e30."
    ),
    Status.UNREACHABLE: "Nothing that was free to vary reaches what was asked for; change another quantity.",
}
