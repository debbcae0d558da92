"""Test that simulations without friction, quantization and limits are those of the linear loop.

Reference: closed-loop matrices and their eigenvalues.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest
from any_loop import closed_loop_matrix
from independent_scenes import KINDS, random_scene
from tolerances import GROWTH_SIMULATED, SIMULATED_LINEAR

import zwidth

MAX_PERIODS = 4000


@cache
def draw_boundary_walls(kind: str) -> Any:
    """Return ten scenes, a virtual damping for each, and the upper end of a stable stiffness interval.

    All tests use the same scenes with two walls each, because a program is compiled for each batch size and longest
    window.
    """
    rng, boundary_walls = np.random.default_rng(KINDS.index(kind)), []
    while len(boundary_walls) < 10:
        scene = random_scene(kind, rng)
        damping = float(rng.uniform(-0.05, 0.3) * scene.units.virtual_damping)
        intervals = scene.stable_stiffness(damping)
        if intervals.size and intervals[-1, 1] > 0 and intervals[-1, 0] < 0.98 * intervals[-1, 1] < np.inf:
            boundary_walls.append((scene, damping, intervals[-1, 1]))
    return tuple(np.array(column) for column in zip(*boundary_walls, strict=True))


def plan_measure(poles):
    """Return the first period without the decayed poles, the sampling stride, and the number of remaining poles."""
    poles = poles[np.argsort(-np.abs(poles))]
    sizes = np.abs(poles)
    pair = 2 if poles[0].imag else 1
    stride = max(1, round(0.5 * np.pi / abs(np.angle(poles[0])))) if pair == 2 else 1
    needed = np.log(1e-10) / np.log(np.append(sizes[pair:], 0.0)[0] / sizes[0] + 1e-300)
    begin = int(min(needed + 8, MAX_PERIODS - 12 * stride - 1))
    return begin, stride, pair + np.sum((sizes[pair:] / sizes[0]) ** begin > 1e-10)


def measure_growth(positions, begin, stride, order):
    """Return the largest pole magnitude by linear prediction from samples at a stride, with normalized rows."""
    starts = np.unique(np.linspace(begin, begin + (12 - order) * stride, 40).astype(int))
    rows = np.stack([positions[starts + stride * j] for j in range(order + 1)], 1)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    prediction = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
    return np.abs(np.roots(np.append(1.0, -prediction[::-1]))).max() ** (1.0 / stride)


@pytest.mark.parametrize("kind", KINDS)
def test_motion_grows_or_decays_at_the_rate_of_the_dominant_pole(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    scenes, damping, end = draw_boundary_walls(kind)
    stiffness = np.stack([0.98 * end, 1.02 * end])
    period = np.array([scene.timing.period for scene in scenes])
    motion = zwidth.simulate(
        scenes,
        stiffness,
        damping,
        periods=MAX_PERIODS,
        start_position=rng.uniform(-1e-3, 1e-3, end.size),
        start_velocity=rng.uniform(-1e-3, 1e-3, end.size) / period,
    )
    for entry, positions in enumerate(np.moveaxis(motion.position, 1, 0)):
        scene, B = scenes[entry], damping[entry]
        for K, trajectory, grows in zip(stiffness[:, entry], positions, (False, True), strict=True):
            poles = np.linalg.eigvals(closed_loop_matrix(scene, K, B))
            growth = measure_growth(trajectory, *plan_measure(poles))
            assert (growth > 1.0) == grows
            assert growth == pytest.approx(np.abs(poles).max(), rel=GROWTH_SIMULATED.float64)
            assert growth == pytest.approx(float(scene.spectral_radius(K, B)), rel=GROWTH_SIMULATED.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_every_sample_matches_the_closed_loop_matrix(kind):
    """The motion starts at rest at a distance from the wall surface."""
    scenes, _, _ = draw_boundary_walls(kind)
    units = np.array([[scene.units.stiffness, scene.units.virtual_damping] for scene in scenes])
    walls = np.array([0.02, 0.05])[:, None, None] * units
    motion = zwidth.simulate(scenes, *np.moveaxis(walls, -1, 0), start_position=1e-3, periods=60)
    for entry in np.ndindex(walls.shape[:2]):
        scene, wall = scenes[entry[1]], walls[entry]
        matrix = closed_loop_matrix(scene, *wall)
        bodies = 1 + (scene.device.coupling is not None)
        bodies += scene.operator is not None and not scene.operator.rigid
        state = np.zeros(len(matrix))
        state[:bodies] = 1e-3
        # The filter is in steady state at the start position; its states depend only on positions.
        order = len(matrix) - 2 * bodies - scene.integer_delay - (scene.d > scene.integer_delay)
        filter_states = slice(2 * bodies, 2 * bodies + order)
        state[filter_states] = np.linalg.solve(
            np.eye(order) - matrix[filter_states, filter_states],
            matrix[filter_states, : 2 * bodies] @ state[: 2 * bodies],
        )
        sensor = int(scene.device.coupling is not None and scene.device.coupling.sensor == "tip")
        expected = np.array([state := matrix @ state if k else state for k in range(60)])
        tolerance = SIMULATED_LINEAR.float64 * np.abs(expected[:, :bodies]).max()
        assert motion.position[entry] == pytest.approx(expected[:, 0], rel=0, abs=tolerance)
        assert motion.measured[entry] == pytest.approx(expected[:, sensor], rel=0, abs=tolerance)
