"""Test the table of published devices: sources and units, and reproduction of published stability limits."""

import csv
import dataclasses
import json
import math
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli
from zwidth.model.devices import DEVICES, HAND, PublishedValue, find_device

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
# One N mm/deg in N m/rad.
N_MM_PER_DEG = 1e-3 * 180 / math.pi


@pytest.mark.parametrize(("period", "critical"), [(1e-3, 45.40), (1e-4, 453.8)])
def test_haptic_wheel_reproduces_published_critical_stiffness(period, critical):
    """Without delay and virtual damping; a wall of 50 N mm/deg is unstable at a period of 1 ms and stable at 0.1 ms."""
    scene = zwidth.Scene(find_device("haptic_wheel").to_device(), zwidth.Timing(period))
    ((low, high),) = scene.stable_stiffness(0.0)
    assert low == 0
    assert float(f"{high / N_MM_PER_DEG:.4g}") == critical
    assert scene.is_stable(50 * N_MM_PER_DEG) == (period == 1e-4)


def test_phantom_reproduces_alpha_max_of_the_paper():
    published = find_device("phantom_2006")
    scene = zwidth.Scene(
        published.to_device(damping=10), zwidth.Timing(published.parameters["period"].value, delay=1e-3)
    )
    assert zwidth.alpha_max(scene.delta, scene.d).alpha == pytest.approx(0.1986, abs=5e-5)


def test_every_value_has_a_source_and_the_unit_of_its_motion():
    rotary = {"mass": "kg m^2", "damping": "N m s/rad", "friction": "N m", "resolution": "rad"}
    linear = {"mass": "kg", "damping": "N s/m", "friction": "N", "resolution": "m"}
    for device in DEVICES:
        units = {
            "period": "s",
            "delay": "periods",
            "counts": "counts",
            "force": "N",
            "stiffness_limit": "N/m",
            "damping_limit": "N s/m",
        }
        units |= rotary if device.motion == "rotary" else linear
        assert device.parameters
        for name, number in device.parameters.items():
            assert number.source
            assert number.value > 0
            assert number.unit == units[name], (device.name, name)


def test_unpublished_values_are_required():
    paddle = find_device("epfl_paddle")
    assert paddle.mass is None
    with pytest.raises(zwidth.InputError, match=r"mass: no value is published for 'epfl_paddle'.*pass a value"):
        paddle.to_device()
    assert paddle.to_device(mass=0.05) == zwidth.Device(mass=0.05, damping=0.033)
    with pytest.raises(zwidth.InputError, match="did you mean 'falcon'"):
        find_device("falcn")


def test_hand_is_a_rigid_grasp_or_coupled_by_a_spring():
    assert HAND.to_operator() == zwidth.Operator(mass=0.554, damping=6.45, stiffness=135)
    assert dataclasses.replace(HAND.to_operator(), coupling_stiffness=1e3).coupling_stiffness == 1e3


def test_devices_command_lists_devices_and_sources():
    # Long lines are continued with an indent.
    listed = re.sub(r"\n {2,}", " ", CliRunner().invoke(cli, ["devices"]).output).splitlines()
    assert [line.split()[0] for line in listed] == [device.name for device in DEVICES]
    for line, device in zip(listed, DEVICES, strict=True):
        assert all(number.spell() in line for number in device.parameters.values())
    details = CliRunner().invoke(cli, ["devices", "haptic_wheel"]).output
    assert "4500 g cm^2" in details
    assert find_device("haptic_wheel").parameters["mass"].source in details
    machine = json.loads(CliRunner().invoke(cli, ["devices", "--json"]).output)
    assert [entry["name"] for entry in machine] == [device.name for device in DEVICES]
    wheel = machine[1]
    assert PublishedValue(**wheel["damping"]) == find_device("haptic_wheel").damping
    assert wheel["friction"] is None


def test_shipped_device_table_contains_only_published_values():
    lines = [line for line in (CONFIGS / "devices.csv").read_text("utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert all(row["source"] for row in rows)
    masses = {0.3, 0.5} | {d.mass.value for d in DEVICES if d.mass is not None and d.motion == "linear"}
    assert {float(row["mass [g]"]) / 1e3 for row in rows} <= masses


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.name)
def test_ridge_command_names_the_options_for_unpublished_values(device):
    """For each published device, the options named in the message are sufficient."""
    options = {"mass": "20 g", "damping": "0.5", "period": "1 ms"}
    if device.rotary:
        options |= {"mass": "20 g m^2"}
    missing = [name for name in options if getattr(device, name) is None]
    runner, command = CliRunner(), ["ridge", "--device", device.name, "--json"]
    result = runner.invoke(cli, command)
    assert result.exit_code == (2 if missing else 0)
    for name in options:
        is_named = f"--{name}" in result.stderr
        assert is_named == (name in missing), result.stderr
    result = runner.invoke(cli, [*command, *(word for name in missing for word in (f"--{name}", options[name]))])
    assert result.exit_code == 0, result.output


def test_published_delay_in_periods_stays_constant_in_periods():
    published = find_device("phantom_2006")
    for options, period in (([], 1e-3), (["--rate", "4 kHz"], 0.25e-3)):
        command = ["ridge", "--device", "phantom_2006", "--damping", "10", "--json", *options]
        result = json.loads(CliRunner().invoke(cli, command).stdout)
        scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period, delay=period))
        assert result["stiffness_max"] == pytest.approx(float(scene.max_stiffness().stiffness), rel=1e-9)
    assert published.to_timing(delay="2 ms") == zwidth.Timing(1e-3, 2e-3)
    with pytest.raises(zwidth.InputError, match="period: no value is published for 'touch'"):
        find_device("touch").to_timing()
