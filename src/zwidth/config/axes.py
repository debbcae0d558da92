"""Axes of a study: the values that one quantity takes.

An axis is written as one number, a list, ``{linear: {start, stop, num}}`` or ``{log: {start, stop, num}}``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import (
    BeforeValidator,
    PlainSerializer,
    PlainValidator,
    ValidationError,
    WithJsonSchema,
    create_model,
)
from pydantic_core import PydanticCustomError

from zwidth.config.faults import LocatedProblem, problem, problems_of, validation_error
from zwidth.config.fields import Strict, repeated
from zwidth.config.numbers import number, whole_number
from zwidth.words.formatting import describe, short, suggestion
from zwidth.words.quantities import ANY, NOT_NEGATIVE, PARAMETERS, Range

LONGEST_AXIS = 10_000_000
"""More values than any result could use, few enough to be laid out in memory."""

Entry: TypeAlias = Callable[[Any], float]
"""Reads one value of an axis, or raises a problem."""

_FORMS = "a number, a list of numbers, {linear: {start, stop, num}} or {log: {start, stop, num}}"
_SPACINGS = {"linear": np.linspace, "log": np.geomspace}


@dataclass(frozen=True)
class Axis:
    """The values that one quantity takes; none of them twice."""

    form: str  # how it is written: "number", "list", "linear" (equal steps) or "log" (equal ratios)
    entries: tuple[float, ...]  # the number, the numbers of the list in its order, or the two ends, both included
    size: int  # how many values there are, known without laying them out
    in_periods: bool = False  # whether the values are delays in sampling periods

    def values(self) -> np.ndarray:
        """The values as a one-dimensional float64 array."""
        if self.form in _SPACINGS:
            return _SPACINGS[self.form](*self.entries, self.size)
        return np.array(self.entries, dtype=np.float64)

    @property
    def largest(self) -> float:
        """The largest of the values."""
        return max(self.entries)

    def spelling(self) -> Any:
        """The axis as a configuration file writes it."""
        written = [f"{value!r} periods" if self.in_periods else value for value in self.entries]
        if self.form in _SPACINGS:
            return {self.form: {"start": written[0], "stop": written[1], "num": self.size}}
        return written if self.form == "list" else written[0]


class _Spacing(Strict):
    """Base of the mappings below ``linear`` and ``log``."""

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        return "an axis of equal steps or ratios has start, stop and num", f"add {name!r}"

    def limits(self) -> list[LocatedProblem]:
        start, stop, num = (getattr(self, name) for name in ("start", "stop", "num"))
        if start == stop:
            where = "start and stop must differ"
            return [(("stop",), problem(f"got {short(stop)}, as start", where, "write a number alone"))]
        if not math.isfinite(stop - start):
            allowed = "the distance from start to stop must be finite"
            return [(("stop",), problem(f"got {short(stop)}", allowed, "bring the ends closer together"))]
        # Neighbors must differ in float64, or the axis would hold one value twice.
        if num > 1 and abs(stop - start) / (num - 1) <= 4 * np.spacing(max(abs(start), abs(stop))):
            return [(("num",), problem(f"got {num}", "the steps are below float64's resolution", "lower num"))]
        return []


def _spacing_model(name: str, entry: Entry) -> type[_Spacing]:
    """The mapping below ``linear`` or ``log`` for ends that ``entry`` reads."""
    end = Annotated[float, BeforeValidator(entry)]
    count = Annotated[int, BeforeValidator(whole_number(Range(2, LONGEST_AXIS)))]
    model = create_model(name, __base__=_Spacing, start=(end, ...), stop=(end, ...), num=(count, ...))
    model.what = f"an axis with {name!r}"
    return model


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


def axis(allowed: Range = ANY) -> Callable[[Any], Axis]:
    """A validator for an axis whose values lie in a given range."""
    # Equal ratios need values of one sign; a log axis of negative numbers has no use here.
    return make_axis_reader(number(allowed), number(Range(0.0, allowed.high, low_open=True)))


def make_axis_reader(entry: Entry, positive: Entry) -> Callable[[Any], Axis]:
    """A validator for an axis of what ``entry`` reads; ``positive`` reads the ends of equal ratios."""
    models = {"linear": _spacing_model("linear", entry), "log": _spacing_model("log", positive)}

    def validate(raw: Any) -> Axis:
        if isinstance(raw, Axis):
            return raw
        if isinstance(raw, list | tuple):
            return Axis("list", read_entries(raw, entry), len(raw))
        if not isinstance(raw, dict):
            return Axis("number", (entry(raw),), 1)
        if len(raw) != 1:
            raise problem(f"got {describe(raw)}", f"an axis is {_FORMS}", "keep one of these forms")
        ((form, ends),) = raw.items()
        if form not in models:
            remedy = suggestion(form, models, "write one of these forms")
            unknown = problem("unknown key", f"an axis is {_FORMS}", remedy, on_key=True)
            raise validation_error("axis", [((form,), unknown)])
        try:
            spaced: Any = models[form].model_validate(ends)
        except ValidationError as error:
            raise validation_error("axis", problems_of(error, form)) from None
        return Axis(form, (spaced.start, spaced.stop), spaced.num)

    return validate


def _schema(allowed: Range) -> WithJsonSchema:
    entry: dict[str, Any] = {"type": "number"}
    if allowed.low == 0.0:
        entry["minimum"] = 0
    if allowed.high < np.inf:
        entry["maximum"] = allowed.high
    positive = {**{key: entry[key] for key in entry if key != "minimum"}, "exclusiveMinimum": 0}
    return axis_schema(entry, positive)


def axis_schema(entry: dict[str, Any], positive: dict[str, Any]) -> WithJsonSchema:
    """The JSON Schema of an axis, from those of an entry and of the end of a log axis."""

    def mapping(**properties: dict[str, Any]) -> dict[str, Any]:
        required = list(properties)
        return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}

    count = {"type": "integer", "minimum": 2, "maximum": LONGEST_AXIS}
    keyed = [
        mapping(**{form: mapping(start=end, stop=end, num=count)})
        for form, end in (("linear", entry), ("log", positive))
    ]
    listed = {"type": "array", "items": entry, "minItems": 1, "uniqueItems": True}
    return WithJsonSchema({"description": f"An axis: {_FORMS}.", "anyOf": [entry, listed, *keyed]})


SPELLED = PlainSerializer(lambda value: value.spelling(), return_type=Any)


def number_axis(allowed: Range) -> tuple[Any, ...]:
    """What makes an `Axis` one of plain numbers: its validator, its spelling and its schema."""
    return PlainValidator(axis(allowed)), SPELLED, _schema(allowed)


AnyAxis = Annotated[Axis, *number_axis(ANY)]
DeltaAxis = Annotated[Axis, *number_axis(NOT_NEGATIVE)]
DelayAxis = Annotated[Axis, *number_axis(PARAMETERS["d"].allowed)]
