"""The judge of simulations is itself judged: by matrices, by closed forms, by energy."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import any_loop
import tolerances as tol
import zwidth
from independent_scenes import KINDS, random_scene, random_walls
from integrator import integrate
from random_motions import condition, judge, largest_difference, nearest_decision, random_motion


def worst(got, expected):
    """The largest error in units of the largest value."""
    return np.abs(np.asarray(got) - expected).max() / np.abs(expected).max()


@pytest.mark.parametrize("wall", [(0.108, 0.425, 0.0, 1.0), (0.656, 0.388, 1.0, 1.0), (0.05, 0.2, 0.1, 2.6)])
def test_rigid_device_answers_a_step_as_the_closed_form_says(wall):
    alpha, beta, delta, d = wall
    mass, period, force = 0.2, 5e-4, 3.0
    device = zwidth.Device(mass, delta * mass / period)
    scene = zwidth.Scene(device, zwidth.Timing(period, d * period))
    got = integrate(scene, alpha * mass / period**2, beta * mass / period, 99, push=force)
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
        for K, B in zip(*random_walls(scene, rng, 50), strict=True):
            if any_loop.spectral_radius(scene, K, B) < 1.02:
                break
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


def newton(wall, slip, push, friction):
    """Rates of motor, tip and soft hand, and of everything their energy goes into or comes from."""

    def rate(_, y):
        x1, x2, x3, v1, v2, v3 = y[:6]
        tie, grip = 20e3 * (x2 - x1) + 0.5 * (v2 - v1), 800.0 * (x3 - x2) + 3.0 * (v3 - v2)
        dry = -friction * slip
        a1 = (wall + push + dry - 0.4 * v1 + tie) / 0.1 if slip else 0.0
        a2, a3 = (grip - tie) / 0.06, (-grip - 5.0 * v3 - 100.0 * x3) / 0.4
        lost = 0.4 * v1**2 + 0.5 * (v2 - v1) ** 2 + 3.0 * (v3 - v2) ** 2 + 5.0 * v3**2 - dry * v1
        return [v1, v2, v3, a1, a2, a3, lost, (wall + push) * v1]

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
    got = integrate(scene, 8e3, 5.0, 200, position=-1e-3, velocity=0.15, push=0.3, contact="unilateral", **friction)
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


def test_single_bodies_on_friction_as_in_closed_form():
    rng = np.random.default_rng(20)
    kinds, left_out = set(), 0
    for k in range(30):
        motion = random_motion(("rigid", "filter")[k % 2], rng)
        got, expected = judge(motion), judge(motion, closed_form=True)
        if nearest_decision(got) < 1e-8 or condition(motion, expected, closed_form=True) > 1e4:
            left_out += 1
            continue
        assert largest_difference(got, expected) < tol.JUDGE.float64
        assert worst(got.command, expected.command) < tol.JUDGE.float64
        assert [kind for _, kind in got.events] == [kind for _, kind in expected.events]
        if got.events:
            instants, others = ([instant for instant, _ in motion.events] for motion in (got, expected))
            assert worst(instants, others) < tol.JUDGE.float64
        kinds |= {kind for _, kind in got.events}
    assert kinds == {"stick", "turn", "slip"}
    assert left_out <= 3


@pytest.mark.parametrize("kind", ["tip", "motor", "hand", "coupled hand", "all"])
def test_motions_do_not_depend_on_the_steps(kind):
    rng = np.random.default_rng(21)
    left_out = 0
    for _ in range(4):
        motion = random_motion(kind, rng)
        got, finer = judge(motion), judge(motion, rtol=3e-14, step=0.1)
        if nearest_decision(got) < 1e-8 or condition(motion, got) > 1e4:
            left_out += 1
            continue
        assert largest_difference(got, finer) < tol.JUDGE.float64
        assert [kind for _, kind in got.events] == [kind for _, kind in finer.events]
    assert left_out <= 1
