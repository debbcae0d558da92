"""Axes of configurations: values, sizes without allocation, serialization and invalid ends."""

import numpy as np
import pytest

from zwidth.config.values import AxisOf, Quantity


@pytest.mark.parametrize(
    "raw, form, values",
    [
        (0.5, "number", [0.5]),
        (2, "number", [2.0]),
        ([4, 0, 1.5], "list", [4.0, 0.0, 1.5]),
        ({"linear": {"start": 0, "stop": 1, "num": 5}}, "linear", [0.0, 0.25, 0.5, 0.75, 1.0]),
        ({"linear": {"start": 1, "stop": -1, "num": 3}}, "linear", [1.0, 0.0, -1.0]),
        ({"log": {"start": 0.01, "stop": 100, "num": 5}}, "log", [0.01, 0.1, 1.0, 10.0, 100.0]),
    ],
)
def test_values_of_every_form(raw, form, values):
    axis = AxisOf(Quantity()).read(raw)
    assert axis.form == form
    assert axis.values().dtype == np.float64
    np.testing.assert_allclose(axis.values(), values, rtol=1e-15)
    assert axis.size == len(values)
    assert max(axis.entries) == max(values)
    assert AxisOf(Quantity()).read(axis.serialize()) == axis
    assert AxisOf(Quantity()).read(axis) is axis
    assert hash(axis) == hash(AxisOf(Quantity()).read(raw))


def test_size_is_known_without_computing_values():
    assert AxisOf(Quantity()).read({"linear": {"start": 0, "stop": 1, "num": 10_000_000}}).size == 10_000_000


def test_overflowing_range_raises():
    with pytest.raises(ValueError, match="must be finite"):
        AxisOf(Quantity()).read({"linear": {"start": -1e308, "stop": 1e308, "num": 3}})


def test_step_below_float64_resolution_raises():
    with pytest.raises(ValueError, match="below float64's resolution"):
        AxisOf(Quantity()).read({"linear": {"start": 1.0, "stop": 1.0 + 1e-14, "num": 1000}})


def test_smallest_step_is_accepted():
    """A step of six units in the last place is accepted, one of three is not."""
    unit = 2.0**-52
    assert (
        AxisOf(Quantity()).read({"linear": {"start": 1.0, "stop": 1.0 + 6 * unit, "num": 2}}).values()[1]
        == 1.0 + 6 * unit
    )
    with pytest.raises(ValueError, match="below float64's resolution"):
        AxisOf(Quantity()).read({"linear": {"start": 1.0, "stop": 1.0 + 3 * unit, "num": 2}})
