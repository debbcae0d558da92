"""Checks that the parts of a scene share: one message names the field, the value and what is allowed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, fields
from numbers import Real
from typing import Any

import numpy as np

from zwidth.arrays.xp import is_jax
from zwidth.parts.span import Span, read_span
from zwidth.words.errors import InputError, UnusableValueError, check_choice
from zwidth.words.formatting import describe
from zwidth.words.quantities import CHOICES, FIELDS, NOT_NEGATIVE, PARAMETERS, Range
from zwidth.words.units import find_dimension, read_quantity, to_float


def check_fields(part: Any, owner: str = "") -> None:
    """Put every number of a part in its SI unit, where `words.quantities` allows it; else raise `InputError`.

    ``owner`` begins the names of its quantities. A number that is None by default may be left out.
    """
    for item in fields(part):
        path, value = f"{owner}.{item.name}" if owner else item.name, getattr(part, item.name)
        if path in CHOICES:
            check_choice(path, value, CHOICES[path].names)
        elif path in FIELDS and not (value is None and item.default is None):
            unit, allowed = FIELDS[path].unit, find_range(item, path)
            if FIELDS[path].whole:
                value = check_whole(path, value, int(allowed.low), int(allowed.high))
            else:
                value = check_number(path, value, unit, allowed)
            object.__setattr__(part, item.name, value)


def find_range(item: Field[Any], path: str) -> Range:
    """The admissible values of a field of a part: the quantity's, or fewer where the part says so."""
    return item.metadata.get("allowed", FIELDS[path].allowed)


def check_number(field: str, value: Any, unit: str = "", allowed: Range | None = None) -> Any:
    """Return one quantity in its SI unit, a float unless JAX traces or holds it; else raise `InputError`.

    A text is a number with a unit, as in configuration files: "70 g". Unit and range are those that `words.quantities`
    has for the field where they are left out.
    """
    if is_jax(value):
        return value
    if not unit:
        unit = PARAMETERS[field].unit
    if allowed is None:
        allowed = PARAMETERS[field].sign if field in PARAMETERS else NOT_NEGATIVE
    return _read(field, value, lambda known: read_quantity(known, find_dimension(unit), allowed)[0])


def check_span(field: str, value: Any) -> Any:
    """Return a length of time as `Span`, in s or in periods as it was given; what JAX holds stays as it is."""
    return value if is_jax(value) else _read(field, value, lambda known: read_span(known, NOT_NEGATIVE))


def _read(field: str, value: Any, read: Callable[[Any], Any]) -> Any:
    if not isinstance(value, str | Span) and np.ndim(value) != 0:
        raise InputError(f"{field}: got an array of shape {np.shape(value)}; a scene holds single numbers")
    if isinstance(value, Real) and not isinstance(value, bool):
        # Also what NumPy holds.
        value = to_float(value)  # pyright: ignore[reportArgumentType]  (anything that float takes)
    try:
        return read(value)
    except UnusableValueError as error:
        message = str(error)
        if not isinstance(value, str):
            # As Python spells it.
            message = message.replace(f"got {describe(value)};", f"got {value!r};", 1)
        raise InputError(f"{field}: {message}") from None


def check_whole(field: str, value: Any, low: int, high: int) -> int:
    """Return one whole number in range; else raise `InputError`."""
    number = value if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None and isinstance(value, float | np.floating) and float(value).is_integer():
        number = int(value)
    if number is None or not low <= number <= high:
        raise InputError(f"{field}: got {value!r}; a whole number from {low} to {high} is needed")
    return int(number)
