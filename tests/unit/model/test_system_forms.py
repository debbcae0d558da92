"""Linear systems and velocity filters by coefficients, roots and sections, in Python, files and on the command line."""

import json
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import signal

import zwidth
from zwidth.cli import cli
from zwidth.studies import load_config

TIMING = zwidth.Timing("1 ms", "1 ms")
RIGID = zwidth.Scene(zwidth.Device(0.1, 10), TIMING)
# The low-pass of the tests: order 4, because its transfer function has two sections.
SOS = signal.butter(4, 80, fs=1000, output="sos")
ZEROS, POLES, GAIN = signal.butter(4, 80, fs=1000, output="zpk")
DIFFERENCE = [1000, -1000], [1, 0]


def run(*arguments):
    result = CliRunner().invoke(cli, [str(each) for each in arguments])
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize(
    "system",
    [
        "1 / 0.1 10 0",
        "zpk: / 0, -100 / 10",
        "zpk:/0 -100+0j/10",
        "sos: 0 0 10 1 100 0",
        {"sos": [[0, 0, 10, 1, 100, 0]]},
        {"sos": [[0, 0, 10, 0, 1, 0], [0, 0, 1, 0, 1, 100]]},
        {"zeros": [], "poles": ["0", "-100"], "gain": 10},
        {"numerator": [1], "denominator": [0.1, 10, 0]},
        ([], [0, -100], 10),
    ],
)
def test_all_forms_of_a_rigid_mass_have_the_same_maximum_stiffness(system):
    device = zwidth.LinearDevice(system)
    expected = RIGID.max_stiffness()
    np.testing.assert_allclose(zwidth.Scene(device, TIMING).max_stiffness()[:3], expected[:3], rtol=1e-9)
    assert eval(repr(device), {"LinearDevice": zwidth.LinearDevice}) == device


def test_sampled_period_is_an_argument_in_any_unit():
    """The limit 4 I/h^2 of a double integrator of semi-implicit Euler, I = 0.1 kg m^2, h = 5 ms, at B = 0."""
    device = zwidth.LinearDevice("25e-5 0 / 1 -2 1", sampled="5 ms")
    assert device.dt == 0.005
    assert device == zwidth.LinearDevice({"numerator": [25e-5, 0], "denominator": [1, -2, 1], "sampled": 5e-3})
    assert device == zwidth.LinearDevice(signal.dlti([25e-5, 0], [1, -2, 1], dt=5e-3))
    assert zwidth.Scene(device, zwidth.Timing("5 ms")).max_stiffness().stiffness == pytest.approx(16e3, rel=1e-9)


@pytest.mark.parametrize(
    ("system", "sampled", "message"),
    [
        ("sos: 1 2 3", None, "device.sos: .* rows of six coefficients"),
        ("zpk: 1 / 2", None, "'zpk: ZEROS / POLES / GAIN'"),
        ("zpk: / 1+1j / 2", None, "finite numbers as"),
        (np.tile([0, 0, 1, 1, 2, 3], (2, 1)), None, "two sections or two polynomials"),
        ("1 / 1 -0.5", "-1 ms", "sampled: got"),
        (signal.dlti([1], [1, -0.5], dt=1e-3), "2 ms", "for a system with dt = 0.001 s"),
        ({"poles": [0]}, None, "finite numbers as"),
    ],
)
def test_incomplete_systems_raise(system, sampled, message):
    with pytest.raises(zwidth.InputError, match=message):
        zwidth.LinearDevice(system, sampled)


def test_forms_of_a_velocity_filter_are_connected_in_series():
    expected = RIGID.replace(velocity=zwidth.Butterworth(80, 4)).max_stiffness()
    for forms in ({"sos": SOS}, {"zeros": ZEROS, "poles": POLES, "gain": GAIN}):
        velocity = zwidth.VelocityFilter(*DIFFERENCE, **forms)
        np.testing.assert_allclose(RIGID.replace(velocity=velocity).max_stiffness()[:3], expected[:3], rtol=1e-9)
        assert eval(repr(velocity), {"VelocityFilter": zwidth.VelocityFilter}) == velocity
    # The gain belongs to the roots: 1000 (z - 1)/z.
    one = zwidth.VelocityFilter(zeros=1, poles=0, gain=1000)
    np.testing.assert_allclose(RIGID.replace(velocity=one).max_stiffness()[:3], RIGID.max_stiffness()[:3], rtol=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "velocity: got no coefficients"),
        ({"numerator": [1]}, "half of a form"),
        ({"poles": [0.5]}, "half of a form"),
        ({"zeros": [0.5]}, "zeros without poles"),
        ({"poles": [0.5 + 0.1j], "gain": 1}, "complex ones with their conjugates"),
        ({"sos": [1, 2, 3]}, "velocity.sos"),
        ({"sos": [[1, 0, 0, 1, -1.5, 0]]}, "Check the coefficients"),
    ],
)
def test_incomplete_filters_raise(given, message):
    with pytest.raises(zwidth.InputError, match=message):
        zwidth.VelocityFilter(**given)


def test_coefficients_with_few_decimals_are_named_as_the_cause():
    """Butterworth filter of order 4 and 5 Hz at 1 kHz; its largest pole is 0.988, and with three decimals above 1."""
    numerator, denominator = signal.butter(4, 5, fs=1000)
    rounded = np.round(denominator, 3)
    assert np.abs(np.roots(denominator)).max() < 0.99 < 1.0 < np.abs(np.roots(rounded)).max()
    with pytest.raises(zwidth.InputError, match="Cause: rounding errors of the coefficients; use sections"):
        zwidth.VelocityFilter(np.convolve(numerator, [1000, -1000]), [*rounded, 0])
    zwidth.VelocityFilter(*DIFFERENCE, sos=signal.butter(4, 5, fs=1000, output="sos"))


def write(tmp_path, scene):
    file = tmp_path / "scene.yaml"
    file.write_text(f"version: 1\nname: s\nscene: {scene}\nstudies: [{{kind: boundary, name: b}}]\n")
    return file


@pytest.mark.parametrize(
    "keys",
    [
        {"sos": SOS.tolist()},
        {"zeros": ZEROS.real.tolist(), "poles": [str(pole).strip("()") for pole in POLES], "gain": GAIN},
    ],
)
def test_filter_in_a_file(tmp_path, keys):
    velocity = json.dumps({"kind": "filter", "numerator": [1000, -1000], "denominator": [1, 0], **keys})
    file = write(tmp_path, f"{{mass: 100 g, damping: 10, period: 1 ms, delay: 1 ms, velocity: {velocity}}}")
    expected = RIGID.replace(velocity=zwidth.Butterworth(80, 4)).max_stiffness()
    config: Any = load_config(file)
    np.testing.assert_allclose(config.scene.to_scene().max_stiffness()[:3], expected[:3], rtol=1e-9)
    assert type(config).model_validate(config.model_dump(mode="json", exclude_none=True)) == config
    code, stdout, _ = run("ridge", file, "--json")
    assert code == 0
    assert json.loads(stdout)["stiffness_max"] == pytest.approx(expected.stiffness, rel=1e-9)


@pytest.mark.parametrize("device", ["'zpk: / 0 -100 / 10'", "'sos: 0 0 10 1 100 0'", "{sos: [[0, 0, 10, 1, 100, 0]]}"])
def test_device_in_a_file(tmp_path, device):
    config: Any = load_config(write(tmp_path, f"{{device: {device}, period: 1 ms, delay: 1 ms}}"))
    expected = RIGID.max_stiffness()
    np.testing.assert_allclose(config.scene.to_scene().max_stiffness()[:3], expected[:3], rtol=1e-9)


SAMPLED = ["--device", "25e-5 0 / 1 -2 1", "--period", "5 ms"]


def test_sampled_device_on_the_command_line(tmp_path):
    code, stdout, stderr = run("ridge", *SAMPLED, "--sampled", "--json")
    assert (code, stderr) == (0, "")
    result = json.loads(stdout)
    assert result["stiffness_max"] == pytest.approx(16e3, rel=1e-9)
    assert result["cautions"] == []
    for device in ("zpk: 0 / 1 1 / 25e-5", "sos: 0 25e-5 0 1 -2 1"):
        same = run("ridge", "--device", device, "--rate", "200 Hz", "--sampled", "--json")[1]
        assert json.loads(same)["stiffness_max"] == pytest.approx(16e3, rel=1e-9)
    # The period is that of the file if no option gives it.
    file = write(tmp_path, "{mass: 100 g, period: 5 ms, stiffness: 1000, virtual_damping: 1}")
    code, stdout, _ = run("check", file, *SAMPLED[:2], "--sampled", "--json")
    assert code == 0
    assert json.loads(stdout)["stiffness_max"] == pytest.approx(16e3, rel=1e-9)


def test_coefficients_in_z_that_are_read_in_s_cause_a_caution(tmp_path):
    _, _, stderr = run("ridge", *SAMPLED)
    assert "got poles of at most 1 rad/s, near the unit circle; if the coefficients are in z, add --sampled" in stderr
    file = write(tmp_path, "{device: 25e-5 0 / 1 -2 1, period: 5 ms, stiffness: 1000}")
    config: Any = load_config(file)
    (warning,) = config.scene.warnings
    assert warning.endswith("if the coefficients are in z, write a mapping with 'sampled'")
    for device in ("1 / 0.1 10 0", "1 / 0.1 0.2 -3", "1 / 1 3 2 0", "1 / 1 0 0"):
        assert "--sampled" not in run("ridge", "--device", device, "--rate", "1 kHz")[2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sampled", "--mass", "1 kg", "--rate", "1 kHz"], "--sampled: give --device 'NUM / DEN'"),
        (["--sampled", "--device", "1 / 1 -0.5"], "--sampled: also give --rate or --period"),
        (["--sampled", "--device", "phantom_2006", "--rate", "1 kHz"], "--device: got 'phantom_2006' as a sampled"),
        ([*SAMPLED, "--sampled", "--delay", "1 ms"], "allows only an integer delay"),
        (["--mass", "1 kg", "--rate", "1 kHz", "--velocity-filter", "1 x / 1 0"], "--velocity-filter: got '1 x / 1 0'"),
        (
            ["--mass", "1", "--rate", "1 kHz", "--velocity-filter", "1 / 1", "--velocity-cutoff", "3"],
            "--velocity-cutoff too",
        ),
        (["--mass", "1 kg", "--rate", "1 kHz", "--velocity-filter", "1 / 1 -1"], "got a pole of magnitude 1"),
    ],
)
def test_invalid_options_exit_with_2(options, message, capsys):
    from zwidth.cli import main

    with pytest.raises(SystemExit) as end:
        main(["ridge", *options])
    assert end.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_velocity_filter_on_the_command_line():
    options = ["ridge", "--mass", "100 g", "--damping", "10", "--rate", "1 kHz", "--delay", "1 ms", "--json"]
    expected = RIGID.max_stiffness().stiffness
    for text in ("1000 -1000 / 1 0", "zpk: 1 / 0 / 1000", "sos: 1000 -1000 0 1 0 0"):
        code, stdout, _ = run(*options, "--velocity-filter", text)
        assert code == 0
        assert json.loads(stdout)["stiffness_max"] == pytest.approx(expected, rel=1e-12)
