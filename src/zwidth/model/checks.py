"""Checks of the parameters of parts and scenes, with messages that name field, value, allowed values and remedy.

Values are numbers in SI units or texts with a unit, such as "70 g". Units determine the *kind* of a device, linear or
rotary: "N/m" belongs to a linear device, "N m/rad" to a rotary one. Functions represent the kind by a Boolean, True for
a rotary device, and by None if no unit determines it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, fields
from functools import cache, wraps
from numbers import Real
from typing import Any, ClassVar, Literal, NamedTuple, ParamSpec, Self, TypeVar

import numpy as np

from zwidth.core.errors import InputError, UnknownArgumentError, UnusableValueError, check_choice, describe_choice
from zwidth.core.pytrees import HiddenText, is_node, register, register_waiting
from zwidth.core.types import Array
from zwidth.core.xp import is_jax, is_traced, namespace, stop_gradient
from zwidth.units.display import with_units
from zwidth.units.formatting import describe, short
from zwidth.units.parsing import DIMENSIONS, TIME, detect_kind, read_quantity, to_float
from zwidth.units.quantities import ANY, CHOICES, FIELDS, NOT_NEGATIVE, PARAMETERS, POSITIVE, Range
from zwidth.units.unit_system import LINEAR, SYSTEMS, UnitSystem


def to_periods(delay: Array, period: Array) -> Array:
    """Return ``delay/period``; a quotient within 4 rounding errors of an integer becomes this integer."""
    # Without this correction, 1.1 ms divided by 0.1 ms would be 11.000000000000002 periods in float64, a fractional
    # delay.
    xp = namespace(delay, period)
    quotient = delay / period
    nearest = xp.round(quotient)
    near = xp.abs(quotient - nearest) <= 4 * np.finfo(quotient.dtype).eps * xp.maximum(nearest, 1.0)
    # Subtract the rounding error as a constant (without gradient), so that the derivatives remain those of the
    # quotient.
    return quotient - stop_gradient(xp.where(near & (nearest > 0), quotient - nearest, 0.0), xp)


class Span(NamedTuple):
    """A duration in seconds or in sampling periods."""

    value: float
    unit: Literal["s", "periods"]

    def seconds(self, period: float) -> float:
        """Return the duration in seconds for a sampling period in seconds."""
        return self.value if self.unit == "s" else self.value * period

    def periods(self, period: float) -> float:
        """Return the duration in sampling periods; an exact integer if it differs from one only by rounding errors."""
        if self.unit == "periods":
            return self.value
        return float(to_periods(np.float64(self.value), np.float64(period)))

    def __str__(self) -> str:
        return f"{self.value if is_jax(self.value) else short(self.value)} {self.unit}"


def read_span(value: Any, allowed: Range) -> Span:
    """Convert a number of seconds, or a text such as "1 ms" or "1.5 periods", to a `Span` and check its range."""
    if isinstance(value, Span):
        return value
    amount, unit = read_quantity(value, TIME, allowed, periods=True)
    return Span(amount, "periods" if unit == "periods" else "s")


# Names and units of linear and of rotary devices for messages, in this order: ``rotary`` (False or True) is the index.
_KINDS = ("linear", "rotary")
_UNITS = ("kg, N s/m and N/m", "kg m^2, N m s/rad and N m/rad")

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def accept_units(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Wrap a function of SI quantities so that it also accepts texts with a unit, such as "70 g" or "1.5 periods".

    The result is displayed in rotary units if an argument has a rotary unit.
    """
    names = tuple(inspect.signature(function).parameters)

    @wraps(function)
    def accepting(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        arguments = dict(zip(names, args, strict=False)) | kwargs
        if len(args) <= len(names) and any(map(_has_text, arguments.values())):
            system = SYSTEMS[bool(find_kind(arguments))]
            period = _in_si("period", arguments.get("period"), None, system)
            numbers = {name: _in_si(name, value, period, system) for name, value in arguments.items()}
            return with_units(function(**numbers), system)  # pyright: ignore[reportCallIssue]
        return with_units(function(*args, **kwargs), LINEAR)

    return accepting


def _has_text(value: Any) -> bool:
    """Return whether a value is a text, or a nested list or tuple with a text."""
    return isinstance(value, str) or (isinstance(value, list | tuple) and any(map(_has_text, value)))


def _map_texts(read: Callable[[str], Any], value: Any) -> Any:
    """Apply ``read`` to a text, or to each text of a list, tuple or array; return other values unchanged."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "U":
        value = value.tolist()
    if isinstance(value, str):
        return read(value)
    if not _has_text(value):
        return value
    results = [_map_texts(read, each) for each in value]
    return type(value)(*results) if hasattr(value, "_fields") else results


def read_texts(field: str, value: Any, unit: str) -> Any:
    """Convert texts with a unit to numbers in SI units; return other values unchanged.

    Args:
        field: path of the parameter, for messages.
        value: a text, a number, or a list or array of texts.
        unit: SI unit of the parameter.
    """
    return value if unit in ("", "1") else _map_texts(lambda text: check_number(field, text, unit, ANY), value)


def _in_si(name: str, value: Any, period: Any, system: UnitSystem) -> Any:
    """Convert all texts in an argument to numbers in SI units; return other values unchanged.

    Args:
        name: name of the argument, usually that of a parameter.
        value: value of the argument, or a nested list of values.
        period: sampling period in s, by which a delay in periods is multiplied; None if unknown.
        system: units of the device.
    """
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
            raise InputError(f"{name}: got {text!r} without a single period; write the delay in seconds")
        return span.seconds(period)

    return _map_texts(read, value)


@cache
def _find_signature(kind: type) -> inspect.Signature:
    """Return the signature of the constructor of a class, without ``self``."""
    signature = inspect.signature(kind.__init__)
    return signature.replace(parameters=list(signature.parameters.values())[1:])


class _ConstructorSignature:
    """The attribute ``__signature__`` of parts, because `inspect` would otherwise use that of ``Part.__new__``."""

    def __get__(self, part: Any, kind: type) -> inspect.Signature:
        return _find_signature(kind)


class Part:
    """Base class of the parts of a scene.

    The constructor checks all fields and converts them to SI units. ``repr`` returns the expression that creates the
    part. Each part is a JAX pytree: numbers and nested parts are its children, all other fields its constant structure.
    """

    _owner: ClassVar[str] = ""  # first part of the dotted paths of the fields, as in "coupling.mass"
    _texts: ClassVar[tuple[str, ...]] = ()  # fields with texts for the user; JAX does not compile again if they change
    # Names of the children; set if JAX creates the part, because the types of its children are then arbitrary.
    _child_names: tuple[str, ...] | None = None

    __signature__ = _ConstructorSignature()

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Create an object of the class; raise `UnknownArgumentError` if the constructor lacks a keyword argument."""
        if kwargs:
            names = tuple(_find_signature(cls).parameters)
            for name in (each for each in kwargs if each not in names):
                # Suggest only very similar names, because "virtual_mass" is no replacement for "virtual_stiffness".
                text = describe_choice(name, names, 0.75).replace("got", "got the argument", 1)
                raise UnknownArgumentError(f"{cls.__name__}: {text}")
        return super().__new__(cls)

    def __init_subclass__(cls) -> None:
        """Register each subclass as a node of JAX pytrees."""
        register(cls)

    def __post_init__(self) -> None:
        """Convert all fields to SI units; raise `InputError` for a value out of the range in `units.quantities`."""
        register_waiting()
        # Do not check the value None of a field whose default is None, because this field is optional. If a unit
        # determines the kind of device, store the kind in the attribute ``rotary``.
        items = {f"{self._owner}.{item.name}".lstrip("."): item for item in fields(self)}  # pyright: ignore[reportArgumentType]
        kind = find_kind({path: getattr(self, item.name) for path, item in items.items() if not _is_bandwidth(path)})
        if kind is not None:
            object.__setattr__(self, "rotary", kind)
        for path, item in items.items():
            value = getattr(self, item.name)
            if path in CHOICES:
                check_choice(path, value, CHOICES[path].names)
            elif path in FIELDS and not (value is None and item.default is None):
                quantity, allowed = FIELDS[path], find_range(item, path)
                if quantity.whole:
                    value = check_integer(path, value, int(allowed.low), int(allowed.high))
                else:
                    value = check_number(path, value, self.unit_system[quantity.unit], allowed)
                object.__setattr__(self, item.name, value)

    def _flatten(self) -> tuple[tuple[tuple[str, Any], ...], Any]:
        """Return the named children of the part as a node of a JAX pytree, and its constant structure."""
        values = {item.name: getattr(self, item.name) for item in fields(self) if item.init}  # pyright: ignore[reportArgumentType]
        names = self._child_names
        if names is None:
            names = tuple(k for k, value in values.items() if k not in self._texts and self._is_child(k, value))
        if not names:
            # A part without children is its own structure, so that JAX keeps its cached properties.
            return (), self
        children = tuple((name, values.pop(name)) for name in names)
        texts = HiddenText((name, values.pop(name)) for name in self._texts)
        return children, (names, tuple(values.items()), texts, self.unit_system is SYSTEMS[True])

    def _is_child(self, name: str, value: Any) -> bool:
        """Return whether a field is a child in JAX pytrees: a non-integer number, a part, or a tuple of parts."""
        if isinstance(value, tuple):
            return all(isinstance(each, Part) for each in value)
        return isinstance(value, float | np.floating | np.ndarray) or is_node(value) or is_jax(value)

    @classmethod
    def _unflatten(cls, structure: Any, children: Any) -> Any:
        """Return a part from its structure and its children; JAX may have replaced the children by any objects."""
        if isinstance(structure, Part):
            return structure
        names, constants, texts, rotary = structure
        part = object.__new__(cls)
        values = dict(zip(names, children, strict=True)) | dict(constants) | {"_child_names": names}
        # Leave texts empty in a traced part, because JAX uses the compiled function for parts with other texts too.
        values |= {name: type(text)() if is_traced(*children) else text for name, text in texts}
        if rotary:
            values["rotary"] = True
        for name, value in values.items():
            object.__setattr__(part, name, value)
        return part

    def _rebuild(self) -> Self:
        """Return the part with all numbers converted to floats and checked, because JAX sets numbers unchecked."""
        part = type(self)(**{item.name: _rebuild(getattr(self, item.name)) for item in fields(self) if item.init})  # pyright: ignore[reportArgumentType]
        if self.unit_system is SYSTEMS[True]:
            object.__setattr__(part, "rotary", True)
        return part

    @property
    def unit_system(self) -> UnitSystem:
        """The units of the device: those of rotary devices if ``rotary`` is True, otherwise those of linear devices."""
        return SYSTEMS[bool(getattr(self, "rotary", False))]

    def __repr__(self) -> str:
        """Return the expression that creates the part, without arguments that equal their defaults."""
        parts = []
        for item in (item for item in fields(self) if item.repr):  # pyright: ignore[reportArgumentType]
            usual = item.default if item.default_factory is MISSING else item.default_factory()
            text = repr(getattr(self, item.name))
            # Omit ``rotary=False``, because the default None also means a linear device.
            if text != repr(usual) and (text, usual) != ("False", None):
                parts.append(f"{item.name}={text}")
        return f"{type(self).__name__}({', '.join(parts)})"


def _is_bandwidth(path: str) -> bool:
    """Return whether a parameter is a bandwidth, whose unit rad/s does not imply a rotary device."""
    return path in FIELDS and FIELDS[path].unit == "1/s"


def _rebuild(value: Any) -> Any:
    """Return a checked copy of a part, or of each part in a tuple; return any other value unchanged."""
    if isinstance(value, tuple):
        return tuple(map(_rebuild, value))
    return value._rebuild() if isinstance(value, Part) else value


def _flatten(given: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the items of a dictionary as pairs (name, value); a list that contains texts yields one pair per entry."""
    for name, value in given.items():
        if isinstance(value, list | tuple) and _has_text(value):
            for each in value:
                yield from _flatten({name: each})
        else:
            yield name, value


def _kind_of(value: Any) -> bool | None:
    """Return the kind of device to which a text with a unit, or a part, belongs; None if it fits both kinds."""
    return detect_kind(value) if isinstance(value, str) else getattr(value, "rotary", None)


def find_kind(given: dict[str, Any]) -> bool | None:
    """Return the kind of device to which all values belong: True for rotary, False for linear, None if undetermined.

    Args:
        given: quantities and parts by name.

    Raises:
        InputError: some values belong to a rotary device and others to a linear device.
    """
    names: dict[bool, str] = {}
    for name, value in _flatten(given):
        kind = _kind_of(value)
        if kind is None:
            continue
        if names and kind not in names:
            raise InputError(
                f"{name}: got {value!r}, in {_KINDS[kind]} units, together with {names[not kind]}, in "
                f"{_KINDS[not kind]} units; write all quantities in {_UNITS[False]}, or in {_UNITS[True]}"
            )
        names.setdefault(bool(kind), f"{name} = {value!r}")
    return next(iter(names), None)


def check_kind(rotary: bool, given: dict[str, Any]) -> None:
    """Raise `InputError` if a quantity or part in the dictionary ``given`` belongs to the other kind of device."""
    for name, value in given.items():
        kind = _kind_of(value)
        if kind is not None and bool(kind) != rotary:
            raise InputError(
                f"{name}: got {value!r}, in {_KINDS[kind]} units, for a {_KINDS[rotary]} device; write it in "
                f"{_UNITS[rotary]}, or define a {_KINDS[kind]} device: zwidth.Device(..., rotary={bool(kind)})"
            )


def find_range(item: Field[Any], path: str) -> Range:
    """Return the allowed range of a dataclass field: that of its metadata, otherwise that in `units.quantities`."""
    return item.metadata.get("allowed", FIELDS[path].allowed)


def check_number(field: str, value: Any, unit: str = "", allowed: Range | None = None) -> Any:
    """Convert a single quantity to a float in SI units and check its range; return values that JAX traces unchanged.

    Args:
        field: path of the parameter, for messages.
        value: a number, or a text with a unit such as "70 g".
        unit: SI unit. Default: the unit of the parameter in `units.quantities`.
        allowed: allowed range. Default: the range of the parameter in `units.quantities`.

    Raises:
        InputError: the value is not a number, has a wrong unit, or is out of range.
    """
    if is_traced(value):
        return value
    if not unit:
        unit = PARAMETERS[field].unit
    if allowed is None:
        allowed = PARAMETERS[field].sign if field in PARAMETERS else NOT_NEGATIVE
    counts = field == "resolution"
    return _read(field, value, lambda number: read_quantity(number, DIMENSIONS[unit], allowed, counts=counts)[0])


def check_limit(name: str, value: Any, unit: str) -> float:
    """Convert a limit of the motor, such as its largest force, to SI units; return infinity (no limit) unchanged.

    Args:
        name: name of the limit, for messages.
        value: a number, or a text with a unit.
        unit: SI unit of the limit.
    """
    unlimited = isinstance(value, int | float | np.floating) and value == math.inf
    return math.inf if unlimited else check_number(name, value, unit, POSITIVE)


def check_span(field: str, value: Any) -> Any:
    """Convert a duration to a `Span` that keeps its unit, s or periods; return a value that JAX traces unchanged."""
    return value if is_traced(value) else _read(field, value, lambda duration: read_span(duration, NOT_NEGATIVE))


def _read(field: str, value: Any, read: Callable[[Any], Any]) -> Any:
    """Convert a single value by a function; raise `InputError` with the name of the field if the value is invalid.

    Args:
        field: path of the parameter, for messages.
        value: the value; arrays with one entry are converted to numbers first.
        read: function of the value that raises `UnusableValueError` for an invalid one.
    """
    if not isinstance(value, str | Span) and np.ndim(value) != 0:
        raise InputError(f"{field}: got an array of shape {np.shape(value)}; it must be a single number")
    if isinstance(value, np.ndarray) or is_jax(value):
        value = np.asarray(value).item()
    if isinstance(value, Real) and not isinstance(value, bool):
        # Convert NumPy scalars as well, which are registered as `numbers.Real`.
        value = to_float(value)  # pyright: ignore[reportArgumentType]  (anything that float takes)
    try:
        return read(value)
    except UnusableValueError as error:
        message = str(error)
        if not isinstance(value, str):
            # Show the value in the notation of Python instead of that of YAML, because the value does not come from a
            # file.
            message = message.replace(f"got {describe(value)};", f"got {value!r};", 1)
        raise InputError(f"{field}: {message}") from None


def check_integer(field: str, value: Any, low: int, high: int) -> int:
    """Convert a value to an integer; raise `InputError` if it is not an integer from ``low`` to ``high``."""
    number = value if isinstance(value, int | np.integer) and not isinstance(value, bool) else None
    if number is None and isinstance(value, float | np.floating) and float(value).is_integer():
        number = int(value)
    if number is None or not low <= number <= high:
        raise InputError(f"{field}: got {value!r}; it must be a whole number from {low} to {high}")
    return int(number)
