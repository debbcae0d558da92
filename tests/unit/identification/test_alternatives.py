"""Test fits of logs that several devices explain: global optima, and errors that include equally good devices."""

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


def fit_simulated_log(seed, span=bench_fit.NOISY):
    """Fit a log of the benchmark; return the fit and the errors of its parameters in standard errors."""
    log = bench_fit.make_log(seed, span)
    fit = zwidth.fit_log(log.time, log.position, log.force)
    names = ("mass", "damping", "delay", "friction", "offset")
    truth: dict[str, float] = {str(name): value for name, value in zip(names, log.truth, strict=True)}
    finite = {name: error for name, error in fit.errors.items() if np.isfinite(error)}
    return fit, {name: (getattr(fit, name) - truth[name]) / error for name, error in finite.items()}


# At the optimum of each log the mass slides back slightly before the first force step, although noise and the encoder
# explain the positions without it. A fit that takes this for evidence has a friction that is 25, 10 and 2,700 standard
# errors off.
@pytest.mark.parametrize("seed", [189, 209, 469])
def test_friction_is_undetermined_if_mass_slides_in_one_direction(seed):
    fit, deviations = fit_simulated_log(seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert np.isnan([fit.errors["friction"], fit.errors["offset"]]).all()
    assert set(deviations) == {"mass", "damping", "delay"}
    assert np.abs(list(deviations.values())).max() < 4.0


# Masses that stick and reverse inside a wall: the search can end in a local optimum, with warnings that the force has
# the wrong sign or that the motion is unexplained.
@pytest.mark.parametrize("seed", [86, 254, 462, 518])
def test_sticking_mass_is_recovered(seed):
    fit, deviations = fit_simulated_log(seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert set(deviations) == {"mass", "damping", "delay", "friction", "offset"}
    assert np.abs(list(deviations.values())).max() < 4.0


# A device without friction explains these logs equally well: it starts to move at once where one with friction sticks
# first. Linearized errors put friction 2.2 to 2.6 standard errors from 0.
@pytest.mark.parametrize("seed", [130, 182, 234])
def test_error_of_friction_includes_zero_if_zero_fits_as_well(seed):
    fit, deviations = fit_simulated_log(seed)
    assert fit.friction > 0
    assert fit.intervals["friction"].low == 0.0
    assert np.abs(list(deviations.values())).max() < 4.0


# In directions that these logs hardly determine, the steps of the search converge slowly.
@pytest.mark.parametrize("seed", [17, 97, 333, 545, 549])
def test_search_converges_in_poorly_determined_directions(seed):
    fit, deviations = fit_simulated_log(seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert not fit.intervals["friction"].low > 0
    assert np.abs(list(deviations.values())).max() < 4.0


# An encoder without noise has a constant error while the device rests. Counted as independent errors, they separated
# friction from a constant force in the first five logs, 7 to 92 standard errors off. The others have few distinct
# positions, of which not every encoder step was found; mass, damping and delay were 5 to 35 standard errors off.
@pytest.mark.parametrize("seed", [29, 89, 197, 209, 1165, 221, 285, 297, 1037, 1297])
def test_rest_counts_as_one_sample_for_encoder_without_noise(seed):
    fit, deviations = fit_simulated_log(seed, bench_fit.SILENT)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert set(deviations) == {"mass", "damping", "delay"}
    assert np.abs(list(deviations.values())).max() < 4.0


def test_encoder_errors_at_repeated_positions_are_correlated():
    # Inside a wall the device returns to the same encoder step. With independent errors: 6 standard errors off.
    fit, deviations = fit_simulated_log(1174, bench_fit.SILENT)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    assert np.abs(list(deviations.values())).max() < 4.0


def fit_simulated_mass(delta, d, friction, steps, noise, seed, count=600):
    """Fit a log of a mass of 100 g.

    Args:
        delta: Normalized damping b T/m.
        d: Delay in periods.
        friction: Coulomb friction in N.
        steps: Encoder steps over the range of motion.
        noise: Standard deviation of the position noise in encoder steps.
        seed: Seed of force and noise.
        count: Number of samples.
    """
    random = np.random.default_rng(seed)
    force = np.concatenate([np.zeros(SKIP + 2), np.repeat(random.choice([-1.0, 1.0], count // 20 + 1), 20)[:count]])
    motion = Recording(force, np.zeros(count + 2), SKIP).move(1e-5, delta, d, 0.0, 0.0, 0.0, 1e-5 * friction).position
    step = np.ptp(motion) / steps
    quantized = step * np.round(motion / step + noise * random.standard_normal(motion.size))
    return zwidth.fit_log(1e-3, np.concatenate([np.full(SKIP, quantized[0]), quantized]), force)


# With strong damping, friction affects only the reversals. From every start, with damping and delay from a coarse grid,
# the search ended in an optimum without friction: all parameters were 12 to 17 standard errors off.
@pytest.mark.parametrize("seed", [3, 31])
def test_friction_of_strongly_damped_device_is_recovered(seed):
    fit = fit_simulated_mass(0.6, 2.87, 0.008, 3e4, 0.0, seed)
    assert (fit.status, fit.warnings) == (Status.OK, ())
    truth = {"mass": 0.1, "damping": 60.0, "delay": 2.87e-3, "friction": 0.008}
    assert max(abs(getattr(fit, name) - value) / fit.errors[name] for name, value in truth.items()) < 4.0


# K_max falls from 71 to 10 kN/m over the delays that these coarse encoders allow. By its derivative at the optimum the
# interval ended at 31 to 54 kN/m.
@pytest.mark.parametrize("seed", [3, 4, 7, 9, 12])
def test_interval_of_max_stiffness_extends_to_zero_delay(seed):
    fit = fit_simulated_mass(0.02, 0.0, 0.0, 20.0, 0.3, seed, count=280)
    true = zwidth.Scene(zwidth.Device(mass=0.1, damping=2.0), zwidth.Timing(period=1e-3)).max_stiffness()
    low, high = fit.intervals["stiffness_max"]
    assert fit.intervals["delay"].low == 0.0
    assert 0.0 < low < fit.stiffness_max < true.stiffness < high


@pytest.mark.parametrize("lag, expected", [(0.0, 1.0), (4.0, 4.0), (30.0, None)])
def test_distance_of_alternative_optimum_follows_its_sum_of_squares(lag, expected):
    random = np.random.default_rng(4)
    force = np.concatenate([np.zeros(SKIP), np.repeat(random.choice([-1.0, 1.0], 20), 20)])
    theta = np.array([1e-5, 0.02, 2.3, 0.0, 1e-5, 1e-7, 1e-6])
    model = Recordings((Recording(force, np.zeros(400), SKIP),))
    noisy = model.simulate(theta).position + 1e-6 * random.standard_normal(400)
    model = Recordings((Recording(force, noisy, SKIP),))
    squares = float(np.sum((noisy - model.simulate(theta).position) ** 2))
    single = FittedModel(model, theta, squares, True)
    # By the linearized covariance the alternative is 50 standard errors away in each of two parameters.
    offset = np.zeros(7)
    offset[[1, 6]] = 50.0 * np.sqrt(np.diag(single.covariance)[[1, 6]])
    alternative = FittedModel(model, theta + offset, squares * np.exp(lag / 400), True)
    widened = replace(single, alternatives=(alternative,)).covariance
    if expected is None:
        np.testing.assert_array_equal(widened, single.covariance)
    else:
        scales = np.sqrt(np.diag(widened))
        steps = offset / scales
        distance = steps @ np.linalg.solve(widened / np.outer(scales, scales), steps)
        assert distance == pytest.approx(expected, rel=1e-6)
