"""`zwidth explore`: messages if the explorer cannot start."""

from __future__ import annotations

import socket
import sys

import pytest
from click.testing import CliRunner

from zwidth.cli.commands import cli
from zwidth.core.errors import ConfigError, InputError


def test_missing_bokeh_raises_with_the_install_command(monkeypatch):
    monkeypatch.delitem(sys.modules, "zwidth.app.explorer.server", raising=False)
    monkeypatch.delitem(sys.modules, "zwidth.app.explorer.page", raising=False)
    for name in [name for name in sys.modules if name.partition(".")[0] == "bokeh"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "bokeh", None)
    result = CliRunner().invoke(cli, ["explore", "--no-browser"])
    assert isinstance(result.exception, InputError)
    assert str(result.exception).endswith(("pip install 'zwidth[explore]'", "scripts/setup explore"))


def test_port_in_use_raises():
    pytest.importorskip("bokeh", reason="zwidth[explore] is not installed")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        result = CliRunner().invoke(cli, ["explore", "--no-browser", "--port", str(taken.getsockname()[1])])
    assert isinstance(result.exception, InputError)
    assert "choose another" in str(result.exception)


def test_missing_file_raises():
    result = CliRunner().invoke(cli, ["explore", "--no-browser", "nowhere.yaml"])
    assert isinstance(result.exception, ConfigError)
    assert "nowhere.yaml: no such file; check the path" in str(result.exception)
