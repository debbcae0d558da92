"""Test `Scene.parameters` and `Scene.replace`: every parameter is listed by its dotted path and can be replaced."""

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
PARAMETERS = {
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


def test_parameters_lists_every_parameter():
    assert SCENE.parameters() == PARAMETERS
    bare = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3))
    assert list(bare.parameters()) == ["mass", "damping", "period", "delay", "stiffness", "virtual_damping"]


@pytest.mark.parametrize("path", PARAMETERS)
def test_replace_changes_only_the_given_parameter(path):
    value = 1 if path == "velocity.order" else 0.7 * PARAMETERS[path]
    assert SCENE.replace(**{path: value}).parameters() == PARAMETERS | {path: value}


def test_replace_of_several_parameters_and_of_sensor_and_rate():
    changed = SCENE.replace(**{"mass": 0.2, "coupling.sensor": "motor", "coupling.mass": 0.01, "period": 2e-3})
    assert changed.parameters() == PARAMETERS | {"mass": 0.2, "coupling.mass": 0.01, "period": 2e-3}
    assert changed.device.coupling is not None
    assert changed.device.coupling.sensor == "motor"
    assert SCENE.replace(rate=4000).timing.period == 0.25e-3
    assert SCENE.replace() == SCENE


def test_replace_of_parts():
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
def test_replace_rejects_invalid_paths_and_values(changes, message):
    with pytest.raises(InputError, match=message):
        SCENE.replace(**changes)


@pytest.mark.parametrize("name", ["actuator", "coupling", "modes"])
def test_linear_device_has_no_replaceable_parts(name):
    scene = zwidth.Scene(zwidth.LinearDevice(([1], [0.1, 10, 0])), zwidth.Timing(1e-3))
    with pytest.raises(
        InputError, match=f"parameter: got '{name}', allowed are 'system', .*'operator', 'tool', 'safe_limit'$"
    ):
        scene.replace(**{name: None})


def test_field_names_of_parts_are_unique():
    """Paths without a prefix would be ambiguous otherwise."""
    names = [
        item.name for part in (zwidth.Device, zwidth.Timing, zwidth.VirtualWall) for item in dataclasses.fields(part)
    ]
    assert len(set(names)) == len(names)
