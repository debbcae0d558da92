"""Test generated programs of a virtual coupling: they compile without warnings and return the simulated forces."""

import ctypes
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import zwidth
from zwidth.analysis.coupling_code import write_program
from zwidth.cli.commands import cli

T = 1e-3
SAMPLES = 1000
TOLERANCE = 1e-12  # relative to the largest force: rounding errors of both programs and of the coefficients
ESTIMATES = {
    "difference": zwidth.BackwardDifference(),
    "window": zwidth.WindowedDifference(7, coded_period=0.9e-3),
    "low-pass": zwidth.LowPass(cutoff=150),
    "two low-passes": zwidth.LowPass(time_constant=0.003, order=2),
    "butterworth": zwidth.Butterworth(120, 5),
    "filter without a difference": zwidth.VelocityFilter([1000.0, -1000.0], [1.0, -0.3, 0.0]),
}
TOOLS: dict[str, dict[str, Any]] = {
    "free": {"mass": 0.3},
    "damped": {"mass": 0.2, "damping": 3},
    "grounded": {"mass": 0.5, "damping": 4, "stiffness": 200},
}
CASES = [
    (estimate, tool, integrator)
    for number, estimate in enumerate(ESTIMATES)
    for integrator in ("semi-implicit", "implicit")
    for tool in (list(TOOLS)[number % 3], list(TOOLS)[(number + 1) % 3])
]


def make_scene(estimate, tool, integrator, **parts):
    tool = zwidth.Tool(**TOOLS[tool], integrator=integrator)
    device, timing = zwidth.Device(0.1, 10.0), zwidth.Timing(T, 1.5e-3)
    return zwidth.Scene(device, timing, zwidth.VirtualWall(1500, 12), ESTIMATES[estimate], tool=tool, **parts)


@pytest.fixture(scope="module")
def motions():
    force = 2.0 * np.sin(np.arange(SAMPLES) / 30.0)
    scenes = [make_scene(*case) for case in CASES]
    motion = zwidth.simulate(scenes, periods=SAMPLES, start_position=2e-3, external_force_history=force)
    rows = zip(motion.measured, motion.command, motion.tool_position, strict=True)
    return dict(zip(CASES, rows, strict=True))


def drive_c(source, positions, folder):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    (folder / "coupling.c").write_text(source)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, "-o", folder / "coupling.so", folder / "coupling.c"], check=True)
    library = ctypes.CDLL(str(folder / "coupling.so"))
    library.coupling_start.argtypes = library.coupling_force.argtypes = [ctypes.c_void_p, ctypes.c_double]
    library.coupling_start.restype, library.coupling_force.restype = None, ctypes.c_double
    state = ctypes.create_string_buffer(4096)
    library.coupling_start(state, positions[0])
    return np.array([library.coupling_force(state, x) for x in positions])


def drive_python(source, positions):
    """Return the forces, and the positions of the tool after each call."""
    names = {}
    exec(source, names)
    coupling = names["Coupling"](positions[0])
    return np.array([(coupling.force(x), coupling.tool_position) for x in positions.tolist()]).T


@pytest.mark.parametrize("case", CASES, ids=" ".join)
def test_programs_return_forces_of_the_simulation(case, motions, tmp_path):
    scene, (positions, expected, tool) = make_scene(*case), motions[case]
    scale = np.abs(expected).max()
    assert scale > 0.1
    forces, places = drive_python(write_program(scene, "python"), positions)
    np.testing.assert_allclose(forces, expected, rtol=0, atol=TOLERANCE * scale)
    np.testing.assert_allclose(
        drive_c(write_program(scene, "c"), positions, tmp_path), expected, atol=TOLERANCE * scale
    )
    # The semi-implicit Euler method computes the force from the position before the step, the implicit one after it.
    same = places if case[2] == "implicit" else np.append(positions[0], places[:-1])
    np.testing.assert_allclose(same, tool, rtol=0, atol=TOLERANCE * np.abs(tool).max())


def test_programs_limit_the_force_on_the_device_only(motions, tmp_path):
    case = CASES[0]
    positions, expected, tool = motions[case]
    limit = float(0.3 * np.abs(expected).max())
    clipped = np.clip(expected, -limit, limit)
    forces, places = drive_python(write_program(make_scene(*case), "python", max_force=limit), positions)
    np.testing.assert_allclose(forces, clipped, rtol=0, atol=TOLERANCE * limit)
    np.testing.assert_allclose(places[:-1], tool[1:], rtol=0, atol=TOLERANCE * np.abs(tool).max())
    source = write_program(make_scene(*case), "c", max_force=limit)
    np.testing.assert_allclose(drive_c(source, positions, tmp_path), clipped, rtol=0, atol=TOLERANCE * limit)


def test_code_of_recommended_coupling():
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(T, T), tool=zwidth.Tool("300 g"))
    advice = scene.recommend()
    text = advice.code("python", max_force="3 N")
    assert "Tool: mass 300.0 g, semi-implicit Euler method." in text
    assert "Force on the device limited to 3.000 N." in text
    forces, _ = drive_python(advice.code("python"), np.array([0.0, 1e-6]))
    np.testing.assert_allclose(forces[1], -1e-6 * (advice.stiffness + advice.virtual_damping / T), rtol=1e-12)
    assert "typedef struct" in advice.code()
    with pytest.raises(zwidth.InputError, match="language: got 'java'"):
        advice.code("java")  # pyright: ignore[reportArgumentType]


def test_code_of_a_chosen_coupling_to_a_slow_tool(tmp_path):
    device, timing = zwidth.Device(mass="100 g", damping=10), zwidth.Timing(rate="1 kHz", delay="1 ms")
    scene = zwidth.Scene(device, timing, tool=zwidth.Tool("300 g", every=8))
    motion = scene.simulate("1.4 kN/m", "1 N s/m", external_force=1, periods=400)
    expected = -motion.coupling_force
    assert scene.code("1.4 kN/m", "1 N s/m", "c") == scene.code(1400, 1)
    assert np.abs(drive_c(scene.code(1400, 1), motion.measured, tmp_path) - expected).max() < 1e-12
    assert np.abs(drive_python(scene.code(1400, 1, "python"), motion.measured)[0] - expected).max() < 1e-12
    with pytest.raises(zwidth.InputError, match=r"code: the wall K = 20\.00 kN/m, B = 1\.000 N s/m is not stable"):
        scene.code("20 kN/m", 1)
    options = "check --mass 100g --damping 10 --rate 1kHz --delay 1ms --tool-mass 300g --tool-every 8 --code python"
    printed = CliRunner().invoke(cli, [*options.split(), "--stiffness", "1400", "--virtual-damping", "1"])
    assert printed.output == scene.code(1400, 1, "python")


def test_code_names_rotary_units():
    device, timing = zwidth.Device("1e-4 kg m^2", "0.01 N m s/rad"), zwidth.Timing(T, T)
    scene = zwidth.Scene(device, timing, zwidth.VirtualWall("5 N m/rad", "0.01 N m s/rad"))
    text = write_program(scene.replace(tool=zwidth.Tool("3e-4 kg m^2", integrator="implicit")))
    assert "x is the angle of the device in rad; the result is the torque on the device in N m." in text
    assert "moment of inertia" in text


CONTROLLERS: dict[str, dict[str, Any]] = {
    "average": {"position": zwidth.ExponentialFilter(0.4)},
    "average and window": {"position": zwidth.ExponentialFilter(0.4), "velocity": zwidth.WindowedDifference(5)},
    "measured": {
        "position": zwidth.ExponentialFilter(0.4, velocity_from="measured"),
        "velocity": zwidth.LowPass(cutoff=150, order=2),
    },
    "no difference": {
        "position": zwidth.LowPass(cutoff="150 Hz"),
        "velocity": ESTIMATES["filter without a difference"],
    },
    "pll": {"position": zwidth.Pll(500)},
    "integral": {"feedback": zwidth.IntegralFeedback(2000)},
    "weights": {
        "position": zwidth.Pll(500),
        "feedback": zwidth.Feedback([0.1, 0.1], [1, -0.5], position=5, velocity=1),
    },
}


@pytest.fixture(scope="module")
def controlled():
    force = 2.0 * np.sin(np.arange(SAMPLES) / 30.0)
    scenes = {
        (name, integrator): make_scene("difference", "grounded", integrator).replace(**parts)
        for name, parts in CONTROLLERS.items()
        for integrator in ("semi-implicit", "implicit")
    }
    motion = zwidth.simulate(list(scenes.values()), periods=SAMPLES, start_position=2e-3, external_force_history=force)
    rows = zip(scenes.values(), motion.measured, motion.command, strict=True)
    return dict(zip(scenes, rows, strict=True))


@pytest.mark.parametrize("integrator", ["semi-implicit", "implicit"])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_programs_with_position_estimates_and_feedback(name, integrator, controlled, tmp_path):
    scene, positions, expected = controlled[name, integrator]
    scale = np.abs(expected).max()
    assert scale > 0.1
    forces, _ = drive_python(write_program(scene, "python"), positions)
    np.testing.assert_allclose(forces, expected, rtol=0, atol=TOLERANCE * scale)
    forces = drive_c(write_program(scene, "c"), positions, tmp_path)
    np.testing.assert_allclose(forces, expected, rtol=0, atol=TOLERANCE * scale)
