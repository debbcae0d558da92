"""Numbers without a unit, as configurations and the command line take them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from zwidth.config.faults import problem, raise_problems
from zwidth.words.formatting import describe
from zwidth.words.quantities import ANY, Range
from zwidth.words.units import check_range, looks_like_number, to_float

_NOT_FINITE_TEXT = {"nan", "inf", "+inf", "-inf", "infinity"}


def number(allowed: Range = ANY, remedy: str = "") -> Callable[[Any], float]:
    """A validator for a number without a unit."""

    def read(value: Any) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return check_range(to_float(value), allowed, remedy=remedy)
        hint = "write a number such as 0.5"
        if isinstance(value, str):
            if looks_like_number(value):
                hint = "drop the quotes"
            elif value.lower() in _NOT_FINITE_TEXT:
                hint = "write a finite number"
            elif looks_like_number(value.split(" ")[0]):
                hint = "this field has no unit; write the number alone"
        raise problem(f"got {describe(value)}", "it must be one number", hint)

    return raise_problems(read)


def whole_number(allowed: Range = ANY) -> Callable[[Any], int]:
    """A validator for a whole number."""

    def read(value: Any) -> int:
        if isinstance(value, int) and not isinstance(value, bool):
            check_range(to_float(value), allowed)
            return value
        hint = f"write a whole number such as {max(allowed.low, 10):g}"
        if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
            hint = f"write {value:.0f}"
        elif isinstance(value, str) and looks_like_number(value):
            hint = "drop the quotes"
        raise problem(f"got {describe(value)}", "it must be a whole number", hint)

    return raise_problems(read)
