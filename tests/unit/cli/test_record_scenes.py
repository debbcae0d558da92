"""Scene files for `zwidth fit`, `excite` and `respond`, and scenes with encoder, friction and motor."""

import json
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from loop_logs import make_knob

import zwidth
from zwidth.cli import cli
from zwidth.identification.device_fit import AlternativeDevice
from zwidth.identification.fit_report import format_alternative
from zwidth.studies.document import load_config
from zwidth.units.unit_system import LINEAR, ROTARY

pytestmark = pytest.mark.usefixtures("fitted_once", "unpainted")
KNOB = make_knob(4, samples=1000)
SCENE = """\
version: 1
name: knob
scene:
  mass: 60 g cm^2
  rate: {rate}
  velocity: {{kind: low_pass, cutoff: 80 Hz}}
  resolution: 16384 counts
  max_force: 20 mN m
studies: [{{kind: recommend, name: wall}}]
"""
ONSETS = "--buzz", "K=0.218 N m/rad B=0 f=26.5", "--buzz", "K=2.53 N m/rad B=0.008 N m s/rad f=107", "--noise", "2%"


def run(*arguments, code=0):
    result = CliRunner().invoke(cli, [str(word) for word in arguments])
    assert result.exit_code == code, result.output
    return result.stderr if code else result.stdout


def run_invalid(*arguments):
    result = CliRunner().invoke(cli, [str(word) for word in arguments])
    assert isinstance(result.exception, SystemExit | zwidth.ZwidthError)
    return result.stderr if isinstance(result.exception, SystemExit) else str(result.exception)


@pytest.fixture
def files(tmp_path):
    """Return a log with times, the same log without times, and a scene file."""
    rows = [f"{count:.0f},{torque:.8f}" for count, torque in zip(KNOB.reading, KNOB.torque, strict=True)]
    timed, bare, scene = tmp_path / "My knob.csv", tmp_path / "bare.csv", tmp_path / "knob.yaml"
    timed.write_text("\n".join(["t_ms,enc_counts,tau_Nm", *(f"{k},{row}" for k, row in enumerate(rows))]))
    bare.write_text("\n".join(["enc_counts,tau_Nm", *rows]))
    scene.write_text(SCENE.format(rate="1 kHz"))
    return timed, bare, scene


def test_fit_uses_period_encoder_and_filter_of_a_scene_file(files):
    timed, bare, scene = files
    given = "--resolution", "16384 counts", "--velocity-cutoff", "80 Hz", "--max-force", "20 mN m"
    expected = json.loads(run("fit", timed, *given, "--json"))
    assert json.loads(run("fit", timed, scene, "--json")) == expected
    assert json.loads(run("fit", bare, scene, "--json"))["mass"] == pytest.approx(expected["mass"], rel=1e-12)
    # Options override the file.
    slower = json.loads(run("fit", scene, bare, "--rate", "500 Hz", "--json"))
    assert slower["period"] == 2e-3


def test_fit_of_walls_uses_period_and_units_of_a_scene_file(files):
    given = "--rate", "1 kHz", "--velocity-cutoff", "80 Hz"
    # The walls contradict a rigid device, so no wall is recommended: exit code 1.
    assert run("fit", files[2], *ONSETS, "--json", code=1) == run("fit", *given, *ONSETS, "--json", code=1)


def test_excite_and_respond_use_a_scene_file(files, tmp_path):
    timed, bare, scene = files
    given = "--rate", "1 kHz", "--force", "20 mN m", "--resolution", "16384 counts", "--velocity-cutoff", "80 Hz"
    for out, arguments in (("a.csv", [scene]), ("b.csv", given), ("c.csv", [scene, "--force", "10 mN m"])):
        run("excite", *arguments, "--duration", "10 s", "--out", tmp_path / out)
    played = {out: np.loadtxt(tmp_path / out, delimiter=",", skiprows=1)[:, 1] for out in ("a.csv", "b.csv", "c.csv")}
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
    assert np.abs(played["a.csv"]).max() == pytest.approx(2.0 * np.abs(played["c.csv"]).max()) == 0.02
    given = "--resolution", "16384 counts", "--velocity-cutoff", "80 Hz"
    assert json.loads(run("respond", bare, scene, "--json"))["warnings"]
    assert run("respond", timed, scene, "--json") == run("respond", timed, *given, "--json")


def test_contradictions_between_log_and_scene_file_raise(files, tmp_path):
    timed, _, scene = files
    slow = tmp_path / "slow.yaml"
    slow.write_text(SCENE.format(rate="500 Hz"))
    assert "got 2.000 ms, but the samples of the log are 1.000 ms apart" in run_invalid("fit", timed, slow)
    linear = tmp_path / "linear.yaml"
    linear.write_text("version: 1\nname: a\nscene: {mass: 1, rate: 1 kHz}\nstudies: [{kind: recommend, name: b}]\n")
    arguments = "the record is that of a rotary device, but the scene file has a linear one"
    assert arguments in run_invalid("fit", timed, linear, "--resolution", "16384 counts")
    assert arguments in run_invalid("fit", linear, *ONSETS)
    assert "got 2 scene files" in run_invalid("fit", timed, scene, slow)
    assert "give one LOG.csv or several" in run_invalid("respond", scene)
    assert "give --force, --resolution" in run_invalid("excite", linear)


def test_fitted_scene_passes_friction_and_encoder_to_other_commands(files, tmp_path):
    fitted = tmp_path / "fitted.yaml"
    text = run("fit", files[0], "--resolution", "16384 counts", "--yaml")
    # Friction that the log does not show is omitted.
    assert "coulomb" not in text
    fitted.write_text(text.replace("  resolution:", "  coulomb: 0.1 mN m\n  resolution:"))
    config: Any = load_config(fitted)
    assert config.name == "fitted_my_knob"
    assert config.scene.hardware == {"resolution": pytest.approx(KNOB.step), "coulomb": 1e-4}
    wall = "--stiffness", "0.2 N m/rad", "--virtual-damping", "1 mN m s/rad"
    checked = json.loads(run("check", fitted, *wall, "--json"))["diagnosis"]
    for diagnosis in (checked, json.loads(run("diagnose", fitted, *wall, "--json"))):
        assert diagnosis["hardware"]["resolution"] == pytest.approx(KNOB.step)
        assert diagnosis["hardware"]["coulomb"] == 1e-4
    diagnosis = json.loads(run("diagnose", fitted, *wall, "--friction", "0.2 mN m", "--json"))["hardware"]
    assert (diagnosis["resolution"], diagnosis["coulomb"]) == (pytest.approx(KNOB.step), 2e-4)
    for arguments in (["recommend", fitted], ["fit", files[0], "--resolution", "16384 counts"]):
        printed = " ".join(run(*arguments).split())
        assert "grasps stable in all six reference grasps" in printed
        # Printed by the simulation for any final state.
        assert "the linear loop is stable" in printed


def test_largest_force_limits_the_code_of_a_fit(files, tmp_path):
    timed, _, scene = files
    given = "--resolution", "16384 counts", "--velocity-cutoff", "80 Hz"
    programs = [
        run("fit", timed, *arguments, "--code", "c") for arguments in ([scene], [*given, "--max-force", "20 mN m"])
    ]
    assert programs[0] == programs[1] != run("fit", timed, *given, "--code", "c")
    fitted = tmp_path / "fitted.yaml"
    fitted.write_text(run("fit", timed, scene, "--max-force", "10 mN m", "--yaml"))
    assert "  max_force: 0.01 N m # as given\n" in fitted.read_text()
    program = run("fit", timed, scene, "--max-force", "10 mN m", "--code", "c")
    assert run("recommend", fitted, "--code", "c") == program
    assert "0.01" in program
    assert (
        json.loads(run("fit", timed, scene, "--max-force", "10 mN m", "--json"))["diagnosis"]["hardware"]["max_force"]
        == 0.01
    )
    arguments = "the record is that of a rotary device, but --max-force has units of a linear one"
    assert arguments in run_invalid("fit", timed, *given, "--max-force", "3 N", "--code", "c")
    assert "must be greater than 0" in run_invalid("fit", timed, *given, "--max-force", "-3 N m")


def test_scene_supplies_its_hardware_to_simulations(files):
    text = (
        files[2]
        .read_text()
        .replace(
            "{kind: recommend, name: wall}", "{kind: simulate, name: s, stiffness_fraction: 0.5, max_force: 5 mN m}"
        )
    )
    files[2].write_text(text)
    study: Any = load_config(files[2]).studies[0]
    options = study.list_options(1e-3)
    assert (options["resolution"], options["max_force"]) == (pytest.approx(2.0 * np.pi / 16384), 5e-3)


def test_normalized_scene_with_hardware_raises(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(
        "version: 1\nname: a\nscene: {delta: 0.1, d: 1, resolution: 1 um}\nstudies: [{kind: ridge, name: b}]\n"
    )
    with pytest.raises(zwidth.ConfigError, match="described in SI units or normalized, never both"):
        load_config(file)


def test_inertia_has_the_symbol_j():
    alternative = AlternativeDevice(1e-5, 1e-4, 1e-3, 1.0)
    assert format_alternative(alternative, ROTARY).startswith("J = 100.0 g cm^2")
    assert format_alternative(alternative, LINEAR).startswith("m = ")
