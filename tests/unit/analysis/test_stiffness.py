"""K_max in SI units and its sensitivities, against differences of the forward model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth import max_stiffness, sensitivities

NAMES = ("mass", "damping", "period", "delay")
# Device by device: light, damped, slow; whole, fractional and no delay; the last two corners.
DEVICES = np.array(
    [
        [0.1, 10.0, 1e-3, 1e-3],
        [0.02, 3.0, 5e-4, 1.2e-4],
        [2.0, 0.5, 1e-2, 3.7e-2],
        [0.1, 400.0, 1e-3, 0.0],
        [0.1, 500.0, 1e-3, 1e-5],
    ]
).T


def device(columns=DEVICES):
    return dict(zip(NAMES, columns, strict=True))


def test_the_wall_is_stable_below_k_max_and_not_above():
    wall = zwidth.normalize(**device(), stiffness=max_stiffness(**device()))
    beta = zwidth.alpha_max(wall.delta, wall.d).beta
    below, above = (
        zwidth.is_stable(wall.alpha * factor, beta, wall.delta, wall.d, method="certified")
        for factor in (1 - 1e-6, 1 + 1e-6)
    )
    assert np.all(below)
    assert not np.any(above)


def test_sensitivities_are_the_slopes_of_k_max():
    gain = sensitivities(**device())
    np.testing.assert_allclose(gain.stiffness_max, max_stiffness(**device()), rtol=1e-14)
    for index, slope in enumerate(gain[1:5]):
        # Where a quantity is 0 a step from the right, else a central one.
        step = np.where(DEVICES[index] > 0, 1e-5 * DEVICES[index], 1e-10)
        up, down = DEVICES.copy(), DEVICES.copy()
        up[index] += step
        down[index] -= np.where(DEVICES[index] > 0, step, 0.0)
        expected = (max_stiffness(**device(up)) - max_stiffness(**device(down))) / (up[index] - down[index])
        np.testing.assert_allclose(slope, expected, rtol=2e-5)


def test_both_sides_of_a_whole_delay_have_one_slope():
    whole = np.array([1.0, 2.0, 5.0])
    slopes = [
        sensitivities(mass=0.1, damping=20.0, period=1e-3, delay=1e-3 * d).per_delay
        for d in (whole, whole * (1 - 1e-9))
    ]
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-7)


def test_gradients_pass_through_a_jitted_device(x64):
    gain = sensitivities(mass=0.1, damping=10.0, period=1e-3, delay=1e-3)
    slope = jax.jit(jax.grad(lambda b: max_stiffness(mass=0.1, damping=b, period=1e-3, delay=1e-3)))(jnp.asarray(10.0))
    assert float(slope) == pytest.approx(float(gain.per_damping), rel=1e-13)


def test_gradients_at_concrete_devices_are_those_that_are_compiled(x64):
    def stiffness(mass, damping, period, delay):
        return zwidth.max_stiffness(mass=mass, damping=damping, period=period, delay=delay)

    every = jax.value_and_grad(stiffness, argnums=(0, 1, 2, 3))
    at = (0.1, 3.0, 1e-3, 1.25e-3)
    np.testing.assert_allclose(np.hstack(every(*at)), np.hstack(jax.jit(every)(*at)), rtol=1e-12)
