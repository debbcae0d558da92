"""Admittance displays inside JAX transformations: values, gradients against central differences, and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth


def make_display(M, D=60.0, tau=0.02, T=2e-3, delay=7.3e-3, program=("velocity", "trapezoidal"), order=1):
    robot = zwidth.Actuator(time_constant=tau, order=order)
    return zwidth.AdmittanceDisplay(M, D, robot, zwidth.Timing(T, delay), *program)


def find_stiffness(*numbers, **choices):
    return make_display(*numbers, **choices).max_environment_stiffness().stiffness


def test_jit_of_the_virtual_mass():
    expected = find_stiffness(20)
    assert jax.jit(lambda M: find_stiffness(M))(20.0) == pytest.approx(expected, rel=1e-6)
    with jax.enable_x64(True):
        assert jax.jit(lambda M: find_stiffness(M))(20) == pytest.approx(expected, rel=1e-12)


def test_vmap_over_masses_and_dampings():
    masses, dampings = np.array([5.0, 20.0, -1.0, np.nan]), np.array([30.0, 60.0])
    with jax.enable_x64(True):
        limits = jax.vmap(jax.vmap(find_stiffness, (None, 0)), (0, None))(masses, dampings)
        status = jax.vmap(lambda M: make_display(M).max_environment_stiffness().status)(masses)
    expected = make_display(1).max_environment_stiffness(virtual_mass=masses[:2, None], virtual_damping=dampings)
    np.testing.assert_allclose(limits[:2], expected.stiffness, rtol=1e-12)
    assert np.all(np.isnan(limits[2:]))
    np.testing.assert_array_equal(status, [0, 0, zwidth.Status.INVALID_INPUT, zwidth.Status.INVALID_INPUT])


def test_traced_arguments_of_a_plain_display():
    display = make_display(20)
    with jax.enable_x64(True):
        limits = jax.jit(lambda M, B: display.max_environment_stiffness(B, virtual_mass=M))(
            jnp.array([[5.0], [20.0]]), jnp.array([0.0, 50.0, 100.0])
        )
    expected = display.max_environment_stiffness([0, 50, 100], virtual_mass=[[5], [20]])
    np.testing.assert_allclose(limits.stiffness, expected.stiffness, rtol=1e-12)
    np.testing.assert_allclose(limits.frequency, expected.frequency, rtol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("integrator", ["semi-implicit", "trapezoidal"])
@pytest.mark.parametrize("command", ["position", "velocity"])
def test_gradients_equal_central_differences(command, integrator, order):
    numbers = 20.0, 60.0, 0.02, 2e-3, 7.3e-3, 35.0

    def limit(M, D, tau, T, delay, B):
        return make_display(M, D, tau, T, delay, (command, integrator), order).max_environment_stiffness(B)

    with jax.enable_x64(True):
        slopes = jax.jacobian(lambda *numbers: limit(*numbers)[:2], argnums=tuple(range(6)))(*numbers)
    for k, number in enumerate(numbers):
        step = 1e-4 * number
        moved = [limit(*(*numbers[:k], number + offset * step, *numbers[k + 1 :])) for offset in (-2, -1, 1, 2)]
        for result, name in enumerate(("stiffness", "frequency")):
            far_low, low, high, far_high = (getattr(each, name) for each in moved)
            expected = (8 * (high - low) - (far_high - far_low)) / (12 * step)
            scale = abs(getattr(limit(*numbers), name)) / number
            assert slopes[result][k] == pytest.approx(expected, rel=1e-7, abs=1e-9 * scale)


def test_gradient_in_the_display_as_a_pytree():
    robot = zwidth.LinearDevice("400 / 1 28 400")
    display = zwidth.AdmittanceDisplay(20, 60, robot, zwidth.Timing("2 ms", "4 periods"))
    with jax.enable_x64(True):
        slopes = jax.grad(lambda display: display.max_environment_stiffness().stiffness)(display)

    def limit(M=20.0, T=2e-3, delay=4.0):
        timing = zwidth.Timing(T, f"{delay} periods")
        return zwidth.AdmittanceDisplay(M, 60, robot, timing).max_environment_stiffness().stiffness

    assert slopes.virtual_mass == pytest.approx((limit(20.01) - limit(19.99)) / 0.02, rel=1e-5)
    assert slopes.timing.period == pytest.approx((limit(T=2.001e-3) - limit(T=1.999e-3)) / 2e-6, rel=1e-5)
    assert slopes.timing._periods == pytest.approx((limit(delay=4.001) - limit(delay=3.999)) / 2e-3, rel=1e-5)


def test_second_derivative_in_the_virtual_mass():
    with jax.enable_x64(True):
        curvature = jax.hessian(find_stiffness)(20.0)
    moved = [find_stiffness(20 + step) for step in (-0.05, 0, 0.05)]
    assert curvature == pytest.approx((moved[0] - 2 * moved[1] + moved[2]) / 0.05**2, rel=1e-3)


def test_gradient_is_nan_without_a_limit():
    with jax.enable_x64(True):
        assert np.isnan(jax.grad(lambda M: find_stiffness(M, 0.0))(20.0))


def test_other_methods_refuse_traced_numbers():
    with pytest.raises(zwidth.InputError, match="display: got a value that JAX traces"):
        jax.jit(lambda M: make_display(M).scene(100.0).wall.stiffness)(20.0)
    with pytest.raises(zwidth.InputError, match="display: got a value that JAX traces"):
        jax.jit(lambda M: make_display(M).min_virtual_mass(100.0).virtual_mass)(20.0)
