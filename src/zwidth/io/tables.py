"""Reader of tables that many programs write, as text or as files of NumPy or MATLAB.

Texts are converted to numbers only when a column is requested. The columns of a text are separated by commas,
semicolons, tabs or blanks. Lines of numbers are called *samples*; the separator is the one for which the first sample
has the largest fraction of cells with numbers. The column names are in the nearest line above the samples with the same
number of cells, possibly after # or %. A line of units between names and samples is added to the names; the lines above
the names are a preamble and ignored. In files of NumPy and MATLAB, each array is a column.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.io.times import CLOCK, is_time, read_clock, read_duration, to_seconds
from zwidth.units.parsing import is_unit, looks_like_number, split_head

_MOST_BYTES = 2**28  # largest size of a file in bytes
_CODINGS = ("utf-8-sig", "cp1252", "latin-1")  # character encodings, tried in this order
_GZIP = b"\x1f\x8b"  # first bytes of a file compressed by gzip
_NO_TEXT = re.compile("[\0-\x08\x0e-\x1f]")  # control characters, which do not occur in tables
# Pattern of the digits before a decimal comma and the comma.
_DECIMAL_COMMA = re.compile(r"^([-+]?[0-9]*),(?=[0-9][^.]*$)")
_FRACTION = re.compile(r"[-+]?[0-9]*([.,])[0-9]+(?:[eE][-+]?[0-9]+)?")  # number with a decimal point or comma
_PREAMBLE = 500  # largest number of lines above the samples
_LABVIEW = "***End_of_Header***"  # last line of each of the two headers of a LabVIEW file
_REMARK = re.compile(r"\s*[#%]+\s*")  # start of a comment line
_SEPARATOR = re.compile(r"\s*\"?sep=.\"?\s*$", re.IGNORECASE)  # line that specifies the separator for spreadsheets
_BLANKS = re.compile(r"\s+(?![\[(])")  # blanks between cells, but not before a unit in brackets
# Contents of cells, in lower case, that denote a missing number.
_MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-")


@dataclass(frozen=True)
class NamedColumns:
    """The columns of a file; numbers are converted only when requested."""

    heads: list[str]  # column names, possibly with units
    # Function of column indices, a type (float by default, or complex) and ``gaps``, which returns these columns as
    # arrays. With gaps=True, missing numbers become NaN; otherwise they raise an error.
    numbers: Callable[..., list[np.ndarray]]
    # Error message for callers that need column names; empty if the file has names. Without names, ``heads`` are "1",
    # "2", ...
    nameless: str = ""


def read_columns(file: Path) -> NamedColumns:
    """Return the columns of a text file or a file of NumPy or MATLAB; raise `InputError` for other files."""
    if not file.is_file():
        read_lines(file, _MOST_BYTES)
    with file.open("rb") as opened:
        begin = opened.read(8)
    if begin.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")) and not _is_npz(file):
        raise InputError(
            f"{file}: got a workbook or an archive, not a table; save the sheet as CSV UTF-8 (File, Save as) and use "
            "that file"
        )
    if begin.startswith((b"\x93NUMPY", b"PK\x03\x04")) or file.suffix.lower() == ".mat":
        return _read_arrays(file, _load_arrays(file))
    return _read_text(file, read_lines(file, _MOST_BYTES))


def read_lines(file: Path, most_bytes: int) -> list[str]:
    """Return the lines of a text file.

    The encoding is UTF-16 if the file begins with a byte order mark, otherwise UTF-8 or, if this fails, Windows-1252.
    The file may be compressed by gzip.

    Args:
        file: path of the file.
        most_bytes: largest size of the uncompressed file.

    Raises:
        InputError: the file cannot be read, is too large, or is not a text.
    """
    # Reject pipes and devices, because reading from them may not terminate.
    if not file.is_file():
        raise InputError(f"{file}: {'not a regular file' if file.exists() else 'no such file'}; check the path")
    try:
        with file.open("rb") as opened:
            raw = opened.read(most_bytes + 1)
        if raw.startswith(_GZIP):
            with gzip.open(file) as opened:
                raw = opened.read(most_bytes + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise InputError(f"{file}: its gzip data are damaged or incomplete; compress it again") from None
    except OSError as error:
        raise InputError(f"{file}: {error.strerror or error}; check the path") from None
    if len(raw) > most_bytes:
        raise InputError(f"{file}: got more than {most_bytes >> 20} MiB; use a part of the file")
    for coding in ("utf-16",) if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else _CODINGS:
        with suppress(UnicodeDecodeError):
            # Reject control characters, because they indicate binary data or a wrong encoding.
            if not _NO_TEXT.search(text := raw.decode(coding)):
                return text.splitlines()
    raise InputError(f"{file}: it is not a text in UTF-8, UTF-16 or Latin-1; save it as CSV in UTF-8")


def split_lines(file: Path, lines: list[str], first: int, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number, counted from 1, and the list of cells of each line that is not empty.

    Args:
        file: path of the file, for messages.
        lines: lines of the file.
        first: index of the first line to read.
        separator: separator of cells.
    """
    reader = csv.reader(islice(lines, first, None), delimiter=separator, skipinitialspace=True, strict=True)
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                yield first + reader.line_num, cells
    except csv.Error as error:
        raise InputError(f"{file}:{first + reader.line_num}: {error}; check the quotes") from None


def with_point(cell: str) -> str:
    """Replace the decimal comma of a number by a point; return other texts unchanged."""
    return _DECIMAL_COMMA.sub(r"\1.", cell)


class DecimalSigns:
    """Reader of numbers that must all have the same decimal sign, comma or point.

    In a table with both signs, one of them may separate thousands, so that its numbers are ambiguous.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self.first: dict[str, tuple[int, str]] = {}  # line number and text of the first number, by its decimal sign

    def read(self, line: int, cell: str) -> str:
        """Replace a decimal comma of a cell by a point; raise `InputError` if an earlier cell has the other sign."""
        if match := _FRACTION.fullmatch(cell):
            self.first.setdefault(match[1], (line, cell))
            if len(self.first) > 1:
                ((number, other),) = (first for sign, first in self.first.items() if sign != match[1])
                raise InputError(
                    f"{self.file}:{line}: got {cell!r}, and {other!r} in line {number}; all numbers must have the same "
                    "decimal sign and no thousands separators"
                )
        return with_point(cell)


def _is_npz(file: Path) -> bool:
    """Return whether a file is an archive of NumPy arrays."""
    with suppress(zipfile.BadZipFile, OSError), zipfile.ZipFile(file) as archive:
        return all(name.endswith(".npy") for name in archive.namelist())
    return False


def _load_arrays(file: Path) -> dict[str, Any]:
    """Return the arrays of a file of NumPy or MATLAB by name; the name of a single array of NumPy is empty."""
    try:
        if file.suffix.lower() == ".mat":
            from scipy.io import loadmat

            return {name: array for name, array in loadmat(file).items() if not name.startswith("__")}
        loaded: Any = np.load(file, allow_pickle=False)
        if not isinstance(loaded, np.ndarray):
            with loaded:
                return dict(loaded)
        if loaded.dtype.names:
            return {name: loaded[name] for name in loaded.dtype.names}
        return {"": loaded}
    except NotImplementedError:
        raise InputError(f"{file}: got MATLAB format 7.3; save it again with save('log.mat', '-v7')") from None
    except Exception as error:
        # Catch all exceptions, because the readers raise exceptions of many types for damaged files.
        contents = "Python objects, which may run code" if "pickle" in str(error).lower() else "no readable arrays"
        raise InputError(f"{file}: got {contents}; save columns of numbers, or a CSV file") from error


def _read_arrays(file: Path, arrays: dict[str, Any]) -> NamedColumns:
    """Return the one-dimensional arrays of a file as columns; if the file has only one matrix, the matrix's columns."""
    columns = {name: array for name, array in arrays.items() if getattr(array, "size", 0) > 1}
    flat = {name: array.ravel() for name, array in columns.items() if max(array.shape) == array.size}
    wide = {name: array for name, array in columns.items() if name not in flat and array.ndim == 2}
    named = bool(flat)
    if not flat and len(wide) == 1:
        (matrix,) = wide.values()
        flat = {str(k + 1): column for k, column in enumerate(matrix.T)}
    flat = {name: array for name, array in flat.items() if array.dtype.kind in "fiubcM"}
    if not flat:
        shapes = ", ".join(f"{name or 'an array'} {np.shape(array)}" for name, array in arrays.items()) or "nothing"
        raise InputError(f"{file}: got {shapes[:200]}; save a column of numbers for each quantity")
    heads, values = list(flat), list(flat.values())

    def numbers(indices: Sequence[int], kind: type = float, gaps: bool = False) -> list[np.ndarray]:
        sizes = {heads[k]: values[k].size for k in indices}
        if len(set(sizes.values())) > 1:
            text = ", ".join(f"{name!r} {size}" for name, size in sizes.items())
            raise InputError(f"{file}: the columns have different lengths, {text}; save one value per sample in each")
        columns_read = []
        for k in indices:
            is_time_column = values[k].dtype.kind == "M"
            if values[k].dtype.kind == "c" and kind is float:
                raise InputError(f"{file}: got complex numbers in {heads[k]!r}; real numbers are needed")
            column = to_seconds(values[k]) if is_time_column else values[k].astype(kind)
            bad = np.flatnonzero(~np.isfinite(column))
            if bad.size and not gaps:
                raise InputError(f"{file}: got {column[bad[0]]} in {heads[k]!r} at sample {bad[0]}; a number is needed")
            columns_read.append(column)
        return columns_read

    return NamedColumns(heads, numbers, "" if named else f"{file}: its columns have no names")


class _Layout(NamedTuple):
    """Layout of a table in a text: the indices of its lines, counted from 0, and its separator."""

    names: int | None  # index of the line with the column names; None without names
    units: int | None  # index of the line with the units; None without such a line
    begin: int  # index of the first sample
    separator: str  # separator of cells


def _read_text(file: Path, lines: list[str]) -> NamedColumns:
    """Return the columns of a text; raise `InputError` if it has only one column or no samples.

    Args:
        file: path of the text, for messages.
        lines: all lines of the text.
    """
    if not any(map(holds_data, lines)):
        raise InputError(f"{file}: it is empty; write a line of column names and one line per sample")
    layout = _find_layout(lines)
    separator = layout.separator
    names, top = layout.names, layout.begin if layout.names is None else layout.names
    heads = _split(lines[top], separator)
    if len(heads) == 1:
        got = lines[top].strip()[:60]
        raise InputError(f"{file}:{top + 1}: got {got!r}; separate the columns by commas, semicolons, tabs or blanks")
    if names is None:
        heads = [str(k + 1) for k in range(len(heads))]
    elif layout.units is not None:
        units = [cell.strip("[]()") for cell in _split(lines[layout.units], separator)]
        # Add the unit of the line of units, unless the name of the column already contains a unit.
        added = [
            f" [{unit}]" if is_unit(unit) and not split_head(head)[1] else ""
            for head, unit in zip(heads, units, strict=False)
        ]
        heads = [head + unit for head, unit in zip_longest(heads, added, fillvalue="")]
    if not any(line.strip() for line in lines[layout.begin :]):
        raise InputError(f"{file}: got column names without samples; record the log again")

    def numbers(indices: Sequence[int], kind: type = float, gaps: bool = False) -> list[np.ndarray]:
        columns = _read_with_numpy(lines, layout, len(heads), indices) if kind is float else None
        return _read_cells(file, lines, layout, heads, indices, kind, gaps) if columns is None else columns

    nameless = f"{file}:{top + 1}: got numbers where the names of the columns are expected"
    return NamedColumns(heads, numbers, nameless if names is None else "")


def _split(line: str, separator: str) -> list[str]:
    """Return the cells of a line, without a comment sign at its start."""
    line = _REMARK.sub("", line, count=1) if _REMARK.match(line) else line.strip()
    if separator == " ":
        return _BLANKS.split(line.strip())
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def holds_data(line: str) -> bool:
    """Return whether a line is neither empty nor a comment nor the specification of a separator, "sep=;"."""
    return bool(line.strip()) and not _REMARK.match(line) and not _SEPARATOR.match(line)


def _count_numbers(cells: list[str]) -> int:
    """Return the number of cells with a number, a duration or NaN."""
    return sum(
        _read_number(read_duration(with_point(cell)), complex) is not None or cell.lower() == "nan" for cell in cells
    )


def _holds_sample(row: list[str]) -> bool:
    """Return whether a row is a sample.

    A sample has at least two numbers, or one number while all other cells, at least two, are empty.
    """
    numbers = _count_numbers(row)
    return numbers >= 2 or (numbers == 1 and len(row) > 2 and sum(map(bool, row)) == 1)


def _read_number(text: str, kind: type) -> Any:
    """Convert a text to a finite number of type ``kind``, float or complex; return None for other texts.

    Complex numbers end with i or j.
    """
    if looks_like_number(text):
        return kind(text) if np.isfinite(float(text)) else None
    if kind is complex and text[-1:] in ("i", "j") and "_" not in text:
        with suppress(ValueError):
            value = complex(text.replace(" ", "").replace("i", "j"))
            return value if np.isfinite(value) else None
    return None


def _find_layout(lines: list[str]) -> _Layout:
    """Determine the separator, the first sample, and the lines of names and units above the first sample."""
    # Skip the headers of LabVIEW files, because their lines contain numbers as well.
    headers = [k for k, line in enumerate(lines[:_PREAMBLE]) if line.startswith(_LABVIEW)]
    first = headers[-1] + 1 if headers else 0
    nonempty = [k for k in range(first, min(len(lines), _PREAMBLE)) if lines[k].strip()]
    best: tuple[float, int, str] | None = None
    for separator in "\t;, ":
        rows = [_split(lines[k], separator) for k in nonempty]
        is_sample = [_holds_sample(row) and not _REMARK.match(lines[k]) for k, row in zip(nonempty, rows, strict=True)]
        for position, (k, row) in enumerate(zip(nonempty, rows, strict=True)):
            above = position > 0 and not is_sample[position - 1] and len(rows[position - 1]) == len(row)
            if is_sample[position] and (above or position + 1 == len(nonempty) or is_sample[position + 1]):
                fraction = _count_numbers(row) / len(row)
                best = (fraction, k, separator) if best is None or fraction > best[0] else best
                break
    if best is None:
        first = next(k for k, line in enumerate(lines) if holds_data(line))
        separator = next((mark for mark in "\t;," if mark in lines[first]), " ")
        return _Layout(first, None, first + 1, separator)
    _, begin, separator = best
    width = len(_trim(_split(lines[begin], separator)))
    above = [k for k in reversed(nonempty) if k < begin]
    # LabVIEW writes an additional name "Comment" at the end, although the samples have no such column.
    if above and (heads := _split(lines[above[0]], separator))[-1:] == ["Comment"] and len(heads) == width + 1:
        return _Layout(above[0], None, begin, separator)
    cells = len(_split(lines[begin], separator))
    named = [k for k in above if len(_trim(_split(lines[k], separator))) == width]
    # If no line matches, also count empty cells at the end of the first sample, because their columns may have names.
    named = named or [k for k in above if len(_split(lines[k], separator)) == cells]
    if not named:
        plain = [k for k in above if holds_data(lines[k])]
        return _Layout(plain[0] if plain else None, None, begin, separator)
    cells = [cell.strip("[]()") for cell in _split(lines[named[0]], separator)]
    if len(named) > 1 and sum(map(is_unit, cells)) >= 2 and all(is_unit(cell) or len(cell) <= 5 for cell in cells):
        return _Layout(named[1], named[0], begin, separator)
    return _Layout(named[0], None, begin, separator)


def _trim(cells: list[str]) -> list[str]:
    """Return the cells without empty cells at the end."""
    return cells[: max((k + 1 for k, cell in enumerate(cells) if cell), default=0)]


def _read_with_numpy(lines: list[str], layout: _Layout, count: int, indices: Sequence[int]) -> list[np.ndarray] | None:
    """Read columns with `numpy.loadtxt`, which is fast; return None if the function cannot read them.

    The caller then uses `_read_cells`, whose errors name the line.

    Args:
        lines: lines of the table.
        layout: first line of the samples, and the separator.
        count: number of columns of the table.
        indices: indices of the columns to read.
    """
    begin, separator = layout.begin, layout.separator
    time_columns = _find_time_columns(lines, layout, indices)
    if separator != "," and all(any(sign in line for line in islice(lines, begin, None)) for sign in ",."):
        # Leave a table with decimal commas and points to `_read_cells`, which requires equal decimal signs.
        return None
    if separator == " ":
        width = max(len(line.split()) for line in lines[begin:])
    else:
        width = 1 + max(line.count(separator) for line in lines[begin:])
    if width > count:
        return None
    options: dict[str, Any] = {"comments": None, "quotechar": '"', "ndmin": 1}
    options["delimiter"] = None if separator == " " else separator
    columns = {}
    try:
        for index in indices:
            rows: Iterable[str] = islice(lines, begin, None)
            if index in time_columns:
                columns[index] = read_clock(np.loadtxt(rows, usecols=index, dtype="U40", **options))
                continue
            rows = rows if separator == "," else (line.replace(",", ".") for line in rows)
            columns[index] = np.loadtxt(rows, usecols=index, dtype=float, **options)
    except (ValueError, IndexError, TypeError):
        return None
    return (
        [columns[index] for index in indices] if all(np.all(np.isfinite(each)) for each in columns.values()) else None
    )


def _read_cells(
    file: Path,
    lines: list[str],
    layout: _Layout,
    heads: list[str],
    indices: Sequence[int],
    kind: type,
    gaps: bool,
) -> list[np.ndarray]:
    """Read columns cell by cell.

    Args:
        file: path of the table, for messages.
        lines: lines of the table.
        layout: first line of the samples, and the separator.
        heads: names of all columns.
        indices: indices of the columns to read.
        kind: float or complex.
        gaps: return NaN for missing numbers instead of raising an error.

    Raises:
        InputError: a cell contains no number and is not a missing number, or a line has too many cells.
    """
    separator, collected = layout.separator, [[] for _ in indices]
    if separator == " ":
        rows = ((k + 1, lines[k].split()) for k in range(layout.begin, len(lines)) if lines[k].strip())
    else:
        rows = split_lines(file, lines, layout.begin, separator)
    time_columns, signs = _find_time_columns(lines, layout, indices), DecimalSigns(file)
    for number, cells in rows:
        if any(cells[len(heads) :]):
            hint = "; a comma as decimal sign requires semicolons between the columns" if separator == "," else ""
            raise InputError(f"{file}:{number}: got {len(cells)} cells for {len(heads)} columns{hint}")
        for column, index in zip(collected, indices, strict=True):
            cell = cells[index] if index < len(cells) else ""
            if gaps and index not in time_columns and cell.lower() in _MISSING:
                column.append(np.nan)
                continue
            value = _read_number(read_duration(cell if separator == "," else signs.read(number, cell)), kind)
            if not is_time(cell) if index in time_columns else value is None:
                allowed = "a time such as 2024-05-01T12:00:00.001" if index in time_columns else "a number"
                raise InputError(
                    f"{file}:{number}: got {repr(cell) if cell else 'nothing'} under {heads[index]!r}; "
                    f"{allowed} is needed"
                )
            column.append(cell if index in time_columns else value)
    columns = zip(indices, map(np.array, collected), strict=True)
    return [read_clock(column) if index in time_columns else column for index, column in columns]


def _find_time_columns(lines: list[str], layout: _Layout, indices: Sequence[int]) -> list[int]:
    """Return those of the given column indices whose first sample is a time of day, with or without a date."""
    first = _split(lines[layout.begin], layout.separator)
    return [k for k in indices if k < len(first) and CLOCK.fullmatch(first[k])]
