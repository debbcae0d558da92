"""Sampled plants without damping: at B = 0 every pole is on the unit circle, which every function must report as
unstable.
"""

import numpy as np
import pytest
import scipy.signal

import zwidth
from zwidth.core.status import Status


def make_joints(rng, bodies, period):
    """Return undamped joints in series, discretized by semi-implicit Euler, with force and sensor at the first."""
    mass, springs = rng.uniform(0.02, 0.5, bodies), rng.uniform(1.0, 200.0, bodies - 1)
    stiffness = np.zeros((bodies, bodies))
    for k, spring in enumerate(springs):
        stiffness[k : k + 2, k : k + 2] += spring * np.array([[1.0, -1.0], [-1.0, 1.0]])
    rate, one = -period * stiffness / mass[:, None], np.eye(bodies)
    A = np.block([[one + period * rate, period * one], [rate, one]])
    B = np.zeros(2 * bodies)
    B[[0, bodies]] = period**2 / mass[0], period / mass[0]
    return A, B, np.eye(1, 2 * bodies)[0], mass[0]


def compute_radius(A, B, C, period, wall, pole):
    """Return the largest pole magnitude of a wall whose backward difference passes a low-pass filter with this pole."""
    size = len(A)
    gain = (1.0 - pole) / period
    velocity = np.concatenate([gain * C, [-gain, pole]])
    force = -wall[0] * np.concatenate([C, [0.0, 0.0]]) - wall[1] * velocity
    matrix = np.zeros((size + 2, size + 2))
    matrix[:size, :size] = A
    matrix[:size] += np.outer(B, force)
    matrix[size, :size], matrix[size + 1] = C, velocity
    return np.abs(np.linalg.eigvals(matrix)).max()


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("bodies", [1, 2, 3])
def test_lossless_plants_are_unstable_at_zero_damping_and_agree_with_eigenvalues(bodies, filtered):
    rng = np.random.default_rng(bodies)
    for period in rng.choice([5e-4, 1e-3, 2e-3, 5e-3], 5).tolist():
        A, B, C, mass = make_joints(rng, bodies, period)
        system = scipy.signal.StateSpace(A, B[:, None], C[None], [[0.0]], dt=period)
        velocity = zwidth.LowPass(cutoff=0.1 / period) if filtered else zwidth.BackwardDifference()
        scene = zwidth.Scene(zwidth.LinearDevice(system), zwidth.Timing(period), velocity=velocity)
        top = scene.max_stiffness()
        assert top.status == Status.OK
        assert top.virtual_damping == 0.0
        stiffness = np.linspace(0.02, 1.2, 60) * top.stiffness
        for method in ("auto", "companion", "crossover"):
            decision = scene.decide_stability(stiffness, 0.0, method=method)
            assert not decision.stable.any()
            assert np.all(decision.status == Status.OK)
        assert scene.stable_stiffness(0.0).size == 0
        low, high = scene.stable_damping(0.5 * top.stiffness)[0]
        assert low == 0.0 < high
        pole = np.exp(-0.2 * np.pi) if filtered else 0.0
        walls = np.stack([rng.uniform(0.01, 1.2, 60) * top.stiffness, rng.uniform(-0.1, 1.0, 60) * mass / period], -1)
        radii = np.array([compute_radius(A, B, C, period, wall, pole) for wall in walls])
        clear = np.abs(radii - 1.0) > 1e-9
        np.testing.assert_array_equal(scene.is_stable(*walls.T)[clear], radii[clear] < 1.0)
        recommendation = scene.recommend(stiffness_fraction=0.7)
        assert compute_radius(A, B, C, period, (recommendation.stiffness, recommendation.virtual_damping), pole) < 1.0


def test_semi_implicit_euler_plant_is_unstable_at_zero_damping():
    """Regression: for the plant z/(z - 1)^2, labels at ten stiffnesses were inconsistent although their status
    was OK.
    """
    system = scipy.signal.TransferFunction([1.0, 0.0], [1.0, -2.0, 1.0], dt=1.0)
    scene = zwidth.Scene(zwidth.LinearDevice(system), zwidth.Timing(1.0))
    stiffness = np.linspace(0.05, 0.95, 10) * 4
    assert not scene.decide_stability(stiffness, 0).stable.any()
    assert scene.max_stiffness().stiffness == pytest.approx(4.0, rel=1e-12)
    marginal = zwidth.assess(scene.replace(wall=zwidth.VirtualWall(2.0, 0.0)))
    assert (marginal.stable, marginal.marginal, marginal.spectral_radius) == (False, True, 1.0)
    unstable = zwidth.assess(scene.replace(wall=zwidth.VirtualWall(5.0, 0.0)))
    assert (unstable.stable, unstable.marginal) == (False, False)
    assert scene.is_stable(2.0, 0.1)


def test_implicit_damping_of_the_plant_allows_zero_virtual_damping():
    """With implicit damping kv = 2, K < 8.8 kN/m is stable at B = 0; at B = -2 N s/m the plant is lossless."""
    inertia, period, damping = 0.05, 5e-3, 2.0
    gain = 1.0 / (inertia + period * damping)
    A = np.array([[1.0, period * gain * inertia], [0.0, gain * inertia]])
    B = np.array([[period**2 * gain], [period * gain]])
    system = scipy.signal.StateSpace(A, B, [[1.0, 0.0]], [[0.0]], dt=period)
    scene = zwidth.Scene(zwidth.LinearDevice(system), zwidth.Timing(period))
    np.testing.assert_allclose(scene.stable_stiffness(0.0), [[0.0, 8800.0]], rtol=1e-12, atol=1e-6)
    top = scene.max_stiffness()
    assert (top.stiffness, top.virtual_damping) == pytest.approx((8800.0, 0.0))
    assert scene.max_stiffness(negative_damping=True).virtual_damping < 0
    assert scene.recommend(stiffness_fraction=0.7).virtual_damping >= 0
