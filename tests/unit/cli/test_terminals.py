"""What terminals get: lines as wide as they are, whole without one, and colors where there are any."""

import os

import pytest
from sweeping import main_of

from zwidth.app.printing import format_row, print_lines
from zwidth.cli.commands import cli

LINES = [
    format_row("margins", "gain 12.19, phase 16.73 degrees at 17.7 Hz"),
    format_row("", "delay 2.623 ms, modulus 0.2901"),
]


@pytest.mark.parametrize(
    "width, says",
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
def test_lines_are_folded_at_the_width_and_a_narrow_terminal_keeps_no_column_for_labels(
    width, says, monkeypatch, capsys
):
    monkeypatch.setattr("shutil.get_terminal_size", lambda whole: os.terminal_size((width or whole[0], 24)))
    print_lines(LINES)
    assert capsys.readouterr().out.splitlines() == says


@pytest.mark.parametrize("name, value", [("TERM", "dumb"), ("NO_COLOR", "1")])
def test_who_wants_no_colors_gets_none(name, value, monkeypatch):
    asked = {}
    monkeypatch.setattr(cli, "main", lambda **options: asked.update(options))
    monkeypatch.setenv(name, value)
    main_of("devices")
    assert asked["color"] is False
