"""The maps from sample to sample, beside one more period of the simulation; and places to rest, beside a search."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from any_loop import continuous
from tolerances import SIMULATED_LINEAR

import zwidth
from zwidth.arrays.evaluate import compute_concretely
from zwidth.simulation.batch import Batch, name_bodies
from zwidth.simulation.engine import round_to, run_lanes
from zwidth.simulation.lanes import Course
from zwidth.simulation.maps import LaneGroup, find_kept, gather, lay_loop

HAND = zwidth.Operator(0.3, 4.0, 500.0, coupling_stiffness=900.0, coupling_damping=3.0)


def lay_scene(velocity: Any, delay: float, operator: Any = None, coupling: Any = None) -> zwidth.Scene:
    """A scene of 1 ms, ``delay`` in periods."""
    device = zwidth.Device(0.1, 2.0, coupling)
    return zwidth.Scene(device, zwidth.Timing(1e-3, delay * 1e-3), velocity=velocity, operator=operator)


# Side by side, those of equally many bodies.
SCENES = {
    "one body": [
        lay_scene(zwidth.BackwardDifference(), 1.0),
        lay_scene(zwidth.WindowedDifference(3), 0.0),
        lay_scene(zwidth.WindowedDifference(4), 2.3),
        lay_scene(zwidth.LowPass(cutoff=80.0, order=2), 0.4),
        lay_scene(zwidth.VelocityFilter([900, -800, -100], [1, -0.5, 0.2]), 2.0),
    ],
    "hand": [lay_scene(zwidth.WindowedDifference(2), 2.0, HAND), lay_scene(zwidth.LowPass(cutoff=90.0), 0.0, HAND)],
    "tip": [lay_scene(zwidth.Butterworth(60.0, 2), 1.3, HAND, zwidth.Coupling(0.05, 5e3, 0.5, "tip"))],
}


class Way(NamedTuple):
    """What is simulated, and the decisions that are in force from sample to sample."""

    numbers: dict[str, float]
    contact: str
    seen: bool
    touching: bool
    held: bool = False


QUANTUM = 1e-2
NUMBERS = (
    *("stiffness", "virtual_damping", "start_position", "start_velocity", "push", "resolution", "noise"),
    *("coulomb", "static", "max_force", "max_rate", "jitter", "seed"),
)
WAYS = {
    "wall": Way({"stiffness": 800.0, "virtual_damping": 3.0, "start_velocity": 0.1}, "bilateral", True, True),
    "damper": Way({"virtual_damping": 3.0, "start_velocity": 0.1}, "bilateral", True, True),
    "a reading that stays": Way(
        {"stiffness": 800.0, "virtual_damping": 3.0, "resolution": QUANTUM, "push": 24.0}, "unilateral", False, True
    ),
    "air": Way({"stiffness": 800.0, "start_position": -0.5, "start_velocity": -0.1}, "unilateral", False, False),
    "slipping": Way({"stiffness": 800.0, "start_velocity": 0.3, "coulomb": 0.2}, "bilateral", True, True),
    "held": Way({"stiffness": 800.0, "coulomb": 50.0}, "bilateral", True, True, True),
    "held, and a reading that stays": Way(
        {"stiffness": 800.0, "coulomb": 50.0, "resolution": QUANTUM}, "bilateral", False, True, True
    ),
}


def simulate(scenes: list[zwidth.Scene], way: Way, periods: int) -> Iterator[tuple[LaneGroup, np.ndarray]]:
    """The groups of two simulations of every scene behind so many periods, and which way friction acts on them."""
    given = {"start_position": 3 * QUANTUM, "push": 0.3, "max_force": np.inf, "max_rate": np.inf} | way.numbers
    given["static"] = given.get("coulomb", 0.0)
    which = np.repeat(np.arange(len(scenes)), 2)
    numbers = {name: np.full(which.size, given.get(name, 0.0)) for name in NUMBERS}
    # Each second one moves half as fast: no lane is taken for another.
    numbers["start_velocity"][1::2] *= 0.5
    for start in ("start_position", "start_velocity"):
        numbers |= {f"{start}.{body}": numbers[start] for body in name_bodies(scenes[0])}
    course = Course(periods, 2, 1, way.contact, record=False)
    batch = Batch(scenes, which, numbers, course)
    lanes, outside = batch.lay(np.arange(which.size))
    with compute_concretely():
        state, *_ = run_lanes(lanes, batch.options, course, outside, batch.rings)
    for place in range(len(scenes)):
        at = np.flatnonzero(which == place)
        yield gather(lanes, batch.options, state, lanes.push, periods, at), state.body.slip[at]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("bodies", SCENES)
def test_a_map_is_one_more_period_of_the_simulation_and_keeps_what_it_should(bodies, way):
    scenes, found = SCENES[bodies], WAYS[way]
    for (now, slip), (later, _) in zip(simulate(scenes, found, 7), simulate(scenes, found, 8), strict=True):
        loop = lay_loop(now, found.seen, found.touching, found.held)
        reading = round_to(now.lanes.resolution, now.state[:, 0])
        constant = loop.pushed * (now.push - slip * now.lanes.motor.coulomb)[:, None]
        if not found.seen:
            constant += loop.misread * reading[:, None]
        expected = np.einsum("lnm,lm->ln", loop.A, now.state) + constant
        # In the air no one asks what the program reads.
        told = slice(None if found.touching else now.bodies)
        close = SIMULATED_LINEAR.float64 * np.abs(later.state).max()
        np.testing.assert_allclose(later.state[:, told], expected[:, told], rtol=0, atol=close)
        # The newest command is that of the row.
        command = np.einsum("ln,ln->l", loop.command, now.state) + (0.0 if found.seen else loop.misled * reading)
        newest = later.state[:, now.state.shape[1] - now.late - 1]
        np.testing.assert_allclose(newest, command, rtol=0, atol=SIMULATED_LINEAR.float64 * np.abs(newest).max())
        kept = find_kept(now, found.seen, found.held)
        for A, vector in zip(loop.A, kept, strict=True):
            # What a map keeps is a functional of a held body, a state of a free one, and there is no other.
            np.testing.assert_allclose((A.T if found.held else A) @ vector, vector, rtol=0, atol=1e-12)
            assert np.any(vector) == (np.abs(np.linalg.eigvals(A) - 1.0).min() < 1e-10)


@pytest.mark.parametrize("contact", ["bilateral", "unilateral"])
@pytest.mark.parametrize("sensor", [None, "motor", "tip"])
def test_restless_is_who_finds_no_reading_that_balances_the_push(sensor, contact):
    """Held at the reading n, bodies rest at ``y = G0 (push - K Q n)``: all n are tried whether that is read as n Q."""
    coupling = None if sensor is None else zwidth.Coupling(0.05, 400.0, 0.5, sensor)
    scene = lay_scene(zwidth.BackwardDifference(), 1.3, HAND, coupling)
    a, b, seen = continuous(scene)
    yields = seen @ np.linalg.solve(-a, b)
    rng = np.random.default_rng(5)
    stiffness, push, quantum = rng.uniform(20.0, 900.0, 200), rng.uniform(-1.0, 4.0, 200), rng.uniform(5e-4, 4e-3, 200)
    found = scene.simulate(
        stiffness, 1.0, push=push, resolution=quantum, start_position=-2e-3, contact=contact, periods=24, record=False
    )
    n = np.arange(-4000, 4001)[:, None] if contact == "bilateral" else np.arange(1, 4001)[:, None]
    off = np.abs(yields * (push / quantum - stiffness * n) - n) - 0.5
    if contact == "unilateral":
        off = np.concatenate([off, yields * push[None] / quantum - 0.5])
    nearest = off.min(0)
    clear = np.abs(nearest) > 1e-6
    assert np.mean(clear) > 0.9
    restless = found.outcome == zwidth.MotionKind.RESTLESS
    np.testing.assert_array_equal(restless[clear], (nearest > 0)[clear])
    assert 20 < restless.sum() < 180
