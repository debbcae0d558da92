"""Shell completion as described in docs/shell-completion.md: scripts are generated, and commands completed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import LONGEST

PAGE = Path(__file__).resolve().parents[3] / "docs" / "shell-completion.md"


def run_zwidth(**variables):
    command = [sys.executable, "-m", "zwidth"]
    result = subprocess.run(
        command, env={**os.environ, **variables}, capture_output=True, text=True, check=False, timeout=LONGEST
    )
    return result.stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_is_generated_as_documented(shell):
    assert f"`_ZWIDTH_COMPLETE={shell}_source zwidth > " in PAGE.read_text(encoding="utf-8")
    script = run_zwidth(_ZWIDTH_COMPLETE=f"{shell}_source")
    assert f"_ZWIDTH_COMPLETE={shell}_complete" in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, text=True, check=True, timeout=LONGEST)


@pytest.mark.parametrize(
    "arguments, index, expected",
    [
        ("zwidth ver", 1, ["plain,verify"]),
        ("zwidth figures --ov", 2, []),
        ("zwidth run --dry", 2, ["plain,--dry-run"]),
        ("zwidth init quick", 2, ["plain,quickstart"]),
        ("zwidth init --example tele", 3, ["plain,teleoperation"]),
    ],
)
def test_commands_options_and_examples_are_completed(arguments, index, expected):
    output = run_zwidth(_ZWIDTH_COMPLETE="bash_complete", COMP_WORDS=arguments, COMP_CWORD=str(index))
    assert output.split() == expected
