"""`zwidth excite` and `zwidth respond`, from the file to play to the safe wall."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from measured_devices import TrueDevice

import zwidth
from zwidth.cli import cli
from zwidth.cli.logs import spell_safe_wall

pytestmark = pytest.mark.usefixtures("fitted_once")
DEVICE = TrueDevice("one resonance", 0.1, 3.0, 3e-4, ((140.0, 0.02, 0.6),), 0.7e-3, 1e-3, 1e-5, 3.0)
LOOP = ["--period", "1 ms", "--force", "3 N", "--resolution", "10 um", "--duration", "30 s"]


def call(*arguments):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def write_log(played, log):
    time, force = np.genfromtxt(played, delimiter=",", skip_header=1).T
    counts = np.round(DEVICE.play(force) / DEVICE.encoder)
    rows = [f"{1e3 * t:.6g},{count:.0f},{f:.7g}" for t, count, f in zip(time, counts, force, strict=True)]
    log.write_text("\n".join(["time [ms],encoder [counts],force [N]", *rows]))


@pytest.mark.parametrize("mass", np.linspace(0.05, 0.5, 12))
def test_a_safe_wall_is_sure_as_it_is_written(mass):
    """At the edge of what is sure a rounded number is as often beyond it as within."""
    lines = np.geomspace(1.0, 450.0, 400)
    response = zwidth.Scene(zwidth.Device(mass, 5.0), zwidth.Timing(1e-3, 1e-3)).frequency_response(1.0, 0.0, lines)
    scene = zwidth.Scene(zwidth.MeasuredDevice(lines, response, 0.01 * np.abs(response)), zwidth.Timing(1e-3))
    top = scene.max_stiffness()
    stiffness, damping = (part.partition(" = ")[2] for part in spell_safe_wall(scene, top).split(", "))
    assert scene.is_stable(stiffness, damping)
    assert len(stiffness.partition(" ")[0]) <= 5


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The log of the first record, its response, and what was said."""
    folder = tmp_path_factory.mktemp("measured")
    said = call("excite", *LOOP, "--out", folder / "play.csv")
    assert "664" in said or "lines" in said
    write_log(folder / "play.csv", folder / "log.csv")
    options = ["--position", "encoder [counts]", "--resolution", "10um"]
    said = call("respond", folder / "log.csv", *options, "--save", folder / "r.csv", "--figure", folder / "r.png")
    return folder, said


def test_a_log_tells_a_safe_wall_and_what_a_stiffer_one_needs(first):
    folder, said = first
    lines = dict(line.split("  ", 1) for line in said.splitlines() if line[0] != " ")
    assert {"response of", "lines", "deviation", "K_max", "safe wall", "wrote"} <= lines.keys()
    assert "stable for every response in the band" in lines["safe wall"]
    assert "measure again from" in said
    assert (folder / "r.png").stat().st_size > 10_000


def test_the_second_record_is_made_from_the_first_and_tells_what_it_promised(first):
    folder, _ = first
    made = json.loads(call("excite", *LOOP, "--response", folder / "r.csv", "--out", folder / "p2.csv", "--json"))
    write_log(folder / "p2.csv", folder / "log2.csv")
    found = json.loads(
        call("respond", folder / "log2.csv", "--position", "encoder [counts]", "--resolution", "10um", "--json")
    )
    safe = found["safe_wall"]
    assert safe["stiffness"] == pytest.approx(made["expected"]["stiffness"], rel=0.05)
    assert DEVICE.is_stable(safe["stiffness"], safe["virtual_damping"])
    assert safe["stiffness"] < found["maximum"]["stiffness"]


def test_the_table_that_was_kept_gives_the_same_wall(first):
    folder, said = first
    again = said_of(call("ridge", "--device", folder / "r.csv", "--period", "1 ms"))
    wall = said_of(said)["safe wall"].strip()
    assert wall.partition(", ")[2].startswith(f"{again['K_max'].partition(' at ')[2].partition(',')[0]}: ")
    # Why no stiffer one is sure, in the same words.
    reason = next(line for line in said.splitlines() if "measure again from" in line).partition("  ")[2].strip()
    assert said_of(said)["K_max"].strip().removeprefix("K = ").partition(",")[0] in again["note"]
    assert reason in again["note"]
    device = zwidth.MeasuredDevice.read(folder / "r.csv")
    top = zwidth.Scene(device, zwidth.Timing(1e-3)).max_stiffness()
    stiffness, damping = (part.partition(" = ")[2] for part in wall.partition(":")[0].split(", "))
    # Sure as it is written, and by a unit or two of the last digit the stiffest such wall.
    assert zwidth.Scene(device, zwidth.Timing(1e-3)).is_stable(stiffness, damping)
    scale = {"kN/m": 1e3}[stiffness.partition(" ")[2]]
    assert 0.9985 * top.stiffness < scale * float(stiffness.partition(" ")[0]) <= top.stiffness


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["respond", "no.csv"], "no such file"),
        (["excite", *LOOP[:-1], "1 s"], "too short"),
        (["excite", *LOOP[2:]], "give --period or --rate"),
        (["excite", "--rate", "1 kHz", *LOOP], "--period and --rate are both given"),
        (["respond", "table.csv", "--period", "1 ms"], "zwidth ridge --device table.csv"),
    ],
)
def test_what_is_missing_is_said(arguments, said, tmp_path, monkeypatch, capsys):
    from zwidth.cli import main

    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.csv").write_text("frequency [Hz],real [m/N],imag [m/N]\n1,2,3\n2,3,4\n")
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert said in capsys.readouterr().err


def said_of(output):
    """Return the lines of an output by their labels, each unfolded."""
    unfolded = re.sub(r"\n +", " ", output)
    lines = (re.split(r" {2,}", line, maxsplit=1) for line in unfolded.splitlines())
    return {line[0]: line[1] for line in lines if len(line) == 2}


def test_a_response_is_a_device_of_every_command_that_judges(first):
    folder, _ = first
    device = ["--device", folder / "r.csv", "--period", "1 ms"]
    scene = zwidth.Scene(zwidth.MeasuredDevice.read(folder / "r.csv"), zwidth.Timing(1e-3))
    top = scene.max_stiffness()
    known = {"stiffness": float(top.stiffness), "virtual_damping": float(top.virtual_damping)}
    ridge = json.loads(call("ridge", *device, "--json"))
    assert (ridge["stiffness_max"], ridge["virtual_damping"]) == tuple(known.values())
    assert "alpha_max" not in ridge, "no mass is known"
    lines = said_of(call("check", *device, "--stiffness", "5 kN/m", "--virtual-damping", "12 N s/m"))
    assert "STABLE" in lines
    assert "not known with a measured response" in lines["passive"]
    assert not {"decay", "growth"} & lines.keys()
    # A little stiffer than what is stable for every response in the band.
    wall = ["--stiffness", 1.03 * known["stiffness"], "--virtual-damping", known["virtual_damping"]]
    lines = said_of(call("check", *device, *wall))
    assert "UNDECIDED" in lines
    assert "measure again from" in lines["note"]
    assert json.loads(call("check", *device, *wall, "--json"))["stable"] is None
    found = json.loads(call("recommend", *device, "--gain-margin", "1.3", "--json"))["recommended"]
    verdict = zwidth.assess(zwidth.Scene(scene.device, scene.timing, zwidth.VirtualWall(*(found[k] for k in known))))
    assert verdict.stable
    assert 1.3 <= verdict.gain_margin < 1.301


def test_a_transfer_function_is_a_device():
    system = ["--device", "1 / 0.1 10 0", "--period", "1 ms", "--delay", "1 ms"]
    mass = ["--mass", "100 g", "--damping", "10 N s/m", "--period", "1 ms", "--delay", "1 ms"]
    wall = ["--stiffness", "5 kN/m", "--virtual-damping", "20"]
    found, known = (json.loads(call("check", *device, *wall, "--json")) for device in (system, mass))
    same = ["stiffness_limit", "virtual_damping_lower", "stiffness_max", "spectral_radius", "time_constant"]
    assert [found[name] for name in same] == pytest.approx([known[name] for name in same], rel=1e-9)
    assert "device continuous linear system of order 2, 0 finite zeros, at 1.000 kHz" in " ".join(
        call("check", *system, *wall).split()
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--device", "1 / x"], "highest power first"),
        (["--device", "nobody"], "'--device': got 'nobody'"),
        (["--device", "nothing.csv"], "no such file"),
        (["--device", "1 / 0.1 10 0", "--mass", "1 kg"], "--mass: the given --device already contains it"),
        (
            ["--device", "1 / 0.1 10 0", "--operator-mass", "1 kg"],
            "--operator-mass: the given --device already contains it",
        ),
    ],
)
def test_what_is_no_device_is_refused_in_one_line(options, words):
    done = CliRunner().invoke(cli, ["ridge", "--period", "1 ms", *options])
    assert done.exit_code != 0
    assert words in (done.output or str(done.exception)) or words in str(done.exception)


def test_a_rotary_device_is_measured_from_the_file_to_play_to_the_safe_wall(tmp_path):
    loop = ["--rate", "1 kHz", "--force", "10 mN m", "--resolution", "2000 counts", "--duration", "15 s"]
    said = call("excite", *loop, "--out", tmp_path / "play.csv")
    assert "up to 10.00 mN m" in said
    assert "rad/(N m) expected" in said
    with (tmp_path / "play.csv").open() as played:
        assert next(played) == "time [s],torque [N m]\n"
    time, torque = np.genfromtxt(tmp_path / "play.csv", delimiter=",", skip_header=1).T
    knob = zwidth.Scene(zwidth.Device("60 g cm^2", "0.02 mN m s/rad"), zwidth.Timing("1 ms"))
    moved = zwidth.simulate(knob, 0.0, 0.0, push_history=torque, periods=torque.size).position[: torque.size]
    # The encoder wraps after each turn.
    counts = np.mod(np.round(moved * 2000 / (2 * np.pi)), 2000)
    rows = [f"{1e3 * t:.6g},{count:.0f},{f:.7g}" for t, count, f in zip(time, counts, torque, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["t_ms,encoder_counts,torque_Nm", *rows]))
    given = [tmp_path / "log.csv", "--resolution", "2000 counts", "--save", tmp_path / "r.csv"]
    found = json.loads(call("respond", *given, "--figure", tmp_path / "r.png", "--json"))
    assert found["rotary"]
    assert any("wraps at 6.28319 rad (360 deg, " in note for note in found["notes"])
    # The true device has no other delay than the hold.
    true = knob.max_stiffness().stiffness
    assert 0 < found["safe_wall"]["stiffness"] < true
    assert knob.is_stable(found["safe_wall"]["stiffness"], found["safe_wall"]["virtual_damping"])
    device = zwidth.MeasuredDevice.read(tmp_path / "r.csv")
    assert device.rotary
    device.save(tmp_path / "again.csv")
    assert zwidth.MeasuredDevice.read(tmp_path / "again.csv") == device
    held = ["--device", tmp_path / "r.csv", "--rate", "1 kHz"]
    for command in (["ridge", *held], ["recommend", *held], ["check", *held, "--stiffness", "50 mN m/rad"]):
        assert "N m/rad" in call(*command)
    refused = CliRunner().invoke(cli, [*map(str, ["check", *held]), "--stiffness", "50 N/m"])
    assert "in linear units" in str(refused.exception)
    second = call("excite", *loop, "--response", tmp_path / "r.csv", "--out", tmp_path / "second.csv")
    assert "N m/rad" in second
    mixed = ["excite", "--rate", "1 kHz", "--force", "1 N", "--resolution", "10 um", "--response", tmp_path / "r.csv"]
    assert "--response is that of a rotary device" in CliRunner().invoke(cli, [*map(str, mixed)]).output
    config = tmp_path / "knob.yaml"
    scene = "{device: r.csv, rate: 1 kHz}"
    config.write_text(f"version: 1\nname: knob\nscene: {scene}\nstudies: [{{kind: recommend, name: r}}]\n")
    assert "N m/rad" in call("run", config, "--out", tmp_path / "run")
