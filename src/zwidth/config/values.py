"""Single values of a configuration: numbers, whole numbers, quantities with a unit, and lengths of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from zwidth.config.faults import problem, raise_problems
from zwidth.parts.checks import Span, read_span
from zwidth.words.formatting import describe
from zwidth.words.quantities import ANY, FRACTION, NOT_NEGATIVE, PARAMETERS, POSITIVE, Range
from zwidth.words.units import PERIOD_WORDS, check_range, find_dimension, looks_like_number, read_quantity, to_float

_NOT_FINITE_TEXT = {"nan", "inf", "+inf", "-inf", "infinity"}


def _number(allowed: Range, remedy: str) -> Callable[[Any], float]:
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


def _whole_number(allowed: Range) -> Callable[[Any], int]:
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


@dataclass(frozen=True)
class Quantity:
    """Makes a field a number of a unit and a range: read, checked, and described in the schema.

    Attributes:
        unit: the SI base unit, in which a number alone is; "1" for a number without one.
        allowed: the admissible values.
        whole: whether they are whole numbers.
        periods: whether it is a length of time, in s or in sampling periods: a `Span`.
        remedy: what helps where another number is given.
    """

    unit: str = "1"
    allowed: Range = ANY
    whole: bool = False
    periods: bool = False
    remedy: str = ""

    @cached_property
    def read(self) -> Callable[[Any], Any]:
        """What reads a value, or raises a problem."""
        if self.periods:
            return raise_problems(lambda value: read_span(value, self.allowed))
        if self.unit == "1":
            return _whole_number(self.allowed) if self.whole else _number(self.allowed, self.remedy)
        dimension = find_dimension(self.unit)
        return raise_problems(lambda value: read_quantity(value, dimension, self.allowed)[0])

    @property
    def schema(self) -> dict[str, Any]:
        """Its JSON Schema."""
        if self.unit != "1":
            return describe_entry(self.unit, *(PERIOD_WORDS if self.periods else ()))
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
    """That of a parameter."""
    parameter = PARAMETERS[name]
    return Quantity(parameter.unit, parameter.allowed, parameter.whole, name == "delay")


Number = Annotated[float, Quantity()]
NonNegative = Annotated[float, Quantity(allowed=NOT_NEGATIVE)]
Fraction = Annotated[float, Quantity(allowed=FRACTION, remedy="write 75 % as 0.75")]
Delay = Annotated[Span, quantity_of("delay")]
Duration = Annotated[Span, Quantity("s", POSITIVE, periods=True)]


def describe_entry(unit: str, *more: str) -> dict[str, Any]:
    """The JSON Schema of a number in an SI unit, or with one of the units beside it."""
    dimension = find_dimension(unit)
    pattern = r"^\s*[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?\s*\S"
    return {
        "description": f"A number in {unit}, or a number with one of the units {', '.join((*dimension.units, *more))}.",
        "examples": [dimension.example],
        "anyOf": [{"type": "number"}, {"type": "string", "pattern": pattern}],
    }
