"""`zwidth excite` and `zwidth respond`, from the excitation file to a wall that is stable on the true device."""

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
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def write_log(played, log):
    time, force = np.genfromtxt(played, delimiter=",", skip_header=1).T
    counts = np.round(DEVICE.play(force) / DEVICE.encoder)
    rows = [f"{1e3 * t:.6g},{count:.0f},{f:.7g}" for t, count, f in zip(time, counts, force, strict=True)]
    log.write_text("\n".join(["time [ms],encoder [counts],force [N]", *rows]))


@pytest.mark.parametrize("mass", np.linspace(0.05, 0.5, 12))
def test_printed_safe_wall_is_provably_stable(mass):
    """The printed wall is rounded towards stability; rounding to nearest would often exceed the limit."""
    frequencies = np.geomspace(1.0, 450.0, 400)
    response = zwidth.Scene(zwidth.Device(mass, 5.0), zwidth.Timing(1e-3, 1e-3)).frequency_response(
        1.0, 0.0, frequencies
    )
    scene = zwidth.Scene(zwidth.MeasuredDevice(frequencies, response, 0.01 * np.abs(response)), zwidth.Timing(1e-3))
    top = scene.max_stiffness()
    stiffness, damping = (part.partition(" = ")[2] for part in spell_safe_wall(scene, top).split(", "))
    assert scene.is_stable(stiffness, damping)
    assert len(stiffness.partition(" ")[0]) <= 5


@pytest.fixture(scope="module")
def first_measurement(tmp_path_factory):
    """Return the folder with log and response of a first measurement, and the printed text."""
    folder = tmp_path_factory.mktemp("measured")
    output = call("excite", *LOOP, "--out", folder / "play.csv")
    assert "664" in output or "frequencies" in output
    write_log(folder / "play.csv", folder / "log.csv")
    options = ["--position", "encoder [counts]", "--resolution", "10um"]
    output = call("respond", folder / "log.csv", *options, "--save", folder / "r.csv", "--figure", folder / "r.png")
    return folder, output


def test_respond_prints_a_safe_wall_and_the_next_measurement(first_measurement):
    folder, output = first_measurement
    lines = dict(line.split("  ", 1) for line in output.splitlines() if line[0] != " ")
    assert {"data", "frequencies", "deviation", "K_max", "safe wall", "wrote"} <= lines.keys()
    assert "stable for every response in the band" in lines["safe wall"]
    assert "measure again from" in output
    assert (folder / "r.png").stat().st_size > 10_000


def test_second_measurement_attains_the_expected_stiffness(first_measurement):
    folder, _ = first_measurement
    excitation = json.loads(call("excite", *LOOP, "--response", folder / "r.csv", "--out", folder / "p2.csv", "--json"))
    write_log(folder / "p2.csv", folder / "log2.csv")
    response = json.loads(
        call("respond", folder / "log2.csv", "--position", "encoder [counts]", "--resolution", "10um", "--json")
    )
    safe = response["safe_wall"]
    assert safe["stiffness"] == pytest.approx(excitation["expected"]["stiffness"], rel=0.05)
    assert DEVICE.is_stable(safe["stiffness"], safe["virtual_damping"])
    assert safe["stiffness"] < response["maximum"]["stiffness"]


def test_saved_response_yields_the_same_wall(first_measurement):
    folder, output = first_measurement
    again = read_labels(call("ridge", "--device", folder / "r.csv", "--period", "1 ms"))
    wall = read_labels(output)["safe wall"].strip()
    assert wall.partition(", ")[2].startswith(f"{again['K_max'].partition(' at ')[2].partition(',')[0]}: ")
    # The reason for the limit has the same wording.
    reason = next(line for line in output.splitlines() if "measure again from" in line).partition("  ")[2].strip()
    assert read_labels(output)["K_max"].strip().removeprefix("K = ").partition(",")[0] in again["note"]
    assert reason in again["note"]
    device = zwidth.MeasuredDevice.read(folder / "r.csv")
    top = zwidth.Scene(device, zwidth.Timing(1e-3)).max_stiffness()
    stiffness, damping = (part.partition(" = ")[2] for part in wall.partition(":")[0].split(", "))
    # The printed wall is provably stable and the stiffest such wall up to a unit or two of the last digit.
    assert zwidth.Scene(device, zwidth.Timing(1e-3)).is_stable(stiffness, damping)
    scale = {"kN/m": 1e3}[stiffness.partition(" ")[2]]
    assert 0.9985 * top.stiffness < scale * float(stiffness.partition(" ")[0]) <= top.stiffness


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["respond", "no.csv"], "no such file"),
        (["excite", *LOOP[:-1], "1 s"], "too short"),
        (["excite", *LOOP[2:]], "give --period or --rate"),
        (["excite", "--rate", "1 kHz", *LOOP], "--period and --rate are both given"),
        (["respond", "table.csv", "--period", "1 ms"], "zwidth ridge --device table.csv"),
    ],
)
def test_missing_arguments_exit_with_2(arguments, message, tmp_path, monkeypatch, capsys):
    from zwidth.cli import main

    monkeypatch.chdir(tmp_path)
    (tmp_path / "table.csv").write_text("frequency [Hz],real [m/N],imag [m/N]\n1,2,3\n2,3,4\n")
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def read_labels(output):
    """Return the lines of an output by their labels, each unfolded."""
    unfolded = re.sub(r"\n +", " ", output)
    lines = (re.split(r" {2,}", line, maxsplit=1) for line in unfolded.splitlines())
    return {line[0]: line[1] for line in lines if len(line) == 2}


def test_response_is_accepted_by_every_analysis_command(first_measurement):
    folder, _ = first_measurement
    device = ["--device", folder / "r.csv", "--period", "1 ms"]
    scene = zwidth.Scene(zwidth.MeasuredDevice.read(folder / "r.csv"), zwidth.Timing(1e-3))
    top = scene.max_stiffness()
    expected = {"stiffness": float(top.stiffness), "virtual_damping": float(top.virtual_damping)}
    ridge = json.loads(call("ridge", *device, "--json"))
    assert (ridge["stiffness_max"], ridge["virtual_damping"]) == tuple(expected.values())
    assert "alpha_max" not in ridge, "the mass is unknown"
    lines = read_labels(call("check", *device, "--stiffness", "5 kN/m", "--virtual-damping", "12 N s/m"))
    assert "STABLE" in lines
    assert "not known with a measured response" in lines["passive"]
    assert not {"decay", "growth"} & lines.keys()
    # Slightly stiffer than stable for every response in the uncertainty band.
    wall = ["--stiffness", 1.03 * expected["stiffness"], "--virtual-damping", expected["virtual_damping"]]
    lines = read_labels(call("check", *device, *wall))
    assert "UNDECIDED" in lines
    assert "measure again from" in lines["note"]
    assert json.loads(call("check", *device, *wall, "--json"))["stable"] is None
    recommended = json.loads(call("recommend", *device, "--gain-margin", "1.3", "--json"))["recommended"]
    verdict = zwidth.assess(
        zwidth.Scene(scene.device, scene.timing, zwidth.VirtualWall(*(recommended[k] for k in expected)))
    )
    assert verdict.stable
    assert 1.3 <= verdict.gain_margin < 1.301


def test_transfer_function_agrees_with_the_rigid_device():
    system = ["--device", "1 / 0.1 10 0", "--period", "1 ms", "--delay", "1 ms"]
    mass = ["--mass", "100 g", "--damping", "10 N s/m", "--period", "1 ms", "--delay", "1 ms"]
    wall = ["--stiffness", "5 kN/m", "--virtual-damping", "20"]
    of_system, of_mass = (json.loads(call("check", *device, *wall, "--json")) for device in (system, mass))
    names = ["stiffness_limit", "virtual_damping_lower", "stiffness_max", "spectral_radius", "time_constant"]
    assert [of_system[name] for name in names] == pytest.approx([of_mass[name] for name in names], rel=1e-9)
    assert "device continuous linear system of order 2, 0 finite zeros, at 1.000 kHz" in " ".join(
        call("check", *system, *wall).split()
    )


@pytest.mark.parametrize(
    ("options", "message"),
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
def test_invalid_devices_raise(options, message):
    result = CliRunner().invoke(cli, ["ridge", "--period", "1 ms", *options])
    assert result.exit_code != 0
    assert message in (result.output or str(result.exception)) or message in str(result.exception)


def test_rotary_device_from_excitation_to_safe_wall(tmp_path):
    loop = ["--rate", "1 kHz", "--force", "10 mN m", "--resolution", "2000 counts", "--duration", "15 s"]
    output = call("excite", *loop, "--out", tmp_path / "play.csv")
    assert "up to 10.00 mN m" in output
    assert "rad/(N m) expected" in output
    with (tmp_path / "play.csv").open() as played:
        assert next(played) == "time [s],torque [N m]\n"
    time, torque = np.genfromtxt(tmp_path / "play.csv", delimiter=",", skip_header=1).T
    knob = zwidth.Scene(zwidth.Device("60 g cm^2", "0.02 mN m s/rad"), zwidth.Timing("1 ms"))
    position = zwidth.simulate(knob, 0.0, 0.0, external_force_history=torque, periods=torque.size).position[
        : torque.size
    ]
    # The encoder wraps after each revolution.
    counts = np.mod(np.round(position * 2000 / (2 * np.pi)), 2000)
    rows = [f"{1e3 * t:.6g},{count:.0f},{f:.7g}" for t, count, f in zip(time, counts, torque, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["t_ms,encoder_counts,torque_Nm", *rows]))
    arguments = [tmp_path / "log.csv", "--resolution", "2000 counts", "--save", tmp_path / "r.csv"]
    response = json.loads(call("respond", *arguments, "--figure", tmp_path / "r.png", "--json"))
    assert response["rotary"]
    assert any("wraps at 6.28319 rad (360 deg, " in note for note in response["notes"])
    # The true device has no delay except the zero-order hold.
    expected = knob.max_stiffness().stiffness
    assert 0 < response["safe_wall"]["stiffness"] < expected
    assert knob.is_stable(response["safe_wall"]["stiffness"], response["safe_wall"]["virtual_damping"])
    device = zwidth.MeasuredDevice.read(tmp_path / "r.csv")
    assert device.rotary
    device.save(tmp_path / "again.csv")
    assert zwidth.MeasuredDevice.read(tmp_path / "again.csv") == device
    measured = ["--device", tmp_path / "r.csv", "--rate", "1 kHz"]
    for command in (["ridge", *measured], ["recommend", *measured], ["check", *measured, "--stiffness", "50 mN m/rad"]):
        assert "N m/rad" in call(*command)
    refused = CliRunner().invoke(cli, [*map(str, ["check", *measured]), "--stiffness", "50 N/m"])
    assert "in linear units" in str(refused.exception)
    second = call("excite", *loop, "--response", tmp_path / "r.csv", "--out", tmp_path / "second.csv")
    assert "N m/rad" in second
    mixed = ["excite", "--rate", "1 kHz", "--force", "1 N", "--resolution", "10 um", "--response", tmp_path / "r.csv"]
    assert "--response is that of a rotary device" in CliRunner().invoke(cli, [*map(str, mixed)]).output
    config = tmp_path / "knob.yaml"
    scene = "{device: r.csv, rate: 1 kHz}"
    config.write_text(f"version: 1\nname: knob\nscene: {scene}\nstudies: [{{kind: recommend, name: r}}]\n")
    assert "N m/rad" in call("run", config, "--out", tmp_path / "run")
