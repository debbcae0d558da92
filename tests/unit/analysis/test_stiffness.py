"""Test `max_stiffness` in SI units against certified verdicts, and its sensitivities against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth import max_stiffness, sensitivities

NAMES = ("mass", "damping", "period", "delay")
# Columns: light, damped and slow devices with integer, fractional and zero delay; the last two maxima are corners.
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


def test_wall_is_stable_just_below_max_stiffness_and_unstable_above():
    wall = zwidth.normalize(**device(), stiffness=max_stiffness(**device()))
    beta = zwidth.alpha_max(wall.delta, wall.d).beta
    below, above = (
        zwidth.is_stable(wall.alpha * factor, beta, wall.delta, wall.d, method="certified")
        for factor in (1 - 1e-6, 1 + 1e-6)
    )
    assert np.all(below)
    assert not np.any(above)


def test_sensitivities_match_finite_differences():
    gain = sensitivities(**device())
    np.testing.assert_allclose(gain.stiffness_max, max_stiffness(**device()), rtol=1e-14)
    for index, slope in enumerate(gain[1:5]):
        # A one-sided difference for parameters that are 0, otherwise a central one.
        step = np.where(DEVICES[index] > 0, 1e-5 * DEVICES[index], 1e-10)
        up, down = DEVICES.copy(), DEVICES.copy()
        up[index] += step
        down[index] -= np.where(DEVICES[index] > 0, step, 0.0)
        expected = (max_stiffness(**device(up)) - max_stiffness(**device(down))) / (up[index] - down[index])
        np.testing.assert_allclose(slope, expected, rtol=2e-5)


def test_sensitivity_to_delay_is_continuous_at_integer_delays():
    integers = np.array([1.0, 2.0, 5.0])
    slopes = [
        sensitivities(mass=0.1, damping=20.0, period=1e-3, delay=1e-3 * d).per_delay
        for d in (integers, integers * (1 - 1e-9))
    ]
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-7)


def test_jitted_gradient_equals_sensitivities(x64):
    gain = sensitivities(mass=0.1, damping=10.0, period=1e-3, delay=1e-3)
    slope = jax.jit(jax.grad(lambda b: max_stiffness(mass=0.1, damping=b, period=1e-3, delay=1e-3)))(jnp.asarray(10.0))
    assert float(slope) == pytest.approx(float(gain.per_damping), rel=1e-13)


def test_eager_gradients_equal_jitted_gradients(x64):
    def stiffness(mass, damping, period, delay):
        return zwidth.max_stiffness(mass=mass, damping=damping, period=period, delay=delay)

    evaluate = jax.value_and_grad(stiffness, argnums=(0, 1, 2, 3))
    point = (0.1, 3.0, 1e-3, 1.25e-3)
    np.testing.assert_allclose(np.hstack(evaluate(*point)), np.hstack(jax.jit(evaluate)(*point)), rtol=1e-12)
