"""Values for people: numbers with SI prefixes and few digits, what was received, and the cells of CSV files.

The first line of a CSV file that holds something has the names of the columns, which may have units in brackets. Lines
before it that begin with # are remarks, and so is the ``sep=;`` of spreadsheets. Columns are separated by tabs, else
semicolons, else commas: the first of these that the line of names holds. Where commas do not separate, they may be
decimal signs.
"""

from __future__ import annotations

import codecs
import csv
import difflib
import gzip
import math
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from zwidth.words.errors import InputError
from zwidth.words.rotation import ROTARY, is_rotary, own_unit

PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
LONGEST_VALUE = 60
_REMARK = re.compile(r"\s*#|\s*\"?sep=.\"?\s*$", re.IGNORECASE)
_TITLE = re.compile(r"(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))?")
_CODINGS, _GZIP, _NO_TEXT = ("utf-8-sig", "cp1252", "latin-1"), b"\x1f\x8b", re.compile("[\0-\x08\x0e-\x1f]")
_DECIMAL_COMMA = re.compile(r"^([-+]?[0-9]*),(?=[0-9][^.]*$)")
_FRACTION = re.compile(r"[-+]?[0-9]*([.,])[0-9]+(?:[eE][-+]?[0-9]+)?")


def plain(value: float, digits: int = 4) -> str:
    """A number with a fixed count of significant digits, without an exponent where it stays short."""
    if not math.isfinite(value):
        return "none" if math.isnan(value) else ("infinite" if value > 0 else "-infinite")
    # A zero has no sign.
    value = float(f"{value:.{digits - 1}e}") + 0.0
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{decimals}f}"


def with_unit(value: float, unit: str, digits: int = 4) -> str:
    """A quantity with an SI prefix on its unit: ``19.87 kN/m``, ``100.0 g`` of kilograms.

    The unit is that of a linear device; of a rotary one in question its own is written. A number without unit, "1" or
    "", has no prefix either.
    """
    unit = own_unit(unit)
    if unit in ("", "1"):
        return plain(value, digits)
    if unit == "kg m^2":
        # What data sheets of rotors have.
        return f"{plain(1e7 * value, digits)} g cm^2" if math.isfinite(value) else plain(value)
    if unit == "kg":
        value, unit = 1e3 * value, "g"
    if not math.isfinite(value) or value == 0:
        return f"{plain(value)} {unit}" if value == 0 else plain(value)
    power = min(9, max(-9, 3 * math.floor(math.log10(abs(value)) / 3)))
    # 999.96 with four digits reads 1000: the next prefix is meant.
    if abs(float(f"{value / 10**power:.{digits - 1}e}")) >= 1000 and power < 9:
        power += 3
    return f"{plain(value / 10**power, digits)} {PREFIXES[power]}{unit}"


def name_wall(stiffness: Any, virtual_damping: Any) -> str:
    """A wall by its numbers, K rounded down: it holds as it is read."""
    K = with_unit(round_safely(float(stiffness), "below"), "N/m")
    return f"K = {K}, B = {with_unit(float(virtual_damping), 'N s/m')}"


# Words behind a number, by the side of it on which there is enough.
ENOUGH = {"above": "or more", "below": "or less"}


def round_safely(value: float, enough: str, digits: int = 4) -> float:
    """A number to few digits, rounded to the side on which there is enough."""
    if not (value and math.isfinite(value) and enough in ENOUGH):
        return value
    step = 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    # A value that has so few digits stays, whatever the rounding of the quotient.
    steps = math.ceil(value / step - 1e-9) if enough == "above" else math.floor(value / step + 1e-9)
    return steps * step


def count_digits(holds: Callable[[int], Any], least: int = 4) -> int:
    """The fewest digits of a printed number, from 4 or so on, with which something holds."""
    return next((digits for digits in range(least, 17) if holds(digits)), 17)


def count_digits_apart(values: list[float], least: int = 4) -> int:
    """The fewest digits, from 4 or so on, that tell different numbers apart."""
    return count_digits(lambda digits: len({f"{value:.{digits}g}" for value in values}) == len(set(values)), least)


def spell_stiffness(value: float, digits: int = 4) -> str:
    """A stiffness with its unit, rounded down: most are the largest of which something holds.

    Of a rotary device per degree as well, as people picture it.
    """
    text = with_unit(round_safely(value, "below", digits), "N/m", digits)
    turned = round_safely(value * 1e3 * math.pi / 180, "below", digits)
    return f"{text} ({plain(turned, digits)} mN m/deg)" if is_rotary() and math.isfinite(value) else text


def tell_apart(low: float, high: float, unit: str = "", least: int = 4) -> tuple[str, str]:
    """Two ends with a unit or plain, rounded into what lies between, with as many digits as it takes to leave some."""
    for digits in range(least, 18):
        ends = round_safely(low, "above", digits), round_safely(high, "below", digits)
        if ends[0] < ends[1]:
            return with_unit(ends[0], unit, digits), with_unit(ends[1], unit, digits)
    return with_unit(low, unit, least), with_unit(high, unit, least)


def spell_enough(value: float, enough: str, others: Iterable[float], unit: str, digits: int = 4) -> str:
    """Of which values there is enough: on one side of a value, or up to the first of others there."""
    side = 1.0 if enough == "above" else -1.0
    beyond = [side * other for other in others if side * other > side * value]
    if beyond:
        low, high = sorted((value, side * min(beyond)))
        return " to ".join(tell_apart(low, high, unit, digits))
    value = round_safely(value, enough, digits)
    return f"{with_unit(value, unit, digits)} {ENOUGH[enough]}"


def header(name: str, unit: str) -> str:
    """The name of a column with its unit, as ``stiffness_N_per_m``; a number without unit has its name alone."""
    if unit in ("", "1", "sampling periods"):
        return name
    return f"{name}_{unit.replace('/', '_per_').replace(' ', '_').replace('^', '')}"


def own_header(name: str) -> str:
    """The name of a column with the unit of the kind of device in question, as ``stiffness_N_m_per_rad``."""
    for unit in sorted(ROTARY, key=len, reverse=True) if is_rotary() else ():
        ending = header("", unit)
        if name.endswith(ending):
            return name.removesuffix(ending) + header("", ROTARY[unit])
    return name


def to_json(value: Any) -> Any:
    """A value as JSON has it: None in place of NaN and infinities, lists in place of tuples."""
    if isinstance(value, Mapping):
        return {name: to_json(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_cell(value: Any) -> Any:
    """A value as a cell of CSV: a text that a spreadsheet would run as a formula has an apostrophe before it."""
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value


def from_cell(cell: str) -> str:
    """The text that `to_cell` made a cell of."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


# Also in the wide forms that East Asian programs take for the same; with apostrophes of its own a text gets one more.
_FORMULA = re.compile(r"'*\s*[=+\-@\uff1d\uff0b\uff0d\uff20\t\r\n]")


def describe(value: Any) -> str:
    """The value received, as YAML spells it, on one line."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return f"a mapping of {_count(len(value), 'key')}"
    if isinstance(value, list | tuple):
        return f"a list of {_count(len(value), 'item')}"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else (".inf" if value > 0 else "-.inf")
    if isinstance(value, int) and abs(value) >= 10**LONGEST_VALUE:
        return f"a whole number beyond 1e{LONGEST_VALUE}"
    text = repr(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 4]}...{text[-1]}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def resembling(name: Any, known: Iterable[str]) -> str | None:
    """The known name that looks most like ``name``, if any does."""
    if not isinstance(name, str):
        return None
    by_lower = {candidate.lower(): candidate for candidate in known}
    found = difflib.get_close_matches(name.lower(), by_lower, n=1)
    return by_lower[found[0]] if found else None


def suggestion(name: Any, known: Iterable[str], otherwise: str) -> str:
    """A remedy: a question for the known name that ``name`` may stand for, else what is given."""
    found = resembling(name, known)
    return f"did you mean {found!r}?" if found else otherwise


def short(value: float) -> str:
    """The shortest text of a number, without ``.0`` where it is whole."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)


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
        try:
            text = raw.decode(coding)
        except UnicodeDecodeError:
            continue
        # Of numbers and names none are control characters.
        if not _NO_TEXT.search(text):
            return text.splitlines()
    raise InputError(f"{file}: it is no text in UTF-8, UTF-16 or Latin-1; save it as CSV in UTF-8")


def read_rows(file: Path, most_bytes: int) -> list[tuple[int, list[str]]]:
    """The row of names and those below that hold something, each with its line."""
    lines = read_lines(file, most_bytes)
    first = next((k for k, line in enumerate(lines) if line.strip() and not _REMARK.match(line)), len(lines))
    separator = next((mark for mark in "\t;" if mark in "".join(lines[first : first + 1])), ",")
    rows = list(split_lines(file, lines, first, separator))
    if separator != ",":
        signs = DecimalSigns(file)
        rows[1:] = [(line, [signs.read(line, cell) for cell in cells]) for line, cells in rows[1:]]
    return rows


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


def split_title(title: str) -> tuple[str, str]:
    """The name of a column, and its unit, which stands in brackets at its end."""
    match = _TITLE.fullmatch(title.strip())
    return (match[1], (match[2] or match[3] or "").strip()) if match else (title, "")
