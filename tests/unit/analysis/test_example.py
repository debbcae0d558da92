"""Test scripts/example_design.py (two optimizers, against `max_stiffness` and each other) and configs/design.yaml."""

import re
import runpy
from pathlib import Path

import pytest

import zwidth
from zwidth import max_stiffness

ROOT = Path(__file__).resolve().parents[3]


def test_example_design_reaches_target_stiffness(capsys):
    runpy.run_path(str(ROOT / "scripts" / "example_design.py"), run_name="__main__")
    output = capsys.readouterr().out
    rows = re.findall(r"b = ([\d.]+) N s/m, rate = ([\d.]+) Hz: K_max = ([\d.]+) kN/m, price ([\d.]+)", output)
    damping, rate, stiffness, price = (float(value) for value in rows[0])
    assert stiffness == pytest.approx(20.0, abs=1e-3)
    assert max_stiffness(mass=0.1, damping=damping, period=1 / rate, delay=1 / rate) == pytest.approx(20e3, rel=1e-3)
    # Both optimizers solve the same problem: one minimizes the price, the other maximizes the stiffness.
    for row in rows[1:]:
        assert float(row[2]) == pytest.approx(stiffness, abs=2e-2)
        assert float(row[3]) == pytest.approx(price, rel=1e-4)


def test_design_configuration_lists_its_studies():
    config = zwidth.load_config(ROOT / "configs" / "design.yaml")
    assert [study.name for study in config.studies] == [
        "what_damping_buys",
        "strong_damping",
        "what_each_change_buys",
        "walls",
        "recommended",
    ]
