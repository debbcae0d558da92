"""Test the closed-form motion of a mass with Coulomb friction.

References: `zwidth.simulate`, and finite differences for the derivatives.
"""

import numpy as np
import pytest
import tolerances

import zwidth
from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import Recording

EXACT = tolerances.FIT_EXACT.float64
PERIOD, FINER, SKIP = 1e-3, 20, 6


def random_force(seed, count=300, hold=17):
    steps = np.random.default_rng(seed).uniform(-1.0, 1.0, count // hold + 1)
    return np.repeat(steps, hold)[:count]


@pytest.mark.parametrize("friction", [0.0, 0.05, 0.4])
@pytest.mark.parametrize("delay, damping", [(0.0, 0.0), (0.35, 1.5), (2.0, 1.5), (3.85, 20.0)])
def test_motion_matches_simulation_with_finer_period(friction, delay, damping):
    mass, force = 0.08, random_force(3)
    # An external force acts without delay, so a delay of 7/20 periods is 7 periods of a simulation with a period of
    # 1/20.
    n_delay = round(delay * FINER)
    fine_force = np.concatenate([np.zeros(n_delay), np.repeat(force, FINER)])[: FINER * force.size]
    scene = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(period=PERIOD / FINER))
    friction_options = {"coulomb": friction} if friction else {}
    motion = zwidth.simulate(
        scene, 0.0, 0.0, external_force_history=fine_force, periods=fine_force.size, **friction_options
    )
    exact = motion.position[: fine_force.size : FINER]
    speed = float(motion.velocity[SKIP * FINER]) * PERIOD
    g = PERIOD**2 / mass
    recording = Recording(force, exact[SKIP:], SKIP)
    response = recording.move(g, damping * PERIOD / mass, delay, exact[SKIP], speed, 0.0, g * friction)
    np.testing.assert_allclose(response.position, recording.position, rtol=0, atol=EXACT * np.ptp(exact))


@pytest.mark.parametrize("friction", [0.0, 2e-6])
@pytest.mark.parametrize("delta, d", [(1e-4, 0.3), (0.02, 2.7), (0.8, 1.4)])
def test_derivatives_match_finite_differences(friction, delta, d):
    recording = Recording(random_force(5), np.zeros(294), SKIP)
    arguments = {"g": 1e-5, "delta": delta, "d": d, "x0": 0.1, "v0": 3e-4, "offset": 2e-7, "friction": friction}
    steps = {"g": 1e-10, "delta": 1e-6, "d": 1e-6, "x0": 1e-6, "v0": 1e-8, "offset": 1e-12, "friction": 1e-11}
    slopes = recording.move(**arguments).derivatives
    for k, (name, step) in enumerate(steps.items()):
        if name == "friction" and not friction:
            continue
        ends = [recording.move(**arguments | {name: arguments[name] + side * step}).position for side in (1, -1)]
        differences = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(slopes[:, k], differences, rtol=0, atol=2e-5 * np.abs(differences).max())


def test_sticking_mass_stays_at_rest():
    recording = Recording(np.full(60, 0.5), np.zeros(54), SKIP)
    response = recording.move(1e-5, 0.01, 1.3, 0.2, 0.0, 0.0, 6e-6)
    np.testing.assert_array_equal(response.position, 0.2)
    np.testing.assert_array_equal(response.derivatives[:, [0, 1, 2, 4, 5, 6]], 0.0)


def test_several_logs_share_only_the_device_parameters():
    logs = tuple(Recording(random_force(seed), np.zeros(294), SKIP) for seed in (1, 2))
    model = Recordings(logs)
    theta = np.array([1e-5, 0.02, 1.3, 0.1, 1e-4, -0.2, -3e-4, 1e-7, 1e-6])
    motion = model.simulate(theta)
    positions, slopes = motion.position, motion.derivatives
    for k, log in enumerate(logs):
        single = log.move(*theta[:3], *theta[3 + 2 * k : 5 + 2 * k], *theta[7:])
        rows = slice(294 * k, 294 * (k + 1))
        np.testing.assert_array_equal(positions[rows], single.position)
        np.testing.assert_array_equal(slopes[rows][:, [0, 1, 2, 3 + 2 * k, 4 + 2 * k, 7, 8]], single.derivatives)
        np.testing.assert_array_equal(slopes[rows][:, [5 - 2 * k, 6 - 2 * k]], 0.0)
