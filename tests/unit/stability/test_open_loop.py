"""Crossovers, pole counts and margins of many loops at once, against eigenvalues, single walls and JAX."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from any_loop import KINDS, closed_loop_matrix, random_scene
from compiling import QUICKLY

import zwidth
from zwidth.core.xp import namespace
from zwidth.model.circle_functions import Jet
from zwidth.stability.linear.delay_margin import count_outside
from zwidth.stability.linear.margins import tabulate
from zwidth.stability.open_loop import (
    OpenLoop,
    find_gain_crossovers,
    find_nearest_angle,
    find_phase_crossovers,
    select_gain_margin,
    select_phase_margin,
)


def draw_walls(scene, rng, count):
    """Return K and B of random walls around the stiffest stable one."""
    top, unit = scene.max_stiffness(), scene.units
    stiffness = float(top.stiffness) if top.status == 0 else 0.1 * float(unit.stiffness)
    damping = abs(float(np.nan_to_num(top.virtual_damping))) + 0.1 * float(unit.virtual_damping)
    return stiffness * 10.0 ** rng.uniform(-2, 0.3, count), damping * rng.uniform(-0.2, 1.5, count)


@pytest.mark.parametrize("kind", KINDS)
def test_counts_of_unstable_poles_agree_with_eigenvalues(kind):
    rng = np.random.default_rng(11)
    for _ in range(4):
        scene = random_scene(kind, rng)
        K, B = draw_walls(scene, rng, 40)
        radii = np.array(
            [np.abs(np.linalg.eigvals(closed_loop_matrix(scene, *wall))) for wall in zip(K, B, strict=True)]
        )
        alpha, beta = scene.normalize_walls(K, B)
        walls = tabulate(scene.loop.roots, alpha, beta, scene.loop.boundary.w)
        with np.errstate(all="ignore"):
            counts = count_outside(scene.loop.roots, walls, find_gain_crossovers(walls), alpha, beta)
        # Leave out walls within the rounding errors of the eigenvalues.
        clear = np.abs(radii - 1.0).min(1) > 1e-7
        assert clear.sum() > 30
        np.testing.assert_array_equal(counts[clear], (radii > 1.0).sum(1)[clear])


@pytest.mark.parametrize("kind", ["filter", "all", "driven"])
def test_margins_of_many_walls_equal_those_of_single_walls(kind):
    rng = np.random.default_rng(12)
    scene = random_scene(kind, rng)
    K, B = draw_walls(scene, rng, 12)
    many = np.array(scene.margins(K.reshape(3, 4), B.reshape(3, 4)))
    assert many.shape == (7, 3, 4)
    single = np.array([scene.margins(*wall) for wall in zip(K.tolist(), B.tolist(), strict=True)])
    np.testing.assert_allclose(many.reshape(7, -1).T, single, rtol=1e-9)


def evaluate_integrator(w):
    """Return ``L = g e^(-j d w)/(j w)`` and its derivative, for two gains g and the delay d = 3."""
    xp = namespace(w)
    with np.errstate(invalid="ignore"):
        value = xp.asarray([[0.4], [0.01]]) * (xp.cos(3.0 * w) - 1j * xp.sin(3.0 * w)) / (1j * w)
        return Jet(value, value * (-3j - 1.0 / w))


def test_crossovers_of_a_delayed_integrator(x64):
    w = np.broadcast_to(np.concatenate([np.geomspace(1e-3, 0.1, 60), np.linspace(0.1, np.pi, 90)[1:]]), (2, 149))
    loop = OpenLoop(evaluate_integrator, w, evaluate_integrator(w))
    gain, phase = find_gain_crossovers(loop), find_phase_crossovers(loop)
    at_gain, at_phase = (evaluate_integrator(w).value for w in (gain, phase))
    margin, crossover = select_gain_margin(np.array([True, True]), phase, abs(at_phase))
    degrees, _ = select_phase_margin(np.array([True, False]), gain, np.angle(-at_gain))
    np.testing.assert_allclose(gain[:, 0], [0.4, 0.01], rtol=1e-13)
    assert np.isnan(gain[:, 1:]).all()
    # arg L = -pi/2 - 3 w is -pi at pi/6 and -3 pi at 5 pi/6.
    np.testing.assert_allclose(phase[:, :1], np.pi / 6, rtol=1e-12)
    np.testing.assert_allclose(margin, np.pi / 6 / np.array([0.4, 0.01]), rtol=1e-12)
    np.testing.assert_allclose(crossover, np.pi / 6, rtol=1e-12)
    np.testing.assert_allclose(degrees, np.degrees([np.pi / 2 - 1.2, -(np.pi / 2 - 0.03)]), rtol=1e-12)
    dense = np.linspace(1e-3, np.pi, 400_001)
    nearest = dense[abs(1.0 + evaluate_integrator(dense).value).argmin(1)]
    square = abs(1.0 + loop.L.value) ** 2
    find = jax.jit(partial(find_nearest_angle, evaluate_integrator), compiler_options=QUICKLY)
    np.testing.assert_allclose(find_nearest_angle(evaluate_integrator, w, square), nearest, atol=1e-5)
    np.testing.assert_allclose(find(jnp.asarray(w), jnp.asarray(square)), nearest, atol=1e-5)


def test_best_damping_maximizes_the_modulus_margin():
    scene = zwidth.Scene(zwidth.Device(0.1, 3.0), zwidth.Timing(1e-3, 1e-3), velocity=zwidth.LowPass(cutoff=100))
    best = scene.best_damping(1e3, goal="robust")
    margins = scene.margins(1e3, best.virtual_damping * np.array([1.0, 0.99, 1.01])).modulus_margin
    assert best.modulus_margin == pytest.approx(margins[0], rel=1e-12)
    assert (margins[1:] < margins[0]).all()
