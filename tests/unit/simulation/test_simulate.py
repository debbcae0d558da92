"""Test `zwidth.simulate`: arguments, batches, velocity estimates, noise, limits, contact, jitter and results.

References: exact arithmetic, SciPy filters, poles, and equivalent simulations.
"""

from fractions import Fraction

import numpy as np
import pytest
import scipy.signal
from any_loop import velocity_polynomials
from tolerances import SIMULATED_AGAIN

import zwidth
from zwidth.core.errors import InputError, ResourceError

SCENE = zwidth.Scene(zwidth.Device(mass=0.1, damping=2.0), zwidth.Timing(period=1e-3, delay=1.3e-3))
RESULTS = ("amplitude", "frequency", "penetration", "bounces", "impact_velocity", "wall_work_max", "outcome", "status")


def run(*args, **options):
    scenes = args or (SCENE,)
    arguments = {"stiffness": 500.0, "virtual_damping": 2.0, "periods": 200, "start_position": 1e-3, **options}
    return zwidth.simulate(*scenes, **arguments)


def assert_same_motion(actual, expected, name):
    """Assert that results of one motion from different programs agree: labels exactly, values up to rounding."""
    if expected.dtype.kind in "bi":
        np.testing.assert_array_equal(actual, expected, err_msg=name)
    else:
        tolerance = SIMULATED_AGAIN.float64 * np.nan_to_num(np.abs(expected)).max()
        np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance, err_msg=name)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"stiffness": np.nan}, "stiffness"),
        ({"stiffness": "stiff"}, "stiffness"),
        ({"stiffness": [1.0, 2.0, 3.0], "external_force": [1.0, 2.0]}, "broadcast"),
        ({"periods": 0}, "periods"),
        ({"periods": 10.5}, "periods"),
        ({"substeps": 0}, "substeps"),
        ({"tail": 201}, "tail"),
        ({"contact": "both"}, "contact"),
        ({"seed": -1}, "seed"),
        ({"seed": 0.5}, "seed"),
        ({"coulomb": 1.0, "static": 0.5}, "static"),
        ({"jitter": 1e-3}, "jitter"),
        ({"resolution": -1e-6}, "resolution"),
        ({"max_force": -1.0}, "max_force"),
        ({"external_force_history": np.ones(5)}, "external_force_history"),
        ({"external_force_history": 1.0}, "external_force_history"),
        ({"external_force_history": np.full(200, np.nan)}, "external_force_history"),
    ],
)
def test_invalid_arguments_are_rejected(options, field):
    with pytest.raises(InputError, match=field):
        run(**options)


def test_simulations_that_exceed_the_memory_are_rejected():
    with pytest.raises(ResourceError, match="record=False"):
        run(stiffness=np.ones(10_000), periods=100_000)
    with pytest.raises(ResourceError, match="fewer periods"):
        run(stiffness=np.ones(10_000), periods=1_000_000, jitter=1e-5, record=False)


def test_invalid_values_do_not_affect_other_batch_entries():
    stiffness = np.array([400.0, np.nan, 900.0, np.inf])
    batch, valid = run(stiffness=stiffness), run(stiffness=stiffness[[0, 2]])
    np.testing.assert_array_equal(batch.status, [0, 1, 0, 1])
    assert np.isnan(batch.position[1]).all()
    assert np.isnan(batch.amplitude[3])
    for name in ("position", "command", "energy", *RESULTS):
        assert_same_motion(getattr(batch, name)[[0, 2]], getattr(valid, name), name)


def test_scenes_of_different_periods_and_bodies_share_a_batch():
    soft = zwidth.Device(0.1, 2.0, zwidth.Coupling(0.05, 2e3, 0.1))
    scenes = [
        SCENE,
        zwidth.Scene(soft, zwidth.Timing(5e-4, 0.0)),
        zwidth.Scene(SCENE.device, zwidth.Timing(2e-4, 2e-2), velocity=zwidth.WindowedDifference(8)),
    ]
    options = {"noise": 1e-6, "resolution": 1e-6, "contact": "unilateral", "max_force": 2.0}
    batch = run(scenes, seed=[3, 4, 5], **options)
    for index, scene in enumerate(scenes):
        single = run(scene, seed=3 + index, **options)
        tolerance = SIMULATED_AGAIN.float64 * np.abs(single.position).max()
        assert batch.position[index] == pytest.approx(single.position, rel=0, abs=tolerance)
        np.testing.assert_array_equal(batch.time[index], single.time)
    assert np.isnan(batch.tip_position[[0, 2]]).all()
    assert np.isfinite(batch.tip_position[1]).all()


@pytest.mark.parametrize(("tip", "delay"), [(None, 1.3e-3), (zwidth.Coupling(0.05, 2e3, 0.1), 0.5e-3)])
def test_large_batch_with_friction_matches_single_simulations(tip, delay):
    """Entries in which friction stops or releases the device within a period are integrated separately."""
    scene = zwidth.Scene(zwidth.Device(0.1, 0.1, tip), zwidth.Timing(1e-3, delay))
    walls = np.linspace(200.0, 4e3, 80), np.linspace(0.0, 20.0, 80)
    friction = {"coulomb": 0.05, "static": 0.08, "substeps": 2}
    batch = run(scene, stiffness=walls[0], virtual_damping=walls[1], **friction)
    for index in (0, 17, 40, 63, 79):
        single = run(scene, stiffness=walls[0][index], virtual_damping=walls[1][index], **friction)
        n_reversals = np.count_nonzero(np.diff(np.sign(single.velocity)))
        assert n_reversals > 1
        for name in ("position", "velocity", "energy"):
            assert_same_motion(getattr(batch, name)[index], getattr(single, name), name)


# Integer delays in one batch, fractional delays in another: each compiles its own program.
@pytest.mark.parametrize("delays", [(0.0, 1.0, 100.0), (0.3, 2.75)], ids=["integer", "fractional"])
def test_command_acts_after_the_delay_at_any_number_of_substeps(delays):
    scenes = [zwidth.Scene(SCENE.device, zwidth.Timing(1e-3, delay * 1e-3)) for delay in delays]
    fine, coarse = run(scenes, substeps=20, stiffness=100.0), run(scenes, stiffness=100.0)
    for k, delay in enumerate(delays):
        n_substeps = round(20 * delay)
        expected = np.append(np.zeros(n_substeps), np.repeat(fine.command[k], 20))[: 20 * 200]
        # The compiled programs may use fused multiply-add differently.
        np.testing.assert_allclose(fine.wall_force[k], expected, rtol=1e-12, atol=1e-15 * np.abs(expected).max())
        for name in ("position", "velocity", "energy", "wall_work", "damping_loss"):
            value = getattr(coarse, name)[k]
            assert getattr(fine, name)[k, ::20] == pytest.approx(value, rel=0, abs=1e-12 * np.abs(value).max())


def test_velocity_estimate_is_exact_from_the_first_sample():
    # One batch compiles one program for the linear estimates and one for the adaptive estimate.
    velocities = (
        zwidth.BackwardDifference(),
        zwidth.WindowedDifference(15),
        zwidth.LowPass(time_constant=0.3, order=2),
        zwidth.Butterworth(25.0, 4),
        zwidth.VelocityFilter([900.0, -900.0], [1.0, -0.999]),
        zwidth.VelocityFilter([1000.0, -999.0], [1.0, 0.0, 0.0]),
        zwidth.FOAW(1e-6, 12),
    )
    scenes = [
        zwidth.Scene(zwidth.Device(0.1, 0.0), zwidth.Timing(1e-3, 0.0), velocity=velocity) for velocity in velocities
    ]
    motions = run(scenes, stiffness=0.0, virtual_damping=0.0, start_position=2e-3, start_velocity=0.05)
    for scene, estimated in zip(scenes, motions.estimated_velocity, strict=True):
        expected = np.full(200, 0.05)
        if isinstance(scene.velocity, zwidth.VelocityFilter):
            numerator, denominator = velocity_polynomials(scene)
            expected = scipy.signal.lfilter(numerator, denominator, 2e-3 + 5e-5 * np.arange(-60_000, 200))[-200:]
        assert estimated == pytest.approx(expected, rel=1e-10), scene.velocity


def test_velocity_filters_match_scipy():
    velocities = zwidth.LowPass(cutoff=40.0), zwidth.Butterworth(60.0, 3), zwidth.WindowedDifference(7)
    scenes = [zwidth.Scene(SCENE.device, SCENE.timing, velocity=velocity) for velocity in velocities]
    motions = run(scenes, noise=1e-4, resolution=3e-5, start_position=9e-5)
    for scene, measured, estimated in zip(scenes, motions.measured, motions.estimated_velocity, strict=True):
        numerator, denominator = velocity_polynomials(scene)
        past = scipy.signal.lfilter_zi(numerator, denominator) * 9e-5
        expected, _ = scipy.signal.lfilter(numerator, denominator, measured, zi=past)
        assert estimated == pytest.approx(expected, rel=0, abs=1e-11 * np.abs(expected).max())


def estimate_foaw(counts, bound, longest):
    """Return the FOAW estimate as published, in exact arithmetic; the newest position is last."""
    newest, slope = counts[-1], counts[-1] - counts[-2]
    for window in range(1, longest + 1):
        candidate = (newest - counts[-1 - window]) / window
        if any(abs(counts[-1 - back] - (newest - candidate * back)) > bound for back in range(1, window)):
            break
        slope = candidate
    return slope


def test_adaptive_windows_match_the_published_algorithm():
    quantum, bound = 2.0**-17, Fraction(13, 10)
    scene = zwidth.Scene(SCENE.device, SCENE.timing, velocity=zwidth.FOAW(float(bound) * quantum, 12))
    motion = run(scene, noise=[0.0, 4e-6], resolution=quantum, start_position=40 * quantum, periods=150)
    for measured, estimates in zip(motion.measured, motion.estimated_velocity, strict=True):
        counts = [Fraction(40)] * 20 + [Fraction(round(x / quantum)) for x in measured]
        expected = [float(estimate_foaw(counts[: 21 + k], bound, 12)) * quantum / 1e-3 for k in range(150)]
        assert estimates == pytest.approx(expected, rel=1e-12)


def test_quantization_rounds_half_up_and_noise_has_its_deviation():
    scene = zwidth.Scene(zwidth.Device(1e9, 0.0), zwidth.Timing(1e-3, 0.0))
    start = np.array([-1.5, -0.5, -0.49, 0.49, 0.5, 1.49]) * 2.0**-10
    steps = run(scene, stiffness=0.0, virtual_damping=0.0, start_position=start, resolution=2.0**-10).measured[:, 0]
    np.testing.assert_array_equal(steps * 2.0**10, [-1, 0, 0, 0, 1, 1])
    noisy = run(scene, stiffness=0.0, virtual_damping=0.0, start_position=0.0, noise=1e-6, seed=[1, 2, 1], periods=4000)
    np.testing.assert_array_equal(noisy.measured[0], noisy.measured[2])
    # Five standard errors of the mean and of the standard deviation of 4,000 samples.
    assert np.abs(noisy.measured.mean(1)).max() < 5e-6 / np.sqrt(4000)
    assert noisy.measured.std(1) == pytest.approx(1e-6, rel=5 / np.sqrt(8000))
    assert abs(np.corrcoef(noisy.measured[:2])[0, 1]) < 5 / np.sqrt(4000)


def test_commands_respect_force_and_rate_limits():
    force, rate = np.array([0.1, 1.0, 2.5]), np.array([1e4, 30.0, 300.0])
    motion = run(stiffness=4e4, max_force=force, max_rate=rate, noise=1e-5)
    steps = np.diff(motion.command, axis=1, prepend=0.0)
    assert np.all(np.abs(motion.command).max(1) <= force * (1 + 1e-15))
    assert np.abs(steps).max(1) == pytest.approx(np.minimum(rate * 1e-3, 2 * force), rel=1e-10)


def test_contact_modes():
    options = {"stiffness": 1e4, "virtual_damping": 40.0, "start_position": -1e-3, "start_velocity": [0.3, 0.8]}
    bilateral, unilateral, push_only = (
        run(contact=name, **options) for name in ("bilateral", "unilateral", "push_only")
    )
    assert bilateral.contact.all()
    for motion in (unilateral, push_only):
        np.testing.assert_array_equal(motion.contact, motion.measured > 0)
        assert not np.any(motion.command[~motion.contact])
    assert unilateral.command.max() > 0
    assert push_only.command.max() == 0
    first = unilateral.contact.argmax(1)[:, None]
    np.testing.assert_array_equal(unilateral.impact_velocity, np.take_along_axis(unilateral.velocity, first, 1)[:, 0])
    np.testing.assert_array_equal(
        unilateral.bounces, np.sum(unilateral.contact[:, :-1] & ~unilateral.contact[:, 1:], 1)
    )
    np.testing.assert_array_equal(unilateral.penetration, np.maximum(unilateral.position.max(1), 0))


def test_energy_given_is_the_work_of_the_wall_force():
    """A device at rest in the wall has lost all its energy; an unstable wall supplies energy without limit."""
    scene = SCENE.replace(delay=1e-3)
    motion = run(scene, stiffness=[300.0, 1200.0, 4000.0], start_velocity=0.1, start_position=0.0, contact="unilateral")
    work = np.cumsum(motion.wall_force[:, :-1] * np.diff(motion.position), axis=1)
    np.testing.assert_allclose(motion.wall_work[:, 1:], work, rtol=0, atol=1e-12 * np.abs(work).max())
    np.testing.assert_allclose(motion.wall_work_max[:2], np.maximum(work[:2].max(1), 0.0), rtol=1e-9, atol=1e-15)
    assert motion.wall_work_max[1] > 1e-6
    assert motion.wall_work_max[2] >= work[2].max() > 1e-4


@pytest.mark.parametrize("periods", [17, 128, 129, 300])
def test_results_without_recording_are_the_same(periods):
    options = {"stiffness": [300.0, 4000.0], "contact": "unilateral", "start_velocity": 0.1, "periods": periods}
    recorded, unrecorded = run(**options), run(record=False, **options)
    assert unrecorded.position is None
    for name in RESULTS:
        assert_same_motion(getattr(recorded, name), getattr(unrecorded, name), name)
    assert_same_motion(recorded.position, run(**{**options, "periods": 300}).position[:, :periods], "position")


def test_frequency_is_that_of_the_dominant_pole_at_any_end_time():
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(1e-4, 0.0))
    poles = scene.poles(5e4, 1.0)
    expected = np.abs(np.angle(poles[np.argmax(np.abs(poles))])) / (2 * np.pi * 1e-4)
    velocity = run(scene, stiffness=5e4, virtual_damping=1.0, periods=2000).velocity
    zero_crossings = np.flatnonzero((velocity[:-1] <= 0) & (velocity[1:] > 0))
    for periods in (zero_crossings[-1], zero_crossings[-1] + 1):
        motion = run(scene, stiffness=5e4, virtual_damping=1.0, periods=int(periods), record=False)
        assert motion.frequency == pytest.approx(expected, rel=1e-6)


def test_jitter_is_bounded_and_vanishes_continuously():
    exact, small, large = (run(jitter=jitter_size) for jitter_size in (0.0, 1e-15, 9e-4))
    assert small.position == pytest.approx(exact.position, rel=0, abs=1e-12)
    lateness = large.time - exact.time
    assert lateness[0] == 0.0
    assert lateness.min() >= 0.0
    assert 8e-4 < lateness.max() < 9e-4
    np.testing.assert_array_equal(large.position, run(jitter=9e-4).position)
    assert np.any(large.position != run(jitter=9e-4, seed=1).position)


@pytest.mark.parametrize("delay", [0.0, 0.6, 2.3])
def test_commands_with_jitter_act_after_the_delay_of_their_samples(delay):
    scene = SCENE.replace(delay=delay * 1e-3)
    motion = run(scene, jitter=[9e-4, 4e-4], stiffness=900.0, substeps=40, seed=[0, 1])
    for time, force, command in zip(motion.time, motion.wall_force, motion.command, strict=True):
        starts = time[::40] + delay * 1e-3
        newest = np.searchsorted(starts, time * (1 + 1e-12), side="right") - 1
        np.testing.assert_allclose(force, np.where(newest >= 0, command[newest], 0.0), rtol=1e-12)


def test_undamped_frequency_and_outcomes_of_known_motions():
    scene = zwidth.Scene(zwidth.Device(0.1, 0.0), zwidth.Timing(1e-4, 0.0))
    oscillation = run(scene, stiffness=50.0, virtual_damping=0.0, periods=16_000, tail=12_000, record=False)
    assert oscillation.frequency == pytest.approx(np.sqrt(500.0) / (2 * np.pi), rel=1e-6)
    best = SCENE.max_stiffness()
    share = np.array([0.5, 1.2, 1.5])
    # A tail with two oscillations in each half.
    wall = {"stiffness": share * best.stiffness, "virtual_damping": best.virtual_damping, "record": False}
    motion = run(**wall, periods=64, tail=52)
    assert [zwidth.MotionKind(code).name for code in motion.outcome] == ["DECAYING", "GROWING", "GROWING"]
    long = run(**wall, periods=9000)
    assert [zwidth.MotionKind(code).name for code in long.outcome] == ["REST", "DIVERGED", "DIVERGED"]
    limited = run(stiffness=1.2 * best.stiffness, virtual_damping=best.virtual_damping, max_force=1.0, periods=9000)
    assert zwidth.MotionKind(limited.outcome) == zwidth.MotionKind.STEADY
