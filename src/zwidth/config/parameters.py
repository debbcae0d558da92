"""The parameters of `zwidth.quantities` as values and axes of a configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import PlainSerializer, PlainValidator, WithJsonSchema

from zwidth.config.axes import Axis, Entry, axis_of, axis_schema
from zwidth.config.faults import describe, problem
from zwidth.config.fields import unit_schema
from zwidth.config.units import DAMPING, MASS, RATE, STIFFNESS, TIME, Dimension, dimension_of, entry_of, quantity, span
from zwidth.quantities import NOT_NEGATIVE, PARAMETERS, POSITIVE, Range


@dataclass(frozen=True)
class DelayValues(Axis):
    """An axis of delays, all in seconds or all in sampling periods."""

    axis: Axis
    unit: str

    def values(self) -> np.ndarray:
        """The delays in ``unit``."""
        return self.axis.values()

    @property
    def size(self) -> int:
        """How many delays there are."""
        return self.axis.size

    @property
    def largest(self) -> float:
        """The longest delay."""
        return self.axis.largest

    def spelling(self) -> Any:
        """The axis as a configuration file writes it."""
        return _with_unit(self.axis.spelling(), self.unit)


def _with_unit(spelling: Any, unit: str) -> Any:
    """The numbers of a spelling followed by a unit; seconds are meant where none is written."""
    if unit == "s" or isinstance(spelling, int):
        return spelling
    if isinstance(spelling, dict):
        return {key: _with_unit(value, unit) for key, value in spelling.items()}
    if isinstance(spelling, list):
        return [_with_unit(value, unit) for value in spelling]
    return f"{spelling!r} {unit}"


def delay_entries() -> tuple[Entry, Entry, Callable[[], str]]:
    """Validators for delays, for delays > 0, and what tells the unit that all of them were written in."""
    units: dict[str, None] = {}

    def reader(allowed: Range) -> Entry:
        read = span(allowed)

        def entry(raw: Any) -> float:
            value, unit = read(raw)
            units.setdefault(unit)
            if len(units) > 1:
                remedy = f"write all of them in {next(iter(units))}"
                raise problem(
                    f"got {describe(raw)}", "the delays of an axis are all in seconds or all in periods", remedy
                )
            return value

        return entry

    return reader(NOT_NEGATIVE), reader(POSITIVE), lambda: next(iter(units), "s")


def _delays(raw: Any) -> DelayValues:
    if isinstance(raw, DelayValues):
        return raw
    entry, positive, unit = delay_entries()
    axis = axis_of(entry, positive)(raw)
    return DelayValues(axis, unit())


def _reader(name: str) -> Callable[[Any], Axis]:
    """A validator for an axis of a parameter in SI units."""
    allowed = PARAMETERS[name].allowed
    low = max(allowed.low, 0.0)
    positive = Range(low, allowed.high, low_open=low == 0.0)
    return axis_of(entry_of(name), quantity(dimension_of(PARAMETERS[name].unit), positive))


def _schema(dimension: Dimension, *more: str) -> WithJsonSchema:
    entry = unit_schema(dimension, *more).json_schema
    assert entry is not None, "a schema for validation is given"
    return axis_schema(entry, entry)


SPELLED = PlainSerializer(lambda value: value.spelling(), return_type=Any)

PeriodAxis = Annotated[Axis, PlainValidator(_reader("period")), SPELLED, _schema(TIME)]
RateAxis = Annotated[Axis, PlainValidator(_reader("rate")), SPELLED, _schema(RATE)]
MassAxis = Annotated[Axis, PlainValidator(_reader("mass")), SPELLED, _schema(MASS)]
DampingAxis = Annotated[Axis, PlainValidator(_reader("damping")), SPELLED, _schema(DAMPING)]
StiffnessAxis = Annotated[Axis, PlainValidator(_reader("stiffness")), SPELLED, _schema(STIFFNESS)]
VirtualDampingAxis = Annotated[Axis, PlainValidator(_reader("virtual_damping")), SPELLED, _schema(DAMPING)]
TimeAxis = Annotated[DelayValues, PlainValidator(_delays), SPELLED, _schema(TIME, "periods", "period")]
