"""Test `zwidth.fit_log` with Coulomb friction, long rests, gaps and short logs.

Reference: an independent simulation with friction, fitted by SciPy.
"""

import math

import numpy as np
import pytest
import tolerances
from scipy.optimize import least_squares

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.identification.extended_model import Recordings
from zwidth.identification.fit_report import detail_fit
from zwidth.identification.friction_model import Recording
from zwidth.identification.output_error import FittedModel

PERIOD, SKIP, STEP = 1e-3, 22, 3e-5


def simulate_positions(mass, damping, delay, start, offset, friction, force, count):
    """Return positions of ``m x'' + b x' = F(t - t_d) + f0 - F_c sign(x')``, integrated from stop to stop.

    Times are in seconds. The first position belongs to the time at which the last ``count`` forces begin.
    """
    n_delay = math.floor(delay / PERIOD)
    spans = (delay - n_delay * PERIOD, (n_delay + 1) * PERIOD - delay)
    x, v = start
    positions = [x]
    for k in range(len(force) - count, len(force) - 1):
        for part, remaining in enumerate(spans):
            external = force[k - n_delay - 1 + part] + offset
            while remaining > 0:
                if v == 0 and abs(external) <= friction:
                    break
                net = external - math.copysign(friction, v if v != 0 else external)
                final_velocity, duration = net / damping, remaining
                end_velocity = final_velocity + (v - final_velocity) * math.exp(-damping / mass * remaining)
                if friction > 0 and v * end_velocity < 0:
                    duration, end_velocity = mass / damping * math.log1p(-damping * v / net), 0.0
                x += (
                    final_velocity * duration
                    + (v - final_velocity) * -math.expm1(-damping / mass * duration) * mass / damping
                )
                v, remaining = end_velocity, remaining - duration
        positions.append(x)
    return np.array(positions)


def random_pulses(rng, count):
    pushes = [rng.uniform(0.5, 1) * np.repeat([1, -1, -1, 1], rng.integers(15, 45)) for _ in range(count // 30)]
    return np.concatenate(pushes)[:count]


def record_positions(rng, force, *device):
    """Return positions of a device that starts at rest, quantized by an encoder."""
    past = [*np.zeros(30), *force.tolist()]
    mass, damping, delay, offset, friction = device
    exact = simulate_positions(mass, damping, delay, (0.0, 0.0), offset, friction, past, force.size)
    return STEP * np.round((exact + 0.2 * STEP * rng.standard_normal(force.size)) / STEP)


@pytest.mark.parametrize("delay, offset, friction", [(2.3e-3, 0.0, 0.08), (3e-3, 0.02, 0.15), (0.7e-3, 0.03, 0.01)])
def test_scipy_fit_of_independent_simulation_agrees(delay, offset, friction):
    rng = np.random.default_rng(5)
    force = random_pulses(rng, 600)
    position = record_positions(rng, force, 0.075, 0.6, delay, offset, friction)
    # The SciPy fit has no encoder model, so exclude the encoder from the compared fit.
    fit = zwidth.fit_log(PERIOD, position, force, resolution=0)
    parts = ("offset", "friction")
    measured, forces = position[SKIP:], force.tolist()

    def residuals(theta):
        mass, damping, t_d, x0, v0 = map(float, theta[:5])
        extra = dict(zip(parts, map(float, theta[5:]), strict=True))
        model = simulate_positions(
            mass, damping, t_d, (x0, v0), extra.get("offset", 0.0), extra.get("friction", 0.0), forces, measured.size
        )
        return (model - measured) / np.std(measured)

    speed = (position[SKIP + 2] - position[SKIP - 2]) / (4 * PERIOD)
    initial = {"offset": 0.97 * offset, "friction": 1.02 * friction}
    start = [0.0755, 0.594, delay + 5e-5, measured[0], speed, *(initial[part] for part in parts)]
    options = {"x_scale": np.maximum(np.abs(start), 1e-4), "xtol": 1e-14, "ftol": 1e-15, "gtol": 1e-15}
    estimate = least_squares(residuals, start, jac="3-point", **options).x
    expected = [estimate[0], estimate[1], estimate[2], *estimate[5:]]
    fitted = [fit.mass, fit.damping, fit.delay, *(getattr(fit, part) for part in parts)]
    np.testing.assert_allclose(fitted, expected, rtol=tolerances.FIT_AGAIN.float64)


def test_long_initial_rest_does_not_affect_the_fit():
    rng = np.random.default_rng(1)
    force = np.concatenate([np.zeros(2700), random_pulses(rng, 400)])
    position = record_positions(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.08)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    for name, true in {"mass": 0.075, "damping": 0.6, "delay": 2.3e-3, "friction": 0.08}.items():
        assert abs(getattr(fit, name) - true) < 4 * fit.errors[name]


@pytest.mark.parametrize("share", [0.5, 0.1, 0.01])
def test_errors_include_the_encoder_if_residuals_are_small(share):
    # At rest the initial position absorbs the encoder error, and the residuals are smaller than the harmonics of the
    # encoder model.
    force = random_pulses(np.random.default_rng(2), 200)
    theta = np.array([PERIOD**2 / 0.075, PERIOD * 0.6 / 0.075, 2.3, 0.0, 0.0, 0.0, 1e-16])
    model = Recordings((Recording(force, np.zeros(178), SKIP),), resolution=STEP)
    squares = [part * (178 - 7) * STEP**2 / 12 for part in (share, 1.0)]
    few, usual = (np.diag(FittedModel(model, theta, size, True).covariance) for size in squares)
    np.testing.assert_allclose(few, usual, rtol=1e-9)


def test_few_positions_yield_a_warning():
    rng = np.random.default_rng(0)
    force = random_pulses(rng, 120)
    position = record_positions(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.0)
    assert not any("positions are fitted" in warning for warning in zwidth.fit_log(PERIOD, position, force).warnings)
    fit = zwidth.fit_log(PERIOD, position[:70], force[:70])
    assert any("only 48 positions are fitted" in warning for warning in fit.warnings)


def test_log_with_gaps_is_fitted_as_several_logs():
    rng = np.random.default_rng(0)
    force = random_pulses(rng, 400)
    position, clock = record_positions(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.0), PERIOD * np.arange(400)
    # The samples between the two gaps are too few for a log.
    is_kept = (clock < 0.1495) | (clock > 0.1505) & (clock < 0.1705) | (clock > 0.1905)
    fit = zwidth.fit_log(clock[is_kept], position[is_kept], force[is_kept])
    parts = clock < 0.1495, clock > 0.1905
    separate = zwidth.fit_log(PERIOD, *([each[part] for part in parts] for each in (position, force)))
    for name in ("mass", "damping", "delay"):
        assert getattr(fit, name) == pytest.approx(getattr(separate, name), rel=1e-9)
    (motion,) = fit.motions
    np.testing.assert_allclose(motion.time, clock[is_kept], rtol=1e-9, atol=1e-12)
    both = np.concatenate([each.modeled for each in separate.motions])
    np.testing.assert_allclose(motion.modeled[(motion.time < 0.1495) | (motion.time > 0.1905)], both, rtol=1e-9)
    note = dict(detail_fit(fit, "log"))["samples"]
    assert note == "315 of 379 used: those after each of 2 gaps depend on forces that were not logged"
    with pytest.raises(InputError, match="21 samples of log 1 are missing, most of them after sample 169"):
        zwidth.respond(clock[is_kept], position[is_kept], force[is_kept])


def test_milliseconds_read_as_seconds_yield_a_warning():
    rng = np.random.default_rng(0)
    force = random_pulses(rng, 300)
    fit = zwidth.fit_log(1.0, record_positions(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.0), force)
    assert any("the time in ms" in warning for warning in fit.warnings)


@pytest.mark.parametrize("seed", range(4))
def test_zero_delay_yields_a_warning_only_if_the_force_is_late(seed):
    rng = np.random.default_rng(seed)
    force = random_pulses(rng, 1000)
    position = record_positions(rng, force, 0.08, 0.5, 0.0, 0.0, 0.02)
    fit = zwidth.fit_log(PERIOD, position, force, resolution=STEP)
    assert fit.warnings == ()
    assert 0 < fit.safe_wall().stiffness < fit.stiffness_max
    late = zwidth.fit_log(PERIOD, position[1:], force[:-1], resolution=STEP)
    assert late.delay == 0
    assert any("a negative delay would fit better" in warning for warning in late.warnings)
    assert np.isnan(late.safe_wall().stiffness)
