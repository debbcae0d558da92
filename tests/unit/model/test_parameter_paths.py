"""Parameters by dotted path: every number of every part is listed, and each can be replaced."""

import dataclasses

import pytest

import zwidth
from zwidth.core.errors import InputError

SCENE = zwidth.Scene(
    zwidth.Device(0.1, 10, zwidth.Coupling(0.05, 20e3, 1.0, "tip")),
    zwidth.Timing(1e-3, 5e-4),
    zwidth.VirtualWall(1e3, 2.0),
    zwidth.LowPass(cutoff=100, order=2),
    zwidth.Operator(0.5, 6.0, 135.0, 800.0, 4.0),
)
LISTED = {
    "mass": 0.1,
    "damping": 10.0,
    "period": 1e-3,
    "delay": 5e-4,
    "velocity.cutoff": 100.0,
    "velocity.order": 2,
    "operator.mass": 0.5,
    "operator.damping": 6.0,
    "operator.stiffness": 135.0,
    "operator.coupling_stiffness": 800.0,
    "operator.coupling_damping": 4.0,
    "coupling.mass": 0.05,
    "coupling.stiffness": 20e3,
    "coupling.damping": 1.0,
    "stiffness": 1e3,
    "virtual_damping": 2.0,
}


def test_every_number_is_listed():
    assert SCENE.parameters() == LISTED
    bare = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3))
    assert list(bare.parameters()) == ["mass", "damping", "period", "delay", "stiffness", "virtual_damping"]


@pytest.mark.parametrize("path", LISTED)
def test_each_is_replaced_alone(path):
    value = 1 if path == "velocity.order" else 0.7 * LISTED[path]
    assert SCENE.replace(**{path: value}).parameters() == LISTED | {path: value}


def test_several_at_once_and_what_is_no_number():
    changed = SCENE.replace(**{"mass": 0.2, "coupling.sensor": "motor", "coupling.mass": 0.01, "period": 2e-3})
    assert changed.parameters() == LISTED | {"mass": 0.2, "coupling.mass": 0.01, "period": 2e-3}
    assert changed.device.coupling is not None
    assert changed.device.coupling.sensor == "motor"
    assert SCENE.replace(rate=4000).timing.period == 0.25e-3
    assert SCENE.replace() == SCENE


def test_whole_parts():
    free = SCENE.replace(operator=None, coupling=None, velocity=zwidth.WindowedDifference(3), **{"velocity.samples": 5})
    assert free == zwidth.Scene(zwidth.Device(0.1, 10), SCENE.timing, SCENE.wall, zwidth.WindowedDifference(5), None)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"actuatr": None}, "parameter: got 'actuatr', .*'actuator', 'modes', .*; did you mean 'actuator'"),
        ({"velocity.cutof": 50}, "parameter: got 'velocity.cutof', .*did you mean 'velocity.cutoff'"),
        ({"velocity.samples": 5}, "parameter: got 'velocity.samples', allowed are 'mass', "),
        ({"operator.mass": -1.0}, "operator.mass: got -1 kg"),
        ({"velocity.time_constant": 0.1}, "velocity: got both cutoff and time_constant; pass either"),
        ({"rate": 1000, "period": 1e-3}, "either"),
        ({"operator": 3}, "operator: got 3; pass an object such as"),
    ],
)
def test_what_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        SCENE.replace(**changes)


@pytest.mark.parametrize("name", ["actuator", "coupling", "modes"])
def test_a_device_given_as_a_whole_has_no_parts_of_its_own(name):
    whole = zwidth.Scene(zwidth.LinearDevice(([1], [0.1, 10, 0])), zwidth.Timing(1e-3))
    with pytest.raises(InputError, match=f"parameter: got '{name}', allowed are 'system', .*'operator', 'safe_limit'$"):
        whole.replace(**{name: None})


def test_the_fields_of_parts_are_told_apart():
    """Bare names would otherwise lie."""
    names = [
        item.name for part in (zwidth.Device, zwidth.Timing, zwidth.VirtualWall) for item in dataclasses.fields(part)
    ]
    assert len(set(names)) == len(names)
