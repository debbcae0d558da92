"""Poles, spectral radius, state space and frequency response of random scenes against other means."""

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from any_loop import closed_loop_matrix, continuous, flow
from independent_scenes import KINDS, random_scene, random_walls

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Method, Status
from zwidth.stability.linear.poles import compute_poles_minus_one, log_modulus, spectral_radius

FILTERED = zwidth.Scene(
    zwidth.Device(mass=0.1, damping=3.0), zwidth.Timing(period=1e-3, delay=1e-3), velocity=zwidth.LowPass(cutoff=100.0)
)


def draw(kind, scenes, walls, seed):
    rng = np.random.default_rng(seed)
    for _ in range(scenes):
        scene = random_scene(kind, rng)
        stiffness, damping = random_walls(scene, rng, walls)
        damping[0] = 0.0
        yield scene, stiffness, damping


def conditions(matrix):
    """Eigenvalues and how much an error of the matrix moves each."""
    # In balanced units: states in m, m/s and N differ by orders of magnitude.
    found: Any = scipy.linalg.eig(scipy.linalg.matrix_balance(matrix)[0], left=True)
    values, left, right = found
    with np.errstate(all="ignore"):
        return values, 1.0 / np.abs(np.sum(left.conj() * right, 0))


@pytest.mark.parametrize("kind", KINDS)
def test_poles_are_those_of_a_state_space_by_other_means(kind):
    for scene, stiffness, damping in draw(kind, 4, 4, 1):
        found = scene.poles(stiffness, damping)
        for k in range(4):
            values, condition = conditions(closed_loop_matrix(scene, stiffness[k], damping[k]))
            apart = np.abs(values[:, None] - found[k]).min(1)
            # Poles at z = 0, of which the matrix has more, are multiple.
            good = (condition < 1e5) & (np.abs(values) > 0.05)
            assert good.any()
            assert apart[good].max() < 1e-9
            assert np.abs(found[k]).max() == pytest.approx(np.abs(values).max(), abs=1e-9)


def test_on_both_sides_of_the_boundary_radius_and_verdict_agree():
    end = FILTERED.stable_stiffness(5.0)[0, 1]
    stiffness = end * (1 + np.array([-1e-6, -1e-12, -1e-15, 1e-15, 1e-12, 1e-6]))
    radius = FILTERED.spectral_radius(stiffness, 5.0)
    np.testing.assert_array_equal(radius < 1, FILTERED.is_stable(stiffness, 5.0))
    assert np.abs(radius - 1).max() < 1e-5
    assert np.all(radius[[0, 1]] < 1)
    assert np.all(radius[[-2, -1]] > 1)


def test_a_radius_within_rounding_takes_the_side_of_the_label_and_one_that_contradicts_it_is_not_given():
    edge = FILTERED.stable_stiffness(5.0)[0, 1] / FILTERED.units.stiffness
    beta, labels = np.full(2, 5.0 / FILTERED.units.virtual_damping), np.array([True, False])
    on, inside, outside = (
        spectral_radius(FILTERED.loop.roots, np.full(2, alpha), beta, labels)
        for alpha in (edge, 0.5 * edge, 2.0 * edge)
    )
    np.testing.assert_allclose(on, 1.0, rtol=1e-12)
    assert on[0] < 1 <= on[1]
    assert inside[0] < 0.999
    assert outside[1] > 1.001
    assert np.isnan([inside[1], outside[0]]).all()


def test_slow_poles_keep_their_digits():
    """By the series of the slowest root: b/K (1 - K (m/b^2 + (T/2 + t_d)/b)), here with K = 1e-6 N/m."""
    slow = zwidth.assess(FILTERED.replace(wall=zwidth.VirtualWall(1e-6))).time_constant
    assert slow == pytest.approx(3.0 / 1e-6 * (1 - 1e-6 * (0.1 / 9.0 + 1.5e-3 / 3.0)), rel=1e-13)


def test_long_delays_by_counting():
    scene = zwidth.Scene(
        zwidth.Device(mass=0.1, damping=3.0),
        zwidth.Timing(period=1e-3, delay=0.1604),
        velocity=zwidth.LowPass(cutoff=100.0),
        operator=zwidth.Operator(0.3, 4.0, 100.0, coupling_stiffness=800.0, coupling_damping=2.0),
    )
    stiffness, damping = np.array([1.0, 20.0, 90.0]), np.array([0.0, -0.5, 0.8])
    reference = np.abs(scene.poles(stiffness, damping)).max(-1)
    np.testing.assert_allclose(scene.spectral_radius(stiffness, damping), reference, rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_state_space_and_frequency_response(kind):
    rng = np.random.default_rng(3)
    for scene, stiffness, damping in draw(kind, 3, 2, 4):
        for K, B in zip(stiffness, damping, strict=True):
            matrix = closed_loop_matrix(scene, K, B)
            a, b, sensor = continuous(scene)
            push, row = (np.zeros(len(matrix)) for _ in range(2))
            push[: len(b)], row[: len(b)] = flow(a, b, scene.timing.period)[1], sensor
            w = rng.uniform(0.05, 3.0)
            closed, loop = (response(model, w) for model in (scene.state_space(K, B), scene.open_loop(K, B)))
            expected = row @ np.linalg.solve(np.exp(1j * w) * np.eye(len(matrix)) - matrix, push)
            assert abs(closed / expected - 1) < 1e-7
            frequency = w / (2 * np.pi * scene.timing.period)
            assert abs(scene.frequency_response(K, B, frequency) / loop - 1) < 1e-7


def response(model, w):
    assert model.dt > 0
    inner = np.exp(1j * w) * np.eye(len(model.A)) - model.A
    return (model.C @ np.linalg.solve(inner, model.B) + model.D)[0, 0]


def test_negative_feedback_around_the_open_loop_has_the_closed_poles():
    loop, closed = FILTERED.open_loop(5e3, 5.0), FILTERED.state_space(5e3, 5.0)
    np.testing.assert_allclose(closed.A, loop.A - loop.B @ loop.C, atol=1e-9)


def test_shapes_and_what_is_not_finite():
    K, B = np.array([1e3, np.nan, 2e3]), np.array([[0.0], [3.0]])
    assert FILTERED.poles(K, B).shape[:2] == (2, 3)
    assert FILTERED.spectral_radius(K, B).shape == (2, 3)
    np.testing.assert_array_equal(np.isnan(FILTERED.spectral_radius(K, B)), [[False, True, False]] * 2)
    assert np.isnan(FILTERED.frequency_response(1e3, 0.0, [0.0, 501.0])).all()
    assert FILTERED.frequency_response(1e3, 0.0, 500.0).imag == pytest.approx(0.0, abs=1e-15)
    with pytest.raises(InputError, match="one wall of finite numbers"):
        FILTERED.state_space(K)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("method, used", [("auto", Method.CROSSOVER), ("companion", Method.COMPANION)])
def test_a_decision_says_what_decided_and_where_it_could_not(method, used):
    K = [1e3, 60e3, np.nan, np.inf, 1e70]
    found = FILTERED.decide_stability(K, 4.0, method=method)
    np.testing.assert_array_equal(found.stable, [True, False, False, False, False])
    np.testing.assert_array_equal(
        found.status, [Status.OK, Status.OK, *[Status.INVALID_INPUT] * 2, Status.OUT_OF_RANGE]
    )
    np.testing.assert_array_equal(found.method, [used] * 5)
    assert np.isnan(FILTERED.spectral_radius(K, 4.0)[2:]).all()


def test_to_control():
    control = pytest.importorskip("control")
    model = zwidth.to_control(FILTERED, 5e3, 2.0)
    assert model.dt == 1e-3
    poles = FILTERED.poles(5e3, 2.0)
    assert np.abs(control.poles(model)).max() == pytest.approx(np.abs(poles).max(), abs=1e-12)


def test_poles_that_are_almost_one_are_told_apart():
    """A soft wall on a device with hardly any damping: alpha = q^2/4 + w^2, z = 1 - q/2 +- j w, or two real poles."""
    rng = np.random.default_rng(1)
    for _ in range(60):
        period, mass, damping = 10 ** rng.uniform(-4, -2), 10 ** rng.uniform(-2, 1), 10 ** rng.uniform(-12, -4)
        delta = damping * period / mass
        alpha = min(0.25 * delta**2 * 10 ** rng.uniform(-1, 6), 1e-3)
        scene = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(period, rng.integers(12) * period))
        stiffness = alpha * mass / period**2
        slowest = log_modulus(compute_poles_minus_one(scene.loop.roots, *scene.normalize_walls(stiffness, 0.0))).max()
        assert slowest == pytest.approx(np.log1p(scene.spectral_radius(stiffness) - 1), rel=1e-6, abs=3e-16)
