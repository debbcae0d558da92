"""Rotary devices in configurations: units, results and errors if mixed with linear units."""

import csv
import re
from typing import Any

import numpy as np
import pytest

import zwidth
from zwidth.config.reader import read_mapping
from zwidth.studies.document import Config, load_config

SCENE: dict[str, Any] = {"mass": "12 g cm^2", "damping": "0.02 mN m s/rad", "rate": "1 kHz", "delay": "1 ms"}
pytestmark = pytest.mark.usefixtures("fitted_once")
WALL = {"stiffness": "2 mN m/deg", "virtual_damping": "0.4 mN m s/rad"}
RECOMMEND = {"kind": "recommend", "name": "set"}


def read_config(scene: Any = None, *studies: dict[str, Any], **top: Any) -> Config:
    mapping = {"version": 1, "name": "turn", "studies": list(studies) or [RECOMMEND], **top}
    return read_mapping(mapping if scene is None else {**mapping, "scene": scene}, Config)


def is_rotary(config: Config) -> bool:
    return config.studies[0].unit_system.rotary


def read_invalid(scene: Any, *studies: dict[str, Any]) -> str:
    with pytest.raises(zwidth.ConfigError) as error:
        read_config(scene, *studies)
    return str(error.value)


def test_rotary_units_make_the_devices_rotary():
    config = read_config(SCENE | WALL)
    scene = config.scene.to_scene()  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    assert is_rotary(config)
    assert scene.device == zwidth.Device(12e-7, 2e-5, rotary=True)
    assert scene.wall.stiffness == pytest.approx(0.36 / np.pi, rel=1e-14)
    # The dumped configuration has plain numbers and is read back equal.
    dump = config.model_dump(mode="json", exclude_none=True)
    again = read_mapping(dump, Config)
    assert is_rotary(again)
    assert again.model_dump(mode="json", exclude_none=True) == dump
    assert not is_rotary(read_config({"mass": 0.1, "rate": 1000, "rotary": False}))
    assert "rotary" not in str(read_config({"mass": 0.1, "rate": 1000}).model_dump(mode="json", exclude_none=True))
    assert is_rotary(read_config({"mass": 1e-6, "rate": 1000, "rotary": True}))


def test_degrees_of_a_margin_do_not_imply_a_rotary_device():
    message = read_invalid({"mass": "100 g", "rate": "1 kHz"}, RECOMMEND | {"phase_margin": "30 deg"})
    assert "phase_margin: got '30 deg'" in message
    assert "rotary" not in message


def test_published_device_is_given_by_name():
    config = read_config({"device": "haptic_wheel", "rate": "1 kHz", "stiffness": 1.0})
    assert is_rotary(config)
    wheel = zwidth.devices.find_device("haptic_wheel").to_device()
    assert config.scene.to_scene().device == wheel  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    modified = read_config({"device": "haptic_wheel", "damping": "2 mN m s/rad", "rate": "1 kHz"})
    assert modified.scene.damping == 2e-3  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    assert "did you mean 'haptic_wheel'?" in read_invalid({"device": "haptic_weel", "rate": "1 kHz"})
    name = next(device.name for device in zwidth.devices.DEVICES if device.mass and not device.rotary)
    assert not is_rotary(read_config({"device": name, "rate": "1 kHz"}))
    assert "others of the file are rotary" in read_invalid({"device": name, "rate": "1 kHz", "stiffness": "1 N m/rad"})


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"mass": "12 g"}, "scene.mass"),
        ({"damping": "2 N s/m"}, "scene.damping"),
        ({"stiffness": "2 N/m"}, "scene.stiffness"),
        ({"operator": {"mass": "0.5 kg"}}, "scene.operator.mass"),
        ({"coupling": {"mass": "3 g cm^2", "stiffness": "20 kN/m"}}, "scene.coupling.stiffness"),
        ({"modes": [{"frequency": 100, "damping_ratio": 0.1, "mass": "3 g"}]}, "scene.modes[0].mass"),
        ({"rotary": False}, "scene.rotary"),
    ],
)
def test_mixed_units_raise_at_their_location(change, field):
    text = read_invalid(SCENE | change)
    assert text.startswith(f"{field}: got ")
    assert "linear" in text or "rotation" in text


def test_linear_unit_in_a_study_of_a_rotary_device_raises():
    motion = {"kind": "simulate", "name": "m", "duration": "0.1 s", "start_position": "1 mm"}
    assert "studies[0].start_position: got '1 mm', a linear unit for a rotary device" in read_invalid(
        SCENE | WALL, motion
    )


def test_misspelled_rotary_unit_is_not_taken_for_a_linear_one(tmp_path):
    file = tmp_path / "a.yaml"
    scene = "{mass: 0.1, rate: 1 kHz, damping: 0.02 mN m s/rd}"
    file.write_text(f"version: 1\nname: a\nscene: {scene}\nstudies: [{{kind: recommend, name: r}}]\n")
    with pytest.raises(zwidth.ConfigError, match=r"a\.yaml:3:.*did you mean 'mN m s/rad'\?"):
        load_config(file)
    file.write_text(file.read_text().replace("s/rd", "s/rad"))
    # A plain number has the unit of the file's devices: 0.1 kg m^2 is an inertia.
    assert is_rotary(load_config(file))
    file.write_text(file.read_text().replace("mass: 0.1", "mass: 100 g"))
    with pytest.raises(zwidth.ConfigError) as refused:
        load_config(file)
    assert "mN s/m" not in str(refused.value)
    assert re.search(r"a\.yaml:3:15: scene\.mass: got '100 g', a linear unit for a rotary device", str(refused.value))


def test_figure_width_is_a_length():
    assert read_config(SCENE, figure={"width": "85 mm"}).figure.width == 0.085  # pyright: ignore[reportOptionalMemberAccess]


def test_run_writes_rotary_units(tmp_path):
    axes = {"stiffness": {"linear": {"start": 0, "stop": "0.3 N m/rad", "num": 4}}, "virtual_damping": [1e-4, 5e-4]}
    sweep = {"kind": "sweep", "name": "s", "axes": axes, "outputs": ["stable", "stiffness_max"]}
    motion = {"kind": "simulate", "name": "m", "duration": "0.05 s", "start_position": "1 deg", "coulomb": "1 uN m"}
    requirement = {"kind": "design", "name": "d", "stiffness": ["10 mN m/deg"], "find": "delay"}
    scene = SCENE | WALL
    config = {
        "version": 1,
        "name": "a",
        "scene": scene,
        "studies": [RECOMMEND, sweep, motion | {"coulomb": 0}, requirement],
    }
    assert zwidth.run(config, out=tmp_path / "a").ok
    with open(tmp_path / "a" / "m.csv", encoding="utf-8") as stream:
        names = next(csv.reader(stream))
    assert {"stiffness_N_m_per_rad", "position_rad", "velocity_rad_per_s", "command_N_m"} <= set(names)
    assert not [name for name in names if re.search(r"(_m|N_per_m|_N)$", name) and not name.endswith("N_m")]
    recommendation = (tmp_path / "a" / "recommendation.md").read_text(encoding="utf-8")
    assert "J = 12.00 g cm^2" in recommendation
    assert not re.search(r"N/m|N s/m|kg\b", recommendation)
    data = zwidth.open_dataset(tmp_path / "a" / "s.zarr")
    units = {name: data[name].attrs.get("units") for name in ("stiffness", "virtual_damping", "mass", "stiffness_max")}
    assert units == {
        "stiffness": "N m/rad",
        "virtual_damping": "N m s/rad",
        "mass": "kg m^2",
        "stiffness_max": "N m/rad",
    }
    top = zwidth.Scene(zwidth.Device(12e-7, 2e-5, rotary=True), zwidth.Timing(1e-3, 1e-3)).max_stiffness().stiffness
    np.testing.assert_allclose(data["stiffness_max"].values, top, rtol=1e-12)
    # The run is resumable from its stored configuration.
    assert zwidth.run(tmp_path / "a" / "config.yaml", out=tmp_path / "a", resume=True).ok
