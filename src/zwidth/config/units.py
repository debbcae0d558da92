"""Quantities with a unit, as ``10 kN/m``; a number alone is in the SI base unit of its field."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from zwidth.config.faults import describe, problem, short, suggestion
from zwidth.config.numbers import check_range, looks_like_number, number, to_float, whole_number
from zwidth.domain import SI_RANGE
from zwidth.normalization import normalize
from zwidth.quantities import ANY, PARAMETERS, Range

# Mantissa, exponent, unit. The exponent is short so that no text makes an integer of thousands of digits.
_QUANTITY = re.compile(r"([-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+))(?:[eE]([-+]?[0-9]{1,6}))?\s*(\S.{0,20})", re.DOTALL)


class Dimension(NamedTuple):
    """The units of one kind of quantity, each with its power of ten over the base unit, which comes first."""

    units: dict[str, int]
    example: str

    @property
    def base(self) -> str:
        """The SI unit that a number without a unit is in."""
        return next(iter(self.units))


MASS = Dimension({"kg": 0, "g": -3, "mg": -6}, "0.1 kg")
TIME = Dimension({"s": 0, "ms": -3, "us": -6, "µs": -6, "ns": -9}, "1 ms")
RATE = Dimension({"Hz": 0, "kHz": 3, "MHz": 6}, "1 kHz")
DAMPING = Dimension(
    {"N s/m": 0, "mN s/m": -3, "kN s/m": 3, "N s/mm": 3, "mN s/mm": 0, "N s/cm": 2, "kg/s": 0}, "10 N s/m"
)
STIFFNESS = Dimension({"N/m": 0, "mN/m": -3, "kN/m": 3, "MN/m": 6, "N/mm": 3, "kN/mm": 6, "N/cm": 2}, "10 kN/m")
_OF_UNIT = {dimension.base: dimension for dimension in (MASS, TIME, RATE, DAMPING, STIFFNESS)}

PERIOD_WORDS = ("periods", "period")


def find_dimension(unit: str) -> Dimension:
    """The units beside an SI base unit."""
    return _OF_UNIT[unit]


class Span(NamedTuple):
    """A length of time, in seconds or in sampling periods."""

    value: float
    unit: Literal["s", "periods"]

    def seconds(self, period: float) -> float:
        """The length in seconds for a sampling period in seconds."""
        return self.value if self.unit == "s" else self.value * period

    def periods(self, period: float) -> float:
        """The length in sampling periods, whole where it is whole but for rounding."""
        if self.unit == "periods":
            return self.value
        return float(normalize(mass=1.0, period=period, delay=self.value).d)

    def __str__(self) -> str:
        return f"{short(self.value)} {self.unit}"


def _canonical(unit: str) -> str:
    """One spelling of a unit for the many of them: ``N*s/m``, ``N·s / m`` and ``Ns/m`` are ``N s/m``."""
    # Two characters look like the micro sign; this makes them one.
    unit = unicodedata.normalize("NFKC", unit)
    unit = re.sub(r"\s*/\s*", "/", unit)
    return re.sub(r"N[\s*·⋅.]*s", "N s", unit)


def _parse(value: Any, dimension: Dimension, *, periods: bool) -> tuple[float, str]:
    """The number in the base unit and that unit, or the number and "periods"."""
    units = (*dimension.units, *PERIOD_WORDS) if periods else tuple(dimension.units)
    names = ", ".join(units)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return to_float(value), dimension.base
    remedy = f"write a number and a unit, as in {dimension.example!r}"
    allowed = f"it must be a number in {dimension.base} or a number with one of the units {names}"
    if not isinstance(value, str):
        raise problem(f"got {describe(value)}", allowed, remedy)
    if looks_like_number(value):
        raise problem(f"got the text {describe(value)}", allowed, f"drop the quotes (it is then in {dimension.base})")
    match = _QUANTITY.fullmatch(value.strip())
    if match is None:
        raise problem(f"got {describe(value)}", allowed, remedy)
    mantissa, exponent, unit = match.groups()
    if periods and unit in PERIOD_WORDS:
        return float(f"{mantissa}e{exponent or 0}"), "periods"
    powers = {_canonical(name): power for name, power in dimension.units.items()}
    power = powers.get(_canonical(unit))
    if power is None:
        raise problem(f"got {describe(value)}", f"the units allowed are {names}", suggestion(unit, units, remedy))
    # Shifting the decimal exponent rounds once: 0.3 ms is exactly the float64 of 0.0003.
    return float(f"{mantissa}e{int(exponent or 0) + power}"), dimension.base


def quantity(dimension: Dimension, allowed: Range = ANY) -> Callable[[Any], float]:
    """A validator for a quantity; its value is in the SI base unit."""

    def validate(value: Any) -> float:
        return _read(value, dimension, allowed)[0]

    return validate


def _read(value: Any, dimension: Dimension, allowed: Range, *, periods: bool = False) -> tuple[float, str]:
    """A quantity that the model is computed for, and its unit as `_parse` gives it."""
    amount, unit = _parse(value, dimension, periods=periods)
    check_range(amount, allowed, unit)
    least, most = SI_RANGE
    if amount and not least <= abs(amount) <= most:
        within = f"it must be 0 or {least:g} to {most:g} {unit} in magnitude"
        raise problem(f"got {short(amount)} {unit}", within, "check the units")
    return amount, unit


def span(allowed: Range) -> Callable[[Any], Span]:
    def validate(value: Any) -> Span:
        if isinstance(value, Span):
            return value
        amount, unit = _read(value, TIME, allowed, periods=True)
        return Span(amount, "periods" if unit == "periods" else "s")

    return validate


def make_entry_reader(name: str) -> Callable[[Any], float]:
    """A validator for one value of a parameter."""
    parameter = PARAMETERS[name]
    if parameter.unit == "1":
        return whole_number(parameter.allowed) if parameter.whole else number(parameter.allowed)
    return quantity(find_dimension(parameter.unit), parameter.allowed)
