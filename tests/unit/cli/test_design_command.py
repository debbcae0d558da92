"""`zwidth design`: what a stiffness needs, and tolerances."""

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


def needed(*arguments, code=0):
    return json.loads(design(*arguments, "--json", code=code))["required"]


def test_what_is_needed_agrees_with_the_closed_form_of_a_rigid_device():
    find = ["--stiffness", "40 kN/m", *DEVICE, "--find"]
    plain = {"mass": 0.1, "damping": 10.0, "period": 1e-3, "delay": 0.5e-3}

    def known(name):
        return {key: value for key, value in plain.items() if key != name}

    for name, low, high in (("damping", 1.0, 100.0), ("mass", 0.05, 1.0), ("period", 1e-4, 1e-2), ("delay", 0.0, 5e-3)):
        exact = find_required(name, 40e3, low, high, **known(name))
        assert needed(*find, name)["value"] == pytest.approx(exact, rel=1e-9)
    rate = needed(*find, "rate")
    period = needed(*find, "period")
    assert 1 / rate["value"] == pytest.approx(period["value"], rel=1e-9)
    assert (rate["rate"], rate["unit"], rate["sufficient_side"]) == (rate["value"], "Hz", "above")
    assert (period["rate"], period["sufficient_side"]) == (1 / period["value"], "below")
    assert re.match(
        r"rate +[\d.]+ kHz or more for K_max = 40.00 kN/m \(the delay stays 500.0 µs\)", design(*find, "rate")
    )


def test_a_delay_in_periods_stays_in_periods():
    """The loop of the trial: 4.722 kHz with the same delay in seconds, 2.762 kHz with one period."""
    loop = ["--mass", "70 g", "--damping", "2", "--rate", "2 kHz", "--stiffness", "80 kN/m", "--find", "rate"]
    found = needed(*loop, "--delay", "1 periods")
    assert found["value"] == pytest.approx(2762.3, rel=1e-4)
    period = 1 / found["value"]
    assert zwidth.max_stiffness(mass=0.07, damping=2, period=period, delay=period) == pytest.approx(80e3, rel=1e-9)
    assert "the delay stays 1 period)" in design(*loop, "--delay", "1 periods")
    assert needed(*loop, "--delay", "0.5 ms")["value"] == pytest.approx(4722, rel=1e-3)


def test_without_a_solution_the_best_is_printed_and_the_command_fails():
    bare = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms", "--find", "delay"]
    text = " ".join(design("--stiffness", "100 kN/m", *bare, code=1).split())
    top = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3)).max_stiffness().stiffness
    assert "delay none for K_max = 100.0 kN/m" in text
    assert "the largest is 82.58 kN/m at 0 s" in text
    found = needed("--stiffness", "100 kN/m", *bare, code=1)
    assert found["status"] == "UNREACHABLE"
    assert found["best"] == {"value": 0.0, "stiffness": top}
    # A stiffness that needs hardly any delay is found.
    assert 0 < needed("--stiffness", "80 kN/m", *bare)["value"] < 33e-6


def test_what_is_printed_is_enough_as_it_is_rounded():
    for stiffness in range(30, 50):
        for name, factor, unit in (
            ("damping", 1.0, "N s/m or more"),
            ("mass", 1e-3, "g or more"),
            ("delay", 1e-6, "µs or less"),
        ):
            words = design("--stiffness", f"{stiffness} kN/m", *DEVICE, "--find", name).removeprefix(name)
            value, _, rest = words.strip().partition(" ")
            assert rest.startswith(f"{unit} for ")
            scene = zwidth.Scene(zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 0.5e-3))
            assert scene.replace(**{name: factor * float(value)}).max_stiffness().stiffness >= 1e3 * stiffness


def test_where_there_is_enough_between_two_values_both_are_told():
    """Strong damping: an eighth of a period of delay is better than none, and than a quarter."""
    device = "--mass=0.1", "--damping=1e4", "--rate=1000", "--delay=0.1 ms", "--stiffness=42 MN/m"
    ends = design("--find=delay", *device).removeprefix("delay").partition(" for ")[0].strip().split(" to ")
    scene = zwidth.Scene(zwidth.Device(0.1, 1e4), zwidth.Timing(1e-3))
    for end, beyond in zip(ends, (0.99, 1.01), strict=True):
        assert scene.replace(delay=end).max_stiffness().stiffness >= 42e6
        further = beyond * zwidth.Timing(1e-3, end).delay
        assert scene.replace(delay=further).max_stiffness().stiffness < 42e6


def test_a_search_that_failed_does_not_say_nowhere(monkeypatch):
    failed = RequiredValue(np.nan, "nowhere", (), (0.1, 10.0), zwidth.Status.NOT_CONVERGED)
    monkeypatch.setattr(zwidth.Scene, "required", lambda *_, **__: failed)
    find = "--find", "damping", "--stiffness", "20 kN/m", *DEVICE
    assert "not found from 100.0 mN s/m to 10.00 N s/m: The solver stopped" in " ".join(design(*find, code=1).split())
    assert needed(*find, code=1)["status"] == "NOT_CONVERGED"


def test_a_cutoff_is_enough_and_a_lower_one_is_not():
    filtered = ["--stiffness", "15 kN/m", *DEVICE, "--velocity-cutoff", "100", "--find", "cutoff"]
    found = needed(*filtered)
    assert (found["parameter"], found["unit"], found["sufficient_side"]) == ("velocity.cutoff", "Hz", "above")
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 0.5e-3), velocity=zwidth.LowPass(cutoff=100))
    reach = [
        scene.replace(**{"velocity.cutoff": found["value"] * factor}).max_stiffness().stiffness
        for factor in (1 - 1e-6, 1 + 1e-6)
    ]
    assert reach[0] < 15e3 < reach[1]
    assert design(*filtered).startswith("velocity.cutoff ")


def test_from_no_damping_and_no_delay_a_range_is_searched():
    bare = ["--mass", "0.1", "--rate", "1000", "--stiffness", "100 kN/m"]
    assert needed(*bare, "--find", "damping")["value"] == pytest.approx(
        find_required("damping", 100e3, 1.0, 1e3, mass=0.1, period=1e-3), rel=1e-9
    )
    assert "none for K_max = 100.0 kN/m" in design(*bare, "--find", "delay", code=1)


def test_tolerances_are_drawn_and_searched():
    wall = ["--stiffness", "17 kN/m", "--virtual-damping", "35", "--mass", "0.1", "--damping", "10", "--rate", "1 kHz"]
    shares = ["--delay", "1 ms", "--tolerance", "mass=20%", "--tolerance", "damping=0.3"]
    found = json.loads(design(*wall, *shares, "--json"))
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(17e3, 35))
    same = zwidth.simulate_tolerances(scene, {"mass": 0.2, "damping": 0.3})
    assert found["tolerances"]["stable"] == same.stable
    assert found["tolerances"]["stiffness"] == same.stiffness
    box = {"mass": zwidth.Interval(0.08, 0.12), "damping": zwidth.Interval(7, 13), "period": 1e-3, "delay": 1e-3}
    assert found["every_device"]["stiffness"] == pytest.approx(zwidth.robust_wall(**box).stiffness, rel=1e-6)
    assert found["every_device"]["stiffness"] < found["tolerances"]["stiffness"]
    text = design(*wall, *shares)
    assert "% of 10000 devices drawn" in text
    # The printed wall is no stiffer than the computed one and has exactly its damping.
    told = " ".join(text.split())
    printed = re.search(
        r"all devices .* for K up to (.*) kN/m at B = (.*) N s/m \(by search\), or up to (.*) kN/m, each", told
    )
    K, B, most = map(float, printed.groups() if printed else ())
    assert float(B) == found["every_device"]["virtual_damping"]
    assert 0 <= found["every_device"]["stiffness"] - 1e3 * K < 10
    assert 0 <= found["every_device"]["stiffness_max"] - 1e3 * most < 10
    mass = np.linspace(0.08, 0.12, 81)[:, None]
    assert zwidth.is_stable(1e-3 * K / mass, 1e-3 * B / mass, 1e-3 * np.array([7.0, 10.0, 13.0]) / mass, 1).all()
    normal = design(*wall, *shares[:2], "--tolerance", "mass=5%", "--distribution", "normal", "--samples", "500")
    assert "of 500 devices drawn" in normal
    assert "by search" not in normal


def test_the_damping_for_a_stiffness_is_that_of_the_library():
    best = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 5e-4)).best_damping(5e3)
    found = needed("--find", "virtual_damping", "--stiffness", "5 kN/m", *DEVICE)
    assert (found["value"], found["spectral_radius"]) == (best.virtual_damping, best.spectral_radius)
    assert "settles fastest" in design("--find", "virtual_damping", "--stiffness", "5 kN/m", *DEVICE)
    find = "--find", "virtual_damping", "--stiffness", "5e5"
    assert "no B is stable at K = 500.0 kN/m" in design(*find, *DEVICE, code=1)
    # Next to the stiffest wall B has the digits that it needs.
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
def test_what_is_refused(arguments, message):
    result = CliRunner().invoke(cli, ["design", "--stiffness", "20 kN/m", *DEVICE, *arguments])
    assert result.exit_code == 2
    assert message in result.output
