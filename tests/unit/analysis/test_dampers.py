"""Test `Scene.damper_range`, the stable range of B at K = 0 (pure dampers), against eigenvalues of a state space."""

import numpy as np
import pytest
from any_loop import closed_loop_matrix
from click.testing import CliRunner
from independent_scenes import KINDS, random_scene

import zwidth
from zwidth.cli import cli


def damper_radius(scene, damping):
    """Return the largest pole magnitude at K = 0, excluding the pole next to z = 1 if the device is free."""
    poles = np.linalg.eigvals(closed_loop_matrix(scene, 0.0, damping))
    free = scene.operator is None or scene.operator.stiffness == 0
    return np.abs(np.delete(poles, np.argmin(np.abs(poles - 1.0))) if free else poles).max()


@pytest.mark.parametrize("kind", KINDS)
def test_damper_range_matches_eigenvalues(kind):
    rng = np.random.default_rng(21)
    for _ in range(6):
        scene = random_scene(kind, rng)
        if scene.operator is not None and scene.operator.stiffness:
            scene = scene.replace(**{"operator.stiffness": 0.0})
        ranges = scene.damper_range()
        assert np.all(ranges[:, 1] > ranges[:, 0])
        unit = scene.units.virtual_damping
        # Nearer to the ends, eigenvalues cannot resolve two poles that meet at z = 1.
        offset = 1e-3 * np.ptp(ranges, axis=1)[:, None]
        dampings = np.concatenate([rng.uniform(-0.3, 2.0, 30) * unit, (ranges + offset).ravel()])
        dampings = np.append(dampings, (ranges - offset).ravel())
        inside = np.array([np.any((ranges[:, 0] < damping) & (damping < ranges[:, 1])) for damping in dampings])
        radii = np.array([damper_radius(scene, damping) for damping in dampings])
        clear = np.abs(radii - 1.0) > 1e-10
        np.testing.assert_array_equal(inside[clear], radii[clear] < 1.0)
        assert clear.sum() > 20


@pytest.mark.parametrize(
    "velocity",
    [
        zwidth.VelocityFilter([1000, -1000], [1, 0]),
        zwidth.VelocityFilter([500, 0, -500], [1, 0, 0]),
        zwidth.WindowedDifference(7),
        zwidth.LowPass(cutoff=60, order=2),
        zwidth.Butterworth(90, order=4),
    ],
    ids=str,
)
@pytest.mark.parametrize("delay", [0.0, 0.4e-3, 2e-3])
def test_damper_range_ends_where_the_radius_crosses_one(velocity, delay):
    scene = zwidth.Scene(zwidth.Device(0.1, 4.0), zwidth.Timing(1e-3, delay), velocity=velocity)
    ranges = scene.damper_range()
    assert ranges[0, 0] == pytest.approx(-4.0, rel=1e-9)
    assert damper_radius(scene, ranges[0, 1] * (1 - 1e-6)) < 1.0 < damper_radius(scene, ranges[0, 1] * (1 + 1e-6))


def test_damper_range_of_device_with_ground_spring_equals_stable_damping():
    scene = zwidth.Scene(zwidth.LinearDevice("1 / 0.1 10 500"), zwidth.Timing(1e-3, 1e-3))
    np.testing.assert_allclose(scene.damper_range(), scene.stable_damping(0.0))


def test_check_command_prints_damper_range():
    options = ["--mass", "120 g cm^2", "--damping", "80 uN m s/rad", "--rate", "1 kHz", "--delay", "0.7 ms"]
    damper = ["--stiffness", "0", "--virtual-damping"]
    result = CliRunner().invoke(cli, ["check", *options, *damper, "6.4 mN m s/rad"])
    assert result.exit_code == 0
    text = " ".join(result.output.split())
    assert text.startswith("MARGINAL")
    assert "a pure damper: marginal only because without stiffness no force restores the position" in text
    assert "B from -80.00 µN m s/rad to 12.01 mN m s/rad at this K" in text
    result = CliRunner().invoke(cli, ["check", *options, *damper, "100 mN m s/rad"])
    text = " ".join(result.output.split())
    assert text.startswith("UNSTABLE")
    assert "remedy a pure damper: B from -80.00 µN m s/rad to 12.01 mN m s/rad" in text
