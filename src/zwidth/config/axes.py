"""Axes of a study: the values that one quantity takes.

An axis is written as one number, a list, ``{linear: {start, stop, num}}`` or ``{log: {start, stop, num}}``.
A new spelling is one more class here and one more entry in `_spellings`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, PlainValidator, ValidationError, WithJsonSchema, create_model
from pydantic_core import PydanticCustomError

from zwidth.config.faults import LocatedProblem, describe, problem, problems_of, short, suggestion, validation_error
from zwidth.config.fields import Strict, repeated
from zwidth.config.numbers import number, whole_number
from zwidth.quantities import ANY, MAX_DELAY_PERIODS, NOT_NEGATIVE, Range

LONGEST_AXIS = 10_000_000
"""More values than any result could use, few enough to be laid out in memory."""

"""A loop has as many poles as its delay has periods, and a few more."""

Entry: TypeAlias = Callable[[Any], float]
"""Reads one value of an axis, or raises a problem."""

_FORMS = "a number, a list of numbers, {linear: {start, stop, num}} or {log: {start, stop, num}}"


class Axis(ABC):
    """The values that one quantity takes; none of them twice."""

    @abstractmethod
    def values(self) -> np.ndarray:
        """The values as a one-dimensional float64 array."""

    @property
    @abstractmethod
    def size(self) -> int:
        """How many values there are, known without laying them out."""

    @property
    @abstractmethod
    def largest(self) -> float:
        """The largest of the values."""

    @abstractmethod
    def spelling(self) -> Any:
        """The axis as a configuration file writes it."""


@dataclass(frozen=True)
class PointAxis(Axis):
    """A single number."""

    value: float

    def values(self) -> np.ndarray:
        """The one value."""
        return np.array([self.value], dtype=np.float64)

    @property
    def size(self) -> int:
        """One."""
        return 1

    @property
    def largest(self) -> float:
        """The value itself."""
        return self.value

    def spelling(self) -> float:
        """The number."""
        return self.value


@dataclass(frozen=True)
class ListAxis(Axis):
    """Numbers in the order in which they are listed."""

    entries: tuple[float, ...]

    def values(self) -> np.ndarray:
        """The listed values."""
        return np.array(self.entries, dtype=np.float64)

    @property
    def size(self) -> int:
        """How many numbers are listed."""
        return len(self.entries)

    @property
    def largest(self) -> float:
        """The largest entry."""
        return max(self.entries)

    def spelling(self) -> list[float]:
        """The list."""
        return list(self.entries)


@dataclass(frozen=True)
class _SpacedAxis(Axis):
    """``num`` values from ``start`` to ``stop``, both included."""

    start: float
    stop: float
    num: int

    @property
    def size(self) -> int:
        """``num``."""
        return self.num

    @property
    def largest(self) -> float:
        """The larger end."""
        return max(self.start, self.stop)

    def _ends(self) -> dict[str, float | int]:
        return {"start": self.start, "stop": self.stop, "num": self.num}


class LinearAxis(_SpacedAxis):
    """Equal steps from ``start`` to ``stop``, both included."""

    def values(self) -> np.ndarray:
        """``num`` equally spaced values."""
        return np.linspace(self.start, self.stop, self.num)

    def spelling(self) -> dict[str, Any]:
        """``{linear: {start, stop, num}}``."""
        return {"linear": self._ends()}


class LogAxis(_SpacedAxis):
    """Equal ratios from ``start`` to ``stop``, both included."""

    def values(self) -> np.ndarray:
        """``num`` values in geometric progression."""
        return np.geomspace(self.start, self.stop, self.num)

    def spelling(self) -> dict[str, Any]:
        """``{log: {start, stop, num}}``."""
        return {"log": self._ends()}


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


def entries_of(raw: list[Any] | tuple[Any, ...], entry: Entry, *, distinct: bool = True) -> tuple[float, ...]:
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
    return axis_of(number(allowed), number(Range(0.0, allowed.high, low_open=True)))


def axis_of(entry: Entry, positive: Entry) -> Callable[[Any], Axis]:
    """A validator for an axis of what ``entry`` reads; ``positive`` reads the ends of equal ratios."""
    spellings: dict[str, tuple[type[_Spacing], type[_SpacedAxis]]] = {
        "linear": (_spacing_model("linear", entry), LinearAxis),
        "log": (_spacing_model("log", positive), LogAxis),
    }

    def validate(raw: Any) -> Axis:
        if isinstance(raw, Axis):
            return raw
        if isinstance(raw, list | tuple):
            return ListAxis(entries_of(raw, entry))
        if not isinstance(raw, dict):
            return PointAxis(entry(raw))
        if len(raw) != 1:
            raise problem(f"got {describe(raw)}", f"an axis is {_FORMS}", "keep one of these forms")
        ((key, ends),) = raw.items()
        if key not in spellings:
            unknown = problem(
                "unknown key",
                f"an axis is {_FORMS}",
                suggestion(key, spellings, "write one of these forms"),
                on_key=True,
            )
            raise validation_error("axis", [((key,), unknown)])
        model, kind = spellings[key]
        try:
            spaced = model.model_validate(ends)
        except ValidationError as error:
            found = [((key, *path), what) for path, what in problems_of(error)]
            raise validation_error("axis", found) from None
        return kind(**spaced.model_dump())

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

    def spaced(end: dict[str, Any]) -> dict[str, Any]:
        count = {"type": "integer", "minimum": 2, "maximum": LONGEST_AXIS}
        return {
            "type": "object",
            "properties": {"start": end, "stop": end, "num": count},
            "required": ["start", "stop", "num"],
            "additionalProperties": False,
        }

    keyed = [
        {"type": "object", "properties": {key: spec}, "required": [key], "additionalProperties": False}
        for key, spec in (("linear", spaced(entry)), ("log", spaced(positive)))
    ]
    listed = {"type": "array", "items": entry, "minItems": 1, "uniqueItems": True}
    return WithJsonSchema({"description": f"An axis: {_FORMS}.", "anyOf": [entry, listed, *keyed]})


_SPELLED = PlainSerializer(lambda value: value.spelling(), return_type=Any)
_DELAYS = Range(0.0, MAX_DELAY_PERIODS)

AnyAxis = Annotated[Axis, PlainValidator(axis()), _SPELLED, _schema(ANY)]
DeltaAxis = Annotated[Axis, PlainValidator(axis(NOT_NEGATIVE)), _SPELLED, _schema(NOT_NEGATIVE)]
DelayAxis = Annotated[Axis, PlainValidator(axis(_DELAYS)), _SPELLED, _schema(_DELAYS)]
