"""`zwidth check`: printed and JSON results against scenes in Python; warnings, remedies, gains, simulation and
imports.
"""

import json
import re
import subprocess
import sys
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import zwidth
from zwidth.app.verdict import spell_passivity
from zwidth.cli.commands import cli

pytestmark = pytest.mark.usefixtures("fitted_once")
DEVICE = ["--mass", "100 g", "--damping", "10", "--delay", "1 periods"]
RATE = ["--rate", "1 kHz"]
WALL = ["--stiffness", "3 kN/m", "--virtual-damping", "5"]
COMPONENTS = {
    "filter": (["--velocity-cutoff", "100 Hz"], {"velocity": zwidth.LowPass(cutoff=100)}),
    "window": (["--velocity-samples", "5"], {"velocity": zwidth.WindowedDifference(5)}),
    "butterworth": (
        ["--velocity-kind", "butterworth", "--velocity-cutoff", "50", "--velocity-order", "4"],
        {"velocity": zwidth.Butterworth(50, 4)},
    ),
    "operator": (
        ["--operator-mass", "500 g", "--operator-stiffness", "100"],
        {"operator": zwidth.Operator(0.5, 0, 100)},
    ),
    "soft operator": (
        ["--operator-mass", "0.5", "--operator-coupling-stiffness", "1 kN/m", "--operator-coupling-damping", "2"],
        {"operator": zwidth.Operator(0.5, 0, 0, 1000, 2)},
    ),
}


@cache
def run(*arguments):
    """Run a command; the result is cached because several tests use the same output."""
    result = CliRunner().invoke(cli, list(arguments))
    assert result.exit_code == 0, result.output
    return result


def list_warnings(result):
    """Return the warnings, which are printed on stderr; older versions of click's runner merge both streams."""
    return [line for line in result.output.splitlines() if line.startswith("zwidth: ")]


def make_scene(velocity=None, operator=None, coupling=None):
    parts = {} if velocity is None else {"velocity": velocity}
    device = zwidth.Device(0.1, 10, coupling)
    return zwidth.Scene(
        device, zwidth.Timing(1e-3, "1 periods"), zwidth.VirtualWall(3e3, 5), operator=operator, **parts
    )


@pytest.mark.parametrize("name", COMPONENTS)
def test_options_agree_with_the_scene_in_python(name):
    arguments, parts = COMPONENTS[name]
    printed = json.loads(run("check", *WALL, *DEVICE, *RATE, *arguments, "--json").stdout)
    scene = make_scene(**parts)
    best = scene.max_stiffness()
    assert printed["stable"] == scene.is_stable(3e3, 5)
    assert printed["spectral_radius"] == scene.spectral_radius(3e3, 5)
    assert printed["stiffness_max"] == best.stiffness
    assert printed["virtual_damping_at_max"] == best.virtual_damping
    assert [limit["gain"] for limit in printed["limits"]] == [limit.gain for limit in zwidth.limits_of(scene)]


def test_stable_intervals_of_a_coupling_end_at_the_boundary():
    tip = ["--coupling-mass", "50 g", "--coupling-stiffness", "20 kN/m", "--coupling-damping", "1"]
    printed = json.loads(run("check", *WALL, *DEVICE, *RATE, *tip, "--coupling-sensor", "tip", "--json").stdout)
    scene = make_scene(coupling=zwidth.Coupling(0.05, 20e3, 1.0, "tip"))
    (row,), (column,) = printed["stable_stiffness"], printed["stable_damping"]
    offset = 1e-6
    for low, high, is_stable_at in (
        (*row, lambda K: scene.is_stable(K, 5)),
        (*column, lambda B: scene.is_stable(3e3, B)),
    ):
        size = high - low
        inside = [low + offset * size, 0.5 * (low + high), high - offset * size]
        assert [bool(is_stable_at(value)) for value in (low - offset * size, *inside, high + offset * size)] == [
            0,
            1,
            1,
            1,
            0,
        ]


def list_labels(output):
    return [line[:10].strip() for line in output.splitlines() if line[:1].strip() and line[10:11] == " "]


def test_output_of_a_filtered_scene():
    out = run("check", *WALL, *DEVICE, *RATE, *COMPONENTS["filter"][0]).stdout
    assert list_labels(out)[:8] == ["STABLE", "device", "velocity", "margins", "decay", "room", "passive", "K_max"]
    assert out.splitlines()[:2] == [
        "STABLE     K = 3.000 kN/m, B = 5.000 N s/m (alpha 0.03000, beta 0.05000)",
        "device     100.0 g, 10.00 N s/m, at 1.000 kHz, delay 1 period (delta 0.1000, d 1.000)",
    ]
    assert "velocity   LowPass, cutoff 100.0 Hz" in out
    assert "K_max      11.94 kN/m at B = 27.02 N s/m; this wall uses 25.1 %" in out
    verbose = run("check", *WALL, *DEVICE, *RATE, *COMPONENTS["filter"][0], "--verbose").stdout
    assert re.search(r"smooth optimum at [0-9.]+ Hz; alpha_max 0.1194, beta 0.2702", verbose), verbose


def test_omitted_parameters_are_printed():
    out = run("check", *WALL, "--mass", "100 g", *RATE).stdout
    assert "100.0 g, damping 0 (not given), at 1.000 kHz, delay 0 (not given)" in " ".join(out.split())
    out = run("check", *WALL, "--mass", "100 g", *RATE, "--delay", "0", "--damping", "0").stdout
    assert "100.0 g, damping 0, at 1.000 kHz, delay 0 (delta" in " ".join(out.split())


@pytest.mark.parametrize("command", [["check", "--stiffness", "40 kN/m"], ["ridge"], ["recommend", "--passive"]])
def test_piped_lines_have_at_most_100_columns(command):
    out = run(*command, *DEVICE, *RATE, *COMPONENTS["soft operator"][0], "--velocity-cutoff", "80 Hz").stdout
    lines = out.splitlines()
    assert 60 < max(map(len, lines)) <= 100


def test_json_keys_are_equal_for_every_scene():
    for command, *wall in (["check", *WALL], ["ridge"]):
        arguments = [command, *wall, *DEVICE, *RATE]
        parts = ([], *(options for options, _ in COMPONENTS.values()))
        rigid, *others = (json.loads(run(*arguments, *options, "--json").stdout) for options in parts)
        assert all(list(other) == list(rigid) for other in others)


@pytest.mark.parametrize(
    ("wall", "text"),
    [
        (("3 kN/m", "5"), "room       K from 0 to 9.744 kN/m at this B; B from -5.864 to 86.76 N s/m at this K"),
        (("60 kN/m", "5"), "remedy     K at most 9.744 kN/m"),
        (("-5 N/m", "5"), "remedy     K from 0 N/m to 9.744 kN/m"),
        (("3 kN/m", "500"), "remedy     B from -5.864 N s/m to 86.76 N s/m"),
    ],
)
def test_distances_to_the_boundary_are_printed(wall, text):
    out = run("check", "--stiffness", wall[0], "--virtual-damping", wall[1], *DEVICE, *RATE).stdout
    assert text in out


REMEDIES = {"K": "stiffness", "B": "virtual-damping", "damping": "damping", "filter": "velocity-cutoff"}


@pytest.mark.parametrize(
    ("wall", "device"),
    [
        (("30 kN/m", "40"), DEVICE + RATE),
        (("3 kN/m", "200"), DEVICE + RATE),
        (("15 kN/m", "30"), [*DEVICE, *RATE, "--velocity-cutoff", "60"]),
        (("40 kN/m", "40"), [*DEVICE[:4], "--delay", "1 ms", *RATE]),
    ],
)
def test_each_printed_remedy_of_an_unstable_wall_is_sufficient(wall, device):
    arguments = ["check", "--stiffness", wall[0], "--virtual-damping", wall[1], *device]
    out = run(*arguments).stdout
    assert out.startswith("UNSTABLE")
    remedies = re.findall(r"^(?:remedy    |          ) (?:or )?(.*? (?:at most|at least|from) .*)", out, re.MULTILINE)
    assert len(remedies) >= 2
    for remedy in remedies:
        parts = re.fullmatch(r"(.*?) (at most|at least|from) (.*)", remedy)
        assert parts is not None
        name, _, ends = parts.groups()
        flag = "--" + REMEDIES.get(name.split()[0], name)
        for end in ends.partition(" (")[0].split(" to "):
            changed = (
                [*arguments, flag, end]
                if flag != "--rate"
                else [*(argument for argument in arguments if argument not in RATE), flag, end]
            )
            # The last of two equal options counts.
            assert run(*changed).stdout.startswith("STABLE"), (remedy, end)


@pytest.mark.parametrize("damping", [5.0, 16.0, 40.0, 70.0, 75.0])
def test_wall_with_the_printed_margins_is_stable(damping):
    """Margins are rounded down; half of those rounded to nearest would be too large."""
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))
    out = run("check", "--stiffness", "8e3", "--virtual-damping", f"{damping}", *DEVICE, *RATE).stdout
    gain = float(*re.findall("margins +gain ([0-9.]+)", out))
    assert scene.is_stable(8e3 * gain, damping * gain)
    (delay,) = re.findall("deg at .*, delay (.*?),", out)
    assert scene.replace(delay=1e-3 + zwidth.Timing(1e-3, delay).delay).is_stable(8e3, damping)


def test_gains_of_a_rigid_scene():
    out = run("check", *WALL, *DEVICE, *RATE).stdout
    assert out.splitlines()[-3:] == [
        "To gain K_max:  twice the rate                   68.31 kN/m  (x 3.44; the delay stays 1 period)",
        "                half the delay                   34.23 kN/m  (x 1.72)",
        "                10 % more damping of the device  20.43 kN/m  (x 1.03)",
    ]
    seconds = run("check", *WALL, *DEVICE[:4], "--delay", "1 ms", *RATE).stdout
    assert "68.31 kN/m  (x 3.44; the delay stays 1 period)" in seconds
    assert "31.78 kN/m  (x 1.60; the delay stays 1.000 ms)" in seconds


def test_rate_and_period_are_equivalent():
    one = run("check", *WALL, *DEVICE, "--rate", "4 kHz").stdout
    assert one == run("check", *WALL, *DEVICE, "--period", "0.25 ms").stdout
    assert "delay 1 period" in " ".join(one.split())
    for options in ([], ["--rate", "1000", "--period", "1e-3"]):
        assert CliRunner().invoke(cli, ["check", *WALL, *DEVICE, *options]).exit_code == 2


@pytest.mark.parametrize(
    ("arguments", "warning"),
    [
        (["--mass", "70", *RATE], "--mass is 70 kg, an implausible value; did you mean --mass '70 g'?"),
        (["--mass", "1", "--period", "4000"], "--period is 4000 s, .* did you mean --rate '4000 Hz'?"),
        (["--mass", "1", "--period", "1"], "--period is 1 s, .* did you mean --period '1 ms'?"),
        (["--mass", "1", "--rate", "1"], "--rate is 1 Hz, .* did you mean --rate '1 kHz'?"),
        (
            ["--mass", "1", *RATE, "--resolution", "5"],
            "--resolution is 5 m, .* write counts as --resolution '5 counts/mm'",
        ),
        (
            ["--mass", "60 g cm^2", *RATE, "--resolution", "2000"],
            "--resolution is 2000 rad, .* write counts as --resolution '2000 counts/rev'",
        ),
        (
            ["--mass", "1", *RATE, "--delay", "20 s"],
            "--delay is 20 s, .* did you mean --delay '20 ms' or --delay '20 periods'?",
        ),
        (
            ["--mass", "1", *RATE, "--delay", "1 s"],
            "--delay is 1 s, .* did you mean --delay '1 ms' or --delay '1 periods'?",
        ),
        (
            ["--mass", "1", *RATE, "--damping", "2e4"],
            "--damping is 20000 N s/m, .* did you mean --damping '20000 mN s/m'?",
        ),
    ],
)
def test_implausible_values_have_a_warning(arguments, warning):
    result = run("check", "--stiffness", "100", *arguments)
    assert re.search("^(STABLE|UNSTABLE|MARGINAL) ", result.output, re.MULTILINE)
    (line,) = list_warnings(result)
    assert re.fullmatch(f"zwidth: {warning.replace('?', '[?]')}", line)


@pytest.mark.parametrize("command", ["check", "recommend", "ridge", "simulate", "diagnose", "design"])
def test_long_delay_without_unit_is_refused(command):
    wall = [] if command in ("recommend", "ridge") else ["--stiffness", "100"]
    result = CliRunner().invoke(cli, [command, *wall, *DEVICE, *RATE, "--delay", "1.5"])
    assert result.exit_code != 0
    assert "got '1.5', i.e. 1.5 s; write '1.5 periods' or '1.5 ms', or '1.5 s'" in result.output + str(result.exception)
    assert run("check", *WALL, *DEVICE, *RATE, "--delay", "1.5periods").exit_code == 0


def test_only_implausible_stiffness_has_a_warning():
    (line,) = list_warnings(run("check", "--stiffness", "1e9", *DEVICE, *RATE))
    assert "--stiffness is 1e+09 N/m" in line
    assert list_warnings(run("check", *WALL, *DEVICE, *RATE, *COMPONENTS["soft operator"][0])) == []
    wheel = ["--stiffness", "2", "--mass", "4.5e-4", "--damping", "0.0013", "--rate", "1 kHz"]
    assert list_warnings(run("check", *wheel)) == []


def test_encoder_and_friction_are_simulated():
    knob = ["--mass", "60 g cm^2", "--damping", "0.02 mN m s/rad", *RATE, "--delay", "0.7 periods"]
    wall = ["--stiffness", "0.3 N m/rad", "--virtual-damping", "1.4 mN m s/rad", "--velocity-cutoff", "100 Hz"]
    hardware = ["--resolution", "2000 counts", "--friction", "0.1 mN m"]
    scene = zwidth.Scene(
        zwidth.Device("60 g cm^2", "0.02 mN m s/rad"),
        zwidth.Timing(rate="1 kHz", delay="0.7 periods"),
        velocity=zwidth.LowPass(cutoff="100 Hz"),
    )
    diagnosis = zwidth.diagnose(scene, "0.3 N m/rad", "1.4 mN m s/rad", resolution="0.0005 rev", coulomb="0.1 mN m")
    out = run("check", *wall, *knob, *hardware).stdout
    assert "CAUTION    LIMIT CYCLE: " in out
    assert "CAUTION: limit cycle device" in " ".join(out.split())
    assert f"to stop it: {diagnosis.advise()}" in " ".join(out.split())
    printed = json.loads(run("check", *wall, *knob, *hardware, "--json").stdout)["diagnosis"]
    assert printed["cause"] == "quantization"
    assert printed["amplitude"] == pytest.approx(diagnosis.amplitude, rel=1e-9)


def test_mismatched_coded_period_is_reported():
    other = ["--velocity-cutoff", "100", "--velocity-coded-period", "0.1 ms"]
    out = " ".join(run("check", *WALL, *DEVICE, *RATE, *other).stdout.split())
    assert "it returns 10.0 times the velocity, and its cutoff is 10.00 Hz instead of 100.0 Hz" in out
    same = ["--velocity-cutoff", "100", "--velocity-coded-period", "1 ms"]
    assert "note" not in run("check", *WALL, *DEVICE, *RATE, *same).stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--velocity-cutoff", "800"], "'--velocity-cutoff': got 800 Hz; it must be below half the sampling rate"),
        (
            ["--velocity-cutoff", "10", "--velocity-order", "3"],
            "'--velocity-order': got 3; it must be a whole number from 1 to 2",
        ),
        (["--velocity-order", "2"], "--velocity-order does not belong to a velocity estimate of kind"),
        (["--velocity-kind", "butterworth"], "requires --velocity-cutoff"),
        (["--coupling-mass", "1"], "a coupling requires a mass and a stiffness; give --coupling-stiffness"),
        (["--operator-coupling-damping", "1"], "'--operator-coupling-damping': got 1.0 without a coupling spring"),
        (["--operator-mass", "70 gg"], "'--operator-mass': got '70 gg'; the units allowed are kg, g, mg"),
    ],
)
def test_error_names_the_option(arguments, message):
    result = CliRunner().invoke(cli, ["check", *WALL, *DEVICE, *RATE, *arguments])
    assert result.exit_code == 2
    assert message in result.output


def test_check_does_not_import_jax():
    bare = ["check", *WALL, *DEVICE, *RATE]
    code = (
        "import sys\nfrom zwidth.cli.commands import cli\n"
        f"for name, words in {[('bare', []), *((name, options) for name, (options, *_) in COMPONENTS.items())]!r}:\n"
        f"    cli.main(args=[*{bare!r}, *words], standalone_mode=False)\n    assert 'jax' not in sys.modules, name\n"
    )
    subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_ridge_of_a_filtered_scene():
    arguments = ["ridge", *DEVICE, *RATE, *COMPONENTS["filter"][0]]
    printed = json.loads(run(*arguments, "--json").stdout)
    scene = make_scene(zwidth.LowPass(cutoff=100))
    best, per = scene.max_stiffness(), scene.sensitivities().per
    assert printed["stiffness_max"] == best.stiffness
    assert printed["frequency"] == best.frequency
    assert printed["kind"] == "smooth"
    assert {name: entry["value"] for name, entry in printed["sensitivities"].items()} == per
    assert printed["sensitivities"]["velocity.cutoff"]["unit"] == "N/m per Hz"
    step = 1e-3
    above, below = (scene.replace(**{"velocity.cutoff": 100 + s}).max_stiffness().stiffness for s in (step, -step))
    assert np.isclose(per["velocity.cutoff"], (above - below) / (2 * step), rtol=1e-6)
    lines = run(*arguments).stdout.splitlines()
    assert lines[-1].startswith("dK_max/d(velocity.cutoff)  52.53 N/m per Hz: +52.5 N/m for 1 Hz more")


def test_ridge_includes_the_mass_of_a_rigid_operator():
    printed = json.loads(run("ridge", *DEVICE, *RATE, "--operator-mass", "100 g", "--json").stdout)
    assert printed["stiffness_max"] == pytest.approx(
        zwidth.max_stiffness(mass=0.2, damping=10.0, period=1e-3, delay=1e-3), rel=1e-12
    )


@pytest.mark.parametrize("parts", [[], ["--velocity-cutoff", "100 Hz"]], ids=["rigid", "filter"])
@pytest.mark.parametrize("damping, verdict", [("0", "UNSTABLE"), ("5", "MARGINAL")])
def test_wall_without_stiffness(parts, damping, verdict):
    output = run("check", "--stiffness", "0", "--virtual-damping", damping, "--mass", "100 g", *RATE, *parts).stdout
    assert verdict in output
    assert "-0 N s/m" not in output
    assert re.search("^decay +none", output, re.MULTILINE)


BARELY = "on the limit: no physical damping to spare"


@pytest.mark.parametrize("velocity", [zwidth.BackwardDifference(), zwidth.LowPass(cutoff=100)], ids=["rigid", "filter"])
@pytest.mark.parametrize("delay", [0.0, 1.0 / 3.0, 1.0, 20.0])
@pytest.mark.parametrize("wall", [(12345.0, 7.3), (777.7, 40.0), (20e3, -5.0), (0.0, 5.0), (1e-3, 0.0)])
def test_passivity_text_at_the_passivity_limit(wall, delay, velocity):
    timing = zwidth.Timing(1 / 3000, f"{delay!r} periods")

    def describe(damping):
        scene = zwidth.Scene(zwidth.Device(0.07, damping), timing, zwidth.VirtualWall(*wall), velocity)
        margin = float(scene.passivity_margin(*wall))
        verdict: Any = SimpleNamespace(passive=bool(scene.is_passive(*wall)), passivity_margin=margin)
        return spell_passivity(scene, verdict), margin

    # The margin depends on the damping with slope 1; the second iteration removes the rounding error of the first.
    required = 100.0
    for _ in range(2):
        required -= describe(required)[1]
    assert describe(required)[0] == BARELY
    assert describe(required * (1 + 1e-6))[0].startswith("yes: ")
    assert describe(required * (1 - 1e-6))[0].startswith("no: ")


def test_zero_wall_on_an_undamped_device_is_on_the_passivity_limit():
    output = run("check", "--stiffness", "0", "--virtual-damping", "0", "--mass", "100 g", *RATE).stdout
    assert f"  {BARELY}" in output


@pytest.mark.parametrize(
    "options, text",
    [
        (["--velocity-cutoff", "100 Hz"], "yes: 8.478 N s/m of physical damping to spare"),
        (["--coupling-mass", "50 g", "--coupling-stiffness", "20 kN/m"], "yes: "),
        (
            ["--coupling-mass", "50 g", "--coupling-stiffness", "20 kN/m", "--coupling-sensor", "tip"],
            "not known with the sensor at the tip",
        ),
    ],
)
def test_passivity_and_margins_with_components_are_printed(options, text):
    wall = ["--stiffness", "0 N/m" if "--velocity-cutoff" in options else "1 kN/m", "--virtual-damping", "5"]
    output = run("check", *wall, "--mass", "100 g", "--damping", "10", *RATE, *options).stdout
    assert re.search(rf"^passive +{re.escape(text)}", output, re.MULTILINE)
    if "--velocity-cutoff" not in options:
        margins = r"^margins +gain [0-9.]+, phase -?[0-9.]+ deg at .*, delay .*s, modulus"
        assert re.search(margins, output, re.MULTILINE)


def test_without_a_remedy_no_limits_are_mentioned():
    # Five integrators: no stiffness and no damping stabilize the device.
    text = run("check", "--stiffness", "1000", "--device", "1 / 0.1 10 0 0 0 0 0", *RATE).stdout
    assert "remedy     no stabilizing change of one parameter was found\n" in text
    assert "limits of stability" not in text
