"""What is copied reproduces the view."""

from __future__ import annotations

import matplotlib.pyplot as plt
import pytest

import zwidth
from zwidth.pages.explorer.controls import Controls, normalized_controls, read_controls, to_python, to_yaml

VIEWS = {
    "rigid": Controls(),
    "unstable": Controls().change({"stiffness": 1e6}),
    "pushing": Controls().change({"stiffness": -5, "virtual_damping": -1}),
    "normalized": normalized_controls(0.1, 0.4, 0.1, 1.5),
    "hand": Controls().change({"operator": "rigid"}),
    "massive hand": Controls().change({"operator": "rigid"}).change({"operator.stiffness": 0, "damping": 0}),
    "all": Controls().change({"velocity": "Butterworth", "operator": "grasp", "coupling": "tip"}),
    "filter": Controls(
        Controls().scene.replace(velocity=zwidth.VelocityFilter([500, 0, -500], [1, 0, 0])),
    ),
    "slow": Controls(Controls().scene.replace(velocity=zwidth.LowPass(time_constant=1e-5, coded_period=1e-4))),
}


@pytest.mark.parametrize("view", VIEWS)
def test_the_configuration_runs_and_is_the_view(tmp_path, view):
    file = tmp_path / "copied.yaml"
    file.write_text(to_yaml(VIEWS[view]), encoding="utf-8")
    assert read_controls(file) == VIEWS[view]
    result = zwidth.run(file, out=tmp_path / "run")
    assert result.ok, [study.error for study in result.studies]


@pytest.mark.parametrize("view", VIEWS)
def test_the_script_runs_and_has_the_view_s_scene(capsys, view):
    scene, names = VIEWS[view].scene, {}
    try:
        exec(to_python(VIEWS[view]), names)
    finally:
        plt.close("all")
    assert names["scene"] == scene
    verdict = zwidth.assess(scene)
    word = "stable" if verdict.stable else "UNSTABLE"
    assert f"{word} spectral radius {verdict.spectral_radius:.6f}" in capsys.readouterr().out
