"""Options of the position estimate and of further feedback, with and without a scene file, against scenes in Python."""

import json

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

SCENE = """\
version: 1
name: knob
scene:
  mass: 100 g
  damping: 10 N s/m
  rate: 1 kHz
  delay: 1 ms
  {parts}
studies:
  - {{kind: boundary, name: walls}}
"""
OPTIONS = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms"]
WALL = ["--stiffness", "2 kN/m", "--virtual-damping", "20"]
PARTS = {
    "--position-coefficient 0.3": {"position": zwidth.ExponentialFilter(0.3)},
    "--position-time-constant 2ms": {"position": zwidth.ExponentialFilter(time_constant=2e-3)},
    "--position-cutoff 100Hz": {"position": zwidth.ExponentialFilter(cutoff=100)},
    "--position-coefficient 0.3 --position-velocity-from measured": {
        "position": zwidth.ExponentialFilter(0.3, velocity_from="measured")
    },
    "--position-cutoff 100 --position-order 2": {"position": zwidth.LowPass(cutoff=100, order=2)},
    "--position-kind butterworth --position-cutoff 50 --velocity-cutoff 200": {
        "position": zwidth.Butterworth(50),
        "velocity": zwidth.LowPass(cutoff=200),
    },
    "--position-bandwidth 500": {"position": zwidth.Pll(500)},
    "--feedback-gain 1000": {"feedback": zwidth.IntegralFeedback(1000)},
    "--feedback-gain 1kN/m/s": {"feedback": zwidth.IntegralFeedback(1000)},
    "--position-bandwidth 500 --feedback-gain 3 --feedback-rule forward --feedback-position 20 --feedback-velocity 1": {
        "position": zwidth.Pll(500),
        "feedback": zwidth.IntegralFeedback(3, "forward", 20, 1),
    },
}


def run(*arguments):
    return CliRunner().invoke(cli, list(arguments))


def check(*arguments):
    result = run("check", *arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def make_scene(**parts):
    return zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), **parts)


def radius(scene):
    # The tolerance allows the rounding error of the period, 1/(1 kHz).
    return pytest.approx(float(scene.spectral_radius(2e3, 20)), rel=1e-13)


@pytest.mark.parametrize("options", PARTS)
def test_options_define_the_estimates(options):
    assert check(*OPTIONS, *WALL, *options.split())["spectral_radius"] == radius(make_scene(**PARTS[options]))


CHANGES = {
    # parts of the file: options, expected parts
    "position: {kind: exponential, cutoff: 100}": ("--position-coefficient 0.5", zwidth.ExponentialFilter(0.5)),
    "position: {kind: exponential, coefficient: 0.3, velocity_from: measured}": (
        "--position-cutoff 50",
        zwidth.ExponentialFilter(cutoff=50, velocity_from="measured"),
    ),
    "position: {kind: pll, bandwidth: 100}": ("--position-bandwidth 400", zwidth.Pll(400)),
    "position: {kind: pll, bandwidth: 200}": ("--position-kind low_pass --position-cutoff 90", zwidth.LowPass(90)),
    "position: {kind: filter, numerator: [0.6, 0.4], denominator: [1, 0]}": (
        "--position-velocity-from measured",
        zwidth.PositionFilter([0.6, 0.4], [1, 0], velocity_from="measured"),
    ),
}


@pytest.mark.parametrize("text", CHANGES)
def test_options_change_the_position_estimate_of_a_file(text, tmp_path):
    options, position = CHANGES[text]
    file = tmp_path / "scene.yaml"
    file.write_text(SCENE.format(parts=text))
    assert check(str(file), *WALL, *options.split())["spectral_radius"] == radius(make_scene(position=position))


def test_options_change_the_feedback_of_a_file(tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(SCENE.format(parts="feedback: {kind: integral, gain: 100, rule: trapezoidal}"))
    expected = make_scene(feedback=zwidth.IntegralFeedback(900, "trapezoidal"))
    assert check(str(file), *WALL, "--feedback-gain", "900")["spectral_radius"] == radius(expected)
    file.write_text(SCENE.format(parts="feedback: {kind: filter, numerator: [5000, -5000], denominator: [1, 0]}"))
    expected = make_scene(feedback=zwidth.IntegralFeedback(900))
    assert check(str(file), *WALL, "--feedback-gain", "900")["spectral_radius"] == radius(expected)


FAULTS = {
    "--position-kind exponential": "a position estimate of kind exponential requires --position-cutoff",
    "--position-kind pll": "requires --position-bandwidth",
    "--position-kind pll --position-cutoff 100": "requires --position-bandwidth",
    "--position-bandwidth 100 --position-cutoff 100": "--position-cutoff does not belong to a position",
    "--position-velocity-from measured": "requires --position-cutoff",
    "--position-kind low_pass --position-cutoff 100 --position-velocity-from measured": "does not belong to",
    "--position-coefficient 2": "'--position-coefficient': got 2; it must be greater than 0 and at most 1",
    "--position-kind butterworth --position-cutoff -3": "'--position-cutoff': got -3 Hz",
    "--position-cutoff 600 --position-order 2": "'--position-cutoff': got 600 Hz; it must be below half",
    "--position-bandwidth 900": "'--position-bandwidth': got 900 rad/s; the PLL is unstable from 828.427 rad/s on",
    "--feedback-rule forward": "feedback of kind integral requires --feedback-gain",
    "--feedback-gain lots": "'--feedback-gain': got 'lots'",
}


@pytest.mark.parametrize("options", FAULTS)
def test_faults_name_the_option(options):
    result = run("check", *OPTIONS, *WALL, *options.split())
    assert result.exit_code != 0
    assert FAULTS[options] in result.output.replace("\n", " ")


def test_output_names_the_estimates():
    result = run("check", *OPTIONS, *WALL, "--position-bandwidth", "500", "--feedback-gain", "1000")
    assert "position   Pll, bandwidth 500" in result.stdout
    assert "feedback   IntegralFeedback, gain 1.000 kN/(m s)" in result.stdout


def test_code_of_a_recommendation_contains_the_estimates():
    result = run("recommend", *OPTIONS, "--position-coefficient", "0.3", "--code", "c")
    assert result.exit_code == 0, result.output
    assert "The position estimate y is computed by ExponentialFilter" in result.stdout
    assert "position_q0 += 0.3 * (u - wall->position_q0)" in result.stdout
