"""Reading and writing configurations: strict YAML 1.2, where every fault has its place in the file.

This is the only module that imports yaml. The model that a file is checked against is `zwidth.studies.document`'s.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from yaml.composer import Composer
from yaml.parser import Parser
from yaml.reader import Reader
from yaml.resolver import BaseResolver
from yaml.scanner import Scanner

from zwidth.config.device_table import files_relative_to, find_file
from zwidth.config.fields import (
    ConfigFileError,
    Fault,
    FieldPath,
    LocatedProblem,
    dotted,
    locate,
    printable,
    problem,
    problems_of,
)
from zwidth.config.values import read_in_units
from zwidth.parts.devices import DEVICES
from zwidth.parts.measured import SUFFIXES, MeasuredDevice
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe
from zwidth.words.quantities import PARAMETERS
from zwidth.words.tables import read_columns
from zwidth.words.unit_system import SYSTEMS
from zwidth.words.units import split_head, tell_kind

_Model = TypeVar("_Model", bound=BaseModel)

# Free text, and an angle of any device, which has no unit.
_TEXTS = ("name", "description", "label", "phase_margin")
MAX_FILE_BYTES = 2**20
MAX_NODES = 50_000
MAX_DEPTH = 20


def read_model(path: str | bytes | os.PathLike[str], model: type[_Model]) -> _Model:
    """Return the model of a configuration file; raise a `ConfigFileError` that lists all faults."""
    file = os.fsdecode(path)
    tree = _Tree(file, _read_text(file))
    with files_relative_to(Path(file).parent):
        return _check(model, tree.data, tree.faults, lambda found: locate(file, found, tree.values, tree.keys))


def read_mapping(data: Mapping[str, Any], model: type[_Model]) -> _Model:
    """Return the model of a mapping; raise a `ConfigFileError` whose faults have fields but no line numbers."""
    problems: list[LocatedProblem] = []
    simple = _simplify(data, (), problems)
    return _check(model, simple, locate("", problems, {}, {}), lambda found: locate("", found, {}, {}))


def _check(
    model: type[_Model], data: Any, faults: list[Fault], place: Callable[[list[LocatedProblem]], list[Fault]]
) -> _Model:
    """Return the model of plain values; raise a `ConfigFileError` with ``faults`` and those of the model."""
    found = None
    try:
        with read_in_units(SYSTEMS[has_rotary_devices(data)]):
            found = model.model_validate(data)
    except ValidationError as error:
        faults = faults + place(problems_of(error))
    if found is None or faults:
        raise ConfigFileError.of(faults)
    return found


def has_rotary_devices(data: Any, key: str = "") -> bool:
    """Return whether a configuration has rotary devices, by its units, ``rotary: true``, device names or data files."""
    # One rotary value makes all devices of a file rotary. Skip fits, because they determine the kind from their logs.
    if isinstance(data, Mapping):
        return data.get("kind") != "fit" and any(has_rotary_devices(each, str(name)) for name, each in data.items())
    if isinstance(data, list):
        return any(has_rotary_devices(each, key) for each in data)
    if key == "device" and isinstance(data, str):
        if data.endswith(SUFFIXES):
            # Ignore an unreadable table here, because the validation of its section reports the error.
            with suppress(InputError):
                return MeasuredDevice.read(find_file(data)).rotary
            return False
        return any(known.rotary for known in DEVICES if known.name == data)
    if key == "csv" and isinstance(data, str):
        # Coordinates in degrees do not make a device rotary, so only parameters count.
        with suppress(InputError):
            heads = map(split_head, read_columns(find_file(data)).heads)
            return any(tell_kind(f"1 {unit}") is True for name, unit in heads if name in PARAMETERS)
        return False
    return data is True if key == "rotary" else key not in _TEXTS and tell_kind(data) is True


def _simplify(value: Any, path: FieldPath, problems: list[LocatedProblem]) -> Any:
    """A value as a file would hold it: arrays and tuples as lists; keys that are no text are left out as faults."""
    if len(path) > MAX_DEPTH:
        problems.append((path, problem("the values are nested too deeply", f"at most {MAX_DEPTH} levels")))
        return None
    if isinstance(value, Mapping):
        strange = [key for key in value if not isinstance(key, str)]
        keys = "keys are text", "write the name of a field"
        problems += [(path, problem(f"got the key {describe(key)}", *keys)) for key in strange]
        return {key: _simplify(each, (*path, key), problems) for key, each in value.items() if isinstance(key, str)}
    if callable(getattr(value, "tolist", None)):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_simplify(each, (*path, index), problems) for index, each in enumerate(value)]
    return value


def write_yaml(data: Mapping[str, Any]) -> str:
    """Plain values as the text of a file that is read as the same values."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)


def find_values(text: str, key: str) -> list[tuple[str, int, int]]:
    """Every text that a file without faults has under a key: the value, and where it begins and ends in the file."""
    found: dict[int, tuple[str, int, int]] = {}
    for path, (value, first, last) in _Tree("", text).scalars.items():
        if path[-1:] == (key,):
            # Marks take in an anchor and the end of the line behind a folded text.
            anchor = re.match(r"&\S+\s+", text[first:last])
            first += anchor.end() if anchor else 0
            found[first] = (value, first, first + len(text[first:last].rstrip()))
    return list(found.values())


def _fail(file: str, place: tuple[int, int] | None, *parts: str, path: FieldPath = ()) -> ConfigFileError:
    line, column = place or (None, None)
    return ConfigFileError.of([Fault(file, line, column, dotted(path), *parts)])


def _read_text(file: str) -> str:
    """The text of a file, or an error that says why there is none."""
    place = Path(file)
    if os.path.isdir(place):
        raise _fail(file, None, "got a folder", "a configuration is one file", "name a .yaml file in it")
    # A pipe or a device might never end.
    if os.path.exists(place) and not os.path.isfile(place):
        raise _fail(file, None, "got no regular file", "a configuration is one file", "save it to a file first")
    try:
        with open(file, "rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except PermissionError as error:
        raise _fail(file, None, "permission denied", "", "make the file readable") from error
    except (OSError, ValueError) as error:
        # ValueError: a path with a null character.
        reason = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        missing = isinstance(error, FileNotFoundError)
        raise _fail(file, None, "no such file" if missing else reason, "", "check the path") from error
    if len(data) > MAX_FILE_BYTES:
        allowed = f"at most {MAX_FILE_BYTES} bytes"
        raise _fail(file, None, "the file is too large", allowed, "write long axes as linear or log")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # With a byte order mark, positions count from behind it.
        good = error.object[: error.start].decode("utf-8")
        what = f"got the byte 0x{error.object[error.start]:02x}, which is not UTF-8"
        raise _fail(file, _place(good, len(good)), what, "the file must be UTF-8 text", "save it as UTF-8") from error


def _place(text: str, index: int) -> tuple[int, int]:
    """Line and column, from 1, of a position in a text."""
    before = re.split(r"\r\n|[\n\r\x85\u2028\u2029]", text[:index])
    return len(before), len(before[-1]) + 1


def _mark_place(mark: yaml.Mark) -> tuple[int, int]:
    return mark.line + 1, mark.column + 1


class _Resolver(BaseResolver):
    """The core schema of YAML 1.2, in place of PyYAML's 1.1."""


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.(?:inf|Inf|INF)|\.nan|\.NaN|\.NAN", list("-+.")),
):
    _Resolver.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})\\Z"), _first)


# Keys of a mapping that stand on one line.
_ON_A_LINE = 4


class _Dumper(yaml.SafeDumper):
    """PyYAML's, with quotes around what the core schema would take for a number."""

    yaml_implicit_resolvers = _Resolver.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:
        """Write everything out."""
        return True

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        """A scene, say, has a line for each key; of few numbers one line holds all."""
        node = super().represent_mapping(tag, mapping, flow_style)
        node.flow_style = node.flow_style and len(node.value) <= _ON_A_LINE
        return node


class _Alias(yaml.Node):
    """What an alias stands for, ``value``, at the place of the alias."""


class _Tree(Reader, Scanner, Parser, Composer, _Resolver):
    """A file of a name and a text as plain Python values, with the places of all of them."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.values: dict[FieldPath, tuple[int, int]] = {}
        self.keys: dict[FieldPath, tuple[int, int]] = {}
        self.scalars: dict[FieldPath, tuple[str, int, int]] = {}  # as written, with the ends in the text
        self.faults: list[Fault] = []
        self._nodes = 0
        self._path: FieldPath = ()  # of the node that is being composed
        self._unfinished: set[str] = set()  # anchors of what has not ended
        try:
            Reader.__init__(self, text)
            for base in (Scanner, Parser, Composer, _Resolver):
                base.__init__(self)
            node = self.get_single_node()
            if node is None:
                allowed = "a configuration has version, name and studies"
                raise _fail(self.file, (1, 1), "the file is empty", allowed, "start with 'version: 1'")
            self.data = self._read(node, ())
        except yaml.reader.ReaderError as error:
            what = f"got the character {describe(text[error.position])}"
            allowed, remedy = "YAML allows no control characters", "remove it"
            raise _fail(self.file, _place(text, error.position), what, allowed, remedy) from error
        except yaml.MarkedYAMLError as error:
            raise self._syntax_error(error) from error
        except (ValueError, OverflowError) as error:
            # PyYAML lets these out of chr() and int(), as for "\U00110000" or a version of 5000 digits.
            if isinstance(error, ConfigFileError):
                raise
            what = "an escape or a number that does not exist"
            raise _fail(self.file, _mark_place(self.get_mark()), what, "", "correct or remove it") from error

    def _syntax_error(self, error: yaml.MarkedYAMLError) -> ConfigFileError:
        """PyYAML's account of a syntax error, with a remedy."""
        mark = error.problem_mark or error.context_mark
        place = _mark_place(mark) if mark else (1, 1)
        what, context = printable((error.problem or "unreadable").replace("\n", " ")), error.context or ""
        if what == "but found another document":
            remedy = "remove the '---' or split the file"
            return _fail(self.file, place, "a second document begins here", "one document a file", remedy)
        remedy = "check the indentation, the colons and the quotes here"
        opened = "line {}, column {}".format(*_mark_place(error.context_mark)) if error.context_mark else ""
        if r"'\t'" in what:
            what, remedy = "got a tab where the line is indented", "indent with spaces"
        elif what.startswith("found undefined alias"):
            remedy = "define it before with '&', or remove the '*'"
        elif context.startswith("found duplicate anchor"):
            what, remedy = context.partition(";")[0], "give each anchor its own name"
        elif opened and "flow" in context:
            remedy = f"close the bracket opened at {opened}"
        elif opened and "quoted" in context:
            remedy = f"check the quoted text that begins at {opened}"
        return _fail(self.file, place, "not valid YAML", what, remedy)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node with all below it, where PyYAML has no limits and takes an alias for what it stands for."""
        event, above, where = self.peek_event(), self._path, (parent, index)
        place, anchor = _mark_place(event.start_mark), event.anchor
        # A key is named by itself.
        own = getattr(event if index is None else index, "value", index)
        self._path = () if parent is None else (*above, own if isinstance(own, int | str) else "?")
        if isinstance(event, yaml.AliasEvent):
            if anchor in self._unfinished:
                what, allowed = "an alias of what it is part of", "aliases stand for values that have ended"
                raise _fail(self.file, place, what, allowed, "write the values out", path=self._path)
            node: Any = _Alias("", super().compose_node(*where), event.start_mark, event.end_mark)
        else:
            self._count_node(place, self._path)
            if event.tag is not None:
                # A fault of its own; the value is read as if it were not there.
                what = f"got the tag {describe(event.tag)}"
                self._add_fault(place, self._path, what, "tags are not used", "remove the tag")
            self._unfinished |= {anchor} - self.anchors.keys() - {None}
            node = super().compose_node(*where)
            self._unfinished -= {anchor}
        self._path = above
        return node

    def _count_node(self, place: tuple[int, int], path: FieldPath) -> None:
        """Refuse one that is too many or too deep."""
        self._nodes += 1
        if self._nodes > MAX_NODES:
            what, allowed = "too many values", f"at most {MAX_NODES} values a file"
            raise _fail(self.file, place, what, allowed, "write long axes as linear or log", path=path)
        if len(path) >= MAX_DEPTH:
            what, allowed = "the values are nested too deeply", f"at most {MAX_DEPTH} levels"
            raise _fail(self.file, place, what, allowed, "use fewer levels", path=path)

    def _add_fault(self, place: tuple[int, int], path: FieldPath, *parts: str) -> None:
        self.faults.append(Fault(self.file, *place, dotted(path), *parts))

    def _read(self, node: Any, path: FieldPath, in_alias: bool = False) -> Any:
        """The value of a node; places go to ``values`` and ``keys``, that of an alias before those within."""
        self.values.setdefault(path, _mark_place(node.start_mark))
        if isinstance(node, _Alias):
            return self._read(node.value, path, in_alias=True)
        if in_alias:
            self._count_node(self.values[path], path)
        if isinstance(node, yaml.SequenceNode):
            return [self._read(each, (*path, k), in_alias) for k, each in enumerate(node.value)]
        if isinstance(node, yaml.MappingNode):
            return self._read_mapping(node, path, in_alias)
        self.scalars[path] = (node.value, node.start_mark.index, node.end_mark.index)
        return self._read_scalar(node)

    def _read_mapping(self, node: Any, path: FieldPath, in_alias: bool) -> dict[str, Any]:
        """The keys and values of a mapping; a key that is no text or comes twice is a fault and left out."""
        found: dict[str, Any] = {}
        for name, value in node.value:
            place = _mark_place(name.start_mark)
            key = self._read_scalar(name) if isinstance(name, yaml.ScalarNode) else None
            if not isinstance(key, str):
                what = f"got the key {describe(key)}" if isinstance(name, yaml.ScalarNode) else "got a complex key"
                self._add_fault(place, path, what, "keys are text", "write the name of a field")
            elif key in found:
                what = f"the key comes twice, first in line {self.keys[*path, key][0]}"
                self._add_fault(place, (*path, key), what, "each key once", "remove one of them")
            else:
                self.keys[*path, key] = place
                found[key] = self._read(value, (*path, key), in_alias)
        return found

    def _read_scalar(self, node: Any) -> Any:
        """The value of a scalar by the core schema; a number beyond float64 becomes infinite."""
        text = node.value
        kind = self.resolve(yaml.ScalarNode, text, (node.style is None, True)).rpartition(":")[2]
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() == "true"
        if kind == "int" and text[:2] in ("0o", "0x"):
            return int(text, 0)
        # Python refuses to read integers of thousands of digits; float64 ends at 309.
        if kind == "int" and len(text) < 400:
            return int(text)
        if kind not in ("int", "float"):
            return text
        low = text.lower().lstrip("+")
        return {".nan": math.nan, ".inf": math.inf, "-.inf": -math.inf}.get(low) or float(text)
