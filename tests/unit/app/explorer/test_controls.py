"""Controls of the explorer: conversion to scenes and back, configurations, links and invalid input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import zwidth
from zwidth.app.explorer.controls import (
    CHOICES,
    ROTARY_SLIDERS,
    SLIDERS,
    Controls,
    read_controls,
    read_link,
    to_link,
    to_python,
)
from zwidth.runs.record import find_config

CONFIGS = Path(__file__).parents[4] / "configs"
DEVICE = "mass: 0.1, period: 1 ms, delay: 1.5 periods"


def write_config(folder, scene):
    file = folder / "a.yaml"
    file.write_text(
        f"{{version: 1, name: a, scene: {{{scene}}}, studies: [{{kind: boundary, name: b, delta: 0, d: 0}}]}}",
        encoding="utf-8",
    )
    return file


@pytest.mark.parametrize("velocity", [kind for kind in CHOICES["velocity"] if kind != "VelocityFilter"])
@pytest.mark.parametrize("operator", CHOICES["operator"])
@pytest.mark.parametrize("coupling", CHOICES["coupling"])
def test_every_choice_is_a_scene_with_adjustable_parameters(velocity, operator, coupling):
    controls = Controls().change({"velocity": velocity, "operator": operator, "coupling": coupling})
    shown = controls.shown()
    assert type(controls.scene.velocity).__name__ == velocity
    assert {name: shown[name] for name in ("velocity", "operator", "coupling")} == {
        "velocity": velocity,
        "operator": operator,
        "coupling": coupling,
    }
    assert controls.change(shown) == controls
    for name in set(shown) & set(SLIDERS):
        changed = controls.change({name: shown[name] + 1})
        assert changed.shown()[name] == pytest.approx(shown[name] + 1, rel=1e-15)
        others = {other: value for other, value in changed.shown().items() if other != name}
        assert others == {other: value for other, value in shown.items() if other != name}


@pytest.mark.parametrize("motion", ["linear", "rotary"])
@pytest.mark.parametrize("position", ["none", "ExponentialFilter", "LowPass", "Butterworth", "Pll"])
def test_position_estimates_and_feedback_have_sliders(motion, position):
    controls = Controls().change({"motion": motion, "velocity": "LowPass"})
    controls = controls.change({"position": position, "feedback": "IntegralFeedback"})
    shown = controls.shown()
    assert (shown["position"], shown["feedback"]) == (position, "IntegralFeedback")
    assert controls.change(shown) == controls
    for name in (name for name in shown if name.startswith(("position.", "feedback."))):
        slider = controls.sliders[name]
        assert slider.low <= shown[name] <= slider.high
        moved = controls.change({name: 0.5 * shown[name] if not slider.whole else 2})
        assert moved.scene.parameters()[name] == pytest.approx(moved.shown()[name] / slider.per_si)
    assert controls.change({"position": "none", "feedback": "none"}).scene.position is None
    # A phase-locked loop estimates the velocity, too, and replaces the velocity estimate.
    assert shown["velocity"] == ("BackwardDifference" if position == "Pll" else "LowPass")


def test_units_are_converted_and_restored():
    normalized = Controls().change({"mode": "normalized"})
    shown = normalized.shown()
    assert shown.pop("mode") == "normalized"
    assert shown == pytest.approx({"delta": 0.1, "d": 1.0, "alpha": 0.1, "beta": 0.4}, rel=1e-15)
    back = normalized.change({"alpha": 0.2}).change({"mode": "physical"})
    assert back.scene.wall.stiffness == pytest.approx(20e3, rel=1e-15)
    assert back.scene.device.damping == pytest.approx(10, rel=1e-15)
    assert (back.scene.mass, back.scene.timing.period) == (0.1, 1e-3)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"mass": -1}, "mass m: got -1 g; it must be greater than 0 g"),
        ({"mass": "1"}, "mass m: got '1'"),
        ({"mass": True}, "mass m: got 'True'"),
        ({"mass": float("nan")}, "mass m: got 'nan'"),
        ({"mass": 10**400}, "mass m"),
        ({"mass": None}, "mass m: got 'None'"),
        ({"alpha": 1}, "the page has no such parameter"),
        ({"__class__": 1}, "the page has no such parameter"),
        ({"velocity": "x" * 1000}, "choose one of"),
        ({"velocity": ["LowPass"]}, "choose one of"),
        ({"velocity": "VelocityFilter"}, "in a configuration file"),
        ({"position": "Observer"}, "in a configuration file"),
        ({"position": "Pll", "position.bandwidth": 900}, "position.bandwidth: got 900 rad/s; the PLL is unstable"),
        ({"velocity": "LowPass", "velocity.cutoff": 600}, "velocity.cutoff: got 600 Hz"),
        ({"delay": 1e6}, "delay: the loop has"),
        ({"velocity": "WindowedDifference", "velocity.samples": 900}, "delay: the loop has"),
    ],
)
def test_invalid_value_raises_with_its_name(change, message):
    with pytest.raises(zwidth.InputError) as refusal:
        Controls().change(change)
    assert message in str(refusal.value)
    assert len(str(refusal.value)) < 250


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.yaml")), ids=lambda file: file.stem)
def test_shipped_configurations_set_the_scene_or_raise(file):
    expected_scene: Any = zwidth.load_config(file).scene
    if expected_scene is None or getattr(expected_scene, "device", None) is not None:
        message = "scene: missing" if expected_scene is None else "scene.device: the page needs a model for all rates"
        with pytest.raises(zwidth.InputError, match=message):
            read_controls(file)
        return
    controls = read_controls(file)
    expected = expected_scene.to_scene() if not controls.normalized else None
    if expected is not None:
        assert controls.scene.replace(stiffness=0, virtual_damping=0) == expected.replace(
            stiffness=0, virtual_damping=0
        )
    if expected_scene.wall is None:
        assert controls.scene.is_stable(*controls.wall)
        assert controls.wall == tuple(float(f"{value:.4g}") for value in controls.wall)


@pytest.mark.parametrize(
    "velocity",
    [
        "{kind: low_pass, time_constant: 5 ms, order: 2}",
        "{kind: low_pass, cutoff: 50, coded_period: 0.5 ms}",
        "{kind: filter, numerator: [500, 0, -500], denominator: [1, 0, 0]}",
        "{kind: butterworth, cutoff: 50, order: 3}",
    ],
)
def test_filter_of_a_configuration_is_preserved(tmp_path, velocity):
    file = write_config(tmp_path, f"{DEVICE}, stiffness: 1000, virtual_damping: 2, velocity: {velocity}")
    controls = read_controls(file)
    expected_scene: Any = zwidth.load_config(file).scene
    assert controls.scene == expected_scene.to_scene()
    assert controls.change({"mass": 200}).scene.velocity == controls.scene.velocity
    assert controls.change(controls.shown()).scene.d == 1.5


def test_obsolete_keys_and_folders_without_a_run_raise(tmp_path):
    with pytest.raises(zwidth.ConfigError, match="delay_model: key of an earlier release"):
        read_controls(write_config(tmp_path, f"{DEVICE}, delay_model: fractional_power"))
    with pytest.raises(zwidth.InputError, match="no run with a recorded configuration"):
        find_config(tmp_path)


def test_run_folder_supplies_its_scene(tmp_path, unpainted):
    file = write_config(tmp_path, f"{DEVICE}, stiffness: 1000")
    assert zwidth.run(file, out=tmp_path / "run").ok
    assert read_controls(find_config(tmp_path / "run")) == read_controls(file)


@pytest.mark.parametrize("operator", CHOICES["operator"])
@pytest.mark.parametrize("coupling", CHOICES["coupling"])
def test_rotary_device_is_preserved_by_every_conversion(operator, coupling):
    controls = Controls().change({"motion": "rotary"}).change({"operator": operator, "coupling": coupling})
    shown = controls.shown()
    assert controls.scene.device.rotary
    assert controls.change(shown) == controls
    assert read_link(to_link(controls)) == controls
    assert "rotary=True" in to_python(controls)
    for name in set(shown) & set(ROTARY_SLIDERS):
        changed = controls.change({name: shown[name] * 1.5 + 1})
        assert changed.shown()[name] == pytest.approx(shown[name] * 1.5 + 1, rel=1e-15)
        assert ROTARY_SLIDERS[name].low <= shown[name] <= ROTARY_SLIDERS[name].high
    if not controls.scene.nonrigid_parts and operator == "none":
        assert controls.change({"mode": "normalized"}).change({"mode": "physical"}) == controls
    assert not controls.change({"motion": "linear"}).scene.device.rotary


@pytest.mark.parametrize("damping", ["0", "[0.02, 0.05]", "[0.02, 0.05], rotary: true"])
def test_arm_is_kept_in_links_and_scripts(tmp_path, damping):
    arm = f"device: {{mass_matrix: [[0.03, 0.01], [0.01, 0.01]], direction: [1, 0], damping: {damping}}}"
    controls = read_controls(write_config(tmp_path, f"{arm}, period: 1 ms, delay: 1 ms"))
    assert read_link(to_link(controls)).scene.device == controls.scene.device
    names: dict[str, Any] = {"zwidth": zwidth}
    script = to_python(controls)
    exec(
        script[script.index("scene = ") : script.index(",\n    timing=")] + ",\n    timing=zwidth.Timing(1e-3))", names
    )
    # Numbers with units, such as "21.74 g" for the mass of a rigid arm, are equal to rounding errors.
    assert names["scene"].device.mass == pytest.approx(controls.scene.device.mass, rel=1e-12)
    assert names["scene"].device.rotary == controls.scene.device.rotary
