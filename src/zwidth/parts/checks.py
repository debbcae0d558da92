"""Checks that the parts of a scene share: one message names the field, the value and what is allowed."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any

import numpy as np

from zwidth.domain import SI_RANGE
from zwidth.errors import InputError
from zwidth.xp import is_jax


def check_number(field: str, value: Any, unit: str, *, low: float = 0.0, low_open: bool = False) -> Any:
    """Return one real number in range, a float unless JAX traces or holds it; else raise `InputError`."""
    if is_jax(value):
        return value
    if not isinstance(value, str) and np.ndim(value) != 0:
        raise InputError(f"{field}: got an array of shape {np.shape(value)}; a scene holds single numbers")
    if isinstance(value, bool | str) or not isinstance(value, Real):
        raise InputError(f"{field}: got {value!r}; a real number is needed{f' (in {unit})' if unit else ''}")
    number = float(value)
    above = number > low if low_open else number >= low
    if not (math.isfinite(number) and above):
        bound = "" if low == -math.inf else f" and {'greater than' if low_open else 'at least'} {low:g}"
        raise InputError(f"{field}: got {value!r}; it must be finite{bound}{f' (in {unit})' if unit else ''}")
    if number and not SI_RANGE[0] <= abs(number) <= SI_RANGE[1]:
        raise InputError(
            f"{field}: got {value!r}; it must be 0 or {SI_RANGE[0]:g} to {SI_RANGE[1]:g} in magnitude; check the units"
        )
    return number


def check_whole(field: str, value: Any, low: int, high: int) -> int:
    """Return one whole number in range; else raise `InputError`."""
    number = value if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None and isinstance(value, float | np.floating) and float(value).is_integer():
        number = int(value)
    if number is None or not low <= number <= high:
        raise InputError(f"{field}: got {value!r}; a whole number from {low} to {high} is needed")
    return int(number)
