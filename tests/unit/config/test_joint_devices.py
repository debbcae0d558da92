"""Devices with several joints in configurations, against `zwidth.from_mass_matrix` and `zwidth.from_mujoco`."""

import json
from importlib import import_module
from types import ModuleType

import numpy as np
import pytest

import zwidth
from zwidth.config.fields import ConfigFileError
from zwidth.core.errors import format_install_command
from zwidth.model import mujoco_model
from zwidth.studies.document import Config

STUDIES = "studies: [{kind: recommend, name: r}]\n"
TIMED = "period: 1 ms, delay: 1 ms"
MATRIX = "mass_matrix: [[0.03, 0.01], [0.01, 0.01]], jacobian: [[-0.2, -0.1]]"
MODEL = """
<mujoco><compiler angle="radian"/><worldbody>
  <body>
    <joint name="shoulder" axis="0 0 1" damping="0.02" armature="0.0015"/>
    <geom type="capsule" fromto="0 0 0 .25 0 0" size=".01" mass=".12"/>
    <body pos=".25 0 0">
      <joint name="elbow" axis="0 0 1" damping="0.05" armature="0.0015"/>
      <geom type="capsule" fromto="0 0 0 .25 0 0" size=".01" mass=".12"/>
      <site name="handle" pos=".25 0 0"/>
    </body>
  </body>
</worldbody><keyframe><key name="home" qpos="0.4 1.1"/></keyframe></mujoco>"""
URDF = """
<robot name="bar"><link name="base"/><link name="bar">
  <inertial><origin xyz="0.1 0 0"/><mass value="0.3"/>
  <inertia ixx="1e-4" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
  <joint name="hinge" type="revolute"><parent link="base"/><child link="bar"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/><dynamics damping="0.01"/></joint></robot>"""


def scene_with(device: str, more: str = TIMED) -> str:
    return f"scene: {{device: {{{device}}}, {more}}}\n{STUDIES}"


@pytest.fixture
def model_file(tmp_path):
    """Write a model next to the configuration; skip the test without MuJoCo."""
    pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    (tmp_path / "arm.xml").write_text(MODEL, encoding="utf-8")
    return tmp_path / "arm.xml"


@pytest.mark.parametrize(
    ("device", "arguments"),
    [
        (f"{MATRIX}, damping: 0.02", {"damping": 0.02}),
        (f"{MATRIX}, damping: [20 mN m s/rad, 0.03]", {"damping": [0.02, 0.03]}),
        (f"{MATRIX}, damping: [[0.02, 0.001], [0.001, 0.01]]", {"damping": [[0.02, 1e-3], [1e-3, 0.01]]}),
        (f"{MATRIX}, damping: 0.02, direction: [-1]", {"damping": 0.02, "direction": [-1]}),
        (f"{MATRIX}, stiffness: [0, 3 N m/rad]", {"stiffness": [0, 3]}),
    ],
)
def test_mass_matrix_equals_that_of_python(load, device, arguments):
    expected = zwidth.from_mass_matrix([[0.03, 0.01], [0.01, 0.01]], jacobian=[[-0.2, -0.1]], **arguments)
    config = load(scene_with(device))
    assert isinstance(expected, zwidth.LinearDevice)
    assert config.scene.to_scene().device == expected
    dump = config.model_dump(mode="json", exclude_none=True)
    assert Config.model_validate(json.loads(json.dumps(dump))) == config


def test_rigid_arm_is_a_mass_that_accepts_a_hand(load):
    scene = load(scene_with(MATRIX, f"{TIMED}, operator: {{mass: 100 g}}, stiffness: 500")).scene.to_scene()
    assert scene.device == zwidth.from_mass_matrix([[0.03, 0.01], [0.01, 0.01]], jacobian=[[-0.2, -0.1]])
    assert scene.operator == zwidth.Operator(0.1)


@pytest.mark.parametrize("damping", ["0", "0.02"])
def test_arm_has_a_simulated_tool(load, damping):
    scene = load(scene_with(f"{MATRIX}, damping: {damping}", f"{TIMED}, tool: {{mass: 300 g}}")).scene.to_scene()
    arm = zwidth.from_mass_matrix([[0.03, 0.01], [0.01, 0.01]], float(damping), jacobian=[[-0.2, -0.1]])
    expected = zwidth.Scene(arm, zwidth.Timing("1 ms", "1 ms"), tool=zwidth.Tool(0.3)).max_stiffness()
    assert scene.max_stiffness().stiffness == expected.stiffness


@pytest.mark.parametrize(
    ("pose", "given"),
    [
        ("pose: {elbow: 60 deg}", {"elbow": "60 deg"}),
        ("pose: [0.4, 60 deg]", [0.4, "60 deg"]),
        ("pose: [0.4, 1]", [0.4, 1]),
        ("pose: home", "home"),
    ],
)
def test_model_equals_that_of_python_and_is_stored_by_its_matrices(load, model_file, pose, given):
    config = load(scene_with(f"model: arm.xml, site: handle, direction: [1, 1, 0], {pose}"))
    expected = zwidth.from_mujoco(model_file, "handle", [1, 1, 0], pose=given)
    assert config.scene.to_scene().device == expected
    dump = config.model_dump(mode="json", exclude_none=True)
    model_file.unlink()
    assert Config.model_validate(dump).scene.to_scene().device == expected  # pyright: ignore


def test_urdf_model_is_a_mass_with_damping(load, model_file):
    model_file.with_suffix(".urdf").write_text(URDF, encoding="utf-8")
    scene = load(scene_with("model: arm.urdf, site: bar, direction: z, rotary: true")).scene.to_scene()
    assert scene.device.rotary
    assert scene.device.mass == pytest.approx(1e-3 + 0.3 * 0.1**2)
    assert scene.device.damping == pytest.approx(0.01)


@pytest.mark.parametrize("more", ["stiffness: 2 N m/rad", "stiffness: 2, rotary: true"])
def test_rotary_scene_uses_the_rotation_about_the_direction(load, model_file, more):
    scene = load(scene_with("model: arm.xml, site: handle, direction: z", f"{TIMED}, {more}")).scene.to_scene()
    expected = zwidth.from_mujoco(model_file, "handle", "z", rotary=True)
    assert scene.device == expected
    assert scene.device.rotary
    assert scene.wall.stiffness == 2


def test_angles_and_damping_of_joints_do_not_make_a_device_rotary(load, model_file):
    config = load(scene_with("model: arm.xml, site: handle, direction: y, pose: {elbow: 60 deg}"))
    assert not config.scene.to_scene().device.rotary
    assert not load(scene_with(f"{MATRIX}, damping: 20 mN m s/rad")).scene.to_scene().device.rotary


def test_studies_and_sweeps_have_their_own_arms(load):
    rigid = "{mass_matrix: [[2, 0], [0, 1]], direction: y}"
    config = load(
        scene_with(f"{MATRIX}, damping: 0.02").replace(
            STUDIES,
            "studies:\n"
            "  - {kind: compare, name: c, devices: [{label: arm}, {label: rigid, device: " + rigid + "}]}\n"
            "  - {kind: sweep, name: s, axes: {period: [1 ms, 2 ms]}, outputs: [stiffness_max]}\n"
            "  - {kind: sweep, name: t, device: "
            + rigid
            + ", axes: {period: [1 ms, 2 ms]}, outputs: [stiffness_max]}\n",
        )
    )
    compare, sweep, of_rigid = config.studies
    timing = zwidth.Timing("1 ms", "1 ms")
    expected = [
        zwidth.Scene(each, timing).max_stiffness() for each in (config.scene.to_scene().device, zwidth.Device(1))
    ]
    table = compare.compute(config.scene, True).table
    np.testing.assert_allclose(table["stiffness_N_per_m"], [float(each.stiffness) for each in expected], rtol=1e-9)
    assert sweep.with_parts
    assert not of_rigid.with_parts
    assert of_rigid.make_scene({"mass": 1.0, "damping": 0.0, "period": 1e-3}).device == zwidth.Device(1.0)


@pytest.mark.parametrize(
    ("device", "more", "field", "message"),
    [
        ("mass_matrix: [[1, 2], [2, 1]], direction: x", TIMED, "device.mass_matrix", "got an eigenvalue of -1"),
        ("mass_matrix: heavy, direction: x", TIMED, "device.mass_matrix", "got 'heavy'"),
        ("mass_matrix: [[1, 0], [0, 1]]", TIMED, "device.direction", "missing; give a vector of 2 components"),
        ("mass_matrix: [[1, 0], [0, 1]], direction: u", TIMED, "device.direction", "allowed are 'x', 'y', 'z'"),
        ("jacobian: [[1, 0]]", TIMED, "device.mass_matrix", "missing"),
        (f"{MATRIX}, dampng: 1", TIMED, "device.dampng", "did you mean 'damping'"),
        (f"{MATRIX}, damping: [1, 2, 3]", TIMED, "device.damping", "got 3 values for 2 joints"),
        (f"{MATRIX}, damping: 3 kg", TIMED, "device.damping", "the units allowed are"),
        (MATRIX, f"{TIMED}, mass: 1 kg", "mass", "the joints determine mass and damping; remove one"),
        (f"{MATRIX}, damping: 1", f"{TIMED}, operator: {{mass: 1}}", "operator", "add them to its matrices"),
        ("model: arm.xml, site: hand, direction: x", TIMED, "device.site", "did you mean 'handle'"),
        ("model: arn.xml, site: handle, direction: x", TIMED, "device.model", "not a file"),
        ("model: arm.xml, site: handle", TIMED, "device.direction", "missing"),
        ("model: arm.xml, site: handle, direction: x", TIMED, "device.direction", "no joint moves the point"),
        ("model: arm.xml, site: handle, direction: y, pose: hme", TIMED, "device.pose", "did you mean 'home'"),
        ("model: arm.xml, site: handle, direction: y, pose: {elbow: 1 mm}", TIMED, "device.pose.elbow", "1 mm"),
        ("model: arm.xml, site: handle, direction: y, pose: {elbw: 1}", TIMED, "device.pose", "did you mean 'elbow'"),
    ],
)
def test_invalid_arms_raise_at_their_location(load, model_file, device, more, field, message):
    with pytest.raises(ConfigFileError) as error:
        load(scene_with(device, more))
    (fault,) = error.value.faults
    assert fault.field == f"scene.{field}"
    assert message in str(fault)


def test_model_without_point_names_the_keys(load):
    with pytest.raises(ConfigFileError, match=r"write \{model: arm.xml, site: handle, direction: x\}"):
        load(f"scene: {{device: arm.xml, {TIMED}}}\n{STUDIES}")


def test_missing_package_is_named(load, model_file, monkeypatch):
    def refuse(name: str) -> ModuleType:
        if name == "mujoco":
            raise ImportError(name)
        return import_module(name)

    monkeypatch.setattr(mujoco_model, "import_module", refuse)
    with pytest.raises(ConfigFileError) as error:
        load(scene_with("model: arm.xml, site: handle, direction: x"))
    (fault,) = error.value.faults
    assert fault.field == "scene.device"
    assert format_install_command("mujoco") in str(fault)
