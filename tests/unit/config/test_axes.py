"""Axes: values, sizes without values, and spellings that lead back to the same axis."""

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
def test_values(raw, form, values):
    made = AxisOf(Quantity()).read(raw)
    assert made.form == form
    assert made.values().dtype == np.float64
    np.testing.assert_allclose(made.values(), values, rtol=1e-15)
    assert made.size == len(values)
    assert max(made.entries) == max(values)
    assert AxisOf(Quantity()).read(made.serialize()) == made
    assert AxisOf(Quantity()).read(made) is made
    assert hash(made) == hash(AxisOf(Quantity()).read(raw))


def test_size_needs_no_memory():
    assert AxisOf(Quantity()).read({"linear": {"start": 0, "stop": 1, "num": 10_000_000}}).size == 10_000_000


def test_ends_too_far_apart_are_refused():
    with pytest.raises(ValueError, match="must be finite"):
        AxisOf(Quantity()).read({"linear": {"start": -1e308, "stop": 1e308, "num": 3}})


def test_steps_below_the_resolution_are_refused():
    with pytest.raises(ValueError, match="below float64's resolution"):
        AxisOf(Quantity()).read({"linear": {"start": 1.0, "stop": 1.0 + 1e-14, "num": 1000}})


def test_two_neighbors_may_be_as_close_as_float64_tells_apart():
    """One step of six units in the last place is an axis, one of three is not."""
    unit = 2.0**-52
    assert (
        AxisOf(Quantity()).read({"linear": {"start": 1.0, "stop": 1.0 + 6 * unit, "num": 2}}).values()[1]
        == 1.0 + 6 * unit
    )
    with pytest.raises(ValueError, match="below float64's resolution"):
        AxisOf(Quantity()).read({"linear": {"start": 1.0, "stop": 1.0 + 3 * unit, "num": 2}})
