"""Output on terminals: lines folded at the terminal width, unfolded without a terminal, colors only if supported."""

import os

import pytest
from sweeping import run_main

from zwidth.app.printing import format_row, print_lines
from zwidth.cli.commands import cli

LINES = [
    format_row("margins", "gain 12.19, phase 16.73 degrees at 17.7 Hz"),
    format_row("", "delay 2.623 ms, modulus 0.2901"),
]


@pytest.mark.parametrize(
    "width, expected",
    [
        (None, LINES),
        (200, LINES),
        (
            60,
            [
                "margins               gain 12.19, phase 16.73 degrees at",
                "                        17.7 Hz",
                "                      delay 2.623 ms, modulus 0.2901",
            ],
        ),
        (40, ["margins  gain 12.19, phase 16.73 degrees", "    at 17.7 Hz", "  delay 2.623 ms, modulus 0.2901"]),
    ],
)
def test_lines_are_folded_at_the_terminal_width(width, expected, monkeypatch, capsys):
    monkeypatch.setattr("shutil.get_terminal_size", lambda whole: os.terminal_size((width or whole[0], 24)))
    print_lines(LINES)
    assert capsys.readouterr().out.splitlines() == expected


@pytest.mark.parametrize("name, value", [("TERM", "dumb"), ("NO_COLOR", "1")])
def test_colors_are_disabled_by_environment(name, value, monkeypatch):
    passed = {}
    monkeypatch.setattr(cli, "main", lambda **options: passed.update(options))
    monkeypatch.setenv(name, value)
    run_main("devices")
    assert passed["color"] is False
