"""Test `limits_of`: each gain is the ratio of the maximum stiffness with and without the improvement."""

import numpy as np
import pytest

from zwidth import (
    Actuator,
    Butterworth,
    Coupling,
    Device,
    LowPass,
    Mode,
    Scene,
    Timing,
    VelocityFilter,
    WindowedDifference,
    limits_of,
)
from zwidth.analysis import assessment

RIGID = Scene(Device(0.1, 10.0), Timing(1e-3, 1e-3))


def test_limits_of_scene_with_filter_and_coupling():
    scene = RIGID.replace(velocity=LowPass(cutoff=100.0), coupling=Coupling(0.05, 2e4, 1.0))
    limits = limits_of(scene)
    original = scene.max_stiffness().stiffness
    improved = {
        "velocity": scene.replace(velocity=LowPass(cutoff=200.0)),
        "delay": scene.replace(delay=0.5e-3),
        "coupling": scene.replace(coupling=Coupling(0.05, 4e4, 1.0)),
        "period": scene.replace(period=0.5e-3),
        "damping": scene.replace(damping=11.0),
    }
    improved["period_and_delay"] = scene.replace(timing=Timing(0.5e-3, "1 periods"))
    assert {limit.name for limit in limits} == set(improved)
    gains = [limit.gain for limit in limits]
    assert gains == sorted(gains, reverse=True)
    for limit in limits:
        assert limit.stiffness == pytest.approx(improved[limit.name].max_stiffness().stiffness, rel=1e-12)
        assert limit.gain == pytest.approx(limit.stiffness / original, rel=1e-12)


def test_limits_that_cannot_be_computed_are_last(monkeypatch):
    scene = RIGID.replace(velocity=LowPass(cutoff=100.0), coupling=Coupling(0.05, 2e4, 1.0))
    names = [limit.name for limit in limits_of(scene)]
    compute, half_delay = assessment._compute_max_stiffness, Timing(1e-3, 0.5e-3)
    monkeypatch.setattr(
        assessment,
        "_compute_max_stiffness",
        lambda scene_changed: np.nan if scene_changed.timing == half_delay else compute(scene_changed),
    )
    names.remove("delay")
    assert [limit.name for limit in limits_of(scene)] == [*names, "delay"]


def test_limits_exist_only_for_parts_of_the_scene():
    assert [limit.name for limit in limits_of(RIGID.replace(delay=0.0, damping=0.0))] == ["period"]
    coefficients = VelocityFilter([500.0, 0.0, -500.0], [1.0, 0.0, 0.0])
    assert {limit.name for limit in limits_of(RIGID.replace(velocity=coefficients))} == {"delay", "damping"}


@pytest.mark.parametrize("velocity", [LowPass(cutoff=300.0, order=2), Butterworth(250.0)])
def test_filter_above_nyquist_at_double_cutoff_is_removed_instead(velocity):
    scene = RIGID.replace(velocity=velocity)
    (limit,) = [limit for limit in limits_of(scene) if limit.name == "velocity"]
    assert limit.label == "no velocity filter"
    assert limit.stiffness == RIGID.max_stiffness().stiffness


def test_window_keeps_its_length_in_seconds():
    scene = RIGID.replace(velocity=WindowedDifference(15, coded_period=2e-3))
    limits = {limit.name: limit for limit in limits_of(scene)}
    assert (limits["period"].label, limits["period"].note) == ("twice the rate", "the delay stays 1.000 ms")
    same = scene.replace(period=0.5e-3, velocity=WindowedDifference(30, coded_period=1e-3))
    assert limits["period"].stiffness == pytest.approx(same.max_stiffness().stiffness, rel=1e-12)
    half = scene.replace(velocity=WindowedDifference(8, coded_period=2e-3))
    assert limits["velocity"].stiffness == pytest.approx(half.max_stiffness().stiffness, rel=1e-12)


def test_limits_of_actuator_and_modes():
    device = Device(0.1, 10.0, actuator=Actuator(cutoff=300.0), modes=[Mode(200.0, 0.1, 0.5)])
    scene = Scene(device, Timing(1e-3))
    limits = {limit.name: limit for limit in limits_of(scene)}
    faster = scene.replace(**{"actuator.cutoff": 600.0})
    assert limits["actuator"].label == "an amplifier twice as fast"
    assert limits["actuator"].stiffness == pytest.approx(faster.max_stiffness().stiffness, rel=1e-12)
    stiffer = scene.replace(**{"modes.0.frequency": 200.0 * np.sqrt(2.0)})
    assert limits["modes"].stiffness == pytest.approx(stiffer.max_stiffness().stiffness, rel=1e-12)


def test_window_too_long_for_double_rate_has_no_period_limit(monkeypatch):
    # The set of improvements does not depend on their stiffness, so a constant suffices.
    monkeypatch.setattr(assessment, "_compute_max_stiffness", lambda of: 1.0)
    assert "period" not in {limit.name for limit in limits_of(RIGID.replace(velocity=WindowedDifference(70)))}
