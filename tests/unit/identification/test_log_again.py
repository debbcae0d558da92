"""Devices with friction fitted by another program as well, and logs that begin with a long rest or are short."""

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


def follow(mass, damping, delay, start, offset, friction, force, count):
    """Positions of ``m x'' + b x' = F(t - t_d) + f0 - F_c sign(x')``, from one stop to the next, in seconds.

    The first position is of the time at which the last ``count`` forces begin.
    """
    whole = math.floor(delay / PERIOD)
    spans = (delay - whole * PERIOD, (whole + 1) * PERIOD - delay)
    x, v = start
    places = [x]
    for k in range(len(force) - count, len(force) - 1):
        for part, left in enumerate(spans):
            push = force[k - whole - 1 + part] + offset
            while left > 0:
                if v == 0 and abs(push) <= friction:
                    break
                pull = push - math.copysign(friction, v if v != 0 else push)
                last, there = pull / damping, left
                after = last + (v - last) * math.exp(-damping / mass * left)
                if friction > 0 and v * after < 0:
                    there, after = mass / damping * math.log1p(-damping * v / pull), 0.0
                x += last * there + (v - last) * -math.expm1(-damping / mass * there) * mass / damping
                v, left = after, left - there
        places.append(x)
    return np.array(places)


def push_to_and_fro(rng, count):
    pushes = [rng.uniform(0.5, 1) * np.repeat([1, -1, -1, 1], rng.integers(15, 45)) for _ in range(count // 30)]
    return np.concatenate(pushes)[:count]


def record(rng, force, *device):
    """From rest, by an encoder."""
    past = [*np.zeros(30), *force.tolist()]
    mass, damping, delay, offset, friction = device
    exact = follow(mass, damping, delay, (0.0, 0.0), offset, friction, past, force.size)
    return STEP * np.round((exact + 0.2 * STEP * rng.standard_normal(force.size)) / STEP)


@pytest.mark.parametrize("delay, offset, friction", [(2.3e-3, 0.0, 0.08), (3e-3, 0.02, 0.15), (0.7e-3, 0.03, 0.01)])
def test_another_program_finds_the_same_device_with_friction(delay, offset, friction):
    rng = np.random.default_rng(5)
    force = push_to_and_fro(rng, 600)
    position = record(rng, force, 0.075, 0.6, delay, offset, friction)
    # That program knows of no encoder.
    fit = zwidth.fit_log(PERIOD, position, force, resolution=0)
    parts = ("offset", "friction")
    measured, forces = position[SKIP:], force.tolist()

    def rest(theta):
        mass, damping, late, x0, v0 = map(float, theta[:5])
        extra = dict(zip(parts, map(float, theta[5:]), strict=True))
        model = follow(
            mass, damping, late, (x0, v0), extra.get("offset", 0.0), extra.get("friction", 0.0), forces, measured.size
        )
        return (model - measured) / np.std(measured)

    speed = (position[SKIP + 2] - position[SKIP - 2]) / (4 * PERIOD)
    own = {"offset": 0.97 * offset, "friction": 1.02 * friction}
    start = [0.0755, 0.594, delay + 5e-5, measured[0], speed, *(own[part] for part in parts)]
    options = {"x_scale": np.maximum(np.abs(start), 1e-4), "xtol": 1e-14, "ftol": 1e-15, "gtol": 1e-15}
    again = least_squares(rest, start, jac="3-point", **options).x
    expected = [again[0], again[1], again[2], *again[5:]]
    found = [fit.mass, fit.damping, fit.delay, *(getattr(fit, part) for part in parts)]
    np.testing.assert_allclose(found, expected, rtol=tolerances.FIT_AGAIN.float64)


def test_a_log_may_begin_with_a_long_rest():
    rng = np.random.default_rng(1)
    force = np.concatenate([np.zeros(2700), push_to_and_fro(rng, 400)])
    position = record(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.08)
    fit = zwidth.fit_log(PERIOD, position, force)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    for name, true in {"mass": 0.075, "damping": 0.6, "delay": 2.3e-3, "friction": 0.08}.items():
        assert abs(getattr(fit, name) - true) < 4 * fit.errors[name]


@pytest.mark.parametrize("share", [0.5, 0.1, 0.01])
def test_errors_know_the_encoder_where_residuals_hide_it(share):
    # At rest the start takes up what the encoder errs: so little is left that its waves alone exceed it.
    force = push_to_and_fro(np.random.default_rng(2), 200)
    theta = np.array([PERIOD**2 / 0.075, PERIOD * 0.6 / 0.075, 2.3, 0.0, 0.0, 0.0, 1e-16])
    model = Recordings((Recording(force, np.zeros(178), SKIP),), resolution=STEP)
    squares = [part * (178 - 7) * STEP**2 / 12 for part in (share, 1.0)]
    few, usual = (np.diag(FittedModel(model, theta, size, True).covariance) for size in squares)
    np.testing.assert_allclose(few, usual, rtol=1e-9)


def test_few_positions_cause_warnings():
    rng = np.random.default_rng(0)
    force = push_to_and_fro(rng, 120)
    position = record(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.0)
    assert not any("positions are fitted" in warning for warning in zwidth.fit_log(PERIOD, position, force).warnings)
    fit = zwidth.fit_log(PERIOD, position[:70], force[:70])
    assert any("only 48 positions are fitted" in warning for warning in fit.warnings)


def test_what_lies_before_and_behind_a_gap_is_fitted_as_two_logs():
    rng = np.random.default_rng(0)
    force = push_to_and_fro(rng, 400)
    position, clock = record(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.0), PERIOD * np.arange(400)
    # The few samples between two gaps are too few.
    kept = (clock < 0.1495) | (clock > 0.1505) & (clock < 0.1705) | (clock > 0.1905)
    fit = zwidth.fit_log(clock[kept], position[kept], force[kept])
    parts = clock < 0.1495, clock > 0.1905
    apart = zwidth.fit_log(PERIOD, *([each[part] for part in parts] for each in (position, force)))
    for name in ("mass", "damping", "delay"):
        assert getattr(fit, name) == pytest.approx(getattr(apart, name), rel=1e-9)
    (motion,) = fit.motions
    np.testing.assert_allclose(motion.time, clock[kept], rtol=1e-9, atol=1e-12)
    both = np.concatenate([each.modeled for each in apart.motions])
    np.testing.assert_allclose(motion.modeled[(motion.time < 0.1495) | (motion.time > 0.1905)], both, rtol=1e-9)
    said = dict(detail_fit(fit, "log"))["samples"]
    assert said == "315 of 379 samples: those after each of 2 gaps depend on forces that were not logged"
    with pytest.raises(InputError, match="21 samples of log 1 are missing, most of them after sample 169"):
        zwidth.respond(clock[kept], position[kept], force[kept])


def test_milliseconds_read_as_seconds_cause_warnings():
    rng = np.random.default_rng(0)
    force = push_to_and_fro(rng, 300)
    fit = zwidth.fit_log(1.0, record(rng, force, 0.075, 0.6, 2.3e-3, 0.0, 0.0), force)
    assert any("the time in ms" in warning for warning in fit.warnings)


@pytest.mark.parametrize("seed", range(4))
def test_a_delay_of_0_causes_a_warning_only_where_the_force_comes_late(seed):
    rng = np.random.default_rng(seed)
    force = push_to_and_fro(rng, 1000)
    position = record(rng, force, 0.08, 0.5, 0.0, 0.0, 0.02)
    fit = zwidth.fit_log(PERIOD, position, force, resolution=STEP)
    assert fit.warnings == ()
    assert 0 < fit.safe_wall().stiffness < fit.stiffness_max
    late = zwidth.fit_log(PERIOD, position[1:], force[:-1], resolution=STEP)
    assert late.delay == 0
    assert any("a negative delay would fit better" in warning for warning in late.warnings)
    assert np.isnan(late.safe_wall().stiffness)
