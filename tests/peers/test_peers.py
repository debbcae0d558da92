"""Two hundred random scenes, against python-control, scipy.signal and matrix exponentials."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
import scipy.signal

import zwidth
from peers.scenes import Loop, closed_loop_matrix, continuous, hold_force, random_loops
from zwidth.stability.rigid.normalization import Normalized

LOOPS = random_loops()
INTEGER_DELAYS = [loop for loop in LOOPS if loop.fraction < 1e-9]
PEER = 1e-9  # the peers' own errors are about 1e-10: products of polynomials, matrices scaled by T and m
PEER_NEAR_DOUBLE = 1e-6  # at nearly double poles, eigenvalues have half of their digits


def normalized(loops: list[Loop]) -> Normalized:
    """Return the normalized parameters of all loops."""
    fields = ("mass", "damping", "period", "delay", "stiffness", "virtual_damping")
    return zwidth.normalize(**{name: np.array([getattr(loop, name) for loop in loops]) for name in fields})


def radius_tolerance(poles: np.ndarray) -> float:
    """Return the allowed difference of two eigenvalue computations, given the poles of a scene."""
    poles = poles[np.isfinite(poles)]
    largest = poles[np.argmax(np.abs(poles))]
    others = np.delete(poles, np.argmax(np.abs(poles)))
    return PEER_NEAR_DOUBLE if np.min(np.abs(others - largest)) < 1e-3 else PEER


@pytest.fixture(scope="module")
def poles_by_loop():
    """Return the poles of every scene."""
    return dict(zip(LOOPS, zwidth.poles(*normalized(LOOPS)), strict=True))


def test_scenes_include_both_verdicts(poles_by_loop):
    stable = [np.nanmax(np.abs(poles)) < 1 for poles in poles_by_loop.values()]
    assert len(stable) == 200
    assert 40 < sum(stable) < 160
    assert len(INTEGER_DELAYS) == 100


def test_spectral_radius_agrees_with_a_matrix_exponential_for_any_delay(poles_by_loop):
    for loop, poles in poles_by_loop.items():
        peer = np.abs(np.linalg.eigvals(closed_loop_matrix(loop))).max()
        assert np.nanmax(np.abs(poles)) == pytest.approx(peer, rel=radius_tolerance(poles)), loop


def test_polynomial_agrees_with_a_matrix_exponential_for_any_delay():
    values = normalized(LOOPS)
    for index, loop in enumerate(LOOPS):
        poles_by_loop = np.asarray(zwidth.char_poly(*(float(part[index]) for part in values)))
        peer = np.poly(closed_loop_matrix(loop))
        # At integer delays the peer keeps an unused force: one more factor z.
        padded = np.pad(poles_by_loop, (0, peer.size - poles_by_loop.size))
        assert np.allclose(padded, peer, rtol=0, atol=1e-8 * np.abs(peer).max()), loop


def discrete_plant(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """Return scipy's zero-order hold of the damped mass, as a transfer function from N to position in T^2/m."""
    a, b = continuous(loop)
    # ss2tf subtracts polynomials with coefficients of order one: a numerator in SI units would lose nine digits.
    position = np.array([[loop.mass / loop.period**2, 0.0]])
    system: Any = scipy.signal.cont2discrete((a, b, position, np.zeros((1, 1))), loop.period, "zoh")
    numerator, denominator = scipy.signal.ss2tf(*system[:4])
    return numerator.ravel()[1:], np.asarray(denominator)


def test_poles_agree_with_scipy_signal(poles_by_loop):
    for loop in INTEGER_DELAYS:
        numerator, denominator = discrete_plant(loop)
        damper = loop.virtual_damping / loop.period
        wall = np.array([loop.stiffness + damper, -damper]) * loop.period**2 / loop.mass
        closed = np.polyadd(np.polymul(denominator, np.eye(1, 2 + loop.n_delay)[0]), np.polymul(numerator, wall))
        peer = np.abs(np.roots(closed)).max()
        # ss2tf computes the denominator from eigenvalues, which are a double 1 for an undamped mass.
        tolerance = radius_tolerance(poles_by_loop[loop]) if loop.damping else PEER_NEAR_DOUBLE
        assert np.nanmax(np.abs(poles_by_loop[loop])) == pytest.approx(peer, rel=tolerance), loop


def control_loop(loop: Loop) -> control.StateSpace:
    """Return python-control's closed loop from applied force to position."""
    a, b = continuous(loop)
    plant = control.c2d(control.ss(a, b, [[1.0, 0.0]], [[0.0]]), loop.period, "zoh")
    damper = loop.virtual_damping / loop.period
    wall = control.tf([loop.stiffness + damper, -damper], np.eye(1, 2 + loop.n_delay)[0], loop.period)
    realized: Any = control.tf2ss(wall)
    closed = control.feedback(plant, realized)
    assert isinstance(closed, control.StateSpace)
    return closed


def test_poles_agree_with_python_control(poles_by_loop):
    for loop in INTEGER_DELAYS:
        peer = np.abs(control_loop(loop).poles()).max()
        assert np.nanmax(np.abs(poles_by_loop[loop])) == pytest.approx(
            peer, rel=radius_tolerance(poles_by_loop[loop])
        ), loop


def zwidth_step(loop: Loop, periods: int) -> np.ndarray:
    """Return the position at the samples for a force of 1 N."""
    scene = zwidth.Scene(
        zwidth.Device(loop.mass, loop.damping),
        zwidth.Timing(loop.period, loop.delay),
        zwidth.VirtualWall(loop.stiffness, loop.virtual_damping),
    )
    response = zwidth.step_response(*map(float, scene.normalized), periods=periods, substeps=1)
    return response.position * loop.period**2 / loop.mass


def test_step_responses_agree_with_python_control_and_scipy():
    periods = 40
    for loop in INTEGER_DELAYS:
        response_zwidth = zwidth_step(loop, periods)
        time = np.arange(periods) * loop.period
        system = control_loop(loop)
        response_control = control.step_response(system, time).outputs
        response_scipy = scipy.signal.dlsim((system.A, system.B, system.C, system.D, loop.period), np.ones(periods))[
            1
        ].ravel()
        # An unstable response grows without bound; rounding errors are relative to its largest value.
        scale = np.abs(response_zwidth).max()
        assert np.abs(response_zwidth - response_control).max() <= PEER * scale, loop
        assert np.abs(response_zwidth - response_scipy).max() <= PEER * scale, loop


def test_step_responses_agree_with_a_matrix_exponential_for_any_delay():
    periods = 40
    for loop in LOOPS:
        matrix = closed_loop_matrix(loop)
        force_effect = hold_force(loop, loop.period)[1].ravel()
        state, positions = np.zeros(matrix.shape[0]), []
        for _ in range(periods):
            positions.append(state[0])
            state = matrix @ state
            state[:2] += force_effect
        response_zwidth = zwidth_step(loop, periods)
        assert np.abs(response_zwidth - positions).max() <= PEER * np.abs(response_zwidth).max(), loop
