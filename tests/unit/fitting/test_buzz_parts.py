"""Buzzing walls of devices with an amplifier's lag or a resonance: found, doubted, and no wall to set that shakes."""

import numpy as np
import pytest
from measured_devices import OTHERS, PERIOD, OtherDevice, TrueDevice

import zwidth
from zwidth.fitting.buzzing import Onsets
from zwidth.fitting.device_estimate import DimensionlessDevice, differentiate, name_numbers
from zwidth.fitting.words import detail_fit, summarize_fit, write_scene
from zwidth.parts.circle import circle
from zwidth.words.status import Status

VELOCITY = zwidth.BackwardDifference()
KINDS = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 2)]
LAG = TrueDevice("", 0.1, 2.0, 1e-3, (), 0.7e-3, PERIOD, 1e-5, 3.0)
MODE = TrueDevice("", 0.1, 2.0, 0.0, ((120.0, 0.03, 0.2),), 0.7e-3, PERIOD, 1e-5, 3.0)
BOTH = TrueDevice("", 0.1, 2.0, 1e-3, ((120.0, 0.03, 0.2),), 0.7e-3, PERIOD, 1e-5, 3.0)


def lay_out(lag, modes):
    """Onsets of a device, and its theta."""
    beside = [*np.log([0.8, 0.6])[:lag], *np.log([0.7, 0.03]), 0.4, *np.log([1.7, 1.2]), -0.2][: lag + 3 * modes]
    kappa, rub, w = np.array([[1e-3, 4e-3, 6e-3], [0.0, 0.01, 0.02], [0.1, 0.3, 0.4]])
    return Onsets(kappa, rub, w, VELOCITY, PERIOD, lag=lag, modes=modes), np.array([np.log(0.1), 0.03, 1.3, *beside])


def differ(function, theta):
    """Derivatives by differences, along a last axis."""
    steps = 1e-6 * np.eye(theta.size)
    return np.stack([(function(theta + step) - function(theta - step)) / 2e-6 for step in steps], -1)


@pytest.mark.parametrize("lag, modes", KINDS)
def test_what_is_needed_is_that_of_the_sampled_device(lag, modes):
    onsets, theta = lay_out(lag, modes)
    scene = onsets.normalize(theta).to_scene(PERIOD, VELOCITY)
    at = circle(np.array([1e-3, 0.05, 0.3, 0.72, 1.9, 3.0]))
    found, wanted = onsets.answer(theta).jet(at), scene.loop.roots.required_wall(at)
    np.testing.assert_allclose(found.value, wanted.value, rtol=1e-12)
    np.testing.assert_allclose(found.slope, wanted.slope, rtol=1e-12)


@pytest.mark.parametrize("lag, modes", KINDS)
def test_walls_and_numbers_move_with_theta_as_their_derivatives_say(lag, modes):
    onsets, theta = lay_out(lag, modes)

    def follow(theta):
        walls = onsets.follow(theta)
        return np.log(np.stack([walls.kappa, walls.w], 1))

    slopes = onsets.follow(theta).slopes()
    np.testing.assert_allclose(slopes, differ(follow, theta), rtol=1e-6, atol=1e-8 * np.abs(slopes).max())

    def to_numbers(theta):
        return onsets.normalize(theta).to_numbers(PERIOD)

    values, by_theta, found = to_numbers(theta), differentiate(to_numbers, theta), differ(to_numbers, theta)
    np.testing.assert_allclose(by_theta, found, rtol=1e-7, atol=1e-7 * np.abs(values).max())
    scene = DimensionlessDevice.of_numbers(np.array(values), PERIOD, lag).to_scene(PERIOD, VELOCITY)
    own = scene.parameters()
    np.testing.assert_allclose([own[name] for name in name_numbers(scene)], values, rtol=1e-15)


def begin_to_buzz(true, shares, noise=0.0, seed=0):
    """Walls at shares of the damping of the stiffest one, by eigenvalues of the true device, off by some noise."""
    A, B, C = true.sampled()
    size, rng, walls = B.size, np.random.default_rng(seed), []

    def close(stiffness, damping):
        rate, closed = damping / true.period, np.zeros((size + 1, size + 1))
        closed[:size, :size] = A - np.outer(B, (stiffness + rate) * C)
        closed[:size, size], closed[size, :size] = rate * B, C
        poles = np.linalg.eigvals(closed)
        return poles[np.argmax(np.abs(poles))]

    scene = zwidth.Scene(zwidth.LinearDevice(true.matrices()), zwidth.Timing(true.period, true.delay))
    for damping in np.array(shares) * float(scene.max_stiffness().virtual_damping):
        low, high = 1.0, 1.02
        while abs(close(high, damping)) < 1:
            low, high = high, 1.04 * high
        while high - low > 1e-14 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if abs(close(middle, damping)) < 1 else (low, middle)
        walls.append((low, damping, abs(np.angle(close(low, damping))) / (2 * np.pi * true.period)))
    return np.array(walls) * (1 + noise * np.array([1, 0, 1]) * rng.standard_normal((len(walls), 3)))


@pytest.mark.parametrize("true", [LAG, BOTH], ids=["lag", "both"])
def test_exact_walls_give_the_device_back(true):
    walls = begin_to_buzz(true, (0.0, 0.3, 0.6, 0.9, 1.1))
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=1e-6)
    assert (fit.status, fit.doubts) == (Status.OK, ())
    modes = [(mode.frequency, mode.damping_ratio, mode.mass) for mode in fit.modes]
    np.testing.assert_allclose(modes, true.modes, rtol=1e-5)
    lag = fit.actuator.time_constant if fit.actuator else 0.0
    found = [fit.mass / true.mass, fit.damping / true.damping, fit.delay / true.delay, 1 + 1e3 * (lag - true.lag)]
    np.testing.assert_allclose(found, 1.0, rtol=1e-5)
    assert fit.stiffness_max == pytest.approx(true.limit_of_walls(), rel=1e-6)
    assert set(fit.errors) == {name.removeprefix("velocity.") for name in fit.numbers}


def test_a_current_loop_of_second_order_is_found():
    true = OtherDevice.of(OTHERS["current loop of 150 Hz"])
    fit = zwidth.fit_buzz(begin_to_buzz(true, (0.0, 0.3, 0.6, 0.9, 1.1)), period=PERIOD)
    assert fit.actuator is not None
    assert fit.actuator.order == 2
    assert 1 / (2 * np.pi * fit.actuator.time_constant) == pytest.approx(150, rel=1e-4)
    assert fit.actuator.damping_ratio == pytest.approx(0.7, rel=1e-4)


@pytest.mark.parametrize("true", [LAG, MODE], ids=["lag", "mode"])
def test_walls_to_set_on_a_device_with_parts_are_stable_and_have_a_damping_that_was_tried(true):
    walls = begin_to_buzz(true, (0.0, 0.3, 0.6, 0.9, 1.1), noise=0.01, seed=1)
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=0.01)
    assert fit.is_structured
    assert not fit.is_doubted
    bar, limit = fit.intervals["stiffness_max"], true.limit_of_walls()
    assert bar.low <= limit <= bar.high
    safe, wall = fit.safe_wall(), fit.recommended
    assert safe.share >= 0.985
    assert safe.stiffness > 0.5 * limit
    for stiffness, damping in (safe[:2], (wall.stiffness, wall.virtual_damping)):
        assert damping <= walls[:, 1].max()
        assert true.is_stable(stiffness, damping)
    assert ("actuator" if true is LAG else "resonance") in dict(summarize_fit(fit))
    assert ("actuator:" if true is LAG else "modes:") in " ".join(write_scene(fit, "walls"))


@pytest.mark.parametrize("seed, noise", [(0, 0.02), (1, 0.02), (2, 0.02), (3, 0.02), (4, None)])
def test_no_part_is_found_where_a_rigid_mass_explains_the_walls(seed, noise):
    rigid = TrueDevice("", 0.1, 2.0, 0.0, (), 0.7e-3, PERIOD, 1e-5, 3.0)
    walls = begin_to_buzz(rigid, (0.0, 0.4, 0.8, 1.1), noise=0.02, seed=seed)
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=noise)
    assert (fit.status, fit.is_structured, fit.doubts) == (Status.OK, False, ())


def test_a_lag_and_a_resonance_that_explain_walls_alike_leave_no_wall_to_set():
    walls = [(3153.6, 0.0, 31.111), (7752.7, 10.94, 53.345), (10638.0, 21.881, 66.037), (12194.0, 32.821, 75.379)]
    walls.append((12196.0, 40.115, 79.984))
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=0.02)
    assert fit.status == Status.UNDECIDED
    (rival, *_) = fit.rivals
    assert rival.parts is not None
    assert "another device fits equally well" in " ".join(fit.doubts)
    assert np.isnan([fit.stiffness_max, fit.safe_wall().stiffness]).all()
    assert fit.recommended.status == Status.UNREACHABLE
    assert fit.as_dict()["rivals"][0]["parts"] == rival.parts
    assert "resonance = 65.6" in dict(detail_fit(fit, "walls"))["or as well"]
    # The wall to measure next is one that the two do not have alike.
    values = [rival.mass, rival.damping, rival.delay, *rival.parts.values()]
    other = DimensionlessDevice.of_numbers(np.array(values), PERIOD, 0).to_scene(PERIOD, VELOCITY)
    assert float(other.max_stiffness().stiffness) == pytest.approx(rival.stiffness_max, rel=1e-9)
    assert fit.next is not None
    assert fit.actuator is not None
    ends = [scene.stable_stiffness(fit.next.virtual_damping)[0, 1] for scene in (fit.scene, other)]
    assert abs(np.log(ends[0] / ends[1])) > 0.1


def test_the_interval_of_what_was_not_tried_reaches_down_to_what_was():
    """A resonance of 270 Hz bends the edge beyond the walls tried, and leaves these as a rigid device does."""
    true = OtherDevice.of(OTHERS["compliance of 300 Hz, encoder at the motor"])
    walls = [(494.7, 0.0, 10.92), (4044.0, 8.053, 33.66), (6577.0, 16.11, 45.92), (8703.0, 24.16, 54.96)]
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=0.02)
    assert not fit.is_structured
    assert fit.damping_tried == 24.16
    assert fit.virtual_damping > 24.16
    bar, spread = fit.intervals["stiffness_max"], np.exp(fit.reach * fit.stiffness_error / fit.stiffness_max)
    assert bar == (pytest.approx(8703 * (1 - 0.02 * fit.reach)), pytest.approx(fit.stiffness_max * spread))
    assert bar.low < true.limit_of_walls() < bar.high
    assert fit.safe_wall().stiffness <= fit.bear_tried(0.99)
