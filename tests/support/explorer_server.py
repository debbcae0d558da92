"""`zwidth explore` as a separate process, and helpers for its page."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from typing import Any

import pytest
from waiting import LONGEST, wait_for


class Server:
    """A running `zwidth explore`."""

    def __init__(self, folder, *arguments):
        command = [sys.executable, "-m", "zwidth", "explore", "--no-browser", *arguments]
        self.process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        out: Any = self.process.stdout
        line = out.readline()
        if not line.startswith("http://127.0.0.1:"):
            self.process.kill()
            pytest.fail(f"{line}{self.process.communicate()}")
        self.said = ()
        self.address = line.split()[0]
        self.host = self.address.split("/")[2]

    def end(self):
        """End the process; return its stdout, stderr and exit code."""
        if self.said:
            return self.said
        self.process.send_signal(signal.SIGINT)
        try:
            self.said = (*self.process.communicate(timeout=LONGEST), self.process.returncode)
            return self.said
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            raise

    def get(self, path="", **headers):
        request = urllib.request.Request(f"{self.address}{path}", headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=LONGEST) as response:
                return response.status, response.headers, response.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.headers, error.read().decode()


@contextlib.contextmanager
def serve(folder):
    """Yield a server and check that it stops cleanly without leaving files."""
    server = Server(folder)
    yield server
    assert server.end() == ("stopped\n", "", 0)
    assert list(folder.iterdir()) == []


SETTLED = (
    "inputs !== null && !scheduled && !rests && Object.keys(waiting).length === 0 && answered === serial"
    " && !document.body.classList.contains('busy') && location.hash !== ''"
)


def settle(page, condition="true"):
    wait_for(lambda: page.evaluate(f"{SETTLED} && ({condition})"), lambda: f"{condition}; {page.inner_text('header')}")


def enter(page, name, text):
    page.fill(f"[id='{name}']", text)
    page.press(f"[id='{name}']", "Enter")
    settle(page)


def value_of(page, name):
    return float(page.input_value(f"[id='{name}']"))
