"""What limits a scene: each ideal scene is what its record says."""

import numpy as np
import pytest

from zwidth import Coupling, Device, LowPass, Scene, Timing, VelocityFilter, WindowedDifference, limits_of
from zwidth.scenes import assessment

RIGID = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3))


def test_a_filter_and_a_compliance():
    scene = RIGID.replace(velocity=LowPass(cutoff=100.0), coupling=Coupling(0.05, 2e4, 1.0))
    found = limits_of(scene)
    now = scene.max_stiffness().stiffness
    ideals = {
        "velocity": RIGID.replace(coupling=scene.device.coupling),
        "delay": scene.replace(delay=0.0),
        "coupling": RIGID.replace(velocity=scene.velocity, mass=0.15),
        "period": scene.replace(period=1e-3 / 64),
    }
    assert {limit.name for limit in found} == set(ideals)
    gains = [limit.gain for limit in found]
    assert gains == sorted(gains, reverse=True)
    for limit in found:
        assert limit.stiffness == pytest.approx(ideals[limit.name].max_stiffness().stiffness, rel=1e-12)
        assert limit.gain == pytest.approx(limit.stiffness / now, rel=1e-12)


def test_what_cannot_be_computed_comes_last(monkeypatch):
    scene = RIGID.replace(velocity=LowPass(cutoff=100.0), coupling=Coupling(0.05, 2e4, 1.0))
    first, *others = [limit.name for limit in limits_of(scene)]
    known = assessment._stiffness
    assert first == "delay"
    monkeypatch.setattr(assessment, "_stiffness", lambda of: np.nan if of.timing.delay == 0 else known(of))
    assert [limit.name for limit in limits_of(scene)] == [*others, first]


def test_only_what_the_scene_has():
    assert [limit.name for limit in limits_of(RIGID.replace(delay=0.0))] == ["period"]
    coefficients = VelocityFilter([500.0, 0.0, -500.0], [1.0, 0.0, 0.0])
    assert {limit.name for limit in limits_of(RIGID.replace(velocity=coefficients))} == {"velocity", "delay"}


def test_a_window_keeps_its_length_in_seconds():
    scene = RIGID.replace(velocity=WindowedDifference(15, coded_period=2e-3))
    (limit,) = [limit for limit in limits_of(scene) if limit.name == "period"]
    assert limit.words == "sampled 8 times faster"
    same = scene.replace(period=1e-3 / 8, velocity=WindowedDifference(120, coded_period=2e-3 / 8))
    assert limit.stiffness == pytest.approx(same.max_stiffness().stiffness, rel=1e-12)
