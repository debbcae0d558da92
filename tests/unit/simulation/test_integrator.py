"""Test the reference integrator of the simulation tests against matrix powers, closed forms and energy balances."""

from typing import Any

import any_loop
import numpy as np
import pytest
import scipy.signal
import tolerances as tol
from independent_scenes import KINDS, random_scene, random_walls
from integrator import integrate, velocity_program
from random_motions import condition, judge, largest_difference, nearest_decision, random_motion
from scipy.integrate import solve_ivp

import zwidth


def relative_error(actual, expected):
    """Return the largest error relative to the largest value."""
    return np.abs(np.asarray(actual) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("wall", [(0.108, 0.425, 0.0, 1.0), (0.656, 0.388, 1.0, 1.0), (0.05, 0.2, 0.1, 2.6)])
def test_step_response_of_rigid_device_matches_closed_form(wall):
    alpha, beta, delta, d = wall
    mass, period, force = 0.2, 5e-4, 3.0
    device = zwidth.Device(mass, delta * mass / period)
    scene = zwidth.Scene(device, zwidth.Timing(period, d * period))
    response = integrate(scene, alpha * mass / period**2, beta * mass / period, 99, external_force=force)
    expected = zwidth.step_response(*wall, substeps=1, force=force)
    assert relative_error(response.position[:, 0] * mass / period**2, expected.position) < tol.JUDGE.float64
    assert relative_error(response.velocity[:, 0] * mass / period, expected.velocity) < tol.JUDGE.float64


def steady_filter_state(numerator, denominator, position, step):
    """Return the state of the filter of `any_loop` after an infinite ramp, newest first: ``denominator w = x``."""
    order = denominator.size - 1
    denominator = denominator / denominator[0]
    growth = step / denominator.sum()
    now = (position + np.arange(denominator.size) @ denominator * growth) / denominator.sum()
    return now - growth * np.arange(1, order + 1)


@pytest.mark.parametrize("kind", KINDS)
def test_linear_loop_is_a_power_of_its_matrix(kind):
    rng = np.random.default_rng(sum(map(ord, kind)))
    for _ in range(3 if kind in ("filter", "all") else 1):
        scene = random_scene(kind, rng)
        walls = zip(*random_walls(scene, rng, 50), strict=True)
        K, B = next(wall for wall in walls if any_loop.spectral_radius(scene, *wall) < 1.02)
        matrix = any_loop.closed_loop_matrix(scene, K, B)
        n = integrate(scene, K, B, 1).position.shape[1]
        start, speed = 2e-3, 0.1
        state = np.zeros(len(matrix))
        state[:n], state[n : 2 * n] = start, speed
        numerator, denominator = any_loop.velocity_polynomials(scene)
        state[2 * n : 2 * n + denominator.size - 1] = steady_filter_state(
            numerator, denominator, start, speed * scene.timing.period
        )
        response = integrate(scene, K, B, 60, position=start, velocity=speed)
        expected = [state]
        for _ in range(60):
            expected.append(matrix @ expected[-1])
        expected = np.array(expected)
        assert relative_error(response.position, expected[:, :n]) < tol.JUDGE.float64
        assert relative_error(response.velocity, expected[:, n : 2 * n]) < tol.JUDGE.float64


ESTIMATES = (
    zwidth.BackwardDifference(coded_period=2e-3),
    zwidth.WindowedDifference(5),
    zwidth.LowPass(cutoff=30, coded_period=1.5e-3),
    zwidth.LowPass(time_constant=5e-3, order=2),
    zwidth.Butterworth(40, 3),
    zwidth.VelocityFilter([900, -800, -90], [1, -0.5, 0.2, 0.1]),
)


@pytest.mark.parametrize("velocity", ESTIMATES, ids=lambda velocity: type(velocity).__name__)
def test_velocity_estimates_continue_an_infinite_ramp(velocity):
    scene = zwidth.Scene(zwidth.Device(1.0), zwidth.Timing(1e-3), velocity=velocity)
    measured = 0.3 + np.random.default_rng(23).normal(0.0, 1e-3, 60)
    program = velocity_program(scene, 0.3, -0.2)
    past = 0.3 + 0.2 * 1e-3 * np.arange(3000, 0, -1)
    numerator, denominator = any_loop.velocity_polynomials(scene)
    expected = scipy.signal.lfilter(numerator, denominator, np.concatenate([past, measured]))[past.size :]
    assert relative_error([program(x) for x in measured], expected) < tol.JUDGE.float64


def build_rates(wall, slip, external_force, friction):
    """Return the rates of motor, tip and coupled operator, and the powers of losses and of the applied forces."""

    def rate(_, y):
        x1, x2, x3, v1, v2, v3 = y[:6]
        coupling_force, operator_force = 20e3 * (x2 - x1) + 0.5 * (v2 - v1), 800.0 * (x3 - x2) + 3.0 * (v3 - v2)
        friction_force = -friction * slip
        a1 = (wall + external_force + friction_force - 0.4 * v1 + coupling_force) / 0.1 if slip else 0.0
        a2, a3 = (operator_force - coupling_force) / 0.06, (-operator_force - 5.0 * v3 - 100.0 * x3) / 0.4
        power_lost = 0.4 * v1**2 + 0.5 * (v2 - v1) ** 2 + 3.0 * (v3 - v2) ** 2 + 5.0 * v3**2 - friction_force * v1
        return [v1, v2, v3, a1, a2, a3, power_lost, (wall + external_force) * v1]

    return rate


def compute_energy(y):
    x1, x2, x3, v1, v2, v3 = y
    double_kinetic = 0.1 * v1**2 + 0.06 * v2**2 + 0.4 * v3**2
    return 0.5 * (double_kinetic + 20e3 * (x2 - x1) ** 2 + 800.0 * (x3 - x2) ** 2 + 100.0 * x3**2)


def test_energy_balance_with_friction():
    coupling = zwidth.Coupling(mass=0.06, stiffness=20e3, damping=0.5, sensor="tip")
    hand = zwidth.Operator(0.4, 5.0, 100.0, coupling_stiffness=800.0, coupling_damping=3.0)
    scene = zwidth.Scene(zwidth.Device(0.1, 0.4, coupling), zwidth.Timing(1e-3, 1.6e-3), operator=hand)
    friction: Any = {"coulomb": 0.6, "static": 0.8}
    response = integrate(
        scene, 8e3, 5.0, 200, position=-1e-3, velocity=0.15, external_force=0.3, contact="unilateral", **friction
    )
    assert {kind for _, kind in response.events} == {"stick", "turn", "slip"}
    dissipated = worked = 0.0
    initial_energy = compute_energy(response.pieces[0].state)
    for piece, after in zip(response.pieces[:-1], response.pieces[1:], strict=True):
        assert piece.slip is not None
        rate = build_rates(piece.wall, piece.slip, 0.3, 0.6)
        start = [*piece.state, 0.0, 0.0]
        end = solve_ivp(rate, (0.0, piece.span), start, method="DOP853", rtol=1e-12, atol=1e-16).y[:, -1]
        assert np.abs(end[:6] - after.state).max() < tol.JUDGE.float64 * 0.15
        dissipated, worked = dissipated + end[6], worked + end[7]
        assert compute_energy(after.state) - initial_energy == pytest.approx(
            worked - dissipated, abs=tol.JUDGE.float64 * initial_energy
        )
    assert dissipated > 0.5 * initial_energy
    times = np.cumsum([piece.span for piece in response.pieces])
    assert times[-1] == pytest.approx(response.time[-1], rel=tol.JUDGE.float64)


def test_sliding_block_stops_and_sticks():
    scene = zwidth.Scene(zwidth.Device(mass=0.3), zwidth.Timing(1e-3))
    response = integrate(scene, 0.0, 0.0, 150, velocity=0.2, coulomb=0.7)
    distance, stop = 0.3 * 0.2**2 / (2 * 0.7), 0.3 * 0.2 / 0.7
    assert response.position[-1, 0] == pytest.approx(distance, rel=tol.JUDGE.float64)
    [(instant, kind)] = response.events
    assert (instant, kind) == (pytest.approx(stop, rel=tol.JUDGE.float64), "stick")
    assert response.velocity[response.time > stop].tolist() == [[0.0]] * int((response.time > stop).sum())


@pytest.mark.parametrize("external_force", [0.69, -0.71, 0.71])
def test_block_at_rest_slips_only_above_static_friction(external_force):
    scene = zwidth.Scene(zwidth.Device(mass=0.3), zwidth.Timing(1e-3))
    response = integrate(scene, 0.0, 0.0, 50, external_force=external_force, coulomb=0.5, static=0.7)
    stays_at_rest = abs(external_force) < 0.7
    distance = 0.0 if stays_at_rest else np.sign(external_force) * 0.5 * (abs(external_force) - 0.5) / 0.3 * 0.05**2
    assert response.position[-1, 0] == pytest.approx(distance, rel=tol.JUDGE.float64)
    assert response.events == ([] if stays_at_rest else [(0.0, "slip")])


@pytest.mark.parametrize("static", [1.3, 1.5])
def test_operator_drags_a_sticking_device(static):
    """The spring of the operator to ground stretches the coupling to the sticking device as ``1 - cos``."""
    hand = zwidth.Operator(0.5, 0.0, 400.0, coupling_stiffness=900.0)
    scene = zwidth.Scene(zwidth.Device(mass=0.3), zwidth.Timing(1e-3), operator=hand)
    response = integrate(scene, 0.0, 0.0, 100, position=-3e-3, coulomb=1.2, static=static)
    stretch, rate = 400.0 * 3e-3 / 1300.0, np.sqrt(1300.0 / 0.5)
    leaving = np.arccos(1.0 - static / (900.0 * stretch)) / rate
    assert response.events[0] == (pytest.approx(leaving, rel=tol.JUDGE.float64), "slip")
    is_sticking = response.time < leaving
    assert np.all(response.position[is_sticking, 0] == -3e-3)
    assert (
        relative_error(
            response.position[is_sticking, 1] + 3e-3, stretch * (1.0 - np.cos(rate * response.time[is_sticking]))
        )
        < tol.JUDGE.float64
    )
    k = int(is_sticking.sum())
    elapsed = response.time[k] - leaving
    # Its acceleration starts at (static - Coulomb)/m and increases with the stretch.
    jerk = 900.0 * stretch * rate * np.sin(rate * leaving) / 0.3
    expected = (static - 1.2) / 0.3 * elapsed + 0.5 * jerk * elapsed**2
    assert response.velocity[k, 0] == pytest.approx(expected, rel=2.0 * rate * elapsed)


def test_single_bodies_with_friction_match_closed_form():
    rng = np.random.default_rng(37)
    kinds, n_excluded = set(), 0
    for k in range(16):
        motion = random_motion(("rigid", "filter")[k % 2], rng)
        numeric, expected = judge(motion), judge(motion, closed_form=True)
        if not largest_difference(numeric, expected) < tol.JUDGE.float64:
            assert nearest_decision(numeric) < 1e-8 or condition(motion, expected, closed_form=True) > 1e4
            n_excluded += 1
            continue
        assert relative_error(numeric.command, expected.command) < tol.JUDGE.float64
        assert [kind for _, kind in numeric.events] == [kind for _, kind in expected.events]
        if numeric.events:
            instants, others = ([instant for instant, _ in motion.events] for motion in (numeric, expected))
            assert relative_error(instants, others) < tol.JUDGE.float64
        kinds |= {kind for _, kind in numeric.events}
    assert kinds == {"stick", "turn", "slip"}
    assert n_excluded <= 2


@pytest.mark.parametrize("kind", ["tip", "motor", "hand", "coupled hand", "all"])
def test_motion_does_not_depend_on_integration_steps(kind):
    rng = np.random.default_rng(21)
    n_excluded = 0
    for _ in range(2):
        motion = random_motion(kind, rng)
        coarse, fine = judge(motion), judge(motion, rtol=1e-13, step=0.1)
        if not largest_difference(coarse, fine) < tol.JUDGE.float64:
            assert nearest_decision(coarse) < 1e-8 or condition(motion, coarse) > 1e4
            n_excluded += 1
            continue
        assert [kind for _, kind in coarse.events] == [kind for _, kind in fine.events]
    assert n_excluded <= 1


def test_program_timing_quantization_and_limits():
    scene = zwidth.Scene(zwidth.Device(0.1, 0.1), zwidth.Timing(1e-3, 1.4e-3))
    lateness = 0.9 * np.random.default_rng(22).random(121)
    lateness[0] = 0.0
    limits: Any = {"resolution": 2e-5, "max_force": 0.5, "max_rate": 200.0, "jitter_samples": lateness}
    response = integrate(scene, 2e3, 2.0, 120, position=-1e-3, velocity=0.1, contact="push_only", **limits)
    assert np.allclose(response.time, (np.arange(121) + lateness) * 1e-3, rtol=1e-15)
    counts = response.measured / 2e-5
    assert np.abs(counts - np.rint(counts)).max() < 1e-9
    assert np.abs(response.measured - response.position[:, 0]).max() <= 1e-5
    assert response.contact.tolist() == (response.measured > 0).tolist()
    assert np.allclose(response.estimate[1:], np.diff(response.measured) / 1e-3, rtol=1e-12)
    assert response.estimate[0] == pytest.approx((response.measured[0] + 1e-3 + 1e-4) / 1e-3, rel=1e-9)
    target = np.where(response.contact, np.clip(-(2e3 * response.measured + 2.0 * response.estimate), -0.5, 0.0), 0.0)
    previous = np.append(0.0, response.command[:-1])
    assert np.allclose(response.command, np.clip(target, previous - 0.2, previous + 0.2), rtol=0, atol=1e-15)
    assert (response.command.min(), np.abs(np.diff(response.command)).max()) == (-0.5, pytest.approx(0.2))
    # Every command acts 1.4 periods after its sample.
    starts = np.cumsum([0.0] + [piece.span for piece in response.pieces[:-1]])
    acting = np.array([piece.wall for piece in response.pieces])
    newest = np.searchsorted(response.time + 1.4e-3, starts + 1e-12) - 1
    assert acting.tolist() == np.where(newest >= 0, response.command[newest], 0.0).tolist()
