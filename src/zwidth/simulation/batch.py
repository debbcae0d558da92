"""Simulations of one structure, from numbers to arrays: laid out in lanes, run in pieces, collected."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from zwidth.arrays.evaluate import compute_concretely, processors
from zwidth.loops.linear.chain import Chain, chain_of
from zwidth.parts.paths import Parts, replace_parameters
from zwidth.parts.velocity import FOAW, BackwardDifference, Estimate
from zwidth.simulation.flow import Mechanics, mechanics
from zwidth.simulation.lanes import (
    Course,
    Given,
    Lanes,
    Motor,
    Options,
    cut_period,
    lay_estimators,
    lay_machines,
    round_up,
)
from zwidth.simulation.result import to_si

# Lanes that run together: enough for the vector units, few enough that a state stays next to the processor.
TOGETHER = 1 << 10


@dataclass(frozen=True)
class Numbers:
    """One number a simulation of everything that is given to it, in SI units."""

    stiffness: np.ndarray
    virtual_damping: np.ndarray
    start_position: np.ndarray
    start_velocity: np.ndarray
    push: np.ndarray
    resolution: np.ndarray
    noise: np.ndarray
    coulomb: np.ndarray
    static: np.ndarray
    max_force: np.ndarray
    max_rate: np.ndarray
    jitter: np.ndarray
    seed: np.ndarray
    history: np.ndarray | None  # (lanes, periods)

    def take(self, places: np.ndarray) -> Numbers:
        """Those of some simulations."""
        return replace(self, **{name: part[places] for name, part in vars(self).items() if part is not None})


def structure(scene: Parts) -> tuple[Any, ...]:
    """What the scenes of one program share: their bodies, which of them is sensed, and FOAW's longest window."""
    sensor = "motor" if scene.device.coupling is None else scene.device.coupling.sensor
    return *name_bodies(scene), sensor, scene.velocity.samples if isinstance(scene.velocity, FOAW) else 0


def name_bodies(scene: Parts) -> tuple[str, ...]:
    """The position of every body by its name in `Motion`."""
    tip = ("tip_position",) if scene.device.coupling is not None else ()
    hand = ("hand_position",) if scene.operator is not None and not scene.operator.rigid else ()
    return "position", *tip, *hand


def _chain(scene: Parts) -> Chain:
    if isinstance(scene.velocity, FOAW):
        scene = replace_parameters(scene, {"velocity": BackwardDifference()})
    return chain_of(scene)


def run_batch(scenes: list[Any], which: np.ndarray, numbers: Numbers, course: Course) -> dict[str, np.ndarray]:
    """Run simulations of scenes of one structure; ``which`` is the scene of each. Columns of one row a simulation."""
    chains = [_chain(scene) for scene in scenes]
    machine = mechanics(chains)
    fractions = np.array([float(chain.d - chain.whole) for chain in chains])
    names = name_bodies(scenes[0])
    first_velocity = scenes[0].velocity
    jitter, friction = bool(np.any(numbers.jitter > 0)), bool(np.any(numbers.static > 0))
    options = Options(
        substeps=course.substeps,
        pieces=4 if jitter else 2 if friction or np.any(fractions > 0) else 1,
        friction=friction,
        jitter=jitter,
        foaw=first_velocity.samples if isinstance(first_velocity, FOAW) else 0,
        record=course.record,
    )
    estimates: list[Estimate | FOAW] = [
        scene.velocity if isinstance(scene.velocity, FOAW) else chain.estimate
        for scene, chain in zip(scenes, chains, strict=True)
    ]
    late = np.array([chain.whole for chain in chains])
    periods = np.array([float(scene.timing.period) for scene in scenes])
    masses = np.array([float(scene.mass) for scene in scenes])
    windows = [each.window if isinstance(each, Estimate) else each.samples for each in estimates]

    def run(places: np.ndarray) -> dict[str, np.ndarray]:
        own, lane_of = np.unique(which[places], return_inverse=True)
        if len(scenes) == 1:
            # One serves all lanes.
            lane_of = np.zeros(1, int)
        few = Mechanics(*(part if name == "place" else part[own] for name, part in machine._asdict().items()))
        given, period, mass = numbers.take(places), periods[which[places]], masses[which[places]]
        force = period * period / mass
        lanes = Lanes(
            alpha=given.stiffness * force,
            beta=given.virtual_damping * period / mass,
            resolution=given.resolution,
            push=given.push * force,
            bilateral=np.array([course.contact == "bilateral"]),
            pulling=np.array([course.contact != "push_only"]),
            late=late[own][lane_of],
            motor=Motor(
                given.max_force * force,
                given.max_rate * period * force,
                given.coulomb * force,
                given.static * force,
            ),
            estimator=lay_estimators([estimates[k] for k in own], lane_of),
            **lay_machines(few, cut_period(fractions[own], options.substeps, options.pieces), lane_of, options),
        )
        if options.jitter:
            late_of, fraction_of = late[own][lane_of], fractions[own][lane_of]
            instants, durations = draw_instants(
                given.seed, given.jitter / period, late_of, fraction_of, course.periods, options.substeps
            )
        else:
            instants, durations = None, None
        drawn = draw_noise(given.seed, given.noise, course.periods)
        history = None if given.history is None else (given.history * force[:, None]).T
        rings = round_up(max(windows) + 1), round_up(int(late.max()) + 3)
        # What JAX is needed for begins here.
        from zwidth.simulation.engine import run_lanes
        from zwidth.simulation.outlook import foresee

        outside = Given(given.start_position, given.start_velocity * period, drawn, history, durations)
        with compute_concretely():
            state, sensed, reading, frame = run_lanes(lanes, options, course, outside, rings)
            last, steady = lanes.push + np.zeros(places.size), given.noise == 0
            if history is not None:
                # A hand that still moves in the tail moves on.
                last, steady = last + history[-1], steady & np.all(history[-course.tail :] == history[-1], axis=0)
            outlook = foresee(lanes, options, state, last, steady, sensed, course.periods)
        found = state, reading, frame
        return to_si(found, given, outlook, instants, period, mass, names, course)

    count = which.size
    size = min(TOGETHER, 1 << (count - 1).bit_length())
    # The last piece is filled up with its last simulation: one size is one compilation.
    pieces = [np.minimum(np.arange(first, first + size), count - 1) for first in range(0, count, size)]
    found = [run(pieces[0])]
    if len(pieces) > 1:
        # The first piece has compiled the program; JAX lets go of the interpreter while it computes.
        with ThreadPoolExecutor(processors()) as pool:
            found.extend(pool.map(run, pieces[1:]))
    return {name: np.concatenate([each[name] for each in found])[:count] for name in found[0]}


def draw_noise(seeds: np.ndarray, sizes: np.ndarray, periods: int) -> np.ndarray | None:
    """Errors of the measured positions, (periods, lanes); equal seeds draw the same."""
    if not np.any(sizes > 0):
        return None
    each, of = np.unique(seeds, return_inverse=True)
    drawn = np.stack([np.random.default_rng([0, seed]).standard_normal(periods) for seed in each], 1)
    return drawn[:, of] * sizes


def draw_instants(
    seeds: np.ndarray, most: np.ndarray, whole: np.ndarray, fractions: np.ndarray, periods: int, substeps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Instants of the samples, (periods + 1, lanes), and how every period is cut, as by `cut_period` (T3)."""
    each, of = np.unique(seeds, return_inverse=True)
    drawn = np.stack([np.random.default_rng([1, seed]).random(periods + 1) for seed in each], 1)
    late = drawn[:, of] * most
    late[0] = 0.0
    whole, fractions = np.broadcast_to(whole, most.shape), np.broadcast_to(fractions, most.shape)
    k = np.arange(periods)[:, None]
    length = 1.0 + np.diff(late, axis=0)
    begin = np.arange(substeps)[:, None] / substeps * length[:, None]  # (periods, substeps, lanes)
    part = np.broadcast_to(length[:, None] / substeps, begin.shape)
    cuts = [np.zeros(begin.shape)]
    for age in (1, 0, -1):
        # When the command of that age sets in; before the first sample there are none.
        sample = np.clip(k - whole - age, 0, periods)
        sets_in = fractions - age + np.take_along_axis(late, sample, 0) - late[:-1]
        cuts.append(np.clip(sets_in[:, None] - begin, 0.0, part))
    cuts.append(part)
    return np.arange(periods + 1)[:, None] + late, np.moveaxis(np.diff(np.stack(cuts), axis=0), 0, 2)
