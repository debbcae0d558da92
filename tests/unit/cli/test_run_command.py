"""`zwidth run`: printed results against recommendations in Python, warnings, and the progress bar."""

import os
import pty
import subprocess
import sys

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli
from zwidth.units.formatting import plain, round_conservatively, with_unit

HEAD = "version: 1\nname: small\n"
STUDY = "studies: [{kind: recommend, name: best, stiffness_fraction: %s}]\n"
MARGINS = "studies: [{kind: recommend, name: best, phase_margin: %g, passive: %s}]\n"
SCENES = {
    "rigid": ("{mass: 0.1, damping: 10, period: 1e-3, delay: 1 ms}", zwidth.BackwardDifference()),
    "filter": (
        "{mass: 0.1, damping: 10, period: 1e-3, delay: 1 ms, velocity: {kind: low_pass, cutoff: 100}}",
        zwidth.LowPass(cutoff=100),
    ),
}


@pytest.fixture
def run(tmp_path, monkeypatch, unpainted):
    monkeypatch.chdir(tmp_path)

    def run_config(text, *arguments):
        (tmp_path / "small.yaml").write_text(HEAD + text, encoding="utf-8")
        result = CliRunner().invoke(cli, ["run", "small.yaml", *arguments], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        lines = result.output.splitlines()
        start = next(k for k, line in enumerate(lines) if line.startswith("1 of 1 done"))
        return lines[start + 1 :]

    return run_config


@pytest.mark.parametrize("name", SCENES)
def test_run_prints_its_recommendation(name, run):
    scene, velocity = SCENES[name]
    output = " ".join(" ".join(run(f"scene: {scene}\n" + STUDY % 0.5)).split())
    bare = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), velocity=velocity)
    recommendation = bare.recommend(stiffness_fraction=0.5)
    top = bare.max_stiffness()
    wall = 0.5 * float(top.stiffness), float(top.virtual_damping)
    assert (recommendation.stiffness, recommendation.virtual_damping) == pytest.approx(wall)
    # Stiffnesses are rounded down.
    stiffness, top_stiffness = (with_unit(round_conservatively(K, "below"), "N/m") for K in (wall[0], 2 * wall[0]))
    assert output.startswith(f"best K = {stiffness}, B = {plain(wall[1])} N s/m: 50 % of K_max = {top_stiffness}")
    assert all(line in output for line in recommendation.lines())
    assert f"passive: {'yes' if bare.is_passive(*wall) else 'no'}; " in output


def test_study_with_required_margins(run):
    output = " ".join(" ".join(run("scene: {mass: 0.1, damping: 10, period: 1e-3}\n" + MARGINS % (30, "true"))).split())
    recommendation = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3)).recommend(phase_margin=30, passive=True)
    assert output.startswith(f"best {recommendation.lines()[0]}")
    output = " ".join(run("scene: {mass: 0.1, period: 1e-3}\n" + MARGINS % (30, "true"), "--overwrite"))
    assert "no wall: no passive wall exists" in " ".join(output.split())


def test_implausible_scene_has_warnings_before_the_computation(tmp_path, monkeypatch, unpainted):
    monkeypatch.chdir(tmp_path)

    def list_warnings(scene):
        (tmp_path / "small.yaml").write_text(HEAD + f"scene: {scene}\n" + STUDY % 0.5, encoding="utf-8")
        result = CliRunner().invoke(cli, ["run", "small.yaml", "--dry-run"], catch_exceptions=False)
        # Older versions of click's runner merge stderr and stdout.
        warnings, plan, _ = result.output.partition("study best\n")
        assert plan
        return [line.removeprefix("zwidth: small.yaml: scene.") for line in warnings.splitlines()]

    assert list_warnings("{mass: 100, damping: 10, rate: 1, delay: 1}") == [
        "mass is 100 kg, an implausible value; did you mean 'mass: 100 g'?",
        "delay is 1 s, an implausible value; did you mean 'delay: 1 ms' or 'delay: 1 periods'?",
        "rate is 1 Hz, an implausible value; did you mean 'rate: 1 kHz'?",
    ]
    (operator_warning,) = list_warnings("{mass: 1, rate: 1 kHz, operator: {mass: 70, stiffness: 100}}")
    assert operator_warning == "operator.mass is 70 kg, an implausible value; did you mean 'operator.mass: 70 g'?"
    (rotary_warning,) = list_warnings("{rotary: true, mass: 50, rate: 1 kHz}")
    assert rotary_warning == "mass is 50 kg m^2, an implausible value; check its unit"
    assert list_warnings("{mass: 0.1, damping: 10, period: 1e-3, delay: 2 periods, stiffness: 5 kN/m}") == []


def test_terminal_shows_a_progress_bar_and_lines(tmp_path):
    study = "studies: [{kind: sweep, name: map, axes: {alpha: [0.1, 0.9], beta: 0.1, delta: 0.1, d: 1}}]\n"
    (tmp_path / "small.yaml").write_text(HEAD + study, encoding="utf-8")
    parent_end, child_end = pty.openpty()
    command = [sys.executable, "-m", "zwidth", "run", "small.yaml"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=child_end, cwd=tmp_path)
    os.close(child_end)
    shown = b""
    # Linux reports the end of a terminal as an error.
    while piece := read_or_nothing(parent_end):
        shown += piece
    os.close(parent_end)
    assert process.wait() == 0
    assert b"map (sweep)  [" in shown
    assert b"  100%  " in shown
    assert b"\r\x1b[K[1/1] map                  sweep " in shown
    # The cursor is visible again.
    assert shown.rstrip().endswith(b"\x1b[?25h")


def read_or_nothing(terminal):
    try:
        return os.read(terminal, 1 << 16)
    except OSError:
        return b""
