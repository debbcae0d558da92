"""Test ranges of quantities and units of outputs against their definitions."""

import math

import pytest

from zwidth.units.outputs import OUTPUTS
from zwidth.units.quantities import Range


@pytest.mark.parametrize("low_open", [False, True])
@pytest.mark.parametrize("high_open", [False, True])
def test_range_contains_its_ends_unless_open(low_open, high_open):
    allowed = Range(0.0, 1.0, low_open, high_open)
    assert (allowed.holds(0.0), allowed.holds(1.0)) == (not low_open, not high_open)
    assert allowed.holds(0.5)
    assert not allowed.holds(-5e-324)
    assert not allowed.holds(math.nextafter(1.0, 2.0))
    low, high = "greater than 0" if low_open else "at least 0", "less than 1" if high_open else "at most 1"
    assert str(allowed) == f"{low} and {high}"


@pytest.mark.parametrize(
    "name, normalized, physical",
    [("settling_time", "sampling periods", "s"), ("decay_rate", "1/period", "1/s"), ("spectral_radius", "1", "1")],
)
def test_output_units_of_a_sweep(name, normalized, physical):
    assert (OUTPUTS[name].units_in(False), OUTPUTS[name].units_in(True)) == (normalized, physical)
