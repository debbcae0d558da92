"""The workspace study of an arm: K_max of all poses and directions against single scenes, and messages for users."""

import json
from typing import Any

import numpy as np
import pytest
from sweeping import run_main

import zwidth
from zwidth.core.errors import ConfigError
from zwidth.studies.document import Config, load_config

pytestmark = pytest.mark.usefixtures("unpainted")
# The annotation is Any, because the type stubs of MuJoCo lack most functions.
mujoco: Any = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

MODEL = """
<mujoco><compiler angle="radian"/><worldbody>
  <body>
    <joint name="shoulder" axis="0 0 1" damping="0.02" armature="0.0015"/>
    <geom type="capsule" fromto="0 0 0 .25 0 0" size=".01" mass=".12"/>
    <body pos=".25 0 0">
      <joint name="elbow" axis="0 0 1" damping="0.05" armature="0.0015"/>
      <geom type="capsule" fromto="0 0 0 .25 0 0" size=".01" mass=".12"/>
      <body pos=".25 0 0">
        <joint name="slide" type="slide" axis="0 0 1" damping="3"/>
        <geom type="sphere" size=".02" mass=".1"/>
        <site name="handle"/>
      </body>
    </body>
  </body>
</worldbody></mujoco>"""
JOINTS = "{shoulder: {linear: {start: 0 deg, stop: 60 deg, num: 2}}, elbow: [30 deg, 1 rad]}"
TIMING = zwidth.Timing("1 ms", "1 ms")


def write_config(folder, joints=JOINTS, more="directions: [x, [1, 1, 0], z]", study="period: 1 ms, delay: 1 ms"):
    (folder / "arm.xml").write_text(MODEL, encoding="utf-8")
    file = folder / "w.yaml"
    arm = f"{{model: arm.xml, site: handle, joints: {joints}{', ' if more else ''}{more}}}"
    file.write_text(f"version: 1\nname: w\nstudies:\n  - {{kind: workspace, name: w, arm: {arm}, {study}}}\n")
    return file


def test_every_pose_and_direction_agrees_with_its_scene(tmp_path, capsys):
    assert run_main("run", write_config(tmp_path), "--out", tmp_path / "out") == 0
    table = np.genfromtxt(tmp_path / "out" / "w.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert len(table) == 12
    assert table.dtype.names is not None
    assert table.dtype.names[:3] == ("shoulder_deg", "elbow_deg", "direction")
    model = mujoco.MjModel.from_xml_string(MODEL)
    directions = {"x": "x", "(1 1 0)": [1, 1, 0], "z": "z"}
    scenes = []
    for row in table:
        pose = [np.radians(row["shoulder_deg"]), np.radians(row["elbow_deg"]), 0]
        device = zwidth.from_mujoco(model, "handle", directions[row["direction"]], pose=pose)
        scenes.append(zwidth.Scene(device, TIMING))
        top = scenes[-1].max_stiffness(negative_damping=False)
        assert row["stiffness_N_per_m"] == pytest.approx(float(top.stiffness), rel=1e-8)
    weakest = table[np.argmin(table["stiffness_N_per_m"])]
    output = " ".join(capsys.readouterr().out.split())
    place = f"shoulder {weakest['shoulder_deg']:.4g} deg, elbow {weakest['elbow_deg']:.4g} deg along"
    assert f"at {place} {weakest['direction']} to" in output
    wall = 0.75 * weakest["stiffness_N_per_m"], weakest["virtual_damping_N_s_per_m"]
    count = sum(bool(scene.is_stable(*wall)) for scene in scenes)
    assert f"is stable in {count} of 12 poses and directions" in output
    assert (tmp_path / "out" / "w.png").exists()
    # The run contains a copy of the model, and is resumed without computation.
    assert (tmp_path / "out" / "inputs" / "arm.xml").read_text() == MODEL
    assert zwidth.run(tmp_path / "w.yaml", out=tmp_path / "out", resume=True).studies[0].state == "kept"


@pytest.mark.parametrize(
    ("joints", "others"), [(JOINTS, ""), (JOINTS[:-1] + ", slide: [0, 1 cm]}", " and other joints")]
)
def test_figure_names_its_quantity_and_the_worst_pose_and_direction(tmp_path, joints, others):
    study: Any = load_config(write_config(tmp_path, joints)).studies[0]
    outcome = study.compute(None, True)
    plt = pytest.importorskip("matplotlib.pyplot")
    (ax,) = outcome.figures[""]()
    figure = ax.figure
    texts = [text.get_text() for legend in [*figure.legends, ax.get_legend()] if legend for text in legend.get_texts()]
    worst = outcome.answer[0].removeprefix("K_max from ").partition(" to ")[0]
    assert texts == [f"weakest: {worst}"]
    bar = figure.axes[-1]
    assert bar.get_ylabel() == rf"smallest $K_{{\max}}$ over all directions{others}  in kN/m"
    plt.close(figure)


def test_pose_without_motion_along_a_direction_is_a_note(tmp_path, capsys):
    file = write_config(tmp_path, "{elbow: [0 deg, 90 deg]}", "directions: [x]")
    assert run_main("run", file, "--out", tmp_path / "out") == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "no K_max in 1 of 2 cases, the first at elbow 0 deg along x" in output
    (notes,) = [study["notes"] for study in json.loads((tmp_path / "out" / "run.json").read_text())["studies"]]
    assert notes[0].startswith("elbow 0 deg along x: no K_max; direction: no joint moves the point along it")
    assert "stable in 1 of 1 poses and directions" in output
    assert not (tmp_path / "out" / "w.png").exists(), "a single joint has no figure over two coordinates"


def test_rotation_has_rotary_units(tmp_path, capsys):
    file = write_config(tmp_path, "{elbow: 90 deg, slide: [0, 20 mm]}", "directions: [z], rotary: true")
    assert run_main("run", file, "--out", tmp_path / "out") == 0
    assert "N m/rad at elbow 90 deg, slide 0 m along z" in " ".join(capsys.readouterr().out.split())


def test_configuration_is_stored_with_its_units(tmp_path, monkeypatch):
    config = load_config(write_config(tmp_path, "{elbow: [30 deg, 60 deg], slide: [10 mm, 0.02 m], shoulder: 0.5}"))
    monkeypatch.chdir(tmp_path)
    dump = config.model_dump(mode="json", exclude_none=True)
    assert dump["studies"][0]["arm"]["joints"]["slide"] == ["0.01 m", "0.02 m"]
    assert Config.model_validate(dump).model_dump(mode="json", exclude_none=True) == dump


@pytest.mark.parametrize(
    ("given", "field", "message"),
    [
        ({"joints": "{elbw: 30 deg}"}, "arm.joints.elbw", "did you mean 'elbow'"),
        ({"joints": "{elbow: 30 mm}"}, "arm.joints.elbow", "it must be deg or rad"),
        ({"joints": "{slide: 30 deg}"}, "arm.joints.slide", "it must be m or mm"),
        ({"joints": "{elbow: 30 kg}"}, "arm.joints.elbow", "kg"),
        ({"joints": "{elbow: [30 deg, 30 deg]}"}, "arm.joints.elbow", "twice"),
        ({"joints": "[30 deg]"}, "arm.joints", "a mapping of names to positions"),
        ({"more": "directions: [u]"}, "arm.directions", "a list of x, y, z and vectors"),
        ({"more": "directions: x"}, "arm.directions", "a list of x, y, z and vectors"),
        ({"more": "directions: [[0, 0, 0]]"}, "arm.directions", "a list of x, y, z and vectors"),
        ({"more": "directions: [[1, 2]]"}, "arm.directions", "a list of x, y, z and vectors"),
        ({"study": "period: 1 ms, delay: 0 s, poses: {csv: a.csv, across: a, up: b}"}, "", "poses and arm are both"),
    ],
)
def test_invalid_arms_raise_at_their_location(given, field, message, tmp_path):
    with pytest.raises(ConfigError) as error:
        load_config(write_config(tmp_path, **given))
    assert f"studies[0]{'.' * bool(field)}{field}" in str(error.value)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        ("site: handle", "arm.site", "did you mean 'handle'"),
        ("model: arm.xml", "arm.model", "not a file"),
    ],
)
def test_unknown_sites_and_files_raise(change, field, message, tmp_path):
    file = write_config(tmp_path)
    key, value = change.split(": ")
    file.write_text(file.read_text().replace(change, f"{key}: {value[:2]}{value[3:]}"))
    with pytest.raises(ConfigError, match=rf"studies\[0\].{field}") as error:
        load_config(file)
    assert message in str(error.value)


@pytest.mark.parametrize(
    "pose",
    [
        {"elbow": "60 deg", "slide": "1 cm", "shoulder": 0.5},
        ["0.5", "60 deg", "10 mm"],
        ["0.5 rad", "60 deg", "0.01"],
        np.array([0.5, np.pi / 3, 0.01]),
    ],
)
def test_poses_accept_units_and_names(pose):
    model = mujoco.MjModel.from_xml_string(MODEL)
    expected = zwidth.from_mujoco(model, "handle", [1, 1, 0], pose=[0.5, np.pi / 3, 0.01])
    device = zwidth.from_mujoco(model, "handle", [1, 1, 0], pose=pose)
    top, other = (zwidth.Scene(each, TIMING).max_stiffness().stiffness for each in (device, expected))
    assert top == pytest.approx(other, rel=1e-12)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ({"elbw": 0}, "pose: got 'elbw'"),
        ({"elbow": "60 mm"}, "pose.elbow: got '60 mm'"),
        (["0", "60 kg", "0"], "pose.elbow: got '60 kg'"),
        (["0", "60 deg"], "3 joint positions"),
    ],
)
def test_invalid_poses_raise(pose, message):
    with pytest.raises(zwidth.InputError, match=message):
        zwidth.from_mujoco(mujoco.MjModel.from_xml_string(MODEL), "handle", "x", pose=pose)
