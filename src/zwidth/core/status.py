"""Integer codes in results: the status of each point, the method that decided its stability, the kind of an optimum.

Compiled code cannot raise exceptions, and one invalid point must not prevent results at other points. A point without
result is therefore NaN and has one of these status codes.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum


class Status(IntEnum):
    """Status of a point: OK if its result is valid, otherwise the reason for the missing result."""

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
        """One sentence with the cause and the remedy."""
        return _MESSAGES[self]


def note_failures(counts: Iterable[int], of: str = "points") -> tuple[str, ...]:
    """Return a tuple with one sentence that states the number of points without result per status; empty if all are OK.

    Args:
        counts: number of points by status code, starting with OK.
        of: noun for the points, in plural.
    """
    ok, *others = counts
    failed = [(count, Status(code).name.lower().replace("_", " ")) for code, count in enumerate(others, 1) if count]
    if not failed:
        return ()
    reasons = ", ".join(f"{count:,} {name}" for count, name in failed)
    return (f"{sum(others):,} of {ok + sum(others):,} {of} have no result: {reasons}",)


class Method(IntEnum):
    """Method that decided the stability of a wall in `zwidth.decide_stability`."""

    COMPANION = 0
    CROSSOVER = 1
    CERTIFIED = 2


class RidgeKind(IntEnum):
    """Kind of the optimum at the stiffest stable wall."""

    SMOOTH = 0
    CORNER = 1
    NO_DAMPING = 2  # B = 0, if walls are restricted to B >= 0 and the optimum is at this bound
    NONE = 3  # there is no stiffest wall; the status is the reason


_MESSAGES = {
    Status.OK: "The value is accurate to the documented tolerance.",
    Status.INVALID_INPUT: (
        "An input is invalid: alpha and beta must be finite, delta and d finite and >= 0; correct it."
    ),
    Status.NOT_CONVERGED: "The solver stopped before it reached its tolerance; use a nearby point or another method.",
    Status.NO_BOUNDARY: (
        "No wall on the given line is stable, or, for K_max, none that is connected to K = 0; choose another value, or "
        "see islands."
    ),
    Status.UNDECIDED: (
        "The precision or the data do not suffice to decide; use method='certified' (extra 'certified'); for a "
        "measured device, resolve its warnings."
    ),
    Status.ON_BOUNDARY: "A pole is on the unit circle, or too close to it for the largest precision; change the wall.",
    Status.OUT_OF_RANGE: (
        "An input is out of range: |alpha|, |beta| 1e-60 to 1e60, delta <= 1e12, d <= 1e5, SI values 1e-30 to 1e30; "
        "check the units."
    ),
    Status.UNREACHABLE: "No value of the free parameter meets the requirement; change another parameter.",
}
