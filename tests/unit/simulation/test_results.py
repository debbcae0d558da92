"""Statistics and observed behavior of motions, and batches with unusual input."""

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
def test_a_linear_motion_ends_as_its_poles_say(share, periods, kind):
    found = SCENE.simulate(share * TOP.stiffness, TOP.virtual_damping, start_position=1e-3, periods=periods)
    assert MotionKind(found.outcome).name == kind
    assert (found.trend < 1) == (share < 1) or kind == "REST"


def test_an_undamped_swing_is_steady():
    free = zwidth.Scene(zwidth.Device(mass=0.1, damping=0.5), zwidth.Timing(period=1e-3))
    found = free.simulate(1e3, 0.0, start_position=1e-3, periods=4000)
    # The width halves in 333,000 periods: a change of 0.2 % within the tail of 1,000 periods is observed.
    assert MotionKind(found.outcome) is MotionKind.DECAYING
    assert MotionKind(free.simulate(1e3, 0.0, start_position=1e-3, periods=500, tail=400).outcome) is MotionKind.STEADY
    assert found.trend == pytest.approx(float(free.spectral_radius(1e3, 0.0)) ** 500, rel=1e-3)
    assert found.amplitude == pytest.approx(1e-3, rel=0.02)
    assert found.frequency == pytest.approx(np.sqrt(1e3 / 0.1) / (2 * np.pi), rel=1e-2)


def test_a_decay_below_a_step_of_the_encoder_is_not_steady():
    hand = zwidth.Operator(mass=0.01, damping=0.05, stiffness=100.0)
    scene = zwidth.Scene(zwidth.Device(0.1, 0.05), TIMING, operator=hand)
    found = scene.simulate(1e3, 0.0, resolution=1e-4, external_force=-0.001, periods=2000)
    assert MotionKind(found.outcome) in (MotionKind.DECAYING, MotionKind.UNCLEAR)


def test_the_steps_of_an_encoder_make_no_trend():
    stiffness = np.linspace(1e3, 0.9 * float(TOP.stiffness), 200)
    found = SCENE.simulate(stiffness, 20.0, start_position=1e-4, resolution=2e-5, periods=4000, record=False)
    stable = SCENE.is_stable(stiffness, 20.0)
    assert stable.sum() > 100
    assert set(found.outcome[stable].tolist()) <= {MotionKind.REST, MotionKind.STEADY, MotionKind.UNCLEAR}
    assert np.mean(found.outcome[stable] == MotionKind.UNCLEAR) < 0.5


def test_a_wall_that_is_no_number_is_not_quiet():
    found = SCENE.simulate([1e3, np.nan], 5.0, periods=50)
    assert found.outcome.tolist() == [MotionKind.REST, MotionKind.INVALID]


def test_an_encoder_at_rest_does_not_kick():
    start = np.linspace(-0.49, 0.49, 99) * 1e-4
    found = SCENE.simulate(0.0, 42.5, resolution=1e-4, start_position=start, coulomb=0.5, periods=100)
    assert not found.wall_force.any()
    assert set(found.outcome.tolist()) == {MotionKind.REST}


@pytest.mark.parametrize("names", [("a", "b"), (), ("position",)])
def test_names_of_axes_fit(names):
    alone, two = SCENE.simulate(1e3, 5.0, periods=5), SCENE.simulate([1e3, 2e3], 5.0, periods=5)
    if names:
        with pytest.raises(InputError, match="dims: got"):
            (alone if len(names) > 1 else two).to_dataset(*names)
    else:
        assert alone.to_dataset().amplitude.dims == ()


def test_the_amplitude_is_that_of_the_whole_tail():
    found = SCENE.simulate(1.1 * TOP.stiffness, TOP.virtual_damping, start_position=1e-3, periods=200, tail=60)
    tail = found.position[-60:]
    assert found.amplitude == pytest.approx(0.5 * np.ptp(tail))
    assert found.trend == pytest.approx(np.ptp(tail[30:]) / np.ptp(tail[:30]))


@pytest.mark.parametrize("coulomb", [0.0, 0.1])
def test_a_tail_of_one_period_has_no_trend(coulomb):
    found = SCENE.simulate(1e3, 5.0, start_velocity=0.1, periods=5, tail=1, coulomb=coulomb)
    assert found.amplitude == 0.0
    assert np.isnan(found.trend)


@pytest.mark.parametrize("resolution", [5e-324, 1e-310])
def test_steps_too_fine_to_be_counted_are_none(resolution):
    fine, exact = (SCENE.simulate(1e3, 5.0, start_velocity=0.1, periods=50, resolution=r) for r in (resolution, 0.0))
    np.testing.assert_array_equal(fine.position, exact.position)


def test_a_motion_beyond_all_numbers_diverges_without_a_warning():
    found = SCENE.simulate(1e7, 0.0, start_position=1e-3, periods=3000)
    assert MotionKind(found.outcome) is MotionKind.DIVERGED
    assert found.amplitude == np.inf
    assert found.status == Status.OK


def test_what_rests_has_no_frequency_and_without_friction_nothing_sticks():
    held = SCENE.simulate(5e3, 5.0, start_position=1e-5, coulomb=1.0)
    assert MotionKind(held.outcome) is MotionKind.REST
    assert np.isnan(held.frequency)
    assert held.sticking.all()
    assert not SCENE.simulate(5e3, 5.0, start_position=1e-5).sticking.any()


def test_an_array_of_scenes_is_a_batch():
    scenes = np.empty((2, 1), object)
    scenes[:, 0] = SCENE, COUPLED
    found = zwidth.simulate(scenes, [1e3, 2e3], 5.0, start_position=1e-3, periods=50)
    assert found.position.shape == (2, 2, 50)
    listed = zwidth.simulate([[SCENE], [COUPLED]], [1e3, 2e3], 5.0, start_position=1e-3, periods=50)
    np.testing.assert_array_equal(listed.position, found.position)
    for row, scene in enumerate((SCENE, COUPLED)):
        alone = scene.simulate([1e3, 2e3], 5.0, start_position=1e-3, periods=50)
        np.testing.assert_allclose(found.position[row], alone.position, rtol=1e-12)


def test_scenes_without_jitter_have_instants_beside_some_that_have_it():
    found = zwidth.simulate([SCENE, COUPLED], 1e3, 5.0, jitter=[0.0, 3e-4], start_position=1e-3, periods=20)
    np.testing.assert_allclose(found.time[0], 1e-3 * np.arange(20))
    late = found.time[1] - 1e-3 * np.arange(20)
    assert late[0] == 0
    assert np.all((late >= 0) & (late <= 3e-4))
    assert late.max() > 0


def test_a_dataset_has_one_time_where_all_share_it_and_else_instants():
    both = [SCENE, SCENE.replace(period=5e-4)]
    shared, own = (zwidth.simulate(scenes, [1e3, 2e3], 5.0, periods=8).to_dataset("wall") for scenes in (SCENE, both))
    assert shared.time.dims == ("time",)
    np.testing.assert_allclose(shared.time, 1e-3 * np.arange(8))
    assert own.instant.dims == ("wall", "time")
    np.testing.assert_allclose(own.instant, np.outer([1e-3, 5e-4], np.arange(8)))


@pytest.mark.parametrize(
    "scenes, options, words",
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
def test_what_cannot_be_simulated_is_named(scenes, options, words):
    with pytest.raises(InputError, match=words):
        zwidth.simulate(scenes, **{"stiffness": 1e3, "virtual_damping": 1.0, "periods": 10, **options})


def test_a_gap_in_one_history_spoils_no_other():
    pushes = np.ones((3, 20))
    pushes[1, 5] = np.nan
    found = SCENE.simulate(1e3, 5.0, external_force_history=pushes, periods=20)
    assert found.status.tolist() == [Status.OK, Status.INVALID_INPUT, Status.OK]
    assert np.isnan(found.position[1]).all()
    close = SIMULATED_AGAIN.float64 * np.abs(found.position[0]).max()
    np.testing.assert_allclose(found.position[0], found.position[2], rtol=0, atol=close)


def test_an_adaptive_window_takes_a_line_that_misses_by_just_its_bound():
    """A ramp of a count a period, read by an encoder: every window fits, and the longest is taken."""
    quantum = 1e-5
    scene = zwidth.Scene(zwidth.Device(1.0), TIMING, velocity=zwidth.FOAW(noise=quantum, samples=8))
    found = scene.simulate(0.0, 0.0, start_velocity=0.5 * quantum / 1e-3, resolution=quantum, periods=60)
    past = found.measured
    for k in range(10, 60):
        allowed = []
        for n in range(1, 9):
            slope = (past[k] - past[k - n]) / n
            missed = [abs(past[k - j] - (past[k] - slope * j)) for j in range(1, n)]
            if max(missed, default=0.0) > quantum * (1 + 1e-9):
                break
            allowed.append(slope / 1e-3)
        assert found.estimated_velocity[k] == pytest.approx(allowed[-1], rel=1e-12)


def test_what_the_program_makes_of_a_sample_is_in_si_units():
    K, B = 2e3, 5.0
    found = SCENE.simulate(K, B, start_position=1e-3, start_velocity=0.1, resolution=1e-5, periods=50)
    rate = np.diff(found.measured) / 1e-3
    np.testing.assert_allclose(found.estimated_velocity[1:], rate, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.command, -(K * found.measured + B * found.estimated_velocity), rtol=1e-9)
    # A period late.
    np.testing.assert_allclose(found.wall_force[1:], found.command[:-1], rtol=1e-9)
    assert found.wall_force[0] == 0
