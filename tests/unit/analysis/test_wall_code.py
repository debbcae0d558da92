"""Walls as programs: compiled without a warning, and driven sample by sample against simulations."""

import ctypes
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest
from scipy import signal

import zwidth
from zwidth.analysis.wall_code import find_sections, write_wall
from zwidth.model.circle_functions import circle_points

BUTTER: Any = signal.butter(3, 60.0, fs=1000.0)
WITH_DIFFERENCE = 1e3 * np.polymul(BUTTER[0], [1, -1]), np.polymul(BUTTER[1], [1, 0])
ESTIMATES = {
    "difference": zwidth.BackwardDifference(),
    "difference coded for another period": zwidth.BackwardDifference(coded_period=1.3e-3),
    "window of one": zwidth.WindowedDifference(1),
    "window": zwidth.WindowedDifference(15, coded_period=0.9e-3),
    "longest window": zwidth.WindowedDifference(1000),
    "low-pass": zwidth.LowPass(cutoff=100),
    "two low-passes": zwidth.LowPass(time_constant=0.02, order=2),
    "slow low-pass": zwidth.LowPass(cutoff=1e-3, order=2, coded_period=1.1e-3),
    **{f"butterworth {order}": zwidth.Butterworth(25, order) for order in range(1, 9)},
    "slow butterworth": zwidth.Butterworth(0.5, 8),
    "filter of butter and a difference": zwidth.VelocityFilter(*WITH_DIFFERENCE),
    "filter without a difference": zwidth.VelocityFilter([3.0, 2.0], [1.0, -0.2, 0.3, 0.1]),
    "filter of a complex zero": zwidth.VelocityFilter([500.0, -100.0, 200.0], [1.0, -0.9, 0.18, 0.0]),
    "number": zwidth.VelocityFilter([7.0], [1.0]),
    "late difference": zwidth.VelocityFilter([1000.0, -1000.0], [1.0, 0.0, 0.0, 0.0]),
}
# Beside the largest force: rounding of either side, and of the coefficients.
CLOSE = 1e-12
PERIODS = 400


def scene_with(velocity):
    device, timing = zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.5e-3)
    return zwidth.Scene(device, timing, zwidth.VirtualWall(2e3, 3.0), velocity)


@pytest.fixture(scope="module")
def motions():
    """Pushed into the wall from in front of it, to fall out of it again and come back."""
    push = 3.0 * np.sin(np.arange(PERIODS) / 20.0) + 1.0
    scenes = [scene_with(velocity) for velocity in ESTIMATES.values()]
    options = {"periods": PERIODS, "start_position": -1e-3, "external_force_history": push, "contact": "unilateral"}
    found = zwidth.simulate(scenes, **options)
    return {name: (found.measured[k], found.command[k]) for k, name in enumerate(ESTIMATES)}


def drive_c(text, positions, folder):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    (folder / "wall.c").write_text(text)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, "-o", folder / "wall.so", folder / "wall.c"], check=True)
    library = ctypes.CDLL(str(folder / "wall.so"))
    library.wall_start.argtypes = library.wall_force.argtypes = [ctypes.c_void_p, ctypes.c_double]
    library.wall_start.restype, library.wall_force.restype = None, ctypes.c_double
    state = ctypes.create_string_buffer(16384)
    library.wall_start(state, positions[0])
    return np.array([library.wall_force(state, x) for x in positions])


def drive_python(text, positions):
    names = {}
    exec(text, names)
    wall = names["Wall"](positions[0])
    return np.array([wall.force(x) for x in positions.tolist()])


@pytest.mark.parametrize("name", ESTIMATES)
def test_programs_give_the_forces_of_the_simulation(name, motions, tmp_path):
    scene, (positions, expected) = scene_with(ESTIMATES[name]), motions[name]
    # In the wall and out of it, several times.
    assert np.count_nonzero(np.diff((positions > 0).astype(int))) >= 3
    scale = np.abs(expected).max()
    for forces in (
        drive_c(write_wall(scene, "c"), positions, tmp_path),
        drive_python(write_wall(scene, "python"), positions),
    ):
        np.testing.assert_allclose(forces, expected, rtol=0, atol=CLOSE * scale)


def test_the_force_limit_is_that_of_the_simulation(motions, tmp_path):
    scene, (positions, expected) = scene_with(ESTIMATES["difference"]), motions["difference"]
    limit = 0.3 * np.abs(expected).max()
    for forces in (
        drive_c(write_wall(scene, "c", max_force=limit), positions, tmp_path),
        drive_python(write_wall(scene, "python", max_force=limit), positions),
    ):
        np.testing.assert_allclose(forces, np.clip(expected, -limit, limit), rtol=0, atol=CLOSE * limit)
    found = scene.recommend(stiffness_fraction=0.5)
    assert found.code(max_force="3 N") == found.code(max_force=3) != found.code()
    assert "Force limited to 3.000 N." in found.code(max_force=3)
    with pytest.raises(zwidth.InputError, match=r"^max_force: got 0"):
        found.code(max_force=0)


def test_a_recommendation_writes_its_own_wall():
    found = scene_with(zwidth.LowPass(cutoff=100)).recommend(stiffness_fraction=0.5)
    text = found.code("python")
    force = drive_python(text, np.array([1e-3]))
    assert force[0] == pytest.approx(-found.stiffness * 1e-3, rel=1e-14)
    with pytest.raises(zwidth.InputError, match="language: got 'java'"):
        found.code("java")  # pyright: ignore[reportArgumentType]


def test_where_there_is_no_wall_there_is_no_program():
    bare = zwidth.Scene(zwidth.Device(0.1, 0.0), zwidth.Timing(1e-3, 1e-3))
    with pytest.raises(zwidth.InputError, match="code: there is no wall: no passive wall exists"):
        bare.recommend(passive=True).code()


@pytest.mark.parametrize("name", ESTIMATES)
def test_sections_are_the_estimate(name):
    """Their product on the circle, by the sections' coefficients alone, against the jet of the estimate."""
    estimate = ESTIMATES[name].estimate(1e-3)
    w = np.linspace(0.05, 3.1, 50)
    zeta = np.exp(1j * w) - 1.0
    value = estimate.gain * np.ones(50, complex)
    for top, bottom in find_sections(estimate):
        assert len(top) == len(bottom)
        value *= np.polyval(top, zeta) / np.polyval(bottom, zeta)
    if estimate.window:
        value *= (1.0 - np.exp(-1j * w * estimate.window)) / estimate.window
    np.testing.assert_allclose(value, estimate.jet(circle_points(w)).value, rtol=1e-11)
