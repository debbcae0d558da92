"""The option --device with the file of a device that has several joints."""

import pytest
from sweeping import run_main

pytestmark = pytest.mark.usefixtures("unpainted")

RIGID = "mass_matrix: [[0.03, 0.01], [0.01, 0.01]]\njacobian: [[-0.2, -0.1]]\n"
SLIDER = (
    '<body><joint name="rail" type="slide" axis="1 0 0" damping="3"/><geom size=".02" mass=".5"/><site name="tip"/>'
)
LOOP = ("--rate", "1kHz", "--delay", "1 ms", "--stiffness", "1 kN/m")


@pytest.fixture
def check(tmp_path, capsys):
    """Write the content of a device file, run ``zwidth check`` with it, and return its exit code and its output."""

    def run_check(content, *more, file="arm.yaml", loop=LOOP):
        (tmp_path / file).write_text(content, encoding="utf-8")
        code = run_main("check", "--device", tmp_path / file, *loop, *more)
        printed = capsys.readouterr()
        return code, " ".join((printed.out + printed.err).split())

    return run_check


def test_rigid_arm_accepts_options_of_a_mass(check):
    _, output = check(RIGID, "--damping", "3", "--operator-mass", "100 g")
    assert "device 666.7 g, 3.000 N s/m" in output
    assert "operator mass 100.0 g" in output


def test_damped_arm_is_a_linear_system(check):
    _, output = check(RIGID + "damping: 20 mN m s/rad\n")
    assert "linear system of order 3" in output
    # The printed limit is rounded down from 96.54 kN/m, the value in the example of `zwidth.from_mass_matrix`.
    assert "K_max 96.53 kN/m" in output


def test_model_is_found_relative_to_the_file(check, tmp_path):
    pytest.importorskip("mujoco", reason="the extra mujoco is not installed")
    (tmp_path / "rail.xml").write_text(f"<mujoco><worldbody>{SLIDER}</body></worldbody></mujoco>", encoding="utf-8")
    code, output = check("model: rail.xml\nsite: tip\ndirection: x\n")
    assert code == 0
    assert "device 500.0 g, 3.000 N s/m" in output


def test_rotary_arm_has_rotary_units(check):
    loop = ("--rate", "1kHz", "--delay", "1 ms", "--stiffness", "1 N m/rad")
    _, output = check(
        "{mass_matrix: [[0.03, 0.01], [0.01, 0.01]], damping: 0.02, direction: x, rotary: true}", loop=loop
    )
    assert "K = 1.000 N m/rad" in output
    assert "N/m" not in output


def test_transfer_function_has_the_units_of_the_other_options(capsys):
    run_main("check", "--device", "1 / 1e-4 1e-3 0", "--rate", "1kHz", "--delay", 0, "--stiffness", "1 N m/rad")
    output = capsys.readouterr().out
    assert "K = 1.000 N m/rad" in output
    assert "N/m" not in output


@pytest.mark.parametrize(
    ("content", "more", "message"),
    [
        (RIGID + "dampng: 1\n", (), "arm.yaml:3:1: dampng: unknown key"),
        ("mass_matrix: [[1, 2], [2, 1]]\ndirection: x\n", (), "arm.yaml:1:14: mass_matrix: got an eigenvalue of -1"),
        ("version: 1\nname: a\n", (), "give its name without --device"),
        (RIGID, ("--sampled",), "write the key 'sampled' into the file"),
        (RIGID + "damping: 1\n", ("--mass", "1 kg"), "--mass: the given --device already contains it"),
    ],
)
def test_invalid_files_are_refused(check, content, more, message):
    code, output = check(content, *more)
    assert code == 2
    assert message in output


def test_model_without_point_is_refused(check):
    code, output = check("<mujoco/>", file="arm.xml")
    assert code == 2
    assert "write model, site and direction into a file DEVICE.yaml" in output


ARM = "mass_matrix: [[0.03, 0.01], [0.01, 0.01]]\njacobian: [[{}, -0.1], [0.1, 0.1]]\ndirection: {}\n"


def test_jacobian_accepts_lengths_with_units(check):
    assert check(ARM.format("-20 cm", "x")) == check(ARM.format("-0.2", "x"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ARM.format("-0.2", "z"), "direction: got 'z'; the Jacobian has 2 rows; use 'x' or 'y', or add a row"),
        (ARM.format("-20 deg", "x"), "jacobian: got '-20 deg', a rotary unit for a linear device"),
        (
            ARM.format("-20 cm", "x") + "rotary: true\n",
            "jacobian: got [['-20 cm', -0.1], [0.1, 0.1]]; it must be finite",
        ),
        ("mass_matrix: 1 kg\ndirection: x\n", "mass_matrix: got one number; it must be a square matrix"),
    ],
)
def test_invalid_matrices_are_refused(check, content, message):
    code, output = check(content)
    assert code == 2
    assert message in output
