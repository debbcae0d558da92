"""Test `Scene.best_damping` against a brute-force search over the interval of stable dampings."""

import numpy as np
import pytest

from zwidth import Device, LowPass, Scene, Status, Timing, VirtualWall, WindowedDifference
from zwidth.core.errors import InputError

DEVICES = [(0.0, 0.0), (0.5, 0.0), (3.0, 0.0), (0.1, 1.0), (0.1, 0.5)]
FILTERED = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3), velocity=LowPass(cutoff=100.0))
SCENES: list[Scene] = [Scene(Device(1.0, delta), Timing(1.0, d)) for delta, d in DEVICES] + [FILTERED]


@pytest.fixture(scope="module", params=SCENES)
def case(request):
    """Return a scene, half of its maximum stiffness, and a fine grid of stable dampings at that stiffness."""
    scene = request.param
    stiffness = 0.5 * float(scene.max_stiffness().stiffness)
    ((low, high),) = scene.stable_damping(stiffness).tolist()
    return scene, stiffness, np.linspace(low, high, 2001)[1:-1]


def test_no_stable_damping_has_a_smaller_spectral_radius(case):
    scene, stiffness, trials = case
    best = scene.best_damping(stiffness)
    radius = scene.spectral_radius(stiffness, trials)
    assert best.status == Status.OK
    assert best.spectral_radius <= radius.min() + 1e-7
    # At a square-root kink the radius falls steeply between two grid points, but by less than this tolerance.
    assert best.spectral_radius > radius.min() - 0.05
    assert scene.spectral_radius(stiffness, best.virtual_damping) == pytest.approx(best.spectral_radius, rel=1e-12)


def test_no_stable_damping_has_a_larger_modulus_margin(case):
    scene, stiffness, trials = case
    best = scene.best_damping(stiffness, goal="robust")
    sample = trials[:: 400 if scene.nonrigid_parts else 10]
    margin = scene.margins(stiffness, sample).modulus_margin
    assert best.modulus_margin >= margin.max() - 1e-12
    assert scene.margins(stiffness, best.virtual_damping).modulus_margin == pytest.approx(best.modulus_margin, rel=1e-9)
    assert scene.is_stable(stiffness, best.virtual_damping, method="certified")
    assert best.modulus_margin >= scene.best_damping(stiffness).modulus_margin


def test_best_damping_above_maximum_stiffness_is_nan():
    best = FILTERED.best_damping(1.01 * float(FILTERED.max_stiffness().stiffness))
    assert best.status == Status.NO_BOUNDARY
    assert np.isnan(best[:3]).all()


def test_best_damping_ignores_islands():
    scene = FILTERED.replace(velocity=WindowedDifference(samples=24))
    (island,) = scene.islands()
    middle = float(np.mean(island.stiffness))
    assert len(scene.stable_damping(middle)) == 1
    assert scene.best_damping(middle).status == Status.NO_BOUNDARY


def test_best_damping_defaults_to_the_wall_of_the_scene():
    assert FILTERED.replace(wall=VirtualWall(5e3)).best_damping() == FILTERED.best_damping(5e3)


def test_best_damping_of_undamped_device_at_triple_pole():
    # (z - r)^3 = z (z - 1)^2 + (z + 1)(alpha z + beta (z - 1))/2 leaves (r + 1)^3 = 4.
    r = 4 ** (1 / 3) - 1
    alpha = 6 * r**2 - 2
    best, *others = (SCENES[0].best_damping(alpha * factor) for factor in (1.0, 0.98, 1.02))
    assert best.spectral_radius == pytest.approx(r, abs=3e-5)
    assert best.virtual_damping == pytest.approx(2 * r**3, abs=2e-3)
    assert all(other.spectral_radius > r + 5e-4 for other in others)


@pytest.mark.parametrize("stiffness, options", [(-1.0, {}), (np.nan, {}), (1e3, {"goal": "soft"})])
def test_best_damping_rejects_invalid_arguments(stiffness, options):
    with pytest.raises(InputError, match=r"goal: got 'soft'|stiffness: got"):
        FILTERED.best_damping(stiffness, **options)
