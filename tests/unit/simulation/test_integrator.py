"""The judge of simulations is itself judged: by matrices, by closed forms, by energy."""

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


def worst(got, expected):
    """The largest error in units of the largest value."""
    return np.abs(np.asarray(got) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("wall", [(0.108, 0.425, 0.0, 1.0), (0.656, 0.388, 1.0, 1.0), (0.05, 0.2, 0.1, 2.6)])
def test_rigid_device_answers_a_step_as_the_closed_form_says(wall):
    alpha, beta, delta, d = wall
    mass, period, force = 0.2, 5e-4, 3.0
    device = zwidth.Device(mass, delta * mass / period)
    scene = zwidth.Scene(device, zwidth.Timing(period, d * period))
    got = integrate(scene, alpha * mass / period**2, beta * mass / period, 99, external_force=force)
    expected = zwidth.step_response(*wall, substeps=1, force=force)
    assert worst(got.position[:, 0] * mass / period**2, expected.position) < tol.JUDGE.float64
    assert worst(got.velocity[:, 0] * mass / period, expected.velocity) < tol.JUDGE.float64


def settled_memory(top, bottom, position, step):
    """The filter's state of `any_loop`, fed a ramp for ever, newest first: ``bottom w = x``."""
    order = bottom.size - 1
    bottom = bottom / bottom[0]
    growth = step / bottom.sum()
    now = (position + np.arange(bottom.size) @ bottom * growth) / bottom.sum()
    return now - growth * np.arange(1, order + 1)


@pytest.mark.parametrize("kind", KINDS)
def test_linear_loop_is_the_power_of_its_matrix(kind):
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
        top, bottom = any_loop.velocity_polynomials(scene)
        state[2 * n : 2 * n + bottom.size - 1] = settled_memory(top, bottom, start, speed * scene.timing.period)
        got = integrate(scene, K, B, 60, position=start, velocity=speed)
        expected = [state]
        for _ in range(60):
            expected.append(matrix @ expected[-1])
        expected = np.array(expected)
        assert worst(got.position, expected[:, :n]) < tol.JUDGE.float64
        assert worst(got.velocity, expected[:, n : 2 * n]) < tol.JUDGE.float64


ESTIMATES = (
    zwidth.BackwardDifference(coded_period=2e-3),
    zwidth.WindowedDifference(5),
    zwidth.LowPass(cutoff=30, coded_period=1.5e-3),
    zwidth.LowPass(time_constant=5e-3, order=2),
    zwidth.Butterworth(40, 3),
    zwidth.VelocityFilter([900, -800, -90], [1, -0.5, 0.2, 0.1]),
)


@pytest.mark.parametrize("velocity", ESTIMATES, ids=lambda velocity: type(velocity).__name__)
def test_estimates_continue_a_long_ramp(velocity):
    scene = zwidth.Scene(zwidth.Device(1.0), zwidth.Timing(1e-3), velocity=velocity)
    measured = 0.3 + np.random.default_rng(23).normal(0.0, 1e-3, 60)
    program = velocity_program(scene, 0.3, -0.2)
    past = 0.3 + 0.2 * 1e-3 * np.arange(3000, 0, -1)
    top, bottom = any_loop.velocity_polynomials(scene)
    expected = scipy.signal.lfilter(top, bottom, np.concatenate([past, measured]))[past.size :]
    assert worst([program(x) for x in measured], expected) < tol.JUDGE.float64


def newton(wall, slip, external_force, friction):
    """Rates of motor, tip and soft hand, and of everything their energy goes into or comes from."""

    def rate(_, y):
        x1, x2, x3, v1, v2, v3 = y[:6]
        tie, grip = 20e3 * (x2 - x1) + 0.5 * (v2 - v1), 800.0 * (x3 - x2) + 3.0 * (v3 - v2)
        dry = -friction * slip
        a1 = (wall + external_force + dry - 0.4 * v1 + tie) / 0.1 if slip else 0.0
        a2, a3 = (grip - tie) / 0.06, (-grip - 5.0 * v3 - 100.0 * x3) / 0.4
        lost = 0.4 * v1**2 + 0.5 * (v2 - v1) ** 2 + 3.0 * (v3 - v2) ** 2 + 5.0 * v3**2 - dry * v1
        return [v1, v2, v3, a1, a2, a3, lost, (wall + external_force) * v1]

    return rate


def energy(y):
    x1, x2, x3, v1, v2, v3 = y
    moving = 0.1 * v1**2 + 0.06 * v2**2 + 0.4 * v3**2
    return 0.5 * (moving + 20e3 * (x2 - x1) ** 2 + 800.0 * (x3 - x2) ** 2 + 100.0 * x3**2)


def test_energy_balances_on_friction():
    coupling = zwidth.Coupling(mass=0.06, stiffness=20e3, damping=0.5, sensor="tip")
    hand = zwidth.Operator(0.4, 5.0, 100.0, coupling_stiffness=800.0, coupling_damping=3.0)
    scene = zwidth.Scene(zwidth.Device(0.1, 0.4, coupling), zwidth.Timing(1e-3, 1.6e-3), operator=hand)
    friction: Any = {"coulomb": 0.6, "static": 0.8}
    got = integrate(
        scene, 8e3, 5.0, 200, position=-1e-3, velocity=0.15, external_force=0.3, contact="unilateral", **friction
    )
    assert {kind for _, kind in got.events} == {"stick", "turn", "slip"}
    lost = worked = 0.0
    before = energy(got.pieces[0].state)
    for piece, after in zip(got.pieces[:-1], got.pieces[1:], strict=True):
        assert piece.slip is not None
        rate = newton(piece.wall, piece.slip, 0.3, 0.6)
        start = [*piece.state, 0.0, 0.0]
        end = solve_ivp(rate, (0.0, piece.span), start, method="DOP853", rtol=1e-12, atol=1e-16).y[:, -1]
        assert np.abs(end[:6] - after.state).max() < tol.JUDGE.float64 * 0.15
        lost, worked = lost + end[6], worked + end[7]
        assert energy(after.state) - before == pytest.approx(worked - lost, abs=tol.JUDGE.float64 * before)
    assert lost > 0.5 * before
    times = np.cumsum([piece.span for piece in got.pieces])
    assert times[-1] == pytest.approx(got.time[-1], rel=tol.JUDGE.float64)


def test_block_on_friction_stops_and_sticks():
    scene = zwidth.Scene(zwidth.Device(mass=0.3), zwidth.Timing(1e-3))
    got = integrate(scene, 0.0, 0.0, 150, velocity=0.2, coulomb=0.7)
    way, stop = 0.3 * 0.2**2 / (2 * 0.7), 0.3 * 0.2 / 0.7
    assert got.position[-1, 0] == pytest.approx(way, rel=tol.JUDGE.float64)
    [(instant, kind)] = got.events
    assert (instant, kind) == (pytest.approx(stop, rel=tol.JUDGE.float64), "stick")
    assert got.velocity[got.time > stop].tolist() == [[0.0]] * int((got.time > stop).sum())


@pytest.mark.parametrize("external_force", [0.69, -0.71, 0.71])
def test_block_at_rest_leaves_beyond_static_friction(external_force):
    scene = zwidth.Scene(zwidth.Device(mass=0.3), zwidth.Timing(1e-3))
    got = integrate(scene, 0.0, 0.0, 50, external_force=external_force, coulomb=0.5, static=0.7)
    rest = abs(external_force) < 0.7
    way = 0.0 if rest else np.sign(external_force) * 0.5 * (abs(external_force) - 0.5) / 0.3 * 0.05**2
    assert got.position[-1, 0] == pytest.approx(way, rel=tol.JUDGE.float64)
    assert got.events == ([] if rest else [(0.0, "slip")])


@pytest.mark.parametrize("static", [1.3, 1.5])
def test_hand_drags_a_device_off_its_friction(static):
    """The ground's spring of the hand stretches the link to the held device as ``1 - cos``."""
    hand = zwidth.Operator(0.5, 0.0, 400.0, coupling_stiffness=900.0)
    scene = zwidth.Scene(zwidth.Device(mass=0.3), zwidth.Timing(1e-3), operator=hand)
    got = integrate(scene, 0.0, 0.0, 100, position=-3e-3, coulomb=1.2, static=static)
    stretch, rate = 400.0 * 3e-3 / 1300.0, np.sqrt(1300.0 / 0.5)
    leaving = np.arccos(1.0 - static / (900.0 * stretch)) / rate
    assert got.events[0] == (pytest.approx(leaving, rel=tol.JUDGE.float64), "slip")
    before = got.time < leaving
    assert np.all(got.position[before, 0] == -3e-3)
    assert worst(got.position[before, 1] + 3e-3, stretch * (1.0 - np.cos(rate * got.time[before]))) < tol.JUDGE.float64
    k = int(before.sum())
    gone = got.time[k] - leaving
    # Its acceleration starts at (static - Coulomb)/m and grows with the stretch.
    jerk = 900.0 * stretch * rate * np.sin(rate * leaving) / 0.3
    expected = (static - 1.2) / 0.3 * gone + 0.5 * jerk * gone**2
    assert got.velocity[k, 0] == pytest.approx(expected, rel=2.0 * rate * gone)


def test_single_bodies_on_friction_as_in_closed_form():
    rng = np.random.default_rng(37)
    kinds, left_out = set(), 0
    for k in range(16):
        motion = random_motion(("rigid", "filter")[k % 2], rng)
        got, expected = judge(motion), judge(motion, closed_form=True)
        if not largest_difference(got, expected) < tol.JUDGE.float64:
            assert nearest_decision(got) < 1e-8 or condition(motion, expected, closed_form=True) > 1e4
            left_out += 1
            continue
        assert worst(got.command, expected.command) < tol.JUDGE.float64
        assert [kind for _, kind in got.events] == [kind for _, kind in expected.events]
        if got.events:
            instants, others = ([instant for instant, _ in motion.events] for motion in (got, expected))
            assert worst(instants, others) < tol.JUDGE.float64
        kinds |= {kind for _, kind in got.events}
    assert kinds == {"stick", "turn", "slip"}
    assert left_out <= 2


@pytest.mark.parametrize("kind", ["tip", "motor", "hand", "coupled hand", "all"])
def test_motions_do_not_depend_on_the_steps(kind):
    rng = np.random.default_rng(21)
    left_out = 0
    for _ in range(2):
        motion = random_motion(kind, rng)
        got, other = judge(motion), judge(motion, rtol=1e-13, step=0.1)
        if not largest_difference(got, other) < tol.JUDGE.float64:
            assert nearest_decision(got) < 1e-8 or condition(motion, got) > 1e4
            left_out += 1
            continue
        assert [kind for _, kind in got.events] == [kind for _, kind in other.events]
    assert left_out <= 1


def test_program_reads_commands_and_acts_when_it_should():
    scene = zwidth.Scene(zwidth.Device(0.1, 0.1), zwidth.Timing(1e-3, 1.4e-3))
    late = 0.9 * np.random.default_rng(22).random(121)
    late[0] = 0.0
    limits: Any = {"resolution": 2e-5, "max_force": 0.5, "max_rate": 200.0, "jitter_samples": late}
    got = integrate(scene, 2e3, 2.0, 120, position=-1e-3, velocity=0.1, contact="push_only", **limits)
    assert np.allclose(got.time, (np.arange(121) + late) * 1e-3, rtol=1e-15)
    counts = got.measured / 2e-5
    assert np.abs(counts - np.rint(counts)).max() < 1e-9
    assert np.abs(got.measured - got.position[:, 0]).max() <= 1e-5
    assert got.contact.tolist() == (got.measured > 0).tolist()
    assert np.allclose(got.estimate[1:], np.diff(got.measured) / 1e-3, rtol=1e-12)
    assert got.estimate[0] == pytest.approx((got.measured[0] + 1e-3 + 1e-4) / 1e-3, rel=1e-9)
    wanted = np.where(got.contact, np.clip(-(2e3 * got.measured + 2.0 * got.estimate), -0.5, 0.0), 0.0)
    before = np.append(0.0, got.command[:-1])
    assert np.allclose(got.command, np.clip(wanted, before - 0.2, before + 0.2), rtol=0, atol=1e-15)
    assert (got.command.min(), np.abs(np.diff(got.command)).max()) == (-0.5, pytest.approx(0.2))
    # Every command sets in 1.4 periods behind its sample.
    starts = np.cumsum([0.0] + [piece.span for piece in got.pieces[:-1]])
    acting = np.array([piece.wall for piece in got.pieces])
    newest = np.searchsorted(got.time + 1.4e-3, starts + 1e-12) - 1
    assert acting.tolist() == np.where(newest >= 0, got.command[newest], 0.0).tolist()
