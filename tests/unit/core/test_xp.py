"""What NumPy and JAX spell differently: angles and their derivatives."""

import jax
import pytest

from zwidth.core.xp import invert_haversine


@pytest.mark.parametrize("x", [0.1, 0.5, 0.9])
def test_an_angle_has_its_derivative_where_sine_and_cosine_are_equal_too(x64, x):
    # dw/dx = 1/sqrt(x (1 - x)) of x = sin^2(w/2).
    slope = jax.grad(lambda x: invert_haversine(x, 1.0 - x, jax.numpy))(x)
    assert slope == pytest.approx((x * (1.0 - x)) ** -0.5, rel=1e-13)
