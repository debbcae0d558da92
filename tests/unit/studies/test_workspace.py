"""The workspace study: K_max of every pose and a wall checked in all poses, against single scenes."""

from typing import Any

import numpy as np
import pytest
from sweeping import run_main

import zwidth
from zwidth.core.errors import ConfigError
from zwidth.studies.document import load_config
from zwidth.studies.ridge import WorkspaceStudy

pytestmark = pytest.mark.usefixtures("unpainted")

POSES = (
    "shoulder [deg],elbow [deg],mass [g],damping [N s/m]\n0,30,240,1.6\n60,30,60,0.13\n0,90,150,1.2\n60,90,0.1 kg,1\n"
)
STUDY = "{kind: workspace, name: w, poses: {csv: arm.csv, across: shoulder, up: elbow}, period: 1 ms, delay: 1 periods}"


def write_config(folder, study=STUDY, poses=POSES, scene=""):
    (folder / "arm.csv").write_text(poses, encoding="utf-8")
    file = folder / "w.yaml"
    file.write_text(f"version: 1\nname: w\n{scene}studies:\n  - {study}\n", encoding="utf-8")
    return file


def test_every_pose_agrees_with_its_scene(tmp_path, capsys):
    assert run_main("run", write_config(tmp_path), "--out", tmp_path / "out") == 0
    output = capsys.readouterr().out
    table = np.genfromtxt(tmp_path / "out" / "w.csv", delimiter=",", names=True)
    assert table.dtype.names is not None
    assert table.dtype.names[:3] == ("shoulder_deg", "elbow_deg", "mass_kg")
    for row in table:
        # Solve a separate scene per pose.
        device = zwidth.Device(row["mass_kg"], row["damping_N_s_per_m"])
        top = zwidth.Scene(device, zwidth.Timing(1e-3, "1 periods")).max_stiffness()
        assert row["stiffness_N_per_m"] == pytest.approx(float(top.stiffness), rel=1e-12)
        assert row["virtual_damping_N_s_per_m"] == pytest.approx(float(top.virtual_damping), rel=1e-9)
    assert "at shoulder 60 deg, elbow 30 deg" in output
    assert "stable in 4 of 4 poses" in output


def test_table_of_inertias_is_rotary(tmp_path, capsys):
    poses = "shoulder [deg],elbow [deg],mass [g cm^2],damping [mN m s/rad]\n0,30,77,0.02\n60,30,60,0.03\n"
    assert run_main("run", write_config(tmp_path, poses=poses), "--out", tmp_path / "out") == 0
    device = zwidth.Device("60 g cm^2", "0.03 mN m s/rad")
    top = zwidth.Scene(device, zwidth.Timing("1 ms", "1 periods")).max_stiffness()
    output = " ".join(capsys.readouterr().out.split())
    assert f"K_max from {1e3 * top.stiffness - 0.05:.1f} mN m/rad at shoulder 60 deg" in output
    table = np.genfromtxt(tmp_path / "out" / "w.csv", delimiter=",", names=True)
    assert table["stiffness_N_m_per_rad"].min() == pytest.approx(float(top.stiffness), rel=1e-12)


@pytest.mark.parametrize("scene", ["", "scene: {mass: 1, period: 3 ms}\n"])
def test_rate_overrides_the_period_of_the_scene(scene, tmp_path):
    (study,) = load_config(write_config(tmp_path, STUDY.replace("period: 1 ms", "rate: 1 kHz"), scene=scene)).studies
    assert isinstance(study, WorkspaceStudy)
    assert study.period == 1e-3
    with pytest.raises(ConfigError, match=r"studies\[0\].rate: period and rate are both given"):
        load_config(write_config(tmp_path, STUDY.replace("delay:", "rate: 1 kHz, delay:")))


def test_recommended_wall_is_checked_in_every_pose(tmp_path, capsys):
    # The damping that suits the heavy, weakest pose is too large for the light, damped one.
    poses = "a,b,mass [g],damping [N s/m]\n0,0,100,0\n1,0,10,25\n"
    study = STUDY.replace("shoulder", "a").replace("elbow", "b")
    assert run_main("run", write_config(tmp_path, study, poses), "--out", tmp_path / "out") == 0
    stiffness, damping = 0.75 * np.array(
        zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3, 1e-3)).max_stiffness()[:2]
    )
    is_stable = [
        bool(zwidth.Scene(device, zwidth.Timing(1e-3, 1e-3)).is_stable(stiffness, damping / 0.75))
        for device in (zwidth.Device(0.1), zwidth.Device(0.01, 25.0))
    ]
    assert f"stable in {sum(is_stable)} of 2 poses" in capsys.readouterr().out
    assert is_stable == [True, False]


def test_recommended_stiffness_is_rounded_down(tmp_path, capsys):
    """Three quarters of the K_max of the weakest pose are 75.057 kN/m."""
    top = zwidth.Scene(zwidth.Device(0.1, 1.0), zwidth.Timing(1e-3)).max_stiffness()
    scale = 75_057.0 / (0.75 * float(top.stiffness))
    poses = f"a,b,mass,damping\n0,0,{0.1 * scale!r},{scale!r}\n1,0,{0.2 * scale!r},{2 * scale!r}\n"
    study = STUDY.replace("shoulder", "a").replace("elbow", "b").replace("1 periods", "0 s")
    assert run_main("run", write_config(tmp_path, study, poses), "--out", tmp_path / "out") == 0
    assert "K = 75.05 kN/m, " in capsys.readouterr().out


def test_scene_supplies_period_and_delay(tmp_path):
    scene = "scene: {mass: 1 kg, period: 2 ms, delay: 1 ms}\n"
    study: Any
    (study,) = load_config(write_config(tmp_path, STUDY.partition(", period")[0] + "}", scene=scene)).studies
    assert (study.period, study.delay.value, study.delay.unit) == (2e-3, 1e-3, "s")


@pytest.mark.parametrize(
    "change, message",
    [
        (
            ("shoulder, up", "sholder, up"),  # codespell:ignore
            "across: got 'sholder'; it must be a column of the file; did you mean 'shoulder'",
        ),
        ((", up: elbow", ""), r"write {csv: arm.csv, across: shoulder, up: elbow}"),
        (("arm.csv", "leg.csv"), "leg.csv"),
        (
            ("up: elbow", "up: shoulder"),
            "up: got 'shoulder', equal to across; the coordinates must differ; name another column",
        ),
    ],
)
def test_invalid_poses_raise(change, message, tmp_path):
    with pytest.raises(ConfigError) as error:
        load_config(write_config(tmp_path, STUDY.replace(*change)))
    assert message in str(error.value)
    assert "studies[0].poses" in str(error.value)


def test_axes_have_names_and_units_of_the_file(tmp_path):
    poses = POSES.replace("shoulder [deg]", "elbow_angle")
    config = load_config(
        write_config(tmp_path, STUDY.replace("shoulder, up: elbow", "elbow_angle, up: damping"), poses)
    )
    study: Any = config.studies[0]
    (ax,) = study.compute(None, True).figures[""]()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("elbow_angle", "damping  in N s/m")


@pytest.mark.parametrize(
    "poses, message",
    [
        (POSES.replace("mass [g]", "weight"), "give mass and damping"),
        (POSES.replace("0,90", "x,90"), "'x'"),
        (POSES.splitlines()[0] + "\n0,30,240,1.6\n", "at least two are needed"),
    ],
)
def test_invalid_pose_files_raise(poses, message, tmp_path):
    with pytest.raises(ConfigError) as error:
        load_config(write_config(tmp_path, poses=poses))
    assert message in str(error.value)


def test_pose_without_maximum_is_reported_and_does_not_affect_others(tmp_path, capsys):
    table = {}
    for name, poses in (("complete", POSES), ("incomplete", POSES.replace("0,90,150,1.2", "0,90,1e-20,1e5"))):
        folder = tmp_path / name
        folder.mkdir()
        assert run_main("run", write_config(folder, poses=poses), "--out", folder / "out") == 0
        table[name] = np.genfromtxt(folder / "out" / "w.csv", delimiter=",", names=True)["stiffness_N_per_m"]
    output = capsys.readouterr()
    assert np.isnan(table["incomplete"]).tolist() == [False, False, True, False]
    np.testing.assert_array_equal(np.delete(table["incomplete"], 2), np.delete(table["complete"], 2))
    assert "stable in 3 of 3 poses" in output.out
    message = (
        "shoulder 0 deg, elbow 90 deg: mass 1.000e-11 ng and damping 100.0 kN s/m (delta = 1.000e+25) have no K_max"
    )
    assert message in output.err
    assert "Correct this pose in arm.csv" in output.err


def test_workspace_without_any_maximum_raises(tmp_path, capsys):
    poses = POSES.splitlines()[0] + "\n0,30,1e-20,1e5\n60,30,1e-20,1e6\n"
    assert run_main("run", write_config(tmp_path, poses=poses), "--out", tmp_path / "out") == 1
    assert "no pose of arm.csv has a K_max; first pose: shoulder 0 deg, elbow 30 deg" in capsys.readouterr().err
