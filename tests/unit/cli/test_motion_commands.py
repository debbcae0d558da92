"""`zwidth simulate` and `zwidth diagnose` from the command line, against simulations in Python."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli
from zwidth.cli.motions import _draw_motion

pytestmark = pytest.mark.usefixtures("fitted_once")
KNOB = [
    *("--mass", "60 g cm^2", "--damping", "0.02 mN m s/rad", "--rate", "1 kHz", "--delay", "0.7 periods"),
    *("--velocity-cutoff", "100 Hz", "--stiffness", "0.3 N m/rad", "--virtual-damping", "1.4 mN m s/rad"),
]
HANDLE = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms", "--virtual-damping", "33.45"]
SOFT, STIFF = ["--stiffness", "8.008 kN/m"], ["--stiffness", "25 kN/m"]


def run(*arguments):
    result = CliRunner().invoke(cli, list(arguments))
    assert result.exit_code == 0, result.output
    return result.stdout


def parse(*arguments):
    return json.loads(run(*arguments, "--json"))


def test_limit_cycle_of_a_knob_with_2000_counts():
    printed = run("diagnose", *KNOB, "--resolution", "2000 counts", "--friction", "0.1 mN m")
    cause, _, remedies = " ".join(printed.split()).partition("to stop it ")
    assert cause.startswith("LIMIT CYCLE ")
    assert "caused by the encoder's steps of 3.14 mrad; the linear loop is stable" in cause
    assert "counts per turn" in remedies
    assert "or friction at least " in remedies
    assert remedies.endswith("; simulated at these and larger changes: check the value that you choose with diagnose")
    frictionless = " ".join(run("diagnose", *KNOB, "--resolution", "2000 counts").split())
    assert "; without friction a finer encoder only reduces the amplitude, in proportion to its steps" in frictionless
    diagnosis = parse("diagnose", *KNOB, "--resolution", "0.0005 rev", "--friction", "0.1 mN m")
    assert diagnosis["cause"] == "quantization"
    assert diagnosis["hardware"]["resolution"] == pytest.approx(2 * np.pi / 2000)


def test_remedy_of_an_unstable_wall_agrees_with_the_stable_interval():
    printed = run("diagnose", *HANDLE, *STIFF)
    assert printed.startswith("UNSTABLE ")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(rate=1000, delay=1e-3))
    ends = {remedy["parameter"]: remedy["high"] for remedy in parse("diagnose", *HANDLE, *STIFF)["remedies"]}
    assert ends["stiffness"] == pytest.approx(scene.stable_stiffness(33.45)[0, 1], rel=1e-2)


def test_stable_wall_without_encoder_comes_to_rest():
    assert run("diagnose", *HANDLE, *SOFT).startswith("AT REST ")


def test_hit_agrees_with_simulate(tmp_path):
    file = tmp_path / "hit.png"
    printed = run("simulate", *HANDLE, *SOFT, "--hit", "0.1 m/s", "--figure", str(file))
    assert "hits the wall at 100 mm/s" in printed
    assert "leaves the wall after 1 contact" in printed
    assert file.read_bytes().startswith(b"\x89PNG")
    output = parse("simulate", *HANDLE, *SOFT, "--hit", "0.1 m/s")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(rate=1000, delay=1e-3))
    motion = scene.simulate(8008, 33.45, start_velocity=0.1, contact="unilateral", periods=output["periods"])
    assert output["penetration"] == pytest.approx(motion.penetration, rel=1e-12)
    assert output["bounces"] == motion.bounces


@pytest.mark.parametrize("speed", ["20 mm/s", "0.5 mm/s"])
def test_friction_does_not_stop_a_hit_before_the_wall(speed):
    printed = run("simulate", *HANDLE, *SOFT, "--hit", speed, "--friction", "1 N")
    assert "comes to rest within" in printed
    assert "never meets the wall" not in printed


def test_diagnosis_is_not_that_of_the_simulated_hit():
    printed = " ".join(
        run("simulate", *HANDLE, *SOFT, "--hit", "0.1", "--resolution", "20um", "--friction", "50mN").split()
    )
    assert "leaves the wall after 1 contact, comes to rest outside" in printed
    assert "in contact LIMIT CYCLE: 5.7 µm at 120 Hz" in printed


def test_time_axis_ends_after_the_motion():
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(rate=1000, delay=1e-3))
    figure = _draw_motion(scene.simulate(8008, 33.45, start_position=1e-3, periods=300))
    ax = figure.axes[0]
    assert ax.get_xlabel().endswith("in ms")
    assert 30 < ax.get_xlim()[1] < 100
    figure = _draw_motion(scene.simulate(25e3, 33.45, start_position=1e-3, periods=50))
    assert figure.axes[0].get_xlim()[1] == pytest.approx(49)


def test_hit_under_a_constant_force():
    printed = run("simulate", *HANDLE, *SOFT, "--hit", "0.1 m/s", "--external-force", "2 N")
    assert "hits the wall at 100 mm/s, external force 2.00 N" in printed


def test_diagnose_warns_of_small_margins():
    wall = "--stiffness", "19.8 kN/m", "--virtual-damping", "42"
    assert "phase margin 0.12 deg, gain margin 1.00" in " ".join(run("diagnose", *HANDLE, *wall).split("CAUTION")[1:])
    assert parse("diagnose", *HANDLE, *wall)["cautions"]
    assert "CAUTION" not in run("diagnose", *HANDLE, *SOFT)


def test_diagnosis_of_an_unstable_wall_states_the_simulated_motion():
    wall = *STIFF, "--virtual-damping", "42", "--max-force", "5 N"
    assert "the simulation grows without bound" in run("diagnose", *HANDLE, *STIFF)
    assert "the simulation reaches 210 µm at 83 Hz" in run("diagnose", *HANDLE, *wall)
    stuck = " ".join(run("diagnose", *HANDLE, *wall, "--friction", "50 N").split())
    assert "the simulation comes to rest, because friction holds small displacements" in stuck


def test_push_and_release():
    output = parse("simulate", *HANDLE, *SOFT, "--external-force", "2 N", "--duration", "500 periods")
    assert output["periods"] == 500
    # Under a constant force the device rests at F/K after one overshoot of less than twice that.
    assert 2 / 8008 < output["penetration"] < 4 / 8008
    assert output["outcome"] == "REST"
    held = run("simulate", *HANDLE, *SOFT, "--hold", "0.2 mm", "--resolution", "20 um")
    assert "released at a depth of 200 µm" in held
    assert "caused by the encoder's steps of 20.0 µm" in held


def test_push_of_a_transfer_function():
    output = run(*("simulate", "--device", "1 / 0.1 10 0", "--rate", "1 kHz", *SOFT, "--virtual-damping", "33.45"))
    assert "external force 8.01 N" in output


TOOL = "--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms", "--tool-mass", "300 g"
COUPLING = "--stiffness", "5 kN/m", "--virtual-damping", "20"


def test_coupling_to_a_tool(tmp_path):
    file = tmp_path / "motion.png"
    hit = run("simulate", *TOOL, *COUPLING, "--hit", "0.1 m/s", "--figure", str(file))
    assert "hits the tool at 100 mm/s" in hit
    assert "linear loop           stable" in hit
    assert "in contact" not in hit
    assert file.exists()
    released = run("simulate", *TOOL, *COUPLING, "--max-force", "3 N")
    assert "released at a distance from the tool of 1.00 mm" in released
    assert "force up to 3.00 N" in released
    system = "--device", "1 / 0.1 10 0", *TOOL[4:], *COUPLING
    assert "released at a distance from the tool of 2.00 mm" in run("simulate", *system, "--hold", "2 mm")
    output = parse("simulate", *TOOL, "--stiffness", "25 kN/m", "--virtual-damping", "40", "--duration", "0.5 s")
    assert output["diagnosis"] is None
    assert output["outcome"] == "GROWING"
    result = CliRunner().invoke(cli, ["diagnose", *TOOL, *COUPLING])
    assert "tool: got Tool(mass=0.3), but diagnose supports walls only" in result.output + str(result.exception)


def test_scene_file(tmp_path):
    file = tmp_path / "knob.yaml"
    scene = "{mass: 60 g cm^2, damping: 0.02 mN m s/rad, period: 1 ms, stiffness: 0.1 N m/rad, virtual_damping: 1e-3}"
    file.write_text(
        f"version: 1\nname: knob\nscene: {scene}\nstudies: [{{kind: simulate, name: s}}]\n", encoding="utf-8"
    )
    printed = run("simulate", str(file), "--hit", "1 rad/s", "--duration", "0.2 s")
    assert "hits the wall at 1.00 rad/s" in printed
    assert run("diagnose", str(file)).startswith("AT REST ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--hit", "1 m/s", "--hold", "1 mm"], "--hold: given together with --hit"),
        (["--hit", "0"], "'--hit'"),
        (["--resolution", "20 kg"], "'--resolution'"),
    ],
)
def test_invalid_options_are_named(options, message):
    result = CliRunner().invoke(cli, ["simulate", *HANDLE, *SOFT, *options])
    assert result.exit_code != 0
    assert message in result.output + str(result.exception)


@pytest.mark.parametrize(
    ("duration", "ending"),
    [("300 ms", "still moves in one direction after 300 ms"), ("8 s", "decays to an amplitude of")],
)
def test_push_without_oscillation_is_named(duration, ending):
    wall = ["--mass", "100 g", "--damping", "1", "--rate", "1kHz", "--delay", "1 ms", "--stiffness", "100"]
    more = ["--virtual-damping", "50", "--external-force", "1 N", "--duration", duration]
    result = CliRunner().invoke(cli, ["simulate", *wall, *more])
    assert ending in " ".join(result.output.split())


def test_small_remaining_amplitude_is_printed():
    wall = ["--mass", "100 g", "--damping", "1", "--rate", "1kHz", "--delay", "1 ms", "--stiffness", "1 kN/m"]
    more = ["--virtual-damping", "5", "--external-force", "1 N", "--duration", "400 ms"]
    result = CliRunner().invoke(cli, ["simulate", *wall, *more])
    assert "decays to an amplitude of" in " ".join(result.output.split())
