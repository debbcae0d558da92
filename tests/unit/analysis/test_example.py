"""The example script and configs/design.yaml do what they promise."""

import re
import runpy
from pathlib import Path

import pytest

import zwidth
from zwidth import max_stiffness

ROOT = Path(__file__).resolve().parents[3]


def test_the_example_reaches_the_wanted_stiffness(capsys):
    runpy.run_path(str(ROOT / "scripts" / "example_design.py"), run_name="__main__")
    said = capsys.readouterr().out
    rows = re.findall(r"b = ([\d.]+) N s/m, rate = ([\d.]+) Hz: K_max = ([\d.]+) kN/m, price ([\d.]+)", said)
    damping, rate, stiffness, price = (float(value) for value in rows[0])
    assert stiffness == pytest.approx(20.0, abs=1e-3)
    assert max_stiffness(mass=0.1, damping=damping, period=1 / rate, delay=1 / rate) == pytest.approx(20e3, rel=1e-3)
    # Both optimizers answer the same question from its two sides.
    for row in rows[1:]:
        assert float(row[2]) == pytest.approx(stiffness, abs=2e-2)
        assert float(row[3]) == pytest.approx(price, rel=1e-4)


def test_the_configuration_is_read():
    config = zwidth.load_config(ROOT / "configs" / "design.yaml")
    assert [study.name for study in config.studies] == [
        "what_damping_buys",
        "strong_damping",
        "what_each_change_buys",
        "walls",
        "recommended",
    ]
