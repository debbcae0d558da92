"""Tables of devices for sweeps: parameters that vary together, one row per device.

A table is written in the configuration as lists of equal length, or read from a CSV file whose header has the names of
the parameters and, in brackets, their units. File names are relative to the folder of the configuration.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import PlainSerializer, PlainValidator, ValidationError, WithJsonSchema
from pydantic_core import PydanticCustomError

from zwidth.config.fields import (
    LocatedProblem,
    Strict,
    combine_problems,
    escape_unprintable,
    list_problems,
    problem,
    quote_names,
)
from zwidth.config.values import quantity_of, read_entries, share_schema
from zwidth.core.contexts import set_temporarily
from zwidth.core.errors import InputError
from zwidth.io.tables import DecimalSigns, holds_data, read_lines, split_lines
from zwidth.units.formatting import describe, from_cell, resembling, suggestion
from zwidth.units.parsing import looks_like_number, split_title
from zwidth.units.quantities import PARAMETERS

LABEL = "label"  # column with a name for each device
MAX_ROWS = 100_000  # devices per table
_COLUMNS = (LABEL, *PARAMETERS)  # names of the columns that are read; others are ignored
MAX_CSV_BYTES = 2**25  # bytes per file (32 MiB)

_FORMS = "lists of equal length under the names of parameters, or {csv: FILE}"

# Folder of the configuration that is being read. It is stored in a context variable, because pydantic passes only the
# value of a field to a validator.
_folder: ContextVar[Path] = ContextVar("folder", default=Path())


def files_relative_to(folder: Path) -> AbstractContextManager[None]:
    """Return a context manager; while it is active, `find_file` resolves file names relative to ``folder``."""
    return set_temporarily(_folder, folder)


def find_file(name: str) -> Path:
    """Return the path of a file whose name in the configuration is relative to the folder of the configuration."""
    return _folder.get() / name


@dataclass(frozen=True)
class DeviceTable:
    """Parameters of several devices, one row per device."""

    columns: dict[str, tuple[float, ...]]  # values by the name of the parameter, in SI base units
    labels: tuple[str, ...] = ()  # one name per device, or empty if the devices have no names
    in_periods: bool = False  # True if the column ``delay`` is in sampling periods instead of seconds

    @property
    def size(self) -> int:
        """Number of devices."""
        return len(next(iter(self.columns.values())))

    def values(self, name: str) -> np.ndarray:
        """Return the column of a parameter as a float64 array with one value per device."""
        return np.array(self.columns[name], dtype=np.float64)

    def serialize(self) -> dict[str, Any]:
        """Return the table as a dict of lists by column name, the form in which a configuration file contains it."""
        lists: dict[str, Any] = {LABEL: list(self.labels)} if self.labels else {}
        lists |= {name: list(values) for name, values in self.columns.items()}
        if self.in_periods:
            lists["delay"] = [f"{value!r} periods" for value in lists["delay"]]
        return lists


def read_table(raw: Any) -> DeviceTable:
    """Read a table of devices from its value in a configuration: a mapping of lists, or ``{csv: FILE}``."""
    if not isinstance(raw, dict):
        raise problem(f"got {describe(raw)}", f"devices are {_FORMS}", "write {csv: devices.csv}")
    return _read_csv(raw) if "csv" in raw else _read_lists(raw)


def _read_lists(raw: dict[str, Any]) -> DeviceTable:
    """Convert a mapping of column names to lists of equal length to a table; raise one error with all problems."""
    problems: list[LocatedProblem] = []
    columns: dict[str, tuple[Any, ...]] = {}
    in_periods = False
    for key, cells in raw.items():
        if key not in _COLUMNS:
            fault = problem("unknown key", f"devices are {_FORMS}", suggestion(key, _COLUMNS, "remove it"), on_key=True)
            problems.append(((key,), fault))
        elif not isinstance(cells, list | tuple):
            fault = problem(f"got {describe(cells)}", "a column of devices is a list", "write [value, value, ...]")
            problems.append(((key,), fault))
        else:
            read, units = (_check_label, set()) if key == LABEL else quantity_of(key).read_alike()
            try:
                columns[key] = read_entries(cells, read, distinct=False) if cells or key != LABEL else ()
            except (PydanticCustomError, ValidationError) as error:
                problems += list_problems(error, key)
            in_periods |= "periods" in units
    if problems:
        raise combine_problems("devices", problems)
    labels = columns.pop(LABEL, ())
    if not columns:
        raise problem("got no parameter", f"devices are {_FORMS}", f"add a column such as {'mass'!r}")
    lengths = {name: len(values) for name, values in columns.items()} | ({LABEL: len(labels)} if labels else {})
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise problem(
            f"got columns of different length: {sizes}", "all columns have one entry per row", "complete them"
        )
    rows = next(iter(lengths.values()))
    if rows > MAX_ROWS:
        raise problem(f"got {rows} rows", f"at most {MAX_ROWS} devices per study", "split the table")
    return DeviceTable(columns, labels, in_periods)


def _check_label(cell: Any) -> Any:
    """Return a label unchanged; raise a problem if it is not a text or is empty."""
    if not isinstance(cell, str) or not cell.strip():
        raise problem(f"got {describe(cell)}", "a label is text", "put it in quotes")
    return cell


class _TableFile(Strict, noun="a table from a file"):
    """Model of the mapping ``{csv: FILE}``, which names the CSV file of a table."""

    csv: str


def _read_csv(raw: dict[str, Any]) -> DeviceTable:
    """Read a table of devices from the CSV file that the mapping ``{csv: FILE}`` names."""
    name = _TableFile.model_validate(raw).csv
    try:
        rows = _read_rows(name)
        return _parse_rows(rows, _choose_columns(rows[0][1], name), name)
    except PydanticCustomError as error:
        raise combine_problems("devices", [(("csv",), error)]) from None


def _read_rows(name: str) -> list[tuple[int, list[str]]]:
    """Return a list of pairs (line number, cells): the header of a CSV file, then its rows that are not empty.

    Lines above the header are skipped if they are comments, which begin with # or %, or the line ``sep=;`` that
    spreadsheets write. The separator of the cells is the first of tab, semicolon and comma that the header contains.
    If the separator is not the comma, commas in numbers are decimal signs.
    """
    file = find_file(name)
    try:
        lines = read_lines(file, MAX_CSV_BYTES)
        first = next((k for k, line in enumerate(lines) if holds_data(line)), len(lines))
        separator = next((mark for mark in "\t;" if mark in "".join(lines[first : first + 1])), ",")
        rows = [row for row in split_lines(file, lines, first, separator) if not row[1][0].startswith("#")]
        if separator != ",":
            signs = DecimalSigns(file)
            rows[1:] = [(line, [signs.read(line, cell) for cell in cells]) for line, cells in rows[1:]]
    except InputError as error:
        message, *allowed, remedy = str(error).split("; ", 2)
        allowed = allowed[0] if allowed else "names are relative to this file"
        raise problem(escape_unprintable(message), allowed, remedy) from None
    if len(rows) < 2:
        raise problem(
            f"{escape_unprintable(name)} has {len(rows)} rows", "a header and at least one row", "fill the file"
        )
    return rows


def _choose_columns(header: list[str], name: str) -> dict[str, tuple[int, str]]:
    """Return the column index and the unit of each parameter in the header, by the name of the parameter.

    Columns that are not parameters are ignored. ``name`` is the name of the file for messages.
    """
    chosen: dict[str, tuple[int, str]] = {}
    for index, title in enumerate(header):
        key, unit = split_title(title)
        if key in chosen:
            raise problem(
                f"{escape_unprintable(name)}: the column {describe(key)} occurs twice", "each once", "remove one"
            )
        if key in _COLUMNS:
            chosen[key] = index, unit
        elif resembling(key, _COLUMNS):
            # Refuse names similar to those of parameters, because a misspelled parameter would be ignored. Other
            # columns, such as "source", are allowed and ignored.
            message = f"{escape_unprintable(name)}: got the column {describe(key)}"
            raise problem(
                message, f"columns are {quote_names(_COLUMNS)}, and others", suggestion(key, _COLUMNS, "rename it")
            )
    return chosen


def _parse_rows(rows: list[tuple[int, list[str]]], chosen: dict[str, tuple[int, str]], name: str) -> DeviceTable:
    """Convert the chosen columns of a CSV file to a table; error messages contain the line in the file.

    Args:
        rows: line number and cells of each row, the header first.
        chosen: index and unit of each column to read, by the name of its parameter.
        name: name of the file for messages.
    """
    lists: dict[str, list[Any]] = {key: [] for key in chosen}
    for key, (index, unit) in chosen.items():
        for line, row in rows[1:]:
            if index >= len(row) or not row[index]:
                allowed = "every device has a value for every parameter"
                raise problem(f"{escape_unprintable(name)}, line {line}: {key} is missing", allowed, "fill the cell")
            lists[key].append(from_cell(row[index]) if key == LABEL else _to_value(row[index], unit))
    try:
        return _read_lists(lists)
    except ValidationError as error:
        ((key, row), fault), *_ = list_problems(error)
        context = fault.context or {}
        position = f"{escape_unprintable(name)}, line {rows[1 + int(row)][0]}: {key}"
        raise problem(f"{position}: {context['message']}", context["allowed"], context["remedy"]) from None


def _to_value(cell: str, unit: str) -> float | str:
    """Convert a CSV cell to a number or a text with a unit; a number without a unit gets the unit of its column."""
    return cell if not looks_like_number(cell) else f"{cell} {unit}" if unit else float(cell)


def _make_schema() -> dict[str, Any]:
    """Return the JSON Schema of a table of devices in both forms, lists and ``{csv: FILE}``."""
    column = share_schema("column", {"type": "array", "minItems": 1, "items": {"type": ["number", "string"]}})
    labels = {"type": "array", "minItems": 1, "items": {"type": "string"}}
    lists = {LABEL: labels, **dict.fromkeys(PARAMETERS, column)}
    keys = {"csv": {"type": "string"}}
    closed = {"type": "object", "additionalProperties": False}
    forms = [{"properties": lists, "minProperties": 1, **closed}, {"properties": keys, "required": ["csv"], **closed}]
    return {"description": f"Devices: {_FORMS}.", "anyOf": forms}


_SERIALIZER = PlainSerializer(DeviceTable.serialize, return_type=dict[str, Any])
TableField = Annotated[DeviceTable, PlainValidator(read_table), _SERIALIZER, WithJsonSchema(_make_schema())]
