"""Derivatives of K_max with respect to the dampings of the joints of an arm, against differences of K_max."""

from typing import Any

import jax
import numpy as np
import pytest

import zwidth

TIMING = zwidth.Timing("1 ms", "1 ms")
MASSES = [[0.03, 0.01], [0.01, 0.01]]
JACOBIAN = [[-0.2, -0.1], [0.1, 0.15]]


def make_scene(damping, **options) -> zwidth.Scene:
    return zwidth.Scene(zwidth.from_mass_matrix(MASSES, damping, direction="x", jacobian=JACOBIAN, **options), TIMING)


def measure(damping, **options) -> float:
    return float(make_scene(damping, **options).max_stiffness().stiffness)


@pytest.mark.parametrize("stiffness", [0, [[30, -30], [-30, 30]]])
@pytest.mark.parametrize("damping", [[0.02, 0.05], [0.02, 0], [[0.02, 0.005], [0.005, 0.05]]])
def test_derivatives_equal_differences(damping, stiffness):
    scene = make_scene(damping, stiffness=stiffness)
    result = scene.sensitivities()
    matrix = np.array(damping, float) if np.ndim(damping) == 2 else np.diag(damping).astype(float)
    assert result.status == 0
    for k in range(2):
        step = np.zeros((2, 2))
        step[k, k] = 1e-5
        ends = [matrix + step, matrix - step] if matrix[k, k] else [matrix + step, matrix]
        high, low = (measure(each, stiffness=stiffness) for each in ends)
        difference = (high - low) / (2e-5 if matrix[k, k] else 1e-5)
        # The central difference has errors of second order, the forward difference for a damping of 0 of first order.
        assert result.per[f"joints.{k}.damping"] == pytest.approx(difference, rel=1e-5 if matrix[k, k] else 1e-3)


def test_dampings_are_replaced_by_path():
    scene = make_scene([0.02, 0.05])
    for given in (0.1, "100 mN m s/rad", np.float64(0.1)):
        assert scene.replace(**{"joints.1.damping": given}).device == make_scene([0.02, 0.1]).device
    both = scene.replace(**{"joints.0.damping": 1, "joints.1.damping": "2 N s/m", "period": "2 ms"})
    assert both.device == make_scene([1, 2]).device
    assert both.timing.period == 2e-3


def test_path_of_a_joint_is_refused_for_a_rigid_mass():
    arm = zwidth.from_mass_matrix(MASSES, jacobian=JACOBIAN, direction="x")
    with pytest.raises(zwidth.InputError, match=r"joints\.0\.damping: the device is a rigid mass"):
        zwidth.Scene(arm, TIMING).replace(**{"joints.0.damping": 0.02})


def test_limits_contain_the_damping_of_the_joints():
    scene = make_scene([0.02, 0.05])
    (limit,) = [limit for limit in zwidth.limits_of(scene) if limit.name == "joints"]
    assert limit.stiffness == pytest.approx(measure([0.022, 0.055]), rel=1e-12)
    assert limit.gain > 1


def test_device_is_restored_from_its_text_and_configuration():
    device: Any = make_scene([0.02, 0.05]).device
    assert eval(repr(device), {"from_mass_matrix": zwidth.from_mass_matrix}) == device
    assert zwidth.from_mass_matrix(**device.spell_form()) == device
    scene = make_scene([0.02, 0.05])
    assert jax.jit(lambda changed: changed)(scene).device == device


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("joints.2.damping", 1, "did you mean 'joints.1.damping'"),
        ("joints.0.damping", -1, "must be at least 0"),
        ("joints.0.damping", "3 kg", "the units allowed are"),
    ],
)
def test_invalid_dampings_raise(path, value, message):
    with pytest.raises(zwidth.InputError, match=message):
        make_scene([0.02, 0.05]).replace(**{path: value})


def test_traced_damping_raises():
    scene = make_scene([0.02, 0.05])
    with pytest.raises(zwidth.InputError, match=r"joints.0.damping: got a value traced by JAX"):
        jax.jit(lambda damping: scene.replace(**{"joints.0.damping": damping}).max_stiffness())(0.1)
