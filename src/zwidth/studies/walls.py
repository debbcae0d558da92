"""The walls of a study: shares of the maximum stiffness or given outright, and their names."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from zwidth.config.faults import LocatedProblem, problem
from zwidth.words.formatting import with_unit

_KEYS = ("stiffness_fraction", "walls")


def gives_walls(raw: dict[str, Any]) -> bool:
    """Whether a study says by itself what its walls are."""
    return any(key in raw for key in _KEYS)


def check_choice_of_walls(raw: dict[str, Any], *, both: str, neither: str) -> Iterable[LocatedProblem]:
    """What is wrong where walls are given twice or not at all; the study says what it allows then."""
    given = [key for key in raw if key in _KEYS]
    if len(given) == 2:
        yield (given[1],), problem("stiffness_fraction and walls are both given", both, "remove one", on_key=True)
    elif not given:
        yield (), problem("stiffness_fraction or walls is missing", neither, "add 'stiffness_fraction: 0.75'")


def name_wall(stiffness: float, virtual_damping: float) -> str:
    """A wall in words."""
    return f"K = {with_unit(stiffness, 'N/m')}, B = {with_unit(virtual_damping, 'N s/m')}"
