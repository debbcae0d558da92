"""Devices unstable by themselves: every question answers for the stable region that exists."""

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


def radius(coefficients, delay, stiffness, damping, period=1e-3):
    """The largest pole magnitude under the backward difference, with scipy's discretization."""
    *plant, _ = scipy.signal.cont2discrete(([1.0], coefficients), period)
    top, bottom = np.trim_zeros(np.ravel(plant[0]), "f"), np.ravel(plant[1])
    wall = np.polyadd(stiffness * np.array([1.0, 0.0]), damping * np.array([1.0, -1.0]) / period)
    device = np.append(np.convolve(bottom, [1.0, 0.0]), np.zeros(delay))
    return np.abs(np.roots(np.polyadd(device, np.convolve(top, wall)))).max()


@pytest.mark.parametrize("seed", range(4))
def test_the_stiffest_wall_is_that_of_the_stable_region(seed):
    rng = np.random.default_rng(seed)
    for delay in (0, 1, 3):
        mass, pull = 10 ** rng.uniform(-2, 0), 10 ** rng.uniform(0, 2)
        coefficients = [mass, rng.uniform(0, 0.5) * np.sqrt(mass * pull), -pull]
        device = zwidth.LinearDevice(([1.0], coefficients))
        scene = zwidth.Scene(device, zwidth.Timing(1e-3, delay * 1e-3))
        top = scene.max_stiffness()
        assert top.status == Status.OK
        K, B = float(top.stiffness), float(top.virtual_damping)
        assert radius(coefficients, delay, 0.9999 * K, B) < 1.0
        assert min(radius(coefficients, delay, 1.001 * K, B * share) for share in np.linspace(0.3, 2.0, 35)) > 1.0
        assert scene.loop.least_stiffness(0.0) * scene.units.stiffness == pytest.approx(pull, rel=1e-9)
        assert min(radius(coefficients, delay, 0.99 * pull, B * share) for share in np.linspace(0.0, 2.0, 41)) > 1.0
        assert scene.islands() == []
        if delay != (0, 1, 3)[seed % 3]:
            continue  # a recommendation takes most of the time: one delay per seed
        found = scene.recommend()
        assert found.status == Status.OK
        assert radius(coefficients, delay, found.stiffness, found.virtual_damping) < 1.0


def test_commands_agree():
    def run(*arguments):
        found = CliRunner().invoke(cli, [*arguments, "--json"])
        assert found.exit_code == 0, found.output
        return json.loads(found.output)

    checked = run("check", *PENDULUM, "--stiffness", "1 kN/m", "--virtual-damping", "5 N s/m")
    assert checked["stable"]
    assert checked["stiffness_max"] == pytest.approx(14550.5, rel=1e-4)
    assert run("ridge", *PENDULUM)["stiffness_max"] == checked["stiffness_max"]
    advised = run("recommend", *PENDULUM)
    assert 3.0 < advised["recommended"]["stiffness"] < checked["stiffness_max"]
    for notes in (checked["notes"], advised["notes"]):
        assert any("unstable without a wall: no wall softer than K = 3" in note for note in notes)


@pytest.mark.parametrize("pull", [5000])
def test_a_wall_in_a_short_stable_range_of_stiffness_is_found(pull):
    """All walls with K below the gravity stiffness are unstable, so a search that steps over the range finds none."""
    coefficients = [0.1, 1.0, -pull]
    device = ["--device", f"1 / 0.1 1 {-pull}", "--rate", "1 kHz", "--delay", "1 ms"]
    for gain in (1.2,):
        result = CliRunner().invoke(cli, ["recommend", *device, "--gain-margin", str(gain), "--json"])
        assert result.exit_code == 0, result.output
        found = json.loads(result.stdout)["recommended"]
        K, B = found["stiffness"], found["virtual_damping"]
        assert all(radius(coefficients, 1, share * K, share * B) < 1.0 for share in (1.0, 0.9999 * gain, 1.0001 / gain))
        assert not all(radius(coefficients, 1, share * K, share * B) < 1.0 for share in (1.01 * gain, 0.99 / gain))
        # No stiffer wall of a grid has the gain margin.
        for stiffer in np.linspace(1.01 * K, 1.2 * K, 4):
            for damping in np.linspace(0.5 * B, 1.5 * B, 21):
                shares = 1.0, gain, 1.0 / gain
                assert max(radius(coefficients, 1, each * stiffer, each * damping) for each in shares) > 1.0


def test_tolerances_count_walls_of_the_stable_region():
    wall = "--stiffness", "1 kN/m", "--virtual-damping", "5 N s/m", "--tolerance", "delay=10%"
    result = CliRunner().invoke(cli, ["design", *PENDULUM, *wall, "--samples", "40"])
    assert "note       the device is unstable without a wall: no wall softer than K = 3" in result.stdout
    result = CliRunner().invoke(cli, ["design", *PENDULUM, *wall, "--samples", "40", "--json"])
    found = json.loads(result.stdout)["tolerances"]
    assert found["stable"] == 1.0
    # The limit lies between those of the shortest and the longest delay.
    scene = zwidth.Scene(zwidth.LinearDevice("1 / 0.1 0.2 -3"), zwidth.Timing(1e-3, 1e-3))
    ends = [float(scene.replace(delay=delay).stable_stiffness(5.0)[0, 1]) for delay in (1.1e-3, 0.9e-3)]
    assert ends[0] <= found["stiffness"] <= ends[1]


def test_no_grasps_are_required_of_a_device_without_a_mass():
    assert zwidth.Scene(zwidth.LinearDevice("1 / 0.1 10 50"), zwidth.Timing(1e-3)).recommend().wanted.grasps == "none"
    result = CliRunner().invoke(cli, ["recommend", *PENDULUM])
    assert "(not checked in the reference grasps)" in " ".join(result.stdout.split())


def test_a_stable_device_says_nothing():
    assert describe_islands(zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))) == []
    assert describe_islands(zwidth.Scene(zwidth.LinearDevice("1 / 0.1 10 50"), zwidth.Timing(1e-3, 1e-3))) == []


def test_an_island_of_a_stable_device_stays_one():
    """Soft walls are stable: the stiff piece apart from them does not count."""
    timing, window = zwidth.Timing(period=1e-3, delay=1e-3), zwidth.WindowedDifference(samples=24)
    scene = zwidth.Scene(zwidth.LinearDevice("1 / 0.1 10 0"), timing, velocity=window)
    (island,) = scene.islands()
    assert island.stiffness == pytest.approx((7537, 9037), rel=1e-3)
    assert scene.max_stiffness().stiffness < island.stiffness[0]
