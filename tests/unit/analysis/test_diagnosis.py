"""Test `zwidth.diagnose`: the cause of an oscillation, and remedies that stop the oscillation in simulations."""

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


def counts_per_turn(remedy: Any) -> int:
    return round(2 * math.pi / remedy.high)


def move(scene: Any, wall: tuple[float, float], **options: Any) -> Any:
    return scene.simulate(*wall, start_position=1e-3, periods=8000, record=False, **options)


def test_knob_with_coarse_encoder_has_quantization_limit_cycle() -> None:
    diagnosis = zwidth.diagnose(KNOB, 0.3, 1.4e-3, resolution="0.0005 rev", coulomb="0.1 mN m")
    assert diagnosis.cause == "quantization"
    assert diagnosis.linearly_stable
    # The oscillation stays within one encoder step.
    assert 0.1 * STEP < diagnosis.amplitude < STEP
    assert 20 < diagnosis.frequency < 200
    assert diagnosis.remedies is not None
    remedies = {remedy.parameter: remedy for remedy in diagnosis.remedies}
    assert set(remedies) == {"resolution", "coulomb", "stiffness"}
    # Friction below K Q/2 cannot hold the device against K times half an encoder step.
    assert remedies["coulomb"].low > 0.3 * STEP / 2
    assert remedies["stiffness"].high < 2 * 1e-4 / STEP
    assert remedies["resolution"].high < 2 * 1e-4 / 0.3
    assert f"(at least {counts_per_turn(remedies['resolution']):,} counts per turn)" in diagnosis.advise()
    assert diagnosis.word == "LIMIT CYCLE"


def test_quantization_remedies_stop_the_limit_cycle_in_simulation() -> None:
    options: dict[str, Any] = {"resolution": "20 um", "coulomb": "50 mN"}
    diagnosis = zwidth.diagnose(PHANTOM, "8.008 kN/m", 33.45, **options)
    assert diagnosis.cause == "quantization"
    assert diagnosis.remedies is not None
    assert len(diagnosis.remedies) >= 2
    for remedy in diagnosis.remedies:
        value = remedy.high if remedy.high < math.inf else remedy.low
        changed = {"stiffness": 8008, "virtual_damping": 33.45, **options} | {remedy.parameter: value}
        again = zwidth.diagnose(PHANTOM, remedies=False, **changed)
        assert (again.cause, again.amplitude) == ("none", 0.0), remedy


def test_limit_cycle_amplitude_without_friction_is_proportional_to_encoder_step() -> None:
    ratios = []
    for step in (2e-5, 2e-6, 2e-7):
        diagnosis = zwidth.diagnose(PHANTOM, 8008, 33.45, resolution=step, remedies=False)
        assert (diagnosis.cause, diagnosis.remedies) == ("quantization", None)
        assert diagnosis.advise().startswith("zwidth diagnose searches")
        ratios.append(diagnosis.amplitude / step)
    assert ratios == pytest.approx([ratios[0]] * 3, rel=1e-3)
    assert diagnosis.advise().endswith(
        "without friction a finer encoder only reduces the amplitude, in proportion to its steps"
    )


def test_wall_without_encoder_comes_to_rest() -> None:
    diagnosis = zwidth.diagnose(PHANTOM, 8008, 33, coulomb=0.05)
    assert (diagnosis.cause, diagnosis.amplitude, diagnosis.word, diagnosis.advise()) == ("none", 0.0, "AT REST", "")


def test_unstable_wall_remedies_are_stability_boundaries() -> None:
    diagnosis = zwidth.diagnose(PHANTOM, 25000, 33, resolution="20 um", max_force=5)
    assert diagnosis.cause == "instability"
    assert diagnosis.word == "UNSTABLE"
    assert not diagnosis.linearly_stable
    # The saturated actuator bounds the oscillation.
    assert 0 < diagnosis.amplitude < 1
    assert math.isfinite(diagnosis.frequency)
    assert diagnosis.remedies is not None
    for remedy in diagnosis.remedies:
        for end, step in ((remedy.low, 0.98), (remedy.high, 1.02)):
            if math.isfinite(end):
                wall = {"stiffness": 25000, "virtual_damping": 33}
                assert PHANTOM.replace(**wall | {remedy.parameter: end}).is_stable()
                assert not PHANTOM.replace(**wall | {remedy.parameter: step * end}).is_stable()
    assert {remedy.parameter for remedy in diagnosis.remedies} >= {"stiffness", "delay"}


def test_conditionally_stable_wall_oscillates_due_to_saturation() -> None:
    # The stable interval of stiffness does not reach 0, and a saturated actuator lowers the effective stiffness.
    scene = zwidth.Scene(
        zwidth.Device(0.1, 3), zwidth.Timing(1e-4, 1e-4), velocity=zwidth.Butterworth(cutoff=20, order=4)
    )
    (low, _) = scene.stable_stiffness(20.0)[0]
    assert low > 3000
    diagnosis = zwidth.diagnose(scene, 1.05 * low, 20, max_force=0.5, remedies=False)
    assert diagnosis.cause == "saturation"
    assert diagnosis.linearly_stable
    assert "limit of 500 mN" in diagnosis.explain()
    assert 1e-4 < diagnosis.amplitude < 1e-3
    assert zwidth.diagnose(scene, 1.05 * low, 20).cause == "none"
    pendulum = zwidth.Scene(zwidth.LinearDevice(([1.0], [0.1, 0.2, -3.0])), zwidth.Timing(1e-3, 0.0))
    escaped = zwidth.diagnose(pendulum, 5, 5, max_force=1.0, remedies=False)
    assert (escaped.cause, escaped.amplitude, escaped.word) == ("saturation", math.inf, "UNBOUNDED")


def test_pure_damper_is_not_diagnosed_as_unstable() -> None:
    assert zwidth.diagnose(PHANTOM, 0, 20).cause == "none"


def test_diagnose_defaults_to_the_wall_of_the_scene() -> None:
    scene = PHANTOM.replace(wall=zwidth.VirtualWall(8008, 33.45))
    diagnosis = zwidth.diagnose(scene, resolution=2e-5, remedies=False)
    assert (diagnosis.stiffness, diagnosis.virtual_damping, diagnosis.remedies) == (8008, 33.45, None)
    assert diagnosis.as_dict()["hardware"]["max_force"] is None


@pytest.mark.parametrize(
    ("options", "field"),
    [({"resolution": -1}, "resolution"), ({"coulomb": "1 kg"}, "coulomb"), ({"max_force": 0}, "max_force")],
)
def test_diagnose_rejects_invalid_arguments(options: dict[str, Any], field: str) -> None:
    with pytest.raises(zwidth.InputError, match=f"^{field}: got"):
        zwidth.diagnose(PHANTOM, 8008, 33, **options)
    walls: Any = [8008, 9000]
    with pytest.raises(zwidth.InputError, match=r"got shape \(2,\); pass one wall"):
        zwidth.diagnose(PHANTOM, walls, 33)
    with pytest.raises(zwidth.InputError, match="stiffness: none is given"):
        zwidth.diagnose(PHANTOM)


def test_weakly_damped_loop_is_undecided() -> None:
    scene = zwidth.Scene(zwidth.Device(0.1, 1e-6), zwidth.Timing(1e-3, 0.0))
    edge = scene.stable_stiffness(0.5)[0, 1]
    diagnosis = zwidth.diagnose(scene, edge * (1 - 1e-9), 0.5, resolution=1e-6)
    assert diagnosis.cause == "undecided"
    assert np.isfinite(diagnosis.phase_margin)
