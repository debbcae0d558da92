"""Test certified decisions of scenes against decisions in float64, companion-matrix poles and the closed form."""

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
def test_certified_decisions_match_float64_decisions(kind):
    rng = np.random.default_rng(7)
    for _ in range(3):
        scene = random_scene(kind, rng)
        stiffness, damping = random_walls(scene, rng, 15)
        damping[0] = 0.0
        decision = scene.decide_stability(stiffness, damping, method="certified")
        assert np.all(decision.status == Status.OK)
        np.testing.assert_array_equal(decision.stable, scene.is_stable(stiffness, damping))
        np.testing.assert_array_equal(decision.stable, scene.is_stable(stiffness, damping, method="companion"))


def test_certified_decision_resolves_the_boundary_to_1e_12():
    end = FILTERED.stable_stiffness(5.0)[0, 1]
    stiffness = end * (1 + np.array([-1e-12, 1e-12]))
    np.testing.assert_array_equal(FILTERED.is_stable(stiffness, 5.0, method="certified"), [True, False])


def test_certified_status_is_on_boundary_without_stiffness():
    decision = FILTERED.decide_stability([0.0, 0.0, 10.0, np.nan], [1.0, 1e3, 1.0, 1.0], method="certified")
    assert decision.stable.tolist() == [False, False, True, False]
    assert decision.status.tolist() == [Status.ON_BOUNDARY, Status.OK, Status.OK, Status.INVALID_INPUT]
    assert decision.method.tolist() == [Method.CERTIFIED] * 4


def test_undamped_device_with_damped_coupling_and_no_virtual_damping():
    """With a damped coupling, walls above some stiffness are stable, although the device has two poles at z = 1."""
    coupling = zwidth.Coupling(mass=3.5, stiffness=10716.0, damping=525.0)
    scene = zwidth.Scene(zwidth.Device(2.8, 0.0, coupling), zwidth.Timing(1.575e-3))
    stiffness = np.array([1.0, 600.0, 800.0, 6e5, 7e5])
    labels = scene.is_stable(stiffness)
    assert labels.tolist() == [False, False, True, True, False]
    np.testing.assert_array_equal(labels, scene.is_stable(stiffness, method="certified"))


def test_rigid_scenes_match_the_closed_form():
    scene = zwidth.Scene(zwidth.Device(0.1, 3.0), zwidth.Timing(1e-3, 1.5e-3))
    walls = scene.normalize_walls(np.array([1e3, 2e4]), 4.0)
    expected = zwidth.decide_stability(*walls, scene.delta, scene.d, method="certified")
    for one, other in zip(scene.decide_stability([1e3, 2e4], 4.0, method="certified"), expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_unknown_method_is_rejected():
    with pytest.raises(InputError, match="did you mean 'certified'"):
        FILTERED.is_stable(1.0, method="certifed")  # pyright: ignore[reportArgumentType]
