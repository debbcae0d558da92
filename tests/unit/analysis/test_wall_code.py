"""Test generated wall programs: they compile without warnings and return the forces of simulations."""

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
AVERAGE = zwidth.ExponentialFilter(0.3)
CONTROLLERS: dict[str, dict[str, Any]] = {
    "average": {"position": AVERAGE},
    "average without effect": {"position": zwidth.ExponentialFilter(1)},
    "average and window": {"position": AVERAGE, "velocity": zwidth.WindowedDifference(7)},
    "average and low-pass": {"position": AVERAGE, "velocity": zwidth.LowPass(cutoff=100, order=2)},
    "average and filter": {"position": AVERAGE, "velocity": ESTIMATES["filter without a difference"]},
    "average of the position only": {"position": zwidth.ExponentialFilter(0.3, velocity_from="measured")},
    "low-pass of the position": {"position": zwidth.LowPass(cutoff="80 Hz")},
    "butterworth of the position": {"position": zwidth.Butterworth(100, 5)},
    "mean": {"position": zwidth.PositionFilter([0.25] * 4, [1, 0, 0, 0])},
    "pll": {"position": zwidth.Pll(300)},
    "slow pll": {"position": zwidth.Pll(5)},
    "observer": {"position": zwidth.Observer([0.5, -0.4, 0], [100, -100, 0], [1, -1.4, 0.5])},
    "integrals": {"feedback": zwidth.IntegralFeedback(2000)},
    "forward integral": {"feedback": zwidth.IntegralFeedback(2000, "forward")},
    "cascade": dict(zwidth.cascade(200, 10, 40, units="m", position=zwidth.Pll(500))),
    "pid": dict(zwidth.pid(2e3, 3e3, 3, units="m", derivative_filter=2e-3)),
    "inner loop": {"feedback": zwidth.Feedback([5e3, -5e3], [1, 0])},
    "feed-through": {"feedback": zwidth.Feedback([500], [1])},
    "two integrators": {"feedback": zwidth.Feedback([0.1, 0.1, 0], [1, -2, 1], position=1, velocity=0.01)},
}
PARTS: dict[str, dict[str, Any]] = {name: {"velocity": each} for name, each in ESTIMATES.items()} | CONTROLLERS
# Relative to the largest force: rounding errors of both programs and of the coefficients.
TOLERANCE = 1e-12
PERIODS = 400


def make_scene(name):
    device, timing = zwidth.Device(0.1, 10.0), zwidth.Timing(1e-3, 1.5e-3)
    return zwidth.Scene(device, timing, **{"wall": zwidth.VirtualWall(2e3, 3.0), **PARTS[name]})


@pytest.fixture(scope="module")
def trajectories():
    """Simulate motions that enter and leave the wall several times under a sinusoidal external force."""
    force = 3.0 * np.sin(np.arange(PERIODS) / 20.0) + 1.0
    scenes = [make_scene(name) for name in PARTS]
    options = {"periods": PERIODS, "start_position": -1e-3, "external_force_history": force, "contact": "unilateral"}
    motions = zwidth.simulate(scenes, **options)
    return {name: (motions.measured[k], motions.command[k]) for k, name in enumerate(PARTS)}


def drive_c(source, positions, folder):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    (folder / "wall.c").write_text(source)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
    subprocess.run(["cc", *flags, "-o", folder / "wall.so", folder / "wall.c"], check=True)
    library = ctypes.CDLL(str(folder / "wall.so"))
    library.wall_start.argtypes = library.wall_force.argtypes = [ctypes.c_void_p, ctypes.c_double]
    library.wall_start.restype, library.wall_force.restype = None, ctypes.c_double
    state = ctypes.create_string_buffer(16384)
    library.wall_start(state, positions[0])
    return np.array([library.wall_force(state, x) for x in positions])


def drive_python(source, positions):
    names = {}
    exec(source, names)
    wall = names["Wall"](positions[0])
    return np.array([wall.force(x) for x in positions.tolist()])


@pytest.mark.parametrize("name", PARTS)
def test_programs_return_forces_of_the_simulation(name, trajectories, tmp_path):
    scene, (positions, expected) = make_scene(name), trajectories[name]
    # The motion enters and leaves the wall several times.
    assert np.count_nonzero(np.diff((positions > 0).astype(int))) >= 3
    scale = np.abs(expected).max()
    for forces in (
        drive_c(write_wall(scene, "c"), positions, tmp_path),
        drive_python(write_wall(scene, "python"), positions),
    ):
        np.testing.assert_allclose(forces, expected, rtol=0, atol=TOLERANCE * scale)


def test_programs_limit_force_like_the_simulation(trajectories, tmp_path):
    scene, (positions, expected) = make_scene("difference"), trajectories["difference"]
    limit = 0.3 * np.abs(expected).max()
    for forces in (
        drive_c(write_wall(scene, "c", max_force=limit), positions, tmp_path),
        drive_python(write_wall(scene, "python", max_force=limit), positions),
    ):
        np.testing.assert_allclose(forces, np.clip(expected, -limit, limit), rtol=0, atol=TOLERANCE * limit)
    recommendation = scene.recommend(stiffness_fraction=0.5)
    assert recommendation.code(max_force="3 N") == recommendation.code(max_force=3) != recommendation.code()
    assert "Force limited to 3.000 N." in recommendation.code(max_force=3)
    with pytest.raises(zwidth.InputError, match=r"^max_force: got 0"):
        recommendation.code(max_force=0)


def test_code_of_recommendation_returns_its_stiffness():
    recommendation = make_scene("low-pass").recommend(stiffness_fraction=0.5)
    text = recommendation.code("python")
    force = drive_python(text, np.array([1e-3]))
    assert force[0] == pytest.approx(-recommendation.stiffness * 1e-3, rel=1e-14)
    with pytest.raises(zwidth.InputError, match="language: got 'java'"):
        recommendation.code("java")  # pyright: ignore[reportArgumentType]


def test_code_without_recommended_wall_is_rejected():
    undamped = zwidth.Scene(zwidth.Device(0.1, 0.0), zwidth.Timing(1e-3, 1e-3))
    with pytest.raises(zwidth.InputError, match="code: there is no wall: no passive wall exists"):
        undamped.recommend(passive=True).code()


@pytest.mark.parametrize("name", ESTIMATES)
def test_filter_sections_multiply_to_the_estimate(name):
    """Compare the product of the sections, from their coefficients, with the frequency response of the estimate."""
    estimate = ESTIMATES[name].estimate(1e-3)
    w = np.linspace(0.05, 3.1, 50)
    zeta = np.exp(1j * w) - 1.0
    value = estimate.gain * np.ones(50, complex)
    for numerator, denominator in find_sections(estimate):
        assert len(numerator) == len(denominator)
        value *= np.polyval(numerator, zeta) / np.polyval(denominator, zeta)
    if estimate.window:
        value *= (1.0 - np.exp(-1j * w * estimate.window)) / estimate.window
    np.testing.assert_allclose(value, estimate.jet(circle_points(w)).value, rtol=1e-11)
