"""Random scenes of every part against a state matrix in absolute coordinates (tests/oracles/any_loop.py)."""

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
# Poles against balls: their distance, or how far from this loop one is that has them.
POLE, MISSED = 1e-12, 1e-15
# Zeros relative to themselves: float64 takes 3 of 16 digits from those that nearly cancel poles.
ZERO = 1e-12
# The end of an interval against a bisected scan: what is left of 16 digits after alpha is a difference.
END = 1e-9


def scenes(kind: str, seed: int, count: int = SCENES) -> list[zwidth.Scene]:
    generator = np.random.default_rng(seed)
    return [any_loop.random_scene(kind, generator) for _ in range(count)]


def walls_of(scene: zwidth.Scene, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Normalized walls anywhere, and beside the curve at a relative distance of 1e-9 to 1e-2."""
    curve = evaluate_curve(scene.loop.roots, generator.choice(scene.loop.boundary.w, 15))
    side = 10 ** generator.uniform(-9, -2, 15) * generator.choice([-1.0, 1.0], 15)
    fine = (np.abs(curve.alpha) < 1e6) & (np.abs(curve.beta) < 1e6) & (np.abs(curve.alpha) > 1e-6)
    alpha = 10 ** generator.uniform(-4, 1, 10) * generator.choice([1.0, 1.0, -0.1], 10)
    beta = generator.uniform(-1, 1.5, 10) * generator.choice([0.1, 1.0, 0.01], 10)
    return np.concatenate([alpha, (curve.alpha * (1 + side))[fine]]), np.concatenate([beta, curve.beta[fine]])


@pytest.mark.parametrize("kind", any_loop.KINDS)
def test_poles_outside_are_those_of_the_matrix(kind):
    generator, units_apart, judged = np.random.default_rng(11), 0, 0
    for scene in scenes(kind, 10):
        units = scene.units
        walls = walls_of(scene, generator)
        for alpha, beta, outside in zip(*walls, scene.loop.boundary.count_outside(*walls), strict=True):
            wall = alpha * units.stiffness, beta * units.virtual_damping
            sizes = np.abs(np.linalg.eigvals(any_loop.closed_loop_matrix(scene, *wall)))
            expected: int | None = int(np.sum(sizes > 1))
            if expected != outside:
                expected = proved_loop.count_outside(scene, *wall)
            units_apart += expected is None
            judged += 1
            assert expected is None or outside == expected, (scene, wall)
    # Undecided: an open-loop pole of an undamped device that the wall does not move.
    assert units_apart < 0.02 * judged


@pytest.mark.parametrize("kind", any_loop.KINDS)
def test_poles_are_proved_ones(kind):
    generator, compared = np.random.default_rng(21), 0
    for scene in scenes(kind, 20, 40):
        alpha, beta = 10 ** generator.uniform(-3, 0), 10 ** generator.uniform(-2, 0) * generator.choice([0.0, 1.0, 1.0])
        wall = alpha * scene.units.stiffness, beta * scene.units.virtual_damping
        found = compute_poles_minus_one(scene.loop.roots, np.array([alpha]), np.array([beta]))[0]
        try:
            expected, missed = proved_loop.proved_poles(scene, *wall, found)
        except ValueError:
            # A multiple pole, of a low-pass that a wall without damping leaves alone.
            continue
        distance = np.abs(found[:, None] - expected)
        own, other = linear_sum_assignment(distance)
        # Of poles next to each other no more can be asked than that a loop next to this one has them.
        right = (distance[own, other] < POLE) | (missed[own] < MISSED)
        assert right.all(), (scene, wall)
        # Those at 0 exactly are left out by the balls.
        assert expected.size == own.size
        assert np.all(np.abs(1.0 + np.delete(found, own)) < 1e-3), (scene, wall)
        compared += own.size
    assert compared > 150


@pytest.mark.parametrize("stiffness", [1e-14, 1e-11, 1e-8, 1e-5, 1e-2])
@pytest.mark.parametrize("sensor", ["motor", "tip"])
def test_zeros_beside_soft_modes_keep_their_digits(sensor, stiffness):
    generator, period = np.random.default_rng(41), 1e-3
    for _ in range(12):
        spring, mass, damped = stiffness / period**2, 10 ** generator.uniform(-1, 1.5), generator.choice([0.0, 0.1])
        damping = damped * np.sqrt(spring * mass)
        device = zwidth.Device(1.0, generator.choice([0.0, 10.0]), zwidth.Coupling(mass, spring, damping, sensor))
        behind = {"coupling_stiffness": spring * 10 ** generator.uniform(-2, 2)}
        held = zwidth.Operator(3.0, damping, spring * 1e-3, **behind)
        hand = held if generator.random() < 0.5 else None
        scene = zwidth.Scene(device, zwidth.Timing(period, generator.choice([0, 1, 0.4]) * period), operator=hand)
        expected = proved_loop.proved_zeros(scene)
        distance = np.abs(-scene.loop.roots.zeros[:, None] - expected) / np.abs(expected)
        own, other = linear_sum_assignment(distance)
        assert own.size == expected.size == scene.loop.roots.zeros.size
        assert distance[own, other].max() < ZERO, scene


@pytest.mark.parametrize("kind", any_loop.KINDS)
def test_intervals_of_rows_are_those_of_a_dense_scan(kind):
    generator = np.random.default_rng(31)
    compared = 0
    for scene in scenes(kind, 30, 6):
        units = scene.units
        for beta in generator.choice([-0.03, 0.0, 0.02, 0.1, 0.4], 2, replace=False):
            damping = float(beta * units.virtual_damping + scene.damping * 0.01)
            ours = scene.stable_stiffness(damping)
            crossings, _ = any_loop.row_ends(scene, damping)
            crossings = np.sort(crossings)
            size = np.max(np.abs(ours), initial=0.0, where=np.isfinite(ours)) or units.stiffness
            cuts = crossings[np.abs(crossings) < 3 * size]
            cuts = np.concatenate([[-size], cuts, [3 * size]]) if cuts.size else np.array([-size, 3 * size])
            for low, high in pairwise(cuts):
                if high - low < 1e-6 * size:
                    continue
                middle = 0.5 * (low + high)
                radius = any_loop.spectral_radius(scene, middle, damping)
                if abs(radius - 1) < 1e-8:
                    continue
                inside = np.any((middle > ours[:, 0]) & (middle < ours[:, 1]))
                assert inside == (radius < 1), (scene, damping, middle)
                compared += 1
            for end in ours[np.isfinite(ours)]:
                assert np.abs(crossings - end).min() <= END * size, (scene, damping, end)
    assert compared > 20
