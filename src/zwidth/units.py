"""Quantities with a unit, as ``10 kN/m``; a number alone is in the SI base unit of its field."""

from __future__ import annotations

import inspect
import math
import re
import unicodedata
from collections.abc import Callable
from functools import wraps
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar

import numpy as np

from zwidth._types import Array
from zwidth.errors import InputError, UnusableValueError
from zwidth.formatting import describe, short, suggestion
from zwidth.quantities import ANY, NOT_NEGATIVE, PARAMETERS, SI_RANGE, Range
from zwidth.xp import frozen, namespace

# Mantissa, exponent, unit. The exponent is short so that no text makes an integer of thousands of digits.
_QUANTITY = re.compile(r"([-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+))(?:[eE]([-+]?[0-9]{1,6}))?\s*(\S.{0,20})", re.DOTALL)

# One way only to match a run of digits: a second one costs quadratic time on a long run that fails in the end.
_NUMBER_TEXT = re.compile(r"\s*[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?\s*")


class Dimension(NamedTuple):
    """The units of one kind of quantity, the base unit first, each with its power of ten over that.

    Units that are no power of ten stand apart, with their factors.
    """

    powers: dict[str, int]
    example: str
    factors: dict[str, float] = {}  # noqa: RUF012  (nobody writes into it)

    @property
    def units(self) -> tuple[str, ...]:
        """Their names."""
        return (*self.powers, *self.factors)

    @property
    def base(self) -> str:
        """The SI unit that a number without a unit is in."""
        return next(iter(self.powers))

    def in_base(self, mantissa: str, exponent: int, unit: str) -> float | None:
        """A number of a unit in the base unit; None for another dimension's unit."""
        own = next((name for name in self.units if _canonical(name) == _canonical(unit)), None)
        if own in self.factors:
            return float(f"{mantissa}e{exponent}") * self.factors[own]
        # Shifting the decimal exponent rounds once: 0.3 ms is exactly the float64 of 0.0003.
        return None if own is None else float(f"{mantissa}e{exponent + self.powers[own]}")


MASS = Dimension({"kg": 0, "g": -3, "mg": -6}, "0.1 kg")
TIME = Dimension({"s": 0, "ms": -3, "us": -6, "µs": -6, "ns": -9}, "1 ms")
RATE = Dimension({"Hz": 0, "kHz": 3, "MHz": 6}, "1 kHz")
DAMPING = Dimension(
    {"N s/m": 0, "mN s/m": -3, "kN s/m": 3, "N s/mm": 3, "mN s/mm": 0, "N s/cm": 2, "kg/s": 0}, "10 N s/m"
)
STIFFNESS = Dimension({"N/m": 0, "mN/m": -3, "kN/m": 3, "MN/m": 6, "N/mm": 3, "kN/mm": 6, "N/cm": 2}, "10 kN/m")
FORCE = Dimension({"N": 0, "mN": -3, "kN": 3}, "0.2 N")
LENGTH = Dimension({"m": 0, "cm": -2, "mm": -3, "um": -6, "µm": -6, "nm": -9}, "10 um")
ANGLE = Dimension(
    {"rad": 0, "mrad": -3},
    "0.1 deg",
    {"deg": math.pi / 180, "°": math.pi / 180, **dict.fromkeys(("rev", "turn", "turns"), 2 * math.pi)},
)
TORQUE = Dimension({"N m": 0, "mN m": -3, "kN m": 3, "N mm": -3, "mN mm": -6, "N cm": -2}, "50 mN m")
ANGULAR_STIFFNESS = Dimension(
    {"N m/rad": 0, "mN m/rad": -3}, "0.5 N m/rad", {"N m/deg": 180 / math.pi, "mN m/deg": 0.18 / math.pi}
)
ANGULAR_DAMPING = Dimension({"N m s/rad": 0, "mN m s/rad": -3}, "2 mN m s/rad")
SPEED = Dimension({"m/s": 0, "cm/s": -2, "mm/s": -3, "um/s": -6}, "1 mm/s")
FORCE_RATE = Dimension({"N/s": 0, "kN/s": 3, "N/ms": 3}, "500 N/s")
_OF_UNIT = {dimension.base: dimension for dimension in (MASS, TIME, RATE, DAMPING, STIFFNESS, FORCE, LENGTH, SPEED)}

PERIOD_WORDS = ("periods", "period")


def find_dimension(unit: str) -> Dimension:
    """The units beside an SI base unit."""
    return _OF_UNIT[unit]


def in_periods(delay: Array, period: Array) -> Array:
    """``delay/period``, with a quotient within 4 rounding errors of a whole number taken as that number.

    1.1 ms over 0.1 ms is 11 periods, but its float64 quotient is 11.000000000000002, another polynomial.
    """
    xp = namespace(delay, period)
    quotient = delay / period
    whole = xp.round(quotient)
    near = xp.abs(quotient - whole) <= 4 * np.finfo(quotient.dtype).eps * xp.maximum(whole, 1.0)
    # Rounding is flat; the quotient it corrects is not.
    return quotient - frozen(xp.where(near & (whole > 0), quotient - whole, 0.0), xp)


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
        return float(in_periods(np.float64(self.value), np.float64(period)))

    def __str__(self) -> str:
        return f"{short(self.value)} {self.unit}"


def looks_like_number(text: str) -> bool:
    """Whether a text would be a number without its quotes."""
    return _NUMBER_TEXT.fullmatch(text) is not None


def check_range(value: float, allowed: Range, unit: str = "", remedy: str = "") -> float:
    """Return a finite, admissible value or raise `UnusableValueError`."""
    bounds = str(allowed)
    needed = f"it must be {bounds}{f' {unit}' if unit else ''}" if bounds else "it must be finite"
    if not math.isfinite(value):
        needed = f"it must be finite{f' and {bounds}' if bounds else ''}"
        raise UnusableValueError(f"got {describe(value)}", needed, remedy or "write a finite number")
    if not allowed.holds(value):
        raise UnusableValueError(
            f"got {short(value)}{f' {unit}' if unit else ''}", needed, remedy or "write a number in this range"
        )
    return value


def to_float(value: Any) -> float:
    """A whole number beyond float64 becomes infinite, which `check_range` then refuses."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _canonical(unit: str) -> str:
    """One spelling of a unit for the many of them: ``N*s/m``, ``N·s / m`` and ``Ns/m`` are ``N s/m``."""
    # Two characters look like the micro sign; this makes them one.
    unit = unicodedata.normalize("NFKC", unit)
    unit = re.sub(r"\s*/\s*", "/", unit)
    unit = re.sub(r"N[\s*·⋅.]*m[\s*·⋅.]*(?=s/)", "N m ", unit)
    return re.sub(r"N[\s*·⋅.]*(?=[scm])", "N ", unit)


def _parse(value: Any, dimension: Dimension, *, periods: bool) -> tuple[float, str]:
    """The number in the base unit and that unit, or the number and "periods"."""
    units = (*dimension.units, *PERIOD_WORDS) if periods else dimension.units
    names = ", ".join(units)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return to_float(value), dimension.base
    remedy = f"write a number and a unit, as in {dimension.example!r}"
    allowed = f"it must be a number in {dimension.base} or a number with one of the units {names}"
    if not isinstance(value, str):
        raise UnusableValueError(f"got {describe(value)}", allowed, remedy)
    if looks_like_number(value):
        raise UnusableValueError(
            f"got the text {describe(value)}", allowed, f"drop the quotes (it is then in {dimension.base})"
        )
    match = _QUANTITY.fullmatch(value.strip())
    if match is None:
        raise UnusableValueError(f"got {describe(value)}", allowed, remedy)
    mantissa, exponent, unit = match.groups()
    if periods and unit in PERIOD_WORDS:
        return float(f"{mantissa}e{exponent or 0}"), "periods"
    amount = dimension.in_base(mantissa, int(exponent or 0), unit)
    if amount is None:
        raise UnusableValueError(
            f"got {describe(value)}", f"the units allowed are {names}", suggestion(unit, units, remedy)
        )
    return amount, dimension.base


def read_quantity(
    value: Any, dimension: Dimension, allowed: Range = ANY, *, periods: bool = False
) -> tuple[float, str]:
    """A quantity that the model is computed for, in its base unit or, where allowed, in "periods"; and which of them.

    Raises:
        UnusableValueError: it is no number, has another unit, or is out of range.
    """
    amount, unit = _parse(value, dimension, periods=periods)
    check_range(amount, allowed, unit)
    least, most = SI_RANGE
    if amount and not least <= abs(amount) <= most:
        within = f"it must be 0 or {least:g} to {most:g} {unit} in magnitude"
        raise UnusableValueError(f"got {short(amount)} {unit}", within, "check the units")
    return amount, unit


def read_span(value: Any, allowed: Range) -> Span:
    """A length of time."""
    if isinstance(value, Span):
        return value
    amount, unit = read_quantity(value, TIME, allowed, periods=True)
    return Span(amount, "periods" if unit == "periods" else "s")


Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def accept_units(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let the SI quantities that a function takes be texts with a unit: "70 g", and a delay "1.5 periods" as well."""
    names = tuple(inspect.signature(function).parameters)

    @wraps(function)
    def accepting(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        given = dict(zip(names, args, strict=False)) | kwargs
        if len(args) <= len(names) and any(map(_has_text, given.values())):
            period = _in_si("period", given.get("period"), None)
            return function(**{name: _in_si(name, value, period) for name, value in given.items()})  # pyright: ignore[reportCallIssue]
        return function(*args, **kwargs)

    return accepting


def _has_text(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, tuple) and any(isinstance(end, str) for end in value))


def _in_si(name: str, value: Any, period: Any) -> Any:
    """A text, or a named tuple of texts, as numbers in the SI base unit; anything else as it is."""
    if name not in PARAMETERS or PARAMETERS[name].unit == "1" or not _has_text(value):
        return value
    if isinstance(value, tuple):
        return type(value)(*(_in_si(name, end, period) for end in value))
    try:
        if name != "delay":
            return read_quantity(value, find_dimension(PARAMETERS[name].unit))[0]
        span = read_span(value, NOT_NEGATIVE)
    except UnusableValueError as error:
        raise InputError(f"{name}: {error}") from None
    if span.unit == "periods" and (period is None or isinstance(period, tuple)):
        raise InputError(f"{name}: got {value!r} without one period to count in; write it in seconds")
    return span.seconds(period)
