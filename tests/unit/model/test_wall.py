"""Test that all methods of a scene use the same rule for the wall: the arguments, otherwise the wall of the scene."""

import copy
import pickle

import numpy as np
import pytest

import zwidth
from zwidth.core.errors import InputError

DEVICE, TIMING, WALL = zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(10e3, 40)
SCENES = {
    "rigid": zwidth.Scene(DEVICE, TIMING, WALL),
    "filter": zwidth.Scene(DEVICE, TIMING, WALL, zwidth.LowPass(cutoff=200)),
}
HERTZ = np.array([5.0, 50.0])


def plot_curves(kind):
    from matplotlib.figure import Figure

    from zwidth import plot

    return lambda scene, *wall: [
        line.get_xydata().tolist()
        for line in getattr(plot, kind)(scene, *wall, ax=Figure().subplots()).lines
        if line.get_label()[0] != "_"
    ]


METHODS = {
    "is_stable": lambda scene, *wall: scene.is_stable(*wall),
    "is_stable, companion": lambda scene, *wall: scene.is_stable(*wall, method="companion"),
    "decide_stability": lambda scene, *wall: scene.decide_stability(*wall),
    "decide_stability, certified": lambda scene, *wall: scene.decide_stability(*wall, method="certified"),
    "poles": lambda scene, *wall: scene.poles(*wall),
    "spectral_radius": lambda scene, *wall: scene.spectral_radius(*wall),
    "margins": lambda scene, *wall: scene.margins(*wall),
    "passivity_margin": lambda scene, *wall: scene.passivity_margin(*wall),
    "is_passive": lambda scene, *wall: scene.is_passive(*wall),
    "state_space": lambda scene, *wall: scene.state_space(*wall),
    "open_loop": lambda scene, *wall: scene.open_loop(*wall),
    "frequency_response": lambda scene, *wall: scene.frequency_response(*wall, frequency=HERTZ),
    "normalize_walls": lambda scene, *wall: scene.normalize_walls(*wall),
    "simulate": lambda scene, *wall: scene.simulate(*wall, start_position=1e-4, periods=50).position,
    "zwidth.simulate": lambda scene, *wall: zwidth.simulate([scene], *wall, start_position=1e-4, periods=50).position,
    "to_control": lambda scene, *wall: zwidth.to_control(scene, *wall).A,
    "plot.step": plot_curves("step"),
    "plot.nyquist": plot_curves("nyquist"),
    "plot.poles": plot_curves("poles"),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", SCENES)
def test_all_methods_use_the_same_wall(name, method):
    call, scene = METHODS[method], SCENES[name]
    without_wall = zwidth.Scene(DEVICE, TIMING, velocity=scene.velocity)
    expected = call(without_wall, 10e3, 40.0)
    for result in (call(scene), call(scene, 10e3, 40.0)):
        for one, other in zip(as_arrays(result), as_arrays(expected), strict=True):
            np.testing.assert_array_equal(one, other)
    for one, other in zip(as_arrays(call(without_wall, 1e3)), as_arrays(call(without_wall, 1e3, 0.0)), strict=True):
        np.testing.assert_array_equal(one, other)
    messages = {(scene, 10e3): "40.0 N s/m; pass it", (scene, None, 5.0): "with virtual_damping"}
    messages |= {(without_wall,): "the scene has no wall", (without_wall, None, 5.0): "with virtual_damping"}
    for arguments, message in messages.items():
        with pytest.raises(InputError, match=message) as error:
            call(*arguments)
        assert "\n" not in str(error.value)


def as_arrays(result):
    return [np.asarray(part) for part in (result if isinstance(result, tuple | list) else (result,))]


def test_stable_intervals_default_to_the_wall_of_the_scene():
    for scene in SCENES.values():
        without_wall = zwidth.Scene(DEVICE, TIMING, velocity=scene.velocity)
        assert np.array_equal(scene.stable_stiffness(), without_wall.stable_stiffness(40.0))
        assert np.array_equal(without_wall.stable_stiffness(), without_wall.stable_stiffness(0.0))
        ((low, high),) = without_wall.stable_damping(10e3)
        assert np.array_equal(scene.stable_damping(), [[low, high]])
        assert without_wall.is_stable(10e3, [low - 1e-6, low + 1e-6, high - 1e-6, high + 1e-6]).tolist() == [0, 1, 1, 0]
        with pytest.raises(InputError, match="the scene has no wall"):
            without_wall.stable_damping()


def test_scenes_of_one_simulation_use_their_own_walls():
    other = SCENES["rigid"].replace(stiffness=5e3)
    positions = zwidth.simulate([SCENES["rigid"], other], start_position=1e-4, periods=20).position
    for trajectory, scene in zip(positions, (SCENES["rigid"], other), strict=True):
        single = scene.simulate(start_position=1e-4, periods=20).position
        # Compiled for two batch entries and for one, the results differ by rounding errors.
        np.testing.assert_allclose(trajectory, single, rtol=0, atol=1e-13 * np.abs(single).max())
    with pytest.raises(InputError, match="the scene has no wall"):
        zwidth.simulate([other, zwidth.Scene(DEVICE, TIMING)])


def test_scene_without_wall_keeps_none_until_a_parameter_is_replaced():
    scene_without_wall = zwidth.Scene(DEVICE, TIMING)
    for scene in (
        pickle.loads(pickle.dumps(scene_without_wall)),
        copy.deepcopy(scene_without_wall),
        scene_without_wall.replace(mass=0.2),
    ):
        with pytest.raises(InputError, match="the scene has no wall"):
            scene.is_stable()
    assert scene_without_wall.replace(stiffness=5e3).wall == zwidth.VirtualWall(5e3)
    assert scene_without_wall.replace(virtual_damping=5.0).wall == zwidth.VirtualWall(0.0, 5.0)
    assert scene_without_wall.parameters()["stiffness"] == 0.0
    # A wall with zero stiffness is a wall.
    assert not zwidth.Scene(DEVICE, TIMING, zwidth.VirtualWall(0.0)).is_stable()
