"""What a command says of itself and of a call that lacks something."""

import re
import shlex

import pytest
from click.testing import CliRunner

from zwidth.cli.commands import cli


def test_help_names_units_of_rotary_devices_and_walls_for_any_grasp():
    text = " ".join(help_of("recommend").split())
    assert "Largest force of the motor, in N (rotary: torque in N m)." in text
    assert "stable in any grasp" in text


def help_of(name: str) -> str:
    done = CliRunner().invoke(cli, [name, "--help"], terminal_width=80)
    assert done.exit_code == 0
    return done.stdout


@pytest.mark.parametrize("name", ["check", "recommend", "ridge", "design", "fit", "excite"])
def test_the_example_in_the_help_of_a_command_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    example = help_of(name).partition("Example:\n")[2].replace("\\\n", " ")
    words = shlex.split(example)
    assert words[:2] == ["zwidth", name]
    done = CliRunner().invoke(cli, words[1:])
    assert done.exit_code == 0, done.output
    assert "NO_BOUNDARY" not in done.output


@pytest.mark.parametrize("name", sorted(cli.commands))
def test_no_help_is_wider_than_a_terminal_or_has_the_unit_one(name):
    text = help_of(name)
    assert max(map(len, text.splitlines())) <= 80
    assert not re.search(r"in 1\b", text)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("check --stiffness 1 --mass 1", "give --rate or --period"),
        ("check --stiffness 1 --rate 1000", "give --mass or --device"),
        ("recommend --damping 1", "give --mass or --device, and --rate or --period"),
        ("ridge --delta 0.1 --d 1 --mass 1", "give either --delta and --d alone, or also --rate or --period"),
    ],
)
def test_what_is_missing_is_named(words, message):
    done = CliRunner().invoke(cli, words.split())
    assert done.exit_code == 2
    assert done.stderr.rstrip().endswith(f"Error: {message}")


def test_a_file_that_cannot_be_written_is_named_as_it_was_given(tmp_path):
    (tmp_path / "config.yaml").write_text(
        "version: 1\nname: first\nstudies:\n  - {kind: ridge, name: top, delta: [0, 1], d: 1}\n"
    )
    run = str(tmp_path / "run")
    assert CliRunner().invoke(cli, ["run", str(tmp_path / "config.yaml"), "--out", run]).exit_code == 0
    with pytest.raises(OSError, match="page") as caught:
        CliRunner().invoke(cli, ["report", run, "--out", "/proc/page.html"], catch_exceptions=False)
    assert caught.value.filename == "/proc/page.html"
