"""`zwidth.stiffest_walls` and variants of scenes: equal to the search of each scene by itself."""

from __future__ import annotations

import numpy as np
import pytest

import zwidth
from zwidth import (
    Actuator,
    Butterworth,
    Coupling,
    Device,
    InputError,
    LinearDevice,
    LowPass,
    Mode,
    Operator,
    RidgeKind,
    Scene,
    Status,
    Timing,
    VirtualWall,
    WindowedDifference,
    stiffest_walls,
)
from zwidth.analysis import ensemble

TIMING = Timing(1e-3, 1.5e-3)
FILTER = LowPass(cutoff=100)
TIP = Coupling(0.05, 2e4, 2.0)
SCENES = {
    "low-pass": Scene(Device(0.1, 10), TIMING, velocity=FILTER),
    "two low-passes": Scene(Device(0.1, 10), TIMING, velocity=LowPass(time_constant=2e-3, order=2)),
    "window": Scene(Device(0.1, 10), TIMING, velocity=WindowedDifference(5)),
    "Butterworth": Scene(Device(0.1, 10), TIMING, velocity=Butterworth(80)),
    "actuator": Scene(Device(0.1, 10, actuator=Actuator(300, order=2)), TIMING),
    "mode": Scene(Device(0.1, 10, modes=[Mode(120, 0.02, 0.5)]), TIMING, velocity=FILTER),
    "negative mode": Scene(Device(0.1, 10, modes=[Mode(120, 0.002, -0.5)]), TIMING),
    "coupling": Scene(Device(0.1, 10, coupling=TIP), Timing(1e-3, "1 period")),
    "tip": Scene(Device(0.1, 10, coupling=Coupling(0.05, 2e4, 2.0, sensor="tip")), TIMING, velocity=FILTER),
    "hand": Scene(Device(0.1, 10, coupling=TIP), TIMING, velocity=FILTER, operator=Operator(0.5, 6.0, 130.0, 1e3, 5.0)),
    "rigid hand": Scene(Device(0.1, 10), TIMING, velocity=FILTER, operator=Operator(0.5, 6.0, 130.0)),
    "linear": Scene(LinearDevice(([-2.0, 30.0, 9e4], [0.1, 12.0, 2.2e4, 9e5, 0.0])), TIMING, velocity=FILTER),
    "no damping": Scene(Device(0.1, 0.0), Timing(1e-3, 1e-3), velocity=FILTER),
}


def vary(scene: Scene, count: int) -> dict[str, np.ndarray]:
    """Return random values of all parameters of a scene that are not 0, within a factor of 2."""
    generator = np.random.default_rng(1)
    names = [name for name, value in scene.parameters().items() if isinstance(value, float) and value != 0]
    return {name: scene.parameters()[name] * 2.0 ** generator.uniform(-1, 1, count) for name in names}


def build(scene: Scene, values: dict[str, np.ndarray], k: int) -> Scene:
    """Return one of the varied scenes."""
    return scene.replace(**{name: float(column[k]) for name, column in values.items()})


@pytest.mark.parametrize("name", SCENES)
def test_stiffest_walls_equal_those_of_single_scenes(name):
    scene, values = SCENES[name], vary(SCENES[name], 24)
    walls = stiffest_walls(scene, values)
    assert np.mean(walls.searched) < 0.2
    for k in range(0, 24, 4):
        top = build(scene, values, k).max_stiffness()
        np.testing.assert_allclose(walls.stiffness[k], top.stiffness, rtol=1e-9)
        np.testing.assert_allclose(walls.frequency[k], top.frequency, rtol=1e-6)
        assert (walls.kind[k], walls.status[k]) == (top.kind, top.status)


def test_negative_damping_is_allowed_on_request():
    scene = SCENES["low-pass"]
    values = {"velocity.cutoff": np.geomspace(2, 60, 16)}
    least, any_damping = (stiffest_walls(scene, values, negative_damping=choice) for choice in (False, True))
    assert np.all(least.virtual_damping >= 0)
    below = any_damping.virtual_damping < 0
    assert np.any(below)
    assert np.all(least.kind[below] == RidgeKind.NO_DAMPING)
    k = int(np.flatnonzero(below)[0])
    top = build(scene, values, k).max_stiffness(negative_damping=True)
    np.testing.assert_allclose(any_damping.stiffness[k], top.stiffness, rtol=1e-9)


def test_walls_of_a_scene_do_not_depend_on_the_other_scenes():
    scene, values = SCENES["hand"], vary(SCENES["hand"], 20)
    together = stiffest_walls(scene, values)
    listed = stiffest_walls([build(scene, values, k) for k in range(20)])
    halves = [
        stiffest_walls(scene, {name: column[part] for name, column in values.items()})
        for part in (slice(7), slice(7, 20))
    ]
    for one, other, *parts in zip(together, listed, *halves, strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one, np.concatenate(parts))


def test_a_stable_interval_between_two_neighboring_nodes_is_not_missed():
    # Above a corner, the line of constant K has a stable interval of B whose two crossings lie between two nodes. There
    # k has an inflection, so that the tangents at both nodes do not meet below 0.
    tip = Coupling(mass=0.013077892958936166, stiffness=15491.16384893111, damping=4.604129519090308)
    device = Device(mass=0.03209467560615074, damping=14.731931522678714, coupling=tip)
    scene = Scene(device, Timing(period=0.0005848654306631077, delay=0.0002189259337193867))
    walls = stiffest_walls(scene, {"mass": device.mass * np.linspace(0.999, 1.001, 9)})
    np.testing.assert_allclose(walls.stiffness[4], scene.max_stiffness().stiffness, rtol=1e-9)
    assert np.ptp(walls.stiffness) < 0.01 * walls.stiffness[4]


def test_few_scenes_are_searched_one_by_one():
    scene, values = SCENES["low-pass"], {"mass": [0.1, 0.2, 0.3]}
    walls = stiffest_walls(scene, values)
    assert walls.searched.all()
    expected = [scene.replace(mass=mass).max_stiffness().stiffness for mass in values["mass"]]
    np.testing.assert_array_equal(walls.stiffness, expected)


def test_a_wall_that_only_a_bent_path_connects_to_zero_stiffness_is_confirmed():
    # Just below this maximum, no wall with the same B is stable, and the ray from K = B = 0 leaves the stable set.
    device = Device(0.137, 0.497, coupling=Coupling(0.617, 30300.0, 83.9))
    scene = Scene(device, Timing("1.8 ms", "2.89 ms"))
    walls = stiffest_walls(scene, {"mass": np.linspace(0.135, 0.139, 9)})
    assert not walls.searched.any()
    np.testing.assert_allclose(walls.stiffness[4], scene.max_stiffness().stiffness, rtol=1e-9)


def test_scenes_of_different_structures_may_be_mixed():
    scenes = [*SCENES.values(), Scene(Device(0.1, 10), Timing(1e-3, 1e-3)), Scene(Device(0.1, 50), Timing(1e-3))]
    walls = stiffest_walls(scenes)
    expected = [float(scene.max_stiffness().stiffness) for scene in scenes]
    np.testing.assert_allclose(walls.stiffness, expected, rtol=1e-9)


def test_parameters_broadcast_and_invalid_scenes_are_marked():
    walls = stiffest_walls(SCENES["low-pass"], {"velocity.cutoff": [[50], [900]], "mass": [0.1, 0.2, -1]})
    assert walls.stiffness.shape == (2, 3)
    expected = np.array([[Status.OK, Status.OK, Status.INVALID_INPUT], [Status.INVALID_INPUT] * 3])
    np.testing.assert_array_equal(walls.status, expected)
    np.testing.assert_array_equal(np.isfinite(walls.stiffness), expected == Status.OK)


def test_rate_and_delay_in_periods_are_understood():
    scene = SCENES["coupling"]
    rates = np.array([800.0, 1000.0, 1500.0])
    walls = stiffest_walls(scene, {"rate": rates})
    expected = [float(scene.replace(rate=rate).max_stiffness().stiffness) for rate in rates.tolist()]
    np.testing.assert_allclose(walls.stiffness, expected, rtol=1e-9)


def test_an_invalid_scene_does_not_affect_the_others():
    scene = SCENES["low-pass"]
    walls = stiffest_walls([scene, scene.replace(**{"velocity.cutoff": 900})])
    np.testing.assert_array_equal(walls.status, [Status.OK, Status.INVALID_INPUT])


def test_long_delays_are_searched_one_by_one():
    scene = SCENES["low-pass"]
    walls = stiffest_walls(scene, {"delay": [30e-3, 30.5e-3]})
    np.testing.assert_array_equal(walls.searched, [True, True])
    np.testing.assert_allclose(walls.stiffness[0], scene.replace(delay=30e-3).max_stiffness().stiffness)


def test_an_empty_list_and_a_single_scene_are_allowed():
    assert stiffest_walls([]).stiffness.shape == (0,)
    assert stiffest_walls(SCENES["low-pass"]).stiffness.shape == ()


def test_wrong_arguments_are_named():
    with pytest.raises(InputError, match="scene: got 3"):
        stiffest_walls([3])  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"parameters: .*velocity.cut"):
        stiffest_walls(SCENES["low-pass"], {"velocity.cut": [1.0]})
    with pytest.raises(InputError, match="parameters: allowed only"):
        stiffest_walls(list(SCENES.values()), {"mass": [1.0]})


@pytest.mark.parametrize("name", ["low-pass", "mode", "hand"])
def test_labels_and_limits_of_variants_equal_those_of_single_scenes(name):
    scene = SCENES[name].replace(wall=VirtualWall(6e3, 15.0))
    values = vary(scene.replace(wall=VirtualWall(0.0)), 40)
    variants, dampings = scene.loop.vary(values), np.array([0.0, 15.0, 60.0])
    labels, limits = variants.labels(6e3, 15.0), variants.find_stiffness_limits(dampings)
    for k in range(0, 40, 5):
        single = build(scene, values, k)
        assert labels[k] == single.is_stable()
        expected = variants._find_limits(single, dampings)
        np.testing.assert_allclose(limits[k], expected, rtol=1e-9)


def test_measured_devices_are_searched_one_by_one():
    w = np.linspace(1, 499, 300)
    z = np.exp(2j * np.pi * w / 1000)
    device = zwidth.MeasuredDevice(w, 1e-5 / (z * (z - 1) * (z - 0.9)))
    scene = Scene(device, Timing(1e-3))
    walls = stiffest_walls([scene])
    top = scene.max_stiffness()
    np.testing.assert_allclose(walls.stiffness, [top.stiffness], rtol=0, atol=0)
    assert walls.searched.all()


def test_values_may_be_texts_with_units():
    walls = stiffest_walls(SCENES["low-pass"], {"mass": ["100 g", "0.2 kg"], "delay": ["1 ms", "2 ms"]})
    numbers = stiffest_walls(SCENES["low-pass"], {"mass": [0.1, 0.2], "delay": [1e-3, 2e-3]})
    np.testing.assert_array_equal(walls.stiffness, numbers.stiffness)


def test_rigid_devices_have_a_closed_form():
    scene = Scene(Device(0.1, 10), Timing("1 ms", "1 ms"))
    values = {"mass": [0.1, 0.2, -1, 0.3], "damping": [10, 0, -5, np.nan]}
    walls = stiffest_walls(scene, values)
    np.testing.assert_array_equal(walls.status == Status.OK, [True, True, False, False])
    assert not walls.searched.any()
    expected = [float(scene.replace(mass=m, damping=b).max_stiffness().stiffness) for m, b in ((0.1, 10), (0.2, 0))]
    np.testing.assert_allclose(walls.stiffness, [*expected, np.nan, np.nan], rtol=1e-14)
    rates = stiffest_walls(scene, {"rate": [1000, 2000, 0]})
    np.testing.assert_allclose(rates.stiffness[1], scene.replace(rate=2000).max_stiffness().stiffness, rtol=1e-14)
    assert rates.status[2] == Status.INVALID_INPUT


def test_scenes_with_a_part_that_batches_do_not_know_are_searched_one_by_one(monkeypatch):
    monkeypatch.setattr(ensemble, "EVALUATED", tuple(name for name in ensemble.EVALUATED if name != "operator"))
    scene = SCENES["rigid hand"]
    for walls in (
        stiffest_walls(scene, {"mass": np.linspace(0.1, 0.2, 8)}),
        stiffest_walls([SCENES["low-pass"], *[scene.replace(mass=mass) for mass in np.linspace(0.1, 0.2, 8)]]),
    ):
        assert walls.searched.all()
