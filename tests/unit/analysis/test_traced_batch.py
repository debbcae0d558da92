"""Batches of scenes under `jax.vmap`: equal to direct calls for each scene."""

from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import zwidth
from zwidth import Coupling, Device, LowPass, Mode, Operator, Scene, Status, Timing, VirtualWall
from zwidth.analysis import traced_batch

FILTERED = Scene(Device(0.1, 10), Timing(1e-3, "1 ms"), VirtualWall("5 kN/m", 15), LowPass(cutoff="100 Hz"))
SCENES = {
    "filtered": FILTERED,
    "periods": FILTERED.replace(timing=Timing(1e-3, "1.5 periods")),
    "no wall": Scene(Device("100 g", 10), Timing(rate=1000), velocity=LowPass(cutoff=100)),
    "mode": FILTERED.replace(device=Device(0.1, 10, modes=[Mode(120, 0.02, 0.5)])),
    "rigid hand": FILTERED.replace(operator=Operator(0.5, 6, 0)),
    "hand": FILTERED.replace(device=Device(0.1, 10, Coupling(0.05, 2e4, 2)), operator=Operator(0.5, 6, 130, 1e3, 5)),
}
COUNT = 40


def vary(scene, seed=1):
    """Return one scene object with arrays of random numbers as leaves, and the list of the single scenes."""
    factors = np.random.default_rng(seed).uniform(0.8, 1.25, (len(jax.tree.leaves(scene)), COUNT))
    leaves = [leaf * row for leaf, row in zip(jax.tree.leaves(scene), factors, strict=True)]
    structure = jax.tree.structure(scene)
    return structure.unflatten(map(jnp.asarray, leaves)), [
        structure.unflatten([float(leaf[k]) for leaf in leaves])._rebuild() for k in range(COUNT)
    ]


@pytest.mark.parametrize("name", SCENES)
def test_stiffest_walls_equal_direct_calls(name, x64):
    many, singles = vary(SCENES[name])
    with mock.patch.object(traced_batch.LeafVariants, "build") as single:
        walls = jax.jit(jax.vmap(lambda scene: scene.max_stiffness()))(many)
        assert single.call_count < 4
    for k in range(0, COUNT, 5):
        top = singles[k].max_stiffness()
        np.testing.assert_allclose(walls.stiffness[k], top.stiffness, rtol=1e-9)
        np.testing.assert_allclose(walls.virtual_damping[k], top.virtual_damping, rtol=1e-6)
        np.testing.assert_allclose(walls.frequency[k], top.frequency, rtol=1e-6)
        assert (walls.kind[k], walls.status[k]) == (top.kind, top.status)


@pytest.mark.parametrize("name", SCENES)
def test_labels_equal_direct_calls(name, x64):
    many, singles = vary(SCENES[name])
    K = np.geomspace(1e3, 1e5, COUNT)
    labels = jax.vmap(lambda scene, K: scene.is_stable(K, 15.0))(many, K)
    expected = [bool(scene.is_stable(float(k), 15.0)) for scene, k in zip(singles, K, strict=True)]
    np.testing.assert_array_equal(labels, expected)
    assert 0 < np.sum(expected) < COUNT


def test_many_walls_per_scene_are_labeled_scene_by_scene(x64):
    many, singles = vary(FILTERED)
    K = np.linspace(1e3, 20e3, 30)
    labels = jax.vmap(lambda scene: scene.is_stable(K, 15.0))(many)
    np.testing.assert_array_equal(labels, [scene.is_stable(K, 15.0) for scene in singles])


def test_invalid_scenes_do_not_affect_the_others(x64):
    many, singles = vary(FILTERED)
    leaves, structure = jax.tree.flatten(many)
    leaves = np.array(leaves)
    # The leaves are m, b, T, t_d, K, B and the cutoff.
    for leaf, k, value in ((0, 0, -1.0), (0, 3, np.nan), (6, 5, 900.0), (4, 7, np.nan), (4, 8, np.inf)):
        leaves[leaf, k] = value
    changed = structure.unflatten(list(leaves))
    walls, stable = jax.vmap(lambda scene: (scene.max_stiffness(), scene.is_stable(5e3, 15.0)))(changed)
    bad = np.isin(np.arange(COUNT), [0, 3, 5, 7, 8])
    np.testing.assert_array_equal(walls.status == Status.INVALID_INPUT, bad)
    np.testing.assert_array_equal(np.isnan(walls.stiffness), bad)
    expected = [not bad[k] and bool(scene.is_stable(5e3, 15.0)) for k, scene in enumerate(singles)]
    np.testing.assert_array_equal(stable, expected)
    np.testing.assert_allclose(walls.stiffness[20], singles[20].max_stiffness().stiffness, rtol=1e-9)


def test_a_batch_without_valid_scene_is_nan(x64):
    walls = jax.vmap(lambda mass: FILTERED.replace(mass=mass).max_stiffness())(-jnp.arange(1.0, 30.0))
    assert np.all(walls.status == Status.INVALID_INPUT)
    assert np.all(np.isnan(walls.stiffness))


def test_wrong_safe_limits_mark_their_scenes(x64):
    limit = zwidth.SafeLimit(400, 1)
    many, _ = vary(FILTERED.replace(safe_limit=limit))
    limits = np.full(COUNT, 400.0)
    limits[2] = -1.0
    leaves, structure = jax.tree.flatten(many)
    leaves = [limits if np.allclose(leaf, 400.0, rtol=0.3) else leaf for leaf in leaves]
    walls = jax.vmap(lambda scene: scene.max_stiffness())(structure.unflatten(leaves))
    np.testing.assert_array_equal(walls.status == Status.INVALID_INPUT, np.arange(COUNT) == 2)


def test_springs_to_ground_may_be_0_in_some_scenes(x64):
    scene = SCENES["rigid hand"]
    values = np.concatenate([np.zeros(COUNT // 2), np.linspace(1, 500, COUNT // 2)])
    walls = jax.vmap(lambda k: scene.replace(**{"operator.stiffness": k}).max_stiffness())(values)
    for k in (0, COUNT - 1):
        top = scene.replace(**{"operator.stiffness": values[k]}).max_stiffness()
        np.testing.assert_allclose(walls.stiffness[k], top.stiffness, rtol=1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_derivatives_equal_those_of_single_scenes(name, x64):
    many, singles = vary(SCENES[name])

    def maximum(scene):
        wall = scene.max_stiffness()
        return wall.stiffness + 10.0 * wall.virtual_damping

    slopes = jax.vmap(jax.grad(maximum))(many)
    for k in range(0, COUNT, 8):
        expected = jax.grad(maximum)(singles[k])
        sizes = [abs(leaf) for leaf in jax.tree.leaves(singles[k])]
        for got, wanted, size in zip(jax.tree.leaves(slopes), jax.tree.leaves(expected), sizes, strict=True):
            np.testing.assert_allclose(got[k] * size, wanted * size, rtol=1e-6, atol=1e-4)


def test_second_derivatives_of_a_batch_equal_those_of_single_scenes(x64):
    masses = jnp.linspace(0.08, 0.12, 8)
    curvature = jax.grad(jax.grad(lambda mass: FILTERED.replace(mass=mass).max_stiffness().stiffness))
    np.testing.assert_allclose(jax.vmap(curvature)(masses), [curvature(mass) for mass in masses], rtol=1e-6)
