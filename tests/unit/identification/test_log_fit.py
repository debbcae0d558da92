"""Test `zwidth.fit_log` on recorded motions, including logs that must be rejected.

References: positions from matrix exponentials, a least-squares fit by SciPy, and `zwidth.simulate`.
"""

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


def random_steps(rng, count, hold=25):
    return np.repeat(rng.choice([-1.0, 1.0], count // hold + 1), hold)[:count]


def simulate_positions(mass, damping, delay, force, start=(0.0, 0.0), offset=0.0):
    """Return positions, from matrix exponentials over both parts of every sampling period."""
    integer, fraction = int(delay // PERIOD), delay / PERIOD % 1
    rate = np.array([[0, 1, 0], [0, -damping / mass, 1 / mass], [0, 0, 0]])
    first, second = expm(rate * fraction * PERIOD), expm(rate * (1 - fraction) * PERIOD)
    delayed = np.concatenate([np.zeros(integer + 1), force])
    state, positions = np.array([*start, 0.0]), []
    for k in range(force.size):
        positions.append(state[0])
        state[2] = delayed[k] + offset
        state = first @ state
        state[2] = delayed[k + 1] + offset
        state = second @ state
    return np.array(positions)


def fit_with_scipy(force, position, skip, start):
    """Fit mass, damping and delay with SciPy's least squares and finite differences, without friction."""
    j = np.arange(position.size - skip)

    def residuals(x):
        decay = np.exp(-x[1] / x[0] * PERIOD * j)
        model = respond_from_rest(x[0], x[1], x[2] * PERIOD, PERIOD, force)[skip:] + x[3] + x[4] * decay
        return (model - position[skip:]) / np.std(position)

    options = {"x_scale": "jac", "xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "jac": "3-point"}
    return least_squares(residuals, start, **options).x[:3]


@pytest.mark.parametrize("delay", [0.0, 0.3e-3, 2e-3, 6.75e-3])
@pytest.mark.parametrize("mass, damping", [(0.1, 2.0), (1.5, 1.0), (0.02, 30.0)])
def test_exact_log_recovers_the_device(mass, damping, delay):
    force = random_steps(np.random.default_rng(0), 700)
    fit = zwidth.fit_log(PERIOD * np.arange(700), simulate_positions(mass, damping, delay, force, (0.01, -0.1)), force)
    np.testing.assert_allclose([fit.mass, fit.damping], [mass, damping], rtol=EXACT)
    assert fit.delay == pytest.approx(delay, abs=EXACT * PERIOD)
    assert fit.offset == pytest.approx(0.0, abs=EXACT)
    assert (fit.status, fit.warnings) == (Status.OK, ())


@pytest.mark.parametrize("seed", range(3))
def test_scipy_fit_without_friction_agrees_within_the_errors(seed):
    rng = np.random.default_rng(seed)
    mass, damping, delay = rng.uniform(0.05, 0.5), rng.uniform(1.0, 8.0), rng.uniform(1.1, 4.9) * PERIOD
    force = random_steps(rng, 800)
    position = simulate_positions(mass, damping, delay, force) + 2e-5 * rng.standard_normal(800)
    fit = zwidth.fit_log(PERIOD, position, force)
    start = [1.01 * mass, 0.99 * damping, delay / PERIOD + 0.02, 0.0, 0.0]
    expected = fit_with_scipy(force, position, 22, start)
    # The estimated friction, absent from SciPy's model, changes the estimates by less than their errors; 4 standard
    # errors allow for three seeds with three parameters each.
    deviations = (np.array([fit.mass, fit.damping, fit.delay]) - expected * [1.0, 1.0, PERIOD]) / list(
        fit.errors.values()
    )[:3]
    assert np.abs(deviations).max() < 4.0


def test_simulated_motion_recovers_the_device():
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=PERIOD))
    force = random_steps(np.random.default_rng(4), 500)
    delayed = np.concatenate([np.zeros(3), force[:-3]])
    motion = zwidth.simulate(scene, 0.0, 0.0, external_force_history=delayed, periods=500)
    fit = zwidth.fit_log(PERIOD, motion.position[:500], force)
    np.testing.assert_allclose([fit.mass, fit.damping, fit.delay / PERIOD], [0.1, 2.0, 3.0], rtol=EXACT)


def test_several_logs_with_constant_force():
    rng = np.random.default_rng(2)
    forces = [random_steps(rng, count) for count in (300, 500)]
    positions = [simulate_positions(0.1, 2.0, 1.4e-3, f, (k, 0.3 * k), 0.25) for k, f in enumerate(forces)]
    fit = zwidth.fit_log([PERIOD, PERIOD], positions, forces)
    np.testing.assert_allclose([fit.mass, fit.damping, fit.delay, fit.offset], [0.1, 2.0, 1.4e-3, 0.25], rtol=1e-8)
    assert fit.residuals.shape == (800,)
    assert np.isnan(fit.residuals[[0, 21, 300, 321]]).all()
    assert np.isfinite(fit.residuals).sum() == 800 - 2 * 22


def test_estimates_scatter_by_their_standard_errors():
    rng = np.random.default_rng(6)
    scene = zwidth.Scene(zwidth.Device(0.1, 5.0), zwidth.Timing(period=PERIOD, delay=1.3e-3))
    true, force = float(scene.max_stiffness().stiffness), random_steps(rng, 500)
    exact = simulate_positions(0.1, 5.0, 1.3e-3, force)
    fits = [zwidth.fit_log(PERIOD, exact + 1e-4 * rng.standard_normal(500), force) for _ in range(12)]
    # The sum of 12 squared standard normal values is within 12 +- 4 sqrt(24), and below 1.5 with probability 1e-4.
    for deviations in (
        [(fit.stiffness_max - true) / fit.stiffness_error for fit in fits],
        [(fit.delay - 1.3e-3) / fit.errors["delay"] for fit in fits],
    ):
        assert 1.5 < np.square(deviations).sum() < 32
    assert np.mean([fit.noise for fit in fits]) == pytest.approx(1e-4, rel=0.05)


def test_stiffness_error_is_that_of_sampled_devices():
    rng = np.random.default_rng(8)
    force = random_steps(rng, 600)
    fit = zwidth.fit_log(PERIOD, simulate_positions(0.1, 5.0, 1.3e-3, force) + 5e-5 * rng.standard_normal(600), force)
    drawn = rng.multivariate_normal([fit.mass, fit.damping, fit.delay], fit.covariance, size=4000)
    mass, damping, delay = drawn.T
    stiffness = zwidth.max_stiffness(mass=mass, damping=damping, period=PERIOD, delay=delay)
    assert np.std(stiffness) == pytest.approx(fit.stiffness_error, rel=0.06)


def test_short_log_with_undetermined_damping_yields_warning():
    rng = np.random.default_rng(9)
    force = random_steps(rng, 120, 10)
    exact = simulate_positions(2.0, 0.5, 1e-3, force)
    fit = zwidth.fit_log(PERIOD, exact + 0.01 * np.std(exact) * rng.standard_normal(120), force)
    assert fit.intervals["damping"].low == 0.0
    assert any("damping" in warning for warning in fit.warnings)


@pytest.mark.parametrize("scale, unit", [(1e3, "mm"), (1e-3, "mN")])
def test_units_wrong_by_1000_yield_warning(scale, unit):
    rng = np.random.default_rng(10)
    force = random_steps(rng, 400)
    fit = zwidth.fit_log(PERIOD, scale * simulate_positions(0.1, 2.0, 1e-3, force), force)
    assert any(f"in {unit}" in warning for warning in fit.warnings)


@pytest.mark.parametrize("inertia, scale, unit", [(0.05, 1e-3, "mN m"), (1e-4, 57.3, "degrees"), (1e-6, 1e4, "counts")])
def test_wrong_units_of_rotary_axis_yield_warning(inertia, scale, unit):
    rng = np.random.default_rng(10)
    force = 500 * inertia * random_steps(rng, 400)
    angle = simulate_positions(inertia, 20 * inertia, 1e-3, force)
    assert zwidth.fit_log(PERIOD, angle, force, rotary=True).warnings == ()
    # A torque that is 1000 times as large has the effect of an angle that is 1000 times as small.
    fit = zwidth.fit_log(PERIOD, scale * angle, force, rotary=True)
    assert any(unit in warning for warning in fit.warnings)
    assert np.isnan(fit.safe_wall().stiffness)


@pytest.mark.parametrize("delay", [0.0, 1.4e-3])
def test_friction_is_recovered_from_simulated_motion(delay):
    force = 2.0 * random_steps(np.random.default_rng(11), 600, 40)
    scene = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=PERIOD, delay=delay))
    positions = zwidth.simulate(scene, 0.0, 0.0, external_force_history=force, coulomb=0.3, periods=600).position[:600]
    fit = zwidth.fit_log(PERIOD, positions, force)
    # An external force acts without delay: the delay of the scene applies to the wall force only.
    np.testing.assert_allclose([fit.mass, fit.damping, fit.friction], [0.1, 2.0, 0.3], rtol=EXACT)
    assert fit.delay == pytest.approx(0.0, abs=EXACT)
    assert (fit.warnings, fit.status) == ((), Status.OK)


def test_oscillatory_lag_is_modeled_and_operator_force_rejected():
    rng = np.random.default_rng(11)
    force = random_steps(rng, 600, 40)
    filtered = lfilter([0.2], [1.0, -1.6, 0.8], force)
    fit = zwidth.fit_log(PERIOD, simulate_positions(0.1, 2.0, 1e-3, filtered) + 1e-6 * rng.standard_normal(600), force)
    assert (fit.status, fit.is_structured) == (Status.OK, True)
    rigid = zwidth.Scene(zwidth.Device(0.1, 2.0), zwidth.Timing(period=PERIOD, delay=1e-3))
    loop: Any = fit.build_response_scene(0.99, True)
    device = loop.device
    hertz = device.frequency
    delay_factor = np.exp(-2j * np.pi * hertz * PERIOD)
    exact = rigid.frequency_response(1.0, 0.0, hertz) * 0.2 / (1.0 - 1.6 * delay_factor + 0.8 * delay_factor**2)
    # The response is within its deviation, although the discrete-time filter is not a continuous lag.
    assert np.all(np.abs(device.response - exact) < device.deviation)
    hand = np.cumsum(0.2 * rng.standard_normal(600))
    with pytest.raises(InputError, match="unexplained and not white noise: another force"):
        zwidth.fit_log(PERIOD, simulate_positions(0.1, 2.0, 1e-3, force + hand), force)


def test_delay_above_max_delay_yields_status_unreachable():
    force = random_steps(np.random.default_rng(12), 600)
    position = simulate_positions(0.1, 2.0, 6e-3, force)
    fit = zwidth.fit_log(PERIOD, position, force, max_delay="3 ms")
    assert fit.status == Status.UNREACHABLE
    assert any("max_delay" in warning for warning in fit.warnings)
    assert zwidth.fit_log(PERIOD, position, force, max_delay="8 ms").status == Status.OK


FORCE = random_steps(np.random.default_rng(13), 200)
POSITIONS = simulate_positions(0.1, 2.0, 1e-3, FORCE)
TIMES = PERIOD * np.arange(200)


@pytest.mark.parametrize(
    "time, position, force, message",
    [
        (TIMES + 0.5e-3 * (TIMES > 0.0905), POSITIONS, FORCE, "not evenly spaced: steps from 1.000 ms to 1.500 ms"),
        (
            TIMES[np.arange(200) % 40 > 0],
            POSITIONS[:195],
            FORCE[:195],
            "log 1 has 39 samples without a gap",
        ),
        (TIMES[::-1], POSITIONS, FORCE, "time: the times decrease from row to row; reverse the order of the rows"),
        (np.roll(TIMES, 60), POSITIONS, FORCE, "the time decreases by 199.0 ms after sample 59; sort the rows"),
        (
            np.floor(TIMES),
            POSITIONS,
            FORCE,
            "time: most samples repeat the previous time, so the column has",
        ),
        (TIMES, POSITIONS, 0.0 * FORCE + 2, "it is 2.000 N all the time"),
        (TIMES, 0.0 * POSITIONS, FORCE, "position: it never changes"),
        (TIMES, POSITIONS, -FORCE, "accelerates against"),
        (TIMES, POSITIONS[:-1], FORCE, "shapes differ"),
        (TIMES, np.full(200, np.nan), FORCE, "position: it contains no number"),
        (TIMES[:30], POSITIONS[:30], np.resize([1.0, -1.0], 30), "record longer"),
        (TIMES, np.random.default_rng(0).standard_normal(200), FORCE, "does not follow"),
        ([PERIOD, PERIOD], [POSITIONS], [FORCE, FORCE], "give each log all three"),
        ([PERIOD, 2 * PERIOD], [POSITIONS, POSITIONS], [FORCE, FORCE], "one by one"),
        (-1.0, POSITIONS, FORCE, "time: got -1 s"),
        (TIMES, 1e160 * POSITIONS, FORCE, "position: got values from "),
        (TIMES, 1e-200 * POSITIONS, FORCE, "at least 1e-30 apart; check the unit"),
        (TIMES, POSITIONS, 1e160 * FORCE, "they must be at most 1e+30 in magnitude"),
        (1e160 * TIMES, POSITIONS, FORCE, "time: got values from 0 to "),
    ],
)
def test_unusable_logs_are_rejected_with_one_line_message(time, position, force, message):
    with pytest.raises(InputError) as caught:
        zwidth.fit_log(time, position, force)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def simulate_single_pulse(coulomb, samples=1500):
    """Simulate one force pulse of 40 ms, after which friction brings the mass to rest."""
    force = np.zeros(samples)
    force[50:90] = 1.0
    scene = zwidth.Scene(zwidth.Device(0.1, 0.5), zwidth.Timing(period=PERIOD))
    return zwidth.simulate(scene, 0.0, 0.0, external_force_history=force, coulomb=coulomb, periods=samples).position[
        :samples
    ], force


@pytest.mark.parametrize("coulomb", [0.002, 0.005, 0.02])
def test_low_friction_after_single_pulse_is_estimated_without_interval(coulomb):
    position, force = simulate_single_pulse(coulomb)
    fit = zwidth.fit_log(PERIOD, position, force)
    np.testing.assert_allclose([fit.mass, fit.damping, fit.friction], [0.1, 0.5, coulomb], rtol=1e-8)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    # A constant force of -coulomb until rest causes the same motion, so no finite interval exists.
    assert np.isnan([fit.errors["friction"], *fit.intervals["friction"]]).all()
    assert fit.safe_wall().stiffness > 0


@cache
def fit_evenly_sampled():
    """Return position, force and their fit with equidistant times."""
    rng = np.random.default_rng(14)
    force = random_steps(rng, 600)
    position = simulate_positions(0.1, 2.0, 2.3e-3, force) + 1e-6 * rng.standard_normal(600)
    return position, force, zwidth.fit_log(PERIOD, position, force)


@pytest.mark.parametrize("share", [0.02, 0.05])
def test_timestamp_jitter_changes_only_the_period(share):
    position, force, even_fit = fit_evenly_sampled()
    stamps = PERIOD * (np.arange(600) + share * np.clip(np.random.default_rng(15).standard_normal(600), -4, 4))
    fit = zwidth.fit_log(stamps, position, force, resample=True)
    assert fit.period == pytest.approx(PERIOD, rel=5e-5)
    assert fit.delay == pytest.approx(even_fit.delay, abs=3e-4 * PERIOD)
    assert fit.stiffness_max == pytest.approx(even_fit.stiffness_max, rel=1e-3)
    assert abs(fit.mass - 0.1) < 4 * fit.errors["mass"]
    if share == 0.05:
        with pytest.raises(InputError, match="use resample"):
            zwidth.fit_log(stamps, position, force)
    stamps[200:] += 0.6 * PERIOD
    with pytest.raises(InputError, match="not even"):
        zwidth.fit_log(stamps, position, force, resample=True)


@pytest.mark.parametrize("period, scale, word", [(1.0, 1.0, "sampling period"), (PERIOD, 1e4, "mm")])
def test_no_wall_is_recommended_while_warnings_remain(period, scale, word):
    force = random_steps(np.random.default_rng(15), 300)
    fit = zwidth.fit_log(period, scale * simulate_positions(0.1, 2.0, 1e-3, force), force)
    assert any(word in warning for warning in fit.warnings)
    assert np.isnan(fit.safe_wall()[:3]).all()
    assert fit.safe_wall().status == Status.UNDECIDED
    assert fit.recommended.status == Status.UNREACHABLE
    assert word in fit.recommended.reason
    summary = dict(summarize_fit(fit))
    assert "SET" not in summary
    assert "record again as they advise" in summary["NO WALL"]
    assert word in summary["WARNING"]
    assert "safe limit" not in dict(detail_fit(fit, "a log"))
    text = "\n".join(write_scene(fit, "a log"))
    assert "    stiffness: 0.0 N/m\n" in text
    assert f'    warnings:\n      - "{fit.warnings[0]}"' in text


def test_long_log_is_truncated_and_reported(monkeypatch):
    monkeypatch.setattr("zwidth.identification.log_fit._MOST", 400)
    rng = np.random.default_rng(16)
    force = random_steps(rng, 900)
    position = simulate_positions(0.1, 2.0, 1.4e-3, force) + 1e-6 * rng.standard_normal(900)
    fit = zwidth.fit_log(PERIOD, position, force)
    finite = np.flatnonzero(np.isfinite(fit.residuals))
    assert (finite[0], finite.size) == (22, finite[-1] - 21)
    assert 400 <= finite.size < 500
    assert abs(fit.mass - 0.1) < 4 * fit.errors["mass"]
    assert dict(detail_fit(fit, "a log"))["samples"].startswith(f"{finite.size} of 900 used")
    assert "samples" not in dict(detail_fit(zwidth.fit_log(PERIOD, position[:400], force[:400]), "a log"))
