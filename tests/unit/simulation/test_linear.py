"""Without friction, rounding and limits a simulation is the linear loop, whose poles are found here by other means."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from any_loop import closed_loop_matrix
from independent_scenes import KINDS, random_scene
from tolerances import GROWTH_SIMULATED, SIMULATED_LINEAR

import zwidth

MOST = 4000


@cache
def draw_edges(kind: str) -> Any:
    """Ten scenes, a virtual damping each, and the upper end of a stable interval: the same for all who ask.

    Programs are compiled for a number of lanes and for the longest window among them; who asks for these scenes and two
    walls each shares one.
    """
    rng, found = np.random.default_rng(KINDS.index(kind)), []
    while len(found) < 10:
        scene = random_scene(kind, rng)
        damping = float(rng.uniform(-0.05, 0.3) * scene.units.virtual_damping)
        intervals = scene.stable_stiffness(damping)
        if intervals.size and intervals[-1, 1] > 0 and intervals[-1, 0] < 0.98 * intervals[-1, 1] < np.inf:
            found.append((scene, damping, intervals[-1, 1]))
    return tuple(np.array(column) for column in zip(*found, strict=True))


def plan_measure(poles):
    """After how many periods the other poles have gone, between which samples a turn is seen, and how many poles."""
    poles = poles[np.argsort(-np.abs(poles))]
    sizes = np.abs(poles)
    pair = 2 if poles[0].imag else 1
    stride = max(1, round(0.5 * np.pi / abs(np.angle(poles[0])))) if pair == 2 else 1
    needed = np.log(1e-10) / np.log(np.append(sizes[pair:], 0.0)[0] / sizes[0] + 1e-300)
    begin = int(min(needed + 8, MOST - 12 * stride - 1))
    return begin, stride, pair + np.sum((sizes[pair:] / sizes[0]) ** begin > 1e-10)


def measure_growth(positions, begin, stride, order):
    """The largest pole by linear prediction from samples so far apart, each row in its own scale."""
    starts = np.unique(np.linspace(begin, begin + (12 - order) * stride, 40).astype(int))
    rows = np.stack([positions[starts + stride * j] for j in range(order + 1)], 1)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    ahead = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
    return np.abs(np.roots(np.append(1.0, -ahead[::-1]))).max() ** (1.0 / stride)


@pytest.mark.parametrize("kind", KINDS)
def test_motion_decays_below_the_boundary_and_grows_above_at_the_predicted_rate(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    scenes, damping, end = draw_edges(kind)
    stiffness = np.stack([0.98 * end, 1.02 * end])
    period = np.array([scene.timing.period for scene in scenes])
    motion = zwidth.simulate(
        scenes,
        stiffness,
        damping,
        periods=MOST,
        start_position=rng.uniform(-1e-3, 1e-3, end.size),
        start_velocity=rng.uniform(-1e-3, 1e-3, end.size) / period,
    )
    for place, positions in enumerate(np.moveaxis(motion.position, 1, 0)):
        scene, B = scenes[place], damping[place]
        for K, seen, grows in zip(stiffness[:, place], positions, (False, True), strict=True):
            poles = np.linalg.eigvals(closed_loop_matrix(scene, K, B))
            growth = measure_growth(seen, *plan_measure(poles))
            assert (growth > 1.0) == grows
            assert growth == pytest.approx(np.abs(poles).max(), rel=GROWTH_SIMULATED.float64)
            assert growth == pytest.approx(float(scene.spectral_radius(K, B)), rel=GROWTH_SIMULATED.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_every_sample_is_that_of_the_closed_loop_matrix(kind):
    """The whole motion, not its rate alone: from a start at rest away from the wall's surface."""
    scenes, _, _ = draw_edges(kind)
    units = np.array([[scene.units.stiffness, scene.units.virtual_damping] for scene in scenes])
    walls = np.array([0.02, 0.05])[:, None, None] * units
    motion = zwidth.simulate(scenes, *np.moveaxis(walls, -1, 0), start_position=1e-3, periods=60)
    for place in np.ndindex(walls.shape[:2]):
        scene, wall = scenes[place[1]], walls[place]
        matrix = closed_loop_matrix(scene, *wall)
        bodies = 1 + (scene.device.coupling is not None)
        bodies += scene.operator is not None and not scene.operator.rigid
        state = np.zeros(len(matrix))
        state[:bodies] = 1e-3
        # The filter has seen that position forever; its states hang on positions alone.
        order = len(matrix) - 2 * bodies - scene.integer_delay - (scene.d > scene.integer_delay)
        own = slice(2 * bodies, 2 * bodies + order)
        state[own] = np.linalg.solve(np.eye(order) - matrix[own, own], matrix[own, : 2 * bodies] @ state[: 2 * bodies])
        sensor = int(scene.device.coupling is not None and scene.device.coupling.sensor == "tip")
        expected = np.array([state := matrix @ state if k else state for k in range(60)])
        close = SIMULATED_LINEAR.float64 * np.abs(expected[:, :bodies]).max()
        assert motion.position[place] == pytest.approx(expected[:, 0], rel=0, abs=close)
        assert motion.measured[place] == pytest.approx(expected[:, sensor], rel=0, abs=close)
