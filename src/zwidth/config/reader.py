"""Reading and writing of configuration files in YAML 1.2 (core schema), with line and column of every fault.

`_Tree` composes the YAML nodes of a file with PyYAML, converts them to plain Python values, and records the position
of every key and value by its path. `read_model` validates the values with a model (`zwidth.studies.document.Config`
for whole files) and combines syntax faults and validation faults into one error. Differences from PyYAML: the core
schema of YAML 1.2 instead of YAML 1.1 (``1e-3`` is a number, ``no`` is a text), limits on size and nesting that stop
alias bombs, and no tags.
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

from zwidth.config.controllers import implies_rotary
from zwidth.config.device_table import files_relative_to, find_file
from zwidth.config.fields import (
    ConfigFileError,
    Fault,
    FieldPath,
    LocatedProblem,
    escape_unprintable,
    format_path,
    list_problems,
    locate_faults,
    problem,
)
from zwidth.config.values import read_in_units
from zwidth.core.errors import InputError
from zwidth.io.tables import read_columns
from zwidth.model.devices import DEVICES
from zwidth.model.measured_device import SUFFIXES, MeasuredDevice
from zwidth.units.formatting import describe
from zwidth.units.parsing import detect_kind, split_head
from zwidth.units.quantities import PARAMETERS
from zwidth.units.unit_system import SYSTEMS

_Model = TypeVar("_Model", bound=BaseModel)

# Keys whose values do not indicate rotary devices: free texts; the phase margin, which is an angle for all devices; and
# bandwidths, which are in rad/s for all devices.
_KEYS_WITHOUT_UNIT = ("name", "description", "label", "phase_margin", "bandwidth", "position.bandwidth")
MAX_FILE_BYTES = 2**20  # bytes (1 MiB)
MAX_NODES = 50_000  # values per file; aliased values count once per use
MAX_DEPTH = 20  # nesting levels of mappings and lists


def read_model(path: str | bytes | os.PathLike[str], model: type[_Model]) -> _Model:
    """Read a configuration file and return its validated model; raise a `ConfigFileError` that lists all faults."""
    file = os.fsdecode(path)
    tree = _Tree(file, _read_text(file))
    with files_relative_to(Path(file).parent):
        return _check(
            model, tree.data, tree.faults, lambda located: locate_faults(file, located, tree.values, tree.keys)
        )


def read_mapping(data: Mapping[str, Any], model: type[_Model]) -> _Model:
    """Validate a mapping and return its model; raise a `ConfigFileError` whose faults have no line numbers."""
    problems: list[LocatedProblem] = []
    simple = _simplify(data, (), problems)
    return _check(
        model, simple, locate_faults("", problems, {}, {}), lambda located: locate_faults("", located, {}, {})
    )


def _check(
    model: type[_Model], data: Any, faults: list[Fault], locate: Callable[[list[LocatedProblem]], list[Fault]]
) -> _Model:
    """Validate plain values and return their model; raise one `ConfigFileError` with all faults.

    Args:
        model: class of the model.
        data: plain Python values of the configuration.
        faults: faults detected before the validation, such as repeated keys.
        locate: function that converts the problems of the validation to faults with positions.
    """
    instance = None
    try:
        with read_in_units(SYSTEMS[has_rotary_devices(data)]):
            instance = model.model_validate(data)
    except ValidationError as error:
        faults = faults + locate(list_problems(error))
    if instance is None or faults:
        raise ConfigFileError.of(faults)
    return instance


def has_rotary_devices(data: Any, key: str = "") -> bool:
    """Return whether a unit, ``rotary: true``, a controller, a published device or a data file implies rotary devices.

    ``data`` is a configuration or one of its values, and ``key`` the key of this value.
    """
    # One rotary value makes all devices of a file rotary. Skip fit studies, because the units in their logs
    # determine whether their devices are rotary.
    if isinstance(data, Mapping):
        if "mass_matrix" in data or "model" in data:
            # For an arm, return its key ``rotary``. Ignore the units of its joints, such as N m s/rad, because the
            # wall may act on a linear motion of an arm with rotary joints.
            return data.get("rotary") is True
        return implies_rotary(data.get("scene")) or (
            data.get("kind") != "fit" and any(has_rotary_devices(each, str(name)) for name, each in data.items())
        )
    if isinstance(data, list):
        return any(has_rotary_devices(each, key) for each in data)
    if key == "device" and isinstance(data, str):
        if data.endswith(SUFFIXES):
            # Ignore an unreadable table here, because the validation of its section reports the error.
            with suppress(InputError):
                return MeasuredDevice.read(find_file(data)).rotary
            return False
        return any(device.rotary for device in DEVICES if device.name == data)
    if key == "csv" and isinstance(data, str):
        # Inspect only columns of parameters, because linear devices may also have other columns in degrees.
        with suppress(InputError):
            heads = map(split_head, read_columns(find_file(data)).heads)
            return any(detect_kind(f"1 {unit}") is True for name, unit in heads if name in PARAMETERS)
        return False
    return data is True if key == "rotary" else key not in _KEYS_WITHOUT_UNIT and detect_kind(data) is True


def _simplify(value: Any, path: FieldPath, problems: list[LocatedProblem]) -> Any:
    """Convert arrays and tuples in a value to lists; omit keys that are not text, and append a problem for each.

    Args:
        value: mapping, list or scalar.
        path: path of the value.
        problems: list to which problems are appended.
    """
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
    """Return the YAML text of a configuration with the given plain values; reading the text returns the same values."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120)


def find_values(text: str, key: str) -> list[tuple[str, int, int]]:
    """Return all scalar values of ``key`` in a valid YAML text, each as a tuple (value, start index, end index)."""
    values: dict[int, tuple[str, int, int]] = {}
    for path, (value, first, last) in _Tree("", text).scalars.items():
        if path[-1:] == (key,):
            # Exclude an anchor (``&name``) before the value and a line break after folded text, because the range
            # between PyYAML's marks contains both.
            anchor = re.match(r"&\S+\s+", text[first:last])
            first += anchor.end() if anchor else 0
            values[first] = (value, first, first + len(text[first:last].rstrip()))
    return list(values.values())


def read_section(path: Path, *keys: str) -> Any:
    """Return the plain value of nested keys in a valid YAML file, without validation; None if a key is absent."""
    value = _Tree(str(path), _read_text(str(path))).data
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _fail(file: str, position: tuple[int, int] | None, *parts: str, path: FieldPath = ()) -> ConfigFileError:
    """Return an error that reports one fault; ``parts`` are the problem, the allowed values and the remedy."""
    line, column = position or (None, None)
    return ConfigFileError.of([Fault(file, line, column, format_path(path), *parts)])


def _read_text(file: str) -> str:
    """Return the text of a file; raise a `ConfigFileError` if it cannot be read."""
    path = Path(file)
    if os.path.isdir(path):
        raise _fail(file, None, "got a folder", "a configuration is one file", "name a .yaml file in it")
    # Refuse pipes and devices, because reading them might never end.
    if os.path.exists(path) and not os.path.isfile(path):
        raise _fail(file, None, "got no regular file", "a configuration is one file", "save it to a file first")
    try:
        with open(file, "rb") as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
    except PermissionError as error:
        raise _fail(file, None, "permission denied", "", "make the file readable") from error
    except (OSError, ValueError) as error:
        # Catch ValueError as well, because `open` raises it for a path with a null character.
        reason = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        missing = isinstance(error, FileNotFoundError)
        raise _fail(file, None, "no such file" if missing else reason, "", "check the path") from error
    if len(data) > MAX_FILE_BYTES:
        allowed = f"at most {MAX_FILE_BYTES} bytes"
        raise _fail(file, None, "the file is too large", allowed, "write long axes as linear or log")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # Use the bytes in the error instead of ``data``, because ``error.start`` does not count a byte order mark.
        good = error.object[: error.start].decode("utf-8")
        message = f"got the byte 0x{error.object[error.start]:02x}, which is not UTF-8"
        raise _fail(
            file, _find_position(good, len(good)), message, "the file must be UTF-8 text", "save it as UTF-8"
        ) from error


def _find_position(text: str, index: int) -> tuple[int, int]:
    """Return the line and column of the character with the given index in a text; both count from 1."""
    before = re.split(r"\r\n|[\n\r\x85\u2028\u2029]", text[:index])
    return len(before), len(before[-1]) + 1


def _find_mark(mark: yaml.Mark) -> tuple[int, int]:
    """Convert a PyYAML mark, which counts from 0, to a line and a column that count from 1."""
    return mark.line + 1, mark.column + 1


class _Resolver(BaseResolver):
    """Resolver of the types of scalars by YAML 1.2 (core schema); the resolvers of PyYAML follow YAML 1.1."""


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", list("-+0123456789")),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.(?:inf|Inf|INF)|\.nan|\.NaN|\.NAN", list("-+.")),
):
    _Resolver.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})\\Z"), _first)


MAX_INLINE_KEYS = 4  # mappings of scalars with up to this many keys are written on one line


class _Dumper(yaml.SafeDumper):
    """YAML serializer that quotes a text if the core schema would read it as a number, a bool or null."""

    yaml_implicit_resolvers = _Resolver.yaml_implicit_resolvers

    def ignore_aliases(self, data: Any) -> bool:
        """Return True, because values that occur several times are written out without anchors."""
        return True

    def represent_mapping(self, tag: str, mapping: Any, flow_style: bool | None = None) -> yaml.MappingNode:
        """Return the node of a mapping, in block style if it has more than `MAX_INLINE_KEYS` keys."""
        node = super().represent_mapping(tag, mapping, flow_style)
        node.flow_style = node.flow_style and len(node.value) <= MAX_INLINE_KEYS
        return node


class _Alias(yaml.Node):
    """YAML node for an alias: ``value`` is the node to which the alias refers, the marks are those of the alias."""


class _Tree(Reader, Scanner, Parser, Composer, _Resolver):
    """Plain Python values of a YAML text (``data``), positions of all values and keys, and faults of tags and keys.

    Args:
        file: name of the file for messages.
        text: content of the file.

    Raises:
        ConfigFileError: if the text is not valid YAML, or exceeds a limit.
    """

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.values: dict[FieldPath, tuple[int, int]] = {}
        self.keys: dict[FieldPath, tuple[int, int]] = {}
        self.scalars: dict[FieldPath, tuple[str, int, int]] = {}  # text of each scalar, with start and end index
        self.faults: list[Fault] = []
        self._nodes = 0
        self._path: FieldPath = ()  # path of the node that is being composed
        self._unfinished: set[str] = set()  # anchors of nodes that are being composed
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
            message = f"got the character {describe(text[error.position])}"
            allowed, remedy = "YAML allows no control characters", "remove it"
            raise _fail(self.file, _find_position(text, error.position), message, allowed, remedy) from error
        except yaml.MarkedYAMLError as error:
            raise self._explain_syntax_error(error) from error
        except (ValueError, OverflowError) as error:
            # Catch the errors of chr() and int(), e.g. for "\U00110000" or a number of 5000 digits, because PyYAML does
            # not convert them to its own errors.
            if isinstance(error, ConfigFileError):
                raise
            message = "an escape or a number that does not exist"
            raise _fail(self.file, _find_mark(self.get_mark()), message, "", "correct or remove it") from error

    def _explain_syntax_error(self, error: yaml.MarkedYAMLError) -> ConfigFileError:
        """Convert a syntax error of PyYAML to a `ConfigFileError` with position and remedy."""
        mark = error.problem_mark or error.context_mark
        position = _find_mark(mark) if mark else (1, 1)
        message, context = escape_unprintable((error.problem or "unreadable").replace("\n", " ")), error.context or ""
        if message == "but found another document":
            remedy = "remove the '---' or split the file"
            return _fail(self.file, position, "a second document begins here", "one document per file", remedy)
        remedy = "check the indentation, the colons and the quotes here"
        opened = "line {}, column {}".format(*_find_mark(error.context_mark)) if error.context_mark else ""
        if r"'\t'" in message:
            message, remedy = "got a tab where the line is indented", "indent with spaces"
        elif message.startswith("found undefined alias"):
            remedy = "define it before with '&', or remove the '*'"
        elif context.startswith("found duplicate anchor"):
            message, remedy = context.partition(";")[0], "give each anchor its own name"
        elif opened and "flow" in context:
            remedy = f"close the bracket opened at {opened}"
        elif opened and "quoted" in context:
            remedy = f"check the quoted text that begins at {opened}"
        return _fail(self.file, position, "not valid YAML", message, remedy)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node and its children; in addition to PyYAML, enforce limits and keep the positions of aliases."""
        event, above, arguments = self.peek_event(), self._path, (parent, index)
        position, anchor = _find_mark(event.start_mark), event.anchor
        # Append the key or index of the node to the path. For the node of a key, append the text of the key, because
        # PyYAML passes no index for it.
        key = getattr(event if index is None else index, "value", index)
        self._path = () if parent is None else (*above, key if isinstance(key, int | str) else "?")
        if isinstance(event, yaml.AliasEvent):
            if anchor in self._unfinished:
                message, allowed = "an alias of a value that contains it", "aliases refer to complete values"
                raise _fail(self.file, position, message, allowed, "write the values out", path=self._path)
            node: Any = _Alias("", super().compose_node(*arguments), event.start_mark, event.end_mark)
        else:
            self._count_node(position, self._path)
            if event.tag is not None:
                # Add a fault instead of raising an error, because all faults of a file are reported together.
                message = f"got the tag {describe(event.tag)}"
                self._add_fault(position, self._path, message, "tags are not used", "remove the tag")
            self._unfinished |= {anchor} - self.anchors.keys() - {None}
            node = super().compose_node(*arguments)
            self._unfinished -= {anchor}
        self._path = above
        return node

    def _count_node(self, position: tuple[int, int], path: FieldPath) -> None:
        """Count a node; raise an error if the file has too many nodes or is nested too deeply."""
        self._nodes += 1
        if self._nodes > MAX_NODES:
            message, allowed = "too many values", f"at most {MAX_NODES} values per file"
            raise _fail(self.file, position, message, allowed, "write long axes as linear or log", path=path)
        if len(path) >= MAX_DEPTH:
            message, allowed = "the values are nested too deeply", f"at most {MAX_DEPTH} levels"
            raise _fail(self.file, position, message, allowed, "use fewer levels", path=path)

    def _add_fault(self, position: tuple[int, int], path: FieldPath, *parts: str) -> None:
        """Append a fault to `faults`; ``parts`` are the problem, the allowed values and the remedy."""
        self.faults.append(Fault(self.file, *position, format_path(path), *parts))

    def _read(self, node: Any, path: FieldPath, in_alias: bool = False) -> Any:
        """Convert a node to plain Python values and record their positions; an aliased value is located at its alias.

        Args:
            node: composed node.
            path: path of the value.
            in_alias: True if an alias refers to the node, whose children are then counted again.
        """
        self.values.setdefault(path, _find_mark(node.start_mark))
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
        """Convert a mapping node to a dict; omit keys that are not text or occur twice, and add a fault for each."""
        mapping: dict[str, Any] = {}
        for name, value in node.value:
            position = _find_mark(name.start_mark)
            key = self._read_scalar(name) if isinstance(name, yaml.ScalarNode) else None
            if not isinstance(key, str):
                message = f"got the key {describe(key)}" if isinstance(name, yaml.ScalarNode) else "got a complex key"
                self._add_fault(position, path, message, "keys are text", "write the name of a field")
            elif key in mapping:
                message = f"the key occurs twice, first in line {self.keys[*path, key][0]}"
                self._add_fault(position, (*path, key), message, "each key once", "remove one of them")
            else:
                self.keys[*path, key] = position
                mapping[key] = self._read(value, (*path, key), in_alias)
        return mapping

    def _read_scalar(self, node: Any) -> Any:
        """Convert a scalar node to None, bool, int, float or str by the core schema; overflow results in infinity."""
        text = node.value
        kind = self.resolve(yaml.ScalarNode, text, (node.style is None, True)).rpartition(":")[2]
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() == "true"
        if kind == "int" and text[:2] in ("0o", "0x"):
            return int(text, 0)
        # Read integers of 400 or more digits as floats, which are then infinite (float64 overflows above 309 digits),
        # because Python refuses to convert thousands of digits to int.
        if kind == "int" and len(text) < 400:
            return int(text)
        if kind not in ("int", "float"):
            return text
        low = text.lower().lstrip("+")
        return {".nan": math.nan, ".inf": math.inf, "-.inf": -math.inf}.get(low) or float(text)
