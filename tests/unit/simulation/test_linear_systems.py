"""Test simulations of devices given as linear systems.

References: the equivalent device with bodies, and the state space of the closed loop.
"""

import numpy as np
import pytest
import scipy.signal

import zwidth
from zwidth.simulation.result import OF_ENERGY

TIMING = zwidth.Timing(1e-3, 0.7e-3)
M1, B1, M2, K, C = 0.1, 3.0, 0.05, 20e3, 2.0
BODIES = zwidth.Device(M1, B1, zwidth.Coupling(M2, K, C))
RATE = [[0, 0, 1, 0], [0, 0, 0, 1], [-K / M1, K / M1, -(B1 + C) / M1, C / M1], [K / M2, -K / M2, C / M2, -C / M2]]
SYSTEM = zwidth.LinearDevice((RATE, [[0], [0], [1 / M1], [0]], [[1, 0, 0, 0]]))
# One number of substeps for all comparisons, because a program is compiled for each.
SUBSTEPS = 3
# A random external force.
EXTERNAL_FORCE = np.repeat(np.random.default_rng(1).normal(0.0, 0.5, 60), 10)


@pytest.mark.parametrize(
    "conditions",
    [
        {},
        {"contact": "unilateral"},
        {"contact": "push_only", "resolution": 1e-6, "max_force": 1.0},
        {"noise": 1e-6, "max_rate": 500.0, "seed": 7},
        {"jitter": 2e-4, "seed": 3},
    ],
)
@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100), zwidth.FOAW(1e-6)])
def test_motion_matches_the_equivalent_device(conditions, velocity):
    options = {
        "periods": EXTERNAL_FORCE.size,
        "substeps": SUBSTEPS,
        "external_force": 0.3,
        "external_force_history": EXTERNAL_FORCE,
        **conditions,
    }
    expected, motion = (
        zwidth.Scene(device, TIMING, velocity=velocity).simulate(4e3, 10.0, **options) for device in (BODIES, SYSTEM)
    )
    for name in ("position", "velocity", "wall_force", "measured", "estimated_velocity"):
        size = np.abs(getattr(expected, name)).max()
        np.testing.assert_allclose(
            getattr(motion, name), getattr(expected, name), rtol=0, atol=1e-11 * size, err_msg=name
        )
    assert motion.bounces == expected.bounces
    assert motion.penetration == pytest.approx(expected.penetration, rel=1e-11)
    assert all(np.isnan(getattr(motion, name)).all() for name in OF_ENERGY), (
        "the energy of a linear system is undefined"
    )


@pytest.mark.parametrize("stiffness", [4e3, 40e3])
def test_final_state_matches_the_verdict(stiffness):
    motion = zwidth.Scene(SYSTEM, TIMING).simulate(stiffness, 10.0, external_force=0.3, substeps=SUBSTEPS)
    stable = zwidth.Scene(SYSTEM, TIMING).is_stable(stiffness, 10.0)
    ends = zwidth.MotionKind.REST, zwidth.MotionKind.DECAYING
    assert (zwidth.MotionKind(int(motion.outcome)) in ends) == stable
    unilateral = zwidth.Scene(SYSTEM, TIMING).simulate(
        4e3, 10.0, external_force=0.3, contact="unilateral", substeps=SUBSTEPS
    )
    assert unilateral.outcome == zwidth.MotionKind.REST


def test_batch_may_contain_several_systems_and_devices():
    slower = zwidth.LinearDevice(([1.0], [0.2, 3.0, 0.0]))
    scenes = [zwidth.Scene(device, TIMING) for device in (SYSTEM, slower, BODIES)]
    batch = zwidth.simulate(scenes, 3e3, 10.0, external_force=0.3, periods=50, substeps=SUBSTEPS)
    for k, scene in enumerate(scenes):
        single = scene.simulate(3e3, 10.0, external_force=0.3, periods=50, substeps=SUBSTEPS)
        np.testing.assert_array_equal(batch.position[k], single.position)


@pytest.mark.parametrize(
    "system",
    [
        ([1.0, 40.0], [0.1, 7.0, 900.0, 0.0]),
        # Modes with damping ratios of 2 % and an unstable zero; the second system is unstable without a wall.
        ([200.0], [-5.0, -8 + 400j, -8 - 400j, -0.6 + 30j, -0.6 - 30j], 4e5),
        ([], [3.0, -40.0, -900.0], 5e3),
    ],
)
def test_step_response_matches_the_state_space(system):
    scene = zwidth.Scene(zwidth.LinearDevice(system), TIMING)
    wall = 0.02 * scene.units.stiffness, 0.1 * scene.units.virtual_damping
    expected = scene.state_space(*wall).step(300)
    motion = scene.simulate(*wall, external_force=1.0, periods=300)
    np.testing.assert_allclose(motion.position, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    grows = zwidth.MotionKind.GROWING, zwidth.MotionKind.DIVERGED
    assert (zwidth.MotionKind(int(motion.outcome)) in grows) == (not scene.is_stable(*wall))


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"start_velocity": 0.1}, "start_velocity: "),
        ({"start_position": -1e-3}, "start_position: "),
        ({"coulomb": 1.0}, "coulomb, static: "),
    ],
)
def test_arguments_that_need_a_body_are_rejected(options, field):
    with pytest.raises(zwidth.InputError, match=f"^{field}.*starts at rest"):
        zwidth.Scene(SYSTEM, TIMING).simulate(4e3, 10.0, **options)
    # Also in a batch with a device that supports them.
    with pytest.raises(zwidth.InputError, match="starts at rest"):
        zwidth.simulate([zwidth.Scene(BODIES, TIMING), zwidth.Scene(SYSTEM, TIMING)], 4e3, 10.0, **options)


def test_systems_without_a_defined_velocity_are_rejected():
    with pytest.raises(zwidth.InputError, match="velocity jumps with the force"):
        zwidth.Scene(zwidth.LinearDevice(([1.0], [3.0, 0.0])), TIMING).simulate(100.0, 0.0, external_force=1.0)
    device = zwidth.LinearDevice(scipy.signal.dlti([4e-6, 4e-6], [1.0, -1.9, 0.9], dt=1e-3))
    with pytest.raises(zwidth.InputError, match="discrete-time system"):
        zwidth.Scene(device, zwidth.Timing(1e-3)).simulate(100.0, 0.0, external_force=1.0)
