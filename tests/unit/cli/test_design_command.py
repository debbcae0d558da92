"""`zwidth design`: required parameter values against the closed form and scenes in Python, and tolerances."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from required_values import find_required

import zwidth
from zwidth.analysis.optimization import RequiredValue
from zwidth.cli.commands import cli

DEVICE = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "0.5 ms"]


def design(*arguments, code=0):
    result = CliRunner().invoke(cli, ["design", *arguments])
    assert result.exit_code == code, result.output
    return result.stdout


def find_value(*arguments, code=0):
    return json.loads(design(*arguments, "--json", code=code))["required"]


def test_required_values_agree_with_the_closed_form():
    find = ["--stiffness", "40 kN/m", *DEVICE, "--find"]
    plain = {"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 0.5e-3}

    def without(name):
        return {key: value for key, value in plain.items() if key != name}

    for name, low, high in (("damping", 1.0, 100.0), ("mass", 0.05, 1.0), ("period", 1e-4, 1e-2), ("delay", 0.0, 5e-3)):
        exact = find_required(name, 40e3, low, high, **without(name))
        assert find_value(*find, name)["value"] == pytest.approx(exact, rel=1e-9)
    rate = find_value(*find, "rate")
    period = find_value(*find, "period")
    assert 1 / rate["value"] == pytest.approx(period["value"], rel=1e-9)
    assert (rate["rate"], rate["unit"], rate["sufficient_side"]) == (rate["value"], "Hz", "above")
    assert (period["rate"], period["sufficient_side"]) == (1 / period["value"], "below")
    assert re.match(
        r"rate +[\d.]+ kHz or more for K_max = 40.00 kN/m \(the delay stays 500.0 µs\)", design(*find, "rate")
    )


def test_delay_in_periods_scales_with_the_period():
    """The required rate is 4.722 kHz with a fixed delay in seconds, but 2.762 kHz with a delay of one period."""
    loop = ["--mass", "70 g", "--damping", "2", "--rate", "2 kHz", "--stiffness", "80 kN/m", "--find", "rate"]
    required = find_value(*loop, "--delay", "1 periods")
    assert required["value"] == pytest.approx(2762.3, rel=1e-4)
    period = 1 / required["value"]
    assert zwidth.max_stiffness(mass=0.07, damping=2, period=period, delay=period) == pytest.approx(80e3, rel=1e-9)
    assert "the delay stays 1 period)" in design(*loop, "--delay", "1 periods")
    assert find_value(*loop, "--delay", "0.5 ms")["value"] == pytest.approx(4722, rel=1e-3)


def test_unreachable_stiffness_reports_the_best_and_exits_with_1():
    bare = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms", "--find", "delay"]
    text = " ".join(design("--stiffness", "100 kN/m", *bare, code=1).split())
    top = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3)).max_stiffness().stiffness
    assert "delay none for K_max = 100.0 kN/m" in text
    assert "the largest is 82.58 kN/m at 0 s" in text
    required = find_value("--stiffness", "100 kN/m", *bare, code=1)
    assert required["status"] == "UNREACHABLE"
    assert required["best"] == {"value": 0.0, "stiffness": top}
    # A stiffness that requires nearly zero delay has a solution.
    assert 0 < find_value("--stiffness", "80 kN/m", *bare)["value"] < 33e-6


def test_printed_value_is_sufficient_after_rounding():
    for stiffness in range(30, 50):
        for name, factor, unit in (
            ("damping", 1.0, "N s/m or more"),
            ("mass", 1e-3, "g or more"),
            ("delay", 1e-6, "µs or less"),
        ):
            text = design("--stiffness", f"{stiffness} kN/m", *DEVICE, "--find", name).removeprefix(name)
            value, _, rest = text.strip().partition(" ")
            assert rest.startswith(f"{unit} for ")
            scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 0.5e-3))
            assert scene.replace(**{name: factor * float(value)}).max_stiffness().stiffness >= 1e3 * stiffness


def test_sufficient_interval_is_printed_with_both_ends():
    """With strong damping, a delay of an eighth of a period is better than zero and than a quarter."""
    device = "--mass=0.1", "--damping=1e4", "--rate=1000", "--delay=0.1 ms", "--stiffness=42 MN/m"
    ends = design("--find=delay", *device).removeprefix("delay").partition(" for ")[0].strip().split(" to ")
    scene = zwidth.Scene(zwidth.Device(0.1, 1e4), zwidth.Timing(1e-3))
    for end, factor in zip(ends, (0.99, 1.01), strict=True):
        assert scene.replace(delay=end).max_stiffness().stiffness >= 42e6
        outside = factor * zwidth.Timing(1e-3, end).delay
        assert scene.replace(delay=outside).max_stiffness().stiffness < 42e6


def test_failed_search_is_not_reported_as_unreachable(monkeypatch):
    failed = RequiredValue(np.nan, "nowhere", (), (0.1, 10.0), zwidth.Status.NOT_CONVERGED)
    monkeypatch.setattr(zwidth.Scene, "required", lambda *_, **__: failed)
    find = "--find", "damping", "--stiffness", "20 kN/m", *DEVICE
    assert "not found from 100.0 mN s/m to 10.00 N s/m: The solver stopped" in " ".join(design(*find, code=1).split())
    assert find_value(*find, code=1)["status"] == "NOT_CONVERGED"


def test_required_cutoff_is_minimal():
    filtered = ["--stiffness", "15 kN/m", *DEVICE, "--velocity-cutoff", "100", "--find", "cutoff"]
    required = find_value(*filtered)
    assert (required["parameter"], required["unit"], required["sufficient_side"]) == ("velocity.cutoff", "Hz", "above")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 0.5e-3), velocity=zwidth.LowPass(cutoff=100))
    maxima = [
        scene.replace(**{"velocity.cutoff": required["value"] * factor}).max_stiffness().stiffness
        for factor in (1 - 1e-6, 1 + 1e-6)
    ]
    assert maxima[0] < 15e3 < maxima[1]
    assert design(*filtered).startswith("velocity.cutoff ")


def test_search_starts_from_zero_damping_and_delay():
    bare = ["--mass", "0.1", "--rate", "1000", "--stiffness", "100 kN/m"]
    assert find_value(*bare, "--find", "damping")["value"] == pytest.approx(
        find_required("damping", 100e3, 1.0, 1e3, mass=0.1, period=1e-3), rel=1e-9
    )
    assert "none for K_max = 100.0 kN/m" in design(*bare, "--find", "delay", code=1)


def test_tolerances_are_simulated_and_searched():
    wall = ["--stiffness", "17 kN/m", "--virtual-damping", "35", "--mass", "0.1", "--damping", "10", "--rate", "1 kHz"]
    tolerances = ["--delay", "1 ms", "--tolerance", "mass=20%", "--tolerance", "damping=0.3"]
    output_json = json.loads(design(*wall, *tolerances, "--json"))
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(17e3, 35))
    simulated = zwidth.simulate_tolerances(scene, {"mass": 0.2, "damping": 0.3})
    assert output_json["tolerances"]["stable"] == simulated.stable
    assert output_json["tolerances"]["stiffness"] == simulated.stiffness
    box = {"mass": zwidth.Interval(0.08, 0.12), "damping": zwidth.Interval(7, 13), "period": 1e-3, "delay": 1e-3}
    assert output_json["every_device"]["stiffness"] == pytest.approx(zwidth.robust_wall(**box).stiffness, rel=1e-6)
    assert output_json["every_device"]["stiffness"] < output_json["tolerances"]["stiffness"]
    text = design(*wall, *tolerances)
    assert "% of 10000 devices drawn" in text
    # The printed stiffness is rounded down; the damping is exact.
    output = " ".join(text.split())
    printed = re.search(
        r"all devices .* for K up to (.*) kN/m at B = (.*) N s/m \(by search\), or up to (.*) kN/m, each", output
    )
    K, B, maximum = map(float, printed.groups() if printed else ())
    assert float(B) == output_json["every_device"]["virtual_damping"]
    assert 0 <= output_json["every_device"]["stiffness"] - 1e3 * K < 10
    assert 0 <= output_json["every_device"]["stiffness_max"] - 1e3 * maximum < 10
    mass = np.linspace(0.08, 0.12, 81)[:, None]
    assert zwidth.is_stable(1e-3 * K / mass, 1e-3 * B / mass, 1e-3 * np.array([7.0, 10.0, 13.0]) / mass, 1).all()
    normal = design(*wall, *tolerances[:2], "--tolerance", "mass=5%", "--distribution", "normal", "--samples", "500")
    assert "of 500 devices drawn" in normal
    assert "by search" not in normal


def test_damping_for_a_stiffness_agrees_with_best_damping():
    best = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 5e-4)).best_damping(5e3)
    required = find_value("--find", "virtual_damping", "--stiffness", "5 kN/m", *DEVICE)
    assert (required["value"], required["spectral_radius"]) == (best.virtual_damping, best.spectral_radius)
    assert "settles fastest" in design("--find", "virtual_damping", "--stiffness", "5 kN/m", *DEVICE)
    find = "--find", "virtual_damping", "--stiffness", "5e5"
    assert "no B is stable at K = 500.0 kN/m" in design(*find, *DEVICE, code=1)
    # Near the maximum stiffness B is printed with the necessary digits.
    stiffness = 266.96362243298
    text = design("--find=virtual_damping", f"--stiffness={stiffness}", "--mass=0.1", "--period=0.01", "--delay=5 ms")
    scene = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(0.01, 5e-3))
    assert scene.is_stable(stiffness, text.removeprefix("B").partition(" settles")[0].strip())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give --find or --tolerance, or both"),
        (
            ["--find", "cutoff"],
            "--find cutoff: not a parameter of this scene; give --velocity-cutoff as a starting value",
        ),
        (["--tolerance", "weight=10%"], "Invalid value for '--tolerance': got 'weight'"),
        (["--tolerance", "weight=10%"], "did you mean 'mass'?"),
        (["--tolerance", "mass=10%", "--tolerance", "mass=20%"], "got 'mass' twice; give each name only once"),
        (["--tolerance", "mass=ten"], "write NAME=SHARE, such as mass=10%"),
    ],
)
def test_invalid_arguments_exit_with_2(arguments, message):
    result = CliRunner().invoke(cli, ["design", "--stiffness", "20 kN/m", *DEVICE, *arguments])
    assert result.exit_code == 2
    assert message in result.output
