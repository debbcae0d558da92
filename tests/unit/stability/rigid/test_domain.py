"""The supported domain includes its limits and excludes the next float64 beyond each."""

import jax
import numpy as np
import pytest

from zwidth.core.status import Status
from zwidth.core.xp import nan_unless, nan_with_nan_derivatives
from zwidth.stability.rigid.normalization import device_status, wall_status
from zwidth.units.quantities import LARGEST_DAMPING, LONGEST_DELAY, WALL_RANGE


@pytest.mark.parametrize("index, limit", [(0, LARGEST_DAMPING), (1, LONGEST_DELAY)])
def test_limits_of_device_parameters(index, limit):
    for value, status in ((limit, Status.OK), (np.nextafter(limit, np.inf), Status.OUT_OF_RANGE)):
        device = [np.float64(0.5), np.float64(0.5)]
        device[index] = np.float64(value)
        assert device_status(*device) == status
        assert wall_status(np.float64(0.1), np.float64(0.1), *device) == status
        device[index] = -device[index]
        assert device_status(*device) == Status.INVALID_INPUT


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_limits_of_wall_parameters(index, sign):
    smallest, largest = WALL_RANGE
    for value, status in (
        (0.0, Status.OK),
        (smallest, Status.OK),
        (largest, Status.OK),
        (np.nextafter(smallest, 0.0), Status.OUT_OF_RANGE),
        (np.nextafter(largest, np.inf), Status.OUT_OF_RANGE),
    ):
        wall = [np.float64(0.1), np.float64(0.1)]
        wall[index] = np.float64(sign * value)
        assert wall_status(wall[0], wall[1], np.float64(0.0), np.float64(0.0)) == status


@pytest.mark.parametrize(
    "mark", [lambda ok, x: nan_unless(ok, x)[0] ** 2, lambda ok, x: x * x + nan_with_nan_derivatives(ok, x)]
)
def test_invalid_points_are_nan_with_nan_derivatives(mark):
    for order in range(3):
        value = lambda x: mark(x < 2.0, x)  # noqa: E731
        for _ in range(order):
            value = jax.grad(value)
        assert np.isnan(value(3.0))
        assert np.isfinite(value(1.0))
    assert mark(np.True_, np.float64(1.0)) == 1.0
