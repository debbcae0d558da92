"""Logs that several devices explain: the best of all optima is found, and errors reach to those that fit as well."""

from dataclasses import replace

import numpy as np
import pytest

import bench_fit
import zwidth
from zwidth.core.status import Status
from zwidth.identification.extended_model import Recordings
from zwidth.identification.friction_model import Recording
from zwidth.identification.output_error import FittedModel

SKIP = bench_fit.SKIP


def fit_made(seed, span=bench_fit.NOISY):
    """The fit of a log of the benchmark, and how many standard errors it is off in what it tells."""
    made = bench_fit.make_log(seed, span)
    fit = zwidth.fit_log(made.time, made.position, made.force)
    names = ("mass", "damping", "delay", "friction", "offset")
    truth: dict[str, float] = {str(name): value for name, value in zip(names, made.truth, strict=True)}
    known = {name: error for name, error in fit.errors.items() if np.isfinite(error)}
    return fit, {name: (getattr(fit, name) - truth[name]) / error for name, error in known.items()}


# The optimum of each slides back by little before it is pushed, which noise and the encoder alone explain; taken for
# the truth, friction was off by 25, 10 and 2,700 standard errors.
@pytest.mark.parametrize("seed", [189, 209, 469])
def test_a_mass_that_slides_one_way_leaves_friction_open(seed):
    fit, away = fit_made(seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert np.isnan([fit.errors["friction"], fit.errors["offset"]]).all()
    assert set(away) == {"mass", "damping", "delay"}
    assert np.abs(list(away.values())).max() < 4.0


# Masses that stick and turn inside a wall, of which the search ended in a false optimum: a force that seemed to have
# the wrong sign, a motion that seemed unexplained.
@pytest.mark.parametrize("seed", [86, 254, 462, 518])
def test_sticking_hides_no_device(seed):
    fit, away = fit_made(seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert set(away) == {"mass", "damping", "delay", "friction", "offset"}
    assert np.abs(list(away.values())).max() < 4.0


# One without friction explains these as well: they start to move at once where those with friction stick first. By
# slopes alone friction was 2.2 to 2.6 standard errors from 0.
@pytest.mark.parametrize("seed", [130, 182, 234])
def test_errors_of_friction_reach_to_none_where_none_fits_as_well(seed):
    fit, away = fit_made(seed)
    assert fit.friction > 0
    assert fit.intervals["friction"].low == 0.0
    assert np.abs(list(away.values())).max() < 4.0


# Along what these logs leave nearly open steps hardly end.
@pytest.mark.parametrize("seed", [17, 97, 333, 545, 549])
def test_a_search_that_creeps_has_arrived(seed):
    fit, away = fit_made(seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert not fit.intervals["friction"].low > 0
    assert np.abs(list(away.values())).max() < 4.0


# An encoder without noise errs by the same all the time a device rests. Counted as thousands of errors, that of 1165
# and the first ones told friction from a constant force, 7 to 92 standard errors off; the others have few different
# positions, of which not every step was found, and were 5 to 35 off in mass, damping and delay.
@pytest.mark.parametrize("seed", [29, 89, 197, 209, 1165, 221, 285, 297, 1037, 1297])
def test_a_rest_counts_once_where_an_encoder_has_no_noise(seed):
    fit, away = fit_made(seed, bench_fit.SILENT)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert set(away) == {"mass", "damping", "delay"}
    assert np.abs(list(away.values())).max() < 4.0


def test_errors_are_alike_wherever_a_device_returns_to_the_same_place():
    # Inside a wall, on and off for a step of the encoder. Stays taken for independent: 6 standard errors off.
    fit, away = fit_made(1174, bench_fit.SILENT)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert np.abs(list(away.values())).max() < 4.0


def play(delta, d, friction, steps, noise, seed, count=600):
    """The fit of a log of 100 g: b T/m, the delay in periods, N, the encoder's steps over the way, and their noise."""
    random = np.random.default_rng(seed)
    force = np.concatenate([np.zeros(SKIP + 2), np.repeat(random.choice([-1.0, 1.0], count // 20 + 1), 20)[:count]])
    moved = Recording(force, np.zeros(count + 2), SKIP).move(1e-5, delta, d, 0.0, 0.0, 0.0, 1e-5 * friction).position
    step = np.ptp(moved) / steps
    read = step * np.round(moved / step + noise * random.standard_normal(moved.size))
    return zwidth.fit_log(1e-3, np.concatenate([np.full(SKIP, read[0]), read]), force)


# Behind a strong damper friction shows in its turns alone. Every start lost it, from a damping and a delay of a coarse
# grid, to an optimum without friction: all numbers were 12 to 17 standard errors off.
@pytest.mark.parametrize("seed", [3, 31])
def test_a_strong_damper_hides_no_friction(seed):
    fit = play(0.6, 2.87, 0.008, 3e4, 0.0, seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    truth = {"mass": 0.1, "damping": 60.0, "delay": 2.87e-3, "friction": 0.008}
    assert max(abs(getattr(fit, name) - value) / fit.errors[name] for name, value in truth.items()) < 4.0


# K_max falls from 71 to 10 kN/m over the delays that these coarse encoders leave open: by its slope alone the interval
# ended at 31 to 54.
@pytest.mark.parametrize("seed", [3, 4, 7, 9, 12])
def test_the_interval_of_the_stiffest_wall_reaches_to_a_device_without_delay(seed):
    fit = play(0.02, 0.0, 0.0, 20.0, 0.3, seed, count=280)
    true = zwidth.Scene(zwidth.Device(mass=0.1, damping=2.0), zwidth.Timing(period=1e-3)).max_stiffness()
    low, high = fit.intervals["stiffness_max"]
    assert fit.intervals["delay"].low == 0.0
    assert 0.0 < low < fit.stiffness_max < true.stiffness < high


@pytest.mark.parametrize("lag, expected", [(0.0, 1.0), (4.0, 4.0), (30.0, None)])
def test_an_alternative_is_as_many_errors_away_as_its_squares_say(lag, expected):
    random = np.random.default_rng(4)
    force = np.concatenate([np.zeros(SKIP), np.repeat(random.choice([-1.0, 1.0], 20), 20)])
    theta = np.array([1e-5, 0.02, 2.3, 0.0, 1e-5, 1e-7, 1e-6])
    model = Recordings((Recording(force, np.zeros(400), SKIP),))
    noisy = model.simulate(theta).position + 1e-6 * random.standard_normal(400)
    model = Recordings((Recording(force, noisy, SKIP),))
    squares = float(np.sum((noisy - model.simulate(theta).position) ** 2))
    alone = FittedModel(model, theta, squares, True)
    # By slopes it is 50 errors away in each of two numbers.
    away = np.zeros(7)
    away[[1, 6]] = 50.0 * np.sqrt(np.diag(alone.covariance)[[1, 6]])
    alternative = FittedModel(model, theta + away, squares * np.exp(lag / 400), True)
    widened = replace(alone, alternatives=(alternative,)).covariance
    if expected is None:
        np.testing.assert_array_equal(widened, alone.covariance)
    else:
        scales = np.sqrt(np.diag(widened))
        steps = away / scales
        distance = steps @ np.linalg.solve(widened / np.outer(scales, scales), steps)
        assert distance == pytest.approx(expected, rel=1e-6)
