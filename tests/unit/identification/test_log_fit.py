"""A device from logs of its motion, made and fitted again by other programs, and from logs that are no good."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import tolerances
from loop_logs import respond_from_rest
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.fit_report import detail_fit, summarize_fit, write_scene

EXACT = tolerances.FIT_EXACT.float64
PERIOD = 1e-3


def steps_to_and_fro(rng, count, hold=25):
    return np.repeat(rng.choice([-1.0, 1.0], count // hold + 1), hold)[:count]


def move(mass, damping, delay, force, start=(0.0, 0.0), offset=0.0):
    """Positions by matrix exponentials over both parts of every period."""
    whole, fraction = int(delay // PERIOD), delay / PERIOD % 1
    rate = np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]])
    first, second = expm(rate * fraction * PERIOD), expm(rate * (1 - fraction) * PERIOD)
    late = np.concatenate([np.zeros(whole + 1), force])
    state, places = np.array([*start, 0.0]), []
    for k in range(force.size):
        places.append(state[0])
        state[2] = late[k] + offset
        state = first @ state
        state[2] = late[k + 1] + offset
        state = second @ state
    return np.array(places)


def fit_again(force, position, skip, start):
    """By SciPy's least squares with difference quotients, from another start."""
    j = np.arange(position.size - skip)

    def rest(x):
        slow = np.exp(-x[1] / x[0] * PERIOD * j)
        model = respond_from_rest(x[0], x[1], x[2] * PERIOD, PERIOD, force)[skip:] + x[3] + x[4] * slow
        return (model - position[skip:]) / np.std(position)

    options = {"x_scale": "jac", "xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "jac": "3-point"}
    return least_squares(rest, start, **options).x[:3]


@pytest.mark.parametrize("delay", [0.0, 0.3e-3, 2e-3, 6.75e-3])
@pytest.mark.parametrize("mass, damping", [(0.1, 2.0), (1.5, 1.0), (0.02, 30.0)])
def test_an_exact_log_gives_the_device_back(mass, damping, delay):
    force = steps_to_and_fro(np.random.default_rng(0), 700)
    fit = zwidth.fit_log(PERIOD * np.arange(700), move(mass, damping, delay, force, (0.01, -0.1)), force)
    np.testing.assert_allclose([fit.mass, fit.damping], [mass, damping], rtol=EXACT)
    assert fit.delay == pytest.approx(delay, abs=EXACT * PERIOD)
    assert fit.offset == pytest.approx(0.0, abs=EXACT)
    assert (fit.status, fit.warnings) == (Status.OK, ())


@pytest.mark.parametrize("seed", range(3))
def test_another_program_that_knows_of_no_friction_finds_the_same_within_the_errors(seed):
    rng = np.random.default_rng(seed)
    mass, damping, delay = rng.uniform(0.05, 0.5), rng.uniform(1.0, 8.0), rng.uniform(1.1, 4.9) * PERIOD
    force = steps_to_and_fro(rng, 800)
    position = move(mass, damping, delay, force) + 2e-5 * rng.standard_normal(800)
    fit = zwidth.fit_log(PERIOD, position, force)
    start = [1.01 * mass, 0.99 * damping, delay / PERIOD + 0.02, 0.0, 0.0]
    again = fit_again(force, position, 22, start)
    # What one number more moves is less than its error: 4 of them for three seeds and numbers.
    away = (np.array([fit.mass, fit.damping, fit.delay]) - again * [1.0, 1.0, PERIOD]) / list(fit.errors.values())[:3]
    assert np.abs(away).max() < 4.0


def test_a_simulated_motion_gives_its_device_back():
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=PERIOD))
    force = steps_to_and_fro(np.random.default_rng(4), 500)
    late = np.concatenate([np.zeros(3), force[:-3]])
    motion = zwidth.simulate(scene, 0.0, 0.0, external_force_history=late, periods=500)
    fit = zwidth.fit_log(PERIOD, motion.position[:500], force)
    np.testing.assert_allclose([fit.mass, fit.damping, fit.delay / PERIOD], [0.1, 2.0, 3.0], rtol=EXACT)


def test_several_logs_and_a_constant_force():
    rng = np.random.default_rng(2)
    forces = [steps_to_and_fro(rng, count) for count in (300, 500)]
    positions = [move(0.1, 2.0, 1.4e-3, f, (k, 0.3 * k), 0.25) for k, f in enumerate(forces)]
    fit = zwidth.fit_log([PERIOD, PERIOD], positions, forces)
    np.testing.assert_allclose([fit.mass, fit.damping, fit.delay, fit.offset], [0.1, 2.0, 1.4e-3, 0.25], rtol=1e-8)
    assert fit.residuals.shape == (800,)
    assert np.isnan(fit.residuals[[0, 21, 300, 321]]).all()
    assert np.isfinite(fit.residuals).sum() == 800 - 2 * 22


def test_noise_moves_the_estimates_as_they_claim():
    rng = np.random.default_rng(6)
    scene = zwidth.Scene(zwidth.Device(0.1, 5.0), zwidth.Timing(period=PERIOD, delay=1.3e-3))
    true, force = float(scene.max_stiffness().stiffness), steps_to_and_fro(rng, 500)
    exact = move(0.1, 5.0, 1.3e-3, force)
    fits = [zwidth.fit_log(PERIOD, exact + 1e-4 * rng.standard_normal(500), force) for _ in range(12)]
    # 12 squares of a normal number add up to 12 within 4 times sqrt(24), and to less than 1.5 in 1 of 10,000 cases.
    for away in (
        [(fit.stiffness_max - true) / fit.stiffness_error for fit in fits],
        [(fit.delay - 1.3e-3) / fit.errors["delay"] for fit in fits],
    ):
        assert 1.5 < np.square(away).sum() < 32
    assert np.mean([fit.noise for fit in fits]) == pytest.approx(1e-4, rel=0.05)


def test_the_error_of_the_stiffest_wall_is_that_of_devices_drawn():
    rng = np.random.default_rng(8)
    force = steps_to_and_fro(rng, 600)
    fit = zwidth.fit_log(PERIOD, move(0.1, 5.0, 1.3e-3, force) + 5e-5 * rng.standard_normal(600), force)
    drawn = rng.multivariate_normal([fit.mass, fit.damping, fit.delay], fit.covariance, size=4000)
    mass, damping, delay = drawn.T
    stiffness = zwidth.max_stiffness(mass=mass, damping=damping, period=PERIOD, delay=delay)
    assert np.std(stiffness) == pytest.approx(fit.stiffness_error, rel=0.06)


def test_a_log_too_short_to_see_the_damping_says_so():
    rng = np.random.default_rng(9)
    force = steps_to_and_fro(rng, 120, 10)
    exact = move(2.0, 0.5, 1e-3, force)
    fit = zwidth.fit_log(PERIOD, exact + 0.01 * np.std(exact) * rng.standard_normal(120), force)
    assert fit.intervals["damping"].low == 0.0
    assert any("damping" in warning for warning in fit.warnings)


@pytest.mark.parametrize("scale, unit", [(1e3, "mm"), (1e-3, "mN")])
def test_units_off_by_a_thousand_cause_warnings(scale, unit):
    rng = np.random.default_rng(10)
    force = steps_to_and_fro(rng, 400)
    fit = zwidth.fit_log(PERIOD, scale * move(0.1, 2.0, 1e-3, force), force)
    assert any(f"in {unit}" in warning for warning in fit.warnings)


@pytest.mark.parametrize("inertia, scale, unit", [(0.05, 1e-3, "mN m"), (1e-4, 57.3, "degrees"), (1e-6, 1e4, "counts")])
def test_units_of_a_rotary_axis_cause_warnings(inertia, scale, unit):
    rng = np.random.default_rng(10)
    force = 500 * inertia * steps_to_and_fro(rng, 400)
    angle = move(inertia, 20 * inertia, 1e-3, force)
    assert zwidth.fit_log(PERIOD, angle, force, rotary=True).warnings == ()
    # A torque a thousand times as large is as if the angle were so much smaller.
    fit = zwidth.fit_log(PERIOD, scale * angle, force, rotary=True)
    assert any(unit in warning for warning in fit.warnings)
    assert np.isnan(fit.safe_wall().stiffness)


@pytest.mark.parametrize("delay", [0.0, 1.4e-3])
def test_friction_comes_back_from_a_simulated_motion(delay):
    force = 2.0 * steps_to_and_fro(np.random.default_rng(11), 600, 40)
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=PERIOD, delay=delay))
    rubbed = zwidth.simulate(scene, 0.0, 0.0, external_force_history=force, coulomb=0.3, periods=600).position[:600]
    fit = zwidth.fit_log(PERIOD, rubbed, force)
    # A push acts at once: the loop's delay is of the wall's force.
    np.testing.assert_allclose([fit.mass, fit.damping, fit.friction], [0.1, 2.0, 0.3], rtol=EXACT)
    assert fit.delay == pytest.approx(0.0, abs=EXACT)
    assert (fit.warnings, fit.status) == ((), Status.OK)


def test_a_lag_that_swings_is_modeled_and_a_hand_refused():
    rng = np.random.default_rng(11)
    force = steps_to_and_fro(rng, 600, 40)
    swinging = lfilter([0.2], [1.0, -1.6, 0.8], force)
    fit = zwidth.fit_log(PERIOD, move(0.1, 2.0, 1e-3, swinging) + 1e-6 * rng.standard_normal(600), force)
    assert (fit.status, fit.is_structured) == (Status.OK, True)
    rigid = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=PERIOD, delay=1e-3))
    loop: Any = fit.build_response_scene(0.99, True)
    device = loop.device
    hertz = device.frequency
    turn = np.exp(-2j * np.pi * hertz * PERIOD)
    exact = rigid.frequency_response(1.0, 0.0, hertz) * 0.2 / (1.0 - 1.6 * turn + 0.8 * turn**2)
    # In its band, though it is no continuous lag.
    assert np.all(np.abs(device.response - exact) < device.deviation)
    hand = np.cumsum(0.2 * rng.standard_normal(600))
    with pytest.raises(InputError, match="unexplained and not white noise: another force"):
        zwidth.fit_log(PERIOD, move(0.1, 2.0, 1e-3, force + hand), force)


def test_a_delay_beyond_the_range_is_told():
    force = steps_to_and_fro(np.random.default_rng(12), 600)
    position = move(0.1, 2.0, 6e-3, force)
    fit = zwidth.fit_log(PERIOD, position, force, max_delay="3 ms")
    assert fit.status == Status.UNREACHABLE
    assert any("max_delay" in warning for warning in fit.warnings)
    assert zwidth.fit_log(PERIOD, position, force, max_delay="8 ms").status == Status.OK


FORCE = steps_to_and_fro(np.random.default_rng(13), 200)
PLACES = move(0.1, 2.0, 1e-3, FORCE)
TIMES = PERIOD * np.arange(200)


@pytest.mark.parametrize(
    "time, position, force, words",
    [
        (TIMES + 0.5e-3 * (TIMES > 0.0905), PLACES, FORCE, "not evenly spaced: steps from 1.000 ms to 1.500 ms"),
        (
            TIMES[np.arange(200) % 40 > 0],
            PLACES[:195],
            FORCE[:195],
            "log 1 has 39 samples without a gap",
        ),
        (TIMES[::-1], PLACES, FORCE, "time: the times decrease from row to row; reverse the order of the rows"),
        (np.roll(TIMES, 60), PLACES, FORCE, "the time decreases by 199.0 ms after sample 59; sort the rows"),
        (
            np.floor(TIMES),
            PLACES,
            FORCE,
            "time: most samples repeat the previous time, so the column has",
        ),
        (TIMES, PLACES, 0.0 * FORCE + 2, "it is 2.000 N all the time"),
        (TIMES, 0.0 * PLACES, FORCE, "position: it never changes"),
        (TIMES, PLACES, -FORCE, "accelerates against"),
        (TIMES, PLACES[:-1], FORCE, "shapes differ"),
        (TIMES, np.full(200, np.nan), FORCE, "position: it contains no number"),
        (TIMES[:30], PLACES[:30], np.resize([1.0, -1.0], 30), "record longer"),
        (TIMES, np.random.default_rng(0).standard_normal(200), FORCE, "does not follow"),
        ([PERIOD, PERIOD], [PLACES], [FORCE, FORCE], "give each log all three"),
        ([PERIOD, 2 * PERIOD], [PLACES, PLACES], [FORCE, FORCE], "one by one"),
        (-1.0, PLACES, FORCE, "time: got -1 s"),
        (TIMES, 1e160 * PLACES, FORCE, "position: got values from "),
        (TIMES, 1e-200 * PLACES, FORCE, "at least 1e-30 apart; check the unit"),
        (TIMES, PLACES, 1e160 * FORCE, "they must be at most 1e+30 in magnitude"),
        (1e160 * TIMES, PLACES, FORCE, "time: got values from 0 to "),
    ],
)
def test_bad_logs_are_refused_in_one_line(time, position, force, words):
    with pytest.raises(InputError) as caught:
        zwidth.fit_log(time, position, force)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def push_once(coulomb, samples=1500):
    """One push of 40 ms, after which friction brings the mass to rest."""
    force = np.zeros(samples)
    force[50:90] = 1.0
    scene = zwidth.Scene(zwidth.Device(0.1, 0.5), zwidth.Timing(period=PERIOD))
    return zwidth.simulate(scene, 0.0, 0.0, external_force_history=force, coulomb=coulomb, periods=samples).position[
        :samples
    ], force


@pytest.mark.parametrize("coulomb", [0.002, 0.005, 0.02])
def test_little_friction_after_a_single_push_is_found_and_how_much_of_it_is_a_constant_force_is_open(coulomb):
    position, force = push_once(coulomb)
    fit = zwidth.fit_log(PERIOD, position, force)
    np.testing.assert_allclose([fit.mass, fit.damping, fit.friction], [0.1, 0.5, coulomb], rtol=1e-8)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    # A constant force of -coulomb until it rests moves it alike: no tight interval.
    assert np.isnan([fit.errors["friction"], *fit.intervals["friction"]]).all()
    assert fit.safe_wall().stiffness > 0


@cache
def fit_even():
    """A log, and its fit by an even clock."""
    rng = np.random.default_rng(14)
    force = steps_to_and_fro(rng, 600)
    position = move(0.1, 2.0, 2.3e-3, force) + 1e-6 * rng.standard_normal(600)
    return position, force, zwidth.fit_log(PERIOD, position, force)


@pytest.mark.parametrize("share", [0.02, 0.05])
def test_a_clock_that_wavers_changes_nothing_but_the_period(share):
    position, force, even = fit_even()
    stamps = PERIOD * (np.arange(600) + share * np.clip(np.random.default_rng(15).standard_normal(600), -4, 4))
    fit = zwidth.fit_log(stamps, position, force, resample=True)
    assert fit.period == pytest.approx(PERIOD, rel=5e-5)
    assert fit.delay == pytest.approx(even.delay, abs=3e-4 * PERIOD)
    assert fit.stiffness_max == pytest.approx(even.stiffness_max, rel=1e-3)
    assert abs(fit.mass - 0.1) < 4 * fit.errors["mass"]
    if share == 0.05:
        with pytest.raises(InputError, match="use resample"):
            zwidth.fit_log(stamps, position, force)
    stamps[200:] += 0.6 * PERIOD
    with pytest.raises(InputError, match="not even"):
        zwidth.fit_log(stamps, position, force, resample=True)


@pytest.mark.parametrize("period, scale, word", [(1.0, 1.0, "sampling period"), (PERIOD, 1e4, "mm")])
def test_with_a_warning_there_is_no_wall(period, scale, word):
    force = steps_to_and_fro(np.random.default_rng(15), 300)
    fit = zwidth.fit_log(period, scale * move(0.1, 2.0, 1e-3, force), force)
    assert any(word in warning for warning in fit.warnings)
    assert np.isnan(fit.safe_wall()[:3]).all()
    assert fit.safe_wall().status == Status.UNDECIDED
    assert fit.recommended.status == Status.UNREACHABLE
    assert word in fit.recommended.reason
    said = dict(summarize_fit(fit))
    assert "SET" not in said
    assert "resolve the warnings first" in said["NO WALL"]
    assert word in said["WARNING"]
    assert "safe limit" not in dict(detail_fit(fit, "a log"))
    text = "\n".join(write_scene(fit, "a log"))
    assert "    stiffness: 0.0 N/m\n" in text
    assert f'    warnings:\n      - "{fit.warnings[0]}"' in text


def test_of_a_long_log_the_beginning_is_fitted_and_that_is_said(monkeypatch):
    monkeypatch.setattr("zwidth.identification.log_fit._MOST", 400)
    rng = np.random.default_rng(16)
    force = steps_to_and_fro(rng, 900)
    position = move(0.1, 2.0, 1.4e-3, force) + 1e-6 * rng.standard_normal(900)
    fit = zwidth.fit_log(PERIOD, position, force)
    known = np.flatnonzero(np.isfinite(fit.residuals))
    assert (known[0], known.size) == (22, known[-1] - 21)
    assert 400 <= known.size < 500
    assert abs(fit.mass - 0.1) < 4 * fit.errors["mass"]
    assert dict(detail_fit(fit, "a log"))["samples"].startswith(f"{known.size} of 900 samples")
    assert "samples" not in dict(detail_fit(zwidth.fit_log(PERIOD, position[:400], force[:400]), "a log"))
