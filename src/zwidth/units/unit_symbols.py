"""Parser of unit expressions: products, quotients and powers of unit symbols with SI prefixes.

Examples are ``N m/deg``, ``mNm/°``, ``N*m*s / rad``, ``kgf/cm`` and ``ozf in``. The result, the *size* of a unit, is
its conversion factor to SI and its exponents of kg, m, s and rad. Powers of ten are stored separately from other
factors, because adding them to the decimal exponent of a number causes only one rounding error: 0.3 ms becomes exactly
the float64 number 0.0003.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

Exponents = tuple[int, int, int, int]
"""Exponents of kg, m, s and rad: the dimension of a unit."""


class UnitSize(NamedTuple):
    """Conversion factor of a unit to SI, ``factor * 10**power``, and the unit's exponents of kg, m, s and rad."""

    power: int
    factor: float
    exponents: Exponents

    @property
    def value(self) -> float:
        """The conversion factor to SI."""
        return float(f"1e{self.power}") * self.factor


# Powers of ten of the SI prefixes; u stands for micro.
_PREFIXES = {"": 0, "n": -9, "u": -6, "μ": -6, "m": -3, "c": -2, "d": -1, "k": 3, "M": 6}
# Dimensions of the unit symbols: exponents of kg, m, s and rad.
_MASS = (1, 0, 0, 0)
_LENGTH = (0, 1, 0, 0)
_TIME = (0, 0, 1, 0)
_ANGLE = (0, 0, 0, 1)
_FORCE = (1, 1, -2, 0)
_PER_TIME = (0, 0, -1, 0)
# Unit symbols with their power of ten, their further factor to SI, their dimension and their allowed prefixes.
_SYMBOLS: dict[str, tuple[int, float, Exponents, str]] = {
    "m": (0, 1.0, _LENGTH, "nuμmck"),
    "g": (-3, 1.0, _MASS, "uμmk"),
    "s": (0, 1.0, _TIME, "nuμm"),
    "N": (0, 1.0, _FORCE, "nuμmckM"),
    "Hz": (0, 1.0, _PER_TIME, "mkM"),
    "rad": (0, 1.0, _ANGLE, "uμmk"),
    **dict.fromkeys(("rpm", "RPM"), (0, math.pi / 30, (0, 0, -1, 1), "k")),
    "sec": (0, 1.0, _TIME, "nuμm"),
    "in": (0, 0.0254, _LENGTH, ""),
    "ft": (0, 0.3048, _LENGTH, ""),
    "lb": (0, 0.45359237, _MASS, ""),
    "oz": (0, 0.028349523125, _MASS, ""),
    # The factors of these force units contain the standard gravity, 9.80665 m/s^2.
    "gf": (-3, 9.80665, _FORCE, "k"),
    "kp": (0, 9.80665, _FORCE, ""),
    "lbf": (0, 4.4482216152605, _FORCE, ""),
    "ozf": (0, 0.27801385095378125, _FORCE, ""),
    **dict.fromkeys(("seconds", "second"), (0, 1.0, _TIME, "")),
    "deg": (0, math.pi / 180, _ANGLE, "m"),
    **dict.fromkeys(("°", "degree", "degrees"), (0, math.pi / 180, _ANGLE, "")),
    "arcmin": (0, math.pi / 10_800, _ANGLE, ""),
    "arcsec": (0, math.pi / 648_000, _ANGLE, ""),
    **dict.fromkeys(("rev", "turn", "turns", "revolution", "revolutions"), (0, 2 * math.pi, _ANGLE, "")),
}
# Conversion factors and exponents of all symbols, without prefix and with each allowed prefix.
_READINGS = {
    prefix + symbol: UnitSize(power + _PREFIXES[prefix], factor, exponents)
    for symbol, (power, factor, exponents, prefixes) in _SYMBOLS.items()
    for prefix in ("", *prefixes)
}
_LONGEST = max(map(len, _READINGS))  # number of characters of the longest symbol, including its prefix
_GRAVITY = 9.80665  # standard gravity, m/s^2
# Pattern of a mass unit that denotes a weight, i.e. a force, in units of torque and similar units, as in "oz in".
_WEIGHT = re.compile(r"(?<![A-Za-z])(kg|g|lb|oz)(?![A-Za-z])|^(kg|g)(?=[cm]?m)")
# Pattern of symbols with an exponent, as in "m^2", "m**2" or "m2".
_POWER = re.compile(r"(.*?)(?:\^|\*\*)?(-?[1-4])?", re.DOTALL)
# Other spellings of rpm. "min" alone is no symbol, because it would make units of headers such as "angle_min".
_PER_MINUTE = re.compile(r"(?:rev|r|U|1)/min|min\^?-1")
# Pattern of a denominator that is itself a quotient, as in "N m/(rad/s)".
_DIVIDED_RATE = re.compile(r"/\(([^()/]+)/([^()/]+)\)")


def normalize_symbols(text: str) -> str:
    """Replace variants of micro sign, degree sign, minus sign and superscripts in a unit by standard characters."""
    text = text.replace("º", "°").replace("˚", "°").replace("−", "-")
    return unicodedata.normalize("NFKC", text)


@lru_cache(maxsize=1024)
def measure_unit(text: str, exponents: Exponents | None = None) -> UnitSize | None:
    """Return conversion factor and exponents of a unit as `UnitSize`; None if the unit is unknown or ambiguous.

    Letters may have several interpretations: "ms" denotes milliseconds or metre seconds. The required exponents select
    one of them.

    Args:
        text: the unit.
        exponents: required exponents of kg, m, s and rad; None to return the interpretation with the fewest symbols.
    """
    sizes = [size for size in _read(normalize_symbols(text)) if exponents in (None, size.exponents)]
    if exponents is None:
        return sizes[0] if sizes else None
    distinct = {round(math.log10(size.value), 9) for size in sizes}
    if len(distinct) == 1:
        return sizes[0]
    return _read_weights(text, exponents) if not sizes else None


def _read_weights(text: str, exponents: Exponents) -> UnitSize | None:
    """Return the `UnitSize` of a unit whose kg, g, lb or oz denotes a weight, as in "oz in"; None for other dimensions.

    Args:
        text: the unit.
        exponents: required exponents of kg, m, s and rad.
    """
    text = normalize_symbols(text)
    mass = _WEIGHT.search(text)
    # Exclude forces, because "2 kg" as a force may be a mass that the user gave by mistake.
    if mass is None or exponents[1] == 1:
        return None
    sizes = [size for size in _read(f"{text[: mass.start()]}N {text[mass.end() :]}") if size.exponents == exponents]
    if not sizes:
        return None
    weight = _READINGS[mass[0]]
    return sizes[0]._replace(power=sizes[0].power + weight.power, factor=sizes[0].factor * weight.factor * _GRAVITY)


def _read(text: str) -> list[UnitSize]:
    """Return a `UnitSize` for each interpretation of a unit, at most 64, in the order of their number of symbols."""
    text = re.sub(r"\s*/\s*", "/", text.strip())
    text = _PER_MINUTE.sub("rpm", text)
    # Replace "N m/(rad/s)" by "N m s/rad".
    if inverse := _DIVIDED_RATE.search(text):
        text = f"{text[: inverse.start()]} {inverse[2]}/{inverse[1]}{text[inverse.end() :]}"
    text = re.sub(r"/\(([^()/]+)\)", r"/\1", text)
    sizes = [UnitSize(0, 1.0, (0, 0, 0, 0))]
    for k, part in enumerate(text.split("/")):
        atoms = [atom for atom in re.split(r"[\s*·⋅.]+|-(?=[A-Za-z])", re.sub(r"\*\*", "^", part)) if atom]
        if k == 0 and atoms == ["1"]:
            continue
        if not atoms:
            return []
        sign = -1 if k else 1
        for atom in atoms:
            sizes = [_join(size, other, sign) for size in sizes for other in _read_run(atom)][:64]
    return sizes


def _read_run(atom: str) -> Iterator[UnitSize]:
    """Yield a `UnitSize` for each interpretation of a text without separators, such as "mNm" or "cm2".

    An exponent at the end applies to the last symbol only.
    """
    match = _POWER.fullmatch(atom)
    letters, power = (match[1], int(match[2] or 1)) if match else (atom, 1)
    # Try long symbols first, so that interpretations with few symbols are yielded first.
    for length in range(min(len(letters), _LONGEST), 0, -1):
        first = _READINGS.get(letters[:length])
        rest = letters[length:]
        # Interpret m directly before N as milli, not as metre.
        if first is None or (letters[:length] == "m" and rest.startswith("N")):
            continue
        if not rest:
            yield _raise_to(first, power)
            continue
        for size in _read_run(atom[length:]):
            yield _join(first, size, 1)


def _raise_to(size: UnitSize, power: int) -> UnitSize:
    """Return the `UnitSize` of an integer power of a unit, given the `UnitSize` of the unit."""
    kg, m, s, rad = size.exponents
    return UnitSize(size.power * power, size.factor**power, (kg * power, m * power, s * power, rad * power))


def _join(first: UnitSize, second: UnitSize, sign: int) -> UnitSize:
    """Return the `UnitSize` of the product of two units or, if ``sign`` is -1, of their quotient."""
    (a, b, c, d), (e, f, g, h) = first.exponents, second.exponents
    exponents = (a + sign * e, b + sign * f, c + sign * g, d + sign * h)
    return UnitSize(first.power + sign * second.power, first.factor * second.factor**sign, exponents)
