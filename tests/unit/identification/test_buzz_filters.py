"""Test `zwidth.fit_buzz` with velocity filters and windows on exact walls from `Scene.boundary`."""

import numpy as np
import pytest
import tolerances

import zwidth
from zwidth.core.status import Status

EXACT = tolerances.FIT_EXACT.float64
PERIOD = 1e-3


def make_scene(velocity, mass=0.1, damping=5.0, delay=0.7e-3):
    return zwidth.Scene(zwidth.Device(mass, damping), zwidth.Timing(PERIOD, delay), velocity=velocity)


def select_walls(scene, shares):
    """Return walls at the first loss of stability with rising K, at shares of the part of the boundary with B > 0."""
    omega = np.linspace(20, 3000, 6000)
    walls = scene.boundary(omega)
    points = np.stack([walls.stiffness, walls.virtual_damping, omega / (2 * np.pi)], -1)
    points = points[(points[:, 0] > 0) & (points[:, 1] >= 0)]
    rows = scene.stable_stiffness(points[:, 1])
    first = (rows[:, 0, 0] <= 1e-9 * rows[:, 0, 1]) & (np.abs(rows[:, 0, 1] / points[:, 0] - 1) < 1e-6)
    points = points[first][np.argsort(points[first, 1])]
    return points[[int(share * (len(points) - 1)) for share in shares]]


def assert_recovered(fit, scene):
    estimates = [fit.mass / scene.mass, fit.damping / scene.damping, (fit.delay - scene.timing.delay) / PERIOD]
    np.testing.assert_allclose(estimates, [1, 1, 0], rtol=EXACT, atol=EXACT)
    assert (fit.status, fit.warnings) == (Status.OK, ())


ESTIMATES = [
    zwidth.LowPass(cutoff=150),
    zwidth.LowPass(cutoff=90, order=2),
    zwidth.Butterworth(cutoff=120),
    *(zwidth.WindowedDifference(samples=samples) for samples in (2, 3, 5, 10)),
]


@pytest.mark.parametrize("velocity", ESTIMATES, ids=str)
def test_exact_onsets_recover_the_device(velocity):
    scene = make_scene(velocity, damping=12.0)
    assert_recovered(zwidth.fit_buzz(select_walls(scene, (0.0, 0.5, 0.9)), period=PERIOD, velocity=velocity), scene)
