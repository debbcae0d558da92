"""Devices with published numbers: what they hold, and that their numbers reproduce what was published of them."""

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
def test_the_wheel_has_its_critical_stiffness(period, critical):
    """Of the undelayed loop without virtual damping; at 1 ms 50 N mm/deg grows, at 0.1 ms it decays."""
    scene = zwidth.Scene(find_device("haptic_wheel").to_device(), zwidth.Timing(period))
    ((low, high),) = scene.stable_stiffness(0.0)
    assert low == 0
    assert float(f"{high / N_MM_PER_DEG:.4g}") == critical
    assert scene.is_stable(50 * N_MM_PER_DEG) == (period == 1e-4)


def test_the_paper_s_device_has_the_paper_s_stiffness():
    known = find_device("phantom_2006")
    scene = zwidth.Scene(known.to_device(damping=10), zwidth.Timing(known.parameters["period"].value, delay=1e-3))
    assert zwidth.alpha_max(scene.delta, scene.d).alpha == pytest.approx(0.1986, abs=5e-5)


def test_every_number_has_a_source_and_a_unit_of_its_motion():
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


def test_what_is_not_published_is_asked_for():
    paddle = find_device("epfl_paddle")
    assert paddle.mass is None
    with pytest.raises(zwidth.InputError, match=r"mass: no value is published for 'epfl_paddle'.*pass a value"):
        paddle.to_device()
    assert paddle.to_device(mass=0.05) == zwidth.Device(mass=0.05, damping=0.033)
    with pytest.raises(zwidth.InputError, match="did you mean 'falcon'"):
        find_device("falcn")


def test_the_hand_is_a_rigid_grasp_or_stands_behind_a_spring():
    assert HAND.to_operator() == zwidth.Operator(mass=0.554, damping=6.45, stiffness=135)
    assert dataclasses.replace(HAND.to_operator(), coupling_stiffness=1e3).coupling_stiffness == 1e3


def test_the_command_lists_them_and_tells_the_sources_of_one():
    # Long lines continue indented.
    listed = re.sub(r"\n {2,}", " ", CliRunner().invoke(cli, ["devices"]).output).splitlines()
    assert [line.split()[0] for line in listed] == [device.name for device in DEVICES]
    for line, device in zip(listed, DEVICES, strict=True):
        assert all(number.spell() in line for number in device.parameters.values())
    one = CliRunner().invoke(cli, ["devices", "haptic_wheel"]).output
    assert "4500 g cm^2" in one
    assert find_device("haptic_wheel").parameters["mass"].source in one
    machine = json.loads(CliRunner().invoke(cli, ["devices", "--json"]).output)
    assert [entry["name"] for entry in machine] == [device.name for device in DEVICES]
    wheel = machine[1]
    assert PublishedValue(**wheel["damping"]) == find_device("haptic_wheel").damping
    assert wheel["friction"] is None


def test_the_shipped_table_holds_published_numbers_only():
    lines = [line for line in (CONFIGS / "devices.csv").read_text("utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    assert all(row["source"] for row in rows)
    masses = {0.3, 0.5} | {d.mass.value for d in DEVICES if d.mass is not None and d.motion == "linear"}
    assert {float(row["mass [g]"]) / 1e3 for row in rows} <= masses


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.name)
def test_the_command_line_names_what_is_not_published(device):
    """The options that a message names are enough, for each published device."""
    options = {"mass": "20 g", "damping": "0.5", "period": "1 ms"}
    if device.rotary:
        options |= {"mass": "20 g m^2"}
    missing = [name for name in options if getattr(device, name) is None]
    runner, command = CliRunner(), ["ridge", "--device", device.name, "--json"]
    done = runner.invoke(cli, command)
    assert done.exit_code == (2 if missing else 0)
    for name in options:
        named = f"--{name}" in done.stderr
        assert named == (name in missing), done.stderr
    done = runner.invoke(cli, [*command, *(word for name in missing for word in (f"--{name}", options[name]))])
    assert done.exit_code == 0, done.output


def test_a_published_delay_in_periods_stays_in_periods():
    known = find_device("phantom_2006")
    for options, period in (([], 1e-3), (["--rate", "4 kHz"], 0.25e-3)):
        command = ["ridge", "--device", "phantom_2006", "--damping", "10", "--json", *options]
        found = json.loads(CliRunner().invoke(cli, command).stdout)
        scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(period, delay=period))
        assert found["stiffness_max"] == pytest.approx(float(scene.max_stiffness().stiffness), rel=1e-9)
    assert known.to_timing(delay="2 ms") == zwidth.Timing(1e-3, 2e-3)
    with pytest.raises(zwidth.InputError, match="period: no value is published for 'touch'"):
        find_device("touch").to_timing()
