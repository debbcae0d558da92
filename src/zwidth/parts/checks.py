"""Checks of the parameters of scenes, with messages that contain field, value, allowed values and remedy."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, fields
from functools import wraps
from numbers import Real
from typing import Any, ClassVar, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np

from zwidth.words.errors import InputError, UnusableValueError, check_choice
from zwidth.words.formatting import describe, short
from zwidth.words.quantities import ANY, CHOICES, FIELDS, NOT_NEGATIVE, PARAMETERS, POSITIVE, Range
from zwidth.words.showing import with_units
from zwidth.words.types import Array
from zwidth.words.unit_system import LINEAR, SYSTEMS, UnitSystem
from zwidth.words.units import DIMENSIONS, TIME, read_quantity, tell_kind, to_float
from zwidth.words.xp import frozen, is_jax, is_traced, namespace


def in_periods(delay: Array, period: Array) -> Array:
    """Return ``delay/period``; replace a quotient within 4 rounding errors of an integer by this integer."""
    # 1.1 ms over 0.1 ms is 11 periods, but its float64 quotient is 11.000000000000002, another polynomial.
    xp = namespace(delay, period)
    quotient = delay / period
    whole = xp.round(quotient)
    near = xp.abs(quotient - whole) <= 4 * np.finfo(quotient.dtype).eps * xp.maximum(whole, 1.0)
    # Keep the derivatives of the quotient, because those of the rounded one are 0.
    return quotient - frozen(xp.where(near & (whole > 0), quotient - whole, 0.0), xp)


class Span(NamedTuple):
    """A length of time, in seconds or in sampling periods."""

    value: float
    unit: Literal["s", "periods"]

    def seconds(self, period: float) -> float:
        """Return the length in seconds for a sampling period in seconds."""
        return self.value if self.unit == "s" else self.value * period

    def periods(self, period: float) -> float:
        """Return the length in sampling periods, an exact integer if it differs from one by rounding errors only."""
        if self.unit == "periods":
            return self.value
        return float(in_periods(np.float64(self.value), np.float64(period)))

    def __str__(self) -> str:
        return f"{short(self.value)} {self.unit}"


def read_span(value: Any, allowed: Range) -> Span:
    """Return a length of time as `Span`."""
    if isinstance(value, Span):
        return value
    amount, unit = read_quantity(value, TIME, allowed, periods=True)
    return Span(amount, "periods" if unit == "periods" else "s")


# Names and units of linear and of rotary devices, for messages.
_KINDS, _UNITS = ("linear", "rotary"), ("kg, N s/m and N/m", "kg m^2, N m s/rad and N m/rad")

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def accept_units(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Wrap a function to accept SI quantities as text with a unit, "70 g", and a delay as "1.5 periods".

    The result is shown in rotary units if one of the units is rotary.
    """
    names = tuple(inspect.signature(function).parameters)

    @wraps(function)
    def accepting(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        given = dict(zip(names, args, strict=False)) | kwargs
        if len(args) <= len(names) and any(map(_has_text, given.values())):
            system = SYSTEMS[bool(find_kind(given))]
            period = _in_si("period", given.get("period"), None, system)
            numbers = {name: _in_si(name, value, period, system) for name, value in given.items()}
            return with_units(function(**numbers), system)  # pyright: ignore[reportCallIssue]
        return with_units(function(*args, **kwargs), LINEAR)

    return accepting


def _has_text(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, list | tuple) and any(map(_has_text, value)))


def _map_texts(read: Callable[[str], Any], value: Any) -> Any:
    """Apply ``read`` to a text or to all texts in a list, tuple or array; return other values unchanged."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "U":
        value = value.tolist()
    if isinstance(value, str):
        return read(value)
    if not _has_text(value):
        return value
    found = [_map_texts(read, each) for each in value]
    return type(value)(*found) if hasattr(value, "_fields") else found


def read_texts(field: str, value: Any, unit: str) -> Any:
    """Convert texts with a unit, also in lists and arrays, to numbers in the SI unit; return other values unchanged."""
    return value if unit in ("", "1") else _map_texts(lambda text: check_number(field, text, unit, ANY), value)


def _in_si(name: str, value: Any, period: Any, system: UnitSystem) -> Any:
    """Return an argument with all texts converted to numbers in its SI unit."""
    if name not in PARAMETERS or PARAMETERS[name].unit == "1":
        return value
    if name != "delay":
        return read_texts(name, value, system[PARAMETERS[name].unit])

    def read(text: str) -> float:
        try:
            span = read_span(text, NOT_NEGATIVE)
        except UnusableValueError as error:
            raise InputError(f"{name}: {error}") from None
        if span.unit == "periods" and (period is None or np.ndim(period) != 0):
            raise InputError(f"{name}: got {text!r} without one period to count in; write it in seconds")
        return span.seconds(period)

    return _map_texts(read, value)


class Part:
    """Base of the parts of a scene: checks their parameters; ``repr`` returns an expression that creates the part."""

    _owner: ClassVar[str] = ""  # prefix of the paths of its parameters

    def __post_init__(self) -> None:
        """Convert every parameter to its SI unit; raise `InputError` if `words.quantities` does not allow the value."""
        # Values that are None by default may be omitted. A part with linear or rotary units stores the kind in
        # ``rotary``.
        own = {f"{self._owner}.{item.name}".lstrip("."): item for item in fields(self)}  # pyright: ignore[reportArgumentType]
        told = find_kind({path: getattr(self, item.name) for path, item in own.items()})
        if told is not None:
            object.__setattr__(self, "rotary", told)
        for path, item in own.items():
            value = getattr(self, item.name)
            if path in CHOICES:
                check_choice(path, value, CHOICES[path].names)
            elif path in FIELDS and not (value is None and item.default is None):
                known, allowed = FIELDS[path], find_range(item, path)
                if known.whole:
                    value = check_whole(path, value, int(allowed.low), int(allowed.high))
                else:
                    value = check_number(path, value, self.unit_system[known.unit], allowed)
                object.__setattr__(self, item.name, value)

    @property
    def unit_system(self) -> UnitSystem:
        """The units of its device; linear unless a unit or an argument ``rotary`` defines a rotary device."""
        return SYSTEMS[bool(getattr(self, "rotary", False))]

    def __repr__(self) -> str:
        """Return an expression that creates the part, without arguments that have their default values."""
        parts = []
        for item in (item for item in fields(self) if item.repr):  # pyright: ignore[reportArgumentType]
            usual = item.default if item.default_factory is MISSING else item.default_factory()
            text = repr(getattr(self, item.name))
            # False and None both mean a linear device.
            if text != repr(usual) and (text, usual) != ("False", None):
                parts.append(f"{item.name}={text}")
        return f"{type(self).__name__}({', '.join(parts)})"


def _list_told(given: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield each value with its name, and each text of a list separately."""
    for name, value in given.items():
        if isinstance(value, list | tuple) and _has_text(value):
            for each in value:
                yield from _list_told({name: each})
        else:
            yield name, value


def _kind_of(value: Any) -> bool | None:
    """Return True for a quantity or part of a rotary device, False for that of a linear device, None otherwise."""
    return tell_kind(value) if isinstance(value, str) else getattr(value, "rotary", None)


def find_kind(given: dict[str, Any]) -> bool | None:
    """Return True if quantities and parts, by name, belong to a rotary device, False for a linear one, None otherwise.

    Raises:
        InputError: some are of a rotary device, others of a linear one.
    """
    told: dict[bool, str] = {}
    for name, value in _list_told(given):
        kind = _kind_of(value)
        if kind is None:
            continue
        if told and kind not in told:
            raise InputError(
                f"{name}: got {value!r}, in units of a {_KINDS[kind]} device, beside {told[not kind]}, of a "
                f"{_KINDS[not kind]} one; write all of them in {_UNITS[False]}, or in {_UNITS[True]}"
            )
        told.setdefault(bool(kind), f"{name} = {value!r}")
    return next(iter(told), None)


def check_kind(rotary: bool, given: dict[str, Any]) -> None:
    """Raise `InputError` if a quantity or part, by name, has units of the other kind of device."""
    for name, value in given.items():
        kind = _kind_of(value)
        if kind is not None and bool(kind) != rotary:
            raise InputError(
                f"{name}: got {value!r}, in units of a {_KINDS[kind]} device, for a {_KINDS[rotary]} one; write it in "
                f"{_UNITS[rotary]}, or make the device {_KINDS[kind]}: zwidth.Device(..., rotary={bool(kind)})"
            )


def find_range(item: Field[Any], path: str) -> Range:
    """Return the allowed range of a field: that of its metadata, otherwise that of its quantity."""
    return item.metadata.get("allowed", FIELDS[path].allowed)


def check_number(field: str, value: Any, unit: str = "", allowed: Range | None = None) -> Any:
    """Return one quantity in its SI unit as a float, or unchanged if JAX traces it.

    Args:
        field: path of the parameter.
        value: a number, or a text with a unit, "70 g".
        unit: SI unit; that of the parameter if left out.
        allowed: range; that of the parameter if left out.

    Raises:
        InputError: the value is not a number, its unit is wrong, or it is out of range.
    """
    if is_traced(value):
        return value
    if not unit:
        unit = PARAMETERS[field].unit
    if allowed is None:
        allowed = PARAMETERS[field].sign if field in PARAMETERS else NOT_NEGATIVE
    counts = field == "resolution"
    return _read(field, value, lambda known: read_quantity(known, DIMENSIONS[unit], allowed, counts=counts)[0])


def check_limit(name: str, value: Any, unit: str) -> float:
    """Return a motor limit in SI units; infinite if the motor has no such limit."""
    unlimited = isinstance(value, int | float | np.floating) and value == math.inf
    return math.inf if unlimited else check_number(name, value, unit, POSITIVE)


def check_span(field: str, value: Any) -> Any:
    """Return a length of time as `Span`, in its original unit, s or periods; unchanged if JAX traces it."""
    return value if is_traced(value) else _read(field, value, lambda known: read_span(known, NOT_NEGATIVE))


def _read(field: str, value: Any, read: Callable[[Any], Any]) -> Any:
    """Apply ``read`` to a single value; raise `InputError` with the name of the field if it is not usable."""
    if not isinstance(value, str | Span) and np.ndim(value) != 0:
        raise InputError(f"{field}: got an array of shape {np.shape(value)}; a scene holds single numbers")
    if isinstance(value, np.ndarray) or is_jax(value):
        value = np.asarray(value).item()
    if isinstance(value, Real) and not isinstance(value, bool):
        # Scalars of NumPy are real numbers, too.
        value = to_float(value)  # pyright: ignore[reportArgumentType]  (anything that float takes)
    try:
        return read(value)
    except UnusableValueError as error:
        message = str(error)
        if not isinstance(value, str):
            # Show the value as Python spells it.
            message = message.replace(f"got {describe(value)};", f"got {value!r};", 1)
        raise InputError(f"{field}: {message}") from None


def check_whole(field: str, value: Any, low: int, high: int) -> int:
    """Return an integer; raise `InputError` if the value is not an integer in range."""
    number = value if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None and isinstance(value, float | np.floating) and float(value).is_integer():
        number = int(value)
    if number is None or not low <= number <= high:
        raise InputError(f"{field}: got {value!r}; a whole number from {low} to {high} is needed")
    return int(number)
