"""The admittance study: limits and virtual masses against `zwidth.AdmittanceDisplay`, units, and messages."""

from typing import Any

import numpy as np
import pytest
from sweeping import run_main

import zwidth
from zwidth.core.errors import ConfigError
from zwidth.studies.document import load_config

pytestmark = pytest.mark.usefixtures("unpainted")

STUDY = (
    "{kind: admittance, name: a, virtual_mass: [2 kg, 20 kg], virtual_damping: [60, 200 N s/m], "
    "robot: {time_constant: 20 ms}, rate: 500 Hz, delay: [1 periods, 4 periods], command: velocity, "
    "integrator: trapezoidal, environment_damping: [0, 10], hand_stiffness: 5 kN/m}"
)


def write_config(folder, study=STUDY, scene=""):
    file = folder / "a.yaml"
    file.write_text(f"version: 1\nname: a\n{scene}studies:\n  - {study}\n", encoding="utf-8")
    return file


def read(file):
    return np.genfromtxt(file, delimiter=",", names=True)


def make_display(M, D, d):
    robot, timing = zwidth.Actuator(time_constant="20 ms"), zwidth.Timing(rate="500 Hz", delay=f"{d} periods")
    return zwidth.AdmittanceDisplay(M, D, robot, timing, "velocity", "trapezoidal")


def test_every_row_agrees_with_its_display(tmp_path, capsys):
    assert run_main("run", write_config(tmp_path), "--out", tmp_path / "out") == 0
    output = " ".join(capsys.readouterr().out.split())
    table = read(tmp_path / "out" / "a.csv")
    assert table.size == 16
    for d, M, D, B, K, frequency in table.tolist():
        limit = make_display(M, D, d).max_environment_stiffness(B)
        assert (K, frequency) == (pytest.approx(limit.stiffness, rel=1e-12), pytest.approx(limit.frequency, rel=1e-12))
    masses = read(tmp_path / "out" / "a_masses.csv")
    assert masses.size == 8
    for d, D, B, stiffness, low, high in masses.tolist():
        mass = make_display(1, D, d).min_virtual_mass(stiffness, B)
        assert (low, high) == (pytest.approx(mass.virtual_mass, rel=1e-12), pytest.approx(mass.largest, rel=1e-12))
    assert "stable up to K = 2.160 kN/m with M = 20.00 kg, D = 60.00 N s/m, B = 0 N s/m, delay 4 periods and" in output
    assert (tmp_path / "out" / "a.png").exists()


def test_one_rotary_display_and_period_of_the_scene(tmp_path, capsys):
    study = "{kind: admittance, name: a, virtual_mass: 0.5 kg m^2, virtual_damping: 2 N m s/rad, robot: 400 / 1 28 400}"
    scene = "scene: {mass: 7e-6, period: 2 ms, delay: 4 ms}\n"
    assert run_main("run", write_config(tmp_path, study, scene), "--out", tmp_path / "out") == 0
    output = " ".join(capsys.readouterr().out.split())
    robot, timing = zwidth.LinearDevice("400 / 1 28 400"), zwidth.Timing("2 ms", "4 ms")
    limit = zwidth.AdmittanceDisplay("0.5 kg m^2", 2, robot, timing).max_environment_stiffness()
    table = read(tmp_path / "out" / "a.csv")
    assert table["stiffness_N_m_per_rad"] == pytest.approx(limit.stiffness, rel=1e-12)
    assert "D = 2.000 N m s/rad" in output
    assert not (tmp_path / "out" / "a.png").exists()
    # The saved configuration contains numbers without units.
    assert load_config(tmp_path / "out" / "config.yaml").studies[0].unit_system.rotary


def test_displays_without_limit_are_noted(tmp_path, capsys):
    study = STUDY.replace("[60, 200 N s/m]", "[0, 60]").replace("environment_damping: [0, 10], ", "")
    assert run_main("run", write_config(tmp_path, study), "--out", tmp_path / "out") == 0
    captured = capsys.readouterr()
    assert "4 of 8 displays have no result: 4 no boundary" in captured.out + captured.err


@pytest.mark.parametrize("spacing", ["linear", "log"])
def test_many_dampings_have_a_color_bar_instead_of_a_legend(tmp_path, spacing):
    dampings = f"{{{spacing}: {{start: 20, stop: 600, num: 60}}}}"
    study: Any = load_config(write_config(tmp_path, STUDY.replace("[60, 200 N s/m]", dampings))).studies[0]
    (ax,) = study.compute(None, True).figures[""]()
    figure = ax.figure
    assert [each.get_ylabel() for each in figure.axes[1:]] == ["virtual damping  $D$  in N s/m"]
    entries = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(entries) == 4
    assert entries[0].startswith("delay 1 period")
    # The layout engine issues a warning, an error in tests, if the legend leaves no space for the panel.
    figure.draw_without_rendering()
    assert ax.get_position().height > 0.5


@pytest.mark.parametrize(
    "old, new, path, message",
    [
        ("virtual_mass: [2 kg, 20 kg]", "virtual_mass: 0", "virtual_mass", "got 0"),
        ("{time_constant: 20 ms}", "3", "robot", "a robot is a lag or a linear system"),
        ("{time_constant: 20 ms}", "{time_constant: 20 ms, cutoff: 3 Hz}", "robot", "cutoff"),
        ("{time_constant: 20 ms}", "1 / x", "robot", "got '1 / x'"),
        ("{time_constant: 20 ms}", "{numerator: [0.1], denominator: [1, -0.9], sampled: 2 ms}", "robot", "sampled"),
        ("rate: 500 Hz", "rate: 500 Hz, period: 2 ms", "period", "both given"),
        ("delay: [1 periods, 4 periods], ", "", "delay", "missing"),
        ("command: velocity", "command: force", "command", "allowed are 'position', 'velocity'"),
        ("robot: {time_constant: 20 ms}, ", "", "robot", "missing"),
    ],
)
def test_invalid_values_are_reported_with_their_field(tmp_path, old, new, path, message):
    assert old in STUDY
    with pytest.raises(ConfigError) as error:
        load_config(write_config(tmp_path, STUDY.replace(old, new)))
    assert f"studies[0].{path}" in str(error.value)
    assert message in str(error.value)


def test_damper_of_a_sampled_robot_is_refused(tmp_path):
    sampled = "{numerator: [0.1], denominator: [1, -0.9], sampled: 2 ms}"
    study = STUDY.replace("{time_constant: 20 ms}", sampled).replace("command: velocity", "command: position")
    study = study.replace("[1 periods, 4 periods]", "[0, 2 ms]")
    with pytest.raises(ConfigError, match="got a damper with a sampled robot"):
        load_config(write_config(tmp_path, study))
    load_config(write_config(tmp_path, study.replace("environment_damping: [0, 10], ", "")))


def test_saved_configuration_reads_the_same(tmp_path):
    study = load_config(write_config(tmp_path)).studies[0]
    saved = study.model_dump(mode="json", exclude_none=True)
    assert type(study).model_validate(saved).model_dump(mode="json", exclude_none=True) == saved
