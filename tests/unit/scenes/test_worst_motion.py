"""The worst motion: its energy by other means, and walls on either side of what is called passive."""

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from independent_scenes import random_scene, velocity_polynomials
from tolerances import WORST_ENERGY, WORST_NEED

import zwidth
from zwidth.scenes import worst_motion
from zwidth.words.errors import InputError
from zwidth.words.status import Status

KINDS = ["rigid", "filter", "hand", "coupled hand", "motor"]


def scene_of(kind, rng, delay=None):
    """A random scene whose device has damping, and a wall's direction."""
    scene = random_scene(kind, rng)
    period = scene.timing.period
    delay = rng.choice([0, 1, 2, 3, 0.3, 0.5, 1.6, 2.95]) if delay is None else delay
    device = zwidth.Device(scene.device.mass, 10 ** rng.uniform(-1, 1.5), scene.device.coupling)
    scene = zwidth.Scene(
        device, zwidth.Timing(period, delay * period), velocity=scene.velocity, operator=scene.operator
    )
    angle = rng.uniform(-0.5, 0.5) * np.pi
    return scene, (np.cos(angle) * device.damping / period, np.sin(angle) * device.damping)


def scaled(scene, wall, share):
    """The wall that needs this share of the device's damping."""
    needed = scene.device.damping - float(scene.passivity_margin(*wall))
    factor = share * scene.device.damping / needed
    return wall[0] * factor, wall[1] * factor


def answers(scene, wall, x):
    """What the wall answers to sampled positions along the first axis, by the estimate's coefficients."""
    top, bottom = velocity_polynomials(scene)
    top = np.concatenate([np.zeros(len(bottom) - len(top)), top])
    return wall[0] * x + wall[1] * scipy.signal.lfilter(top, bottom, x, axis=0)


def late(values, count):
    return np.concatenate([np.zeros_like(values[:count]), values])[: len(values)]


def forms(scene, wall, periods):
    """Work on the wall and integral of v^2 as quadratic forms of the positions, those at which forces arrive last."""
    f, period, n = scene.d - scene.whole_delay, scene.timing.period, periods
    held = f > 0
    unit = np.eye(n * (2 if held else 1))
    x = np.concatenate([np.zeros((1, unit.shape[1])), unit[:n]])
    now = late(answers(scene, wall, x), scene.whole_delay)
    if not held:
        steps, forces, times = [np.diff(x, axis=0)], [now[:-1]], [period]
    else:
        y = unit[n:]
        steps, forces = [y - x[:-1], x[1:] - y], [late(now, 1)[:-1], now[:-1]]
        times = [f * period, (1 - f) * period]
    work = np.concatenate(forces).T @ np.concatenate(steps)
    square = np.sum([step.T @ step / time for step, time in zip(steps, times, strict=True)], axis=0)
    return (work + work.T) / 2, square


def least_damping(scene, wall, periods):
    """The damping without which some motion of so many periods gives energy."""
    work, square = forms(scene, wall, periods)
    return -scipy.linalg.eigh(work, square, eigvals_only=True, subset_by_index=[0, 0])[0]


def energy_by_quadrature(scene, wall, motion):
    """Gauss-Legendre over pieces of the motion as interpolated from its positions, samples taken from it."""
    period, d = scene.timing.period, scene.d
    samples = np.interp(period * np.arange(round(motion.time[-1] / period)), motion.time, motion.position)
    answer = answers(scene, wall, samples)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    start, length = motion.time[:-1, None], np.diff(motion.time)[:, None]
    t = start + length * (nodes + 1) / 2
    v = np.broadcast_to(np.diff(motion.position)[:, None] / length, t.shape)
    which = np.floor(t / period - d).astype(int)
    force = -np.where(which >= 0, answer[np.maximum(which, 0)], 0.0)
    power = (scene.device.damping * v - force) * v
    size = (scene.device.damping * v * v + np.abs(force * v)) * weights * length / 2
    return (power * weights * length / 2).sum(), size.sum()


@pytest.mark.parametrize("kind", KINDS)
def test_walls_on_either_side_of_the_passive_set(kind):
    rng = np.random.default_rng(1)
    for excess in (1e-5, 1e-3, 0.1, 10.0) * 4:
        scene, wall = scene_of(kind, rng)
        active = scaled(scene, wall, 1 + excess)
        motion = zwidth.worst_motion(scene, *active)
        assert motion.status == Status.OK
        assert not scene.is_passive(*active)
        energy, size = energy_by_quadrature(scene, active, motion)
        assert energy < 0
        assert abs(energy - motion.energy[-1]) < WORST_ENERGY.float64 * size
        assert 0 < motion.missing_damping < excess * scene.device.damping * (1 + 1e-6)
        passive = scaled(scene, wall, 1 / (1 + excess))
        assert scene.is_passive(*passive)
        none = zwidth.worst_motion(scene, *passive)
        assert none.status == Status.UNREACHABLE
        assert all(np.isnan(part).all() for part in none[:-1])


@pytest.mark.parametrize("kind", KINDS)
def test_no_motion_of_a_passive_wall_gives_energy(kind):
    """What the worst of all motions of N periods needs rises with N to what the condition asks for, and not above."""
    rng = np.random.default_rng(2)
    for _ in range(6):
        scene, wall = scene_of(kind, rng)
        needed = scene.device.damping - float(scene.passivity_margin(*wall))
        found = [least_damping(scene, wall, periods) for periods in (40, 80, 160)]
        assert found == sorted(found)
        assert found[-1] <= needed * (1 + WORST_NEED.float64)
        # The rest falls with the square of N, so that a sequence of doubled lengths can be extended.
        assert needed - found[-1] < 0.6 * (needed - found[0])


@pytest.mark.parametrize("kind", KINDS)
def test_random_motions_of_passive_walls_never_give_energy(kind):
    rng = np.random.default_rng(3)
    for _ in range(5):
        scene, wall = scene_of(kind, rng)
        wall = scaled(scene, wall, 1 - 1e-9)
        work, square = forms(scene, wall, 80)
        # White, slow and resonant motions.
        x = rng.normal(size=(len(work), 200))
        x[:, 70:140] = np.cumsum(x[:, 70:140], 0)
        x[:, 140:] *= np.cos(np.arange(len(work))[:, None] * rng.uniform(0, np.pi, 60))
        assert np.all(np.einsum("ik,ij,jk->k", x, work + scene.device.damping * square, x) > 0)


def test_a_filter_that_is_all_but_a_difference_loses_no_digits():
    # Eight poles next to -1, each beside a zero: in a row they would amplify what was rounded off before.
    scene = zwidth.Scene(
        zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 20.25e-3), velocity=zwidth.Butterworth(cutoff=499, order=8)
    )
    wall = scaled(scene, (0.0, 30.0), 1 + 1e-4)
    motion = zwidth.worst_motion(scene, *wall)
    assert motion.status == Status.OK
    assert motion.missing_damping < 1e-3 * (1 + 1e-6)


def test_without_delay_the_threshold_is_that_of_the_paper():
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3))
    for share in (1 - 1e-5, 1 + 1e-5):
        for B in (-8.0, -1e-3, 0.0, 4.0):
            K = 2 * (10.0 - abs(B)) / 1e-3
            found = zwidth.worst_motion(scene, share * K, share * B)
            assert found.status == (Status.OK if share > 1 else Status.UNREACHABLE)
            if share > 1 and B:
                assert found.frequency == pytest.approx(500.0 if B > 0 else 0.0, abs=1e-3)


def test_the_frequency_is_where_the_most_damping_is_needed():
    # d = 1, by hand: alpha sin(3 w/2)/sin(w/2)/2 - beta cos 2 w is highest where 2 beta sin 2 w = alpha sin w.
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1e-3))
    found = zwidth.worst_motion(scene, 8e3, 30.0)
    assert found.frequency == pytest.approx(np.arccos(0.08 / (4 * 0.3)) / (2 * np.pi * 1e-3), rel=1e-6)


def test_what_is_returned_is_one_motion():
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.3e-3), velocity=zwidth.LowPass(cutoff=80))
    motion = zwidth.worst_motion(scene, 9e3, 20.0)
    assert len({len(part) for part in motion[:5]}) == 1
    assert motion.time[0] == motion.position[0] == motion.position[-1] == motion.energy[0] == motion.velocity[-1] == 0
    assert np.max(np.abs(motion.position[::2])) == pytest.approx(1e-3, rel=1e-12)
    lasting = np.diff(motion.time)
    np.testing.assert_allclose(np.diff(motion.position), motion.velocity[:-1] * lasting, rtol=1e-9, atol=1e-18)
    power = (10.0 * motion.velocity - motion.force)[:-1] * motion.velocity[:-1]
    np.testing.assert_allclose(np.cumsum(power * lasting), motion.energy[1:], rtol=1e-9, atol=1e-15)
    # With that much more damping the same motion gives nothing.
    held = np.sum(motion.velocity[:-1] ** 2 * lasting)
    assert motion.energy[-1] + motion.missing_damping * held == pytest.approx(0, abs=1e-15)


def test_walls_that_push():
    for delay, velocity in ((0.0, zwidth.BackwardDifference()), (1.6e-3, zwidth.Butterworth(100, 3))):
        scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, delay), velocity=velocity)
        for wall in ((-50.0, 0.0), (-1.0, 5.0), (-0.5, -9.0), (-100.0, 300.0)):
            motion = zwidth.worst_motion(scene, *wall)
            assert motion.status == Status.OK
            assert energy_by_quadrature(scene, wall, motion)[0] == pytest.approx(motion.energy[-1], rel=1e-6)
    # An estimate that answers a position at rest is a spring as well.
    tilted = zwidth.Scene(
        zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3), velocity=zwidth.VelocityFilter([1000.0, -999.0], [1.0, 0.0])
    )
    assert zwidth.worst_motion(tilted, 3.0, -5.0).status == Status.OK
    assert zwidth.worst_motion(tilted, 8.0, -5.0).status == Status.UNREACHABLE


def test_nothing_is_given_without_a_wall_or_on_the_edge():
    for damping in (0.0, 10.0):
        scene = zwidth.Scene(zwidth.Device(0.1, damping), zwidth.Timing(1e-3, 1.4e-3))
        assert zwidth.worst_motion(scene, 0.0).status == Status.UNREACHABLE
    # No damping at all: every wall gives energy.
    assert zwidth.worst_motion(scene.replace(damping=0.0), 1.0, 1e-3).status == Status.OK


def test_too_short_a_motion_is_not_taken_for_a_proof(monkeypatch):
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 5e-3))
    wall = scaled(scene, (8e3, 3.0), 1 + 1e-6)
    with monkeypatch.context() as patched:
        patched.setattr(worst_motion, "_LONGEST", 64)
        short = zwidth.worst_motion(scene, *wall)
    assert short.status == Status.NOT_CONVERGED
    assert np.isnan(short.missing_damping)
    # Beyond what rounding lets be told.
    wall = scaled(scene, (8e3, 3.0), 1 + 1e-14)
    assert zwidth.worst_motion(scene, *wall).status != Status.OK


def test_energy_that_rounding_can_come_to_is_no_proof():
    # Every frequency lacks the same 1e-15 of the damping.
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3))
    stiffness = 20e3 * (1 + 1e-15)
    assert scene.passivity_margin(stiffness) < 0
    assert zwidth.worst_motion(scene, stiffness).status == Status.NOT_CONVERGED
    assert zwidth.worst_motion(scene, 20e3 * (1 + 1e-12)).status == Status.OK


def test_what_is_refused():
    scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3))
    with pytest.raises(InputError, match="stiffness: got nan; a finite number"):
        zwidth.worst_motion(scene, np.nan)
    with pytest.raises(InputError, match="one wall of finite numbers"):
        zwidth.worst_motion(scene, [1.0, 2.0])  # pyright: ignore[reportArgumentType]
    coupling = zwidth.Coupling(0.05, 20e3, 1.0, "tip")
    with pytest.raises(InputError, match="with the sensor at the tip: there is no passivity condition"):
        zwidth.worst_motion(zwidth.Scene(zwidth.Device(0.1, 10.0, coupling), zwidth.Timing(1e-3)), 1e3)
    assert zwidth.worst_motion(scene, 1e200).status == Status.OUT_OF_RANGE


def test_no_motion_misses_more_than_the_margin_says_negative_stiffness_included():
    rng = np.random.default_rng(8)
    for _ in range(60):
        scene = zwidth.Scene(zwidth.Device(0.1, rng.uniform(0.01, 5)), zwidth.Timing(1e-3, rng.choice([0, 5e-4, 1e-3])))
        wall = -(10 ** rng.uniform(-0.5, 4)), rng.uniform(-5, 5)
        found = zwidth.worst_motion(scene, *wall)
        assert found.status == Status.OK
        assert found.missing_damping <= -scene.passivity_margin(*wall) * (1 + 1e-6)
