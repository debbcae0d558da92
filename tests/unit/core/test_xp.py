"""Test functions that NumPy and JAX implement differently: angles and their derivatives."""

import jax
import pytest

from zwidth.core.xp import invert_haversine


@pytest.mark.parametrize("x", [0.1, 0.5, 0.9])
def test_derivative_of_angle_from_its_haversine(x64, x):
    # Exactly dw/dx = 1/sqrt(x (1 - x)) for x = sin^2(w/2); at x = 0.5, sine and cosine of w/2 are equal.
    slope = jax.grad(lambda x: invert_haversine(x, 1.0 - x, jax.numpy))(x)
    assert slope == pytest.approx((x * (1.0 - x)) ** -0.5, rel=1e-13)
