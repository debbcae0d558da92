"""Conversion of quantities with units, such as ``10 kN/m``, to SI, and messages for invalid ones.

A number without unit is in the SI unit of its field, the *base unit* of its dimension. Messages list the usual units of
a dimension; `zwidth.units.unit_symbols` accepts all other units of the dimension, too, such as ``N/um`` or ``ozf in``.
The *kind* of a device is linear or rotary.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cached_property
from typing import Any, NoReturn

from zwidth.core.errors import UnusableValueError
from zwidth.units.formatting import describe, resembling, short
from zwidth.units.quantities import ANY, SI_RANGE, Range
from zwidth.units.unit_symbols import Exponents, UnitSize, measure_unit, normalize_symbols
from zwidth.units.unit_system import UNIT_PAIRS

# Pattern of a quantity: mantissa, exponent and unit. The length of the exponent is limited, so that conversions do not
# create huge integers.
_QUANTITY = re.compile(r"([-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+))(?:[eE]([-+]?[0-9]{1,6}))?\s*(\S.{0,30})", re.DOTALL)

# Pattern of a number without unit. It can match a sequence of digits in one way only, because with several ways the
# search would take quadratic time for long texts that do not match.
_NUMBER_TEXT = re.compile(r"\s*[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?\s*")

# Pattern of the number at the start of a quantity, possibly with thousands separators and a decimal separator. It
# excludes the digit of units such as 1/s.
_DIGITS = re.compile(r"\s*[-+]?[0-9](?:(?! 1/)[0-9.,'’_\u00a0\u2009\u202f ])*[0-9](?![0-9])")
# Pattern of an integer with thousands separators, all of them the same character.
_GROUPED = re.compile(r"[1-9][0-9]{0,2}(?:(?P<mark>[.,'’_\u00a0\u2009\u202f ])[0-9]{3})(?:(?P=mark)[0-9]{3})*")


@dataclass(frozen=True, eq=False)
class Dimension:
    """A physical dimension and its usual units; all other units of the dimension are accepted as well."""

    names: str  # usual units, separated by commas, the base unit first; "" for ratios
    example: str  # a quantity, for messages
    # Conversion factors to the base unit for additional units with other exponents of kg, m, s and rad, such as rad/s
    # for frequencies in Hz.
    factors: dict[str, float] = field(default_factory=dict)

    @property
    def units(self) -> tuple[str, ...]:
        """All usual units, the base unit first."""
        return (*self.names.split(", "), *self.factors)

    @property
    def base(self) -> str:
        """The base unit, in SI."""
        return self.units[0]

    @cached_property
    def exponents(self) -> Exponents | None:
        """Exponents of kg, m, s and rad; None for ratios."""
        size = measure_unit(self.base)
        return None if size is None else size.exponents

    def measure(self, unit: str) -> UnitSize | None:
        """Return the conversion factor of a unit to SI as a `UnitSize`; None for a unit of another dimension.

        An angular damping may omit the angle, as in the "mN m s" of data sheets of motors.
        """
        if not self.exponents or not unit:
            return None
        size = measure_unit(unit, self.exponents)
        return measure_unit(unit, _WITHOUT_ANGLE) if size is None and self is ANGULAR_DAMPING else size

    def in_base(self, mantissa: str, exponent: int, unit: str) -> float | None:
        """Convert the quantity ``mantissa * 10**exponent`` with a unit to the base unit; None for another dimension."""
        if unit in self.factors:
            return float(f"{mantissa}e{exponent}") * self.factors[unit]
        size = self.measure(unit)
        # Shift the decimal exponent, because a product would round twice: 0.3 ms must be exactly the float64 of 0.0003.
        return None if size is None else float(f"{mantissa}e{exponent + size.power}") * size.factor


MASS = Dimension("kg, g, mg", "0.1 kg")
TIME = Dimension("s, ms, us, µs, ns", "1 ms")
RATE = Dimension("Hz, kHz, MHz", "1 kHz")
# Bandwidths have a dimension of their own, because their unit rad/s does not imply a rotary device.
BANDWIDTH = Dimension("1/s", "1000 rad/s", {"rad/s": 1.0, "krad/s": 1e3, "Hz": 2.0 * math.pi, "kHz": 2e3 * math.pi})
DAMPING = Dimension("N s/m, mN s/m, kN s/m, N s/mm, mN s/mm, N s/cm, kg/s", "10 N s/m")
STIFFNESS = Dimension("N/m, mN/m, kN/m, MN/m, N/mm, kN/mm, N/cm", "10 kN/m")
FORCE = Dimension("N, mN, kN", "0.2 N")
LENGTH = Dimension("m, cm, mm, um, µm, nm", "10 um")
ANGLE = Dimension("rad, mrad, deg, °, rev, turn, turns", "0.1 deg")
TORQUE = Dimension("N m, mN m, uN m, µN m, kN m, N mm, mN mm, N cm", "50 mN m")
ANGULAR_STIFFNESS = Dimension("N m/rad, mN m/rad, uN m/rad, µN m/rad, kN m/rad, N m/deg, mN m/deg", "0.5 N m/rad")
ANGULAR_DAMPING = Dimension(
    "N m s/rad, mN m s/rad, uN m s/rad, µN m s/rad, N m s/deg, mN m s/deg, mN m s, mN m/rpm", "2 mN m s/rad"
)
INERTIA = Dimension("kg m^2, g m^2, kg cm^2, kg mm^2, g cm^2, g mm^2, mg mm^2", "12 g cm^2")
ANGULAR_SPEED = Dimension("rad/s, mrad/s, deg/s, rpm", "0.1 rad/s")
TORQUE_RATE = Dimension("N m/s, mN m/s", "0.5 N m/s")
SPEED = Dimension("m/s, cm/s, mm/s, um/s", "1 mm/s")
FORCE_RATE = Dimension("N/s, kN/s, N/ms", "500 N/s")
INTEGRAL_GAIN = Dimension("N/(m s), kN/(m s), N/(mm s)", "2 kN/(m s)")
ANGULAR_INTEGRAL_GAIN = Dimension("N m/(rad s), mN m/(rad s), N m/(deg s), N m/(turn s)", "2 N m/(rad s)")
RATIO = Dimension("", "0.02")
_SCALES = (
    *(MASS, TIME, RATE, BANDWIDTH, DAMPING, STIFFNESS, FORCE, FORCE_RATE, LENGTH, SPEED),
    *(INERTIA, ANGULAR_DAMPING, ANGULAR_STIFFNESS, TORQUE, TORQUE_RATE, ANGLE, ANGULAR_SPEED),
    *(INTEGRAL_GAIN, ANGULAR_INTEGRAL_GAIN),
)
DIMENSIONS = {"1": RATIO, **{dimension.base: dimension for dimension in _SCALES}}
# Base unit of a quantity on the other kind of device, by its base unit: "N m/rad" for "N/m" and vice versa.
_OTHER_KIND = {one: other for pair in UNIT_PAIRS for one, other in (pair, pair[::-1])}
_ROTARY_UNITS = [rotary for _, rotary in UNIT_PAIRS]

PERIOD_WORDS = ("periods", "period")
"""Accepted units of a time that is given as a number of sampling periods."""
COUNTS = ("counts", "count", "cnt", "cts", "ticks", "inc", "increments")
"""Accepted units of encoder positions in counts; multiplication by the encoder resolution converts these to SI."""

_LINES = ("ppr", "lines", "line", "pulses", "pulses/rev", "lines/rev")  # units of encoders before counting


def find_other(dimension: Dimension) -> Dimension | None:
    """Return the dimension of a quantity on the other kind of device; None if both kinds have the same, such as s."""
    return DIMENSIONS.get(_OTHER_KIND.get(dimension.base, ""))


def detect_kind(value: Any) -> bool | None:
    """Return True for a text with a unit of rotary devices, False for one of linear devices, None for other values."""
    if not isinstance(value, str):
        return None
    match = _QUANTITY.fullmatch(_drop_separators(value, strict=False))
    unit = "" if match is None else match[3].strip()
    if _read_counts("1", unit) is not None or unit.lower() in COUNTS:
        return True
    size = measure_unit(unit) if unit else None
    if size is None:
        # Classify a unit that cannot be parsed by its denominator: a unit per angle is rotary.
        return True if _canonical(unit).endswith(("/rad", "/deg", "/°", "/turn", "/rev")) else None
    return _KIND_OF_EXPONENTS.get(size.exponents, True if size.exponents[3] else None)


def format_exactly(value: float, unit: str) -> str:
    """Format a quantity in SI as the shortest text that is converted to the same float64: 0.1 kg as ``100 g``."""
    number, dimension = Decimal(repr(float(value))), DIMENSIONS[unit]
    sizes = [(name, size) for name in dimension.units if (size := dimension.measure(name)) is not None]
    powers = {name: size.power for name, size in sizes if size.factor == 1.0 and not size.power % 3}
    fitting = [name for name, power in powers.items() if abs(number.scaleb(-power)) >= 1]
    # If several units have the same power of ten, `max` selects the first of them, which is the most common unit.
    chosen = max(fitting, key=lambda name: powers[name]) if fitting else unit
    digits = number.scaleb(-powers[chosen]).normalize()
    return f"{digits:{'f' if -6 < digits.adjusted() < 15 else ''}} {chosen}"


def looks_like_number(text: str) -> bool:
    """Return whether a text is a number without unit."""
    return _NUMBER_TEXT.fullmatch(text) is not None


def check_range(value: float, allowed: Range, unit: str = "", remedy: str = "") -> float:
    """Return a value unchanged if it is finite and in its range; otherwise raise `UnusableValueError`.

    Args:
        value: the value.
        allowed: allowed range.
        unit: unit of the value in messages.
        remedy: remedy in messages. Default: "write a number in this range", or "write a finite number".
    """
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
    """Convert a number to float; an integer that overflows becomes infinite, and `check_range` then rejects it."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _canonical(unit: str) -> str:
    """Convert a unit to its standard notation: ``N*s/m``, ``N·s / m`` and ``Ns/m`` become ``N s/m``."""
    unit = normalize_symbols(unit)
    unit = re.sub(r"\s*/\s*", "/", unit)
    unit = re.sub(r"([kmµu]?g)[\s*·⋅.]*([cm]?m)\^?2$", r"\1 \2^2", unit)
    unit = re.sub(r"N[\s*·⋅.]*m[\s*·⋅.]*(?=s/)", "N m ", unit)
    return re.sub(r"N[\s*·⋅.]*(?=[scm])", "N ", unit)


_WITHOUT_ANGLE: Exponents = (1, 2, -1, 0)  # exponents of kg, m, s and rad of an angular damping without its angle
# Kind of device (True: rotary, False: linear) to which a unit belongs, by the unit's exponents of kg, m, s and rad.
_KIND_OF_EXPONENTS = {
    DIMENSIONS[base].exponents: kind == 1 for pair in UNIT_PAIRS for kind, base in enumerate(pair) if base in DIMENSIONS
} | {_WITHOUT_ANGLE: True}


def _drop_separators(text: str, *, strict: bool = True) -> str:
    """Remove thousands separators from a quantity, and convert a decimal comma to a point.

    "1.000,5 N/m" and "1,000.5 N/m" become 1000.5 N/m, and "1,5 N/m" becomes 1.5 N/m. "1,000 N/m" is ambiguous. A single
    point is always a decimal point.

    Args:
        text: the quantity.
        strict: raise an error for ambiguous or invalid numbers; otherwise return such a text unchanged.

    Raises:
        UnusableValueError: the number is ambiguous, or its digits are not in groups of three.
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
    integer_part, _, fraction = number.rpartition(decimal) if decimal else (number, "", "")
    grouped = _GROUPED.fullmatch(integer_part) is not None
    plain_digits = re.sub("[^0-9]", "", integer_part)
    if decimal == "," and marks == "," and _GROUPED.fullmatch(number):
        if not strict:
            return text
        readings = " or ".join(
            repr(f"{sign}{each}{rest}") for each in (plain_digits + fraction, f"{integer_part}.{fraction}")
        )
        raise UnusableValueError(
            f"got {describe(text)}", "the comma is ambiguous: decimal or thousands separator", f"write {readings}"
        )
    if integer_part.isdigit() or grouped or (_GROUPED.fullmatch(number) and not decimal):
        return f"{sign}{plain_digits}{'.' if decimal else ''}{fraction}{rest}"
    if not strict:
        return text
    raise UnusableValueError(
        f"got {describe(text)}", "its digits are not in groups of three", "omit thousands separators, e.g. '1000.5'"
    )


def _last(number: str, mark: str) -> int:
    """Return the index of the last character that is neither a digit nor ``mark``; -1 if there is none."""
    return max((k for k, sign in enumerate(number) if not sign.isdigit() and sign != mark), default=-1)


def _read_counts(mantissa: str, unit: str) -> tuple[float, Dimension] | None:
    """Convert counts per revolution or per length to the resolution of the encoder.

    Returns:
        The resolution and its dimension: in rad for "2000 counts/rev" or "14 bit", in m for "50 counts/mm". None for
        other units.
    """
    number = float(mantissa)
    if unit.lower() in ("bit", "bits", "-bit") and 1 <= number <= 64 and number.is_integer():
        return 2.0 * math.pi / 2.0**number, ANGLE
    unit = "counts/rev" if unit.lower() == "cpr" else re.sub(r"\s+per\s+", "/", unit)
    name, per, base = (part.strip() for part in unit.partition("/"))
    if name.lower() not in COUNTS or not per or not number > 0:
        return None
    for dimension in (ANGLE, LENGTH):
        size = dimension.in_base("1", 0, base)
        if size is not None:
            return size / number, dimension
    return None


def _parse(value: Any, dimension: Dimension, *, periods: bool, counts: bool) -> tuple[float, str]:
    """Convert a quantity to its base unit as `read_quantity` does, but without checking its range."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return to_float(value), dimension.base
    units = (*dimension.units, *PERIOD_WORDS) if periods else dimension.units
    text, names, got = value if isinstance(value, str) else "", ", ".join(units), f"got {describe(value)}"
    allowed = f"it must be a number in {dimension.base} or a number with one of the units {names}"
    remedy = f"write a number and a unit, as in {dimension.example!r}"
    if dimension is RATIO:
        allowed, remedy = "it must be a number without a unit", f"write a number, e.g. {dimension.example}"
    text = _drop_separators(text)
    if looks_like_number(text) and not looks_like_number(str(value)):
        condition = " if the comma is a decimal point" if "." in text and "." not in str(value) else ""
        raise UnusableValueError(got, "it must be one number without separators", f"write {text}{condition}")
    if looks_like_number(text):
        note = f" (it is then in {dimension.base})" if dimension.base else ""
        raise UnusableValueError(f"got the text {describe(value)}", allowed, f"drop the quotes{note}")
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
        if unit.lower() in _LINES:
            remedy = f"write '{4.0 * float(number):.15g} counts/rev' if the counter counts all four edges of a line"
            raise UnusableValueError(got, "an encoder step is needed", remedy)
    if dimension is RATIO:
        raise UnusableValueError(got, allowed, remedy)
    other = find_other(dimension)
    if other is not None and other.in_base(mantissa, 0, unit) is not None:
        other_kind = "linear" if dimension.base in _ROTARY_UNITS else "rotary"
        _refuse_kind(
            got,
            dimension,
            f"write one of these, or write all quantities in {other_kind} units, e.g. {other.example!r}",
        )
    suggestion = _find_same_letters(unit, (*units, *(other.units if other else ())))
    raise UnusableValueError(got, f"the units allowed are {names}", suggestion or remedy)


def _refuse_kind(got: str, dimension: Dimension, remedy: str) -> NoReturn:
    """Raise `UnusableValueError` for a rotary unit on a linear device or a linear unit on a rotary device."""
    kind, other_kind = ("rotary", "linear") if dimension.base in _ROTARY_UNITS else ("linear", "rotary")
    names = ", ".join(dimension.units)
    raise UnusableValueError(
        f"{got}, a {other_kind} unit for a {kind} device", f"the units allowed are {names}", remedy
    )


def _find_same_letters(unit: str, candidates: Sequence[str]) -> str:
    """Return the question "did you mean ...?" for a misspelled unit; "" if no unit is similar enough.

    The suggestion must have the intended magnitude. Therefore it differs from the misspelled unit only in the case of
    letters other than m and M, which may be prefixes, or in the spelling of symbols with three or more letters.
    """

    def fold(name: str) -> str:
        """Return a unit without blanks and in lower case, except that m and M are unchanged."""
        return "".join(sign if sign in "mM" else sign.lower() for sign in _canonical(name).replace(" ", ""))

    def split(name: str) -> list[str]:
        return re.split(r"([ /])", _canonical(name))

    def misspells(name: str) -> bool:
        """Return whether the unit is the unit ``name`` except for misspelled symbols of 3 or more letters."""
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
    """Convert a quantity to its base unit.

    Args:
        value: a number in the base unit, or a text with a number and a unit.
        dimension: dimension of the quantity.
        allowed: allowed range of the quantity, in the base unit.
        periods: accept numbers of sampling periods, "1.5 periods".
        counts: accept "2000 counts" as the resolution of an encoder with 2000 counts per revolution.

    Returns:
        The quantity in the base unit, and the base unit; for sampling periods, their number and "periods".

    Raises:
        UnusableValueError: the value is not a quantity of this dimension, or it is out of range.
    """
    amount, unit = _parse(value, dimension, periods=periods, counts=counts)
    check_range(amount, allowed, unit)
    least, most = SI_RANGE
    if amount and not least <= abs(amount) <= most:
        limits = f"it must be 0 or {least:g} to {most:g} {unit} in magnitude"
        raise UnusableValueError(f"got {short(amount)} {unit}", limits, "check the units")
    return amount, unit


def read_share(text: str) -> float:
    """Convert a text such as "2%" or "0.02" to the number 0.02; raise `ValueError` for other texts."""
    text = text.strip()
    return float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)


def read_factor(text: str) -> float:
    """Convert a text such as "2" or "6 dB" to a factor; raise `ValueError` for other texts."""
    number = float(text.strip().removesuffix("dB"))
    return 10.0 ** (number / 20.0) if text.strip().endswith("dB") else number


def read_degrees(text: str) -> float:
    """Convert a text such as "30", "30 deg" or "30°" to an angle in degrees; raise `ValueError` for other texts."""
    return float(text.strip().removesuffix("deg").removesuffix("°"))


# Dimensions of the columns of logs and frequency responses.
_COLUMN_DIMENSIONS = (TIME, LENGTH, ANGLE, FORCE, TORQUE, SPEED, RATE)
# Further units of these columns.
_COLUMN_UNITS = ("A", "mA", "rpm", "rad/s", "deg/s", "counts/s", "krad/s", "dB", "m/N", "mm/N", "um/N", "µm/N")
# Pattern of a name and a unit in brackets, as in "time [s]" or "time (s)".
_TITLE = re.compile(r"(.*?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))?")
# Pattern of the separator between a name and a unit without brackets, as in time_s, time/s and time s.
_JOINT = re.compile(r"\s*[/,]\s*|_|\s+")


def split_title(title: str) -> tuple[str, str]:
    """Split the title of a column into its name and the unit in brackets at its end, or "" if it has no unit."""
    match = _TITLE.fullmatch(title.strip())
    return (match[1], (match[2] or match[3] or "").strip()) if match else (title, "")


def split_head(head: str) -> tuple[str, str]:
    """Split the title of a column into its name and its unit.

    The unit is in brackets, or it is a known unit after a slash, a comma, an underscore or a blank. It is "" if the
    title has no unit.
    """
    name, unit = split_title(head)
    if unit or name != head.strip():
        return name, unit
    for joint in _JOINT.finditer(head):
        if joint.start() and is_unit(head[joint.end() :]):
            return head[: joint.start()], head[joint.end() :]
    return name, unit


def is_unit(text: str) -> bool:
    """Return whether a text is a unit that a column of a log or of a frequency response may have."""
    return (
        text in _COLUMN_UNITS
        or text.lower() in COUNTS
        or any(each.in_base("1", 0, text) is not None for each in _COLUMN_DIMENSIONS)
    )
