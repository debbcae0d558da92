"""Values of a configuration: numbers, quantities with a unit, lengths of time, and axes.

An axis is written as one number, a list, ``{linear: {start, stop, num}}`` or ``{log: {start, stop, num}}``.
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
from pydantic import BeforeValidator, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError, ValidationInfo
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from zwidth.config.fields import LocatedProblem, Strict, problem, problems_of, repeated, validation_error
from zwidth.parts.checks import Span, read_span
from zwidth.words.contexts import set_temporarily
from zwidth.words.errors import UnusableValueError
from zwidth.words.formatting import describe, short, suggestion
from zwidth.words.quantities import ANY, FIELDS, FRACTION, NOT_NEGATIVE, POSITIVE, Range
from zwidth.words.unit_system import LINEAR, UnitSystem
from zwidth.words.units import (
    DIMENSIONS,
    PERIOD_WORDS,
    check_range,
    find_other,
    looks_like_number,
    read_quantity,
    to_float,
)

_NOT_FINITE_TEXT = {"nan", "inf", "+inf", "-inf", "infinity"}
LONGEST_AXIS = 10_000_000
"""More values than any result could use, few enough to be laid out in memory."""

Entry: TypeAlias = Callable[[Any], float]
"""Reads one value of an axis, or raises a problem."""

_FORMS = "a number, a list of numbers, {linear: {start, stop, num}} or {log: {start, stop, num}}"

# A context variable, because a value may have no unit: other values of the file determine the kind of device.
_system: ContextVar[UnitSystem] = ContextVar("system", default=LINEAR)


def read_in_units(system: UnitSystem) -> AbstractContextManager[None]:
    """Return a context manager in which values of a configuration are read in a unit system."""
    return set_temporarily(_system, system)


def get_system() -> UnitSystem:
    """Return the unit system of the configuration that is being read."""
    return _system.get()


@dataclass(frozen=True)
class Quantity:
    """Makes a field a number of a unit and a range: read, checked, and described in the schema."""

    unit: str = "1"  # the SI base unit, in which a number alone is; "1" for a number without one
    allowed: Range = ANY
    whole: bool = False  # whether the admissible values are whole numbers
    periods: bool = False  # whether it is a length of time, in s or in sampling periods: a `Span`
    remedy: str = ""  # what helps where another number is given
    turns: bool = True  # whether it is an angle, a torque, ... where the device is rotary
    counts: bool = False  # the quantity is an encoder step, which may also be given as "2000 counts"

    def read(self, value: Any) -> Any:
        """A value of a configuration in the unit."""
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
        """What reads several values, lengths of time all in seconds or all in periods; and the unit of those read."""
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
        """A number without a unit."""
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
                hint = "this field has no unit; write the number alone"
        raise problem(f"got {describe(value)}", f"it must be {'a whole' if self.whole else 'one'} number", hint)

    @property
    def schema(self) -> dict[str, Any]:
        if self.unit != "1":
            other = find_other(DIMENSIONS[self.unit]) if self.turns else None
            return describe_entry(self.unit, *(PERIOD_WORDS if self.periods else ()), *(other.units if other else ()))
        low, high, low_open, high_open = self.allowed
        ends = {"exclusiveMinimum" if low_open else "minimum": low}
        ends |= {"exclusiveMaximum" if high_open else "maximum": high}
        # JSON has no infinity, and needs no point in a whole number.
        ends = {key: int(end) if end % 1 == 0 else end for key, end in ends.items() if abs(end) < inf}
        return {"type": "integer" if self.whole else "number", **ends}

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        spelling = core_schema.to_string_ser_schema() if self.periods else None
        return core_schema.no_info_plain_validator_function(self.read, serialization=spelling)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return self.schema


def quantity_of(name: str) -> Quantity:
    parameter = FIELDS[name]
    counts = name == "resolution"
    return Quantity(parameter.unit, parameter.allowed, parameter.whole, name == "delay", counts=counts)


Number = Annotated[float, Quantity()]
NonNegative = Annotated[float, Quantity(allowed=NOT_NEGATIVE)]
Fraction = Annotated[float, Quantity(allowed=FRACTION, remedy="write 75 % as 0.75")]
Delay = Annotated[Span, quantity_of("delay")]
Duration = Annotated[Span, Quantity("s", POSITIVE, periods=True)]


def share(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    """A part of the JSON Schema that `zwidth.studies.document.config_json_schema` writes once, under this name."""
    return {"allOf": [{"shared": re.sub(r"\W+", "_", name.replace("/", " per ")), **schema}]}


def describe_entry(unit: str, *more: str) -> dict[str, Any]:
    """The JSON Schema of a number in an SI unit, or with one of the units beside it."""
    dimension = DIMENSIONS[unit]
    pattern = r"^\s*[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?\s*\S"
    words = f"A number in {unit}, or a number with one of the units {', '.join((*dimension.units, *more))}."
    forms = [{"type": "number"}, {"type": "string", "pattern": pattern}]
    name = f"number in {unit}{f' or {more[0]}' if more else ''}"
    return share(name, {"description": words, "examples": [dimension.example], "anyOf": forms})


@dataclass(frozen=True)
class Axis:
    """The values that one quantity takes; none of them twice."""

    form: str  # how it is written: "number", "list", "linear" (equal steps) or "log" (equal ratios)
    entries: tuple[float, ...]  # the number, the numbers of the list in its order, or the two ends, both included
    size: int  # how many values there are, known without laying them out
    in_periods: bool = False  # whether the values are delays in sampling periods

    def values(self) -> np.ndarray:
        if self.form in _SPACINGS:
            return _SPACINGS[self.form](*self.entries, self.size)
        return np.array(self.entries, dtype=np.float64)

    def spelling(self) -> Any:
        """The axis as a configuration file writes it."""
        written = [f"{value!r} periods" if self.in_periods else value for value in self.entries]
        if self.form in _SPACINGS:
            return {self.form: {"start": written[0], "stop": written[1], "num": self.size}}
        return written if self.form == "list" else written[0]


def _read_end(raw: Any, info: ValidationInfo) -> float:
    """An end of an axis, as what is swept reads it."""
    return cast(Entry, info.context)(raw)


class _Spaced(Strict, what="an axis of equal steps or ratios"):
    """The mapping below ``linear`` or ``log``."""

    start: Annotated[float, BeforeValidator(_read_end)]
    stop: Annotated[float, BeforeValidator(_read_end)]
    num: Annotated[int, Quantity(allowed=Range(2, LONGEST_AXIS), whole=True)]

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        return f"{cls.what} has start, stop and num", f"add {name!r}"

    def limits(self) -> Iterator[LocatedProblem]:
        start, stop, num = self.start, self.stop, self.num
        if start == stop:
            where = "start and stop must differ"
            yield ("stop",), problem(f"got {short(stop)}, as start", where, "write a number alone")
        elif not math.isfinite(stop - start):
            allowed = "the distance from start to stop must be finite"
            yield ("stop",), problem(f"got {short(stop)}", allowed, "bring the ends closer together")
        # Neighbors must differ in float64, or the axis would hold one value twice.
        elif abs(stop - start) / (num - 1) <= 4 * np.spacing(max(abs(start), abs(stop))):
            yield ("num",), problem(f"got {num}", "the steps are below float64's resolution", "lower num")


_SPACINGS: dict[str, Callable[..., np.ndarray]] = {"linear": np.linspace, "log": np.geomspace}


def read_entries(raw: list[Any] | tuple[Any, ...], entry: Entry, *, distinct: bool = True) -> tuple[float, ...]:
    """The entries of a list, each read by ``entry``; all faults are reported with their positions."""
    if not raw:
        raise problem("got an empty list", "an axis has at least one value", "fill the list")
    found = list(repeated(raw, "remove it")) if distinct else []
    entries = []
    for index, value in enumerate(raw):
        try:
            entries.append(entry(value))
        except PydanticCustomError as error:
            found.append(((index,), error))
    if distinct and not found:
        # Two spellings of one value, as 1 ms and 0.001.
        found = list(repeated(entries, "remove it"))
    if found:
        raise validation_error("axis", found)
    return tuple(entries)


@dataclass(frozen=True)
class AxisOf:
    """Makes an `Axis` one of a quantity: read, checked, spelled and described in the schema."""

    quantity: Quantity

    @property
    def _forms(self) -> dict[str, Quantity]:
        """What the ends of equal steps and of equal ratios are: those need values of one sign."""
        low, high, low_open, high_open = self.quantity.allowed
        positive = Range(max(low, 0.0), high, low_open or low <= 0.0, high_open)
        return {"linear": self.quantity, "log": replace(self.quantity, allowed=positive)}

    def read(self, raw: Any) -> Axis:
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
                raise validation_error("axis", [((form,), unknown)])
        quantity = self._forms.get(form, self.quantity)
        read, units = quantity.read_alike()

        def entry(raw: Any) -> float:
            # 5.0 is 5, as a store spells the ends of equal steps.
            return read(int(raw) if quantity.whole and isinstance(raw, float) and raw.is_integer() else raw)

        if form in self._forms:
            try:
                spaced = _Spaced.model_validate(ends, context=entry)
            except ValidationError as error:
                raise validation_error("axis", problems_of(error, form)) from None
            entries, size = (spaced.start, spaced.stop), spaced.num
        else:
            entries = read_entries(ends, entry) if form == "list" else (entry(ends),)
            size = len(entries)
        axis = Axis(form, entries, size, "periods" in units)
        missed = [value for value in axis.values().tolist() if not value.is_integer()] if quantity.whole else []
        if missed:
            allowed = "every value is a whole number"
            raise problem(f"got {short(missed[0])} as one of the steps", allowed, "change num, or write a list")
        return axis

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        spelling = core_schema.plain_serializer_function_ser_schema(lambda axis: axis.spelling())
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
        return share(name, {"description": f"An axis: {_FORMS}.", "anyOf": [entry, listed, *keyed]})


def axis_of(name: str) -> AxisOf:
    return AxisOf(quantity_of(name))


AnyAxis = Annotated[Axis, AxisOf(Quantity())]
DeltaAxis = Annotated[Axis, axis_of("delta")]
DelayAxis = Annotated[Axis, axis_of("d")]
