"""Two hundred random scenes against python-control, scipy.signal and a matrix exponential."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
import scipy.signal

import zwidth
from peers.scenes import Loop, closed_loop_matrix, continuous, held, random_loops
from zwidth.stability.rigid.normalization import Normalized

LOOPS = random_loops()
WHOLE = [loop for loop in LOOPS if loop.fraction < 1e-9]
# The peers multiply polynomials and take eigenvalues of matrices scaled by T and m: about 1e-10 is theirs.
PEER = 1e-9
# Where two poles nearly coincide, eigenvalues keep half their digits.
PEER_NEAR_DOUBLE = 1e-6


def normalized(loops: list[Loop]) -> Normalized:
    """All scenes at once."""
    fields = ("mass", "damping", "period", "delay", "stiffness", "virtual_damping")
    return zwidth.normalize(**{name: np.array([getattr(loop, name) for loop in loops]) for name in fields})


def radius_tolerance(poles: np.ndarray) -> float:
    """What two eigenvalue codes may differ by, given the poles of one scene."""
    poles = poles[np.isfinite(poles)]
    largest = poles[np.argmax(np.abs(poles))]
    others = np.delete(poles, np.argmax(np.abs(poles)))
    return PEER_NEAR_DOUBLE if np.min(np.abs(others - largest)) < 1e-3 else PEER


@pytest.fixture(scope="module")
def ours():
    """Poles of every scene, by scene."""
    return dict(zip(LOOPS, zwidth.poles(*normalized(LOOPS)), strict=True))


def test_there_are_enough_scenes_of_both_verdicts(ours):
    stable = [np.nanmax(np.abs(poles)) < 1 for poles in ours.values()]
    assert len(stable) == 200
    assert 40 < sum(stable) < 160
    assert len(WHOLE) == 100


def test_spectral_radius_agrees_with_a_matrix_exponential_for_any_delay(ours):
    for loop, poles in ours.items():
        peer = np.abs(np.linalg.eigvals(closed_loop_matrix(loop))).max()
        assert np.nanmax(np.abs(poles)) == pytest.approx(peer, rel=radius_tolerance(poles)), loop


def test_polynomial_agrees_with_a_matrix_exponential_for_any_delay():
    values = normalized(LOOPS)
    for index, loop in enumerate(LOOPS):
        ours = np.asarray(zwidth.char_poly(*(float(part[index]) for part in values)))
        peer = np.poly(closed_loop_matrix(loop))
        # For a whole delay the peer keeps the force that is never used: one more factor z.
        padded = np.pad(ours, (0, peer.size - ours.size))
        assert np.allclose(padded, peer, rtol=0, atol=1e-8 * np.abs(peer).max()), loop


def discrete_plant(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """scipy's zero-order hold of the damped mass, as a transfer function from N to position in T^2/m."""
    a, b = continuous(loop)
    # ss2tf subtracts polynomials of order one: a numerator in SI units, 1e-9 say, would lose nine digits.
    position = np.array([[loop.mass / loop.period**2, 0.0]])
    system: Any = scipy.signal.cont2discrete((a, b, position, np.zeros((1, 1))), loop.period, "zoh")
    numerator, denominator = scipy.signal.ss2tf(*system[:4])
    return numerator.ravel()[1:], np.asarray(denominator)


def test_poles_agree_with_scipy_signal(ours):
    for loop in WHOLE:
        numerator, denominator = discrete_plant(loop)
        damper = loop.virtual_damping / loop.period
        wall = np.array([loop.stiffness + damper, -damper]) * loop.period**2 / loop.mass
        closed = np.polyadd(np.polymul(denominator, np.eye(1, 2 + loop.whole)[0]), np.polymul(numerator, wall))
        peer = np.abs(np.roots(closed)).max()
        # ss2tf takes its denominator from eigenvalues; those of a free mass without damping are a double 1.
        tolerance = radius_tolerance(ours[loop]) if loop.damping else PEER_NEAR_DOUBLE
        assert np.nanmax(np.abs(ours[loop])) == pytest.approx(peer, rel=tolerance), loop


def control_loop(loop: Loop) -> control.StateSpace:
    """python-control's closed loop from the applied force to position."""
    a, b = continuous(loop)
    plant = control.c2d(control.ss(a, b, [[1.0, 0.0]], [[0.0]]), loop.period, "zoh")
    damper = loop.virtual_damping / loop.period
    wall = control.tf([loop.stiffness + damper, -damper], np.eye(1, 2 + loop.whole)[0], loop.period)
    realized: Any = control.tf2ss(wall)
    closed = control.feedback(plant, realized)
    assert isinstance(closed, control.StateSpace)
    return closed


def test_poles_agree_with_python_control(ours):
    for loop in WHOLE:
        peer = np.abs(control_loop(loop).poles()).max()
        assert np.nanmax(np.abs(ours[loop])) == pytest.approx(peer, rel=radius_tolerance(ours[loop])), loop


def our_step(loop: Loop, periods: int) -> np.ndarray:
    """Position at the samples for a force of 1 N."""
    scene = zwidth.Scene(
        zwidth.Device(loop.mass, loop.damping),
        zwidth.Timing(loop.period, loop.delay),
        zwidth.VirtualWall(loop.stiffness, loop.virtual_damping),
    )
    response = zwidth.step_response(*map(float, scene.normalized), periods=periods, substeps=1)
    return response.position * loop.period**2 / loop.mass


def test_step_responses_agree_with_python_control_and_scipy():
    periods = 40
    for loop in WHOLE:
        ours = our_step(loop, periods)
        time = np.arange(periods) * loop.period
        system = control_loop(loop)
        theirs = control.step_response(system, time).outputs
        scipys = scipy.signal.dlsim((system.A, system.B, system.C, system.D, loop.period), np.ones(periods))[1].ravel()
        # An unstable response grows without bound: its largest value is the scale of its rounding errors.
        scale = np.abs(ours).max()
        assert np.abs(ours - theirs).max() <= PEER * scale, loop
        assert np.abs(ours - scipys).max() <= PEER * scale, loop


def test_step_responses_agree_with_a_matrix_exponential_for_any_delay():
    periods = 40
    for loop in LOOPS:
        matrix = closed_loop_matrix(loop)
        push = held(loop, loop.period)[1].ravel()
        state, positions = np.zeros(matrix.shape[0]), []
        for _ in range(periods):
            positions.append(state[0])
            state = matrix @ state
            state[:2] += push
        ours = our_step(loop, periods)
        assert np.abs(ours - positions).max() <= PEER * np.abs(ours).max(), loop
