"""Commands for rotary devices: recognized by units or by name, printed in rotary units, never mixed with linear
ones.
"""

import json
import re

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

pytestmark = pytest.mark.usefixtures("fitted_once")
DEVICE = ["--mass", "12 g cm^2", "--damping", "0.02mNms/rad", "--rate", "1 kHz", "--delay", "1 ms"]
LINEAR_UNITS = re.compile(r"(N/m|N s/m|\bm?N\b(?! m)|\bk?g\b(?! ?[cm]+\^2))")
COMMANDS = {
    "check": ["--stiffness", "2 mN m/deg", "--virtual-damping", "0.4 mN m s/rad", "--friction", "1 mN m"],
    "ridge": [],
    "recommend": ["--phase-margin", "20"],
    "design": ["--stiffness", "4 mN m/deg", "--find", "delay", "--tolerance", "mass=10%"],
}


def run(*arguments):
    result = CliRunner().invoke(cli, list(arguments))
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_prints_rotary_units(command):
    text = run(command, *DEVICE, *COMMANDS[command])
    assert "N m/rad" in text
    assert not LINEAR_UNITS.search(text), text
    assert "12.00 g cm^2" in text
    assert "mN m/deg" in text
    as_json = run(command, *DEVICE, *COMMANDS[command], "--json")
    assert not LINEAR_UNITS.search(as_json), as_json


def test_units_of_data_sheets_of_motors_and_encoders():
    wall = "--mass", "60 gcm^2", "--rate", "1kHz", "--stiffness", "0.1 N m/rad"
    texts = [
        run("simulate", *wall, "--damping", damping, "--virtual-damping", B, "--hit", "60 rpm", "--resolution", encoder)
        for damping, B, encoder in (
            ("0.02 mN m s", "0.5 mN*m*s", "4096 cpr"),
            ("0.02 mN m s/rad", "0.5 mN m s/rad", "4096 counts per rev"),
        )
    ]
    assert texts[0] == texts[1]
    assert "hits the wall at 6.28 rad/s" in texts[0]


def test_lines_of_an_encoder_are_refused_with_the_number_of_counts():
    result = CliRunner().invoke(cli, ["excite", "--rate", "1 kHz", "--force", "20 mN m", "--resolution", "512 PPR"])
    assert result.exit_code != 0
    assert "'2048 counts/rev'" in result.output + str(result.exception)


def test_ridge_agrees_with_python():
    output = json.loads(run("ridge", *DEVICE, "--json"))
    scene = zwidth.Scene(zwidth.Device(12e-7, 2e-5, rotary=True), zwidth.Timing(1e-3, 1e-3))
    assert output["stiffness_max"] == float(scene.max_stiffness().stiffness)
    assert output["sensitivities"]["mass"]["unit"] == "N m/rad per kg m^2"


def test_published_device_supplies_parameters_and_units():
    wall = ["--rate", "1 kHz", "--stiffness", "20 mN m/deg"]
    text = run("check", "--device", "haptic_wheel", *wall)
    assert "4500 g cm^2, 1.300 mN m s/rad" in text
    assert "(20.00 mN m/deg)" in text
    modified = run(
        "check", "--device", "haptic_wheel", "--damping", "2 mN m s/rad", "--rate", "1 kHz", "--stiffness", "1"
    )
    assert "4500 g cm^2, 2.000 mN m s/rad" in modified
    assert "K = 1.000 N m/rad" in modified
    linear_name = next(device.name for device in zwidth.devices.DEVICES if not device.rotary and device.mass)
    assert "kN/m" in run("ridge", "--device", linear_name, "--damping", "1", "--rate", "1 kHz")
    result = CliRunner().invoke(cli, ["check", "--device", "haptic_weel", *wall])
    assert result.exit_code
    assert "did you mean 'haptic_wheel'" in result.output


def test_code_of_a_rotary_wall_states_its_units():
    text = run("recommend", *DEVICE, "--code", "c")
    assert "angle in rad" in text
    assert "in N m," in text
    assert "N m/rad" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ridge", "--mass", "12 g", "--damping", "0.02 mN m s/rad", "--rate", "1 kHz"], "--damping: got '0.02 mN m s"),
        (["ridge", "--device", "haptic_wheel", "--damping", "2 N s/m", "--rate", "1 kHz"], "together with --damping"),
        (["check", *DEVICE, "--stiffness", "2 N/m"], "in linear units"),
        (["check", *DEVICE, "--stiffness", "2", "--friction", "1 N"], "--friction"),
        (["ridge", *DEVICE, "--coupling-mass", "1 g", "--coupling-stiffness", "1"], "--coupling-mass"),
        (["ridge", *DEVICE, "--operator-mass", "1 kg"], "--operator-mass"),
        (["ridge", *DEVICE, "--modes-0-mass", "1 g"], "--modes-0-mass"),
    ],
)
def test_mixed_units_raise(arguments, message):
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code
    text = result.output + str(result.exception)
    assert message in text
    assert "write all quantities in" in text
