"""The parameters that a sweep can vary, each described once: for the reader of the file, the store and the docs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import PlainSerializer, PlainValidator, WithJsonSchema

from zwidth.config.axes import MAX_DELAY_PERIODS, Axis, Entry, axis_of, axis_schema
from zwidth.config.faults import describe, problem
from zwidth.config.fields import ANY, NOT_NEGATIVE, POSITIVE, Range, number
from zwidth.config.scenes import PERIODS, RATES
from zwidth.config.units import (
    DAMPING,
    MASS,
    RATE,
    STIFFNESS,
    TIME,
    Dimension,
    quantity,
    span,
    unit_schema,
)


@dataclass(frozen=True)
class Parameter:
    """One quantity of the loop as a sweep knows it.

    Args:
        name: its name in files and stores.
        long_name: what it is, for people.
        dimension: its units; None for a normalized quantity.
        allowed: its admissible values, in the base unit.
    """

    name: str
    long_name: str
    dimension: Dimension | None
    allowed: Range

    @property
    def units(self) -> str:
        """The unit that the store states."""
        return "1" if self.dimension is None else self.dimension.base

    def entry(self) -> Entry:
        """A validator for one value."""
        return number(self.allowed) if self.dimension is None else quantity(self.dimension, self.allowed)


# In the order of a store's dimensions: a plane of walls lies together, at the end.
_ALL = (
    Parameter("period", "sampling period T", TIME, PERIODS),
    Parameter("rate", "sampling rate 1/T", RATE, RATES),
    Parameter("delay", "delay t_d from a sample to the moment its force acts", TIME, NOT_NEGATIVE),
    Parameter("mass", "mass m of the device", MASS, POSITIVE),
    Parameter("damping", "physical damping b of the device", DAMPING, NOT_NEGATIVE),
    Parameter("d", "delay in sampling periods, t_d/T", None, Range(0.0, MAX_DELAY_PERIODS)),
    Parameter("delta", "normalized damping of the device, b T/m", None, NOT_NEGATIVE),
    Parameter("stiffness", "stiffness K of the virtual wall", STIFFNESS, ANY),
    Parameter("alpha", "normalized stiffness of the virtual wall, K T^2/m", None, ANY),
    Parameter("virtual_damping", "damping B of the virtual wall", DAMPING, ANY),
    Parameter("beta", "normalized damping of the virtual wall, B T/m", None, ANY),
)
PARAMETERS = {parameter.name: parameter for parameter in _ALL}

NORMALIZED = ("alpha", "beta", "delta", "d")
PHYSICAL = tuple(name for name in PARAMETERS if name not in NORMALIZED)
WALL = ("alpha", "beta", "stiffness", "virtual_damping")


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
    parameter = PARAMETERS[name]
    dimension, allowed = parameter.dimension, parameter.allowed
    assert dimension is not None, "a normalized parameter has an annotation already"
    low = max(allowed.low, 0.0)
    return axis_of(parameter.entry(), quantity(dimension, Range(low, allowed.high, low_open=low == 0.0)))


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
