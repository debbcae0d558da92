"""From a log to a wall: every command reports the same wall, and it is stable on the true device."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from measured_devices import TrueDevice, draw_hidden

from zwidth.cli.commands import cli

pytestmark = pytest.mark.usefixtures("fitted_once", "unpainted")


def run(*arguments, code=0):
    result = CliRunner().invoke(cli, list(map(str, arguments)))
    assert result.exit_code == code, result.output
    return result.stdout


def write_log(folder, true, force, position):
    """Write a log in a common format: seconds, millimeters, newtons, with units in the column names."""
    rows = [f"{k * true.period:g},{1e3 * x:.6g},{f:.6g}" for k, (x, f) in enumerate(zip(position, force, strict=True))]
    file = folder / "log.csv"
    file.write_text("\n".join(["time_s,x_mm,F_N", *rows]), encoding="utf-8")
    return file, "--time", "time_s:s", "--position", "x_mm:mm", "--force", "F_N:N"


def record_hidden_mode():
    """Return a device of 80 g with a resonance at 140 Hz, hidden by an encoder of 60 um; the true K_max is 11.8
    kN/m.
    """
    true = TrueDevice("", 0.08, 0.5, 0.0, ((140.0, 0.02, 0.6),), 0.7e-3, 1e-3, 6e-5, 0.4)
    force = true.limit * np.repeat(np.random.default_rng(7).choice([-1.0, 1.0], 60), 25)
    return true, force, true.play(force)


def read_code(text):
    """Return K and B of a C program."""
    return tuple(map(float, re.findall(r"-\((\S+) \* x \+ (\S+) \* v\)", text)[0]))


@pytest.mark.parametrize("seed", [None, 2, 7])
def test_every_command_reports_the_same_stable_wall(seed, tmp_path):
    true, force, position = record_hidden_mode() if seed is None else draw_hidden(seed)
    log = write_log(tmp_path, true, force, position)
    recommended = json.loads(run("fit", *log, "--json"))["recommended"]
    wall = recommended["stiffness"], recommended["virtual_damping"]
    assert all(true.is_stable(factor * wall[0], wall[1]) for factor in (1.0, 0.5, 0.1))
    assert recommended["phase_margin"] > 29.9
    printed = run("fit", *log).splitlines()[0]
    assert printed.startswith("SET        K = ")
    wall_text = printed.partition("SET")[2].strip()
    file, out = tmp_path / "fitted.yaml", tmp_path / "run"
    text = run("fit", *log, "--yaml")
    file.write_text(text, encoding="utf-8")
    assert "  period: 0.001 s # from the times of the log\n" in text
    assert wall_text in run("run", file, "--out", out)
    assert wall_text in (out / "recommendation.md").read_text("utf-8")
    document = json.loads((out / "recommendation.json").read_text("utf-8"))["recommended"]
    assert (document["stiffness"], document["virtual_damping"]) == wall
    run("report", out)
    page = (out / "report.html").read_text("utf-8")
    assert wall_text in page
    document = json.loads(run("recommend", file, "--json"))["recommended"]
    assert (document["stiffness"], document["virtual_damping"]) == wall
    programs = [run("fit", *log, "--code", "c"), run("recommend", file, "--code", "c")]
    assert [read_code(program) for program in programs] == [wall, wall]
    # The limit and its reason accompany the wall.
    reason = re.search(r'reason: "(.*?);', text)
    assert reason is not None
    for document_text in (page, (out / "recommendation.md").read_text("utf-8"), " ".join(programs[0].split())):
        assert reason[1] in document_text


def test_wall_above_the_safe_limit_requires_an_option_and_warns(tmp_path):
    true, force, position = record_hidden_mode()
    file = tmp_path / "fitted.yaml"
    file.write_text(run("fit", *write_log(tmp_path, true, force, position), "--yaml"), encoding="utf-8")
    fraction = "--stiffness-fraction", "0.75"
    document = json.loads(run("recommend", file, *fraction, "--json"))["recommended"]
    assert document["limited_by"] == "safe_limit"
    assert true.is_stable(document["stiffness"], document["virtual_damping"])
    free = json.loads(run("recommend", file, *fraction, "--beyond-safe", "--json"))["recommended"]
    # 75 % of the rigid device's K_max is unstable on the true device.
    assert free["stiffness"] > 12e3
    assert not true.is_stable(free["stiffness"], free["virtual_damping"])
    wall = "--stiffness", free["stiffness"], "--virtual-damping", free["virtual_damping"]
    assert "; CAUTION: limit cycle, exceeds the safe limit" in " ".join(run("check", file, *wall).split())
    assert "this wall exceeds the safe limit" in json.loads(run("check", file, *wall, "--json"))["cautions"][0]
    assert "exceeds the safe limit" in " ".join(run("simulate", file, *wall, "--duration", "100 periods").split())
    safe_wall = "--stiffness", document["stiffness"], "--virtual-damping", document["virtual_damping"]
    printed = " ".join(run("check", file, *safe_wall).split())
    assert "exceeds" not in printed
    # The encoder is that of the file; remedies are searched by diagnose only.
    assert "LIMIT CYCLE" in printed
    assert "to stop it: zwidth diagnose searches for a remedy" in printed
    program = run("recommend", file, *fraction, "--beyond-safe", "--code", "c")
    assert "WARNING: this wall exceeds the safe limit" in program


def test_warnings_prevent_a_wall_in_every_command(tmp_path):
    true, force, position = record_hidden_mode()
    log = write_log(tmp_path, true, force, 1e4 * position)
    lines = run("fit", *log, code=1).splitlines()
    assert lines[0] == "NO WALL    the fit has warnings: record again as they advise"
    assert any(line.startswith("WARNING ") for line in lines)
    file, out = tmp_path / "fitted.yaml", tmp_path / "run"
    file.write_text(run("fit", *log, "--yaml"), encoding="utf-8")
    (warning,) = json.loads(run("fit", *log, "--json", code=1))["safe_limit"]["warnings"][:1]
    assert "NO WALL" in run("recommend", file, code=1)
    run("run", file, "--out", out)
    assert warning in (out / "recommendation.md").read_text("utf-8")
    run("recommend", file, "--code", "c", code=1)
    run("fit", *log, "--code", "c", code=1)


def test_phase_margin_holds_below_an_active_safe_limit():
    walls = ("K=0.0168 N m/rad B=0 N m s/rad f=8.52", "K=0.3991 N m/rad B=0.0005 N m s/rad f=41.68")
    walls = (*walls, "K=0.9605 N m/rad B=0.0015 N m s/rad f=74.03")
    options = [part for wall in walls for part in ("--buzz", wall)]
    fit = json.loads(run("fit", "--rate", "1 kHz", "--noise", "2%", *options, "--json"))
    safe, wall = fit["safe_limit"], fit["recommended"]
    assert safe["stiffness"] == pytest.approx(0.9158, rel=1e-3)
    assert wall["stiffness"] < 0.75 * safe["stiffness"]
    assert wall["phase_margin"] > 29.9
    assert wall["virtual_damping"] <= 0.0015


def test_passive_wall_of_a_fit_is_passive_at_the_lowest_damping(tmp_path):
    walls = "K=6.85kN/m B=0 f=40.1Hz", "K=15.9kN/m B=18.7 f=68.6Hz", "K=19.7kN/m B=37.4 f=89.1Hz"
    options = ["--rate", "1 kHz", "--noise", "2%", *(part for wall in walls for part in ("--buzz", wall))]
    low = json.loads(run("fit", *options, "--json"))["intervals"]["damping"][0]
    file = tmp_path / "fitted.yaml"
    file.write_text(run("fit", *options, "--yaml"), encoding="utf-8")
    wall = json.loads(run("recommend", file, "--passive", "--json"))["recommended"]
    arguments = "--stiffness", wall["stiffness"], "--virtual-damping", wall["virtual_damping"]
    assert json.loads(run("check", file, *arguments, "--damping", low, "--json"))["passive"]
    free = json.loads(run("recommend", file, "--passive", "--beyond-safe", "--json"))["recommended"]
    arguments = "--stiffness", free["stiffness"], "--virtual-damping", free["virtual_damping"]
    assert not json.loads(run("check", file, *arguments, "--damping", low, "--json"))["passive"]
    printed = " ".join(run("check", file, *arguments).split())
    assert "passive uncertain: " in printed
    assert "but the fitted damping may be lower by 574.1 mN s/m" in printed
