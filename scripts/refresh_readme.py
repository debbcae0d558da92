#!/usr/bin/env python3
"""Update the command output in README.md by running its commands.

In every ``console`` block, each line that starts with ``$ zwidth`` or ``$ cat`` is run in the project root and followed
by its output. ``--check`` changes nothing and fails if README.md is out of date.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shlex
import subprocess
from pathlib import Path

from click.testing import CliRunner

from zwidth.cli import cli

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
_BLOCK = re.compile(r"^```console\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def output_of(command: str) -> str:
    """Return the output of a command without colors."""
    words = shlex.split(command)
    if words[0] == "cat":
        return "".join(Path(name).read_text(encoding="utf-8") for name in words[1:])
    if words[0] != "zwidth":
        raise SystemExit(f"{command!r} is neither zwidth nor cat")
    # Run in this process, which avoids importing everything again.
    done = CliRunner(env={"NO_COLOR": "1", "COLUMNS": "100"}).invoke(cli, words[1:], prog_name="zwidth")
    if done.exit_code:
        raise subprocess.CalledProcessError(done.exit_code, command, done.output) from done.exception
    return done.stdout


def show_commands(block: str) -> str:
    """Run the commands of a console block in the current folder and return them with their output."""
    commands = [line[2:] for line in block.splitlines() if line.startswith("$ ")]
    return "\n".join(f"$ {command}\n{output_of(command).rstrip()}\n" for command in commands)


def refreshed(text: str) -> str:
    """Return the text with current output of all commands in its console blocks."""
    with contextlib.chdir(ROOT):
        return _BLOCK.sub(lambda block: f"```console\n{show_commands(block.group(1))}```", text)


def main() -> None:
    """Update or check README.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--check", action="store_true", help="change nothing; fail where README.md is out of date")
    check = parser.parse_args().check
    old = README.read_text(encoding="utf-8")
    new = refreshed(old)
    if check and new != old:
        raise SystemExit("README.md is out of date: run scripts/refresh_readme.py")
    README.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
