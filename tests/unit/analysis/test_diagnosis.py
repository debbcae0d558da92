"""Diagnosis of walls in time: the cause of an oscillation, and remedies that stop it in a simulation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import zwidth

STEP = 2 * math.pi / 2000
KNOB = zwidth.Scene(
    zwidth.Device(mass="60 g cm^2", damping="0.02 mN m s/rad"),
    zwidth.Timing(period=1e-3, delay="0.7 periods"),
    velocity=zwidth.LowPass(cutoff=100),
)
PHANTOM = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))


def count_turn(remedy: Any) -> int:
    return round(2 * math.pi / remedy.high)


def move(scene: Any, wall: tuple[float, float], **options: Any) -> Any:
    return scene.simulate(*wall, start_position=1e-3, periods=8000, record=False, **options)


def test_encoder_of_a_knob() -> None:
    found = zwidth.diagnose(KNOB, 0.3, 1.4e-3, resolution="0.0005 rev", coulomb="0.1 mN m")
    assert found.cause == "quantization"
    assert found.linearly_stable
    # Amplitude and frequency of an oscillation within a step of the encoder.
    assert 0.1 * STEP < found.amplitude < STEP
    assert 20 < found.frequency < 200
    assert found.remedies is not None
    remedies = {remedy.parameter: remedy for remedy in found.remedies}
    assert set(remedies) == {"resolution", "coulomb", "stiffness"}
    # With an external force of half a step times K, friction below K Q/2 cannot hold the device.
    assert remedies["coulomb"].low > 0.3 * STEP / 2
    assert remedies["stiffness"].high < 2 * 1e-4 / STEP
    assert remedies["resolution"].high < 2 * 1e-4 / 0.3
    assert f"(at least {count_turn(remedies['resolution']):,} counts per turn)" in found.advise()
    assert found.word == "LIMIT CYCLE"


def test_remedies_are_simulated() -> None:
    options: dict[str, Any] = {"resolution": "20 um", "coulomb": "50 mN"}
    found = zwidth.diagnose(PHANTOM, "8.008 kN/m", 33.45, **options)
    assert found.cause == "quantization"
    assert found.remedies is not None
    assert len(found.remedies) >= 2
    for remedy in found.remedies:
        value = remedy.high if remedy.high < math.inf else remedy.low
        changed = {"stiffness": 8008, "virtual_damping": 33.45, **options} | {remedy.parameter: value}
        again = zwidth.diagnose(PHANTOM, remedies=False, **changed)
        assert (again.cause, again.amplitude) == ("none", 0.0), remedy


def test_without_friction_the_limit_cycle_scales_with_the_encoder_step() -> None:
    ratios = []
    for step in (2e-5, 2e-6, 2e-7):
        found = zwidth.diagnose(PHANTOM, 8008, 33.45, resolution=step, remedies=False)
        assert (found.cause, found.remedies) == ("quantization", None)
        assert found.advise().startswith("zwidth diagnose searches")
        ratios.append(found.amplitude / step)
    assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-3)
    assert found.advise().endswith(
        "without friction a finer encoder only reduces the amplitude, in proportion to its steps"
    )


def test_without_an_encoder() -> None:
    found = zwidth.diagnose(PHANTOM, 8008, 33, coulomb=0.05)
    assert (found.cause, found.amplitude, found.word, found.advise()) == ("none", 0.0, "AT REST", "")


def test_linear_instability() -> None:
    found = zwidth.diagnose(PHANTOM, 25000, 33, resolution="20 um", max_force=5)
    assert found.cause == "instability"
    assert found.word == "UNSTABLE"
    assert not found.linearly_stable
    # The motor's limit keeps the oscillation bounded.
    assert 0 < found.amplitude < 1
    assert math.isfinite(found.frequency)
    assert found.remedies is not None
    for remedy in found.remedies:
        for end, step in ((remedy.low, 0.98), (remedy.high, 1.02)):
            if math.isfinite(end):
                wall = {"stiffness": 25000, "virtual_damping": 33}
                assert PHANTOM.replace(**wall | {remedy.parameter: end}).is_stable()
                assert not PHANTOM.replace(**wall | {remedy.parameter: step * end}).is_stable()
    assert {remedy.parameter for remedy in found.remedies} >= {"stiffness", "delay"}


def test_saturation() -> None:
    # Stable for an interval of stiffnesses that does not reach 0: a saturated motor acts as a softer wall.
    scene = zwidth.Scene(
        zwidth.Device(0.1, 3), zwidth.Timing(1e-4, 1e-4), velocity=zwidth.Butterworth(cutoff=20, order=4)
    )
    (low, _) = scene.stable_stiffness(20.0)[0]
    assert low > 3000
    found = zwidth.diagnose(scene, 1.05 * low, 20, max_force=0.5, remedies=False)
    assert found.cause == "saturation"
    assert found.linearly_stable
    assert "limit of 500 mN" in found.explain()
    assert 1e-4 < found.amplitude < 1e-3
    assert zwidth.diagnose(scene, 1.05 * low, 20).cause == "none"
    pendulum = zwidth.Scene(zwidth.LinearDevice(([1.0], [0.1, 0.2, -3.0])), zwidth.Timing(1e-3, 0.0))
    escaped = zwidth.diagnose(pendulum, 5, 5, max_force=1.0, remedies=False)
    assert (escaped.cause, escaped.amplitude, escaped.word) == ("saturation", math.inf, "UNBOUNDED")


def test_a_pure_damper_is_not_unstable() -> None:
    assert zwidth.diagnose(PHANTOM, 0, 20).cause == "none"


def test_the_wall_of_the_scene() -> None:
    scene = PHANTOM.replace(wall=zwidth.VirtualWall(8008, 33.45))
    found = zwidth.diagnose(scene, resolution=2e-5, remedies=False)
    assert (found.stiffness, found.virtual_damping, found.remedies) == (8008, 33.45, None)
    assert found.as_dict()["hardware"]["max_force"] is None


@pytest.mark.parametrize(
    ("options", "field"),
    [({"resolution": -1}, "resolution"), ({"coulomb": "1 kg"}, "coulomb"), ({"max_force": 0}, "max_force")],
)
def test_bad_input(options: dict[str, Any], field: str) -> None:
    with pytest.raises(zwidth.InputError, match=f"^{field}: got"):
        zwidth.diagnose(PHANTOM, 8008, 33, **options)
    walls: Any = [8008, 9000]
    with pytest.raises(zwidth.InputError, match=r"got shape \(2,\); pass one wall"):
        zwidth.diagnose(PHANTOM, walls, 33)
    with pytest.raises(zwidth.InputError, match="stiffness: none is given"):
        zwidth.diagnose(PHANTOM)


def test_undecided_where_the_loop_hardly_decays() -> None:
    scene = zwidth.Scene(zwidth.Device(0.1, 1e-6), zwidth.Timing(1e-3, 0.0))
    edge = scene.stable_stiffness(0.5)[0, 1]
    found = zwidth.diagnose(scene, edge * (1 - 1e-9), 0.5, resolution=1e-6)
    assert found.cause == "undecided"
    assert np.isfinite(found.phase_margin)
