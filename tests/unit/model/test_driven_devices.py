"""Test actuators and modes: validation, and their effect on the results of a scene.

References: finite differences, certified pole counts, and limits of fast actuators and heavy modes.
"""

from __future__ import annotations

from typing import Any, cast

import jax
import numpy as np
import proved_loop
import pytest

import zwidth


@pytest.fixture
def scene():
    device = zwidth.Device(
        0.1,
        2.0,
        zwidth.Coupling(0.05, 2e4, 1.0, "tip"),
        zwidth.Actuator(300.0, order=2, damping_ratio=0.6),
        [zwidth.Mode(180.0, 0.05, 0.8), zwidth.Mode(330.0, 0.05, -3.0)],
    )
    hand = zwidth.Operator(0.2, 3.0, 100.0)
    return zwidth.Scene(device, zwidth.Timing(1e-3, 0.3e-3), velocity=zwidth.LowPass(cutoff=80.0), operator=hand)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: zwidth.Actuator(), "actuator: got neither cutoff nor"),
        (lambda: zwidth.Actuator(100, 1e-3), "actuator: got cutoff and time_constant; pass either"),
        (lambda: zwidth.Actuator(-1), "actuator.cutoff: got -1"),
        (lambda: zwidth.Actuator(100, order=3), "actuator.order: got 3"),
        (lambda: zwidth.Actuator(100, damping_ratio=0.7), "for a first-order actuator; omit it, or pass order=2"),
        (lambda: zwidth.Actuator("100 N"), "actuator.cutoff: got '100 N'"),
        (lambda: zwidth.Mode(100, 0.0, 1), "mode.damping_ratio: got 0;"),
        (lambda: zwidth.Mode(100, "2 N", 1), "it must be a number without a unit"),
        (lambda: zwidth.Mode(100, 0.1, 0), "mode.mass: got 0.0; it must not be 0"),
        (lambda: zwidth.Device(1, modes=[3]), "modes: got \\[3\\]; it must be a list of zwidth.Mode"),
        (lambda: zwidth.Device(1, actuator=cast(Any, 3)), "actuator: got 3; it must be a zwidth.Actuator or None"),
    ],
)
def test_invalid_actuators_and_modes_are_rejected(make, message):
    with pytest.raises(zwidth.InputError, match=message):
        make()


@pytest.mark.parametrize("part", ["actuator", "modes"])
def test_parts_too_fast_for_the_period_are_rejected(part):
    parts = {"actuator": zwidth.Actuator(1e8), "modes": [zwidth.Mode(1e8, 0.1, 1)]}[part]
    scene = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(1e-3)).replace(**{part: parts})
    with pytest.raises(zwidth.InputError, match=f"{part}.*oscillates 1e\\+05 times per period"):
        scene.is_stable(1e3, 1.0)


@pytest.mark.parametrize("path", ["actuator.cutoff", "modes.0.frequency", "modes.1.mass", "modes.0.damping_ratio"])
def test_sensitivities_match_differences_of_max_stiffness(scene, path):
    value = scene.parameters()[path]

    def stiffest(change: float) -> float:
        return float(scene.replace(**{path: value * (1.0 + change)}).max_stiffness().stiffness)

    h = 1e-4
    difference = (8.0 * (stiffest(h) - stiffest(-h)) - (stiffest(2 * h) - stiffest(-2 * h))) / (12.0 * h * value)
    assert scene.sensitivities().per[path] == pytest.approx(difference, rel=1e-6)


def test_traced_gradient_equals_sensitivity(scene, x64):
    slope = jax.grad(lambda value: scene.replace(**{"modes.1.mass": value}).max_stiffness().stiffness)(-3.0)
    assert float(slope) == pytest.approx(scene.sensitivities().per["modes.1.mass"], rel=1e-7)


def test_certified_verdicts_match_certified_pole_counts(scene):
    top = scene.max_stiffness()
    stiffness = np.array([0.5, 1.0 - 1e-10, 1.0 + 1e-10]) * top.stiffness
    expected = [proved_loop.count_outside(scene, each, float(top.virtual_damping)) == 0 for each in stiffness]
    verdicts = scene.is_stable(stiffness, top.virtual_damping, method="certified")
    assert verdicts.tolist() == expected == [True, True, False]


@pytest.mark.parametrize("part", ["actuator", "modes"])
def test_passivity_is_undefined_with_actuator_or_modes(scene, part):
    single = zwidth.Scene(zwidth.Device(0.1, 2.0), scene.timing, zwidth.VirtualWall(1e3, 1.0))
    single = single.replace(**{part: getattr(scene.device, part)})
    with pytest.raises(zwidth.InputError, match=f"passivity with {'an ' if part == 'actuator' else ''}{part}"):
        single.passivity_margin()
    assert zwidth.assess(single).passive is None


def test_fast_actuator_and_heavy_mode_have_no_effect():
    plain = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.5e-3))
    wall = plain.max_stiffness().stiffness
    for part in ({"actuator": zwidth.Actuator(1e6)}, {"modes": [zwidth.Mode(100.0, 0.5, 1e9)]}):
        assert plain.replace(**part).max_stiffness().stiffness == pytest.approx(wall, rel=1e-3)


def test_actuator_lag_is_nearly_equivalent_to_a_delay():
    plain = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3))
    lag = plain.replace(actuator=zwidth.Actuator(time_constant=1e-4)).max_stiffness().stiffness
    delayed = plain.replace(delay=1e-4).max_stiffness().stiffness
    assert lag == pytest.approx(delayed, rel=0.02)
