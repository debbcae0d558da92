"""Help texts of commands, and messages for missing options."""

import re
import shlex

import pytest
from click.testing import CliRunner

from zwidth.cli.commands import cli


def test_help_mentions_rotary_units_and_grasps():
    text = " ".join(read_help("recommend").split())
    assert "Largest force of the motor, in N (rotary: torque in N m)." in text
    assert "stable in any grasp" in text


def read_help(name: str) -> str:
    result = CliRunner().invoke(cli, [name, "--help"], terminal_width=80)
    assert result.exit_code == 0
    return result.stdout


@pytest.mark.parametrize("name", ["check", "recommend", "ridge", "design", "fit", "excite"])
def test_example_in_the_help_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    example = read_help(name).partition("Example:\n")[2].replace("\\\n", " ")
    arguments = shlex.split(example)
    assert arguments[:2] == ["zwidth", name]
    result = CliRunner().invoke(cli, arguments[1:])
    assert result.exit_code == 0, result.output
    assert "NO_BOUNDARY" not in result.output


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_help_fits_80_columns_without_unit_one(name):
    text = read_help(name)
    assert max(map(len, text.splitlines())) <= 80
    assert not re.search(r"in 1\b", text)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("check --stiffness 1 --mass 1", "give --rate or --period"),
        ("check --stiffness 1 --rate 1000", "give --mass or --device"),
        ("recommend --damping 1", "give --mass or --device, and --rate or --period"),
        (
            "ridge --delta 0.1 --d 1 --mass 1",
            "give --rate or --period; for normalized parameters, give only --delta and --d",
        ),
    ],
)
def test_missing_options_are_named(command, message):
    result = CliRunner().invoke(cli, command.split())
    assert result.exit_code == 2
    assert result.stderr.rstrip().endswith(f"Error: {message}")


def test_unwritable_file_is_named_as_given(tmp_path):
    (tmp_path / "config.yaml").write_text(
        "version: 1\nname: first\nstudies:\n  - {kind: ridge, name: top, delta: [0, 1], d: 1}\n"
    )
    run = str(tmp_path / "run")
    assert CliRunner().invoke(cli, ["run", str(tmp_path / "config.yaml"), "--out", run]).exit_code == 0
    with pytest.raises(OSError, match="page") as caught:
        CliRunner().invoke(cli, ["report", run, "--out", "/proc/page.html"], catch_exceptions=False)
    assert caught.value.filename == "/proc/page.html"
