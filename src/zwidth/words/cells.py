"""CSV files as rows of cells; the names of columns may have units in brackets.

The first line that holds something has the names of the columns. Lines before it that begin with # are remarks, and so
is the ``sep=;`` of spreadsheets. Columns are separated by tabs, else semicolons, else commas: the first of these that
the line of names holds. Where commas do not separate, they may be decimal signs.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

from zwidth.words.errors import InputError

_REMARK = re.compile(r"\s*#|\s*\"?sep=.\"?\s*$", re.IGNORECASE)
_TITLE = re.compile(r"(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))?")
_DECIMAL_COMMA = re.compile(r"^([-+]?[0-9]*),(?=[0-9][^.]*$)")


def read_rows(file: Path, most_bytes: int) -> tuple[list[tuple[int, list[str]]], str]:
    """The row of names and those below that hold something, each with the number of its line; and what separates cells.

    Raises:
        InputError: it is no file of UTF-8 text that is small enough, or its quotes are wrong.
    """
    # A pipe would be waited for.
    if not file.is_file():
        raise InputError(f"{file}: {'it is no file' if file.exists() else 'no such file'}; check the path")
    try:
        if file.stat().st_size > most_bytes:
            raise InputError(f"{file}: it has more than {most_bytes >> 20} MiB; take a part of it")
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{file}: it is no text in UTF-8; save it as CSV in UTF-8") from None
    except OSError as error:
        raise InputError(f"{file}: {error.strerror or error}; check the path") from None
    first = next((k for k, line in enumerate(lines) if line.strip() and not _REMARK.match(line)), len(lines))
    separator = next((mark for mark in "\t;" if mark in "".join(lines[first : first + 1])), ",")
    reader = csv.reader(lines[first:], delimiter=separator, skipinitialspace=True, strict=True)
    try:
        rows = [(first + reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        raise InputError(f"{file}:{first + reader.line_num}: {error}; check the quotes") from None
    if separator != ",":
        rows[1:] = [(line, [_DECIMAL_COMMA.sub(r"\1.", cell) for cell in cells]) for line, cells in rows[1:]]
    return [row for row in rows if any(row[1])], separator


def split_title(title: str) -> tuple[str, str]:
    """The name of a column, and its unit, which stands in brackets at its end."""
    match = _TITLE.fullmatch(title.strip())
    return (match[1], (match[2] or match[3] or "").strip()) if match else (title, "")
