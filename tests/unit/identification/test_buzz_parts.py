"""Test `zwidth.fit_buzz` on devices with an actuator lag or a resonance.

The fit is rejected, or its recommended walls are stable. References: eigenvalues of the true devices, and scenes built
from the same parameters.
"""

import numpy as np
import pytest
from measured_devices import OTHERS, PERIOD, OtherDevice, TrueDevice

import zwidth
from zwidth.core.status import Status
from zwidth.identification.device_estimate import DimensionlessDevice, differentiate, name_parameters
from zwidth.identification.onset_model import Onsets

VELOCITY = zwidth.BackwardDifference()
KINDS = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 2)]
LAG = TrueDevice("", 0.1, 2.0, 1e-3, (), 0.7e-3, PERIOD, 1e-5, 3.0)
MODE = TrueDevice("", 0.1, 2.0, 0.0, ((120.0, 0.03, 0.2),), 0.7e-3, PERIOD, 1e-5, 3.0)
BOTH = TrueDevice("", 0.1, 2.0, 1e-3, ((120.0, 0.03, 0.2),), 0.7e-3, PERIOD, 1e-5, 3.0)
SHARES = (0.0, 0.3, 0.6, 0.9, 1.1)


def describe_device(lag, modes):
    """Return a device with an actuator lag of some order and some modes."""
    ringing = [(0.7, 0.03, 0.4), (1.7, 1.2, -0.2)][:modes]
    return DimensionlessDevice(0.1, 0.03, 1.3, [0.8, 0.6][:lag], ringing)


def differ(function, theta):
    """Return the derivatives along a last axis, by central differences."""
    steps = 1e-6 * np.eye(theta.size)
    return np.stack([(function(theta + step) - function(theta - step)) / 2e-6 for step in steps], -1)


@pytest.mark.parametrize("lag, modes", KINDS)
def test_parameters_of_dimensionless_device_match_its_scene(lag, modes):
    values = describe_device(lag, modes).to_parameters(PERIOD)
    scene = DimensionlessDevice.from_parameters(values, PERIOD, lag).to_scene(PERIOD, VELOCITY)
    by_name = scene.parameters()
    np.testing.assert_allclose([by_name[name] for name in name_parameters(scene)], values, rtol=1e-15)


def test_derivatives_of_walls_and_parameters_match_differences():
    kappa, scaled_damping, w = np.array([[1e-3, 4e-3, 6e-3], [0.0, 0.01, 0.02], [0.1, 0.3, 0.4]])
    onsets, theta = Onsets(kappa, scaled_damping, w, VELOCITY, PERIOD), np.array([np.log(0.1), 0.03, 1.3])

    def predict_logarithms(theta):
        walls = onsets.predict_walls(theta)
        return np.log(np.stack([walls.kappa, walls.w], 1))

    def to_parameters(theta):
        return onsets.normalize(theta).to_parameters(PERIOD)

    slopes = onsets.predict_walls(theta).differentiate()
    np.testing.assert_allclose(slopes, differ(predict_logarithms, theta), rtol=1e-6, atol=1e-8 * np.abs(slopes).max())
    np.testing.assert_allclose(differentiate(to_parameters, theta), differ(to_parameters, theta), rtol=1e-7, atol=1e-9)


def find_onsets(true, shares, noise=0.0, seed=0):
    """Return onsets of instability at shares of the damping at K_max, by eigenvalues, with relative noise."""
    A, B, C = true.sampled()
    size, rng, walls = B.size, np.random.default_rng(seed), []

    def compute_dominant_pole(stiffness, damping):
        rate, closed = damping / true.period, np.zeros((size + 1, size + 1))
        closed[:size, :size] = A - np.outer(B, (stiffness + rate) * C)
        closed[:size, size], closed[size, :size] = rate * B, C
        poles = np.linalg.eigvals(closed)
        return poles[np.argmax(np.abs(poles))]

    scene = zwidth.Scene(zwidth.LinearDevice(true.matrices()), zwidth.Timing(true.period, true.delay))
    for damping in np.array(shares) * float(scene.max_stiffness().virtual_damping):
        low, high = 1.0, 1.02
        while abs(compute_dominant_pole(high, damping)) < 1:
            low, high = high, 1.04 * high
        while high - low > 1e-14 * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if abs(compute_dominant_pole(middle, damping)) < 1 else (low, middle)
        walls.append((low, damping, abs(np.angle(compute_dominant_pole(low, damping))) / (2 * np.pi * true.period)))
    return np.array(walls) * (1 + noise * np.array([1, 0, 1]) * rng.standard_normal((len(walls), 3)))


def is_stable(true, stiffness, damping):
    """Return whether a wall and softer ones of its damping are stable on the true device."""
    return all(true.is_stable(share * stiffness, damping) for share in (1.0, 0.7, 0.4, 0.1, 0.03))


@pytest.mark.parametrize("true", [MODE, BOTH], ids=["mode", "both"])
@pytest.mark.parametrize("noise", [1e-3, 0.01])
def test_onsets_that_no_rigid_device_has_are_rejected(true, noise):
    fit = zwidth.fit_buzz(find_onsets(true, SHARES, noise, seed=1), period=PERIOD, noise=noise)
    assert fit.status == Status.NO_BOUNDARY
    assert "no rigid device has these walls" in " ".join(fit.warnings)
    assert all(len(warning.split()) <= 25 for warning in fit.warnings)
    assert np.isnan([fit.stiffness_max, fit.safe_wall().stiffness]).all()
    assert fit.recommended.status == Status.UNREACHABLE
    assert fit.next is None


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("true", [LAG, MODE, BOTH], ids=["lag", "mode", "both"])
def test_recommended_walls_of_non_rigid_devices_are_stable(true, seed):
    walls = find_onsets(true, SHARES, noise=0.02, seed=seed)
    for noise in (0.02, None):
        fit = zwidth.fit_buzz(walls, period=PERIOD, noise=noise)
        assert not fit.is_structured
        if fit.is_unreliable:
            assert np.isnan(fit.safe_wall().stiffness)
            continue
        safe, wall = fit.safe_wall(), fit.recommended
        assert safe.stiffness > 0.3 * true.limit_of_walls()
        for stiffness, damping in (safe[:2], (wall.stiffness, wall.virtual_damping)):
            assert damping <= walls[:, 1].max()
            assert is_stable(true, stiffness, damping)


@pytest.mark.parametrize("seed, noise", [(0, 0.02), (1, 0.02), (2, 0.02), (3, 0.02), (4, None)])
def test_onsets_of_rigid_mass_are_accepted(seed, noise):
    rigid = TrueDevice("", 0.1, 2.0, 0.0, (), 0.7e-3, PERIOD, 1e-5, 3.0)
    walls = find_onsets(rigid, (0.0, 0.4, 0.8, 1.1), noise=0.02, seed=seed)
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=noise)
    assert (fit.status, fit.warnings) == (Status.OK, ())


def test_interval_at_unmeasured_damping_includes_measured_stiffness():
    """A resonance at 270 Hz lowers the boundary only at dampings above the measured ones."""
    true = OtherDevice.of(OTHERS["compliance of 300 Hz, encoder at the motor"])
    walls = [(494.7, 0.0, 10.92), (4044.0, 8.053, 33.66), (6577.0, 16.11, 45.92), (8703.0, 24.16, 54.96)]
    fit = zwidth.fit_buzz(walls, period=PERIOD, noise=0.02)
    assert not fit.is_structured
    assert fit.measured_damping == 24.16
    assert fit.virtual_damping > 24.16
    interval, spread = (
        fit.intervals["stiffness_max"],
        np.exp(fit.coverage_factor * fit.stiffness_error / fit.stiffness_max),
    )
    assert interval == (
        pytest.approx(8703 * (1 - 0.02 * fit.coverage_factor)),
        pytest.approx(fit.stiffness_max * spread),
    )
    assert interval.low < true.limit_of_walls() < interval.high
    assert fit.safe_wall().stiffness <= fit.bound_measured_stiffness(0.99)
