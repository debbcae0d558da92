"""Tables in files as programs write them: named columns, numbers when asked for.

Texts have their columns between commas, semicolons, tabs or blanks. The first lines of numbers tell by which, and the
line of names is the nearest one above them with as many cells, behind # or % too; what stands above it is a preamble,
and a line of units alone between the two belongs to the names. Files of NumPy and MATLAB have arrays for columns.
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

from zwidth.words.clocks import CLOCK, is_time, read_clock, read_duration, to_seconds
from zwidth.words.errors import InputError
from zwidth.words.units import is_unit, looks_like_number, split_head

_MOST_BYTES = 2**28
_CODINGS, _GZIP, _NO_TEXT = ("utf-8-sig", "cp1252", "latin-1"), b"\x1f\x8b", re.compile("[\0-\x08\x0e-\x1f]")
_DECIMAL_COMMA = re.compile(r"^([-+]?[0-9]*),(?=[0-9][^.]*$)")
_FRACTION = re.compile(r"[-+]?[0-9]*([.,])[0-9]+(?:[eE][-+]?[0-9]+)?")
# Lines that may stand above the numbers.
_PREAMBLE = 500
_LABVIEW = "***End_of_Header***"  # last line of each of the two headers of a LabVIEW file
_REMARK = re.compile(r"\s*[#%]+\s*")
_SEPARATOR = re.compile(r"\s*\"?sep=.\"?\s*$", re.IGNORECASE)
_BLANKS = re.compile(r"\s+(?![\[(])")
# Contents of cells, in lower case, that denote a missing number.
_MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-")


@dataclass(frozen=True)
class NamedColumns:
    """Columns of a file, whose numbers are read when they are asked for."""

    heads: list[str]  # their names, perhaps with units
    # Return the columns with the given indices as arrays of the given type, float or complex (float by default). With
    # gaps=True, missing numbers are NaN; otherwise they raise an error.
    numbers: Callable[..., list[np.ndarray]]
    nameless: str = ""  # says so where the names are 1, 2, ...


def read_columns(file: Path) -> NamedColumns:
    """The columns of a file of any known kind; raise `InputError` for others, with how to save them."""
    if not file.is_file():
        read_lines(file, _MOST_BYTES)
    with file.open("rb") as opened:
        begin = opened.read(8)
    if begin.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")) and not _is_npz(file):
        raise InputError(
            f"{file}: it is a workbook or an archive, not a table; save the sheet as CSV UTF-8 (File, Save as), and "
            "give that file"
        )
    if begin.startswith((b"\x93NUMPY", b"PK\x03\x04")) or file.suffix.lower() == ".mat":
        return _table_arrays(file, _load(file))
    return _table_text(file, read_lines(file, _MOST_BYTES))


def read_lines(file: Path, most_bytes: int) -> list[str]:
    """The lines of a text: UTF-8, UTF-16 with its mark, else Latin-1 as Windows has it; packed by gzip or not."""
    # A pipe would be waited for.
    if not file.is_file():
        raise InputError(f"{file}: {'it is no file' if file.exists() else 'no such file'}; check the path")
    try:
        with file.open("rb") as opened:
            raw = opened.read(most_bytes + 1)
        if raw.startswith(_GZIP):
            with gzip.open(file) as opened:
                raw = opened.read(most_bytes + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise InputError(f"{file}: its gzip is cut off or broken; pack it again") from None
    except OSError as error:
        raise InputError(f"{file}: {error.strerror or error}; check the path") from None
    if len(raw) > most_bytes:
        raise InputError(f"{file}: it has more than {most_bytes >> 20} MiB; take a part of it")
    for coding in ("utf-16",) if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else _CODINGS:
        with suppress(UnicodeDecodeError):
            # Of numbers and names none are control characters.
            if not _NO_TEXT.search(text := raw.decode(coding)):
                return text.splitlines()
    raise InputError(f"{file}: it is no text in UTF-8, UTF-16 or Latin-1; save it as CSV in UTF-8")


def split_lines(file: Path, lines: list[str], first: int, separator: str) -> Iterator[tuple[int, list[str]]]:
    """The cells of each line from the first on that holds something, with its number."""
    reader = csv.reader(islice(lines, first, None), delimiter=separator, skipinitialspace=True, strict=True)
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                yield first + reader.line_num, cells
    except csv.Error as error:
        raise InputError(f"{file}:{first + reader.line_num}: {error}; check the quotes") from None


def with_point(cell: str) -> str:
    """A number with a decimal comma, with a point."""
    return _DECIMAL_COMMA.sub(r"\1.", cell)


class DecimalSigns:
    """The decimal sign of a table, a comma or a point: of one with both, either may group the digits of thousands."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.first: dict[str, tuple[int, str]] = {}

    def read(self, line: int, cell: str) -> str:
        """A cell with a point; raise `InputError` for the first whose sign is not that of those before."""
        if match := _FRACTION.fullmatch(cell):
            self.first.setdefault(match[1], (line, cell))
            if len(self.first) > 1:
                ((number, other),) = (place for sign, place in self.first.items() if sign != match[1])
                raise InputError(
                    f"{self.file}:{line}: got {cell!r}, and {other!r} in line {number}; a comma is a decimal sign or "
                    "groups digits, not both; write all numbers with one decimal sign, and group no digits"
                )
        return with_point(cell)


def _is_npz(file: Path) -> bool:
    with suppress(zipfile.BadZipFile, OSError), zipfile.ZipFile(file) as archive:
        return all(name.endswith(".npy") for name in archive.namelist())
    return False


def _load(file: Path) -> dict[str, Any]:
    """The arrays of a file of NumPy or MATLAB, by name; of a single one without names its columns, by number."""
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
        raise InputError(f"{file}: it is of MATLAB's version 7.3; save it again with save('log.mat', '-v7')") from None
    except Exception as error:
        # Whatever a broken file makes of its reader.
        what = "objects, which may run programs" if "pickle" in str(error).lower() else "no arrays that can be read"
        raise InputError(f"{file}: it holds {what}; save columns of numbers, or a CSV file") from error


def _table_arrays(file: Path, arrays: dict[str, Any]) -> NamedColumns:
    """Columns of equal length; a matrix alone is taken by its columns."""
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
        raise InputError(f"{file}: got {shapes[:200]}; give a column of numbers for each quantity")
    heads, values = list(flat), list(flat.values())

    def numbers(places: Sequence[int], kind: type = float, gaps: bool = False) -> list[np.ndarray]:
        sizes = {heads[at]: values[at].size for at in places}
        if len(set(sizes.values())) > 1:
            text = ", ".join(f"{name!r} {size}" for name, size in sizes.items())
            raise InputError(f"{file}: the columns have different lengths, {text}; save them sample by sample")
        found = []
        for at in places:
            clock = values[at].dtype.kind == "M"
            if values[at].dtype.kind == "c" and kind is float:
                raise InputError(f"{file}: got complex numbers in {heads[at]!r}; real ones are needed")
            column = to_seconds(values[at]) if clock else values[at].astype(kind)
            bad = np.flatnonzero(~np.isfinite(column))
            if bad.size and not gaps:
                raise InputError(
                    f"{file}: got {column[bad[0]]} in {heads[at]!r} at sample {bad[0]}; a number is needed"
                )
            found.append(column)
        return found

    return NamedColumns(heads, numbers, "" if named else f"{file}: its columns have no names")


class _Layout(NamedTuple):
    """Where in a text the names, their units and the samples stand, and what separates cells; None for what is not."""

    names: int | None
    units: int | None
    begin: int
    separator: str


def _table_text(file: Path, lines: list[str]) -> NamedColumns:
    if not any(map(holds_data, lines)):
        raise InputError(f"{file}: it is empty; a line of column names and a line a sample are needed")
    layout = _lay_out(lines)
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
        # What a name says itself counts.
        told = [
            f" [{unit}]" if is_unit(unit) and not split_head(head)[1] else ""
            for head, unit in zip(heads, units, strict=False)
        ]
        heads = [head + unit for head, unit in zip_longest(heads, told, fillvalue="")]
    if not any(line.strip() for line in lines[layout.begin :]):
        raise InputError(f"{file}: it has names of columns and no samples; record some")

    def numbers(places: Sequence[int], kind: type = float, gaps: bool = False) -> list[np.ndarray]:
        found = _read_quickly(lines, layout, len(heads), places) if kind is float else None
        return _read_each(file, lines, layout, heads, places, kind, gaps) if found is None else found

    nameless = f"{file}:{top + 1}: got numbers where the names of the columns are expected"
    return NamedColumns(heads, numbers, nameless if names is None else "")


def _split(line: str, separator: str) -> list[str]:
    """The cells of a line of names or numbers, a remark's sign left out."""
    line = _REMARK.sub("", line, count=1) if _REMARK.match(line) else line.strip()
    if separator == " ":
        return _BLANKS.split(line.strip())
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def holds_data(line: str) -> bool:
    """Whether a line holds more than a remark or a spreadsheet's mark."""
    return bool(line.strip()) and not _REMARK.match(line) and not _SEPARATOR.match(line)


def _count_numbers(cells: list[str]) -> int:
    return sum(
        _read_number(read_duration(with_point(cell)), complex) is not None or cell.lower() == "nan" for cell in cells
    )


def _holds_sample(row: list[str]) -> bool:
    """Return whether a row is a sample: two numbers or more, or one number and otherwise empty cells (sparse table)."""
    numbers = _count_numbers(row)
    return numbers >= 2 or (numbers == 1 and len(row) > 2 and sum(map(bool, row)) == 1)


def _read_number(text: str, kind: type) -> Any:
    """A finite number, a complex one with i or j; None where there is none."""
    if looks_like_number(text):
        return kind(text) if np.isfinite(float(text)) else None
    if kind is complex and text[-1:] in ("i", "j") and "_" not in text:
        with suppress(ValueError):
            value = complex(text.replace(" ", "").replace("i", "j"))
            return value if np.isfinite(value) else None
    return None


def _lay_out(lines: list[str]) -> _Layout:
    """Find the first lines of numbers, by the separator that leaves the least text in them, and what is above."""
    # Skip the headers of LabVIEW files, because their lines contain numbers as well.
    headers = [k for k, line in enumerate(lines[:_PREAMBLE]) if line.startswith(_LABVIEW)]
    first = headers[-1] + 1 if headers else 0
    held = [k for k in range(first, min(len(lines), _PREAMBLE)) if lines[k].strip()]
    best: tuple[float, int, str] | None = None
    for separator in "\t;, ":
        rows = [_split(lines[k], separator) for k in held]
        full = [_holds_sample(row) and not _REMARK.match(lines[k]) for k, row in zip(held, rows, strict=True)]
        for at, (k, row) in enumerate(zip(held, rows, strict=True)):
            above = at > 0 and not full[at - 1] and len(rows[at - 1]) == len(row)
            if full[at] and (above or at + 1 == len(held) or full[at + 1]):
                share = _count_numbers(row) / len(row)
                best = (share, k, separator) if best is None or share > best[0] else best
                break
    if best is None:
        first = next(k for k, line in enumerate(lines) if holds_data(line))
        separator = next((mark for mark in "\t;," if mark in lines[first]), " ")
        return _Layout(first, None, first + 1, separator)
    _, begin, separator = best
    width = len(_trim(_split(lines[begin], separator)))
    above = [k for k in reversed(held) if k < begin]
    # LabVIEW adds the name of a column of comments, which the samples lack.
    if above and (heads := _split(lines[above[0]], separator))[-1:] == ["Comment"] and len(heads) == width + 1:
        return _Layout(above[0], None, begin, separator)
    cells = len(_split(lines[begin], separator))
    named = [k for k in above if len(_trim(_split(lines[k], separator))) == width]
    # If the first sample ends with empty cells, compare the number of names with that of all its cells.
    named = named or [k for k in above if len(_split(lines[k], separator)) == cells]
    if not named:
        plain = [k for k in above if holds_data(lines[k])]
        return _Layout(plain[0] if plain else None, None, begin, separator)
    cells = [cell.strip("[]()") for cell in _split(lines[named[0]], separator)]
    if len(named) > 1 and sum(map(is_unit, cells)) >= 2 and all(is_unit(cell) or len(cell) <= 5 for cell in cells):
        return _Layout(named[1], named[0], begin, separator)
    return _Layout(named[0], None, begin, separator)


def _trim(cells: list[str]) -> list[str]:
    """Cells without empty ones at the end."""
    return cells[: max((k + 1 for k, cell in enumerate(cells) if cell), default=0)]


def _read_quickly(lines: list[str], layout: _Layout, count: int, places: Sequence[int]) -> list[np.ndarray] | None:
    """Columns by NumPy's reader; None where there is anything that it does not read, to be told line by line."""
    begin, separator = layout.begin, layout.separator
    clocks = _find_clocks(lines, layout, places)
    if separator != "," and all(any(sign in line for line in islice(lines, begin, None)) for sign in ",."):
        # Cell by cell, so that numbers with either are told.
        return None
    if separator == " ":
        wide = max(len(line.split()) for line in lines[begin:])
    else:
        wide = 1 + max(line.count(separator) for line in lines[begin:])
    if wide > count:
        return None
    options: dict[str, Any] = {"comments": None, "quotechar": '"', "ndmin": 1}
    options["delimiter"] = None if separator == " " else separator
    found = {}
    try:
        for at in places:
            rows: Iterable[str] = islice(lines, begin, None)
            if at in clocks:
                found[at] = read_clock(np.loadtxt(rows, usecols=at, dtype="U40", **options))
                continue
            rows = rows if separator == "," else (line.replace(",", ".") for line in rows)
            found[at] = np.loadtxt(rows, usecols=at, dtype=float, **options)
    except (ValueError, IndexError, TypeError):
        return None
    return [found[at] for at in places] if all(np.all(np.isfinite(each)) for each in found.values()) else None


def _read_each(
    file: Path,
    lines: list[str],
    layout: _Layout,
    heads: list[str],
    places: Sequence[int],
    kind: type,
    gaps: bool,
) -> list[np.ndarray]:
    """Read columns cell by cell.

    Args:
        file: path of the table, for messages.
        lines: lines of the table.
        layout: first line of the samples, and the separator.
        heads: headers of all columns.
        places: indices of the columns to read.
        kind: float or complex.
        gaps: return NaN for missing numbers.

    Raises:
        InputError: a cell contains no number and is not a missing number, or a line has too many cells.
    """
    separator, found = layout.separator, [[] for _ in places]
    if separator == " ":
        rows = ((k + 1, lines[k].split()) for k in range(layout.begin, len(lines)) if lines[k].strip())
    else:
        rows = split_lines(file, lines, layout.begin, separator)
    clocks, signs = _find_clocks(lines, layout, places), DecimalSigns(file)
    for number, cells in rows:
        if any(cells[len(heads) :]):
            hint = "; a comma as decimal sign needs semicolons between the columns" if separator == "," else ""
            raise InputError(f"{file}:{number}: got {len(cells)} cells for {len(heads)} columns{hint}")
        for column, at in zip(found, places, strict=True):
            got = cells[at] if at < len(cells) else ""
            if gaps and at not in clocks and got.lower() in _MISSING:
                column.append(np.nan)
                continue
            value = _read_number(read_duration(got if separator == "," else signs.read(number, got)), kind)
            if not is_time(got) if at in clocks else value is None:
                wanted = "a time such as 2024-05-01T12:00:00.001" if at in clocks else "a number"
                raise InputError(
                    f"{file}:{number}: got {repr(got) if got else 'nothing'} under {heads[at]!r}; {wanted} is needed"
                )
            column.append(got if at in clocks else value)
    columns = zip(places, map(np.array, found), strict=True)
    return [read_clock(column) if at in clocks else column for at, column in columns]


def _find_clocks(lines: list[str], layout: _Layout, places: Sequence[int]) -> list[int]:
    """Columns whose first cell is a time of the calendar."""
    first = _split(lines[layout.begin], layout.separator)
    return [at for at in places if at < len(first) and CLOCK.fullmatch(first[at])]
