"""`zwidth admittance`: limits, verdicts and messages, as typed by a user, against `zwidth.AdmittanceDisplay`."""

import json

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

DISPLAY = ["--virtual-mass", "20 kg", "--virtual-damping", "60"]
LAG = ["--robot-time-constant", "20 ms"]
LOOP = ["--rate", "500Hz", "--delay", "4 periods", "--command", "velocity", "--integrator", "trapezoidal"]


def call(*arguments, code=0):
    result = CliRunner().invoke(cli, ["admittance", *arguments])
    assert result.exit_code == code, result.output
    return result.output


def make_display(virtual_mass: float = 20, virtual_damping: float = 60):
    robot, timing = zwidth.Actuator(time_constant="20 ms"), zwidth.Timing(rate="500 Hz", delay="4 periods")
    return zwidth.AdmittanceDisplay(virtual_mass, virtual_damping, robot, timing, "velocity", "trapezoidal")


def test_limit_is_printed_first():
    first, second, *_ = call(*DISPLAY, *LAG, *LOOP).splitlines()
    assert first == "K_max      2.160 kN/m, where the contact oscillates at 1.608 Hz"
    assert second.startswith(
        "display    M = 20.00 kg, D = 60.00 N s/m, at 500.0 Hz, delay 4 periods, velocity command,"
    )


def test_stable_contact():
    lines = call(*DISPLAY, *LAG, *LOOP, "--environment", "1 kN/m").splitlines()
    assert lines[0] == "STABLE     in an environment with K = 1.000 kN/m, B = 0 N s/m"
    assert "margins    gain 2.160, phase 12.94 deg at 1.07 Hz, modulus 0.2079" in lines
    assert (
        lines[-1] == "room       M from 60.01 g; D from 28.41 N s/m to 19.99 kN s/m, each alone; no margins at the ends"
    )


def test_printed_remedies_stabilize_the_contact():
    output = call(*DISPLAY, *LAG, *LOOP, "--environment", "5 kN/m")
    assert output.startswith("UNSTABLE   in an environment with K = 5.000 kN/m")
    assert "remedy     M from 60.05 g to 393.6 g; D from 132.4 N s/m to 19.99 kN s/m, each alone;" in output
    assert output.split()[-5:] == ["no", "margins", "at", "the", "ends"]
    for M, D in ((0.06005, 60), (0.3936, 60), (20, 132.4), (20, 19.99e3)):
        assert make_display(M, D).is_stable(5e3, 0)


def test_json_agrees_with_python():
    environment = ["--environment", "5 kN/m", "--environment-damping", "10 N s/m"]
    result = json.loads(call(*DISPLAY, *LAG, *LOOP, *environment, "--json"))
    display = make_display()
    limit, scene = display.max_environment_stiffness(10), display.scene(5e3, 10)
    assert result["stiffness_limit"] == limit.stiffness
    assert result["frequency"] == limit.frequency
    assert result["stable"] is False
    assert result["spectral_radius"] == pytest.approx(scene.spectral_radius(), rel=1e-14)
    assert result["virtual_damping_range"][0] == display.min_virtual_damping(5e3, 10).virtual_damping
    assert result["virtual_mass_range"] == [*display.min_virtual_mass(5e3, 10)[:2]]
    alone = json.loads(call(*DISPLAY, *LAG, *LOOP, "--json"))
    assert alone["stiffness_limit"] == display.max_environment_stiffness().stiffness


@pytest.mark.parametrize(
    "robot",
    [
        ["--robot", "400 / 1 28 400"],
        ["--robot-cutoff", "10 Hz", "--robot-order", "2", "--robot-damping-ratio", "0.6"],
        ["--robot", "0.1 / 1 -0.9", "--robot-sampled"],
    ],
)
def test_models_of_the_robot(robot):
    result = json.loads(
        call(*DISPLAY, *robot, "--period", "2 ms", "--delay", "4 ms" if robot[1] != "0.1 / 1 -0.9" else "0", "--json")
    )
    models = {
        "400 / 1 28 400": zwidth.LinearDevice("400 / 1 28 400"),
        "10 Hz": zwidth.Actuator(cutoff=10, order=2, damping_ratio=0.6),
        "0.1 / 1 -0.9": zwidth.LinearDevice("0.1 / 1 -0.9", sampled=2e-3),
    }
    timing = zwidth.Timing(2e-3, 0 if robot[1] == "0.1 / 1 -0.9" else 4e-3)
    limit = zwidth.AdmittanceDisplay(20, 60, models[robot[1]], timing).max_environment_stiffness()
    assert result["stiffness_limit"] == pytest.approx(limit.stiffness, rel=1e-13)


def test_rotary_units_and_missing_delay():
    rotary = ["--virtual-mass", "0.5 kg m^2", "--virtual-damping", "2 N m s/rad", "--rate", "1 kHz"]
    output = call(*rotary, *LAG, "--environment", "10 N m/rad")
    assert "K = 10.00 N m/rad" in output
    assert "CAUTION    no delay given" in output


def test_display_without_damping_has_no_limit():
    output = call("--virtual-mass", "20", "--virtual-damping", "0", *LAG, *LOOP, code=1)
    assert output.startswith("K_max      none: the display is unstable even in soft environments")
    call("--virtual-mass", "20", "--virtual-damping", "0", *LAG, *LOOP, "--environment", "100")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (LAG + LOOP, "Missing option '--virtual-mass'"),
        (DISPLAY + LOOP, "give a model of the robot"),
        ([*DISPLAY, *LAG, *LOOP, "--robot", "1 / 1 1"], "give a model of the robot"),
        (DISPLAY + LAG, "give either --rate or --period"),
        ([*DISPLAY, *LAG, *LOOP, "--period", "1 ms"], "give either --rate or --period"),
        (["display.yaml"], "got 'display.yaml', but this command has only options; for a file with a study of kind"),
        (["display.yaml"], "use zwidth run display.yaml"),
        (
            [*DISPLAY, *LAG, *LOOP, "--robot-cutoff", "10"],
            "got both --robot-cutoff and --robot-time-constant",
        ),
        ([*DISPLAY, *LOOP, "--robot-order", "2"], "either --robot-time-constant or --robot-cutoff"),
        ([*DISPLAY, *LAG, *LOOP, "--robot-sampled"], "--robot-sampled: give --robot"),
        (["--virtual-mass", "20 N", "--virtual-damping", "1"], "'--virtual-mass': got '20 N'"),
        (["--virtual-mass", "1", "--virtual-damping", "-1"], "'--virtual-damping': got -1"),
        ([*DISPLAY, "--robot-order", "3", "--robot-cutoff", "10", *LOOP], "'--robot-order': got 3"),
        ([*DISPLAY, "--robot", "abc", *LOOP], "'--robot': got 'abc'"),
        ([*DISPLAY, *LAG, *LOOP, "--environment", "1 N m/rad"], "rotary units"),
    ],
)
def test_invalid_arguments_exit_with_2(arguments, message):
    result = CliRunner().invoke(cli, ["admittance", *arguments])
    text = result.output + str(result.exception)
    assert message in text
    assert result.exit_code == 2 or isinstance(result.exception, zwidth.InputError)


def test_code_is_printed_alone_and_only_for_a_stable_contact():
    expected = make_display().code("c")
    assert call(*DISPLAY, *LAG, *LOOP, "--code", "c", "--environment", "1 kN/m") == expected
    output = call(*DISPLAY, *LAG, *LOOP, "--code", "c", "--environment", "5 kN/m", code=1)
    assert "--code: the contact with this environment is unstable" in output


def test_help_groups_the_virtual_damping_with_the_virtual_mass():
    output = call("--help")
    own = output.partition("This command:")[2].partition("Output:")[0]
    assert "--virtual-damping" in own
    assert "Wall:" not in output
