"""Devices with several joints from a mass matrix: responses, units, and messages for invalid arguments."""

import numpy as np
import pytest

import zwidth


def test_response_equals_that_of_the_joints():
    rng = np.random.default_rng(4)
    for case in range(300):
        joints = int(rng.integers(1, 8))
        root = rng.normal(size=(joints, joints))
        mass_matrix = root @ root.T + 0.1 * np.eye(joints)
        damping = rng.uniform(0, 2, joints) * (case % 3 > 0)
        stiffness = np.zeros((joints, joints))
        springs = int(rng.integers(1, joints + 1))
        if case % 3 == 2:
            factor = 10 * rng.normal(size=(joints, springs))
            stiffness = factor @ factor.T
        jacobian, direction = rng.normal(size=(3, joints)), rng.normal(size=3)
        device = zwidth.from_mass_matrix(
            mass_matrix, damping, direction=direction, jacobian=jacobian, stiffness=stiffness
        )
        vector = jacobian.T @ direction / np.linalg.norm(direction)
        for s in (0.3 + 1j, 0.1 + 5j, 20 + 3j):
            joint_torques = np.linalg.solve(mass_matrix * s * s + np.diag(damping) * s + stiffness, vector)
            if isinstance(device, zwidth.Device):
                response = 1 / (device.mass * s * s + device.damping * s)
            else:
                response = device.gain * np.prod(s - device.zeros) / np.prod(s - device.poles)
            # The coefficients of up to 14 poles lose some digits, more with ill-conditioned random matrices.
            assert response == pytest.approx(vector @ joint_torques, rel=1e-9)
        if isinstance(device, zwidth.LinearDevice) and 0 < springs < joints and case % 3 == 2:
            assert np.sum(device.poles == 0) == 1  # one free motion with damping is measured


def test_lists_as_a_user_types_them():
    assert zwidth.from_mass_matrix([[2, 0], [0, 1]], direction=[0, 3]) == zwidth.Device(1.0)
    assert zwidth.from_mass_matrix([[2, 0], [0, 1]], 1, direction=[1, 0]).mass == 2.0
    assert zwidth.from_mass_matrix([[4]], 2, jacobian=[[2]]) == zwidth.Device(1.0, 0.5)
    knob = zwidth.from_mass_matrix([[1e-4]], 1e-4, rotary=True)
    assert knob == zwidth.Device(1e-4, 1e-4, rotary=True)
    assert zwidth.from_mass_matrix([[1, 0], [0, 1]], direction="y") == zwidth.Device(1.0)


def test_texts_with_units_equal_numbers_in_si():
    expected = zwidth.from_mass_matrix([[3e-3, 0], [0, 0.1]], [0.02, 3], jacobian=[[0.2, 1]], stiffness=[0.5, 0])
    texts = zwidth.from_mass_matrix(
        [["30 kg cm^2", 0], [0, "100 g"]],
        damping=["20 mN m s/rad", "3 N s/m"],
        jacobian=[[0.2, 1]],
        stiffness=["0.5 N m/rad", 0],
    )
    assert texts == expected
    knob = zwidth.from_mass_matrix([["30 kg cm^2"]], "20 mN m s/rad", rotary=True)
    assert knob == zwidth.from_mass_matrix([[3e-3]], 0.02, rotary=True)


def test_rotary_arm_with_damped_joints_has_rotary_units():
    device = zwidth.from_mass_matrix([[0.03, 0.01], [0.01, 0.01]], 0.02, direction=[1, 0], rotary=True)
    assert isinstance(device, zwidth.LinearDevice)
    assert eval(repr(device), {"from_mass_matrix": zwidth.from_mass_matrix}) == device
    assert eval(repr(zwidth.LinearDevice("1 / 1 2 0", rotary=True)), {"LinearDevice": zwidth.LinearDevice}).rotary
    scene = zwidth.Scene(device, zwidth.Timing("1 ms", "1 ms"), zwidth.VirtualWall("2 N m/rad"))
    assert scene.wall.stiffness == 2
    with pytest.raises(zwidth.InputError, match="linear units"):
        zwidth.Scene(device, zwidth.Timing("1 ms"), zwidth.VirtualWall("2 N/m"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mass_matrix": [[1, 0]]}, "mass_matrix: got shape (1, 2)"),
        ({"mass_matrix": [[1, 2], [2, 1]]}, "mass_matrix: got an eigenvalue of -1"),
        ({"mass_matrix": [[1, 0.5], [0, 1]]}, "mass_matrix: got a matrix that is not symmetric"),
        ({"mass_matrix": "heavy"}, "mass_matrix: got 'heavy'"),
        ({"mass_matrix": [[np.nan, 0], [0, 1]]}, "mass_matrix: got a value that is not finite"),
        ({"damping": [1, 2, 3]}, "damping: got 3 values for 2 joints"),
        ({"damping": [1, -2]}, "damping: got an eigenvalue of -2"),
        ({"stiffness": -1}, "stiffness: got an eigenvalue of -1"),
        ({"direction": None}, "direction: missing"),
        ({"direction": "u"}, "direction: got 'u'"),
        ({"direction": [0, 0]}, "direction: got a zero"),
        ({"direction": "up and down"}, "direction: got 'up and down'"),
        ({"direction": ["up", 1]}, "direction: got ['up', 1]; it must be finite numbers"),
        ({"jacobian": [["a", 0]]}, "jacobian: got 'a'; it must be a number in m"),
        ({"jacobian": [["a", 0]], "rotary": True}, "jacobian: got [['a', 0]]; it must be finite numbers"),
        ({"damping": "3 kg"}, "damping: got '3 kg'"),
        ({"damping": [[1, 0], [0]]}, "damping: got [[1, 0], [0]]; it must be numbers"),
        ({"direction": [1, 0, 0]}, "direction: got shape (3,)"),
        ({"jacobian": [1, 2]}, "jacobian: got shape (2,)"),
        ({"jacobian": [[0, 0], [1, 0]], "direction": [1, 0]}, "direction: no joint moves the point"),
    ],
)
def test_invalid_arguments_are_named(arguments, message):
    with pytest.raises(zwidth.InputError) as error:
        zwidth.from_mass_matrix(**{"mass_matrix": [[1, 0], [0, 1]], "direction": [1, 0]} | arguments)
    assert message in str(error.value)
