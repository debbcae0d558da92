"""Test devices that are unstable without a wall, with a stable region at positive K only.

Reference: poles of the discretization by scipy.
"""

import json

import numpy as np
import pytest
import scipy.signal
from click.testing import CliRunner

import zwidth
from zwidth.analysis.assessment import describe_islands
from zwidth.cli import cli
from zwidth.core.status import Status

PENDULUM = ["--device", "1 / 0.1 0.2 -3", "--rate", "1 kHz", "--delay", "1 ms"]


def compute_radius(coefficients, delay, stiffness, damping, period=1e-3):
    """Return the largest pole magnitude with the backward difference, discretized by scipy."""
    *plant, _ = scipy.signal.cont2discrete(([1.0], coefficients), period)
    numerator, denominator = np.trim_zeros(np.ravel(plant[0]), "f"), np.ravel(plant[1])
    wall = np.polyadd(stiffness * np.array([1.0, 0.0]), damping * np.array([1.0, -1.0]) / period)
    device = np.append(np.convolve(denominator, [1.0, 0.0]), np.zeros(delay))
    return np.abs(np.roots(np.polyadd(device, np.convolve(numerator, wall)))).max()


@pytest.mark.parametrize("seed", range(4))
def test_max_stiffness_of_pendulums_matches_scipy_poles(seed):
    rng = np.random.default_rng(seed)
    for delay in (0, 1, 3):
        mass, pull = 10 ** rng.uniform(-2, 0), 10 ** rng.uniform(0, 2)
        coefficients = [mass, rng.uniform(0, 0.5) * np.sqrt(mass * pull), -pull]
        device = zwidth.LinearDevice(([1.0], coefficients))
        scene = zwidth.Scene(device, zwidth.Timing(1e-3, delay * 1e-3))
        top = scene.max_stiffness()
        assert top.status == Status.OK
        K, B = float(top.stiffness), float(top.virtual_damping)
        assert compute_radius(coefficients, delay, 0.9999 * K, B) < 1.0
        assert (
            min(compute_radius(coefficients, delay, 1.001 * K, B * share) for share in np.linspace(0.3, 2.0, 35)) > 1.0
        )
        assert scene.loop.least_stiffness(0.0) * scene.units.stiffness == pytest.approx(pull, rel=1e-9)
        assert (
            min(compute_radius(coefficients, delay, 0.99 * pull, B * share) for share in np.linspace(0.0, 2.0, 41))
            > 1.0
        )
        assert scene.islands() == []
        if delay != (0, 1, 3)[seed % 3]:
            continue  # recommend for one delay per seed, because recommendations take most of the time
        recommendation = scene.recommend()
        assert recommendation.status == Status.OK
        assert compute_radius(coefficients, delay, recommendation.stiffness, recommendation.virtual_damping) < 1.0


def test_commands_report_the_same_maximum_stiffness():
    def run(*arguments):
        result = CliRunner().invoke(cli, [*arguments, "--json"])
        assert result.exit_code == 0, result.output
        return json.loads(result.output)

    checked = run("check", *PENDULUM, "--stiffness", "1 kN/m", "--virtual-damping", "5 N s/m")
    assert checked["stable"]
    assert checked["stiffness_max"] == pytest.approx(14550.5, rel=1e-4)
    assert run("ridge", *PENDULUM)["stiffness_max"] == checked["stiffness_max"]
    advised = run("recommend", *PENDULUM)
    assert 3.0 < advised["recommended"]["stiffness"] < checked["stiffness_max"]
    for notes in (checked["notes"], advised["notes"]):
        assert any("unstable without a wall: no wall softer than K = 3" in note for note in notes)


@pytest.mark.parametrize("pull", [5000])
def test_recommend_finds_wall_in_narrow_stable_stiffness_range(pull):
    """All walls with K below the gravity stiffness are unstable, so a coarse search misses the stable range."""
    coefficients = [0.1, 1.0, -pull]
    device = ["--device", f"1 / 0.1 1 {-pull}", "--rate", "1 kHz", "--delay", "1 ms"]
    for gain in (1.2,):
        result = CliRunner().invoke(cli, ["recommend", *device, "--gain-margin", str(gain), "--json"])
        assert result.exit_code == 0, result.output
        recommended = json.loads(result.stdout)["recommended"]
        K, B = recommended["stiffness"], recommended["virtual_damping"]
        assert all(
            compute_radius(coefficients, 1, share * K, share * B) < 1.0 for share in (1.0, 0.9999 * gain, 1.0001 / gain)
        )
        assert not all(
            compute_radius(coefficients, 1, share * K, share * B) < 1.0 for share in (1.01 * gain, 0.99 / gain)
        )
        # No stiffer wall on a grid satisfies the gain margin.
        for stiffer in np.linspace(1.01 * K, 1.2 * K, 4):
            for damping in np.linspace(0.5 * B, 1.5 * B, 21):
                shares = 1.0, gain, 1.0 / gain
                assert max(compute_radius(coefficients, 1, each * stiffer, each * damping) for each in shares) > 1.0


def test_tolerance_analysis_of_device_unstable_without_wall():
    wall = "--stiffness", "1 kN/m", "--virtual-damping", "5 N s/m", "--tolerance", "delay=10%"
    result = CliRunner().invoke(cli, ["design", *PENDULUM, *wall, "--samples", "40"])
    assert "note       the device is unstable without a wall: no wall softer than K = 3" in result.stdout
    result = CliRunner().invoke(cli, ["design", *PENDULUM, *wall, "--samples", "40", "--json"])
    tolerances = json.loads(result.stdout)["tolerances"]
    assert tolerances["stable"] == 1.0
    # The limit lies between the limits at the shortest and the longest delay.
    scene = zwidth.Scene(zwidth.LinearDevice("1 / 0.1 0.2 -3"), zwidth.Timing(1e-3, 1e-3))
    ends = [float(scene.replace(delay=delay).stable_stiffness(5.0)[0, 1]) for delay in (1.1e-3, 0.9e-3)]
    assert ends[0] <= tolerances["stiffness"] <= ends[1]


def test_grasps_are_not_checked_for_linear_devices():
    assert (
        zwidth.Scene(zwidth.LinearDevice("1 / 0.1 10 50"), zwidth.Timing(1e-3)).recommend().requirements.grasps
        == "none"
    )
    result = CliRunner().invoke(cli, ["recommend", *PENDULUM])
    assert "(not checked in the reference grasps)" in " ".join(result.stdout.split())


def test_describe_islands_is_empty_for_stable_devices():
    assert describe_islands(zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))) == []
    assert describe_islands(zwidth.Scene(zwidth.LinearDevice("1 / 0.1 10 50"), zwidth.Timing(1e-3, 1e-3))) == []


def test_island_of_stable_device_does_not_raise_max_stiffness():
    """The region connected to K = 0 is stable; the island at higher K is separate from it."""
    timing, window = zwidth.Timing(period=1e-3, delay=1e-3), zwidth.WindowedDifference(samples=24)
    scene = zwidth.Scene(zwidth.LinearDevice("1 / 0.1 10 0"), timing, velocity=window)
    (island,) = scene.islands()
    assert island.stiffness == pytest.approx((7537, 9037), rel=1e-3)
    assert scene.max_stiffness().stiffness < island.stiffness[0]
