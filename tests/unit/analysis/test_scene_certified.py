"""Certified labels of scenes: against the labels and the poles, and what is said where no label is given."""

import numpy as np
import pytest
from independent_scenes import KINDS, random_scene, random_walls

import zwidth
from zwidth.core.errors import InputError
from zwidth.core.status import Method, Status

pytest.importorskip("flint")
FILTERED = zwidth.Scene(
    zwidth.Device(mass=0.1, damping=3.0), zwidth.Timing(period=1e-3, delay=1e-3), velocity=zwidth.LowPass(cutoff=100.0)
)


@pytest.mark.parametrize("kind", KINDS)
def test_labels_are_the_certified_ones(kind):
    rng = np.random.default_rng(7)
    for _ in range(3):
        scene = random_scene(kind, rng)
        stiffness, damping = random_walls(scene, rng, 15)
        damping[0] = 0.0
        found = scene.decide_stability(stiffness, damping, method="certified")
        assert np.all(found.status == Status.OK)
        np.testing.assert_array_equal(found.stable, scene.is_stable(stiffness, damping))
        np.testing.assert_array_equal(found.stable, scene.is_stable(stiffness, damping, method="companion"))


def test_next_to_the_boundary():
    end = FILTERED.stable_stiffness(5.0)[0, 1]
    stiffness = end * (1 + np.array([-1e-12, 1e-12]))
    np.testing.assert_array_equal(FILTERED.is_stable(stiffness, 5.0, method="certified"), [True, False])


def test_without_stiffness_a_pole_is_on_the_circle():
    found = FILTERED.decide_stability([0.0, 0.0, 10.0, np.nan], [1.0, 1e3, 1.0, 1.0], method="certified")
    assert found.stable.tolist() == [False, False, True, False]
    assert found.status.tolist() == [Status.ON_BOUNDARY, Status.OK, Status.OK, Status.INVALID_INPUT]
    assert found.method.tolist() == [Method.CERTIFIED] * 4


def test_undamped_devices_without_virtual_damping():
    """With a damped coupling such walls are stable from some stiffness on, though the device's double pole is at 1."""
    coupling = zwidth.Coupling(mass=3.5, stiffness=10716.0, damping=525.0)
    scene = zwidth.Scene(zwidth.Device(2.8, 0.0, coupling), zwidth.Timing(1.575e-3))
    stiffness = np.array([1.0, 600.0, 800.0, 6e5, 7e5])
    labels = scene.is_stable(stiffness)
    assert labels.tolist() == [False, False, True, True, False]
    np.testing.assert_array_equal(labels, scene.is_stable(stiffness, method="certified"))


def test_rigid_scenes_are_those_of_the_closed_form():
    scene = zwidth.Scene(zwidth.Device(0.1, 3.0), zwidth.Timing(1e-3, 1.5e-3))
    walls = scene.normalize_walls(np.array([1e3, 2e4]), 4.0)
    expected = zwidth.decide_stability(*walls, scene.delta, scene.d, method="certified")
    for one, other in zip(scene.decide_stability([1e3, 2e4], 4.0, method="certified"), expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_unknown_method_is_refused():
    with pytest.raises(InputError, match="did you mean 'certified'"):
        FILTERED.is_stable(1.0, method="certifed")  # pyright: ignore[reportArgumentType]
