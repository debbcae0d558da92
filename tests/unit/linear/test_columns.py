"""Stable intervals of the damping at a stiffness, against eigenvalues of an independent closed loop."""

import numpy as np
import pytest

import zwidth
from independent_scenes import KINDS, closed_loop_matrix, random_scene, random_walls
from zwidth.linear.columns import stable_dampings


@pytest.mark.parametrize("seed", range(28))
def test_columns_agree_with_eigenvalues(seed):
    rng = np.random.default_rng([seed, 5])
    scene = random_scene(KINDS[seed % len(KINDS)], rng)
    K, B = random_walls(scene, rng, 4)
    unit = scene.units.virtual_damping
    for stiffness in K[:2]:
        found = stable_dampings(scene.traced_boundary, stiffness / scene.units.stiffness) * unit
        shares = np.array([-0.01, 0.003, 0.5, 0.997, 1.01])
        tried = np.concatenate([B, *(low + (high - low) * shares for low, high in found)])
        inside = ((tried[:, None] > found[:, 0]) & (tried[:, None] < found[:, 1])).any(1)
        poles = [np.linalg.eigvals(closed_loop_matrix(scene, stiffness, damping)) for damping in tried]
        radius = np.abs(poles).max(1)
        told = np.abs(radius - 1) > 1e-7
        assert told.sum() >= 3
        assert np.array_equal(inside[told], radius[told] < 1)


def test_a_rigid_column_is_the_closed_form_s():
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3), zwidth.VirtualWall(10e3, 40))
    verdict = zwidth.assess(scene)
    assert isinstance(verdict, zwidth.Assessment)
    ((low, high),) = stable_dampings(scene.traced_boundary, scene.alpha) * scene.units.virtual_damping
    assert low == pytest.approx(verdict.virtual_damping_lower, rel=1e-9)
    assert high == pytest.approx(verdict.virtual_damping_upper, rel=1e-9)


@pytest.mark.parametrize("alpha", [0.3, 5.0, np.nan, np.inf])
def test_a_column_beyond_the_stable_set_is_empty(alpha):
    scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3, 1e-3))
    assert stable_dampings(scene.traced_boundary, alpha).shape == (0, 2)
