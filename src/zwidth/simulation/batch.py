"""Simulations of scenes of one structure: normalize the parameters, run groups of a fixed size, collect the results."""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.arrays.evaluate import compute_concretely
from zwidth.arrays.threads import run_in_threads
from zwidth.parts.chain import chain_of
from zwidth.parts.device import Device
from zwidth.parts.paths import Parts, replace_parameters
from zwidth.parts.velocity import FOAW, BackwardDifference
from zwidth.simulation.flow import Mechanics, build_mechanics
from zwidth.simulation.parameters import (
    ExternalInputs,
    Motor,
    Options,
    Parameters,
    Settings,
    build_estimators,
    build_flows,
    cut_period,
    round_up,
    spread_scenes,
)
from zwidth.simulation.result import OF_ENERGY, convert_to_si

GROUP = 1 << 10  # simulations per call: enough for vector units, few enough that a state stays in the cache


def find_structure(scene: Parts) -> tuple[Any, ...]:
    """Return the properties that scenes of one compiled program share."""
    sensor = "motor" if scene.device.coupling is None else scene.device.coupling.sensor
    orders = len(scene.device.modes), 0 if scene.device.actuator is None else scene.device.actuator.order
    # Linear systems have no common structure, so each device and period has a program of its own.
    system = None if isinstance(scene.device, Device) else (scene.device, scene.timing.period)
    longest = scene.velocity.samples if isinstance(scene.velocity, FOAW) else 0
    return *name_bodies(scene), sensor, *orders, longest, system


def name_bodies(scene: Parts) -> tuple[str, ...]:
    """Return the names in `Motion` of the positions of all bodies."""
    tip = ("tip_position",) if scene.device.coupling is not None else ()
    hand = ("hand_position",) if scene.operator is not None and not scene.operator.rigid else ()
    return "position", *tip, *hand


class Batch:
    """Simulations of scenes of one structure.

    Attributes:
        which: index of the scene of each simulation.
        numbers: arguments of `simulate` in SI units, by name, with one row per simulation.
    """

    def __init__(
        self, scenes: list[Any], which: np.ndarray, numbers: dict[str, np.ndarray], settings: Settings
    ) -> None:
        self.names, self.which, self.numbers, self.settings = name_bodies(scenes[0]), which, numbers, settings
        # FOAW is not a filter, so its parameters bypass the chain.
        adapts = isinstance(scenes[0].velocity, FOAW)
        plain = [replace_parameters(each, {"velocity": BackwardDifference()}) for each in scenes] if adapts else scenes
        chains: Any = [chain_of(each) for each in plain]
        self.mechanics = build_mechanics(chains)
        self.estimates: list[Any] = (
            [each.velocity for each in scenes] if adapts else [chain.estimate for chain in chains]
        )
        self.late = np.array([chain.whole for chain in chains])
        self.fractions = np.array([float(chain.d - chain.whole) for chain in chains])
        self.periods = np.array([float(scene.timing.period) for scene in scenes])
        self.masses = np.array([float(scene.mass) for scene in scenes])
        # The energies of a linear system are unknown, because its bodies are.
        self.unknown = set() if isinstance(scenes[0].device, Device) else OF_ENERGY
        jitter, friction = bool(np.any(numbers["jitter"] > 0)), bool(np.any(numbers["static"] > 0))
        self.options = Options(
            substeps=settings.substeps,
            pieces=4 if jitter else 2 if friction or np.any(self.fractions > 0) else 1,
            friction=friction,
            jitter=jitter,
            foaw=scenes[0].velocity.samples if adapts else 0,
            record=settings.record,
            law=settings.law,
        )
        self.windows = np.array([each.samples if isinstance(each, FOAW) else each.window for each in self.estimates])
        # The minima avoid further compilations; a longer ring takes no more time.
        self.rings = round_up(max(int(self.windows.max()), 3) + 1), round_up(max(int(self.late.max()), 5) + 3)

    def build(self, rows: np.ndarray) -> tuple[Parameters, ExternalInputs]:
        """Return the normalized parameters and inputs of the selected simulations."""
        own, scene_of = np.unique(self.which[rows], return_inverse=True)
        settings, options = self.settings, self.options
        numbers = {name: part[rows] for name, part in self.numbers.items()}
        shared = ("place", "motion")
        machine = Mechanics(*(part if name in shared else part[own] for name, part in self.mechanics._asdict().items()))
        period, mass = self.periods[self.which[rows]], self.masses[self.which[rows]]
        force = period * period / mass
        late, fractions = (spread_scenes(part[own], scene_of) for part in (self.late, self.fractions))
        params = Parameters(
            alpha=numbers["stiffness"] * force,
            beta=numbers["virtual_damping"] * period / mass,
            period=period,
            force=1.0 / force,
            resolution=numbers["resolution"],
            push=numbers["push"] * force,
            bilateral=np.array([settings.contact == "bilateral"]),
            pulling=np.array([settings.contact != "push_only"]),
            late=late,
            motor=Motor(
                numbers["max_force"] * force,
                numbers["max_rate"] * period * force,
                numbers["coulomb"] * force,
                numbers["static"] * force,
            ),
            estimator=build_estimators([self.estimates[k] for k in own], scene_of),
            **build_flows(
                machine, cut_period(self.fractions[own], options.substeps, options.pieces), scene_of, options
            ),
        )
        instants = durations = None
        if options.jitter:
            instants, durations = draw_instants(numbers["seed"], numbers["jitter"] / period, late, fractions, settings)
        return params, ExternalInputs(
            positions=np.stack([numbers[f"start_position.{name}"] for name in self.names]),
            velocities=np.stack([numbers[f"start_velocity.{name}"] for name in self.names]) * period,
            noise=draw_noise(numbers["seed"], numbers["noise"], settings.periods),
            history=(numbers["push_history"] * force[:, None]).T if "push_history" in numbers else None,
            durations=durations,
            instants=instants,
            period=period,
            mass=mass,
        )

    def run(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the fields of `Motion` by name, with one row per selected simulation."""
        # Import JAX only here, because importing zwidth must not load it.
        from zwidth.simulation.engine import run_batch

        params, inputs = self.build(rows)
        with compute_concretely():
            found = run_batch(params, self.options, self.settings, inputs, self.rings)
        memory = (self.late + self.windows)[self.which[rows]]
        columns = convert_to_si(found, inputs, params.motor.static > 0, memory, self.names, self.settings)
        return columns | {name: np.full_like(columns[name], np.nan) for name in self.unknown & columns.keys()}


def run_scenes(
    scenes: list[Any], which: np.ndarray, numbers: dict[str, np.ndarray], settings: Settings
) -> dict[str, np.ndarray]:
    """Run the simulations of a `Batch`; return the fields of `Motion` by name, with one row per simulation."""
    batch, count = Batch(scenes, which, numbers, settings), which.size
    size = min(GROUP, 1 << (count - 1).bit_length())
    # Repeat the last simulation to fill the last group, because each size needs a compilation.
    groups = [np.minimum(np.arange(first, first + size), count - 1) for first in range(0, count, size)]
    # Compile with the first group; threads run the others in parallel, because JAX releases the interpreter lock.
    found = [batch.run(groups[0]), *run_in_threads(batch.run, groups[1:])]
    return {name: np.concatenate([each[name] for each in found])[:count] for name in found[0]}


def draw_noise(seeds: np.ndarray, sizes: np.ndarray, periods: int) -> np.ndarray | None:
    """Return the errors of the measured positions, (periods, batch); equal seeds give equal errors."""
    if not np.any(sizes > 0):
        return None
    each, index = np.unique(seeds, return_inverse=True)
    drawn = np.stack([np.random.default_rng([0, seed]).standard_normal(periods) for seed in each], 1)
    return drawn[:, index] * sizes


def draw_instants(
    seeds: np.ndarray, most: np.ndarray, whole: np.ndarray, fractions: np.ndarray, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """Return the instants of the samples, (periods + 1, batch), and the durations of constant force (T3).

    Args:
        seeds: equal seeds give equal jitter.
        most: largest jitter, in periods.
        whole: integer delay.
        fractions: remaining delay, in periods.
        settings: length of the simulation, and substeps.

    Returns:
        Instants in periods, and durations of shape (periods, substeps, pieces, batch).
    """
    each, index = np.unique(seeds, return_inverse=True)
    periods, substeps = settings.periods, settings.substeps
    drawn = np.stack([np.random.default_rng([1, seed]).random(periods + 1) for seed in each], 1)
    late = drawn[:, index] * most
    late[0] = 0.0
    whole, fractions = np.broadcast_to(whole, most.shape), np.broadcast_to(fractions, most.shape)
    k = np.arange(periods)[:, None]
    length = 1.0 + np.diff(late, axis=0)
    begin = np.arange(substeps)[:, None] / substeps * length[:, None]  # (periods, substeps, batch)
    part = np.broadcast_to(length[:, None] / substeps, begin.shape)
    cuts = [np.zeros(begin.shape)]
    for age in (1, 0, -1):
        # Time at which the command of this age takes effect; there is no command before the first sample.
        sample = np.clip(k - whole - age, 0, periods)
        effective = fractions - age + np.take_along_axis(late, sample, 0) - late[:-1]
        cuts.append(np.clip(effective[:, None] - begin, 0.0, part))
    cuts.append(part)
    return np.arange(periods + 1)[:, None] + late, np.moveaxis(np.diff(np.stack(cuts), axis=0), 0, 2)
