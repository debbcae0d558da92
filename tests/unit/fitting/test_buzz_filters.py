"""Buzzing walls behind a velocity filter, whose cut-off may be unknown, and behind windows."""

import numpy as np
import pytest
import tolerances

import zwidth
from zwidth.words.errors import InputError
from zwidth.words.status import Status

EXACT = tolerances.FIT_EXACT.float64
PERIOD = 1e-3
FILTERS = [zwidth.LowPass(cutoff=150), zwidth.LowPass(cutoff=90, order=2), zwidth.Butterworth(cutoff=120)]


def scene_with(velocity, mass=0.1, damping=5.0, delay=0.7e-3):
    return zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(PERIOD, delay), velocity=velocity)


def walls_of(scene, shares):
    """Walls at which stability first ends as K rises, at shares of the way along the boundary with B > 0."""
    omega = np.linspace(20, 3000, 6000)
    walls = scene.boundary(omega)
    points = np.stack([walls.stiffness, walls.virtual_damping, omega / (2 * np.pi)], -1)
    points = points[(points[:, 0] > 0) & (points[:, 1] >= 0)]
    rows = scene.stable_stiffness(points[:, 1])
    first = (rows[:, 0, 0] <= 1e-9 * rows[:, 0, 1]) & (np.abs(rows[:, 0, 1] / points[:, 0] - 1) < 1e-6)
    points = points[first][np.argsort(points[first, 1])]
    return points[[int(share * (len(points) - 1)) for share in shares]]


def assert_found(fit, scene):
    found = [fit.mass / scene.mass, fit.damping / scene.damping, (fit.delay - scene.timing.delay) / PERIOD]
    np.testing.assert_allclose(found, [1, 1, 0], rtol=EXACT, atol=EXACT)
    assert (fit.status, fit.doubts) == (Status.OK, ())


@pytest.mark.parametrize("velocity", FILTERS)
def test_exact_walls_give_the_cut_off_back(velocity):
    scene = scene_with(velocity)
    guess = type(velocity)(cutoff=40, order=velocity.order)
    fit = zwidth.fit_buzz(walls_of(scene, (0.0, 0.4, 0.9)), period=PERIOD, velocity=guess, unknown_cutoff=True)
    assert_found(fit, scene)
    assert fit.cutoff == pytest.approx(velocity.cutoff, rel=EXACT)
    assert fit.stiffness_max == pytest.approx(float(scene.max_stiffness().stiffness), rel=EXACT)


def test_a_time_constant_may_be_the_guess():
    scene = scene_with(FILTERS[0])
    guess = zwidth.LowPass(time_constant=5e-3)
    fit = zwidth.fit_buzz(walls_of(scene, (0.0, 0.4, 0.9)), period=PERIOD, velocity=guess, unknown_cutoff=True)
    assert fit.cutoff == pytest.approx(150, rel=EXACT)


def test_the_error_of_the_stiffest_wall_holds_that_of_the_cut_off():
    walls = walls_of(scene_with(FILTERS[0]), (0.0, 0.3, 0.6, 0.9))
    free = zwidth.fit_buzz(walls, period=PERIOD, velocity=FILTERS[0], unknown_cutoff=True, noise=0.02)
    known = zwidth.fit_buzz(walls, period=PERIOD, velocity=FILTERS[0], noise=0.02)
    assert set(free.errors) == {"mass", "damping", "delay", "cutoff"}
    far = free.reach * free.errors["cutoff"]
    assert free.intervals["cutoff"] == (pytest.approx(150 - far), pytest.approx(150 + far))
    assert free.as_dict()["cutoff"] == free.cutoff
    assert np.all(np.diag(free.covariance)[:3] > np.diag(known.covariance))
    # The gradient of K_max by differences of K_max alone.
    values = {
        "mass": free.mass,
        "damping": free.damping,
        "delay": free.delay,
        "velocity.cutoff": free.cutoff,
    }
    slopes = []
    for name, value in values.items():
        both = [free.scene.replace(**{name: value * (1 + side * 1e-4)}).max_stiffness().stiffness for side in (1, -1)]
        slopes.append((both[0] - both[1]) / (2e-4 * value))
    assert free.stiffness_error == pytest.approx(float(np.sqrt(slopes @ free.covariance @ slopes)), rel=1e-5)


def test_noisy_walls_leave_the_cut_off_within_what_they_claim():
    scene, rng = scene_with(FILTERS[0]), np.random.default_rng(2)
    walls, away = walls_of(scene, (0.0, 0.3, 0.6, 0.9)), []
    for _ in range(6):
        noisy = walls.copy()
        noisy[:, [0, 2]] *= 1 + 0.01 * rng.standard_normal((4, 2))
        fit = zwidth.fit_buzz(noisy, period=PERIOD, velocity=FILTERS[0], unknown_cutoff=True, noise=0.01)
        assert fit.cutoff is not None
        away.append((fit.cutoff - 150) / fit.errors["cutoff"])
    # The chance that 6 squares of a normal number add up to less, or to more, is 1e-4 each.
    assert 0.16 < np.square(away).sum() < 27.9


@pytest.mark.parametrize(
    "shares, words",
    [
        ((0.0, 0.5), "B > 0, cannot tell m, b, t_d and the cut-off"),
        ((0.5, 0.5, 0.0), "what is missing is a wall of another damping"),
        ((0.5, 0.9), "three are needed"),
    ],
)
def test_walls_that_cannot_tell_the_cut_off_are_refused(shares, words):
    walls = walls_of(scene_with(FILTERS[0]), shares)
    walls[np.array(shares) == 0.0, 1] = 0.0
    with pytest.raises(InputError) as caught:
        zwidth.fit_buzz(walls, period=PERIOD, velocity=FILTERS[0], unknown_cutoff=True)
    assert words in str(caught.value)


@pytest.mark.parametrize("velocity", [None, zwidth.WindowedDifference(samples=4)])
def test_only_a_low_pass_has_a_cut_off(velocity):
    with pytest.raises(InputError, match=r"velocity: got .* no cut-off"):
        zwidth.fit_buzz([(1e3, 0, 40)], period=PERIOD, velocity=velocity, unknown_cutoff=True)


@pytest.mark.parametrize("samples", [2, 3, 5, 10])
def test_exact_walls_behind_a_window(samples):
    window = zwidth.WindowedDifference(samples=samples)
    scene = scene_with(window, damping=12.0)
    assert_found(zwidth.fit_buzz(walls_of(scene, (0.0, 0.5, 0.9)), period=PERIOD, velocity=window), scene)
