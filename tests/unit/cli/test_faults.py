"""Errors of all commands on a terminal: one line each, in one style."""

from __future__ import annotations

import pytest

from zwidth.cli import main

SCENE = ["--mass", "100 g", "--rate", "1 kHz"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["chek"], "Error: No such command 'chek'. (Did you mean one of: 'check', 'schema'?); see zwidth --help"),
        (["check", *SCENE], "Error: give --stiffness; see zwidth check --help"),
        (
            ["check", "--inertia", "3"],
            "Error: No such option '--inertia'; write --mass '1e-4 kg m^2'; see zwidth check --help",
        ),
        (["check", "--dead-time", "3"], "Error: No such option '--dead-time'; write --delay; see zwidth check --help"),
        (
            ["admittance", "--robot-bandwidth", "3"],
            "Error: No such option '--robot-bandwidth'; write --robot-cutoff; see",
        ),
        (["check", "--stiffness", "1 kN/m"], "Error: give --mass or --device, and --rate or --period; see zwidth"),
        (["check", *SCENE, "--stiffness", "1 kN"], "Error: --stiffness: got '1 kN'; "),
        (["run", "nowhere.yaml"], "Error: nowhere.yaml: no such file; check the path"),
        (["report", "nowhere"], "Error: nowhere: contains no run"),
    ],
)
def test_error_is_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert line.startswith(message)
    assert out == ""
