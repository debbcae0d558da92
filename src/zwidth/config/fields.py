"""Building blocks of the configuration's models: faults with their places, a strict base class, names and lists.

A validator knows what is wrong but not where its value stands in the file. It raises a `problem`, pydantic
adds the path of fields that leads there, and `locate` turns path and problem into a `Fault` with a place.
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

from zwidth.words.errors import ConfigError
from zwidth.words.formatting import LONGEST_VALUE, describe, resembling, suggestion
from zwidth.words.quantities import FIELDS, Parameter

FieldPath: TypeAlias = tuple[str | int, ...]
Kind = TypeVar("Kind")
LocatedProblem: TypeAlias = tuple[FieldPath, PydanticCustomError]


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
    return PydanticCustomError("zwidth", "{what}; {allowed}; {remedy}", context)


# What pydantic itself finds: what is allowed, and the remedy.
_PLAIN = {
    "bool_type": ("it must be true or false", "write true or false, without quotes"),
    "string_type": ("it must be text", "put the text in quotes"),
    "list_type": ("it must be a list", "write '- ' before each entry"),
    "dict_type": ("it must be a mapping", "write 'key: value' lines, or {key: value}"),
}

_DELAY_MODELS = ("delay_model", "delay_models")  # keys of earlier releases


def problems_of(error: ValidationError | PydanticCustomError, *above: str) -> list[LocatedProblem]:
    """Return all problems of an error with the paths to their fields; ``above`` precedes each path."""
    if not isinstance(error, ValidationError):
        return [(above, error)]
    found = []
    for detail in error.errors(include_url=False):
        kind, got = detail["type"], f"got {describe(detail['input'])}"
        if kind == "zwidth":
            what = problem(**detail.get("ctx", {}))
        elif kind == "literal_error":
            names = re.findall("'(.*?)'", detail.get("ctx", {})["expected"])
            allowed = f"allowed {'is' if len(names) == 1 else 'are'} {listing(names)}"
            what = problem(got, allowed, suggestion(detail["input"], names, "write one of these"))
        else:
            what = problem(got, *_PLAIN.get(kind, (detail["msg"],)))
        found.append(((*above, *detail["loc"]), what))
    return found


def validation_error(title: str, problems: Iterable[LocatedProblem]) -> ValidationError:
    """Put located problems into one pydantic error; raised in a validator, it keeps all of them apart."""
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
    """Give problems their places, from the places of the file's values and keys."""
    # A field that is missing stands nowhere: it gets the place of the mapping that lacks it. Without a file none has
    # one.
    faults = []
    for path, found in problems:
        what, allowed, remedy, on_key = (found.context or {}).values()
        above = [keys.get(path) if on_key else None, *(values.get(path[:end]) for end in range(len(path), -1, -1))]
        place = next(filter(None, above), (None, None))
        faults.append(Fault(file, *place, dotted(path), what, allowed, remedy))
    return faults


class Strict(BaseModel):
    """A frozen mapping that knows all its keys and reports all its faults at once."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", defer_build=True)

    what: ClassVar[str] = "a mapping"  # that it describes, for messages
    described_by: ClassVar[tuple[type[Strict], ...]] = ()  # other models, which say what the fields of their names are

    def __init_subclass__(cls, *, what: str = "", **config: Any) -> None:
        super().__init_subclass__(**config)
        if what:
            cls.what = what

    @classmethod
    def prepare(cls, raw: dict[str, Any]) -> dict[str, Any]:
        """Return a mapping completed with values that other parts of the file supply; a hook."""
        return raw

    @classmethod
    def conflicts(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        """Return the faults visible from the keys of a mapping with unchecked values; a hook."""
        return ()

    @classmethod
    def missing(cls, name: str) -> tuple[str, str]:
        """Return what is allowed and the remedy if a required key is missing; a hook."""
        return f"{cls.what} needs it", f"add {name!r}"

    @classmethod
    def unknown(cls, name: str) -> tuple[str, str, str]:
        """Return the problem, what is allowed and the remedy for a key that is not allowed; a hook."""
        if name == "<<":
            return "unknown key", "YAML 1.2 has no merge keys", "write the keys out"
        if name in _DELAY_MODELS:
            remedy = "remove it; for the paper's z^(1+d), use the kinds 'paper_fig6' and 'paper_fig10'"
            return "key of an earlier release", "every delay is exact ('held')", remedy
        key, colon, value = name.partition(":")
        if colon and key in cls.model_fields:
            return "unknown key", "a space follows the colon after a key", f"write '{key}: {value}'"
        allowed = f"{cls.what} has the keys {listing(cls.model_fields)}"
        return "unknown key", allowed, suggestion(name, cls.model_fields, "remove it")

    def limits(self) -> Iterable[LocatedProblem]:
        """Return the faults of a model whose fields are all valid; a hook."""
        return ()

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Add the description of each field to the schema: that of its quantity, or its docstring."""
        found = handler(schema)
        properties = handler.resolve_ref_schema(found)["properties"]
        for name in FIELDS.keys() & properties.keys():
            properties[name].setdefault("description", f"{describe_parameter(FIELDS[name])}.")
        for model in (*cls.described_by, *reversed(cls.__mro__)):
            for name, words in _find_docstrings(model) if issubclass(model, Strict) else ():
                properties[name]["description"] = words
        return found

    @model_validator(mode="wrap")
    @classmethod
    def _report_all(cls, raw: Any, handler: Handler[Any]) -> Any:
        if isinstance(raw, cls):
            return raw
        if not isinstance(raw, dict):
            allowed = f"{cls.what} is a mapping with the keys {listing(cls.model_fields)}"
            raise problem(f"got {describe(raw)}", allowed, "write 'key: value' lines, or {key: value}")
        raw = cls.prepare(raw)
        found = list(cls._unusable(raw))
        skipped = {path[0] for path, _ in found}
        found.extend(cls.conflicts(raw))
        try:
            model = handler({key: value for key, value in raw.items() if key not in skipped})
        except ValidationError as error:
            found.extend(cls._with_remedies(error, skipped))
        else:
            found.extend(model.limits())
            if not found:
                return model
        raise validation_error(cls.__name__, found)

    @classmethod
    def _unusable(cls, raw: dict[str, Any]) -> Iterable[LocatedProblem]:
        """Keys that do not exist, and keys without a value."""
        for key, value in raw.items():
            if key not in cls.model_fields:
                yield (key,), problem(*cls.unknown(key), on_key=True)
            elif value is None:
                yield (key,), problem("got nothing", "a key that is written has a value", "add one or remove the key")

    @classmethod
    def _with_remedies(cls, error: ValidationError, skipped: set[Any]) -> Iterable[LocatedProblem]:
        """The problems of an error; a key that is absent is reported with what this class knows of it."""
        # Faults of their own: a key without a value, and one that is misspelled.
        explained = skipped | {resembling(key, cls.model_fields) for key in skipped}
        details = error.errors(include_url=False, include_input=False, include_context=False)
        for detail, (path, what) in zip(details, problems_of(error), strict=True):
            absent = detail["type"] == "missing" or (len(path) == 1 and (what.context or {})["what"] == "missing")
            if absent and path[0] in explained:
                continue
            yield path, problem("missing", *cls.missing(str(path[0]))) if detail["type"] == "missing" else what


def _find_docstrings(model: type[Strict]) -> Iterator[tuple[str, str]]:
    """The names of the fields that a class adds, and the texts below them."""
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]
    except (OSError, TypeError):
        # Made of quantities, or by a program: there is no source.
        return
    assert isinstance(body, ast.ClassDef), "this is a class"
    for field, below in pairwise(body.body):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            name = ast.unparse(field.target)
            if name in model.model_fields:
                yield name, inspect.cleandoc(str(below.value.value))


def _name(value: Any) -> str:
    allowed = "a name is 1 to 64 of the characters a-z, 0-9, '_' and '-', since it names a folder"
    if not isinstance(value, str):
        raise problem(f"got {describe(value)}", allowed, "write a name, in quotes where it is all digits")
    if not re.fullmatch(r"[a-z0-9_-]{1,64}", value):
        plain = re.sub(r"[^a-z0-9_-]+", "_", value.lower())[:64].strip("_")
        raise problem(f"got {describe(value)}", allowed, f"write {plain or 'a name'!r}")
    return value


def members(what: str) -> Callable[[Any, Callable[[Any], Any]], Any]:
    """A wrapping validator for a list that is not empty and names nothing twice."""

    def validate(raw: Any, handler: Callable[[Any], Any]) -> Any:
        if not isinstance(raw, list | tuple):
            hint = "write '- ' before each of them"
            if isinstance(raw, str) and raw.isprintable() and len(raw) < 60:
                hint = f"write [{raw}]"
            raise problem(f"got {describe(raw)}", f"it must be a list of {what}", hint)
        if not raw:
            raise problem("got an empty list", f"one of the {what} at least is needed", "fill the list")
        found = list(repeated(raw, "remove it"))
        try:
            value = handler(tuple(raw))
        except ValidationError as error:
            raise validation_error(what, [*found, *problems_of(error)]) from None
        if found:
            raise validation_error(what, found)
        return value

    return validate


def find_kind(
    raw: Any, known: Mapping[str, Kind], what: str, example: str, refused: Mapping[str, tuple[str, str]] | None = None
) -> Kind:
    """What a mapping is read as, by its key ``kind``; some names are refused with what is allowed and a remedy."""
    kinds = f"{what} is a mapping with one of the kinds {listing(known)}"
    if not isinstance(raw, dict):
        raise problem(f"got {describe(raw)}", kinds, f"write {example}")
    if "kind" not in raw:
        found = problem("missing", kinds, f"add 'kind: {next(iter(known))}'")
    elif isinstance(kind := raw["kind"], str) and kind in known:
        return known[kind]
    else:
        parts = f"the kinds are {listing(known)}", suggestion(kind, known, "write one of these")
        found = problem(f"got {describe(kind)}", *(refused or {}).get(str(kind), parts))
    raise validation_error(what, [(("kind",), found)])


def repeated(raw: Iterable[Any], remedy: str, allowed: str = "each value once") -> Iterable[LocatedProblem]:
    """A problem for every plain value of a list that an earlier entry already holds."""
    seen: dict[Any, int] = {}
    for index, value in enumerate(raw):
        if isinstance(value, str | int | float) and not isinstance(value, bool):
            first = seen.setdefault(value, index)
            if first != index:
                yield (index,), problem(f"got {describe(value)} twice, here and at [{first}]", allowed, remedy)


Name = Annotated[str, BeforeValidator(_name), WithJsonSchema({"type": "string", "pattern": "^[a-z0-9_-]{1,64}$"})]


def describe_parameter(parameter: Parameter, bounds: str = "") -> str:
    """What a schema says of a parameter."""
    unit = "" if parameter.unit == "1" else f", in {parameter.unit} or with a unit"
    return f"{parameter.sentence}{unit}{bounds}{'; ' if parameter.note else ''}{parameter.note}"
