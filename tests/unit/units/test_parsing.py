"""Test the parsing of quantities: spellings of units, exact conversion, and times in periods."""

import math
import re

import pytest

from zwidth.core.errors import UnusableValueError
from zwidth.model.checks import Span
from zwidth.units.parsing import (
    ANGLE,
    ANGULAR_DAMPING,
    ANGULAR_SPEED,
    ANGULAR_STIFFNESS,
    BANDWIDTH,
    DAMPING,
    DIMENSIONS,
    FORCE,
    INERTIA,
    LENGTH,
    MASS,
    RATE,
    STIFFNESS,
    TIME,
    TORQUE,
    format_exactly,
    read_quantity,
)


@pytest.mark.parametrize(
    "dimension, text, value",
    [
        (MASS, "0.1 kg", 0.1),
        (MASS, "100g", 0.1),
        (MASS, "  2.5e2   g ", 0.25),
        (MASS, 0.1, 0.1),
        (MASS, "0,1 kg", 0.1),
        (MASS, "−0,1 kg", -0.1),
        (STIFFNESS, "1.000,5 N/m", 1000.5),
        (STIFFNESS, "1,000.5 N/m", 1000.5),
        (STIFFNESS, "1,000,000 N/m", 1e6),
        (STIFFNESS, "1.000.000,0 N/m", 1e6),
        (STIFFNESS, "12'000 N/m", 12e3),
        (STIFFNESS, "12 000 N/m", 12e3),
        (STIFFNESS, "1.000 kN/m", 1e3),
        (STIFFNESS, "1 N/um", 1e6),
        (STIFFNESS, "1 N/µm", 1e6),
        (MASS, 2, 2.0),
        (DAMPING, "10 N s/m", 10.0),
        (DAMPING, "10 N*s/m", 10.0),
        (DAMPING, "10 N·s/m", 10.0),
        (DAMPING, "10 Ns/m", 10.0),
        (DAMPING, "10 N s / m", 10.0),
        (DAMPING, "10 kg/s", 10.0),
        (DAMPING, "3 mN s/mm", 3.0),
        (DAMPING, "3 mNs/m", 0.003),
        (DAMPING, "3 N s/mm", 3000.0),
        (ANGULAR_DAMPING, "0.02 mN m s", 2e-5),
        (ANGULAR_DAMPING, "0.02 mN*m*s", 2e-5),
        (ANGULAR_DAMPING, "20 uNms", 2e-5),
        (ANGULAR_DAMPING, "0.2 g cm^2/s", 2e-8),
        (ANGULAR_DAMPING, "1 mNm/krpm", 1e-6 / (math.pi / 30)),
        (ANGULAR_SPEED, "60 rpm", 2 * math.pi),
        (ANGULAR_SPEED, "60 RPM", 2 * math.pi),
        (ANGULAR_SPEED, "60 rev/min", 2 * math.pi),
        (ANGULAR_SPEED, "60 min^-1", 2 * math.pi),
        (ANGLE, "60 arcmin", math.pi / 180),
        (ANGLE, "3600 arcsec", math.pi / 180),
        (ANGLE, "1000 mdeg", math.pi / 180),
        (ANGLE, "3 mrad", 0.003),
        (ANGLE, "90 deg", math.pi / 2),
        (ANGLE, "-1.8e2°", -math.pi),
        (ANGLE, "0.25 rev", math.pi / 2),
        (TORQUE, "50 mNm", 0.05),
        (TORQUE, "50 N·mm", 0.05),
        (TORQUE, "5 Ncm", 0.05),
        (ANGULAR_STIFFNESS, "5 Nm/rad", 5.0),
        (ANGULAR_STIFFNESS, "1 N mm/rad", 1e-3),
        (ANGULAR_DAMPING, "5 mNms/rad", 0.005),
        (ANGULAR_DAMPING, "5 N*m*s / rad", 5.0),
        (TIME, "1 ms", 0.001),
        (TIME, "0.3 ms", 0.0003),
        (TIME, "7 us", 7e-6),
        (TIME, "7 µs", 7e-6),
        (TIME, "7 μs", 7e-6),
        (STIFFNESS, "10 kN/m", 10e3),
        (STIFFNESS, "-1.1 N/mm", -1100.0),
        (RATE, "1.5 kHz", 1500.0),
        (RATE, ".5e-3 MHz", 500.0),
    ],
)
def test_quantity_is_the_float_nearest_to_the_text(dimension, text, value):
    assert read_quantity(text, dimension)[0] == value


@pytest.mark.parametrize(
    "dimension, text, value",
    [
        (ANGULAR_STIFFNESS, "1 mN m/deg", 0.18 / math.pi),
        (STIFFNESS, "2 kgf/mm", 2 * 9.80665e3),
        (STIFFNESS, "2 kg/mm", 2 * 9.80665e3),
        (STIFFNESS, "10 lbf/in", 10 * 4.4482216152605 / 0.0254),
        (FORCE, "2 kgf", 19.6133),
        (FORCE, "3 lbf", 13.3446648457815),
        (TORQUE, "1 ozf in", 0.27801385095378125 * 0.0254),
        (TORQUE, "1 oz-in", 0.028349523125 * 9.80665 * 0.0254),
        (TORQUE, "1 in-oz", 0.028349523125 * 9.80665 * 0.0254),
        (TORQUE, "2 kg cm", 0.196133),
        (TORQUE, "2 kgf.cm", 0.196133),
        (ANGLE, "0.18º", math.pi / 1000),
        (ANGULAR_STIFFNESS, "1 N mm/deg", 0.18 / math.pi),
        (ANGULAR_STIFFNESS, "30 mNm/°", 5.4 / math.pi),
        (ANGULAR_STIFFNESS, "3.2 N m/turn", 1.6 / math.pi),
        (ANGULAR_STIFFNESS, "3.2 N m/rev", 1.6 / math.pi),
        (ANGULAR_DAMPING, "5 mNm/(rad/s)", 0.005),
        (ANGULAR_DAMPING, "1 N m s/rev", 0.5 / math.pi),
        (INERTIA, "60 gcm2", 6e-6),
        (INERTIA, "60 g cm²", 6e-6),
        (RATE, "1000 1/s", 1000.0),
        (RATE, "5 1/s", 5.0),
        (BANDWIDTH, "1 500 1/s", 1500.0),
    ],
)
def test_compound_and_customary_units_are_read(dimension, text, value):
    # Products of several factors have several rounding errors.
    assert read_quantity(text, dimension)[0] == pytest.approx(value, rel=4e-16, abs=0)


def test_counts_per_revolution_or_length_are_an_encoder_step():
    step = math.pi / 1000
    for text in ("2000 counts/rev", "2000 cpr", "2,000.0 counts/turn", "2e3 ticks/rev"):
        assert read_quantity(text, ANGLE)[0] == pytest.approx(step, rel=1e-15)
    assert read_quantity("2000 counts", ANGLE, counts=True)[0] == pytest.approx(step, rel=1e-15)
    assert read_quantity("14 bit", ANGLE)[0] == 2 * math.pi / 2**14
    # Without the number of counts per turn, counts are not an angle.
    with pytest.raises(UnusableValueError, match="units allowed are rad"):
        read_quantity("20 counts", ANGLE)
    assert read_quantity("50 counts/mm", LENGTH)[0] == pytest.approx(2e-5, rel=1e-15)
    with pytest.raises(UnusableValueError, match=r"a rotary unit for a linear device.*50 counts/mm"):
        read_quantity("2000 counts", LENGTH, counts=True)


@pytest.mark.parametrize(
    ("dimension", "text"),
    [
        (STIFFNESS, "1 pN/m"),
        (STIFFNESS, "1 GN/m"),
        (STIFFNESS, "2 N m"),
        (STIFFNESS, "10 kN"),
        (ANGULAR_STIFFNESS, "2 N m"),
        (ANGULAR_STIFFNESS, "2 N m s/rad"),
        (DAMPING, "10 N/m"),
        (DAMPING, "3 MN s/um s"),
        (MASS, "70 gr"),
        (LENGTH, "2000 counts"),
        (RATE, "1 ms"),
        (TIME, "1 Mhz"),
    ],
)
def test_no_suggestion_has_another_magnitude(dimension, text):
    with pytest.raises(UnusableValueError, match="units allowed are") as caught:
        read_quantity(text, dimension)
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(
    ("dimension", "text", "suggestion"),
    [
        (MASS, "0.1 KG", "kg"),
        (RATE, "1 khz", "kHz"),
        (STIFFNESS, "1 KN/m", "kN/m"),
        (DAMPING, "1 ns/m", "N s/m"),
        (ANGULAR_DAMPING, "1 mN m s/rd", "mN m s/rad"),
    ],
)
def test_suggestion_has_the_same_magnitude(dimension, text, suggestion):
    with pytest.raises(UnusableValueError, match=f"did you mean '{suggestion}'"):
        read_quantity(text, dimension)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,000 N/m", "the comma is ambiguous: decimal or thousands separator; write '1000 N/m' or '1.000 N/m'"),
        ("1,00,0.5 N/m", "not in groups of three"),
        ("1,5", "it must be one number without separators; write 1.5"),
        ("1000,2000", "it must be one number without separators; write 1000.2000 if the comma is a decimal point"),
    ],
)
def test_ambiguous_separators_are_rejected(text, message):
    with pytest.raises(UnusableValueError, match=re.escape(message)):
        read_quantity(text, STIFFNESS)


@pytest.mark.parametrize(
    "dimension, value",
    [
        (MASS, "0.1"),
        (MASS, "kg"),
        (MASS, "0.1 kg kg"),
        (MASS, "1,000 kg"),
        (MASS, "1,00,000 kg"),
        (MASS, "٣ kg"),
        (MASS, "1e99999999 kg"),
        (MASS, "1e999 kg"),
        (MASS, "nan kg"),
        (MASS, True),
        (MASS, None),
        (MASS, [1]),
        (MASS, 10**400),
        (TIME, "1 periods"),
        (TIME, "1 m s"),
        (TIME, "1 Ms"),
        (STIFFNESS, "10 N s/m"),
        (DAMPING, "10 N m/s"),
        (DAMPING, "10 N m s/m"),
        (TORQUE, "10 N/m"),
        (ANGLE, "10 m"),
    ],
)
def test_invalid_quantities_are_rejected(dimension, value):
    with pytest.raises(UnusableValueError):
        read_quantity(value, dimension)


def test_span_in_periods_and_seconds():
    assert Span(3.0, "periods").periods(1e-4) == 3.0
    assert Span(3.0, "periods").seconds(0.5) == 1.5
    assert Span(1.1e-3, "s").periods(1e-4) == 11.0
    assert Span(1.1e-3, "s").seconds(1e-4) == 1.1e-3
    assert str(Span(100.0, "periods")) == "100 periods"
    assert str(Span(0.1 + 0.2, "s")) == "0.30000000000000004 s"


@pytest.mark.parametrize(
    "value, unit, text",
    [
        (0.1, "kg", "100 g"),
        (0.0007, "s", "700 us"),
        (19863.4, "N/m", "19.8634 kN/m"),
        (-5.0, "N/m", "-5 N/m"),
        (0.0, "N s/m", "0 N s/m"),
        (1000.0, "Hz", "1 kHz"),
        (1e-5, "m", "10 um"),
        (1 / 3, "s", "333.3333333333333 ms"),
        (5e-324, "N/m", None),
        (1.7976931348623157e308, "N/m", None),
    ],
)
def test_exactly_formatted_quantity_is_read_back_bit_by_bit(value, unit, text):
    formatted = format_exactly(value, unit)
    assert text is None or formatted == text
    mantissa, _, prefixed_unit = formatted.partition(" ")
    assert len(mantissa) <= 25
    digits, _, exponent = mantissa.partition("E")
    assert DIMENSIONS[unit].in_base(digits, int(exponent or 0), prefixed_unit) == value
