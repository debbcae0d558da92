"""Validators for quantities, which `words.units` reads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from zwidth.config.faults import raise_problems
from zwidth.config.numbers import number, whole_number
from zwidth.parts.span import Span, read_span
from zwidth.words.quantities import ANY, PARAMETERS, Range
from zwidth.words.units import Dimension, find_dimension, read_quantity


def quantity(dimension: Dimension, allowed: Range = ANY) -> Callable[[Any], float]:
    """A validator for a quantity; its value is in the SI base unit."""
    return raise_problems(lambda value: read_quantity(value, dimension, allowed)[0])


def span(allowed: Range) -> Callable[[Any], Span]:
    return raise_problems(lambda value: read_span(value, allowed))


def make_entry_reader(name: str) -> Callable[[Any], float]:
    """A validator for one value of a parameter."""
    parameter = PARAMETERS[name]
    if parameter.unit == "1":
        return whole_number(parameter.allowed) if parameter.whole else number(parameter.allowed)
    return quantity(find_dimension(parameter.unit), parameter.allowed)
