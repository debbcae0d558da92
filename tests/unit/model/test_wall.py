"""Which wall a question of a scene means: one rule, whichever the question."""

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


def draw(picture):
    from matplotlib.figure import Figure

    from zwidth import plot

    return lambda scene, *wall: [
        line.get_xydata().tolist()
        for line in getattr(plot, picture)(scene, *wall, ax=Figure().subplots()).lines
        if line.get_label()[0] != "_"
    ]


QUESTIONS = {
    "is_stable": lambda scene, *wall: scene.is_stable(*wall),
    "is_stable, all poles": lambda scene, *wall: scene.is_stable(*wall, method="companion"),
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
    "plot.step": draw("step"),
    "plot.nyquist": draw("nyquist"),
    "plot.poles": draw("poles"),
}


@pytest.mark.parametrize("question", QUESTIONS)
@pytest.mark.parametrize("name", SCENES)
def test_one_rule_for_the_wall(name, question):
    ask, scene = QUESTIONS[question], SCENES[name]
    bare = zwidth.Scene(DEVICE, TIMING, velocity=scene.velocity)
    expected = ask(bare, 10e3, 40.0)
    for found in (ask(scene), ask(scene, 10e3, 40.0)):
        for one, other in zip(as_arrays(found), as_arrays(expected), strict=True):
            np.testing.assert_array_equal(one, other)
    for one, other in zip(as_arrays(ask(bare, 1e3)), as_arrays(ask(bare, 1e3, 0.0)), strict=True):
        np.testing.assert_array_equal(one, other)
    refused = {(scene, 10e3): "40.0 N s/m; pass it", (scene, None, 5.0): "with virtual_damping"}
    refused |= {(bare,): "the scene has no wall", (bare, None, 5.0): "with virtual_damping"}
    for arguments, words in refused.items():
        with pytest.raises(InputError, match=words) as error:
            ask(*arguments)
        assert "\n" not in str(error.value)


def as_arrays(found):
    return [np.asarray(part) for part in (found if isinstance(found, tuple | list) else (found,))]


def test_a_row_and_a_column_are_those_of_the_scene_s_own_wall():
    for scene in SCENES.values():
        bare = zwidth.Scene(DEVICE, TIMING, velocity=scene.velocity)
        assert np.array_equal(scene.stable_stiffness(), bare.stable_stiffness(40.0))
        assert np.array_equal(bare.stable_stiffness(), bare.stable_stiffness(0.0))
        ((low, high),) = bare.stable_damping(10e3)
        assert np.array_equal(scene.stable_damping(), [[low, high]])
        assert bare.is_stable(10e3, [low - 1e-6, low + 1e-6, high - 1e-6, high + 1e-6]).tolist() == [0, 1, 1, 0]
        with pytest.raises(InputError, match="the scene has no wall"):
            bare.stable_damping()


def test_scenes_of_one_simulation_each_mean_their_own_wall():
    other = SCENES["rigid"].replace(stiffness=5e3)
    found = zwidth.simulate([SCENES["rigid"], other], start_position=1e-4, periods=20).position
    for row, scene in zip(found, (SCENES["rigid"], other), strict=True):
        alone = scene.simulate(start_position=1e-4, periods=20).position
        # Compiled for two lanes and for one, to the last places.
        np.testing.assert_allclose(row, alone, rtol=0, atol=1e-13 * np.abs(alone).max())
    with pytest.raises(InputError, match="the scene has no wall"):
        zwidth.simulate([other, zwidth.Scene(DEVICE, TIMING)])


def test_no_wall_stays_none_until_one_is_chosen():
    bare = zwidth.Scene(DEVICE, TIMING)
    for scene in (pickle.loads(pickle.dumps(bare)), copy.deepcopy(bare), bare.replace(mass=0.2)):
        with pytest.raises(InputError, match="the scene has no wall"):
            scene.is_stable()
    assert bare.replace(stiffness=5e3).wall == zwidth.VirtualWall(5e3)
    assert bare.replace(virtual_damping=5.0).wall == zwidth.VirtualWall(0.0, 5.0)
    assert bare.parameters()["stiffness"] == 0.0
    # A wall of no stiffness is one.
    assert not zwidth.Scene(DEVICE, TIMING, zwidth.VirtualWall(0.0)).is_stable()
