"""Test results of simulations: statistics, observed behavior, batches of scenes, datasets and unusual input."""

from __future__ import annotations

import numpy as np
import pytest
from tolerances import SIMULATED_AGAIN

import zwidth
from zwidth import MotionKind, Status
from zwidth.core.errors import InputError

TIMING = zwidth.Timing(period=1e-3, delay=1e-3)
SCENE = zwidth.Scene(zwidth.Device(mass=0.1, damping=2.0), TIMING)
COUPLED = zwidth.Scene(zwidth.Device(0.1, 2.0, zwidth.Coupling(0.05, 5e3, 1.0)), TIMING)
TOP = SCENE.max_stiffness()


@pytest.mark.parametrize("share, periods, kind", [(0.5, 200, "DECAYING"), (1.1, 400, "GROWING"), (0.5, 4000, "REST")])
def test_outcome_of_linear_motion_matches_its_poles(share, periods, kind):
    motion = SCENE.simulate(share * TOP.stiffness, TOP.virtual_damping, start_position=1e-3, periods=periods)
    assert MotionKind(motion.outcome).name == kind
    assert (motion.trend < 1) == (share < 1) or kind == "REST"


def test_outcome_of_weakly_damped_oscillation():
    free = zwidth.Scene(zwidth.Device(mass=0.1, damping=0.5), zwidth.Timing(period=1e-3))
    motion = free.simulate(1e3, 0.0, start_position=1e-3, periods=4000)
    # The amplitude halves in 333,000 periods: a change of 0.2 % within a tail of 1,000 periods is detected.
    assert MotionKind(motion.outcome) is MotionKind.DECAYING
    assert MotionKind(free.simulate(1e3, 0.0, start_position=1e-3, periods=500, tail=400).outcome) is MotionKind.STEADY
    assert motion.trend == pytest.approx(float(free.spectral_radius(1e3, 0.0)) ** 500, rel=1e-3)
    assert motion.amplitude == pytest.approx(1e-3, rel=0.02)
    assert motion.frequency == pytest.approx(np.sqrt(1e3 / 0.1) / (2 * np.pi), rel=1e-2)


def test_decay_below_the_encoder_step_is_not_steady():
    hand = zwidth.Operator(mass=0.01, damping=0.05, stiffness=100.0)
    scene = zwidth.Scene(zwidth.Device(0.1, 0.05), TIMING, operator=hand)
    motion = scene.simulate(1e3, 0.0, resolution=1e-4, external_force=-0.001, periods=2000)
    assert MotionKind(motion.outcome) in (MotionKind.DECAYING, MotionKind.UNCLEAR)


def test_quantization_causes_no_trend():
    stiffness = np.linspace(1e3, 0.9 * float(TOP.stiffness), 200)
    motion = SCENE.simulate(stiffness, 20.0, start_position=1e-4, resolution=2e-5, periods=4000, record=False)
    stable = SCENE.is_stable(stiffness, 20.0)
    assert stable.sum() > 100
    assert set(motion.outcome[stable].tolist()) <= {MotionKind.REST, MotionKind.STEADY, MotionKind.UNCLEAR}
    assert np.mean(motion.outcome[stable] == MotionKind.UNCLEAR) < 0.5


def test_outcome_of_invalid_stiffness_is_invalid():
    motion = SCENE.simulate([1e3, np.nan], 5.0, periods=50)
    assert motion.outcome.tolist() == [MotionKind.REST, MotionKind.INVALID]


def test_quantized_start_position_causes_no_force():
    start = np.linspace(-0.49, 0.49, 99) * 1e-4
    motion = SCENE.simulate(0.0, 42.5, resolution=1e-4, start_position=start, coulomb=0.5, periods=100)
    assert not motion.wall_force.any()
    assert set(motion.outcome.tolist()) == {MotionKind.REST}


@pytest.mark.parametrize("names", [("a", "b"), (), ("position",)])
def test_invalid_dimension_names_are_rejected(names):
    single, batch = SCENE.simulate(1e3, 5.0, periods=5), SCENE.simulate([1e3, 2e3], 5.0, periods=5)
    if names:
        with pytest.raises(InputError, match="dims: got"):
            (single if len(names) > 1 else batch).to_dataset(*names)
    else:
        assert single.to_dataset().amplitude.dims == ()


def test_amplitude_and_trend_are_computed_from_the_tail():
    motion = SCENE.simulate(1.1 * TOP.stiffness, TOP.virtual_damping, start_position=1e-3, periods=200, tail=60)
    tail = motion.position[-60:]
    assert motion.amplitude == pytest.approx(0.5 * np.ptp(tail))
    assert motion.trend == pytest.approx(np.ptp(tail[30:]) / np.ptp(tail[:30]))


@pytest.mark.parametrize("coulomb", [0.0, 0.1])
def test_tail_of_one_period_has_no_trend(coulomb):
    motion = SCENE.simulate(1e3, 5.0, start_velocity=0.1, periods=5, tail=1, coulomb=coulomb)
    assert motion.amplitude == 0.0
    assert np.isnan(motion.trend)


@pytest.mark.parametrize("resolution", [5e-324, 1e-310])
def test_denormal_resolution_has_no_effect(resolution):
    fine, exact = (SCENE.simulate(1e3, 5.0, start_velocity=0.1, periods=50, resolution=r) for r in (resolution, 0.0))
    np.testing.assert_array_equal(fine.position, exact.position)


def test_overflowing_motion_diverges_without_a_warning():
    motion = SCENE.simulate(1e7, 0.0, start_position=1e-3, periods=3000)
    assert MotionKind(motion.outcome) is MotionKind.DIVERGED
    assert motion.amplitude == np.inf
    assert motion.status == Status.OK


def test_sticking_motion_has_no_frequency():
    stuck = SCENE.simulate(5e3, 5.0, start_position=1e-5, coulomb=1.0)
    assert MotionKind(stuck.outcome) is MotionKind.REST
    assert np.isnan(stuck.frequency)
    assert stuck.sticking.all()
    assert not SCENE.simulate(5e3, 5.0, start_position=1e-5).sticking.any()


def test_array_of_scenes_is_a_batch():
    scenes = np.empty((2, 1), object)
    scenes[:, 0] = SCENE, COUPLED
    batch = zwidth.simulate(scenes, [1e3, 2e3], 5.0, start_position=1e-3, periods=50)
    assert batch.position.shape == (2, 2, 50)
    from_list = zwidth.simulate([[SCENE], [COUPLED]], [1e3, 2e3], 5.0, start_position=1e-3, periods=50)
    np.testing.assert_array_equal(from_list.position, batch.position)
    for row, scene in enumerate((SCENE, COUPLED)):
        single = scene.simulate([1e3, 2e3], 5.0, start_position=1e-3, periods=50)
        np.testing.assert_allclose(batch.position[row], single.position, rtol=1e-12)


def test_batch_with_and_without_jitter_has_sample_times():
    motion = zwidth.simulate([SCENE, COUPLED], 1e3, 5.0, jitter=[0.0, 3e-4], start_position=1e-3, periods=20)
    np.testing.assert_allclose(motion.time[0], 1e-3 * np.arange(20))
    lateness = motion.time[1] - 1e-3 * np.arange(20)
    assert lateness[0] == 0
    assert np.all((lateness >= 0) & (lateness <= 3e-4))
    assert lateness.max() > 0


def test_dataset_has_common_time_or_sample_instants():
    scenes_of_two_periods = [SCENE, SCENE.replace(period=5e-4)]
    shared, separate = (
        zwidth.simulate(scenes, [1e3, 2e3], 5.0, periods=8).to_dataset("wall")
        for scenes in (SCENE, scenes_of_two_periods)
    )
    assert shared.time.dims == ("time",)
    np.testing.assert_allclose(shared.time, 1e-3 * np.arange(8))
    assert separate.instant.dims == ("wall", "time")
    np.testing.assert_allclose(separate.instant, np.outer([1e-3, 5e-4], np.arange(8)))


@pytest.mark.parametrize(
    "scenes, options, message",
    [
        (None, {}, "scenes: got None"),
        (3, {}, "scenes: got 3"),
        ([SCENE, "x"], {}, "scenes: got 'x'"),
        (SCENE, {"seed": [[1], [2, 3]]}, "seed: got"),
        (SCENE, {"stiffness": np.ones(0)}, "use at least one simulation"),
        ([], {}, "use at least one simulation"),
        (SCENE, {"external_force_history": np.zeros((3, 10)), "stiffness": [1.0, 2.0]}, "external_force_history"),
        (
            SCENE,
            {"external_force_history": [0.0] * 9 + [np.nan]},
            "external_force_history: got a value that is not finite",
        ),
    ],
)
def test_invalid_arguments_are_rejected_with_their_name(scenes, options, message):
    with pytest.raises(InputError, match=message):
        zwidth.simulate(scenes, **{"stiffness": 1e3, "virtual_damping": 1.0, "periods": 10, **options})


def test_nan_in_one_history_does_not_affect_other_batch_entries():
    pushes = np.ones((3, 20))
    pushes[1, 5] = np.nan
    motion = SCENE.simulate(1e3, 5.0, external_force_history=pushes, periods=20)
    assert motion.status.tolist() == [Status.OK, Status.INVALID_INPUT, Status.OK]
    assert np.isnan(motion.position[1]).all()
    tolerance = SIMULATED_AGAIN.float64 * np.abs(motion.position[0]).max()
    np.testing.assert_allclose(motion.position[0], motion.position[2], rtol=0, atol=tolerance)


def test_adaptive_window_accepts_deviations_up_to_its_bound():
    """For a quantized ramp every window is within the bound, so the longest is used."""
    quantum = 1e-5
    scene = zwidth.Scene(zwidth.Device(1.0), TIMING, velocity=zwidth.FOAW(noise=quantum, samples=8))
    motion = scene.simulate(0.0, 0.0, start_velocity=0.5 * quantum / 1e-3, resolution=quantum, periods=60)
    past = motion.measured
    for k in range(10, 60):
        allowed = []
        for n in range(1, 9):
            slope = (past[k] - past[k - n]) / n
            deviations = [abs(past[k - j] - (past[k] - slope * j)) for j in range(1, n)]
            if max(deviations, default=0.0) > quantum * (1 + 1e-9):
                break
            allowed.append(slope / 1e-3)
        assert motion.estimated_velocity[k] == pytest.approx(allowed[-1], rel=1e-12)


def test_recorded_signals_are_in_si_units():
    K, B = 2e3, 5.0
    motion = SCENE.simulate(K, B, start_position=1e-3, start_velocity=0.1, resolution=1e-5, periods=50)
    rate = np.diff(motion.measured) / 1e-3
    np.testing.assert_allclose(motion.estimated_velocity[1:], rate, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(motion.command, -(K * motion.measured + B * motion.estimated_velocity), rtol=1e-9)
    # The force acts one period later.
    np.testing.assert_allclose(motion.wall_force[1:], motion.command[:-1], rtol=1e-9)
    assert motion.wall_force[0] == 0
