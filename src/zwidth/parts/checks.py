"""Checks that the parts of a scene share: one message names the field, the value and what is allowed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from zwidth.domain import SI_RANGE
from zwidth.errors import InputError
from zwidth.xp import is_jax


def check_number(
    field: str, value: Any, unit: str, *, low: float = 0.0, low_open: bool = False, high: float = math.inf
) -> Any:
    """Return one real number in range, a float unless JAX traces or holds it; else raise `InputError`."""
    if is_jax(value):
        return value
    allowed = f"it must be one finite number{_bounds(low, low_open, high)}{f' (in {unit})' if unit else ''}"
    if isinstance(value, bool | str) or np.ndim(value) != 0:
        raise InputError(f"{field}: got {value!r}; {allowed}")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{field}: got {value!r}; {allowed}") from error
    above = number > low if low_open else number >= low
    if not (math.isfinite(number) and above and number <= high):
        raise InputError(f"{field}: got {value!r}; {allowed}")
    if number and not SI_RANGE[0] <= abs(number) <= SI_RANGE[1]:
        raise InputError(
            f"{field}: got {value!r}; it must be 0 or {SI_RANGE[0]:g} to {SI_RANGE[1]:g} in magnitude; check the units"
        )
    return number


def _bounds(low: float, low_open: bool, high: float) -> str:
    above = "" if low == -math.inf else f", {'greater than' if low_open else 'at least'} {low:g}"
    return above + ("" if high == math.inf else f" and at most {high:g}")


def check_whole(field: str, value: Any, low: int, high: int) -> int:
    """Return one whole number in range; else raise `InputError`."""
    number = value if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None and isinstance(value, float | np.floating) and float(value).is_integer():
        number = int(value)
    if number is None or not low <= number <= high:
        raise InputError(f"{field}: got {value!r}; a whole number from {low} to {high} is needed")
    return int(number)
