"""`zwidth excite` and `zwidth respond`, from the file to play to the safe wall."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from measured_devices import TrueDevice

import zwidth
from zwidth.cli import cli

DEVICE = TrueDevice("one resonance", 0.1, 3.0, 3e-4, ((140.0, 0.02, 0.6),), 0.7e-3, 1e-3, 1e-5, 3.0)
LOOP = ["--period", "1 ms", "--force", "3 N", "--resolution", "10 um", "--duration", "30 s"]


def call(*arguments):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def write_log(played, log):
    time, force = np.genfromtxt(played, delimiter=",", skip_header=1).T
    counts = np.round(DEVICE.play(force) / DEVICE.encoder)
    rows = [f"{1e3 * t:.6g},{count:.0f},{f:.7g}" for t, count, f in zip(time, counts, force, strict=True)]
    log.write_text("\n".join(["time [ms],encoder [counts],force [N]", *rows]))


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The log of the first record, its response, and what was said."""
    folder = tmp_path_factory.mktemp("measured")
    said = call("excite", *LOOP, "--out", folder / "play.csv")
    assert "664" in said or "lines" in said
    write_log(folder / "play.csv", folder / "log.csv")
    options = ["--position", "encoder [counts]", "--resolution", "10um"]
    said = call("respond", folder / "log.csv", *options, "--save", folder / "r.csv", "--figure", folder / "r.png")
    return folder, said


def test_a_log_tells_a_safe_wall_and_what_a_stiffer_one_needs(first):
    folder, said = first
    lines = dict(line.split("  ", 1) for line in said.splitlines() if line[0] != " ")
    assert {"response of", "lines", "deviation", "K_max", "safe wall", "wrote"} <= lines.keys()
    assert "stable for every response in the band" in lines["safe wall"]
    assert "measure anew from" in said
    assert (folder / "r.png").stat().st_size > 10_000


def test_the_second_record_is_made_from_the_first_and_tells_what_it_promised(first):
    folder, _ = first
    made = json.loads(call("excite", *LOOP, "--response", folder / "r.csv", "--out", folder / "p2.csv", "--json"))
    write_log(folder / "p2.csv", folder / "log2.csv")
    found = json.loads(
        call("respond", folder / "log2.csv", "--position", "encoder [counts]", "--resolution", "10um", "--json")
    )
    safe = found["safe_wall"]
    assert safe["stiffness"] == pytest.approx(made["expected"]["stiffness"], rel=0.05)
    assert DEVICE.is_stable(safe["stiffness"], safe["virtual_damping"])
    assert safe["stiffness"] < found["maximum"]["stiffness"]


def test_the_table_that_was_kept_gives_the_same_wall(first):
    folder, said = first
    again = call("respond", folder / "r.csv", "--table", "--period", "1 ms")
    same = [next(line for line in text.splitlines() if line.startswith("safe wall")) for text in (said, again)]
    assert same[0] == same[1]
    device = zwidth.MeasuredDevice.read(folder / "r.csv")
    top = zwidth.Scene(device, zwidth.Timing(1e-3)).max_stiffness()
    assert f"{top.stiffness / 1e3:.3f}" in same[1] or f"{top.stiffness / 1e3:.2f}" in same[1]


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["respond", "no.csv"], "no such file"),
        (["respond", "r.csv", "--table"], "--period"),
        (["excite", *LOOP[:-1], "1 s"], "too short"),
        (["excite", *LOOP[2:]], "--period"),
    ],
)
def test_what_is_missing_is_said(arguments, said, tmp_path, monkeypatch, capsys):
    from zwidth.cli import main

    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert said in capsys.readouterr().err
