"""Garbage collection is disabled at exit of a command."""

import subprocess
import sys


def test_command_collects_no_garbage_at_exit():
    text = (
        "import atexit, gc, sys\n"
        "atexit.register(lambda: print(len(gc.get_objects()) < 1000, gc.get_freeze_count() > 10_000))\n"
        "from zwidth.__main__ import main\n"
        "sys.argv = ['zwidth', '--version']\n"
        "main()\n"
    )
    result = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "True True"
