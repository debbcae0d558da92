"""`zwidth recommend`: text, JSON, figure and code, against Scene.recommend."""

import json
import re
import subprocess
import sys

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

pytestmark = pytest.mark.usefixtures("fitted_once")
DEVICE = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms"]
SCENE = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))


def recommend(*arguments, code=0):
    result = CliRunner().invoke(cli, ["recommend", *DEVICE, *arguments])
    assert result.exit_code == code, result.output
    return result


def test_text_lists_the_wall_its_margins_and_improvements():
    lines = recommend("--phase-margin", "30").stdout.splitlines()
    recommendation = SCENE.recommend(phase_margin=30)
    assert " ".join(lines[0:2]).split() == f"SET {recommendation.spell_wall()}; {recommendation.spell_limit()}".split()
    assert "limited by 30 deg phase margin" in " ".join(" ".join(lines[:2]).split())
    text = "\n".join(lines)
    assert "margins    gain 1.93, phase 30.0 deg, delay 1.29 ms" in text
    assert "grasps     stable in all six reference grasps" in text
    assert "twice the rate                   24.2" in text
    assert "(x 3.02; the delay stays 1 period)" in text
    assert "half the delay                   12.7" in text
    assert "CAUTION" not in text


def test_wall_with_small_margins_has_a_caution():
    text = " ".join(recommend("--passive").stdout.split())
    assert "CAUTION phase margin 0.89 deg, gain margin 1.04, delay margin" in text
    assert "rings for 470 ms; use recommend --phase-margin 30 --passive: K = 3.979 kN/m, B = 7.75" in text
    assert "N s/m (costs 52 % of the stiffness)" in text
    assert "limited by passivity; CAUTION: small margins device" in text
    assert "requirements (not checked in the reference grasps):" in text


def test_passive_wall_and_its_loss_of_stiffness():
    text = " ".join(recommend("--phase-margin", "30").stdout.split())
    assert "passive no; a passive wall has K = 3.9" in text
    assert "(costs 50 % of the stiffness): recommend --passive --phase-margin 30 To gain" in text
    text = " ".join(recommend("--damping", "0").stdout.split())
    assert "passive no; no passive wall satisfies the same requirements" in text


def test_options_of_the_passive_wall_recommend_it():
    text = " ".join(recommend().stdout.split())
    ((wall, options),) = re.findall(r"a passive wall has (K = [\d.]+) .*?: recommend (--passive .*? soft) ", text)
    again = json.loads(recommend(*options.split(), "--json").stdout)["recommended"]
    assert again["passive"]
    assert again["stiffness"] == pytest.approx(1e3 * float(wall.removeprefix("K = ")), rel=5e-3)


def test_rate_without_gain_is_shown():
    text = " ".join(recommend("--damping", "0.1", "--delay", "300 ms", "--stiffness-fraction", "50%").stdout.split())
    assert "(x 1.00; the delay stays 300.0 ms)" in text


def test_wall_stable_in_every_grasp():
    text = " ".join(recommend("--stiffness-fraction", "95%").stdout.split())
    assert "CAUTION: small margins, unstable in a grasp device" in text
    assert "unstable in the hand (firm, light damping); use recommend --grasps all: K = 15." in text
    text = " ".join(recommend("--stiffness-fraction", "95%", "--grasps", "all").stdout.split())
    assert "limited by stability in all six reference grasps" in text
    assert "grasps stable in all six reference grasps" in text
    printed = json.loads(recommend("--stiffness-fraction", "95%", "--grasps", "all", "--json").stdout)
    assert printed["requirements"]["grasps"] == "all"
    assert printed["recommended"]["limited_by"] == "grasps"
    assert all(printed["grasps"].values())
    assert "Virtual wall: K = 15." in recommend("--stiffness-fraction", "95%", "--grasps", "all", "--code", "c").stdout


def test_first_line_reports_a_limit_cycle():
    lines = recommend("--resolution", "2 mm").stdout.splitlines()
    assert "CAUTION: limit cycle" in " ".join(lines[:2])
    assert "CAUTION    LIMIT CYCLE: " in "\n".join(lines)


def test_omitted_delay_has_a_caution():
    device, text = DEVICE[:6], "no delay given: the results hold only if the force acts at the sample"
    for command in ("recommend", "ridge", "check", "simulate", "diagnose"):
        wall = [] if command in ("recommend", "ridge") else ["--stiffness", "1 kN/m"]
        output = CliRunner().invoke(cli, [command, *device, *wall]).stdout
        assert " ".join(output.split()).count(f"CAUTION {text}") == 1
        assert text not in CliRunner().invoke(cli, [command, *DEVICE, *wall]).stdout
    assert text in CliRunner().invoke(cli, ["recommend", *device, "--code", "c"]).output
    assert text in json.loads(CliRunner().invoke(cli, ["recommend", *device, "--json"]).stdout)["cautions"][0]


def test_encoder_and_motor_are_simulated():
    text = recommend("--resolution", "20 um", "--friction", "50 mN", "--max-force", "5 N").stdout
    assert "CAUTION    LIMIT CYCLE: " in text
    printed = json.loads(recommend("--resolution", "20 um", "--friction", "50 mN", "--json").stdout)
    assert printed["diagnosis"]["cause"] in ("none", "quantization")


@pytest.mark.parametrize("columns", [60, 80])
def test_lines_fit_the_terminal_width(columns, monkeypatch):
    unfolded = recommend("--phase-margin", "30").stdout
    monkeypatch.setenv("COLUMNS", str(columns))
    folded = recommend("--phase-margin", "30").stdout
    assert max(map(len, folded.splitlines())) <= columns < max(map(len, unfolded.splitlines())) <= 100
    assert folded.split() == unfolded.split()
    # Numbers and their units stay on one line.
    assert "33.45 N s/m" in folded
    assert "30.0 deg" in folded


def test_json_agrees_with_as_dict():
    printed = json.loads(recommend("--stiffness-fraction", "60%", "--json").stdout)
    assert printed == json.loads(json.dumps(SCENE.recommend(stiffness_fraction=0.6).as_dict()))


def test_generated_code_is_self_contained():
    assert recommend("--code", "c").stdout == SCENE.recommend().code("c")
    names = {}
    exec(recommend("--code", "python").stdout, names)
    assert names["Wall"](0.0).force(-1e-3) == 0.0
    assert names["Wall"](0.0).force(0.1) < -3.0
    exec(recommend("--code", "python", "--max-force", "3 N").stdout, names)
    assert names["Wall"](0.0).force(0.1) == -3.0
    assert names["Wall"](0.1).force(0.001) == 3.0
    assert "give only one of --code or --json" in recommend("--code", "c", "--json", code=2).output


@pytest.mark.parametrize("ending", ["pdf", "png"])
def test_figure_is_written(ending, tmp_path):
    file = tmp_path / f"chart.{ending}"
    assert recommend("--figure", str(file)).stdout.splitlines()[-1].endswith(str(file))
    assert file.stat().st_size > 5000
    assert "does not exist; create it first" in recommend("--figure", str(tmp_path / "none" / "a.png"), code=2).output


def test_no_wall_exits_with_1():
    device = ["--mass", "0.1", "--rate", "1 kHz"]
    result = CliRunner().invoke(cli, ["recommend", *device, "--passive"])
    assert result.exit_code == 1
    assert result.stdout.startswith("NO WALL    no passive wall exists, because the device has no physical damping\n")
    code = CliRunner().invoke(cli, ["recommend", *device, "--passive", "--code", "c"])
    # Older versions of click do not separate stderr from stdout.
    message = "Error: no passive wall exists, because the device has no physical damping\n"
    assert (code.exit_code, code.output) == (1, message)
    assert json.loads(CliRunner().invoke(cli, ["recommend", *device, "--passive", "--json"]).stdout)["reason"]
    # An unstable wall is a valid result with exit code 0.
    assert CliRunner().invoke(cli, ["check", *device, "--stiffness", "1 MN/m"]).exit_code == 0


@pytest.mark.parametrize("arguments", [["--gain-margin", "1"], ["--phase-margin", "0"], ["--stiffness-fraction", "x"]])
def test_invalid_requirements_exit_with_2(arguments):
    recommend(*arguments, code=2)


def test_rigid_device_does_not_import_jax():
    program = (
        "import sys; from zwidth.cli import main\n"
        "try: main(sys.argv[1:])\nexcept SystemExit as end: assert not end.code\n"
        "assert not {'jax', 'pydantic', 'matplotlib'} & set(sys.modules)"
    )
    for options in ([], ["--phase-margin", "30"]):
        subprocess.run([sys.executable, "-c", program, "recommend", *DEVICE, *options], check=True, capture_output=True)


@pytest.mark.parametrize(
    ("options", "requirements"),
    [(["--gain-margin", "6 dB"], {"gain_margin": 10**0.3}), (["--phase-margin", "30deg"], {"phase_margin": 30})],
)
def test_margins_accept_decibels_and_degrees(options, requirements):
    # Degrees of a margin do not imply a rotary device.
    assert json.loads(recommend(*options, "--json").stdout) == json.loads(
        json.dumps(SCENE.recommend(**requirements).as_dict())
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--stiffness-fraction", "60"],
            "'--stiffness-fraction': got 60.0; a number greater than 0 and less than 1 is needed, such as 0.6",
        ),
        (["--gain-margin", "1"], "'--gain-margin': got 1.0; a number greater than 1 is needed, such as 2 for 6 dB"),
        (["--phase-margin", "large"], "'--phase-margin': got 'large'; write degrees, such as 30"),
    ],
)
def test_invalid_requirement_names_its_option(options, message):
    assert message in recommend(*options, code=2).output


def test_slow_sliding_of_an_arm_is_named(tmp_path):
    file = tmp_path / "arm.yaml"
    matrix, jacobian = "[[0.003, 0.001], [0.001, 0.001]]", "[[-0.2, -0.1], [0.1, 0.1]]"
    text = f"mass_matrix: {matrix}\njacobian: {jacobian}\ndamping: [2e-4, 5e-4]\ndirection: y\n"
    file.write_text(text, encoding="utf-8")
    arguments = ["recommend", "--device", str(file), "--rate", "1 kHz", "--delay", "1 ms"]
    text = " ".join(CliRunner().invoke(cli, arguments).stdout.split())
    assert "CAUTION: slow decay device" in text
    assert "margins gain 2.11, phase 30.0 deg" in text
    assert "CAUTION slow decay (time constant 2.9 s): a motion of the arm that hardly depends on the wall" in text
