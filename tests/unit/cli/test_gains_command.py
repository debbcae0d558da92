"""Gains of motor controllers on the command line and in files, typed as a user types them."""

import json
import re

import pytest
from click.testing import CliRunner

from zwidth.cli.commands import cli

MOTOR = ["--mass", "1e-4 kg m^2", "--damping", "1e-4 N m s/rad", "--rate", "8 kHz", "--delay", "1.5 periods"]
PLL = ["--position-bandwidth", "1000"]
CASCADE = ["--feedback-gain", "0.0477465", "--feedback-rule", "forward"]
CASCADE += ["--feedback-position", "20", "--feedback-velocity", "1"]


def run(*arguments):
    result = CliRunner().invoke(cli, list(arguments))
    assert result.exit_code == 0, result.output
    return result.output


def test_recommend_prints_the_gains_of_a_cascade_in_turns():
    arguments = ["recommend", *MOTOR, *PLL, "--stiffness-fraction", "20%"]
    text = " ".join(run(*arguments, *CASCADE).split())
    gains = r" gains pos_gain [0-9.]+ 1/s, vel_gain [0-9.]+ N m/\(turn/s\), vel_integrator_gain 0.3000 N m/turn "
    assert re.search(gains, text)
    result = json.loads(run(*arguments, *CASCADE, "--json"))
    K, B = (result["recommended"][name] for name in ("stiffness", "virtual_damping"))
    assert result["gains"]["pos_gain"] == pytest.approx(K / B)
    assert result["gains"]["units"] == "turns"
    assert "gains" not in json.loads(run(*arguments, "--json"))
