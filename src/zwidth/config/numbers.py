"""Numbers without a unit, as configurations and the command line take them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

from zwidth.config.faults import describe, problem, short
from zwidth.quantities import ANY, Range

# One way only to match a run of digits: a second one costs quadratic time on a long run that fails in the end.
_NUMBER_TEXT = re.compile(r"\s*[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?\s*")
_NOT_FINITE_TEXT = {"nan", "inf", "+inf", "-inf", "infinity"}


def looks_like_number(text: str) -> bool:
    """Whether a text would be a number without its quotes."""
    return _NUMBER_TEXT.fullmatch(text) is not None


def check_range(value: float, allowed: Range, unit: str = "", remedy: str = "") -> float:
    """Return a finite, admissible value or raise a problem."""
    bounds = str(allowed)
    needed = f"it must be {bounds}{f' {unit}' if unit else ''}" if bounds else "it must be finite"
    if not math.isfinite(value):
        needed = f"it must be finite{f' and {bounds}' if bounds else ''}"
        raise problem(f"got {describe(value)}", needed, remedy or "write a finite number")
    if not allowed.holds(value):
        raise problem(
            f"got {short(value)}{f' {unit}' if unit else ''}", needed, remedy or "write a number in this range"
        )
    return value


def to_float(value: float) -> float:
    """A whole number beyond float64 becomes infinite, which `check_range` then refuses."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def number(allowed: Range = ANY, remedy: str = "") -> Callable[[Any], float]:
    """A validator for a number without a unit."""

    def validate(value: Any) -> float:
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

    return validate


def whole_number(allowed: Range = ANY) -> Callable[[Any], int]:
    """A validator for a whole number."""

    def validate(value: Any) -> int:
        if isinstance(value, int) and not isinstance(value, bool):
            check_range(to_float(value), allowed)
            return value
        hint = f"write a whole number such as {max(allowed.low, 10):g}"
        if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
            hint = f"write {value:.0f}"
        elif isinstance(value, str) and looks_like_number(value):
            hint = "drop the quotes"
        raise problem(f"got {describe(value)}", "it must be a whole number", hint)

    return validate
