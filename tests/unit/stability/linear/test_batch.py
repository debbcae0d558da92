"""Counts along lines of walls of a batch of loops: equal to computed poles, and equal in NumPy and JAX."""

from __future__ import annotations

import numpy as np
import pytest

from zwidth import Coupling, Device, LinearDevice, LowPass, Mode, Scene, Timing
from zwidth.model.mechanism import build_chain
from zwidth.model.parameter_paths import fill_parameters
from zwidth.stability.linear.batch_devices import build_loops
from zwidth.stability.linear.batch_lines import Line, count_outside, find_crossings
from zwidth.stability.linear.loop_batch import LoopBatch, Sizes, count_nodes, evaluate, sample
from zwidth.stability.linear.poles import compute_poles_minus_one, log_modulus

SIZE = 16
SCENES = {
    "rigid": Scene(Device(0.1, 10), Timing(1e-3, 1.5e-3), velocity=LowPass(cutoff=100)),
    "mode": Scene(Device(0.1, 10, modes=[Mode(120, 0.02, 0.5)]), Timing(1e-3, 1e-3), velocity=LowPass(cutoff=100)),
    "coupling": Scene(Device(0.1, 10, coupling=Coupling(0.05, 2e4, 2.0)), Timing(1e-3, 0.3e-3)),
}


def make_batch(scene):
    """Return a batch of loops with random masses and dampings, its sizes, and the single scenes."""
    generator = np.random.default_rng(2)
    values = {"mass": generator.uniform(0.05, 0.5, SIZE), "damping": generator.uniform(1, 40, SIZE)}
    filled = fill_parameters(scene, values)
    batch = build_loops(build_chain(filled, (scene.d, scene.integer_delay)), SIZE)
    sizes = Sizes(*count_nodes(batch.form, batch.loop).max(1).tolist())
    singles = [scene.replace(**{name: float(column[k]) for name, column in values.items()}) for k in range(SIZE)]
    return batch, sizes, singles


@pytest.mark.parametrize("name", SCENES)
def test_q_and_f_equal_those_of_single_loops(name):
    batch, _, singles = make_batch(SCENES[name])
    w = np.linspace(0.05, 3.1, SIZE)
    values = evaluate(batch.form, batch.loop, w)
    for k, single in enumerate(singles):
        alpha, beta = single.loop.critical_walls(w[k : k + 1])
        wall = alpha + beta * values.f[k]
        np.testing.assert_allclose(wall, values.q[k], rtol=1e-8)


@pytest.mark.parametrize("name", SCENES)
def test_counts_of_walls_equal_computed_poles(name):
    batch, sizes, singles = make_batch(SCENES[name])
    loops, generator = sample(batch.form, batch.loop, sizes), np.random.default_rng(3)
    for _ in range(5):
        alpha, beta = 10 ** generator.uniform(-3, 1, SIZE), generator.uniform(-0.3, 2.0, SIZE)
        with np.errstate(all="ignore"):
            outside, doubtful = count_outside(loops, alpha, beta)
        for k, single in enumerate(singles):
            poles = compute_poles_minus_one(single.loop.roots, alpha[k : k + 1], beta[k : k + 1])
            assert doubtful[k] or outside[k] == np.sum(log_modulus(poles) > 0)
        assert np.mean(doubtful) < 0.1


def test_two_crossings_between_neighboring_nodes_are_found():
    batch, sizes, singles = make_batch(SCENES["rigid"])
    loops = sample(batch.form, batch.loop, sizes)
    # Just below a smooth maximum, a line of constant K crosses the curve twice between two nodes.
    tops = [single.loop.stiffest(True) for single in singles]
    alpha = np.array([float(top.alpha) for top in tops])
    with np.errstate(all="ignore"):
        below, above = (find_crossings(loops, Line(a0=alpha * (1 + shift), b1=1.0)) for shift in (-1e-6, 1e-9))
    smooth = (np.array([int(top.kind) for top in tops]) == 0) & ~below.doubtful
    count = [np.isfinite(each.t).sum(0) for each in (below, above)]
    assert smooth.sum() > 10
    assert not above.doubtful.any()
    np.testing.assert_array_equal(count[0][smooth], count[1][smooth] + 2)


def test_numpy_and_jax_count_the_same():
    jax = pytest.importorskip("jax")
    batch, sizes, _ = make_batch(SCENES["rigid"])
    alpha, beta = np.linspace(0.01, 0.4, SIZE), np.linspace(0.0, 1.0, SIZE)
    expected = count_outside(sample(batch.form, batch.loop, sizes), alpha, beta)
    with jax.enable_x64(True), jax.numpy_rank_promotion("allow"):
        loop = LoopBatch(*map(jax.numpy.asarray, batch.loop))
        count = jax.jit(lambda loop, *wall: count_outside(sample(batch.form, loop, sizes), *wall))
        outside, doubtful = count(loop, *map(jax.numpy.asarray, (alpha, beta)))
        np.testing.assert_array_equal(outside, expected[0])
        np.testing.assert_array_equal(doubtful, expected[1])


def test_a_device_with_negative_static_gain_is_doubtful():
    scene = Scene(LinearDevice(([-1.0], [0.1, 10.0, 500.0])), Timing(1e-3), velocity=LowPass(cutoff=100))
    filled = fill_parameters(scene, {"period": np.full(SIZE, 1e-3)})
    batch = build_loops(build_chain(filled, (0.0, 0)), SIZE)
    loops = sample(batch.form, batch.loop, Sizes(*count_nodes(batch.form, batch.loop).max(1).tolist()))
    assert not loops.resolved.any()
