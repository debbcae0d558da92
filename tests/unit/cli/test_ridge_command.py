"""`zwidth ridge`: text and JSON with sensitivities, against zwidth.sensitivities."""

import json
import re

import pytest
from click.testing import CliRunner

import zwidth
from zwidth.cli.commands import cli

DEVICE = ["--mass", "100 g", "--damping", "10", "--period", "1 ms", "--delay", "1 ms"]


def ridge(*arguments):
    result = CliRunner().invoke(cli, ["ridge", *arguments])
    assert result.exit_code == 0, result.output
    return result.output


def test_sensitivities_are_printed_with_units():
    assert ridge(*DEVICE).splitlines()[-4:] == [
        "dK_max/d(mass)        141.4 kN/m per kg: +141 N/m for 1 g more",
        "dK_max/d(damping)     572.2 N/m per N s/m: +572 N/m for 1 N s/m more",
        "dK_max/d(period)      -15.34 MN/m per s: -153 N/m for 10 µs more (the delay stays 1.000 ms)",
        "dK_max/d(delay)       -18.67 MN/m per s: -187 N/m for 10 µs more",
    ]


def test_json_agrees_with_sensitivities():
    printed = json.loads(ridge(*DEVICE, "--json"))
    gain = zwidth.sensitivities(mass=0.1, damping=10.0, period=1e-3, delay=1e-3)
    assert printed["stiffness_max"] == pytest.approx(gain.stiffness_max, rel=1e-14)
    assert {name: entry["unit"] for name, entry in printed["sensitivities"].items()} == {
        "damping": "N/m per N s/m",
        "mass": "N/m per kg",
        "period": "N/m per s",
        "delay": "N/m per s",
    }
    for name, entry in printed["sensitivities"].items():
        assert entry["value"] == pytest.approx(getattr(gain, f"per_{name}"), rel=1e-13)


def test_normalized_device_has_no_si_sensitivities():
    printed = ridge("--delta", "0.1", "--d", "1")
    assert not re.search("K_max|per", printed)
    assert "sensitivities" not in json.loads(ridge("--delta", "0.1", "--d", "1", "--json"))


def test_invalid_normalized_value_is_named_by_its_option():
    result = CliRunner().invoke(cli, ["ridge", "--delta", "inf", "--d", "1"])
    assert "Invalid value for '--delta': got 'inf'" in result.output


@pytest.mark.parametrize("arguments", [[], ["--delta", "1"], ["--mass", "1"], ["--delta", "1", "--d", "-1"]])
def test_invalid_arguments_exit_with_2(arguments):
    assert CliRunner().invoke(cli, ["ridge", *arguments]).exit_code == 2


def test_dimensionless_parameter_has_no_unit_prefix():
    last = ridge(
        *DEVICE, *["--actuator-cutoff", "200", "--actuator-order", "2", "--actuator-damping-ratio", "0.7"]
    ).splitlines()[-1]
    assert last.startswith("dK_max/d(actuator.damping_ratio)  ")
    assert last.endswith("N/m for 0.01 more")


FITTED = """\
version: 1
name: fitted
scene:
  {{mass: 100 g, damping: 10 N s/m, rate: 1 kHz, delay: 1 ms, safe_limit: {}}}
studies: [{{kind: recommend, name: wall}}]
"""


def test_sensitivity_to_a_negative_modal_mass_is_printed():
    # The modal mass is negative if actuator and sensor move in opposite directions.
    mode = ["--modes-0-frequency", "120 Hz", "--modes-0-damping-ratio", "0.02", "--modes-0-mass", "-0.5"]
    lines = ridge(*DEVICE, *mode).splitlines()
    (line,) = [line for line in lines if line.startswith("dK_max/d(modes.0.mass)")]
    assert line.endswith("for 10 g more")


def test_maximum_above_the_safe_limit_has_a_caution(tmp_path):
    file = tmp_path / "fitted.yaml"
    file.write_text(
        FITTED.format('{stiffness: 0, reason: "resolve the warnings first", warnings: ["the clock jumps"]}')
    )
    text = " ".join(ridge(str(file)).split())
    caution = "the real device may be unstable. no wall is supported: resolve the warnings first"
    assert f"CAUTION this wall exceeds the safe limit: {caution} CAUTION the clock jumps next" in text
    cautions = json.loads(ridge(str(file), "--json"))["cautions"]
    assert cautions == [f"this wall exceeds the safe limit: {caution}", "the clock jumps"]
    file.write_text(FITTED.format("{stiffness: 30 kN/m, virtual_damping: 50 N s/m}"))
    assert "CAUTION" not in ridge(str(file))


@pytest.mark.parametrize(
    ("tool", "narrow"),
    [
        (["--tool-mass", "300 g"], False),
        (["--tool-mass", "300 g", "--tool-every", "16"], True),
        (["--tool-mass", "30 g", "--delay", "1 ms"], True),
    ],
)
def test_largest_coupling_in_a_narrow_region_is_named(tool, narrow):
    system = ["--mass", "100 g", "--damping", "10", "--rate", "1 kHz", *tool]
    found = json.loads(ridge(*system, "--json"))
    half = [f"{0.5 * found['stiffness_max']} N/m", f"{found['virtual_damping']} N s/m"]
    wall = ["--stiffness", half[0], "--virtual-damping", half[1]]
    checked = CliRunner().invoke(cli, ["check", *system, *wall])
    assert checked.output.startswith("UNSTABLE" if narrow else "STABLE")
    assert any("do not set a coupling near K_max" in note for note in found["notes"]) == narrow


@pytest.mark.parametrize(
    ("damping", "effect"),
    [
        ("[0.02, 0.05]", r"joints\.1\.damping\)  .* kN/m per SI unit: \+\d+ N/m for 10 % more"),
        ("[0, 0.05]", r"joints\.0\.damping\)  .* N/m per SI unit: .* for a damping of 0\.001"),
    ],
)
def test_joint_dampings_have_sensitivities(tmp_path, damping, effect):
    file = tmp_path / "arm.yaml"
    matrix, jacobian = "[[0.003, 0.001], [0.001, 0.001]]", "[[-0.2, -0.1], [0.1, 0.1]]"
    file.write_text(
        f"mass_matrix: {matrix}\njacobian: {jacobian}\ndamping: {damping}\ndirection: y\n", encoding="utf-8"
    )
    assert re.search(effect, ridge("--device", str(file), "--rate", "1 kHz", "--delay", "1 ms"))


# Options of scenes that have stable walls, but no K_max: with the implicit tool, couplings of arbitrarily large K are
# stable; on the undamped device, all stable walls with B >= 0 are on islands.
IMPLICIT = ["--mass", "2.326 g", "--damping", "14.35 mN s/m", "--period", "947 us", "--delay", "1 period"]
IMPLICIT += ["--velocity-kind", "butterworth", "--velocity-cutoff", "110.7 Hz", "--velocity-order", "3"]
IMPLICIT += ["--tool-mass", "2 g", "--tool-integrator", "implicit"]
UNDAMPED = ["--mass", "2.55 kg cm^2", "--coupling-mass", "7.08 kg cm^2", "--coupling-stiffness", "1.324 N m/rad"]
UNDAMPED += ["--period", "2.432 ms", "--delay", "0.43 periods", "--velocity-samples", "19", "--damping", "0"]
UNDAMPED += ["--tool-mass", "1.28 kg cm^2", "--tool-damping", "1.9e-5 N m s/rad"]


@pytest.mark.parametrize(
    ("options", "wall", "fault"),
    [
        (IMPLICIT, ("30 N/m", "0.1 N s/m"), "not computed: stable couplings exist for arbitrarily large K"),
        (IMPLICIT, ("3 kN/m", "0.1 N s/m"), "not computed: stable couplings exist for arbitrarily large K"),
        (UNDAMPED, ("1.7 N m/rad", "25 mN m s/rad"), "none: no stable wall with B >= 0 is connected to K = 0"),
    ],
)
def test_missing_maximum_with_stable_walls_is_explained(options, wall, fault):
    arguments = ["check", *options, "--stiffness", wall[0], "--virtual-damping", wall[1]]
    printed = " ".join(CliRunner().invoke(cli, arguments).output.split())
    assert printed.startswith("STABLE")
    assert f"K_max {fault}" in printed
    for command in ("ridge", "recommend"):
        result = CliRunner().invoke(cli, [command, *options])
        assert result.exit_code == 1
        assert fault.partition(": ")[2] in " ".join(result.output.split())
        assert "at any damping" not in result.output


def test_islands_of_unlimited_couplings_are_refused():
    scene = zwidth.Scene(
        zwidth.Device("2.326 g", "14.35 mN s/m"),
        zwidth.Timing("947 us", "1 period"),
        velocity=zwidth.Butterworth("110.7 Hz", 3),
        tool=zwidth.Tool("2 g", integrator="implicit"),
    )
    assert scene.is_stable(["30 N/m", "3 kN/m", "3 MN/m"], "0.1 N s/m").all()
    assert not scene.is_stable("500 N/m", "0.1 N s/m")
    assert scene.max_stiffness().status == zwidth.Status.NOT_CONVERGED
    with pytest.raises(zwidth.InputError, match="no boundary at high stiffness"):
        scene.islands()
