"""A scene component added as CONTRIBUTING.md describes is known to API, command line, configurations and explorer."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

MOUNT = '''"""A spring and a damper between the motor's side of the device and the ground."""

from dataclasses import dataclass
from typing import Any, ClassVar

from zwidth.model.checks import Part


@dataclass(frozen=True, repr=False)
class Mount(Part):
    """A spring and a damper between device and ground."""

    _owner = "mount"
    usual: ClassVar[dict[str, dict[str, float]]] = {"soft": {"stiffness": 100.0, "damping": 1.0}}

    stiffness: Any
    damping: Any = 0.0
'''
IMPORT = "from zwidth.model.mount import Mount\n"
# Per file: text to replace, and its replacement in the copy.
EDITS = {
    "units/quantities.py": {
        '    Parameter("stiffness", "stiffness K': (
            '    Parameter("mount.stiffness", "stiffness of the mount", "k_0", POSITIVE, "N/m", (1.0, 1e3)),\n'
            '    Parameter("mount.damping", "damping of the mount", "b_0", NOT_NEGATIVE, "N s/m", (0.0, 10.0)),\n'
            '    Parameter("stiffness", "stiffness K'
        )
    },
    "model/parameter_paths.py": {
        '"tool": Tool}': '"tool": Tool, "mount": Mount}',
        "from zwidth.model.operator": f"{IMPORT}from zwidth.model.operator",
    },
    "analysis/base.py": {
        "    operator: Operator | None = None\n": (
            "    operator: Operator | None = None\n    mount: Mount | None = None\n"
        ),
        '"zwidth.Operator(mass=0.5)"),\n': (
            '"zwidth.Operator(mass=0.5)"),\n    "mount": (Mount | None, "zwidth.Mount(stiffness=100)"),\n'
        ),
        "from zwidth.model.operator": f"{IMPORT}from zwidth.model.operator",
    },
    "model/mechanism.py": {
        "    links = []\n": (
            "    links = []\n"
            "    if (mount := scene.mount) is not None:\n"
            "        masses = [(device.mass, device.damping + mount.damping, mount.stiffness)]\n"
        )
    },
    "__init__.pyi": {
        "from .model.operator": "from .model.mount import Mount as Mount\nfrom .model.operator",
    },
}

CONFIGURATION = """
version: 1
name: mounted
scene: {mass: 100 g, damping: 10, period: 1 ms, mount: {stiffness: 0.135 N/mm, damping: 6}}
studies:
  - {kind: sweep, name: springs, axes: {mount.stiffness: [10, 1 kN/m], stiffness: [1e3, 50e3], virtual_damping: 5}}
"""

PROGRAM = """
import json, zwidth
from click.testing import CliRunner
from zwidth.cli import cli
from zwidth.app.explorer.controls import CHOICES, SLIDERS, Controls
from zwidth.app.explorer.controls import to_python, to_yaml
from zwidth.studies.document import config_json_schema

def say(*arguments):
    return CliRunner().invoke(cli, list(arguments)).output

def answer(scene):
    radius = [float(scene.spectral_radius(stiffness, 5.0)) for stiffness in (1e3, 50e3)]
    certified = [bool(scene.is_stable(stiffness, 5.0, method="certified")) for stiffness in (1e3, 50e3)]
    return [*radius, *certified, float(scene.max_stiffness().stiffness), scene.sensitivities().per["damping"]]

def refuse(function):
    try:
        function()
    except zwidth.ZwidthError as error:
        return str(error)

CHECK = ("check", "--mass", "0.1", "--damping", "10", "--period", "1e-3", "--stiffness", "1e3")
config = zwidth.load_config("mounted.yaml")
scene = config.scene.to_scene()
bare = scene.replace(mount=None)
assert zwidth.run("mounted.yaml", out="out").ok
store = zwidth.open_dataset("out/springs.zarr")
controls = Controls().change({"mount": "soft"}).change({"mount.stiffness": 50})
schema = config_json_schema()["$defs"]
print(json.dumps({
    "parameters": scene.parameters(),
    "answers": [answer(scene), answer(bare.replace(operator=zwidth.Operator(damping=6, stiffness=135)))],
    "slopes": sorted(scene.sensitivities().per),
    "help": say("check", "--help"),
    "checked": say(*CHECK, "--mount-stiffness", "135", "--mount-damping", "6"),
    "warned": say(*CHECK, "--mount-stiffness", "1e12"),
    "needed": say(*CHECK, "--mount-damping", "1"),
    "refused": [refuse(lambda: zwidth.Mount(stiffness=0)), refuse(lambda: scene.replace(mount=None).replace(mount=5))],
    "faults": refuse(lambda: zwidth.load_config("wrong.yaml")),
    "store": [list(store.stable.dims), store.mount_stiffness.attrs],
    "page": [SLIDERS["mount.stiffness"], CHOICES["mount"], controls.shown(), to_yaml(controls), to_python(controls)],
    "schema": [schema["MountSection"], "mount" in schema["PhysicalScene"]["properties"]],
}, default=float))
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Output of PROGRAM, run with a copy of the package to which the component was added."""
    folder = tmp_path_factory.mktemp("copy")
    package = folder / "zwidth"
    shutil.copytree(ROOT / "src" / "zwidth", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "model" / "mount.py").write_text(MOUNT, encoding="utf-8")
    for file, edits in EDITS.items():
        text = (package / file).read_text(encoding="utf-8")
        for old, new in edits.items():
            assert text.count(old) == 1, (file, old)
            text = text.replace(old, new)
        (package / file).write_text(text, encoding="utf-8")
    (folder / "mounted.yaml").write_text(CONFIGURATION, encoding="utf-8")
    invalid_config = CONFIGURATION.replace(
        "stiffness: 0.135 N/mm, damping: 6",
        "stiffness: 0, dampin: 6",  # codespell:ignore
    )
    (folder / "wrong.yaml").write_text(invalid_config, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr[-3000:]
    return json.loads(result.stdout)


def test_edited_files_are_those_named_in_the_guide():
    guide = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = guide[guide.index("**A part of a scene**") : guide.index("## Style")]
    named = set(re.findall(r"`([\w/]+\.pyi?)`", section))
    assert named == set(EDITS)
    # Six files together with the module of the component.
    assert len(EDITS) == 5


def test_scene_knows_and_checks_the_parameters(results):
    assert {name: value for name, value in results["parameters"].items() if "." in name} == {
        "mount.stiffness": 135.0,
        "mount.damping": 6.0,
    }
    assert {"mount.stiffness", "mount.damping"} <= set(results["slopes"])
    assert (
        results["refused"][0]
        == "mount.stiffness: got 0 N/m; it must be greater than 0 N/m; write a number in this range"
    )
    assert results["refused"][1].startswith("mount: got 5")


def test_results_equal_those_of_a_massless_operator(results):
    with_mount, with_operator = results["answers"]
    assert with_mount == pytest.approx(with_operator, rel=1e-9)
    assert with_mount[2:4] == [True, False]


def test_the_command_line_accepts_judges_and_warns_about_it(results):
    assert "Stiffness of the mount, in N/m." in results["help"]
    assert re.search(r"^mount +stiffness 135\.0 N/m, damping 6\.000 N s/m", results["checked"], re.MULTILINE)
    assert "--mount-stiffness is 1e+12 N/m, an implausible value" in results["warned"]
    assert "a mount requires a stiffness; give --mount-stiffness" in results["needed"]


def test_configuration_section_and_store_axis_exist(results):
    assert "scene.mount.stiffness: got 0 N/m; it must be greater than 0 N/m" in results["faults"]
    assert "a mount has the keys 'stiffness', 'damping'; did you mean 'damping'?" in results["faults"]
    dims, attributes = results["store"]
    assert "mount_stiffness" in dims
    assert attributes == {"long_name": "stiffness of the mount", "units": "N/m"}
    section, is_listed = results["schema"]
    assert is_listed
    assert section["required"] == ["stiffness"]
    assert section["properties"]["damping"]["description"].startswith("Damping of the mount, in N s/m or with a unit")


def test_explorer_has_its_sliders_and_exports_it(results):
    slider, choices, shown, yaml, python = results["page"]
    assert slider == ["stiffness of the mount k_0", "N/m", 1.0, 1.0, 1000.0, False]
    assert choices == {"none": "none", "soft": "soft"}
    assert (shown["mount"], shown["mount.stiffness"]) == ("soft", 50.0)
    assert "mount: {stiffness: 50 N/m, damping: 1 N s/m}" in yaml
    assert 'mount=zwidth.Mount(stiffness="50 N/m", damping="1 N s/m")' in python
