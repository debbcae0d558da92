"""Values of a configuration: numbers, quantities with a unit, durations, and axes.

A quantity is a number in its SI base unit or a text with a unit, such as ``'2 kN/m'``. A duration is in seconds or in
sampling periods (a `Span`). An axis, the values of one quantity, is written as one number, a list,
``{linear: {start, stop, num}}`` (equal steps) or ``{log: {start, stop, num}}`` (equal ratios).

`Quantity` and `AxisOf` are annotations of model fields. They validate the value, and describe it in the JSON Schema.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from math import inf
from typing import Annotated, Any, TypeAlias, cast

import numpy as np
from pydantic import (
    BeforeValidator,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainValidator,
    ValidationError,
    ValidationInfo,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from zwidth.config.fields import LocatedProblem, Strict, combine_problems, find_repeated, list_problems, problem
from zwidth.core.contexts import set_temporarily
from zwidth.core.errors import UnusableValueError
from zwidth.model.checks import Span, read_span
from zwidth.units.formatting import describe, short, suggestion
from zwidth.units.parsing import (
    DIMENSIONS,
    PERIOD_WORDS,
    check_range,
    find_other,
    looks_like_number,
    read_quantity,
    to_float,
)
from zwidth.units.quantities import ANY, FIELDS, FRACTION, NOT_NEGATIVE, POSITIVE, Range
from zwidth.units.unit_system import LINEAR, UnitSystem

_NOT_FINITE_TEXT = {"nan", "inf", "+inf", "-inf", "infinity"}
LONGEST_AXIS = 10_000_000
"""Largest number of values of an axis, which limits its memory to 80 MB."""

Entry: TypeAlias = Callable[[Any], float]
"""Function that returns a value of a configuration as a number, or raises a `problem`."""

_FORMS = "a number, a list of numbers, {linear: {start, stop, num}} or {log: {start, stop, num}}"

# Unit system of the file that is being read. It is stored in a context variable, because a value without a unit gets
# its unit from the kind of devices in the whole file, which is not passed to a validator.
_system: ContextVar[UnitSystem] = ContextVar("system", default=LINEAR)


def read_in_units(system: UnitSystem) -> AbstractContextManager[None]:
    """Return a context manager; while it is active, quantities are read in the units of ``system``."""
    return set_temporarily(_system, system)


def get_system() -> UnitSystem:
    """Return the unit system, linear or rotary, of the configuration that is being read."""
    return _system.get()


def read_rotary(value: Any = None) -> bool | None:
    """Validate the key ``rotary``; return True if the devices of the file are rotary, otherwise None."""
    if value is not None and not isinstance(value, bool):
        raise problem(f"got {describe(value)}", "it must be true or false", "remove it: the units determine the kind")
    if value is False and get_system().rotary:
        raise problem("got false", "other devices of the file are rotary, or have units of rotation", "write two files")
    return value or get_system().rotary or None


Rotary = Annotated[bool | None, PlainValidator(read_rotary, json_schema_input_type=bool)]


@dataclass(frozen=True)
class Quantity:
    """Annotation of a field that is a number with a unit and a range."""

    unit: str = "1"  # SI base unit, also the unit of plain numbers; "1" for a dimensionless number
    allowed: Range = ANY
    whole: bool = False  # True if the value must be a whole number
    periods: bool = False  # True for a duration in s or in sampling periods, which is read as a `Span`
    remedy: str = ""  # remedy to report for a number out of range
    turns: bool = True  # True if rotary devices have the corresponding unit of rotation, e.g. rad for m
    counts: bool = False  # True for an encoder step, which may also be given as "2000 counts"

    def read(self, value: Any) -> Any:
        """Validate a value of a configuration and return it in ``unit``, or as a `Span` if ``periods`` is true."""
        try:
            if self.periods:
                return read_span(value, self.allowed)
            if self.unit == "1":
                return self._read_number(value)
            unit = get_system()[self.unit] if self.turns else self.unit
            return read_quantity(value, DIMENSIONS[unit], self.allowed, counts=self.counts)[0]
        except UnusableValueError as error:
            raise problem(*error.parts) from None

    def read_alike(self) -> tuple[Entry, set[str]]:
        """Return a function that reads one value of an axis, and the set to which the function adds the value's unit.

        Only units of durations are added, because the durations of an axis must be all in seconds or all in periods.
        """
        units: set[str] = set()

        def entry(raw: Any) -> float:
            value, unit = self.read(raw)
            if units - {unit}:
                allowed = "the delays of an axis are all in seconds or all in periods"
                raise problem(f"got {describe(raw)}", allowed, f"write all of them in {next(iter(units))}")
            units.add(unit)
            return value

        return entry if self.periods else self.read, units

    def _read_number(self, value: Any) -> float:
        """Validate a dimensionless number; return an int if ``whole`` is true, otherwise a float."""
        if isinstance(value, int if self.whole else int | float) and not isinstance(value, bool):
            number = check_range(to_float(value), self.allowed, remedy=self.remedy)
            return value if self.whole else number
        example = f"whole number such as {max(self.allowed.low, 10):g}" if self.whole else "number such as 0.5"
        hint = f"write a {example}"
        if isinstance(value, float) and value.is_integer() and abs(value) < 1e15:
            hint = f"write {value:.0f}"
        elif isinstance(value, str):
            if looks_like_number(value):
                hint = "drop the quotes"
            elif value.lower() in _NOT_FINITE_TEXT:
                hint = "write a finite number"
            elif looks_like_number(value.split(" ")[0]):
                hint = "this field has no unit; write only the number"
        raise problem(f"got {describe(value)}", f"it must be {'a whole' if self.whole else 'one'} number", hint)

    @property
    def schema(self) -> dict[str, Any]:
        """JSON Schema of the value: its possible units, or the range of a dimensionless number."""
        if self.unit != "1":
            rotary = find_other(DIMENSIONS[self.unit]) if self.turns else None
            return describe_entry(self.unit, *(PERIOD_WORDS if self.periods else ()), *(rotary.units if rotary else ()))
        low, high, low_open, high_open = self.allowed
        ends = {"exclusiveMinimum" if low_open else "minimum": low}
        ends |= {"exclusiveMaximum" if high_open else "maximum": high}
        # Omit infinite bounds, which JSON cannot represent, and write whole numbers without a decimal point.
        ends = {key: int(end) if end % 1 == 0 else end for key, end in ends.items() if abs(end) < inf}
        return {"type": "integer" if self.whole else "number", **ends}

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        spelling = core_schema.to_string_ser_schema() if self.periods else None
        return core_schema.no_info_plain_validator_function(self.read, serialization=spelling)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return self.schema


def quantity_of(name: str) -> Quantity:
    """Return the unit and range of the named parameter, as the annotation of a field."""
    parameter = FIELDS[name]
    counts = name == "resolution"
    return Quantity(parameter.unit, parameter.allowed, parameter.whole, name == "delay", counts=counts)


Number = Annotated[float, Quantity()]
NonNegative = Annotated[float, Quantity(allowed=NOT_NEGATIVE)]
Fraction = Annotated[float, Quantity(allowed=FRACTION, remedy="write 75 % as 0.75")]
Delay = Annotated[Span, quantity_of("delay")]
Duration = Annotated[Span, Quantity("s", POSITIVE, periods=True)]


def share_schema(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema marked as shared, so that `config_json_schema` moves it to ``$defs`` under ``name``."""
    return {"allOf": [{"shared": re.sub(r"\W+", "_", name.replace("/", " per ")), **schema}]}


def describe_entry(unit: str, *more: str) -> dict[str, Any]:
    """Return the JSON Schema of a quantity: a number in an SI unit, or a text with a unit.

    The units of the text are those of the same dimension, and those in ``more``.
    """
    dimension = DIMENSIONS[unit]
    pattern = r"^\s*[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?\s*\S"
    description = f"A number in {unit}, or a number with one of the units {', '.join((*dimension.units, *more))}."
    forms = [{"type": "number"}, {"type": "string", "pattern": pattern}]
    name = f"number in {unit}{f' or {more[0]}' if more else ''}"
    return share_schema(name, {"description": description, "examples": [dimension.example], "anyOf": forms})


@dataclass(frozen=True)
class Axis:
    """The values of one quantity, without repetitions."""

    form: str  # form in the configuration: "number", "list", "linear" (equal steps) or "log" (equal ratios)
    entries: tuple[float, ...]  # the number, the entries of the list, or the first and the last value
    size: int  # number of values
    in_periods: bool = False  # True if the values are delays in sampling periods

    def values(self) -> np.ndarray:
        """Return all values as a float64 array of shape (size,)."""
        if self.form in _SPACINGS:
            return _SPACINGS[self.form](*self.entries, self.size)
        return np.array(self.entries, dtype=np.float64)

    def serialize(self) -> Any:
        """Return the number, list or mapping that represents the axis in a configuration file."""
        written = [f"{value!r} periods" if self.in_periods else value for value in self.entries]
        if self.form in _SPACINGS:
            return {self.form: {"start": written[0], "stop": written[1], "num": self.size}}
        return written if self.form == "list" else written[0]


def _read_end(raw: Any, info: ValidationInfo) -> float:
    """Return the first or last value of an axis, read by the function in the validation context."""
    return cast(Entry, info.context)(raw)


class _Spaced(Strict, noun="an axis of equal steps or ratios"):
    """First value, last value and number of values: the mapping below ``linear`` or ``log``."""

    start: Annotated[float, BeforeValidator(_read_end)]
    stop: Annotated[float, BeforeValidator(_read_end)]
    num: Annotated[int, Quantity(allowed=Range(2, LONGEST_AXIS), whole=True)]

    @classmethod
    def explain_missing(cls, name: str) -> tuple[str, str]:
        return f"{cls.noun} has start, stop and num", f"add {name!r}"

    def find_faults(self) -> Iterator[LocatedProblem]:
        start, stop, num = self.start, self.stop, self.num
        if start == stop:
            allowed = "start and stop must differ"
            yield ("stop",), problem(f"got {short(stop)}, equal to start", allowed, "write one number instead")
        elif not math.isfinite(stop - start):
            allowed = "the distance from start to stop must be finite"
            yield ("stop",), problem(f"got {short(stop)}", allowed, "bring the ends closer together")
        # Require steps larger than the rounding error of float64, because otherwise neighboring values may coincide.
        elif abs(stop - start) / (num - 1) <= 4 * np.spacing(max(abs(start), abs(stop))):
            yield ("num",), problem(f"got {num}", "the steps are below float64's resolution", "lower num")


_SPACINGS: dict[str, Callable[..., np.ndarray]] = {"linear": np.linspace, "log": np.geomspace}


def read_entries(raw: list[Any] | tuple[Any, ...], entry: Entry, *, distinct: bool = True) -> tuple[float, ...]:
    """Return the entries of a list, each read by ``entry``; raise one error with the problems of all entries.

    Args:
        raw: list of the configuration.
        entry: function that reads one value.
        distinct: True to refuse a list with equal entries.
    """
    if not raw:
        raise problem("got an empty list", "an axis has at least one value", "fill the list")
    problems = list(find_repeated(raw, "remove it")) if distinct else []
    entries = []
    for index, value in enumerate(raw):
        try:
            entries.append(entry(value))
        except PydanticCustomError as error:
            problems.append(((index,), error))
    if distinct and not problems:
        # Compare the numbers as well, because texts may differ although the values are equal ("1 ms" and 0.001).
        problems = list(find_repeated(entries, "remove it"))
    if problems:
        raise combine_problems("axis", problems)
    return tuple(entries)


@dataclass(frozen=True)
class AxisOf:
    """Annotation of a field that is an `Axis` of a quantity."""

    quantity: Quantity

    @property
    def _forms(self) -> dict[str, Quantity]:
        """Quantities that validate the ends of the forms ``linear`` and ``log``; those of ``log`` must be positive."""
        low, high, low_open, high_open = self.quantity.allowed
        positive = Range(max(low, 0.0), high, low_open or low <= 0.0, high_open)
        return {"linear": self.quantity, "log": replace(self.quantity, allowed=positive)}

    def read(self, raw: Any) -> Axis:
        """Validate an axis, written in any form (number, list, ``linear`` or ``log``), and return it."""
        if isinstance(raw, Axis):
            return raw
        form, ends = "number", raw
        if isinstance(raw, list | tuple):
            form = "list"
        elif isinstance(raw, dict):
            if len(raw) != 1:
                raise problem(f"got {describe(raw)}", f"an axis is {_FORMS}", "keep one of these forms")
            ((form, ends),) = raw.items()
            if form not in self._forms:
                remedy = suggestion(form, self._forms, "write one of these forms")
                unknown = problem("unknown key", f"an axis is {_FORMS}", remedy, on_key=True)
                raise combine_problems("axis", [((form,), unknown)])
        quantity = self._forms.get(form, self.quantity)
        read, units = quantity.read_alike()

        def entry(raw: Any) -> float:
            # Accept 5.0 as the whole number 5, because stores write the ends of a linear axis as floats.
            return read(int(raw) if quantity.whole and isinstance(raw, float) and raw.is_integer() else raw)

        if form in self._forms:
            try:
                spaced = _Spaced.model_validate(ends, context=entry)
            except ValidationError as error:
                raise combine_problems("axis", list_problems(error, form)) from None
            entries, size = (spaced.start, spaced.stop), spaced.num
        else:
            entries = read_entries(ends, entry) if form == "list" else (entry(ends),)
            size = len(entries)
        axis = Axis(form, entries, size, "periods" in units)
        fractional = [value for value in axis.values().tolist() if not value.is_integer()] if quantity.whole else []
        if fractional:
            allowed = "every value is a whole number"
            raise problem(f"got {short(fractional[0])} as one of the values", allowed, "change num, or write a list")
        return axis

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        spelling = core_schema.plain_serializer_function_ser_schema(lambda axis: axis.serialize())
        return core_schema.no_info_plain_validator_function(self.read, serialization=spelling)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        def mapping(**properties: dict[str, Any]) -> dict[str, Any]:
            required = list(properties)
            return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}

        count = {"type": "integer", "minimum": 2, "maximum": LONGEST_AXIS}
        ends = {form: quantity.schema for form, quantity in self._forms.items()}
        keyed = [mapping(**{form: mapping(start=end, stop=end, num=count)}) for form, end in ends.items()]
        entry, unit = self.quantity.schema, self.quantity.unit
        listed = {"type": "array", "items": entry, "minItems": 1, "uniqueItems": True}
        kind = f"of numbers {self.quantity.allowed}".strip() if unit == "1" else f"in {unit}"
        name = f"axis {kind}{' or periods' if self.quantity.periods else ''}"
        return share_schema(name, {"description": f"An axis: {_FORMS}.", "anyOf": [entry, listed, *keyed]})


def axis_of(name: str) -> AxisOf:
    """Return the annotation of a field that is an axis of the named parameter."""
    return AxisOf(quantity_of(name))


AnyAxis = Annotated[Axis, AxisOf(Quantity())]
DeltaAxis = Annotated[Axis, axis_of("delta")]
DelayAxis = Annotated[Axis, axis_of("d")]
