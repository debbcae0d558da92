"""Faults of a configuration: what is wrong, where, what is allowed and what to do about it.

A validator knows what is wrong but not where its value stands in the file. It raises a `problem`, pydantic
adds the path of fields that leads there, and `locate` turns path and problem into a `Fault` with a place.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from zwidth.words.errors import ConfigError, UnusableValueError
from zwidth.words.formatting import LONGEST_VALUE, describe, suggestion

if TYPE_CHECKING:
    from pydantic_core import PydanticCustomError, ValidationError

FieldPath: TypeAlias = tuple[str | int, ...]
Result = TypeVar("Result")
LocatedProblem: TypeAlias = "tuple[FieldPath, PydanticCustomError]"


@dataclass(frozen=True)
class Fault:
    """One fault of a configuration file; line and column are None where it has no place, as for a missing file."""

    file: str  # as the user named it; empty for a configuration that is no file
    line: int | None  # from 1
    column: int | None  # in characters, from 1
    field: str  # such as ``studies[0].delta``; empty for the file as a whole
    problem: str  # with the value received
    allowed: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        place = printable(self.file)
        if self.line is not None:
            place += f":{self.line}:{self.column}"
        text = "; ".join(part for part in (self.problem, self.allowed, self.remedy) if part)
        return ": ".join(part for part in (place, self.field, text) if part)


class ConfigFileError(ConfigError):
    """A configuration file with faults, in the order of their places: one line of the message for each of them."""

    def __init__(self, message: str, faults: Sequence[Fault] = ()) -> None:
        # The message alone goes into args, so that a copy sent to another process can be rebuilt.
        super().__init__(message)
        self.faults = tuple(faults)

    @classmethod
    def of(cls, faults: Iterable[Fault]) -> ConfigFileError:
        """The error that reports ``faults``, sorted by place."""
        ordered = sorted(faults, key=lambda fault: (fault.line or 0, fault.column or 0))
        return cls("\n".join(str(fault) for fault in ordered), ordered)


def problem(what: str, allowed: str = "", remedy: str = "", *, on_key: bool = False) -> PydanticCustomError:
    """What a validator raises; ``on_key`` points at the key of the field instead of its value."""
    context = {"what": what, "allowed": allowed, "remedy": remedy, "on_key": on_key}
    # Only a fault loads pydantic: the command line, which reads numbers alone, has no other use for it.
    from pydantic_core import PydanticCustomError

    return PydanticCustomError("zwidth", "{what}; {allowed}; {remedy}", context)


def raise_problems(read: Callable[[Any], Result]) -> Callable[[Any], Result]:
    """Make a validator of what reads a value and raises `UnusableValueError`."""

    def validate(value: Any) -> Result:
        try:
            return read(value)
        except UnusableValueError as error:
            raise problem(*error.parts) from None

    return validate


# What pydantic itself finds: what is allowed, and the remedy.
_PLAIN = {
    "bool_type": ("it must be true or false", "write true or false, without quotes"),
    "string_type": ("it must be text", "put the text in quotes"),
}


def problems_of(error: ValidationError | PydanticCustomError, *above: str) -> list[LocatedProblem]:
    """Every problem of an error with the path to its field, below the keys ``above`` of what was read."""
    from pydantic import ValidationError

    if not isinstance(error, ValidationError):
        return [(above, error)]
    found = []
    for detail in error.errors(include_url=False):
        kind, got = detail["type"], f"got {describe(detail['input'])}"
        if kind == "zwidth":
            what = problem(**detail.get("ctx", {}))
        elif kind == "literal_error":
            what = unlisted(detail["input"], re.findall("'(.*?)'", detail.get("ctx", {})["expected"]))
        else:
            what = problem(got, *_PLAIN.get(kind, (detail["msg"],)))
        found.append(((*above, *detail["loc"]), what))
    return found


def unlisted(value: Any, names: Sequence[str]) -> PydanticCustomError:
    allowed = f"allowed {'is' if len(names) == 1 else 'are'} {listing(names)}"
    return problem(f"got {describe(value)}", allowed, suggestion(value, names, "write one of these"))


def validation_error(title: str, problems: Iterable[LocatedProblem]) -> ValidationError:
    """Put located problems into one pydantic error; raised in a validator, it keeps all of them apart."""
    from pydantic_core import InitErrorDetails, ValidationError

    details = [InitErrorDetails(type=what, loc=path, input=None) for path, what in problems]
    return ValidationError.from_exception_data(title, details)


def listing(names: Iterable[str]) -> str:
    """Names for a message: ``'a', 'b', 'c'``."""
    return ", ".join(repr(name) for name in names)


def printable(text: str) -> str:
    """The text itself where it fits on one line of a terminal, else an escaped form of it."""
    return text if text.isprintable() else ascii(text)


def dotted(path: FieldPath) -> str:
    """``("studies", 0, "delta")`` as ``studies[0].delta``."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            short = part if len(part) <= LONGEST_VALUE else f"{part[:LONGEST_VALUE]}..."
            text += ("." if text else "") + printable(short)
    return text


def locate(
    file: str,
    problems: Iterable[LocatedProblem],
    values: Mapping[FieldPath, tuple[int, int]],
    keys: Mapping[FieldPath, tuple[int, int]],
) -> list[Fault]:
    """Give problems their places, from the places of the file's values and keys.

    A field that is missing stands nowhere: it gets the place of the mapping that lacks it. Without a file none has one.
    """
    faults = []
    for path, what in problems:
        context = what.context or {}
        place = keys.get(path) if context["on_key"] else None
        above = path
        while place is None:
            place = values.get(above) or (None if above else (None, None))
            above = above[:-1]
        line, column = place
        parts = (context["what"], context["allowed"], context["remedy"])
        faults.append(Fault(file, line, column, dotted(path), *parts))
    return faults
