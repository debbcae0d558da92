"""Test the formatting of values against texts written by hand: significant digits, no exponent from 1e-4 to 1e6."""

import math

import pytest

from zwidth.units.formatting import format_interval, format_sufficient, plain, round_conservatively, with_unit


@pytest.mark.parametrize(
    "value, text",
    [
        (0.0, "0"),
        (-0.0, "0"),
        (0.5, "0.5000"),
        (-12.34, "-12.34"),
        (1234.4, "1234"),
        (999960.0, "1.000e+06"),
        (999940.0, "999900"),
        (1e-4, "0.0001000"),
        (-1.04e-4, "-0.0001040"),
        (9.9994e-5, "9.999e-05"),
        (9.99996e-5, "0.0001000"),
        (math.nan, "none"),
        (math.inf, "infinite"),
        (-math.inf, "-infinite"),
    ],
)
def test_plain(value, text):
    assert plain(value) == text


@pytest.mark.parametrize(
    "value, text",
    [
        (19870.0, "19.87 kN/m"),
        (-0.0213, "-21.30 mN/m"),
        (999.94, "999.9 N/m"),
        (999.96, "1.000 kN/m"),
        (1000.0, "1.000 kN/m"),
        (1e-9, "1.000 nN/m"),
        (2e-11, "0.02000 nN/m"),
        (5e13, "50000 GN/m"),
        (999.96e9, "1000 GN/m"),
        (0.0, "0 N/m"),
        (math.nan, "none"),
    ],
)
def test_with_unit(value, text):
    assert with_unit(value, "N/m") == text


def test_number_of_digits():
    assert (with_unit(0.01, "", 1), with_unit(-1234.5, "1")) == ("0.01", "-1234")
    assert (plain(2 / 3, 2), with_unit(2 / 3, "s", 2), with_unit(996.0, "s", 2)) == ("0.67", "670 ms", "1.0 ks")


def test_interval_ends_are_distinct_and_rounded_inward():
    assert format_interval(-3.45678, 19844.99, "N/m") == ("-3.456 N/m", "19.84 kN/m")
    assert format_interval(1.23411, 1.23499) == ("1.2342", "1.2349")
    assert format_interval(10.5953e3, 10.5971e3, "N/m") == ("10.596 kN/m", "10.597 kN/m")
    assert format_interval(1.0, 2.0) == ("1.000", "2.000")
    assert format_interval(3.0, 3.0, "N/m") == ("3.000 N/m", "3.000 N/m")
    assert format_interval(-float("inf"), 1.0, "N/m") == ("-infinite", "1.000 N/m")
    low, high = format_interval(1.0, 1.0 + 2.3e-16)
    assert low != high


@pytest.mark.parametrize(
    ("value", "enough", "rounded"),
    [(1.23456, "above", 1.235), (1.23456, "below", 1.234), (-1.23456, "above", -1.234), (-1.23456, "below", -1.235)],
)
def test_round_conservatively_rounds_to_the_sufficient_side(value, enough, rounded):
    assert round_conservatively(value, enough) == pytest.approx(rounded, rel=1e-12)
    assert round_conservatively(rounded, enough) == pytest.approx(rounded, rel=1e-12)


def test_round_conservatively_keeps_zero_infinity_and_undirected_values():
    assert round_conservatively(0.0, "above") == 0.0
    assert round_conservatively(float("inf"), "below") == float("inf")
    assert round_conservatively(1.23456, "") == 1.23456


def test_sufficient_range_is_rounded_inward():
    assert format_sufficient(40.653e-6, "above", [40.653e-6, 224.97e-6], "s") == "40.66 µs to 224.9 µs"
    assert format_sufficient(224.97e-6, "below", [40.653e-6, 1.0], "s") == "40.66 µs to 224.9 µs"
    assert format_sufficient(1.00001, "above", [1.00002], "1") == "1.00001 to 1.00002"
    assert format_sufficient(224.97e-6, "below", [1.0], "s") == "224.9 µs or less"
