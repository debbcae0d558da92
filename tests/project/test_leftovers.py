"""What the check at the end of each file of tests sees."""

import socket
import subprocess
import sys
import threading

from leftovers import what_is_open
from waiting import wait_for


def test_a_socket_is_seen_until_it_is_closed():
    before = what_is_open()
    with socket.create_server(("127.0.0.1", 0)):
        assert what_is_open().beyond(before) == "1 sockets"
    assert what_is_open().beyond(before) == ""


def test_a_thread_is_seen_until_it_ends():
    before, end = what_is_open(), threading.Event()
    thread = threading.Thread(target=end.wait, name="waits", daemon=True)
    thread.start()
    assert what_is_open().beyond(before).startswith("thread waits, ")
    end.set()
    thread.join()
    assert what_is_open().beyond(before) == ""


def test_a_process_is_seen_when_its_parent_has_been_killed():
    before = what_is_open()
    child = "import sys; print(1, flush=True); sys.stdin.read()"
    parent = f"import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', {child!r}]); time.sleep(600)"
    with subprocess.Popen(
        [sys.executable, "-c", parent], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "1\n"
        assert what_is_open().beyond(before).count("process ") == 2
        process.kill()
        process.wait()
        assert what_is_open().beyond(before).count("process ") == 1
    # Its input ends with the pipe.
    wait_for(lambda: not what_is_open().beyond(before))
