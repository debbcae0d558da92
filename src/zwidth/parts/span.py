"""Lengths of time in seconds or in sampling periods, and functions whose arguments may have units: "1.5 periods"."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np

from zwidth.arrays.xp import frozen, namespace
from zwidth.words.errors import InputError, UnusableValueError
from zwidth.words.formatting import short
from zwidth.words.quantities import NOT_NEGATIVE, PARAMETERS, Range
from zwidth.words.types import Array
from zwidth.words.units import TIME, find_dimension, read_quantity


def in_periods(delay: Array, period: Array) -> Array:
    """``delay/period``, with a quotient within 4 rounding errors of a whole number taken as that number.

    1.1 ms over 0.1 ms is 11 periods, but its float64 quotient is 11.000000000000002, another polynomial.
    """
    xp = namespace(delay, period)
    quotient = delay / period
    whole = xp.round(quotient)
    near = xp.abs(quotient - whole) <= 4 * np.finfo(quotient.dtype).eps * xp.maximum(whole, 1.0)
    # Rounding is flat; the quotient it corrects is not.
    return quotient - frozen(xp.where(near & (whole > 0), quotient - whole, 0.0), xp)


class Span(NamedTuple):
    """A length of time, in seconds or in sampling periods."""

    value: float
    unit: Literal["s", "periods"]

    def seconds(self, period: float) -> float:
        """The length in seconds for a sampling period in seconds."""
        return self.value if self.unit == "s" else self.value * period

    def periods(self, period: float) -> float:
        """The length in sampling periods, whole where it is whole but for rounding."""
        if self.unit == "periods":
            return self.value
        return float(in_periods(np.float64(self.value), np.float64(period)))

    def __str__(self) -> str:
        return f"{short(self.value)} {self.unit}"


def read_span(value: Any, allowed: Range) -> Span:
    """A length of time."""
    if isinstance(value, Span):
        return value
    amount, unit = read_quantity(value, TIME, allowed, periods=True)
    return Span(amount, "periods" if unit == "periods" else "s")


Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def accept_units(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let the SI quantities that a function takes be texts with a unit: "70 g", and a delay "1.5 periods" as well."""
    names = tuple(inspect.signature(function).parameters)

    @wraps(function)
    def accepting(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        given = dict(zip(names, args, strict=False)) | kwargs
        if len(args) <= len(names) and any(map(_has_text, given.values())):
            period = _in_si("period", given.get("period"), None)
            return function(**{name: _in_si(name, value, period) for name, value in given.items()})  # pyright: ignore[reportCallIssue]
        return function(*args, **kwargs)

    return accepting


def _has_text(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, tuple) and any(isinstance(end, str) for end in value))


def _in_si(name: str, value: Any, period: Any) -> Any:
    """A text, or a named tuple of texts, as numbers in the SI base unit; anything else as it is."""
    if name not in PARAMETERS or PARAMETERS[name].unit == "1" or not _has_text(value):
        return value
    if isinstance(value, tuple):
        return type(value)(*(_in_si(name, end, period) for end in value))
    try:
        if name != "delay":
            return read_quantity(value, find_dimension(PARAMETERS[name].unit))[0]
        span = read_span(value, NOT_NEGATIVE)
    except UnusableValueError as error:
        raise InputError(f"{name}: {error}") from None
    if span.unit == "periods" and (period is None or isinstance(period, tuple)):
        raise InputError(f"{name}: got {value!r} without one period to count in; write it in seconds")
    return span.seconds(period)
