"""What a simulation is given, and what of it hangs on what: shapes, bad numbers, neighbors, seeds, limits."""

from fractions import Fraction

import numpy as np
import pytest
import scipy.signal
from any_loop import velocity_polynomials
from tolerances import SIMULATED_AGAIN

import zwidth
from zwidth.core.errors import InputError, ResourceError

SCENE = zwidth.Scene(zwidth.Device(mass=0.1, damping=2.0), zwidth.Timing(period=1e-3, delay=1.3e-3))
FIGURES = ("amplitude", "frequency", "penetration", "bounces", "impact_velocity", "wall_work_max", "outcome", "status")


def run(*args, **options):
    scenes = args or (SCENE,)
    known = {"stiffness": 500.0, "virtual_damping": 2.0, "periods": 200, "start_position": 1e-3, **options}
    return zwidth.simulate(*scenes, **known)


def assert_again(got, expected, name):
    """The same motion in a batch or a program of another size: labels as they are, numbers but for their rounding."""
    if expected.dtype.kind in "bi":
        np.testing.assert_array_equal(got, expected, err_msg=name)
    else:
        close = SIMULATED_AGAIN.float64 * np.nan_to_num(np.abs(expected)).max()
        np.testing.assert_allclose(got, expected, rtol=0, atol=close, err_msg=name)


@pytest.mark.parametrize(
    ("options", "word"),
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
def test_bad_input_is_named(options, word):
    with pytest.raises(InputError, match=word):
        run(**options)


def test_more_than_the_memory_is_refused():
    with pytest.raises(ResourceError, match="record=False"):
        run(stiffness=np.ones(10_000), periods=100_000)
    with pytest.raises(ResourceError, match="fewer periods"):
        run(stiffness=np.ones(10_000), periods=1_000_000, jitter=1e-5, record=False)


def test_a_bad_number_spoils_no_neighbor():
    stiffness = np.array([400.0, np.nan, 900.0, np.inf])
    both, good = run(stiffness=stiffness), run(stiffness=stiffness[[0, 2]])
    np.testing.assert_array_equal(both.status, [0, 1, 0, 1])
    assert np.isnan(both.position[1]).all()
    assert np.isnan(both.amplitude[3])
    for name in ("position", "command", "energy", *FIGURES):
        assert_again(getattr(both, name)[[0, 2]], getattr(good, name), name)


def test_scenes_of_different_periods_and_bodies_move_in_a_batch_as_alone():
    soft = zwidth.Device(0.1, 2.0, zwidth.Coupling(0.05, 2e3, 0.1))
    scenes = [
        SCENE,
        zwidth.Scene(soft, zwidth.Timing(5e-4, 0.0)),
        zwidth.Scene(SCENE.device, zwidth.Timing(2e-4, 2e-2), velocity=zwidth.WindowedDifference(8)),
    ]
    options = {"noise": 1e-6, "resolution": 1e-6, "contact": "unilateral", "max_force": 2.0}
    together = run(scenes, seed=[3, 4, 5], **options)
    for place, scene in enumerate(scenes):
        alone = run(scene, seed=3 + place, **options)
        close = SIMULATED_AGAIN.float64 * np.abs(alone.position).max()
        assert together.position[place] == pytest.approx(alone.position, rel=0, abs=close)
        np.testing.assert_array_equal(together.time[place], alone.time)
    assert np.isnan(together.tip_position[[0, 2]]).all()
    assert np.isfinite(together.tip_position[1]).all()


@pytest.mark.parametrize(("tip", "delay"), [(None, 1.3e-3), (zwidth.Coupling(0.05, 2e3, 0.1), 0.5e-3)])
def test_many_walls_on_friction_move_as_alone(tip, delay):
    """Those that friction stops or lets go in a period go on by themselves; all others take it in one step."""
    scene = zwidth.Scene(zwidth.Device(0.1, 0.1, tip), zwidth.Timing(1e-3, delay))
    walls = np.linspace(200.0, 4e3, 80), np.linspace(0.0, 20.0, 80)
    rough = {"coulomb": 0.05, "static": 0.08, "substeps": 2}
    together = run(scene, stiffness=walls[0], virtual_damping=walls[1], **rough)
    for place in (0, 17, 40, 63, 79):
        alone = run(scene, stiffness=walls[0][place], virtual_damping=walls[1][place], **rough)
        turns = np.count_nonzero(np.diff(np.sign(alone.velocity)))
        assert turns > 1
        for name in ("position", "velocity", "energy"):
            assert_again(getattr(together, name)[place], getattr(alone, name), name)


# Those of whole periods side by side, and those that act within one: a program for each.
@pytest.mark.parametrize("delays", [(0.0, 1.0, 100.0), (0.3, 2.75)], ids=["whole", "within"])
def test_a_command_acts_its_delay_later_and_substeps_change_nothing(delays):
    scenes = [zwidth.Scene(SCENE.device, zwidth.Timing(1e-3, delay * 1e-3)) for delay in delays]
    fine, coarse = run(scenes, substeps=20, stiffness=100.0), run(scenes, stiffness=100.0)
    for k, delay in enumerate(delays):
        late = round(20 * delay)
        expected = np.append(np.zeros(late), np.repeat(fine.command[k], 20))[: 20 * 200]
        # Of two compiled programs: one may round a product and a sum once where the other does twice.
        np.testing.assert_allclose(fine.wall_force[k], expected, rtol=1e-12, atol=1e-15 * np.abs(expected).max())
        for name in ("position", "velocity", "energy", "wall_work", "damping_loss"):
            value = getattr(coarse, name)[k]
            assert getattr(fine, name)[k, ::20] == pytest.approx(value, rel=0, abs=1e-12 * np.abs(value).max())


def test_the_estimate_is_right_from_the_first_sample_of_a_device_that_comes_on_a_line():
    # In one batch, which compiles a program for the linear ones and one for the adaptive one.
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
            top, bottom = velocity_polynomials(scene)
            expected = scipy.signal.lfilter(top, bottom, 2e-3 + 5e-5 * np.arange(-60_000, 200))[-200:]
        assert estimated == pytest.approx(expected, rel=1e-10), scene.velocity


def test_filters_are_those_of_scipy_on_what_was_measured():
    velocities = zwidth.LowPass(cutoff=40.0), zwidth.Butterworth(60.0, 3), zwidth.WindowedDifference(7)
    scenes = [zwidth.Scene(SCENE.device, SCENE.timing, velocity=velocity) for velocity in velocities]
    motions = run(scenes, noise=1e-4, resolution=3e-5, start_position=9e-5)
    for scene, measured, estimated in zip(scenes, motions.measured, motions.estimated_velocity, strict=True):
        top, bottom = velocity_polynomials(scene)
        past = scipy.signal.lfilter_zi(top, bottom) * 9e-5
        expected, _ = scipy.signal.lfilter(top, bottom, measured, zi=past)
        assert estimated == pytest.approx(expected, rel=0, abs=1e-11 * np.abs(expected).max())


def fit_ends(counts, bound, longest):
    """FOAW as published, in exact numbers: the newest position last."""
    newest, slope = counts[-1], counts[-1] - counts[-2]
    for window in range(1, longest + 1):
        tried = (newest - counts[-1 - window]) / window
        if any(abs(counts[-1 - back] - (newest - tried * back)) > bound for back in range(1, window)):
            break
        slope = tried
    return slope


def test_adaptive_windows_are_those_of_the_published_algorithm():
    quantum, bound = 2.0**-17, Fraction(13, 10)
    scene = zwidth.Scene(SCENE.device, SCENE.timing, velocity=zwidth.FOAW(float(bound) * quantum, 12))
    motion = run(scene, noise=[0.0, 4e-6], resolution=quantum, start_position=40 * quantum, periods=150)
    for measured, estimates in zip(motion.measured, motion.estimated_velocity, strict=True):
        counts = [Fraction(40)] * 20 + [Fraction(round(x / quantum)) for x in measured]
        expected = [float(fit_ends(counts[: 21 + k], bound, 12)) * quantum / 1e-3 for k in range(150)]
        assert estimates == pytest.approx(expected, rel=1e-12)


def test_measured_positions_are_rounded_halves_up_and_noise_is_what_was_asked_for():
    scene = zwidth.Scene(zwidth.Device(1e9, 0.0), zwidth.Timing(1e-3, 0.0))
    start = np.array([-1.5, -0.5, -0.49, 0.49, 0.5, 1.49]) * 2.0**-10
    steps = run(scene, stiffness=0.0, virtual_damping=0.0, start_position=start, resolution=2.0**-10).measured[:, 0]
    np.testing.assert_array_equal(steps * 2.0**10, [-1, 0, 0, 0, 1, 1])
    noisy = run(scene, stiffness=0.0, virtual_damping=0.0, start_position=0.0, noise=1e-6, seed=[1, 2, 1], periods=4000)
    np.testing.assert_array_equal(noisy.measured[0], noisy.measured[2])
    # Five standard deviations of a mean and of a standard deviation from 4,000 draws.
    assert np.abs(noisy.measured.mean(1)).max() < 5e-6 / np.sqrt(4000)
    assert noisy.measured.std(1) == pytest.approx(1e-6, rel=5 / np.sqrt(8000))
    assert abs(np.corrcoef(noisy.measured[:2])[0, 1]) < 5 / np.sqrt(4000)


def test_motor_limits_hold_for_every_command():
    force, rate = np.array([0.1, 1.0, 2.5]), np.array([1e4, 30.0, 300.0])
    motion = run(stiffness=4e4, max_force=force, max_rate=rate, noise=1e-5)
    steps = np.diff(motion.command, axis=1, prepend=0.0)
    assert np.all(np.abs(motion.command).max(1) <= force * (1 + 1e-15))
    assert np.abs(steps).max(1) == pytest.approx(np.minimum(rate * 1e-3, 2 * force), rel=1e-10)


def test_contact_is_what_its_name_says():
    options = {"stiffness": 1e4, "virtual_damping": 40.0, "start_position": -1e-3, "start_velocity": [0.3, 0.8]}
    both, one, push = (run(contact=name, **options) for name in ("bilateral", "unilateral", "push_only"))
    assert both.contact.all()
    for motion in (one, push):
        np.testing.assert_array_equal(motion.contact, motion.measured > 0)
        assert not np.any(motion.command[~motion.contact])
    assert one.command.max() > 0
    assert push.command.max() == 0
    first = one.contact.argmax(1)[:, None]
    np.testing.assert_array_equal(one.impact_velocity, np.take_along_axis(one.velocity, first, 1)[:, 0])
    np.testing.assert_array_equal(one.bounces, np.sum(one.contact[:, :-1] & ~one.contact[:, 1:], 1))
    np.testing.assert_array_equal(one.penetration, np.maximum(one.position.max(1), 0))


def test_the_energy_that_the_wall_gives_is_its_held_force_times_the_way():
    """At rest in the wall it has taken all of it, beyond the stable ones it gives more and more."""
    scene = SCENE.replace(delay=1e-3)
    motion = run(scene, stiffness=[300.0, 1200.0, 4000.0], start_velocity=0.1, start_position=0.0, contact="unilateral")
    work = np.cumsum(motion.wall_force[:, :-1] * np.diff(motion.position), axis=1)
    np.testing.assert_allclose(motion.wall_work[:, 1:], work, rtol=0, atol=1e-12 * np.abs(work).max())
    np.testing.assert_allclose(motion.wall_work_max[:2], np.maximum(work[:2].max(1), 0.0), rtol=1e-9, atol=1e-15)
    assert motion.wall_work_max[1] > 1e-6
    assert motion.wall_work_max[2] >= work[2].max() > 1e-4


@pytest.mark.parametrize("periods", [17, 128, 129, 300])
def test_what_is_said_of_a_motion_is_the_same_unrecorded(periods):
    options = {"stiffness": [300.0, 4000.0], "contact": "unilateral", "start_velocity": 0.1, "periods": periods}
    kept, told = run(**options), run(record=False, **options)
    assert told.position is None
    for name in FIGURES:
        assert_again(getattr(kept, name), getattr(told, name), name)
    assert_again(kept.position, run(**{**options, "periods": 300}).position[:, :periods], "position")


def test_the_frequency_is_that_of_the_slowest_pole_also_if_the_end_is_where_the_velocity_turns():
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(1e-4, 0.0))
    poles = scene.poles(5e4, 1.0)
    expected = np.abs(np.angle(poles[np.argmax(np.abs(poles))])) / (2 * np.pi * 1e-4)
    velocity = run(scene, stiffness=5e4, virtual_damping=1.0, periods=2000).velocity
    turns = np.flatnonzero((velocity[:-1] <= 0) & (velocity[1:] > 0))
    for periods in (turns[-1], turns[-1] + 1):
        motion = run(scene, stiffness=5e4, virtual_damping=1.0, periods=int(periods), record=False)
        assert motion.frequency == pytest.approx(expected, rel=1e-6)


def test_jitter_is_late_by_less_than_asked_and_none_is_the_limit_of_little():
    exact, little, much = (run(jitter=late) for late in (0.0, 1e-15, 9e-4))
    assert little.position == pytest.approx(exact.position, rel=0, abs=1e-12)
    late = much.time - exact.time
    assert late[0] == 0.0
    assert late.min() >= 0.0
    assert 8e-4 < late.max() < 9e-4
    np.testing.assert_array_equal(much.position, run(jitter=9e-4).position)
    assert np.any(much.position != run(jitter=9e-4, seed=1).position)


@pytest.mark.parametrize("delay", [0.0, 0.6, 2.3])
def test_late_samples_command_forces_that_act_their_delay_behind_them(delay):
    scene = SCENE.replace(delay=delay * 1e-3)
    motion = run(scene, jitter=[9e-4, 4e-4], stiffness=900.0, substeps=40, seed=[0, 1])
    for time, force, command in zip(motion.time, motion.wall_force, motion.command, strict=True):
        sets_in = time[::40] + delay * 1e-3
        newest = np.searchsorted(sets_in, time * (1 + 1e-12), side="right") - 1
        np.testing.assert_allclose(force, np.where(newest >= 0, command[newest], 0.0), rtol=1e-12)


def test_an_undamped_swing_has_its_frequency_and_known_motions_their_outcome():
    scene = zwidth.Scene(zwidth.Device(0.1, 0.0), zwidth.Timing(1e-4, 0.0))
    swing = run(scene, stiffness=50.0, virtual_damping=0.0, periods=16_000, tail=12_000, record=False)
    assert swing.frequency == pytest.approx(np.sqrt(500.0) / (2 * np.pi), rel=1e-6)
    best = SCENE.max_stiffness()
    share = np.array([0.5, 1.2, 1.5])
    # Halves of two swings each.
    wall = {"stiffness": share * best.stiffness, "virtual_damping": best.virtual_damping, "record": False}
    motion = run(**wall, periods=64, tail=52)
    assert [zwidth.MotionKind(code).name for code in motion.outcome] == ["DECAYING", "GROWING", "GROWING"]
    long = run(**wall, periods=9000)
    assert [zwidth.MotionKind(code).name for code in long.outcome] == ["REST", "DIVERGED", "DIVERGED"]
    held = run(stiffness=1.2 * best.stiffness, virtual_damping=best.virtual_damping, max_force=1.0, periods=9000)
    assert zwidth.MotionKind(held.outcome) == zwidth.MotionKind.STEADY
