"""Simulations of one structure, from numbers to arrays: laid out in lanes, run in pieces, collected."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.arrays.evaluate import compute_concretely
from zwidth.arrays.threads import run_in_threads
from zwidth.parts.chain import chain_of
from zwidth.parts.device import Device
from zwidth.parts.paths import Parts, replace_parameters
from zwidth.parts.velocity import FOAW, BackwardDifference
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
    lay_scenes,
    round_up,
)
from zwidth.simulation.result import OF_ENERGY, to_si

# Lanes that run together: enough for the vector units, few enough that a state stays next to the processor.
TOGETHER = 1 << 10


def structure(scene: Parts) -> tuple[Any, ...]:
    """What the scenes of one program share: bodies, modes and actuator, what is sensed, and FOAW's longest window."""
    sensor = "motor" if scene.device.coupling is None else scene.device.coupling.sensor
    behind = len(scene.device.modes), 0 if scene.device.actuator is None else scene.device.actuator.order
    # Of a linear system no part is known that others may share.
    whole = None if isinstance(scene.device, Device) else (scene.device, scene.timing.period)
    longest = scene.velocity.samples if isinstance(scene.velocity, FOAW) else 0
    return *name_bodies(scene), sensor, *behind, longest, whole


def name_bodies(scene: Parts) -> tuple[str, ...]:
    """The position of every body by its name in `Motion`."""
    tip = ("tip_position",) if scene.device.coupling is not None else ()
    hand = ("hand_position",) if scene.operator is not None and not scene.operator.rigid else ()
    return "position", *tip, *hand


class Batch:
    """Simulations of scenes of one structure.

    ``which`` is the scene of each; ``numbers`` has a row each of the arguments of `simulate`, by name and in SI units.
    """

    def __init__(self, scenes: list[Any], which: np.ndarray, numbers: dict[str, np.ndarray], course: Course) -> None:
        self.names, self.which, self.numbers, self.course = name_bodies(scenes[0]), which, numbers, course
        # An adaptive window is no filter: its own numbers stand beside the chain's.
        adapts = isinstance(scenes[0].velocity, FOAW)
        plain = [replace_parameters(each, {"velocity": BackwardDifference()}) for each in scenes] if adapts else scenes
        chains: Any = [chain_of(each) for each in plain]
        self.machine = mechanics(chains)
        self.estimates: list[Any] = (
            [each.velocity for each in scenes] if adapts else [chain.estimate for chain in chains]
        )
        self.late = np.array([chain.whole for chain in chains])
        self.fractions = np.array([float(chain.d - chain.whole) for chain in chains])
        self.periods = np.array([float(scene.timing.period) for scene in scenes])
        self.masses = np.array([float(scene.mass) for scene in scenes])
        jitter, friction = bool(np.any(numbers["jitter"] > 0)), bool(np.any(numbers["static"] > 0))
        self.options = Options(
            substeps=course.substeps,
            pieces=4 if jitter else 2 if friction or np.any(self.fractions > 0) else 1,
            friction=friction,
            jitter=jitter,
            foaw=scenes[0].velocity.samples if adapts else 0,
            bodies=isinstance(scenes[0].device, Device),
            record=course.record,
            law=course.law,
        )
        windows = [each.samples if isinstance(each, FOAW) else each.window for each in self.estimates]
        # Reading a ring takes no longer where it is: as long as most are, it needs no program of its own.
        self.rings = round_up(max(*windows, 3) + 1), round_up(max(int(self.late.max()), 5) + 3)

    def lay(self, places: np.ndarray) -> tuple[Lanes, Given]:
        """Some of the simulations side by side."""
        own, lane_of = np.unique(self.which[places], return_inverse=True)
        course, options = self.course, self.options
        numbers = {name: part[places] for name, part in self.numbers.items()}
        shared = ("place", "motion")
        machine = Mechanics(*(part if name in shared else part[own] for name, part in self.machine._asdict().items()))
        period, mass = self.periods[self.which[places]], self.masses[self.which[places]]
        force = period * period / mass
        late, fractions = (lay_scenes(part[own], lane_of) for part in (self.late, self.fractions))
        lanes = Lanes(
            alpha=numbers["stiffness"] * force,
            beta=numbers["virtual_damping"] * period / mass,
            period=period,
            force=1.0 / force,
            resolution=numbers["resolution"],
            push=numbers["push"] * force,
            bilateral=np.array([course.contact == "bilateral"]),
            pulling=np.array([course.contact != "push_only"]),
            late=late,
            motor=Motor(
                numbers["max_force"] * force,
                numbers["max_rate"] * period * force,
                numbers["coulomb"] * force,
                numbers["static"] * force,
            ),
            estimator=lay_estimators([self.estimates[k] for k in own], lane_of),
            **lay_machines(
                machine, cut_period(self.fractions[own], options.substeps, options.pieces), lane_of, options
            ),
        )
        instants = durations = None
        if options.jitter:
            instants, durations = draw_instants(
                numbers["seed"],
                numbers["jitter"] / period,
                late,
                fractions,
                course.periods,
                course.substeps,
            )
        return lanes, Given(
            positions=np.stack([numbers[f"start_position.{name}"] for name in self.names]),
            velocities=np.stack([numbers[f"start_velocity.{name}"] for name in self.names]) * period,
            noise=draw_noise(numbers["seed"], numbers["noise"], course.periods),
            history=(numbers["push_history"] * force[:, None]).T if "push_history" in numbers else None,
            durations=durations,
            instants=instants,
            period=period,
            mass=mass,
        )

    def run(self, places: np.ndarray) -> dict[str, np.ndarray]:
        """Columns of one row a simulation."""
        # What JAX is needed for begins here.
        from zwidth.simulation.engine import run_lanes
        from zwidth.simulation.outlook import foresee

        lanes, given = self.lay(places)
        with compute_concretely():
            state, sensed, reading, frame = run_lanes(lanes, self.options, self.course, given, self.rings)
            last = lanes.push + np.zeros(places.size)
            steady = (self.numbers["noise"][places] == 0) & (self.numbers["jitter"][places] == 0)
            if given.history is not None:
                # A hand that still moves in the tail moves on.
                tail = given.history[-self.course.tail :]
                last, steady = last + tail[-1], steady & np.all(tail == tail[-1], axis=0)
            outlook = foresee(lanes, self.options, state, last, steady, sensed, self.course.periods)
        found = to_si((state, reading, frame), given, lanes.motor.static > 0, outlook, self.names, self.course)
        # Where a force acts and what stores its work is known of bodies.
        unknown = () if self.options.bodies else OF_ENERGY & found.keys()
        return found | {name: np.full_like(found[name], np.nan) for name in unknown}


def run_batch(
    scenes: list[Any], which: np.ndarray, numbers: dict[str, np.ndarray], course: Course
) -> dict[str, np.ndarray]:
    """Run the simulations of a `Batch`: columns of one row each."""
    batch, count = Batch(scenes, which, numbers, course), which.size
    size = min(TOGETHER, 1 << (count - 1).bit_length())
    # The last piece is filled up with its last simulation: one size is one compilation.
    pieces = [np.minimum(np.arange(first, first + size), count - 1) for first in range(0, count, size)]
    # The first piece compiles the program; JAX lets go of the interpreter while it computes.
    found = [batch.run(pieces[0]), *run_in_threads(batch.run, pieces[1:])]
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
