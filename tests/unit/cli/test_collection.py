"""Garbage of a command: looked for late for the first time, and not at its end."""

import gc
import subprocess
import sys

from zwidth.__main__ import put_off_collection


def test_the_first_collection_comes_late_and_all_others_as_before():
    usual, callbacks = gc.get_threshold(), list(gc.callbacks)
    put_off_collection()
    try:
        assert gc.get_threshold()[0] == 1_000_000
        gc.collect()
        assert gc.get_threshold() == usual
        assert gc.callbacks == callbacks
    finally:
        gc.set_threshold(*usual)


def test_a_command_that_ends_has_nothing_left_to_look_at():
    text = (
        "import atexit, gc, sys\n"
        "from zwidth.__main__ import main\n"
        "atexit.register(lambda: print(len(gc.get_objects()) < 1000, gc.get_freeze_count() > 10_000))\n"
        "sys.argv = ['zwidth', '--version']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "True True"
