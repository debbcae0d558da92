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

from zwidth.units.unit_system import UNIT_PAIRS, UnitSystem

PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}  # SI prefixes by power of ten
LONGEST_VALUE = 60  # largest number of characters of a received value in a message; longer values are shortened


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

    Numbers without unit, "1" or "", and reciprocal units such as "1/s" have no prefix. Inertias are in g cm^2, as in
    data sheets of motors.
    """
    if unit in ("", "1"):
        return plain(value, digits)
    if unit == "kg m^2":
        return f"{plain(1e7 * value, digits)} g cm^2" if math.isfinite(value) else plain(value)
    if unit == "kg":
        value, unit = 1e3 * value, "g"
    if not math.isfinite(value) or value == 0:
        return f"{plain(value)} {unit}" if value == 0 else plain(value)
    if unit.startswith("1/"):
        return f"{plain(value, digits)} {unit}"
    power = min(9, max(-9, 3 * math.floor(math.log10(abs(value)) / 3)))
    # Use the next prefix if rounding yields 1000, as for 999.96 with four digits.
    if abs(float(f"{value / 10**power:.{digits - 1}e}")) >= 1000 and power < 9:
        power += 3
    return f"{plain(value / 10**power, digits)} {PREFIXES[power]}{unit}"


def format_periods(count: float) -> str:
    """Format a number of sampling periods with four significant digits, as in ``1 period`` or ``0.7 periods``."""
    rounded = float(f"{count:.4g}" if count < 1000 else f"{count:.0f}")
    return f"{short(rounded)} period{'' if count == 1 else 's'}"


def format_short(value: float, unit: str, digits: int = 3) -> str:
    """Format a quantity with an SI prefix of its unit, without trailing zeros, as in ``1 mm`` or ``349 mrad``."""
    number, space, name = with_unit(value, unit, digits).partition(" ")
    return f"{float(number):g}{space}{name}" if math.isfinite(value) else number


def format_wall(stiffness: Any, virtual_damping: Any, system: UnitSystem) -> str:
    """Format stiffness K and damping B of a wall; K is rounded down, because it may be the largest stable stiffness."""
    K = with_unit(round_conservatively(float(stiffness), "below"), system["N/m"])
    return f"K = {K}, B = {with_unit(float(virtual_damping), system['N s/m'])}"


ENOUGH = {"above": "or more", "below": "or less"}  # words that are printed after a limit, by its sufficient side


def round_conservatively(value: float, enough: str, digits: int = 4) -> float:
    """Round a limit to ``digits`` significant digits, toward its sufficient side.

    Args:
        value: the limit.
        enough: its sufficient side, "above" or "below". For other texts, the limit is returned unchanged.
        digits: number of significant digits.
    """
    if not (value and math.isfinite(value) and enough in ENOUGH):
        return value
    step = 10.0 ** (math.floor(math.log10(abs(value))) + 1 - digits)
    # Tolerate a rounding error of the quotient, so that a value that already has few digits does not change.
    steps = math.ceil(value / step - 1e-9) if enough == "above" else math.floor(value / step + 1e-9)
    return steps * step


def count_digits(holds: Callable[[int], Any], least: int = 4) -> int:
    """Return the smallest number of digits from ``least`` to 16 for which ``holds(digits)`` is true, otherwise 17."""
    return next((digits for digits in range(least, 17) if holds(digits)), 17)


def count_digits_apart(values: list[float], least: int = 4) -> int:
    """Return the smallest number of significant digits, at least ``least``, that formats unequal values differently."""
    return count_digits(lambda digits: len({f"{value:.{digits}g}" for value in values}) == len(set(values)), least)


def format_stiffness(value: float, system: UnitSystem, digits: int = 4) -> str:
    """Format a stiffness, rounded down because most stiffnesses are upper limits; a rotary one also in mN m/deg."""
    text = with_unit(round_conservatively(value, "below", digits), system["N/m"], digits)
    per_degree = round_conservatively(value * 1e3 * math.pi / 180, "below", digits)
    return f"{text} ({plain(per_degree, digits)} mN m/deg)" if system.rotary and math.isfinite(value) else text


def format_interval(low: float, high: float, unit: str = "", least: int = 4) -> tuple[str, str]:
    """Return the two ends of an interval as texts, rounded inward, with enough digits that the texts differ.

    Args:
        low: lower end of the interval.
        high: upper end of the interval.
        unit: unit of both ends; "" for numbers without unit.
        least: smallest number of significant digits.
    """
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
    """Return the header of a CSV column, such as ``stiffness_N_per_m``; only the name for a quantity without unit."""
    if unit in ("", "1", "sampling periods"):
        return name
    return f"{name}_{unit.replace('/', '_per_').replace(' ', '_').replace('^', '')}"


# Pairs of the text for a unit in headers, for linear and for rotary devices. Long texts come first, because "_N_per_m"
# also ends with "_m".
_ENDINGS = sorted(([header("", unit) for unit in pair] for pair in UNIT_PAIRS), key=lambda pair: -len(pair[0]))


def convert_header(name: str, system: UnitSystem) -> str:
    """Replace the unit at the end of a CSV header, as in ``stiffness_N_per_m``, by the unit in a unit system."""
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
    """Convert a CSV cell written by `to_cell` back to its text, without the apostrophe that `to_cell` added."""
    return cell[1:] if cell.startswith("'") and _FORMULA.match(cell) else cell


# Pattern of a text that a spreadsheet would evaluate as a formula; East Asian versions also accept full-width
# characters. It allows leading apostrophes: `to_cell` then adds one more, and `from_cell` removes only that one.
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
    """Return "did you mean ...?" with the most similar of the allowed names; ``otherwise`` if no name is similar."""
    similar = resembling(name, names)
    return f"did you mean {similar!r}?" if similar else otherwise


def short(value: float) -> str:
    """Format a number as the shortest text that represents exactly this float, without ``.0`` for integers."""
    text = f"{value:g}"
    return text if float(text) == value else repr(value)
