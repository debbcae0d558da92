"""Building blocks of the configuration's models: error reports, a strict base class, names and lists.

A section is one mapping of a configuration, such as a device or a study. Errors are reported in three steps. A
validator has no access to the position of its value in the file; it raises a `problem` (message, allowed values,
remedy). Pydantic adds the path of the field, such as ``("studies", 0, "delta")``; path and problem together are a
`LocatedProblem`. `locate_faults` looks up the line and column of the path, and returns a `Fault`. All faults of a file
are collected into one `ConfigFileError`.

`Strict` is the base of all models of sections. Subclasses add checks and messages by overriding its hooks: `prepare`,
`find_conflicts`, `find_faults`, `explain_missing` and `explain_unknown`. The descriptions of keys in the JSON Schema
are the docstrings below the fields.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, TypeAlias, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetJsonSchemaHandler,
    ValidationError,
    WithJsonSchema,
    model_validator,
)
from pydantic import ModelWrapValidatorHandler as Handler
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError

from zwidth.core.errors import ConfigError
from zwidth.units.formatting import LONGEST_VALUE, describe, resembling, suggestion
from zwidth.units.quantities import FIELDS, Parameter

FieldPath: TypeAlias = tuple[str | int, ...]
Kind = TypeVar("Kind")
LocatedProblem: TypeAlias = tuple[FieldPath, PydanticCustomError]
"""Pair of the path of a field, relative to the model that is being validated, and the `problem` of this field."""


@dataclass(frozen=True)
class Fault:
    """One fault of a configuration; line and column are None for a fault without a position, such as a missing file."""

    file: str  # path as given by the user; empty for a configuration passed as a mapping
    line: int | None  # line number, counted from 1
    column: int | None  # column in characters, counted from 1
    field: str  # path of the field, such as ``studies[0].delta``; empty for the file as a whole
    problem: str  # description of the problem, with the value received
    allowed: str = ""  # description of the allowed values
    remedy: str = ""  # change that makes the value valid

    def __str__(self) -> str:
        position = escape_unprintable(self.file)
        if self.line is not None:
            position += f":{self.line}:{self.column}"
        text = "; ".join(part for part in (self.problem, self.allowed, self.remedy) if part)
        return ": ".join(part for part in (position, self.field, text) if part)


class ConfigFileError(ConfigError):
    """Error that reports all faults of a configuration file, one per line of the message, in the order of the file."""

    def __init__(self, message: str, faults: Sequence[Fault] = ()) -> None:
        # Pass only the message to the base class, because unpickling an exception calls its class with the arguments
        # of the base class.
        super().__init__(message)
        self.faults = tuple(faults)

    @classmethod
    def of(cls, faults: Iterable[Fault]) -> ConfigFileError:
        """Return the error that reports ``faults`` in the order of their lines and columns."""
        ordered = sorted(faults, key=lambda fault: (fault.line or 0, fault.column or 0))
        return cls("\n".join(str(fault) for fault in ordered), ordered)


def problem(message: str, allowed: str = "", remedy: str = "", *, on_key: bool = False) -> PydanticCustomError:
    """Return the error that a validator raises for an invalid value.

    Args:
        message: the problem, with the value received.
        allowed: the allowed values.
        remedy: the change that makes the value valid.
        on_key: True to report the position of the key of the field instead of the position of its value.
    """
    context = {"message": message, "allowed": allowed, "remedy": remedy, "on_key": on_key}
    return PydanticCustomError("zwidth", "{message}; {allowed}; {remedy}", context)


# Allowed values and remedy to report for errors that pydantic itself detects, by pydantic's name of the error type.
_PYDANTIC_ERRORS = {
    "bool_type": ("it must be true or false", "write true or false, without quotes"),
    "string_type": ("it must be text", "put the text in quotes"),
    "list_type": ("it must be a list", "write '- ' before each entry"),
    "dict_type": ("it must be a mapping", "write 'key: value' lines, or {key: value}"),
}

# Keys that users may write for the keys of the models: words of rotary devices and of the command line.
_OTHER_NAMES = {"inertia": "mass", "friction": "coulomb"}
_REMOVED_KEYS = ("delay_model", "delay_models")  # keys that studies had in earlier releases


def list_problems(error: ValidationError | PydanticCustomError, *above: str) -> list[LocatedProblem]:
    """Convert a validation error to a list of pairs (path, problem), one pair for each invalid field.

    Errors that pydantic itself detected, such as a wrong type, are converted to a `problem` with allowed values and a
    remedy.

    Args:
        error: error of pydantic, which contains one entry per invalid field; or a single `problem` without a path.
        above: keys from an outer model to the field that caused the error. They are prepended to each path, so that
            the paths are relative to the outer model.
    """
    if not isinstance(error, ValidationError):
        return [(above, error)]
    problems = []
    for detail in error.errors(include_url=False):
        kind, got = detail["type"], f"got {describe(detail['input'])}"
        if kind == "zwidth":
            entry = problem(**detail.get("ctx", {}))
        elif kind == "literal_error":
            names = re.findall("'(.*?)'", detail.get("ctx", {})["expected"])
            allowed = f"allowed {'is' if len(names) == 1 else 'are'} {quote_names(names)}"
            entry = problem(got, allowed, suggestion(detail["input"], names, "write one of these"))
        else:
            entry = problem(got, *_PYDANTIC_ERRORS.get(kind, (detail["msg"],)))
        problems.append(((*above, *detail["loc"]), entry))
    return problems


def combine_problems(title: str, problems: Iterable[LocatedProblem]) -> ValidationError:
    """Return one pydantic error that contains all ``problems``, for a validator to raise; ``title`` names the model."""
    details = [InitErrorDetails(type=error, loc=path, input=None) for path, error in problems]
    return ValidationError.from_exception_data(title, details)


def quote_names(names: Iterable[str]) -> str:
    """Return the names in quotes and separated by commas, as text for a message: ``'a', 'b', 'c'``."""
    return ", ".join(repr(name) for name in names)


def escape_unprintable(text: str) -> str:
    """Return a printable text unchanged; otherwise return its ASCII form in quotes, with line breaks escaped."""
    return text if text.isprintable() else ascii(text)


def format_path(path: FieldPath) -> str:
    """Convert a path such as ``("studies", 0, "delta")`` to the text ``studies[0].delta``; shorten long keys."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            short = part if len(part) <= LONGEST_VALUE else f"{part[:LONGEST_VALUE]}..."
            text += ("." if text else "") + escape_unprintable(short)
    return text


def locate_faults(
    file: str,
    problems: Iterable[LocatedProblem],
    values: Mapping[FieldPath, tuple[int, int]],
    keys: Mapping[FieldPath, tuple[int, int]],
) -> list[Fault]:
    """Convert the problems of a configuration to faults, by adding the line and column of each field.

    A missing field has no position; its fault gets the position of the mapping in which the field is missing.

    Args:
        file: path of the file as given by the user; empty for a configuration that is not a file.
        problems: problems with paths relative to the whole configuration.
        values: line and column of each value by its path; empty without a file.
        keys: line and column of each key by the path of its value; empty without a file.
    """
    faults = []
    for path, error in problems:
        message, allowed, remedy, on_key = (error.context or {}).values()
        above = [keys.get(path) if on_key else None, *(values.get(path[:end]) for end in range(len(path), -1, -1))]
        position = next(filter(None, above), (None, None))
        faults.append(Fault(file, *position, format_path(path), message, allowed, remedy))
    return faults


class Strict(BaseModel):
    """Base of the models of sections.

    Instances are immutable. Unknown keys are refused, types are not converted, and one error reports all problems of a
    section.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", defer_build=True)

    noun: ClassVar[str] = "a mapping"  # noun of the section for messages, such as "a device"
    described_by: ClassVar[tuple[type[Strict], ...]] = ()  # models whose docstrings describe fields of the same name

    def __init_subclass__(cls, *, noun: str = "", **config: Any) -> None:
        super().__init_subclass__(**config)
        if noun:
            cls.noun = noun

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Return the mapping to validate: by default ``raw``. A hook, with which subclasses add derived keys."""
        return raw

    @classmethod
    def find_conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        """Return the problems of keys that exclude or require each other. A hook, called before the validation."""
        return ()

    @classmethod
    def explain_missing(cls, name: str) -> tuple[str, str]:
        """Return the allowed values and the remedy to report if the required key ``name`` is missing. A hook."""
        return f"{cls.noun} needs it", f"add {name!r}"

    @classmethod
    def explain_unknown(cls, name: str) -> tuple[str, str, str]:
        """Return the message, the allowed keys and the remedy to report for the unknown key ``name``. A hook."""
        if name == "<<":
            return "unknown key", "YAML 1.2 has no merge keys", "write the keys out"
        if name in _REMOVED_KEYS:
            remedy = "remove it; for the paper's z^(1+d), use the kinds 'paper_fig6' and 'paper_fig10'"
            return "key of an earlier release", "every delay is exact ('held')", remedy
        key, colon, value = name.partition(":")
        if colon and key in cls.model_fields:
            return "unknown key", "a space follows the colon after a key", f"write '{key}: {value}'"
        allowed = f"{cls.noun} has the keys {quote_names(cls.model_fields)}"
        if (standard := _OTHER_NAMES.get(name)) in cls.model_fields:
            return "unknown key", allowed, f"use {standard!r}"
        return "unknown key", allowed, suggestion(name, cls.model_fields, "remove it")

    def find_faults(self) -> Iterable[LocatedProblem]:
        """Return the problems of combinations of fields. A hook, called only if every single field is valid."""
        return ()

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Add a description of each field to the JSON Schema: its docstring or else the description of its quantity."""
        reference = handler(schema)
        properties = handler.resolve_ref_schema(reference)["properties"]
        for name in FIELDS.keys() & properties.keys():
            properties[name].setdefault("description", f"{describe_parameter(FIELDS[name])}.")
        for model in (*cls.described_by, *reversed(cls.__mro__)):
            for name, description in _find_docstrings(model) if issubclass(model, Strict) else ():
                properties[name]["description"] = description
        return reference

    @model_validator(mode="wrap")
    @classmethod
    def _validate(cls, raw: Any, handler: Handler[Any]) -> Any:
        """Return the model of the mapping ``raw``; raise one error with all problems of the mapping if it is invalid.

        ``handler`` is pydantic's validation of the single fields.
        """
        if isinstance(raw, cls):
            return raw
        if not isinstance(raw, dict):
            allowed = f"{cls.noun} is a mapping with the keys {quote_names(cls.model_fields)}"
            raise problem(f"got {describe(raw)}", allowed, "write 'key: value' lines, or {key: value}")
        raw = cls.prepare(raw)
        problems = list(cls._find_unusable_keys(raw))
        skipped = {path[0] for path, _ in problems}
        problems.extend(cls.find_conflicts(raw))
        try:
            model = handler({key: value for key, value in raw.items() if key not in skipped})
        except ValidationError as error:
            problems.extend(cls._add_remedies(error, skipped))
        else:
            problems.extend(model.find_faults())
            if not problems:
                return model
        raise combine_problems(cls.__name__, problems)

    @classmethod
    def _find_unusable_keys(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        """Yield the problems of unknown keys and of keys without a value."""
        for key, value in raw.items():
            if key not in cls.model_fields:
                yield (key,), problem(*cls.explain_unknown(key), on_key=True)
            elif value is None:
                yield (key,), problem("got nothing", "a key needs a value", "add one or remove the key")

    @classmethod
    def _add_remedies(cls, error: ValidationError, skipped: set[Any]) -> Iterable[LocatedProblem]:
        """Yield the problems of ``error``; those of missing required keys get the texts of the hook `explain_missing`.

        ``skipped`` contains the unusable keys of the mapping, whose problems are already reported.
        """
        # Do not report a required key as missing if it is present without a value or misspelled, because that problem
        # is already reported.
        explained = skipped | {resembling(key, cls.model_fields) for key in skipped}
        details = error.errors(include_url=False, include_input=False, include_context=False)
        for detail, (path, fault) in zip(details, list_problems(error), strict=True):
            absent = detail["type"] == "missing" or (len(path) == 1 and (fault.context or {})["message"] == "missing")
            if absent and path[0] in explained:
                continue
            yield (
                path,
                problem("missing", *cls.explain_missing(str(path[0]))) if detail["type"] == "missing" else fault,
            )


def _find_docstrings(model: type[Strict]) -> Iterator[tuple[str, str]]:
    """Yield the name and the docstring of each field that has a docstring in the body of the class ``model``."""
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]
    except (OSError, TypeError):
        # Yield nothing for models made by `create_model`, because they have no source code; their fields have
        # descriptions instead of docstrings.
        return
    assert isinstance(body, ast.ClassDef), "this is a class"
    for field, below in pairwise(body.body):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            name = ast.unparse(field.target)
            if name in model.model_fields:
                yield name, inspect.cleandoc(str(below.value.value))


def _validate_name(value: Any) -> str:
    """Return the name unchanged; raise a problem if it is not valid as the name of a folder."""
    allowed = "a name is 1 to 64 of the characters a-z, 0-9, '_' and '-', because it names a folder"
    if not isinstance(value, str):
        raise problem(f"got {describe(value)}", allowed, "write a name, in quotes if it is all digits")
    if not re.fullmatch(r"[a-z0-9_-]{1,64}", value):
        plain = re.sub(r"[^a-z0-9_-]+", "_", value.lower())[:64].strip("_")
        raise problem(f"got {describe(value)}", allowed, f"write {plain or 'a name'!r}")
    return value


def require_entries(noun: str) -> Callable[[Any, Callable[[Any], Any]], Any]:
    """Return a validator that accepts only lists with at least one entry and without repeated entries.

    Args:
        noun: plural noun of the entries for messages, such as "devices".

    Returns:
        A validator for `pydantic.WrapValidator`.
    """

    def validate(raw: Any, handler: Callable[[Any], Any]) -> Any:
        if not isinstance(raw, list | tuple):
            hint = "write '- ' before each of them"
            if isinstance(raw, str) and raw.isprintable() and len(raw) < 60:
                hint = f"write [{raw}]"
            raise problem(f"got {describe(raw)}", f"it must be a list of {noun}", hint)
        if not raw:
            raise problem("got an empty list", f"at least one of the {noun} is needed", "fill the list")
        problems = list(find_repeated(raw, "remove it"))
        try:
            value = handler(tuple(raw))
        except ValidationError as error:
            raise combine_problems(noun, [*problems, *list_problems(error)]) from None
        if problems:
            raise combine_problems(noun, problems)
        return value

    return validate


def find_kind(
    raw: Any, models: Mapping[str, Kind], noun: str, example: str, refused: Mapping[str, tuple[str, str]] | None = None
) -> Kind:
    """Return the entry of ``models`` that the key ``kind`` of a mapping names.

    Args:
        raw: value of the configuration.
        models: models by the names of their kinds.
        noun: noun of the section for messages, such as "a study".
        example: remedy to report if the value is not a mapping.
        refused: allowed values and remedy to report, by kind, for kinds that exist but are not accepted here.
    """
    kinds = f"{noun} is a mapping with one of the kinds {quote_names(models)}"
    if not isinstance(raw, dict):
        raise problem(f"got {describe(raw)}", kinds, f"write {example}")
    if "kind" not in raw:
        shown = next((name for name in models if f"kind: {name}" in example), next(iter(models)))
        error = problem("missing", kinds, f"add 'kind: {shown}'")
    elif isinstance(kind := raw["kind"], str) and kind in models:
        return models[kind]
    else:
        rule = f"the kinds are {quote_names(models)}", suggestion(kind, models, "write one of these")
        error = problem(f"got {describe(kind)}", *(refused or {}).get(str(kind), rule))
    raise combine_problems(noun, [(("kind",), error)])


def find_repeated(raw: Iterable[Any], remedy: str, allowed: str = "each value once") -> Iterable[LocatedProblem]:
    """Yield a problem for each number or text of a list that equals an earlier entry.

    The path of a problem is the index of the repeated entry; ``remedy`` and ``allowed`` are texts of the problem.
    """
    seen: dict[Any, int] = {}
    for index, value in enumerate(raw):
        if isinstance(value, str | int | float) and not isinstance(value, bool):
            first = seen.setdefault(value, index)
            if first != index:
                yield (index,), problem(f"got {describe(value)} twice, here and at [{first}]", allowed, remedy)


Name = Annotated[
    str, BeforeValidator(_validate_name), WithJsonSchema({"type": "string", "pattern": "^[a-z0-9_-]{1,64}$"})
]


def describe_parameter(parameter: Parameter, bounds: str = "") -> str:
    """Return the description of a parameter for the JSON Schema: quantity, unit, text of the bounds, and note."""
    unit = f", in {parameter.unit_words} or with a unit" if parameter.unit_words else ""
    return f"{parameter.sentence}{unit}{bounds}{'; ' if parameter.note else ''}{parameter.note}"
