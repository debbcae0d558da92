"""The parameters of `words.quantities` as values and axes of a configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

from pydantic import PlainValidator, WithJsonSchema

from zwidth.config.axes import SPELLED, Axis, Entry, axis_schema, make_axis_reader
from zwidth.config.faults import problem
from zwidth.config.fields import unit_schema
from zwidth.config.units import make_entry_reader, quantity, span
from zwidth.words.formatting import describe, short
from zwidth.words.quantities import NOT_NEGATIVE, OF_PARTS, PARAMETERS, POSITIVE, Range
from zwidth.words.units import DAMPING, MASS, RATE, STIFFNESS, TIME, Dimension, find_dimension


def make_delay_readers() -> tuple[Entry, Entry, Callable[[], bool]]:
    """Validators for delays, for delays > 0, and what tells whether all of them were written in sampling periods."""
    units: dict[str, None] = {}

    def reader(allowed: Range) -> Entry:
        read = span(allowed)

        def entry(raw: Any) -> float:
            value, unit = read(raw)
            units.setdefault(unit)
            if len(units) > 1:
                allowed = "the delays of an axis are all in seconds or all in periods"
                raise problem(f"got {describe(raw)}", allowed, f"write all of them in {next(iter(units))}")
            return value

        return entry

    return reader(NOT_NEGATIVE), reader(POSITIVE), lambda: "periods" in units


def _delays(raw: Any) -> Axis:
    entry, positive, in_periods = make_delay_readers()
    return raw if isinstance(raw, Axis) else replace(make_axis_reader(entry, positive)(raw), in_periods=in_periods())


def _reader(name: str) -> Callable[[Any], Axis]:
    """A validator for an axis of a parameter in SI units."""
    parameter, allowed = PARAMETERS[name], PARAMETERS[name].allowed
    if parameter.whole:
        entry = _accept_whole_floats(make_entry_reader(name))
        return _whole_axis(make_axis_reader(entry, entry))
    low = max(allowed.low, 0.0)
    positive = Range(low, allowed.high, low_open=low == 0.0)
    return make_axis_reader(make_entry_reader(name), quantity(find_dimension(parameter.unit), positive))


def _accept_whole_floats(entry: Entry) -> Entry:
    """A validator that takes 5.0 for 5, as a store spells the ends of equal steps."""
    return lambda raw: entry(int(raw) if isinstance(raw, float) and raw.is_integer() else raw)


def _whole_axis(read: Callable[[Any], Axis]) -> Callable[[Any], Axis]:
    """A validator for an axis of whole numbers, which equal steps or ratios may miss."""

    def validate(raw: Any) -> Axis:
        axis = read(raw)
        missed = [value for value in axis.values().tolist() if not value.is_integer()]
        if missed:
            allowed = "every value is a whole number"
            raise problem(f"got {short(missed[0])} as one of the steps", allowed, "change num, or write a list")
        return axis

    return validate


def _schema(dimension: Dimension, *more: str) -> WithJsonSchema:
    entry = unit_schema(dimension, *more).json_schema
    assert entry is not None, "a schema for validation is given"
    return axis_schema(entry, entry)


PeriodAxis = Annotated[Axis, PlainValidator(_reader("period")), SPELLED, _schema(TIME)]
RateAxis = Annotated[Axis, PlainValidator(_reader("rate")), SPELLED, _schema(RATE)]
MassAxis = Annotated[Axis, PlainValidator(_reader("mass")), SPELLED, _schema(MASS)]
DampingAxis = Annotated[Axis, PlainValidator(_reader("damping")), SPELLED, _schema(DAMPING)]
StiffnessAxis = Annotated[Axis, PlainValidator(_reader("stiffness")), SPELLED, _schema(STIFFNESS)]
VirtualDampingAxis = Annotated[Axis, PlainValidator(_reader("virtual_damping")), SPELLED, _schema(DAMPING)]
TimeAxis = Annotated[Axis, PlainValidator(_delays), SPELLED, _schema(TIME, "periods", "period")]


def _schema_of(name: str) -> WithJsonSchema:
    parameter = PARAMETERS[name]
    if not parameter.whole:
        return _schema(find_dimension(parameter.unit))
    entry = {"type": "integer", "minimum": int(parameter.allowed.low), "maximum": int(parameter.allowed.high)}
    return axis_schema(entry, entry)


CutoffAxis = Annotated[Axis, PlainValidator(_reader("velocity.cutoff")), SPELLED, _schema_of("velocity.cutoff")]
WindowAxis = Annotated[Axis, PlainValidator(_reader("velocity.samples")), SPELLED, _schema_of("velocity.samples")]
# Of the parameters of parts, by path.
PART_AXES: dict[str, Any] = {
    name: Annotated[Axis, PlainValidator(_reader(name)), SPELLED, _schema_of(name)] for name in OF_PARTS
}
