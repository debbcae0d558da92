"""Quantities: every spelling of a unit, exact conversion, and spans in periods."""

import math

import pytest

from zwidth.parts.checks import Span
from zwidth.words.errors import UnusableValueError
from zwidth.words.units import (
    ANGLE,
    ANGULAR_DAMPING,
    ANGULAR_STIFFNESS,
    DAMPING,
    MASS,
    RATE,
    STIFFNESS,
    TIME,
    TORQUE,
    find_dimension,
    read_quantity,
    spell_exactly,
)


@pytest.mark.parametrize(
    "dimension, text, value",
    [
        (MASS, "0.1 kg", 0.1),
        (MASS, "100g", 0.1),
        (MASS, "  2.5e2   g ", 0.25),
        (MASS, 0.1, 0.1),
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
        (ANGLE, "3 mrad", 0.003),
        (ANGLE, "90 deg", math.pi / 2),
        (ANGLE, "-1.8e2°", -math.pi),
        (ANGLE, "0.25 rev", math.pi / 2),
        (TORQUE, "50 mNm", 0.05),
        (TORQUE, "50 N·mm", 0.05),
        (TORQUE, "5 Ncm", 0.05),
        (ANGULAR_STIFFNESS, "5 Nm/rad", 5.0),
        (ANGULAR_STIFFNESS, "1 mN m/deg", 0.18 / math.pi),
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
def test_a_quantity_is_the_number_nearest_to_what_is_written(dimension, text, value):
    assert read_quantity(text, dimension)[0] == value


@pytest.mark.parametrize(
    "dimension, value",
    [
        (MASS, "0.1"),
        (MASS, "kg"),
        (MASS, "0.1 kg kg"),
        (MASS, "0,1 kg"),
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
def test_what_is_no_quantity(dimension, value):
    with pytest.raises(UnusableValueError):
        read_quantity(value, dimension)


def test_spans():
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
def test_a_spelled_quantity_is_read_back_bit_by_bit(value, unit, text):
    spelled = spell_exactly(value, unit)
    assert text is None or spelled == text
    mantissa, _, shown = spelled.partition(" ")
    assert len(mantissa) <= 25
    digits, _, exponent = mantissa.partition("E")
    assert find_dimension(unit).in_base(digits, int(exponent or 0), shown) == value
