"""Read quantities with units, such as ``10 kN/m``. Numbers without a unit are in the SI unit of their field.

Messages list the usual units of each dimension. `zwidth.words.unit_symbols` reads these and any other unit of the same
dimension, such as ``N/um`` or ``ozf in``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cached_property
from typing import Any, NoReturn

from zwidth.words.errors import UnusableValueError
from zwidth.words.formatting import describe, resembling, short
from zwidth.words.quantities import ANY, SI_RANGE, Range
from zwidth.words.unit_symbols import Exponents, UnitSize, measure_unit, normalize_symbols
from zwidth.words.unit_system import UNIT_PAIRS

# Mantissa, exponent, unit. The exponent is short so that no text makes an integer of thousands of digits.
_QUANTITY = re.compile(r"([-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+))(?:[eE]([-+]?[0-9]{1,6}))?\s*(\S.{0,30})", re.DOTALL)

# One way only to match a run of digits: a second one costs quadratic time on a long run that fails in the end.
_NUMBER_TEXT = re.compile(r"\s*[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?\s*")

# The leading number of a quantity, with thousands separators and a decimal separator; and an integer with thousands
# separators.
_DIGITS = re.compile(r"\s*[-+]?[0-9][0-9.,'’_\u00a0\u2009\u202f ]*[0-9](?![0-9])")
_GROUPED = re.compile(r"[1-9][0-9]{0,2}(?:(?P<mark>[.,'’_\u00a0\u2009\u202f ])[0-9]{3})(?:(?P=mark)[0-9]{3})*")


@dataclass(frozen=True, eq=False)
class Dimension:
    """A physical dimension with the units that messages list; all other units of the dimension are read as well."""

    names: str  # usual units, separated by commas, the base unit first; "" for ratios
    example: str
    factors: dict[str, float] = field(default_factory=dict)  # further units with other exponents, such as rad/s for Hz

    @property
    def units(self) -> tuple[str, ...]:
        return (*self.names.split(", "), *self.factors)

    @property
    def base(self) -> str:
        return self.units[0]

    @cached_property
    def exponents(self) -> Exponents | None:
        """Exponents of kg, m, s and rad; None for ratios."""
        size = measure_unit(self.base)
        return None if size is None else size.exponents

    def measure(self, unit: str) -> UnitSize | None:
        """Return the size of a unit; None for a unit of another dimension."""
        return measure_unit(unit, self.exponents) if self.exponents and unit else None

    def in_base(self, mantissa: str, exponent: int, unit: str) -> float | None:
        """Return ``mantissa * 10**exponent`` units in the base unit; None for a unit of another dimension."""
        if unit in self.factors:
            return float(f"{mantissa}e{exponent}") * self.factors[unit]
        size = self.measure(unit)
        # Shift the decimal exponent, because a product would round twice: 0.3 ms is exactly the float64 of 0.0003.
        return None if size is None else float(f"{mantissa}e{exponent + size.power}") * size.factor


MASS = Dimension("kg, g, mg", "0.1 kg")
TIME = Dimension("s, ms, us, µs, ns", "1 ms")
RATE = Dimension("Hz, kHz, MHz", "1 kHz")
DAMPING = Dimension("N s/m, mN s/m, kN s/m, N s/mm, mN s/mm, N s/cm, kg/s", "10 N s/m")
STIFFNESS = Dimension("N/m, mN/m, kN/m, MN/m, N/mm, kN/mm, N/cm", "10 kN/m")
FORCE = Dimension("N, mN, kN", "0.2 N")
LENGTH = Dimension("m, cm, mm, um, µm, nm", "10 um")
ANGLE = Dimension("rad, mrad, deg, °, rev, turn, turns", "0.1 deg")
TORQUE = Dimension("N m, mN m, uN m, µN m, kN m, N mm, mN mm, N cm", "50 mN m")
ANGULAR_STIFFNESS = Dimension("N m/rad, mN m/rad, uN m/rad, µN m/rad, kN m/rad, N m/deg, mN m/deg", "0.5 N m/rad")
ANGULAR_DAMPING = Dimension("N m s/rad, mN m s/rad, uN m s/rad, µN m s/rad, N m s/deg, mN m s/deg", "2 mN m s/rad")
INERTIA = Dimension("kg m^2, g m^2, kg cm^2, kg mm^2, g cm^2, g mm^2, mg mm^2", "12 g cm^2")
ANGULAR_SPEED = Dimension("rad/s, mrad/s, deg/s", "0.1 rad/s")
TORQUE_RATE = Dimension("N m/s, mN m/s", "0.5 N m/s")
SPEED = Dimension("m/s, cm/s, mm/s, um/s", "1 mm/s")
FORCE_RATE = Dimension("N/s, kN/s, N/ms", "500 N/s")
RATIO = Dimension("", "0.02")
_SCALES = (
    *(MASS, TIME, RATE, DAMPING, STIFFNESS, FORCE, FORCE_RATE, LENGTH, SPEED),
    *(INERTIA, ANGULAR_DAMPING, ANGULAR_STIFFNESS, TORQUE, TORQUE_RATE, ANGLE, ANGULAR_SPEED),
)
DIMENSIONS = {"1": RATIO, **{dimension.base: dimension for dimension in _SCALES}}
_OTHER_KIND = {one: other for pair in UNIT_PAIRS for one, other in (pair, pair[::-1])}
_ROTARY_UNITS = [rotary for _, rotary in UNIT_PAIRS]

PERIOD_WORDS = ("periods", "period")
COUNTS = ("counts", "count", "cnt", "cts", "ticks", "inc", "increments")
"""Units of encoder positions, which are converted with the resolution of the encoder."""


def find_other(dimension: Dimension) -> Dimension | None:
    """Return the dimension of the same quantity of the other kind of device, linear or rotary; None if it has none."""
    return DIMENSIONS.get(_OTHER_KIND.get(dimension.base, ""))


def tell_kind(value: Any) -> bool | None:
    """Return True for a quantity with a unit of a rotary device, False for that of a linear device, None otherwise."""
    if not isinstance(value, str):
        return None
    match = _QUANTITY.fullmatch(_drop_separators(value, strict=False))
    unit = "" if match is None else match[3].strip()
    if _read_counts("1", unit) is not None or unit.lower() in COUNTS:
        return True
    size = measure_unit(unit) if unit else None
    if size is None:
        # Classify unknown units by their denominator: units per angle are rotary.
        return True if _canonical(unit).endswith(("/rad", "/deg", "/°", "/turn", "/rev")) else None
    return _KIND_OF_EXPONENTS.get(size.exponents, True if size.exponents[3] else None)


def spell_exactly(value: float, unit: str) -> str:
    """Return a quantity in SI units as the shortest text that is read as the same float64: 0.1 kg as ``100 g``."""
    number, dimension = Decimal(repr(float(value))), DIMENSIONS[unit]
    sizes = [(name, size) for name in dimension.units if (size := dimension.measure(name)) is not None]
    powers = {name: size.power for name, size in sizes if size.factor == 1.0 and not size.power % 3}
    fitting = [name for name, power in powers.items() if abs(number.scaleb(-power)) >= 1]
    # The first name of a power is the usual one.
    chosen = max(fitting, key=lambda name: powers[name]) if fitting else unit
    digits = number.scaleb(-powers[chosen]).normalize()
    return f"{digits:{'f' if -6 < digits.adjusted() < 15 else ''}} {chosen}"


def looks_like_number(text: str) -> bool:
    """Return whether a text would be a number without its quotes."""
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
    """Return a float; infinity for an integer that overflows, which `check_range` refuses."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _canonical(unit: str) -> str:
    """Return the standard spelling of a unit: ``N s/m`` for ``N*s/m``, ``N·s / m`` and ``Ns/m``."""
    unit = normalize_symbols(unit)
    unit = re.sub(r"\s*/\s*", "/", unit)
    unit = re.sub(r"([kmµu]?g)[\s*·⋅.]*([cm]?m)\^?2$", r"\1 \2^2", unit)
    unit = re.sub(r"N[\s*·⋅.]*m[\s*·⋅.]*(?=s/)", "N m ", unit)
    return re.sub(r"N[\s*·⋅.]*(?=[scm])", "N ", unit)


_KIND_OF_EXPONENTS = {
    DIMENSIONS[base].exponents: kind == 1 for pair in UNIT_PAIRS for kind, base in enumerate(pair) if base in DIMENSIONS
}


def _drop_separators(text: str, *, strict: bool = True) -> str:
    """Return a quantity with a decimal point and without thousands separators.

    "1.000,5 N/m" and "1,000.5 N/m" are 1000.5 N/m, and "1,5 N/m" is 1.5 N/m. "1,000 N/m" is ambiguous. A single point
    is always the decimal point.

    Args:
        text: the quantity.
        strict: raise an error for ambiguous numbers; otherwise return the text unchanged.

    Raises:
        UnusableValueError: the number is ambiguous, or its separators are not thousands separators.
    """
    text = normalize_symbols(text.strip())
    match = _DIGITS.match(text)
    digits = match[0].strip() if match else ""
    number, rest = digits.lstrip("+-"), text[match.end() :] if match else text
    marks = re.sub("[0-9]", "", number)
    if not marks or marks == ".":
        return text
    sign = digits[: len(digits) - len(number)]
    decimal = next((mark for mark in ",." if number.count(mark) == 1 and number.rindex(mark) > _last(number, mark)), "")
    whole, _, fraction = number.rpartition(decimal) if decimal else (number, "", "")
    grouped = _GROUPED.fullmatch(whole) is not None
    plain_digits = re.sub("[^0-9]", "", whole)
    if decimal == "," and marks == "," and _GROUPED.fullmatch(number):
        if not strict:
            return text
        ways = " or ".join(repr(f"{sign}{way}{rest}") for way in (plain_digits + fraction, f"{whole}.{fraction}"))
        raise UnusableValueError(
            f"got {describe(text)}", "the comma is ambiguous: decimal or thousands separator", f"write {ways}"
        )
    if whole.isdigit() or grouped or (_GROUPED.fullmatch(number) and not decimal):
        return f"{sign}{plain_digits}{'.' if decimal else ''}{fraction}{rest}"
    if not strict:
        return text
    raise UnusableValueError(
        f"got {describe(text)}", "its digits are not in groups of three", "omit thousands separators, as '1000.5'"
    )


def _last(number: str, mark: str) -> int:
    """Return the index of the last separator other than ``mark``, -1 if there is none."""
    return max((k for k, sign in enumerate(number) if not sign.isdigit() and sign != mark), default=-1)


def _read_counts(mantissa: str, unit: str) -> tuple[float, Dimension] | None:
    """Return the encoder step in rad or m that a number of counts defines, and its dimension; None for other units.

    "2000 counts/rev" and "14 bit" define steps in rad, "50 counts/mm" defines a step in m.
    """
    number = float(mantissa)
    if unit.lower() in ("bit", "bits", "-bit") and 1 <= number <= 64 and number.is_integer():
        return 2.0 * math.pi / 2.0**number, ANGLE
    if unit.lower() == "cpr":
        unit = "counts/rev"
    name, per, base = (part.strip() for part in unit.partition("/"))
    if name.lower() not in COUNTS or not per or not number > 0:
        return None
    for dimension in (ANGLE, LENGTH):
        size = dimension.in_base("1", 0, base)
        if size is not None:
            return size / number, dimension
    return None


def _parse(value: Any, dimension: Dimension, *, periods: bool, counts: bool) -> tuple[float, str]:
    """Return a quantity in the base unit and that unit, or a number of periods and "periods"; see `read_quantity`."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return to_float(value), dimension.base
    units = (*dimension.units, *PERIOD_WORDS) if periods else dimension.units
    text, names, got = value if isinstance(value, str) else "", ", ".join(units), f"got {describe(value)}"
    allowed = f"it must be a number in {dimension.base} or a number with one of the units {names}"
    remedy = f"write a number and a unit, as in {dimension.example!r}"
    if dimension is RATIO:
        allowed, remedy = "it must be a number without a unit", f"write a number, as {dimension.example}"
    text = _drop_separators(text)
    if looks_like_number(text) and not looks_like_number(str(value)):
        raise UnusableValueError(got, "numbers without a unit have no separators", f"write {text}")
    if looks_like_number(text):
        raise UnusableValueError(
            f"got the text {describe(value)}", allowed, f"drop the quotes (it is then in {dimension.base})"
        )
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise UnusableValueError(got, allowed, remedy)
    mantissa, exponent, unit = match.groups()
    if periods and unit in PERIOD_WORDS:
        return float(f"{mantissa}e{exponent or 0}"), "periods"
    amount = dimension.in_base(mantissa, int(exponent or 0), unit)
    if amount is not None:
        return amount, dimension.base
    if dimension in (LENGTH, ANGLE):
        number = f"{mantissa}e{exponent or 0}"
        step = _read_counts(number, f"{unit}/rev" if counts and unit.lower() in COUNTS else unit)
        if step is not None:
            if step[1] is not dimension:
                _refuse_kind(got, dimension, "write the encoder step as a length, or as '50 counts/mm'")
            return step[0], dimension.base
    if dimension is RATIO:
        raise UnusableValueError(got, allowed, remedy)
    other = find_other(dimension)
    if other is not None and other.in_base(mantissa, 0, unit) is not None:
        that = "linear" if dimension.base in _ROTARY_UNITS else "rotary"
        _refuse_kind(
            got,
            dimension,
            f"write one of these, or every quantity of the device in {that} units, as {other.example!r} here",
        )
    meant = _find_same_letters(unit, (*units, *(other.units if other else ())))
    raise UnusableValueError(got, f"the units allowed are {names}", meant or remedy)


def _refuse_kind(got: str, dimension: Dimension, remedy: str) -> NoReturn:
    """Raise `UnusableValueError` for a rotary unit in a linear device or a linear unit in a rotary device."""
    this, that = ("rotary", "linear") if dimension.base in _ROTARY_UNITS else ("linear", "rotary")
    names = ", ".join(dimension.units)
    raise UnusableValueError(
        f"{got}, a unit of a {that} device where the device is {this}", f"the units allowed are {names}", remedy
    )


def _find_same_letters(unit: str, candidates: Sequence[str]) -> str:
    """Return a question that suggests the unit which a misspelled one stands for, "" if there is none.

    The suggestion has the same magnitude for certain: the two differ only in the case of letters other than m and M,
    which may be prefixes, or in the spelling of symbols of three letters or more.
    """

    def fold(name: str) -> str:
        """Return a unit in lower case except for m and M."""
        return "".join(sign if sign in "mM" else sign.lower() for sign in _canonical(name).replace(" ", ""))

    def split(name: str) -> list[str]:
        return re.split(r"([ /])", _canonical(name))

    def misspells(name: str) -> bool:
        """Return whether the unit differs from a correct one only by the spelling of symbols of 3 letters or more."""
        pairs = list(zip(split(unit), split(name), strict=False))
        if len(split(unit)) != len(split(name)):
            return False
        others = [(one, other) for one, other in pairs if one != other]
        return all(len(other) > 2 and one[:1] == other[0] and resembling(one, [other]) for one, other in others)

    same = [name for name in candidates if fold(name) == fold(unit)]
    same = same or ([] if measure_unit(unit) else [name for name in candidates if misspells(name)])
    return f"did you mean {same[0]!r}?" if same else ""


def read_quantity(
    value: Any, dimension: Dimension, allowed: Range = ANY, *, periods: bool = False, counts: bool = False
) -> tuple[float, str]:
    """Return a quantity in its base unit, and that unit.

    Args:
        value: a number in the base unit, or a text with a number and a unit.
        dimension: dimension of the quantity.
        allowed: range of the quantity.
        periods: allow numbers of sampling periods. These are returned unchanged, with the unit "periods".
        counts: allow counts per revolution: "2000 counts" is the step of an encoder with 2000 counts per revolution.

    Raises:
        UnusableValueError: the value is no quantity of this dimension, or out of range.
    """
    amount, unit = _parse(value, dimension, periods=periods, counts=counts)
    check_range(amount, allowed, unit)
    least, most = SI_RANGE
    if amount and not least <= abs(amount) <= most:
        within = f"it must be 0 or {least:g} to {most:g} {unit} in magnitude"
        raise UnusableValueError(f"got {short(amount)} {unit}", within, "check the units")
    return amount, unit


def read_share(text: str) -> float:
    """Return the value of a share such as ``2%`` or ``0.02``; raise `ValueError` for other texts."""
    text = text.strip()
    return float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)


# Of logs and responses; and their units besides.
_KNOWN = (TIME, LENGTH, ANGLE, FORCE, TORQUE, SPEED, RATE)
_FURTHER = ("A", "mA", "rpm", "rad/s", "deg/s", "counts/s", "krad/s", "dB", "m/N", "mm/N", "um/N", "µm/N")
_TITLE = re.compile(r"(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))?")
# Where a unit may begin behind a name without brackets: time_s, time/s, time s.
_JOINT = re.compile(r"\s*[/,]\s*|_|\s+")


def split_title(title: str) -> tuple[str, str]:
    """The name of a column, and its unit, which stands in brackets at its end."""
    match = _TITLE.fullmatch(title.strip())
    return (match[1], (match[2] or match[3] or "").strip()) if match else (title, "")


def split_head(head: str) -> tuple[str, str]:
    """The name of a column and its unit: in brackets, or behind a slash, an underscore or a blank where it is known."""
    name, unit = split_title(head)
    if unit or name != head.strip():
        return name, unit
    for joint in _JOINT.finditer(head):
        if joint.start() and is_unit(head[joint.end() :]):
            return head[: joint.start()], head[joint.end() :]
    return name, unit


def is_unit(text: str) -> bool:
    """Whether a text is the unit of some column of logs or responses."""
    return text in _FURTHER or text.lower() in COUNTS or any(each.in_base("1", 0, text) is not None for each in _KNOWN)
