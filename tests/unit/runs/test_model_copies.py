"""Copies of MuJoCo models in the folder of a run, which do not depend on the files of the user."""

import shutil

import pytest
from sweeping import run_main

import zwidth

pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
pytestmark = pytest.mark.usefixtures("unpainted")

RAIL = '<body><joint name="rail" type="slide" axis="1 0 0" damping="3"/>{geom}<site name="tip"/></body>'
SPHERE = '<geom size=".02" mass=".5"/>'
MESH = '<geom type="mesh" mesh="wedge" mass=".5"/>'
WEDGE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
SCENE = "device: {model: arm.xml, site: tip, direction: x}, rate: 1 kHz, delay: 1 ms"


@pytest.mark.parametrize(
    ("world", "more", "copy"),
    [
        (RAIL.format(geom=SPHERE), "", "arm.xml"),
        (RAIL.format(geom=MESH), '<asset><mesh name="wedge" file="wedge.obj"/></asset>', "arm.mjb"),
        ('<include file="part.xml"/>', "", "arm.mjb"),
    ],
    ids=["one file", "mesh", "include"],
)
def test_run_reproduces_without_the_files_of_the_user(tmp_path, world, more, copy):
    folder = tmp_path / "given"
    folder.mkdir()
    (folder / "arm.xml").write_text(f"<mujoco>{more}<worldbody>{world}</worldbody></mujoco>", encoding="utf-8")
    (folder / "wedge.obj").write_text(WEDGE, encoding="utf-8")
    (folder / "part.xml").write_text(f"<mujocoinclude>{RAIL.format(geom=SPHERE)}</mujocoinclude>", encoding="utf-8")
    config = folder / "a.yaml"
    config.write_text(f"{{version: 1, name: a, scene: {{{SCENE}}}, studies: [{{kind: boundary, name: b}}]}}")
    assert run_main("run", config, "--out", tmp_path / "out") == 0
    assert zwidth.run(config, out=tmp_path / "out", resume=True).studies[0].state == "kept"
    shutil.rmtree(folder)
    assert [file.name for file in (tmp_path / "out" / "inputs").iterdir()] == [copy]
    device = zwidth.load_scene(tmp_path / "out" / "config.yaml").device
    assert (device.mass, device.damping) == pytest.approx((0.5, 3.0), rel=1e-14)
