"""Copied configurations, scripts and links reproduce the view."""

from __future__ import annotations

import matplotlib.pyplot as plt
import pytest

import zwidth
from zwidth.app.explorer.controls import (
    Controls,
    normalized_controls,
    read_controls,
    read_link,
    to_link,
    to_python,
    to_yaml,
)

pytestmark = pytest.mark.usefixtures("unpainted")

VIEWS = {
    "rigid": Controls(),
    "unstable": Controls().change({"stiffness": 1e6}),
    "pushing": Controls().change({"stiffness": -5, "virtual_damping": -1}),
    "normalized": normalized_controls(0.1, 0.4, 0.1, 1.5),
    "rigid operator": Controls().change({"operator": "rigid"}),
    "operator mass only": Controls().change({"operator": "rigid"}).change({"operator.stiffness": 0, "damping": 0}),
    "all": Controls().change({"velocity": "Butterworth", "operator": "grasp", "coupling": "tip"}),
    "filter": Controls(
        Controls().scene.replace(velocity=zwidth.VelocityFilter([500, 0, -500], [1, 0, 0])),
    ),
    "position filter": Controls().change({"position": "ExponentialFilter", "feedback": "IntegralFeedback"}),
    "phase-locked loop": Controls().change({"motion": "rotary", "position": "Pll", "feedback": "IntegralFeedback"}),
    "actuator lag": Controls().change({"actuator": "second order"}),
    "resonance": Controls(
        zwidth.Scene(
            zwidth.Device(0.1, 1 / 3, modes=(zwidth.Mode(frequency=80, damping_ratio=0.02, mass=0.5),)),
            zwidth.Timing(period=1e-3),
            zwidth.VirtualWall(1000 / 7, 0),
        )
    ),
    "slow": Controls(Controls().scene.replace(velocity=zwidth.LowPass(time_constant=1e-5, coded_period=1e-4))),
}


@pytest.mark.parametrize("view", VIEWS)
def test_copied_configuration_runs_and_reproduces_the_view(tmp_path, view):
    file = tmp_path / "copied.yaml"
    file.write_text(to_yaml(VIEWS[view]), encoding="utf-8")
    assert read_controls(file) == VIEWS[view]
    result = zwidth.run(file, out=tmp_path / "run")
    assert result.ok, [study.error for study in result.studies]


def test_copied_configuration_has_one_quantity_per_line():
    assert "\n  virtual_damping: 40 mN m s/rad\n" in to_yaml(Controls().change({"motion": "rotary"}))


@pytest.mark.parametrize("view", VIEWS)
def test_copied_script_runs_and_reproduces_the_scene(capsys, view):
    scene, names = VIEWS[view].scene, {}
    try:
        exec(to_python(VIEWS[view]), names)
    finally:
        plt.close("all")
    assert names["scene"] == scene
    verdict = zwidth.assess(scene)
    verdict_word = "stable" if verdict.stable else "UNSTABLE"
    assert f"{verdict_word} spectral radius {verdict.spectral_radius:.6f}" in capsys.readouterr().out


@pytest.mark.parametrize("view", VIEWS)
def test_link_reproduces_the_view(view):
    link = to_link(VIEWS[view])
    assert read_link(link) == VIEWS[view]
    # These characters are encoded differently by some browsers.
    assert not set(link) & set(' "<>`#')


@pytest.mark.parametrize(
    "link, message",
    [
        ("nonsense", "address: the text after # is not a scene"),
        ("a=1&" * 200, "address: the text after # is not a scene"),
        ("modes=" + "[" * 100_000, "address: the text after # is not a scene"),
        ("mass=-1&period=1+ms", "scene.mass: got -1 kg"),
        ("mass=NaN&period=1+ms", "scene.mass: got .nan"),
        ("mass=100+g&period=1+ms&stiffness=1&delay=10+s", "delay"),
        ("mass=100+g&period=1+ms&delay_model=fractional_power", "scene.delay_model: key of an earlier release"),
        ("file=/etc/passwd", "scene.file: unknown key"),
    ],
)
def test_invalid_link_raises(link, message):
    with pytest.raises((zwidth.InputError, zwidth.ConfigError)) as refusal:
        read_link(link)
    assert message in str(refusal.value)


def test_copied_values_have_units_without_rounding_digits():
    view = Controls().change({"mass": 70.1, "delay": 0.7, "stiffness": 12340, "velocity": "LowPass"})
    assert "mass: 70.1 g\n" in to_yaml(view)
    assert "delay: 700 us\n  stiffness: 12.34 kN/m\n" in to_yaml(view)
    assert 'Timing(period="1 ms", delay="700 us")' in to_python(view)
    assert 'LowPass(cutoff="100 Hz")' in to_python(view)
    restored = Controls().change({"mode": "normalized"}).change({"mode": "physical"})
    assert to_link(restored) == to_link(Controls())
