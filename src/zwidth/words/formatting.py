"""Formatting of numbers and other values in output, messages, CSV files and JSON.

A *sufficient side* of a limit, "above" or "below", is the side on which values meet a requirement. Limits are rounded
toward this side, so that a printed limit meets the requirement as well.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from zwidth.words.unit_system import UNIT_PAIRS, UnitSystem

PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}  # SI prefixes by power of ten
LONGEST_VALUE = 60  # characters of a received value in a message


def plain(value: float, digits: int = 4) -> str:
    """Format a number with a fixed number of significant digits, without exponent between 1e-4 and 1e6."""
    if not math.isfinite(value):
        return "none" if math.isnan(value) else ("infinite" if value > 0 else "-infinite")
    # Add 0 to remove the sign of a negative zero.
    value = float(f"{value:.{digits - 1}e}") + 0.0
    if value != 0 and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{decimals}f}"


def with_unit(value: float, unit: str, digits: int = 4) -> str:
    """Format a quantity with an SI prefix of its unit, as in ``19.87 kN/m``, and masses in grams, ``100.0 g``.

    Numbers without unit, "1" or "", have no prefix. Inertias are in g cm^2, as in data sheets of motors.
    """
    if unit in ("", "1"):
        return plain(value, digits)
    if unit == "kg m^2":
        return f"{plain(1e7 * value, digits)} g cm^2" if math.isfinite(value) else plain(value)
    if unit == "kg":
        value, unit = 1e3 * value, "g"
    if not math.isfinite(value) or value == 0:
        return f"{plain(value)} {unit}" if value == 0 else plain(value)
    power = min(9, max(-9, 3 * math.floor(math.log10(abs(value)) / 3)))
    # Use the next prefix if rounding yields 1000, as for 999.96 with four digits.
    if abs(float(f"{value / 10**power:.{digits - 1}e}")) >= 1000 and power < 9:
        power += 3
    return f"{plain(value / 10**power, digits)} {PREFIXES[power]}{unit}"


def format_periods(count: float) -> str:
    """Format a number of sampling periods to four significant digits: ``1 period``, ``0.7 periods``."""
    rounded = float(f"{count:.4g}" if count < 1000 else f"{count:.0f}")
    return f"{short(rounded)} period{'' if count == 1 else 's'}"


def format_short(value: float, unit: str, digits: int = 3) -> str:
    """Format a quantity with its unit, rounded and without trailing zeros: ``1 mm``, ``349 mrad``."""
    number, space, name = with_unit(value, unit, digits).partition(" ")
    return f"{float(number):g}{space}{name}" if math.isfinite(value) else number


def format_wall(stiffness: Any, virtual_damping: Any, system: UnitSystem) -> str:
    """Format K and B of a wall with units; K is rounded down, so that it does not exceed a limit of stability."""
    K = with_unit(round_conservatively(float(stiffness), "below"), system["N/m"])
    return f"K = {K}, B = {with_unit(float(virtual_damping), system['N s/m'])}"


ENOUGH = {"above": "or more", "below": "or less"}  # words after a limit, by sufficient side


def round_conservatively(value: float, enough: str, digits: int = 4) -> float:
    """Round a limit to a few digits, toward its sufficient side; return it unchanged if ``enough`` is no side."""
    if not (value and math.isfinite(value) and enough in ENOUGH):
        return value
    step = 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    # Tolerate the rounding error of the quotient, so that a value with few digits is not changed.
    steps = math.ceil(value / step - 1e-9) if enough == "above" else math.floor(value / step + 1e-9)
    return steps * step


def count_digits(holds: Callable[[int], Any], least: int = 4) -> int:
    """Return the smallest number of digits, at least ``least``, for which ``holds`` returns True; at most 17."""
    return next((digits for digits in range(least, 17) if holds(digits)), 17)


def count_digits_apart(values: list[float], least: int = 4) -> int:
    """Return the smallest number of digits, at least ``least``, with which different numbers have different texts."""
    return count_digits(lambda digits: len({f"{value:.{digits}g}" for value in values}) == len(set(values)), least)


def format_stiffness(value: float, system: UnitSystem, digits: int = 4) -> str:
    """Format a stiffness, rounded down because most are upper limits; a rotary one also in mN m/deg."""
    text = with_unit(round_conservatively(value, "below", digits), system["N/m"], digits)
    per_degree = round_conservatively(value * 1e3 * math.pi / 180, "below", digits)
    return f"{text} ({plain(per_degree, digits)} mN m/deg)" if system.rotary and math.isfinite(value) else text


def format_interval(low: float, high: float, unit: str = "", least: int = 4) -> tuple[str, str]:
    """Format both ends of an interval with unit, rounded inward, with so many digits that their texts differ."""
    for digits in range(least, 18):
        ends = round_conservatively(low, "above", digits), round_conservatively(high, "below", digits)
        if ends[0] < ends[1]:
            return with_unit(ends[0], unit, digits), with_unit(ends[1], unit, digits)
    return with_unit(low, unit, least), with_unit(high, unit, least)


def format_sufficient(value: float, enough: str, others: Iterable[float], unit: str, digits: int = 4) -> str:
    """Format the interval of sufficient values, such as "2.5 mm or more" or "1 N/m to 2 N/m".

    Args:
        value: limit of the interval.
        enough: sufficient side of the limit, "above" or "below".
        others: further limits. The nearest one on the sufficient side ends the interval.
        unit: unit of all limits.
        digits: significant digits.
    """
    side = 1.0 if enough == "above" else -1.0
    beyond = [side * other for other in others if side * other > side * value]
    if beyond:
        low, high = sorted((value, side * min(beyond)))
        return " to ".join(format_interval(low, high, unit, digits))
    value = round_conservatively(value, enough, digits)
    return f"{with_unit(value, unit, digits)} {ENOUGH[enough]}"


def header(name: str, unit: str) -> str:
    """Return the header of a column in CSV files, such as ``stiffness_N_per_m``; the name alone if it has no unit."""
    if unit in ("", "1", "sampling periods"):
        return name
    return f"{name}_{unit.replace('/', '_per_').replace(' ', '_').replace('^', '')}"


# Units in headers, for linear and for rotary devices. Long ones come first, because "_N_per_m" also ends with "_m".
_ENDINGS = sorted(([header("", unit) for unit in pair] for pair in UNIT_PAIRS), key=lambda pair: -len(pair[0]))


def convert_header(name: str, system: UnitSystem) -> str:
    """Replace the unit in a header, as in ``stiffness_N_per_m``, by that of a linear or rotary device."""
    for pair in _ENDINGS:
        old = pair[not system.rotary]
        if name.endswith(old):
            return name.removesuffix(old) + pair[system.rotary]
    return name


def to_json(value: Any) -> Any:
    """Convert a value for JSON: NaN and infinities become None, tuples become lists."""
    if isinstance(value, Mapping):
        return {name: to_json(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_cell(value: Any) -> Any:
    """Convert a value to a CSV cell; put an apostrophe before a text that a spreadsheet would evaluate as a formula."""
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value


def from_cell(cell: str) -> str:
    """Return the original text of a CSV cell from `to_cell`."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


# Start of a formula, also in full-width characters, which East Asian versions of spreadsheets accept. Leading
# apostrophes are included, so that `from_cell` restores a text that begins with an apostrophe of its own.
_FORMULA = re.compile(r"'*\s*[=+\-@\uff1d\uff0b\uff0d\uff20\t\r\n]")


def describe(value: Any) -> str:
    """Format a received value for a message, in the notation of YAML and on one line."""
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
    """Format a number of items with their noun in singular or plural."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def resembling(name: Any, names: Iterable[str]) -> str | None:
    """Return the name in ``names`` that is most similar to ``name``, ignoring case; None if none is similar."""
    if not isinstance(name, str):
        return None
    by_lower = {candidate.lower(): candidate for candidate in names}
    matches = difflib.get_close_matches(name.lower(), by_lower, n=1)
    return by_lower[matches[0]] if matches else None


def suggestion(name: Any, names: Iterable[str], otherwise: str) -> str:
    """Return the question "did you mean ...?" with the most similar names name; ``otherwise`` if none is similar."""
    similar = resembling(name, names)
    return f"did you mean {similar!r}?" if similar else otherwise


def short(value: float) -> str:
    """Format a number as the shortest text that is read as the same float, without ``.0`` for integers."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)
