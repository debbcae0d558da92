"""Final states of random responses, against the recorded positions and the linear verdict."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import random_motions

import zwidth
from zwidth.simulation.result import MotionKind

SEED, COUNT, PERIODS = 7, 60, 800
SEGMENTS = 6
LINEAR_VALUES = {"resolution": 0.0, "coulomb": 0.0, "static": 0.0, "max_force": np.inf, "max_rate": np.inf}
"""Parameters of nonlinear components, with their values in a linear loop."""


def draw_motions(linear: bool) -> list[tuple[Any, dict[str, Any]]]:
    """Return random rigid scenes with the arguments of their simulation, half of them on unstable walls."""
    rng = np.random.default_rng([SEED, linear])
    drawn = [random_motions.random_motion("rigid", rng) for _ in range(COUNT)]
    motions = []
    for motion in drawn:
        arguments = dict(motion.arguments) | (LINEAR_VALUES if linear else {})
        arguments.pop("jitter_samples")
        arguments |= {"start_position": arguments.pop("position"), "start_velocity": arguments.pop("velocity")}
        motions.append((motion.scene, arguments | ({"contact": "bilateral"} if linear else {})))
    return motions


def label(position: np.ndarray, velocity: np.ndarray, delay: int) -> MotionKind:
    """Return the final state of one body from its recorded response, by the rules of T7."""
    size = np.abs(position).max()
    if not size < 1e100:
        return MotionKind.DIVERGED
    start = position.size - position.size // 4
    edges = position.size - (position.size // 4) * np.arange(SEGMENTS, -1, -1) // SEGMENTS
    parts = [position[low:high] for low, high in itertools.pairwise(edges)]
    widths = [np.ptp(part) for part in parts]
    before, first, second = (
        np.ptp(part) for part in (position[:start], position[start : edges[3]], position[edges[3] :])
    )
    if second <= 1e-9 * size and first <= 1e-9**0.5 * size and position.size // 8 > delay + 1:
        return MotionKind.REST
    if max(widths) - min(widths) <= 1e-3 * max(widths) and count_turns(velocity, edges) >= 1:
        return MotionKind.STEADY
    pairs = list(itertools.pairwise(widths))
    if widths[0] > 1e-9 * size and all(later < former or later <= 1e-9 * size for former, later in pairs):
        return MotionKind.DECAYING
    if second < 0.5 * first and second < 0.01 * before:
        return MotionKind.DECAYING
    if all(later > former for former, later in pairs) or (second > 2 * first and second > 2 * before):
        return MotionKind.GROWING
    steady = count_turns(velocity, edges) >= 1 and 0.8 < second / first < 1.25
    return MotionKind.STEADY if steady else MotionKind.UNCLEAR


def count_turns(velocity: np.ndarray, edges: np.ndarray) -> int:
    """Return the smallest number of times in a segment that the velocity becomes positive."""
    turns = np.flatnonzero((velocity[:-1] <= 0) & (velocity[1:] > 0))
    return int(np.histogram(turns, edges)[0].min())


@pytest.mark.parametrize("contact", ["bilateral", "unilateral", "push_only"])
def test_labels_agree_with_recorded_positions(contact: Any) -> None:
    motions = [each for each in draw_motions(linear=False) if each[1]["contact"] == contact]
    columns: dict[str, Any] = {
        name: [arguments[name] for _, arguments in motions] for name in motions[0][1] if name != "contact"
    }
    result: Any = zwidth.simulate([scene for scene, _ in motions], **columns, contact=contact, periods=PERIODS)
    expected = [
        label(position, velocity, int(scene.integer_delay))
        for position, velocity, (scene, _) in zip(result.position, result.velocity, motions, strict=True)
    ]
    assert [MotionKind(code).name for code in result.outcome] == [kind.name for kind in expected]


def test_labels_of_linear_responses_agree_with_the_verdict():
    motions = draw_motions(linear=True)
    columns: dict[str, Any] = {
        name: [arguments[name] for _, arguments in motions] for name in motions[0][1] if name != "contact"
    }
    result = zwidth.simulate([scene for scene, _ in motions], **columns, periods=4 * PERIODS, record=False)
    stable = np.array([scene.is_stable(each["stiffness"], each["virtual_damping"]) for scene, each in motions])
    assert 0.2 < np.mean(stable) < 0.8
    assert np.isin(result.outcome[stable], [MotionKind.REST, MotionKind.DECAYING, MotionKind.UNCLEAR]).all()
    assert np.isin(result.outcome[~stable], [MotionKind.GROWING, MotionKind.DIVERGED, MotionKind.UNCLEAR]).all()
    assert np.mean(result.outcome == MotionKind.UNCLEAR) <= 0.1
