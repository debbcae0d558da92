"""Test poles, spectral radius, state space and frequency response of random scenes.

Reference: state-space matrices from matrix exponentials.
"""

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


def draw_walls(kind, scenes, walls, seed):
    rng = np.random.default_rng(seed)
    for _ in range(scenes):
        scene = random_scene(kind, rng)
        stiffness, damping = random_walls(scene, rng, walls)
        damping[0] = 0.0
        yield scene, stiffness, damping


def compute_eigenvalue_conditions(matrix):
    """Return the eigenvalues and their condition numbers."""
    # Balance the matrix first, because its states (in m, m/s and N) differ by orders of magnitude.
    decomposition: Any = scipy.linalg.eig(scipy.linalg.matrix_balance(matrix)[0], left=True)
    values, left, right = decomposition
    with np.errstate(all="ignore"):
        return values, 1.0 / np.abs(np.sum(left.conj() * right, 0))


@pytest.mark.parametrize("kind", KINDS)
def test_poles_match_eigenvalues_of_state_space(kind):
    for scene, stiffness, damping in draw_walls(kind, 4, 4, 1):
        pole_batch = scene.poles(stiffness, damping)
        for k in range(4):
            values, condition = compute_eigenvalue_conditions(closed_loop_matrix(scene, stiffness[k], damping[k]))
            distance = np.abs(values[:, None] - pole_batch[k]).min(1)
            # Exclude poles near z = 0: there the matrix has more, and multiple, eigenvalues.
            good = (condition < 1e5) & (np.abs(values) > 0.05)
            assert good.any()
            assert distance[good].max() < 1e-9
            assert np.abs(pole_batch[k]).max() == pytest.approx(np.abs(values).max(), abs=1e-9)


def test_spectral_radius_agrees_with_verdict_near_boundary():
    end = FILTERED.stable_stiffness(5.0)[0, 1]
    stiffness = end * (1 + np.array([-1e-6, -1e-12, -1e-15, 1e-15, 1e-12, 1e-6]))
    radius = FILTERED.spectral_radius(stiffness, 5.0)
    np.testing.assert_array_equal(radius < 1, FILTERED.is_stable(stiffness, 5.0))
    assert np.abs(radius - 1).max() < 1e-5
    assert np.all(radius[[0, 1]] < 1)
    assert np.all(radius[[-2, -1]] > 1)


def test_spectral_radius_near_boundary_follows_the_label():
    """A radius within rounding error of 1 is moved to the side of the label; a contradicting radius becomes NaN."""
    edge = FILTERED.stable_stiffness(5.0)[0, 1] / FILTERED.units.stiffness
    beta, labels = np.full(2, 5.0 / FILTERED.units.virtual_damping), np.array([True, False])
    boundary, inside, outside = (
        spectral_radius(FILTERED.loop.roots, np.full(2, alpha), beta, labels)
        for alpha in (edge, 0.5 * edge, 2.0 * edge)
    )
    np.testing.assert_allclose(boundary, 1.0, rtol=1e-12)
    assert boundary[0] < 1 <= boundary[1]
    assert inside[0] < 0.999
    assert outside[1] > 1.001
    assert np.isnan([inside[1], outside[0]]).all()


def test_time_constant_of_very_soft_wall():
    """Compare with the series of the slowest root: b/K (1 - K (m/b^2 + (T/2 + t_d)/b)) at K = 1e-6 N/m."""
    slow = zwidth.assess(FILTERED.replace(wall=zwidth.VirtualWall(1e-6))).time_constant
    assert slow == pytest.approx(3.0 / 1e-6 * (1 - 1e-6 * (0.1 / 9.0 + 1.5e-3 / 3.0)), rel=1e-13)


def test_spectral_radius_at_long_delay_matches_poles():
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
def test_state_space_and_frequency_response_match_matrix_exponential(kind):
    rng = np.random.default_rng(3)
    for scene, stiffness, damping in draw_walls(kind, 3, 2, 4):
        for K, B in zip(stiffness, damping, strict=True):
            matrix = closed_loop_matrix(scene, K, B)
            a, b, sensor = continuous(scene)
            force_input, output = (np.zeros(len(matrix)) for _ in range(2))
            force_input[: len(b)], output[: len(b)] = flow(a, b, scene.timing.period)[1], sensor
            w = rng.uniform(0.05, 3.0)
            closed, loop = (evaluate_response(model, w) for model in (scene.state_space(K, B), scene.open_loop(K, B)))
            expected = output @ np.linalg.solve(np.exp(1j * w) * np.eye(len(matrix)) - matrix, force_input)
            assert abs(closed / expected - 1) < 1e-7
            frequency = w / (2 * np.pi * scene.timing.period)
            assert abs(scene.frequency_response(K, B, frequency) / loop - 1) < 1e-7


def evaluate_response(model, w):
    assert model.dt > 0
    inner = np.exp(1j * w) * np.eye(len(model.A)) - model.A
    return (model.C @ np.linalg.solve(inner, model.B) + model.D)[0, 0]


def test_state_space_is_open_loop_with_negative_feedback():
    loop, closed = FILTERED.open_loop(5e3, 5.0), FILTERED.state_space(5e3, 5.0)
    np.testing.assert_allclose(closed.A, loop.A - loop.B @ loop.C, atol=1e-9)


def test_shapes_broadcast_and_non_finite_walls_yield_nan():
    K, B = np.array([1e3, np.nan, 2e3]), np.array([[0.0], [3.0]])
    assert FILTERED.poles(K, B).shape[:2] == (2, 3)
    assert FILTERED.spectral_radius(K, B).shape == (2, 3)
    np.testing.assert_array_equal(np.isnan(FILTERED.spectral_radius(K, B)), [[False, True, False]] * 2)
    assert np.isnan(FILTERED.frequency_response(1e3, 0.0, [0.0, 501.0])).all()
    assert FILTERED.frequency_response(1e3, 0.0, 500.0).imag == pytest.approx(0.0, abs=1e-15)
    with pytest.raises(InputError, match="one wall of finite numbers"):
        FILTERED.state_space(K)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("method, used", [("auto", Method.CROSSOVER), ("companion", Method.COMPANION)])
def test_decision_reports_method_and_status(method, used):
    K = [1e3, 60e3, np.nan, np.inf, 1e70]
    decision = FILTERED.decide_stability(K, 4.0, method=method)
    np.testing.assert_array_equal(decision.stable, [True, False, False, False, False])
    np.testing.assert_array_equal(
        decision.status, [Status.OK, Status.OK, *[Status.INVALID_INPUT] * 2, Status.OUT_OF_RANGE]
    )
    np.testing.assert_array_equal(decision.method, [used] * 5)
    assert np.isnan(FILTERED.spectral_radius(K, 4.0)[2:]).all()


def test_to_control_keeps_poles_and_period():
    control = pytest.importorskip("control")
    model = zwidth.to_control(FILTERED, 5e3, 2.0)
    assert model.dt == 1e-3
    poles = FILTERED.poles(5e3, 2.0)
    assert np.abs(control.poles(model)).max() == pytest.approx(np.abs(poles).max(), abs=1e-12)


def test_spectral_radius_resolves_poles_close_to_one():
    """Compare with poles computed as z - 1, for soft walls on devices with almost no damping."""
    rng = np.random.default_rng(1)
    for _ in range(60):
        period, mass, damping = 10 ** rng.uniform(-4, -2), 10 ** rng.uniform(-2, 1), 10 ** rng.uniform(-12, -4)
        delta = damping * period / mass
        alpha = min(0.25 * delta**2 * 10 ** rng.uniform(-1, 6), 1e-3)
        scene = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(period, rng.integers(12) * period))
        stiffness = alpha * mass / period**2
        slowest = log_modulus(compute_poles_minus_one(scene.loop.roots, *scene.normalize_walls(stiffness, 0.0))).max()
        assert slowest == pytest.approx(np.log1p(scene.spectral_radius(stiffness) - 1), rel=1e-6, abs=3e-16)
