"""Parameters that move together: one row a device, written in the file or read from a CSV file."""

from __future__ import annotations

from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import PlainSerializer, PlainValidator, ValidationError, WithJsonSchema
from pydantic_core import PydanticCustomError

from zwidth.config.fields import LocatedProblem, Strict, listing, printable, problem, problems_of, validation_error
from zwidth.config.values import quantity_of, read_entries, share
from zwidth.words.contexts import set_temporarily
from zwidth.words.errors import InputError
from zwidth.words.formatting import describe, from_cell, resembling, suggestion
from zwidth.words.quantities import PARAMETERS
from zwidth.words.tables import DecimalSigns, holds_data, read_lines, split_lines
from zwidth.words.units import looks_like_number, split_title

LABEL = "label"
MAX_ROWS = 100_000
_KNOWN = (LABEL, *PARAMETERS)
MAX_CSV_BYTES = 2**25

_FORMS = "lists of equal length under the names of parameters, or {csv: FILE}"

# A context variable, because values of a configuration do not contain its folder.
_folder: ContextVar[Path] = ContextVar("folder", default=Path())


def files_relative_to(folder: Path) -> AbstractContextManager[None]:
    """Return a context manager in which file names in a configuration are relative to a folder."""
    return set_temporarily(_folder, folder)


def find_file(name: str) -> Path:
    """Return the path of a file named in the configuration that is being read."""
    return _folder.get() / name


@dataclass(frozen=True)
class DeviceTable:
    """Rows of parameters."""

    columns: dict[str, tuple[float, ...]]  # the parameters in base units
    labels: tuple[str, ...] = ()  # a name for each row, or none at all
    in_periods: bool = False  # whether the column ``delay`` counts sampling periods; else it is in seconds

    @property
    def size(self) -> int:
        return len(next(iter(self.columns.values())))

    def values(self, name: str) -> np.ndarray:
        return np.array(self.columns[name], dtype=np.float64)

    def spelling(self) -> dict[str, Any]:
        """The table as a configuration file writes it, whether it came from a CSV file or not."""
        lists: dict[str, Any] = {LABEL: list(self.labels)} if self.labels else {}
        lists |= {name: list(values) for name, values in self.columns.items()}
        if self.in_periods:
            lists["delay"] = [f"{value!r} periods" for value in lists["delay"]]
        return lists


def read_table(raw: Any) -> DeviceTable:
    """A validator for a table in any of its forms."""
    if not isinstance(raw, dict):
        raise problem(f"got {describe(raw)}", f"devices are {_FORMS}", "write {csv: devices.csv}")
    return _read_csv(raw) if "csv" in raw else _read_lists(raw)


def _read_lists(raw: dict[str, Any]) -> DeviceTable:
    found: list[LocatedProblem] = []
    columns: dict[str, tuple[Any, ...]] = {}
    in_periods = False
    for key, cells in raw.items():
        if key not in _KNOWN:
            what = problem("unknown key", f"devices are {_FORMS}", suggestion(key, _KNOWN, "remove it"), on_key=True)
            found.append(((key,), what))
        elif not isinstance(cells, list | tuple):
            what = problem(f"got {describe(cells)}", "a column of devices is a list", "write [value, value, ...]")
            found.append(((key,), what))
        else:
            entry, units = (_check_label, set()) if key == LABEL else quantity_of(key).read_alike()
            try:
                columns[key] = read_entries(cells, entry, distinct=False) if cells or key != LABEL else ()
            except (PydanticCustomError, ValidationError) as error:
                found += problems_of(error, key)
            in_periods |= "periods" in units
    if found:
        raise validation_error("devices", found)
    labels = columns.pop(LABEL, ())
    if not columns:
        raise problem("got no parameter", f"devices are {_FORMS}", f"add a column such as {'mass'!r}")
    lengths = {name: len(values) for name, values in columns.items()} | ({LABEL: len(labels)} if labels else {})
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise problem(f"got columns of different length: {sizes}", "all columns have one entry a row", "complete them")
    rows = next(iter(lengths.values()))
    if rows > MAX_ROWS:
        raise problem(f"got {rows} rows", f"at most {MAX_ROWS} devices a study", "split the table")
    return DeviceTable(columns, labels, in_periods)


def _check_label(cell: Any) -> Any:
    if not isinstance(cell, str) or not cell.strip():
        raise problem(f"got {describe(cell)}", "a label is text", "put it in quotes")
    return cell


class _TableFile(Strict, what="a table from a file"):
    csv: str


def _read_csv(raw: dict[str, Any]) -> DeviceTable:
    """A table from a file, whose header names parameters and, in brackets, their units."""
    name = _TableFile.model_validate(raw).csv
    try:
        rows = _read_rows(name)
        return _parse_rows(rows, _choose_columns(rows[0][1], name), name)
    except PydanticCustomError as error:
        raise validation_error("devices", [(("csv",), error)]) from None


def _read_rows(name: str) -> list[tuple[int, list[str]]]:
    """The header of a CSV file and the rows below it that hold something, each with its line."""
    # Remarks above it begin with # or %, or are the ``sep=;`` of spreadsheets. Columns are separated by tabs, else
    # semicolons, else commas: the first of these that the header holds. Where commas do not separate, they may be
    # decimal signs.
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
        what, *allowed, remedy = str(error).split("; ", 2)
        allowed = allowed[0] if allowed else "names are relative to this file"
        raise problem(printable(what), allowed, remedy) from None
    if len(rows) < 2:
        raise problem(f"{printable(name)} has {len(rows)} rows", "a header and one row at least", "fill the file")
    return rows


def _choose_columns(header: list[str], name: str) -> dict[str, tuple[int, str]]:
    """For every parameter that the file holds its column and unit."""
    chosen: dict[str, tuple[int, str]] = {}
    for index, title in enumerate(header):
        key, unit = split_title(title)
        if key in chosen:
            raise problem(f"{printable(name)}: the column {describe(key)} comes twice", "each once", "remove one")
        if key in _KNOWN:
            chosen[key] = index, unit
        elif resembling(key, _KNOWN):
            # A misspelled column must not be taken for a remark; other ones, as a source, are the reader's own.
            what = f"{printable(name)}: got the column {describe(key)}"
            raise problem(what, f"columns are {listing(_KNOWN)}, and others", suggestion(key, _KNOWN, "rename it"))
    return chosen


def _parse_rows(rows: list[tuple[int, list[str]]], chosen: dict[str, tuple[int, str]], name: str) -> DeviceTable:
    """The chosen columns of a file's rows, read as lists are; a fault is told with its line."""
    lists: dict[str, list[Any]] = {key: [] for key in chosen}
    for key, (index, unit) in chosen.items():
        for line, row in rows[1:]:
            if index >= len(row) or not row[index]:
                allowed = "every device has a value for every parameter"
                raise problem(f"{printable(name)}, line {line}: {key} is missing", allowed, "fill the cell")
            lists[key].append(from_cell(row[index]) if key == LABEL else _to_value(row[index], unit))
    try:
        return _read_lists(lists)
    except ValidationError as error:
        ((key, row), what), *_ = problems_of(error)
        context = what.context or {}
        place = f"{printable(name)}, line {rows[1 + int(row)][0]}: {key}"
        raise problem(f"{place}: {context['what']}", context["allowed"], context["remedy"]) from None


def _to_value(cell: str, unit: str) -> float | str:
    """A number in the header's unit, or a number with a unit of its own."""
    return cell if not looks_like_number(cell) else f"{cell} {unit}" if unit else float(cell)


def _make_schema() -> dict[str, Any]:
    column = share("column", {"type": "array", "minItems": 1, "items": {"type": ["number", "string"]}})
    labels = {"type": "array", "minItems": 1, "items": {"type": "string"}}
    lists = {LABEL: labels, **dict.fromkeys(PARAMETERS, column)}
    keys = {"csv": {"type": "string"}}
    closed = {"type": "object", "additionalProperties": False}
    forms = [{"properties": lists, "minProperties": 1, **closed}, {"properties": keys, "required": ["csv"], **closed}]
    return {"description": f"Devices: {_FORMS}.", "anyOf": forms}


_SPELLED = PlainSerializer(DeviceTable.spelling, return_type=dict[str, Any])
TableField = Annotated[DeviceTable, PlainValidator(read_table), _SPELLED, WithJsonSchema(_make_schema())]
