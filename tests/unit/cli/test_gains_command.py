"""Gains of motor controllers on the command line and in files, typed as a user types them."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

MOTOR = ["--mass", "1e-4 kg m^2", "--damping", "1e-4 N m s/rad", "--rate", "8 kHz", "--delay", "1.5 periods"]
PLL = ["--position-bandwidth", "1000"]
CASCADE = ["--feedback-gain", "0.0477465", "--feedback-rule", "forward"]
CASCADE += ["--feedback-position", "20", "--feedback-velocity", "1"]


def run(*arguments):
    result = CliRunner().invoke(cli, list(arguments))
    assert result.exit_code == 0, result.output
    return result.output


def test_recommend_prints_the_gains_of_a_cascade_in_turns():
    arguments = ["recommend", *MOTOR, *PLL, "--stiffness-fraction", "20%"]
    text = " ".join(run(*arguments, *CASCADE).split())
    gains = r" gains pos_gain [0-9.]+ 1/s, vel_gain [0-9.]+ N m/\(turn/s\), vel_integrator_gain 0.3000 N m/turn "
    assert re.search(gains, text)
    result = json.loads(run(*arguments, *CASCADE, "--json"))
    K, B = (result["recommended"][name] for name in ("stiffness", "virtual_damping"))
    assert result["gains"]["pos_gain"] == pytest.approx(K / B)
    assert result["gains"]["units"] == "turns"
    assert "gains" not in json.loads(run(*arguments, "--json"))


@pytest.mark.parametrize("rule", ["forward", "trapezoidal", "backward"])
def test_an_odrive_is_assessed_by_its_gains(rule):
    gains = ["--pos-gain", "20", "--vel-gain", "0.16", "--vel-integrator-gain", "0.32", "--rule", rule]
    result = json.loads(run("gains", *gains, *MOTOR, *PLL, "--json"))

    def build(*gains):
        device = zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad")
        controller = zwidth.cascade(*gains, position=zwidth.Pll(1000), rule=rule)
        return zwidth.Scene(device, zwidth.Timing(rate="8 kHz", delay="1.5 periods"), **controller)

    scene = build(20, 0.16, 0.32)
    assert result["stiffness"] == pytest.approx(scene.wall.stiffness)
    assert result["virtual_damping"] == pytest.approx(scene.wall.virtual_damping)
    assert result["integral_gain"] == pytest.approx(0.32 / (2 * np.pi))
    assert result["check"]["spectral_radius"] == pytest.approx(float(scene.spectral_radius()), rel=1e-12)
    # Compare each end of the stable interval of each gain with the stability of the controller close to the end.
    for index, (name, (low, high)) in enumerate(result["limits"].items()):
        for factor, stable in ((1 - 1e-6, True), (1 + 1e-6, False)):
            changed = [20, 0.16, 0.32]
            changed[index] = factor * high
            assert bool(build(*changed).is_stable()) is stable, (name, changed)
            changed[index] = low / factor
            assert not low or bool(build(*changed).is_stable()) is stable, (name, changed)


def test_gains_convert_without_a_device():
    text = run("gains", "--pos-gain", "20", "--vel-gain", "0.16")
    assert "K = 509.2 mN m/rad, B = 25.46 mN m s/rad" in text
    motor = ["--torque-constant", "0.02", "--resistance", "2.5"]
    result = json.loads(run("gains", "--kp", "0.25", "--ki", "0.5", "--kd", "0.003", *motor, "--json"))
    assert (result["stiffness"], result["virtual_damping"]) == pytest.approx((0.25 * 0.008, 0.003 * 0.008))
    assert result["integral_gain"] == pytest.approx(0.5 * 0.008)
    linear = json.loads(run("gains", "--kp", "2000", "--kd", "5", "--units", "m", "--json"))
    assert (linear["stiffness"], linear["virtual_damping"]) == (2000, 5)


def test_a_wall_converts_to_gains():
    text = run("gains", "--stiffness", "2 N m/rad", "--virtual-damping", "50 mN m s/rad")
    assert "pos_gain 40.00 1/s, vel_gain 0.3142 N m/(turn/s)" in text
    assert "kp 2.000 N m/rad, kd 0.05000 N m/(rad/s)" in text
    spring = json.loads(run("gains", "--stiffness", "2 kN/m", "--json"))
    assert list(spring["gains"]) == ["pid"]


FILE = """\
version: 1
name: motor
scene:
  mass: 1000 g cm^2
  damping: 0.1 mN m s/rad
  rate: 8 kHz
  delay: 1.5 periods
  position: {kind: pll, bandwidth: 1000}
  controller: CONTROLLER
studies:
  - {kind: boundary, name: walls}
"""


@pytest.mark.parametrize(
    "controller, options",
    [
        (
            "{kind: cascade, pos_gain: 20, vel_gain: 0.16, vel_integrator_gain: 0.32, rule: forward}",
            ["--pos-gain", "20", "--vel-gain", "0.16", "--vel-integrator-gain", "0.32", "--rule", "forward"],
        ),
        (
            "{kind: pid, kp: 3, ki: 2, kd: 0.04, torque_constant: 0.5}",
            ["--kp", "3", "--ki", "2", "--kd", "0.04", "--torque-constant", "0.5"],
        ),
    ],
)
def test_a_file_with_a_controller_gives_the_results_of_the_options(tmp_path, controller, options):
    file = tmp_path / "motor.yaml"
    file.write_text(FILE.replace("CONTROLLER", controller), encoding="utf-8")
    checked = json.loads(run("check", str(file), "--json"))
    expected = json.loads(run("gains", *options, *MOTOR, *PLL, "--json"))
    assert checked["spectral_radius"] == pytest.approx(expected["check"]["spectral_radius"], rel=1e-12)
    units = ["--output-unit", "0.5"] if "pid" in controller else []
    printed = json.loads(run("gains", str(file), *units, "--json"))
    kind = "pid" if "pid" in controller else "cascade"
    for name, gain in expected["gains"][kind].items():
        assert printed["gains"][kind][name] == (gain if name == "units" else pytest.approx(gain))
    assert printed["limits"].keys() == expected["limits"].keys()
    for name, ends in expected["limits"].items():
        assert printed["limits"][name] == pytest.approx(ends)


NUMBERS = ["--mass", "1e-4", "--damping", "1e-4", "--rate", "8 kHz", "--delay", "1.5 periods"]


def test_quantities_without_unit_belong_to_a_rotary_device_if_the_gains_are_in_turns(tmp_path):
    gains = ["--pos-gain", "20 1/s", "--vel-gain", "0.16"]
    text = run("gains", *gains, *NUMBERS)
    assert text == run("gains", *gains, *MOTOR)
    assert text == run("gains", "--pos-gain", "20 /s", "--vel-gain", "0.16", *NUMBERS)
    assert "K = 3.200 N/m" in run("gains", *gains, *NUMBERS, "--units", "m")
    file = tmp_path / "motor.yaml"
    plain = (
        FILE.replace("1000 g cm^2", "1e-4").replace("0.1 mN m s/rad", "1e-4").replace("  position: {kind: pll", "  #")
    )
    file.write_text(plain.replace("CONTROLLER", "{kind: cascade, pos_gain: 20, vel_gain: 0.16}"), encoding="utf-8")
    assert run("gains", str(file)) == text
    file.write_text(plain.replace("CONTROLLER", "{kind: pid, kp: 3.2, kd: 0.16}"), encoding="utf-8")
    assert "K = 3.200 N/m" in run("gains", str(file))


def test_options_override_single_gains_of_a_file(tmp_path):
    file = tmp_path / "motor.yaml"
    controller = (
        "{kind: cascade, pos_gain: 20, vel_gain: 4, vel_integrator_gain: 8, rule: forward, torque_constant: 0.04}"
    )
    file.write_text(FILE.replace("CONTROLLER", controller), encoding="utf-8")
    gains = ["--pos-gain", "20", "--vel-gain", "4", "--rule", "forward", "--torque-constant", "0.04"]
    expected = json.loads(run("gains", *gains, "--vel-integrator-gain", "3", *MOTOR, *PLL, "--json"))
    result = json.loads(run("gains", str(file), "--vel-integrator-gain", "3", "--json"))
    assert result["gains"] == expected["gains"]
    assert result["check"]["spectral_radius"] == pytest.approx(expected["check"]["spectral_radius"], rel=1e-12)
    # The folder of a run contains the configuration with the controller.
    folder = tmp_path / "motor"
    run("run", str(file), "--out", str(folder))
    assert json.loads(run("gains", str(folder), "--vel-integrator-gain", "3", "--json")) == result
    # A new torque constant leaves K and B of the file unchanged, and the gains change.
    result = json.loads(run("gains", str(file), "--torque-constant", "0.02", "--json"))
    assert result["gains"]["cascade"]["vel_gain"] == pytest.approx(8)
    assert result["stiffness"] == pytest.approx(expected["stiffness"])
    # New values of K and B change pos_gain in the integrator, too.
    wall = ["--stiffness", "2", "--virtual-damping", "50 mN m s/rad"]
    result = json.loads(run("gains", str(file), *wall, "--json"))
    assert result["gains"]["cascade"]["pos_gain"] == pytest.approx(40)
    assert result["gains"]["cascade"]["vel_integrator_gain"] == pytest.approx(8)


@pytest.mark.parametrize("gains", [(800, 0.16), (-5, 0.16), (20, 4), (20, -1)])
def test_an_unstable_controller_has_limits_and_a_remedy(gains):
    options = ["gains", "--pos-gain", str(gains[0]), "--vel-gain", str(gains[1]), *NUMBERS, *PLL]
    text = " ".join(run(*options).split())
    result = json.loads(run(*options, "--json"))
    assert "UNSTABLE" in text
    assert "remedy set " in text
    assert "use zwidth recommend" in text
    device = zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad")
    timing = zwidth.Timing(rate="8 kHz", delay="1.5 periods")
    for index, (name, ends) in enumerate(result["limits"].items()):
        if ends is None:
            assert f"no {name} > 0 is stable" in text
            continue
        for value in (ends[0] + 0.01 * (ends[1] - ends[0]), 0.99 * ends[1], 1.01 * ends[1]):
            changed = list(gains)
            changed[index] = value
            scene = zwidth.Scene(device, timing, **zwidth.cascade(*changed, position=zwidth.Pll(1000)))
            assert bool(scene.is_stable()) is (value < ends[1])


def test_check_reports_an_integrator_with_another_pos_gain_than_the_wall(tmp_path):
    file = tmp_path / "motor.yaml"
    controller = "{kind: cascade, pos_gain: 20, vel_gain: 0.16, vel_integrator_gain: 0.32, rule: forward}"
    file.write_text(FILE.replace("CONTROLLER", controller), encoding="utf-8")
    wall = ["--stiffness", "2 N m/rad", "--virtual-damping", "50 mN m s/rad"]
    text = " ".join(run("check", str(file), *wall).split())
    assert "CAUTION the integrator contains pos_gain = 20.00 1/s, but this wall needs K/B = 40.00 1/s" in text
    assert "use zwidth gains with the same options" in text
    assert "integrator contains" in json.loads(run("check", str(file), *wall, "--json"))["cautions"][0]
    assert "integrator contains" not in run("check", str(file))
    assert "integrator contains" not in run("gains", str(file), *wall)


@pytest.mark.parametrize(
    "controller, message",
    [
        ("{kind: cascade, pos_gain: 20, vel_gain: 0.16, units: m}", "controller.units: got 'm' for a rotary device"),
        ("{kind: pid, kp: 3 N m}", "controller.kp: got '3 N m'"),
        ("{kind: pid, kp: 3, resistance: 2}", "controller.resistance: got 2.0 without torque_constant"),
        ("{kp: 3}", "controller.kind: missing"),
        ("{kind: pid, kp: 3}\n  stiffness: 3", "stiffness: got 'stiffness' together with a controller"),
    ],
)
def test_invalid_controllers_in_files(tmp_path, controller, message):
    file = tmp_path / "motor.yaml"
    file.write_text(FILE.replace("CONTROLLER", controller), encoding="utf-8")
    result = CliRunner().invoke(cli, ["check", str(file)])
    assert message in str(result.exception)


@pytest.mark.parametrize(
    "options, message",
    [
        (["--pos-gain", "2"], "requires --vel-gain"),
        (["--kp", "2", "--vel-gain", "2"], "only those of one controller"),
        (["--kp", "2", "--stiffness", "3"], "give either the gains, or K and B"),
        ([], "give gains such as"),
        (["--kp", "2", "--units", "turns", "--mass", "0.1 kg", "--rate", "1 kHz"], "got 'turns' for a linear device"),
        (
            ["--pos-gain", "20", "--vel-gain", "0.16", "--mass", "0.1 kg", "--rate", "1 kHz"],
            "use m, or write the inertia in a rotary unit, such as '1e-4 kg m^2'",
        ),
        (["--pos-gain", "20 Hz", "--vel-gain", "0.16"], "got '20 Hz'; write only a number"),
        (["--kp", "2", "--output-unit", "2", "--torque-constant", "3"], "give only one of them"),
        (["--kp", "2", "--resistance", "-1"], "resistance"),
    ],
)
def test_invalid_options(options, message):
    result = CliRunner().invoke(cli, ["gains", *options])
    assert result.exit_code == 2
    assert message in result.output
