"""Test the sampled plant in its three forms against each other, with NumPy and JAX arrays.

The forms are partial fractions (`SampledPlant`), state space (`SampledStates`), and zeros and poles (`FactoredPlant`).
"""

import any_loop
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth.identification.device_estimate import DimensionlessDevice
from zwidth.model.circle_functions import circle_points
from zwidth.model.estimate import Estimate
from zwidth.model.mechanism import Body, Chain, Resonance
from zwidth.plant.factored_plant import factor_chain
from zwidth.plant.sampled_plant import integrate_pole, sample_parts
from zwidth.plant.sampled_states import SampledStates, sample_chain, sample_states

PERIOD = 1e-3
POINTS = circle_points(np.array([1e-3, 0.05, 0.3, 0.72, 1.9, 3.0, np.pi]))
MODES = [(0.7, 0.03, 0.4), (1.7, 1.2, -0.2)]
KINDS = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 2)]


def describe_parts(lag, modes, d=1.3):
    """Return delta, d, an actuator lag of some order and some modes, in units of the mass and the period."""
    return 0.03, d, [0.8, 0.6][:lag], MODES[:modes]


@pytest.mark.parametrize("d", [0, 2, 1.3, 0.999999999])
@pytest.mark.parametrize("lag, modes", KINDS)
def test_three_forms_of_a_device_agree(lag, modes, d):
    device = DimensionlessDevice(0.1, *describe_parts(lag, modes, d))
    chain = device.to_scene(PERIOD, zwidth.BackwardDifference()).loop.chain
    plant, states, factored = sample_parts(*device[1:]), sample_states(chain), factor_chain(chain)
    expected = states.controller(POINTS)
    np.testing.assert_allclose(plant.controller(POINTS), expected, rtol=1e-11)
    np.testing.assert_allclose(plant.response(POINTS) * expected, -1.0, rtol=1e-11)
    np.testing.assert_allclose(states.response(POINTS) * expected, -1.0, rtol=1e-14)
    np.testing.assert_allclose(factored.evaluate_controller(POINTS).value, expected, rtol=1e-11)
    np.testing.assert_allclose(factored.evaluate_response(POINTS).value * expected, -1.0, rtol=1e-11)
    np.testing.assert_allclose(sample_chain(chain).controller(POINTS), expected, rtol=1e-11)
    if not lag + modes:
        slope = plant.rigid_controller(POINTS).slope
        np.testing.assert_allclose(slope, factored.evaluate_controller(POINTS).slope, rtol=1e-11)


@pytest.mark.parametrize("kind", any_loop.KINDS)
def test_state_space_model_has_the_response_of_the_plant(kind):
    generator = np.random.default_rng(7)
    for _ in range(4):
        states = sample_states(any_loop.random_scene(kind, generator).loop.chain)
        A, B, C, _, _ = states.realize()
        resolvent = np.linalg.solve(POINTS.z[:, None, None] * np.eye(len(A)) - A, B + 0j)
        np.testing.assert_allclose((C @ resolvent)[:, 0, 0], states.response(POINTS), rtol=1e-9)


@pytest.mark.parametrize("lag, modes", KINDS)
def test_many_plants_on_shared_points_equal_single_plants(lag, modes):
    delta, d = np.array([[1e-9], [0.1], [2.0]]), np.array([[0.0], [1.5], [7.25]])
    parts = describe_parts(lag, modes)[2:]
    batch = sample_parts(delta, d, *parts)
    for function in ("controller", "response"):
        single = [
            getattr(sample_parts(*one, *parts), function)(POINTS) for one in zip(delta[:, 0], d[:, 0], strict=True)
        ]
        np.testing.assert_allclose(getattr(batch, function)(POINTS), single, rtol=1e-14)


def test_plants_compute_with_jax_arrays(x64):
    delta, d, lag, modes = describe_parts(2, 1)
    points = circle_points(jnp.asarray(POINTS.w))

    def evaluate(delta, d):
        plant = sample_parts(delta, d, lag, modes)
        return jnp.stack([plant.controller(points), plant.response(points)])

    expected = np.stack([(plant := sample_parts(delta, d, lag, modes)).controller(POINTS), plant.response(POINTS)])
    step = 1e-5
    values, many = jax.jit(evaluate), jax.jit(jax.vmap(evaluate))
    np.testing.assert_allclose(values(delta, d), expected, rtol=1e-12)
    near = many(delta + step * np.array([1, -1, 0, 0]), d + step * np.array([0, 0, 1, -1]))
    by_delta, by_d = jax.jit(jax.jacfwd(evaluate, (0, 1)))(delta, d)
    # Central differences with a step of 1e-5 have errors of about 1e-10.
    np.testing.assert_allclose(by_delta, (near[0] - near[1]) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(by_d, (near[2] - near[3]) / (2 * step), rtol=1e-6)


def test_states_of_many_chains_equal_those_of_each_chain(x64):
    delta, rate, d = np.array([0.0, 0.1, 0.5]), np.array([0.2, 0.7, 2.0]), np.array([1.0, 1.3, 1.9])

    def build_chain(delta, rate, d):
        mode = Resonance(rate, 0.1, 3.0)
        return Chain((Body(1.0, delta, 0.0),), (), (mode,), 0.8, 0, d, 1, Estimate())

    many = sample_states(build_chain(delta, rate, d))
    realized = many.realize()
    for k in range(delta.size):
        states = sample_states(build_chain(delta[k], rate[k], d[k]))
        single = SampledStates(many.psi[k], many.full[k], many.late[k], 1)
        np.testing.assert_allclose(single.controller(POINTS), states.controller(POINTS), rtol=1e-12)
        np.testing.assert_allclose(single.realize().A, realized.A[k], rtol=0)
    # The leading axes of the matrices broadcast with the points, also for JAX arrays of equal rank.
    columns = SampledStates(many.psi[:, None], many.full[:, None], many.late[:, None], 1)
    on_device, points = jax.tree.map(jnp.asarray, columns), circle_points(jnp.asarray(POINTS.w)[None])
    np.testing.assert_allclose(jax.jit(on_device.controller)(points), columns.controller(POINTS), rtol=1e-12)


@pytest.mark.parametrize("pole", [0, 0.0, -2, -1e-20, 0.3 + 4j])
def test_pole_integrates_a_held_force(pole):
    assert integrate_pole(pole, 0.5) == pytest.approx(
        0.5 if abs(pole) < 1e-9 else (np.exp(pole / 2) - 1) / pole, rel=1e-15
    )
