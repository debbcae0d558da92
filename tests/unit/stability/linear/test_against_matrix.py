"""Poles, zeros and stable intervals of random scenes, against a state matrix in absolute coordinates
(oracles/any_loop).
"""

from __future__ import annotations

from itertools import pairwise

import any_loop
import numpy as np
import proved_loop
import pytest
from scipy.optimize import linear_sum_assignment

import zwidth
from zwidth.stability.linear.curve import evaluate_curve
from zwidth.stability.linear.poles import compute_poles_minus_one

SCENES = 6
POLE = 1e-12  # distance between a pole and the pole certified in balls
MISSED = 1e-15  # or: relative change of the loop that makes the computed pole exact
ZERO = 1e-12  # relative error of zeros; those that nearly cancel poles lose 3 of 16 digits in float64
END = 1e-9  # relative error of an interval's end, because alpha is a difference


def scenes(kind: str, seed: int, count: int = SCENES) -> list[zwidth.Scene]:
    generator = np.random.default_rng(seed)
    return [any_loop.random_scene(kind, generator) for _ in range(count)]


def draw_walls(scene: zwidth.Scene, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return normalized walls, some random, others next to the boundary at a relative distance of 1e-9 to 1e-2."""
    curve = evaluate_curve(scene.loop.roots, generator.choice(scene.loop.boundary.w, 15))
    side = 10 ** generator.uniform(-9, -2, 15) * generator.choice([-1.0, 1.0], 15)
    fine = (np.abs(curve.alpha) < 1e6) & (np.abs(curve.beta) < 1e6) & (np.abs(curve.alpha) > 1e-6)
    alpha = 10 ** generator.uniform(-4, 1, 10) * generator.choice([1.0, 1.0, -0.1], 10)
    beta = generator.uniform(-1, 1.5, 10) * generator.choice([0.1, 1.0, 0.01], 10)
    return np.concatenate([alpha, (curve.alpha * (1 + side))[fine]]), np.concatenate([beta, curve.beta[fine]])


@pytest.mark.parametrize("kind", any_loop.KINDS)
def test_number_of_unstable_poles_agrees_with_the_matrix(kind):
    generator, undecided, compared = np.random.default_rng(11), 0, 0
    for scene in scenes(kind, 10):
        units = scene.units
        walls = draw_walls(scene, generator)
        for alpha, beta, outside in zip(*walls, scene.loop.boundary.count_outside(*walls), strict=True):
            wall = alpha * units.stiffness, beta * units.virtual_damping
            sizes = np.abs(np.linalg.eigvals(any_loop.closed_loop_matrix(scene, *wall)))
            expected: int | None = int(np.sum(sizes > 1))
            if expected != outside:
                expected = proved_loop.count_outside(scene, *wall)
            undecided += expected is None
            compared += 1
            assert expected is None or outside == expected, (scene, wall)
    # Undecided are open-loop poles of an undamped device that no wall moves.
    assert undecided < 0.02 * compared


@pytest.mark.parametrize("kind", any_loop.KINDS)
def test_poles_agree_with_certified_poles(kind):
    generator, compared = np.random.default_rng(21), 0
    for scene in scenes(kind, 20, 40):
        alpha, beta = 10 ** generator.uniform(-3, 0), 10 ** generator.uniform(-2, 0) * generator.choice([0.0, 1.0, 1.0])
        wall = alpha * scene.units.stiffness, beta * scene.units.virtual_damping
        computed = compute_poles_minus_one(scene.loop.roots, np.array([alpha]), np.array([beta]))[0]
        try:
            expected, missed = proved_loop.proved_poles(scene, *wall, computed)
        except ValueError:
            # Skip multiple poles, of a low-pass filter that has no effect without virtual damping.
            continue
        distance = np.abs(computed[:, None] - expected)
        matched, other = linear_sum_assignment(distance)
        # Clustered poles are ill-conditioned: accept those that are exact poles of a nearby loop.
        right = (distance[matched, other] < POLE) | (missed[matched] < MISSED)
        assert right.all(), (scene, wall)
        # The certified poles exclude those at exactly 0.
        assert expected.size == matched.size
        assert np.all(np.abs(1.0 + np.delete(computed, matched)) < 1e-3), (scene, wall)
        compared += matched.size
    assert compared > 150


@pytest.mark.parametrize("stiffness", [1e-14, 1e-11, 1e-8, 1e-5, 1e-2])
@pytest.mark.parametrize("sensor", ["motor", "tip"])
def test_zeros_near_soft_modes_are_accurate(sensor, stiffness):
    generator, period = np.random.default_rng(41), 1e-3
    for _ in range(12):
        spring, mass, damped = stiffness / period**2, 10 ** generator.uniform(-1, 1.5), generator.choice([0.0, 0.1])
        damping = damped * np.sqrt(spring * mass)
        device = zwidth.Device(1.0, generator.choice([0.0, 10.0]), zwidth.Coupling(mass, spring, damping, sensor))
        link = {"coupling_stiffness": spring * 10 ** generator.uniform(-2, 2)}
        grounded = zwidth.Operator(3.0, damping, spring * 1e-3, **link)
        hand = grounded if generator.random() < 0.5 else None
        scene = zwidth.Scene(device, zwidth.Timing(period, generator.choice([0, 1, 0.4]) * period), operator=hand)
        expected = proved_loop.proved_zeros(scene)
        distance = np.abs(-scene.loop.roots.zeros[:, None] - expected) / np.abs(expected)
        matched, other = linear_sum_assignment(distance)
        assert matched.size == expected.size == scene.loop.roots.zeros.size
        assert distance[matched, other].max() < ZERO, scene


@pytest.mark.parametrize("kind", any_loop.KINDS)
def test_stable_stiffness_intervals_agree_with_matrix_crossings(kind):
    generator = np.random.default_rng(31)
    compared = 0
    for scene in scenes(kind, 30, 6):
        units = scene.units
        for beta in generator.choice([-0.03, 0.0, 0.02, 0.1, 0.4], 2, replace=False):
            damping = float(beta * units.virtual_damping + scene.damping * 0.01)
            intervals = scene.stable_stiffness(damping)
            crossings, _ = any_loop.row_ends(scene, damping)
            crossings = np.sort(crossings)
            size = np.max(np.abs(intervals), initial=0.0, where=np.isfinite(intervals)) or units.stiffness
            cuts = crossings[np.abs(crossings) < 3 * size]
            cuts = np.concatenate([[-size], cuts, [3 * size]]) if cuts.size else np.array([-size, 3 * size])
            for low, high in pairwise(cuts):
                if high - low < 1e-6 * size:
                    continue
                middle = 0.5 * (low + high)
                radius = any_loop.spectral_radius(scene, middle, damping)
                if abs(radius - 1) < 1e-8:
                    continue
                inside = np.any((middle > intervals[:, 0]) & (middle < intervals[:, 1]))
                assert inside == (radius < 1), (scene, damping, middle)
                compared += 1
            for end in intervals[np.isfinite(intervals)]:
                assert np.abs(crossings - end).min() <= END * size, (scene, damping, end)
    assert compared > 20
