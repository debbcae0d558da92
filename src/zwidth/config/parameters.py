"""The parameters of `words.quantities` as axes of a configuration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pydantic import PlainValidator

from zwidth.config.axes import SPELLED, Axis, Entry, axis_schema, make_axis_reader, number_axis
from zwidth.config.faults import problem
from zwidth.config.fields import describe_entry
from zwidth.config.units import make_entry_reader, quantity, span
from zwidth.words.formatting import describe, short
from zwidth.words.quantities import NOT_NEGATIVE, PARAMETERS, POSITIVE, Range
from zwidth.words.units import PERIOD_WORDS, find_dimension


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


def quantity_axis(unit: str, allowed: Range) -> tuple[Any, ...]:
    """What makes an `Axis` one of a quantity: its validator, its spelling and its schema."""
    low = max(allowed.low, 0.0)
    positive = Range(low, allowed.high, low_open=low == 0.0)
    read = [quantity(find_dimension(unit), ends) for ends in (allowed, positive)]
    return PlainValidator(make_axis_reader(*read)), SPELLED, axis_schema(*2 * (describe_entry(unit),))


def parameter_axis(name: str) -> tuple[Any, ...]:
    """The same of a parameter."""
    parameter, allowed = PARAMETERS[name], PARAMETERS[name].allowed
    if name == "delay":
        entry = describe_entry(parameter.unit, *PERIOD_WORDS)
        return PlainValidator(_delays), SPELLED, axis_schema(entry, entry)
    if not parameter.whole:
        return number_axis(allowed) if parameter.unit == "1" else quantity_axis(parameter.unit, allowed)
    entry = {"type": "integer", "minimum": int(allowed.low), "maximum": int(allowed.high)}
    reader = _accept_whole_floats(make_entry_reader(name))
    return PlainValidator(_whole_axis(make_axis_reader(reader, reader))), SPELLED, axis_schema(entry, entry)
