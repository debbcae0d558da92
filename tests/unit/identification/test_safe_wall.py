"""Test `safe_wall`, the wall that is stable for nearly all devices of an estimate.

Reference: verdicts for devices sampled independently of the implementation.
"""

from dataclasses import replace

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status

PERIOD = 1e-3
ONSETS = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]


@pytest.fixture(scope="module")
def fit():
    return zwidth.fit_buzz(ONSETS, period=PERIOD, noise=0.02)


def sample_devices(fit, count, seed):
    """Sample devices from the estimate: ln m, b and t_d are normal, b and t_d truncated at 0."""
    rng = np.random.default_rng(seed)
    scales = np.array([fit.mass, 1.0, 1.0])
    root = np.linalg.cholesky(fit.covariance / np.outer(scales, scales))
    sampled = rng.standard_normal((2 * count, 3)) @ root.T + [np.log(fit.mass), fit.damping, fit.delay]
    sampled[:, 0] = np.exp(sampled[:, 0])
    return sampled[(sampled[:, 1:] >= 0).all(1)][:count]


def compute_stable_share(devices, stiffness, virtual_damping):
    mass, damping, delay = devices.T
    alpha, beta = stiffness * PERIOD**2 / mass, virtual_damping * PERIOD / mass
    return zwidth.is_stable(alpha, beta, damping * PERIOD / mass, delay / PERIOD).mean()


def test_share_of_stable_devices_equals_the_reliability(fit):
    # For a rigid device the measured wall with the largest damping is no limit.
    wall, devices = fit.safe_wall(rigid=True), sample_devices(fit, 20_000, 99)
    assert wall.status == Status.OK
    # A share of 99 % among 8,000 devices has a standard error of 0.1 %.
    assert compute_stable_share(devices, wall.stiffness, wall.virtual_damping) == pytest.approx(0.99, abs=0.004)
    assert wall.share == pytest.approx(0.99, abs=1e-3)
    for softer in (0.7, 0.3, 0.1, 0.01):
        assert compute_stable_share(devices, softer * wall.stiffness, wall.virtual_damping) > 0.986
    stiffer = [
        compute_stable_share(devices, 1.02 * wall.stiffness, B)
        for B in np.linspace(0.5, 1.5, 41) * wall.virtual_damping
    ]
    assert max(stiffer) < 0.985


def test_safe_wall_is_reproducible_and_stiffer_at_lower_reliability(fit):
    assert fit.safe_wall() == replace(fit).safe_wall()
    assert fit.safe_wall(reliability=0.9).stiffness > fit.safe_wall().stiffness


def test_few_degrees_of_freedom_reduce_the_safe_stiffness(fit):
    uncertain = replace(fit, degrees_of_freedom=2)
    assert uncertain.safe_wall().stiffness < 0.95 * fit.safe_wall().stiffness


def test_large_covariance_reduces_the_safe_stiffness(fit):
    stiffness = [replace(fit, covariance=scale**2 * fit.covariance).safe_wall().stiffness for scale in (1, 10, 300)]
    assert 0.9 * fit.stiffness_max < stiffness[0] < fit.stiffness_max
    # Errors of a fifth of the mass and a third of the damping at scale 10, and 30 times larger ones at scale 300.
    assert stiffness[1] < 0.75 * fit.stiffness_max
    assert stiffness[2] < 0.05 * fit.stiffness_max


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100)])
def test_unbounded_covariance_leaves_no_safe_stiffness(fit, velocity):
    unbounded = replace(
        fit, covariance=1e8 * fit.covariance, degrees_of_freedom=1, nominal=replace(fit.nominal, velocity=velocity)
    )
    assert unbounded.safe_wall()[:2] == (0.0, 0.0)


def test_sampled_implementation_matches_the_closed_form(fit, monkeypatch):
    # A window of one sample equals the backward difference, but the scene uses the sampled implementation.
    sampled = replace(fit, nominal=replace(fit.nominal, velocity=zwidth.WindowedDifference(samples=1)))
    assert sampled.nominal.nonrigid_parts
    monkeypatch.setattr("zwidth.identification.safe_wall._SAMPLES", 1000)
    wall, expected = sampled.safe_wall(), replace(fit).safe_wall()
    assert wall.stiffness == pytest.approx(expected.stiffness, rel=5e-3)
    assert wall.virtual_damping == pytest.approx(expected.virtual_damping, rel=0.05)
    assert wall.share >= 0.988


def test_safe_wall_with_low_pass_is_stable_for_sampled_devices(fit):
    filtered = replace(fit, nominal=replace(fit.nominal, velocity=zwidth.LowPass(cutoff=150)))
    wall = filtered.safe_wall()
    scenes = [
        zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(PERIOD, delay), velocity=filtered.velocity)
        for mass, damping, delay in sample_devices(fit, 40, 5)
    ]
    steps = np.linspace(0.02, 1.0, 20) * wall.stiffness
    # 39.6 stable devices of 40 are expected; 37 or fewer have a probability of 1e-3.
    assert sum(scene.is_stable(steps, wall.virtual_damping).all() for scene in scenes) >= 38
    stiffest = [float(scene.max_stiffness().stiffness) for scene in scenes]
    assert 0.8 * np.median(stiffest) < wall.stiffness < np.median(stiffest)


@pytest.mark.parametrize(
    "options, name",
    [
        ({"reliability": 1.0}, "reliability"),
        ({"reliability": 0.3}, "reliability"),
        ({"reliability": "most"}, "reliability"),
    ],
)
def test_invalid_reliability_is_rejected(fit, options, name):
    with pytest.raises(InputError, match=f"{name}: got"):
        fit.safe_wall(**options)


@pytest.mark.parametrize("mass, damping, delay", [(0.1, 10.0, 1e-3), (0.4, 2.0, 0.3e-3), (0.05, 20.0, 2.5e-3)])
def test_stiffness_error_is_that_of_sampled_devices(mass, damping, delay):
    scene = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(PERIOD, delay))
    top = scene.max_stiffness()
    points = []
    for share in (0.0, 0.5, 0.9):
        point = zwidth.boundary_point(scene.delta, scene.d, beta=share * float(top.virtual_damping) * PERIOD / mass)
        points.append((point.alpha * mass / PERIOD**2, point.beta * mass / PERIOD, point.omega / (2 * np.pi * PERIOD)))
    fit = zwidth.fit_buzz(points, period=PERIOD, noise=0.001)
    sampled = sample_devices(fit, 20_000, 1)
    stiffest = zwidth.max_stiffness(mass=sampled[:, 0], damping=sampled[:, 1], period=PERIOD, delay=sampled[:, 2])
    # The standard deviation of 20,000 samples has a standard error of 0.5 %.
    assert np.std(stiffest) == pytest.approx(fit.stiffness_error, rel=0.02)


def test_safe_wall_with_undetermined_mass_raises_no_warning():
    # Warnings are errors in the test suite: these two walls allow masses that are sampled as 0.
    fit = zwidth.fit_buzz([(1e3, 0.0, 20.0), (2e3, 8.0, 30.0)], period=1e-3)
    wall = fit.safe_wall()
    assert wall.status == Status.OK
    assert 0 < wall.stiffness < fit.stiffness_max
