"""The wall that nearly all devices bear: counted on devices drawn apart from it, and against the closed form."""

from dataclasses import replace

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Status

PERIOD = 1e-3
HEARD = [(6.85e3, 0, 40.1), (15.9e3, 18.7, 68.6), (19.7e3, 37.4, 89.1)]


@pytest.fixture(scope="module")
def fit():
    return zwidth.fit_buzz(HEARD, period=PERIOD, noise=0.02)


def draw(fit, count, seed):
    """Devices as the estimate allows them: ln m, b and t_d normal, b and t_d not negative."""
    rng = np.random.default_rng(seed)
    scales = np.array([fit.mass, 1.0, 1.0])
    root = np.linalg.cholesky(fit.covariance / np.outer(scales, scales))
    drawn = rng.standard_normal((2 * count, 3)) @ root.T + [np.log(fit.mass), fit.damping, fit.delay]
    drawn[:, 0] = np.exp(drawn[:, 0])
    return drawn[(drawn[:, 1:] >= 0).all(1)][:count]


def share_of(devices, stiffness, virtual_damping):
    mass, damping, delay = devices.T
    alpha, beta = stiffness * PERIOD**2 / mass, virtual_damping * PERIOD / mass
    return zwidth.is_stable(alpha, beta, damping * PERIOD / mass, delay / PERIOD).mean()


def test_other_devices_bear_it_and_hardly_more_they_do_not(fit):
    # Of a rigid device the noise of the one wall with most damping is no limit.
    wall, devices = fit.safe_wall(rigid=True), draw(fit, 20_000, 99)
    assert wall.status == Status.OK
    # 0.1 % is the error of a share of 99 % among 8,000 devices.
    assert share_of(devices, wall.stiffness, wall.virtual_damping) == pytest.approx(0.99, abs=0.004)
    assert wall.share == pytest.approx(0.99, abs=1e-3)
    for softer in (0.7, 0.3, 0.1, 0.01):
        assert share_of(devices, softer * wall.stiffness, wall.virtual_damping) > 0.986
    stiffer = [share_of(devices, 1.02 * wall.stiffness, B) for B in np.linspace(0.5, 1.5, 41) * wall.virtual_damping]
    assert max(stiffer) < 0.985


def test_equal_fits_give_equal_walls_and_a_smaller_share_stiffer_ones(fit):
    assert fit.safe_wall() == replace(fit).safe_wall()
    assert fit.safe_wall(reliability=0.9).stiffness > fit.safe_wall().stiffness


def test_a_noise_that_was_estimated_from_little_costs_stiffness(fit):
    guessed = replace(fit, degrees_of_freedom=2)
    assert guessed.safe_wall().stiffness < 0.95 * fit.safe_wall().stiffness


def test_what_the_records_leave_open_leaves_nothing_to_render(fit):
    stiffness = [replace(fit, covariance=scale**2 * fit.covariance).safe_wall().stiffness for scale in (1, 10, 300)]
    assert 0.9 * fit.stiffness_max < stiffness[0] < fit.stiffness_max
    # A fifth of the mass and a third of the damping are open, then six times both and more.
    assert stiffness[1] < 0.75 * fit.stiffness_max
    assert stiffness[2] < 0.05 * fit.stiffness_max


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100)])
def test_devices_beyond_all_bounds_bear_nothing(fit, velocity):
    lost = replace(
        fit, covariance=1e8 * fit.covariance, degrees_of_freedom=1, nominal=replace(fit.nominal, velocity=velocity)
    )
    assert lost.safe_wall()[:2] == (0.0, 0.0)


def test_another_route_to_the_same_wall(fit, monkeypatch):
    # A window of one sample is the backward difference, of which this scene does not know the closed form.
    alike = replace(fit, nominal=replace(fit.nominal, velocity=zwidth.WindowedDifference(samples=1)))
    assert alike.nominal.nonrigid_parts
    monkeypatch.setattr("zwidth.identification.safe_wall._SAMPLES", 1000)
    wall, same = alike.safe_wall(), replace(fit).safe_wall()
    assert wall.stiffness == pytest.approx(same.stiffness, rel=5e-3)
    assert wall.virtual_damping == pytest.approx(same.virtual_damping, rel=0.05)
    assert wall.share >= 0.988


def test_a_filtered_wall_is_borne_by_other_devices(fit):
    filtered = replace(fit, nominal=replace(fit.nominal, velocity=zwidth.LowPass(cutoff=150)))
    wall = filtered.safe_wall()
    scenes = [
        zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(PERIOD, delay), velocity=filtered.velocity)
        for mass, damping, delay in draw(fit, 40, 5)
    ]
    steps = np.linspace(0.02, 1.0, 20) * wall.stiffness
    # Of 40 devices 39.6 are expected; 37 or fewer would be a chance of 1e-3.
    assert sum(scene.is_stable(steps, wall.virtual_damping).all() for scene in scenes) >= 38
    stiffest = [float(scene.max_stiffness().stiffness) for scene in scenes]
    assert 0.8 * np.median(stiffest) < wall.stiffness < np.median(stiffest)


@pytest.mark.parametrize(
    "given, name",
    [
        ({"reliability": 1.0}, "reliability"),
        ({"reliability": 0.3}, "reliability"),
        ({"reliability": "most"}, "reliability"),
    ],
)
def test_what_cannot_be_asked_is_refused(fit, given, name):
    with pytest.raises(InputError, match=f"{name}: got"):
        fit.safe_wall(**given)


@pytest.mark.parametrize("mass, damping, delay", [(0.1, 10.0, 1e-3), (0.4, 2.0, 0.3e-3), (0.05, 20.0, 2.5e-3)])
def test_the_error_of_the_stiffest_wall_is_that_of_drawn_devices(mass, damping, delay):
    scene = zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(PERIOD, delay))
    top = scene.max_stiffness()
    points = []
    for share in (0.0, 0.5, 0.9):
        at = zwidth.boundary_point(scene.delta, scene.d, beta=share * float(top.virtual_damping) * PERIOD / mass)
        points.append((at.alpha * mass / PERIOD**2, at.beta * mass / PERIOD, at.omega / (2 * np.pi * PERIOD)))
    fit = zwidth.fit_buzz(points, period=PERIOD, noise=0.001)
    drawn = draw(fit, 20_000, 1)
    stiffest = zwidth.max_stiffness(mass=drawn[:, 0], damping=drawn[:, 1], period=PERIOD, delay=drawn[:, 2])
    # A standard deviation of 20,000 is off by 0.5 %.
    assert np.std(stiffest) == pytest.approx(fit.stiffness_error, rel=0.02)


def test_records_that_allow_any_mass_warn_of_nothing():
    # Warnings are errors here: two rough walls allow masses that are drawn as 0.
    fit = zwidth.fit_buzz([(1e3, 0.0, 20.0), (2e3, 8.0, 30.0)], period=1e-3)
    wall = fit.safe_wall()
    assert wall.status == Status.OK
    assert 0 < wall.stiffness < fit.stiffness_max
