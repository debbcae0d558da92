"""README.md shows actual output of the commands and examples."""

from __future__ import annotations

import doctest
import importlib.util
from pathlib import Path

from click.testing import CliRunner

from zwidth.cli import cli

ROOT = Path(__file__).resolve().parents[2]


def test_console_blocks_show_the_output_of_their_commands():
    spec = importlib.util.spec_from_file_location("refresh_readme", ROOT / "scripts" / "refresh_readme.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count("```console") >= 3
    assert module.refreshed(text) == text


def test_python_examples_run_as_shown():
    result = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert result.attempted >= 5
    assert result.failed == 0


def test_example_of_a_scene_file_is_one(tmp_path):
    file = tmp_path / "my-device.yaml"
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    file.write_text(text.partition("```yaml\n")[2].partition("```")[0], encoding="utf-8")
    result = CliRunner().invoke(cli, ["recommend", str(file)])
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("SET ")
