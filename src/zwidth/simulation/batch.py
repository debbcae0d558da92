"""Simulate scenes of equal structure: normalize their parameters, run groups of a fixed size, collect the results.

Scenes have equal *structure* if they can share one compiled program (`find_structure`). The *chain* of a scene is the
open loop in normalized units, from the commanded force to the velocity estimate; its delay is an integer delay
(``late``) plus a fraction of a period. FOAW is the adaptive velocity estimate of Janabi-Sharifi et al. 2000. *Rings*
are circular buffers of the last measured positions and of the last commands. ``which`` contains the index of the scene
of each simulation, and ``numbers`` the arguments of `zwidth.simulate` in SI units by name.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.xp import compute_concretely
from zwidth.model.device import Device
from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import LoopEstimates, build_estimates
from zwidth.model.mechanism import build_chain
from zwidth.model.parameter_paths import Parts, replace_parameters
from zwidth.model.tool import ToolStep
from zwidth.model.velocity import FOAW, BackwardDifference
from zwidth.numerics.threads import run_in_threads
from zwidth.simulation.mechanics import build_mechanics
from zwidth.simulation.parameters import (
    ExternalInputs,
    Motor,
    Options,
    Parameters,
    Settings,
    build_program,
    build_transitions,
    cut_period,
    round_up,
    spread_scenes,
)
from zwidth.simulation.result import OF_ENERGY, convert_to_si

GROUP = 1 << 10  # simulations per compiled call: enough for vector units, few enough for their states to fit the cache


def find_structure(scene: Parts) -> tuple[Any, ...]:
    """Return the structure of a scene, a tuple that is equal for scenes that can share a compiled program."""
    sensor = "motor" if scene.device.coupling is None else scene.device.coupling.sensor
    orders = len(scene.device.modes), 0 if scene.device.actuator is None else scene.device.actuator.order
    # Include the linear system and its period in the structure of a scene with a `LinearDevice`, because each
    # combination of both needs a separate program.
    system = None if isinstance(scene.device, Device) else (scene.device, scene.timing.period)
    longest = scene.velocity.samples if isinstance(scene.velocity, FOAW) else 0
    program = scene.position is not None, scene.feedback is not None, scene.tool is not None
    return *name_bodies(scene), sensor, *orders, longest, *program, system


def name_bodies(scene: Parts) -> tuple[str, ...]:
    """Return the names of the position fields in `Motion`: device and, if present, mass after a coupling and hand."""
    tip = ("tip_position",) if scene.device.coupling is not None else ()
    hand = ("hand_position",) if scene.operator is not None and not scene.operator.rigid else ()
    return "position", *tip, *hand


class Model(NamedTuple):
    """Simulation model of one scene: its plant (field ``chain``), estimates, delay, and units."""

    chain: Any  # open loop, of which only the plant and the delay are used
    program: LoopEstimates  # linear estimates and further feedback; contains the backward difference in place of FOAW
    estimate: Any  # velocity estimate
    late: int  # integer delay, in periods
    fraction: float  # fractional delay, in periods
    window: int  # number of past samples that the estimate uses
    period: float  # sampling period, in s
    mass: float  # mass that the force of the wall acts on, in kg
    tool: ToolStep  # integration step of the tool; all fields are 0 without a tool


def build_model(scene: Any) -> Model:
    """Build the simulation model of a scene, with its chain, delay and velocity estimate."""
    period, mass = float(scene.timing.period), float(scene.mass)
    chain: Any = build_chain(scene, estimate=Estimate())
    fraction = float(chain.d - chain.n_delay)
    # `LoopEstimates` contains linear filters only. Replace the nonlinear FOAW by the backward difference in it, and
    # store the parameters of FOAW separately.
    velocity, adapts = scene.velocity, isinstance(scene.velocity, FOAW)
    linear = replace_parameters(scene, {"velocity": BackwardDifference()}) if adapts else scene
    program = build_estimates(linear) or LoopEstimates(velocity=linear.velocity.estimate(period))
    estimate, window = (velocity, velocity.samples) if adapts else (program.velocity, program.velocity.window)
    tool = ToolStep(0.0, 0.0, 0.0, False, 1) if scene.tool is None else scene.tool.compute_step(mass, period)
    return Model(chain, program, estimate, chain.n_delay, fraction, window, period, mass, tool)


def run_scenes(
    scenes: list[Any], which: np.ndarray, numbers: dict[str, np.ndarray], settings: Settings
) -> dict[str, np.ndarray]:
    """Simulate scenes of equal structure, divided into groups of at most `GROUP` simulations.

    Args:
        scenes: distinct scenes.
        which: index of the scene of each simulation.
        numbers: arguments of `zwidth.simulate` in SI units by name, with one row per simulation.
        settings: settings that all simulations share.

    Returns:
        The fields of `Motion` by name, with one row per simulation.
    """
    models = [build_model(scene) for scene in scenes]
    jitter, friction = bool(np.any(numbers["jitter"] > 0)), bool(np.any(numbers["static"] > 0))
    options = Options(
        substeps=settings.substeps,
        pieces=4 if jitter else 2 if friction or any(model.fraction > 0 for model in models) else 1,
        friction=friction,
        jitter=jitter,
        foaw=scenes[0].velocity.samples if isinstance(scenes[0].velocity, FOAW) else 0,
        position=scenes[0].position is not None,
        feedback=scenes[0].feedback is not None,
        tool=scenes[0].tool is not None,
        record=settings.record,
        law=settings.law,
    )
    # Compute the lengths of the rings of positions and of commands. Round them up to a few common lengths, because each
    # length needs a compilation, and a ring that is longer than necessary costs no time.
    rings = (
        round_up(max(3, *(model.window for model in models)) + 1),
        round_up(max(5, *(model.late for model in models)) + 3),
    )
    names, count = name_bodies(scenes[0]), which.size
    # Return NaN for the energies of a linear system, because its masses and springs are unknown.
    unknown = set() if isinstance(scenes[0].device, Device) else OF_ENERGY

    def run(rows: np.ndarray) -> dict[str, np.ndarray]:
        # Import the engine inside this function, because it loads JAX, which importing zwidth must not do.
        from zwidth.simulation.engine import run_batch

        used, scene_of = np.unique(which[rows], return_inverse=True)
        members, group = [models[k] for k in used], {name: part[rows] for name, part in numbers.items()}
        params, inputs = build_batch(members, scene_of, group, settings, options, names)
        with compute_concretely():
            simulated = run_batch(params, options, settings, inputs, rings)
        memory = np.array([model.late + model.window for model in members])[scene_of]
        columns = convert_to_si(simulated, inputs, params.motor.static > 0, memory, names, settings)
        return columns | {name: np.full_like(columns[name], np.nan) for name in unknown & columns.keys()}

    size = min(GROUP, 1 << (count - 1).bit_length())
    # Repeat the last simulation until the last group is full, because each group size needs a compilation.
    groups = [np.minimum(np.arange(first, first + size), count - 1) for first in range(0, count, size)]
    # Run the first group before all others, so that it compiles the program. Threads then run the other groups in
    # parallel, because JAX releases the interpreter lock.
    results = [run(groups[0]), *run_in_threads(run, groups[1:])]
    return {name: np.concatenate([each[name] for each in results])[:count] for name in results[0]}


def build_batch(
    models: list[Model],
    which: np.ndarray,
    numbers: dict[str, np.ndarray],
    settings: Settings,
    options: Options,
    names: tuple[str, ...],
) -> tuple[Parameters, ExternalInputs]:
    """Return the normalized parameters and the external inputs of one group of simulations.

    Args:
        models: models of the scenes in the group.
        which: index of the model of each simulation.
        numbers: arguments of `zwidth.simulate` in SI units by name, with one row per simulation.
        settings: settings that all simulations share.
        options: structure of the compiled program.
        names: fields of `Motion` with the positions of the bodies.
    """
    chains, programs, estimates, late, fractions, _, periods, masses, tools = zip(*models, strict=True)
    period, mass = np.array(periods)[which], np.array(masses)[which]
    force = period * period / mass
    durations = cut_period(np.ones(len(models)), [np.array(fractions)][: options.pieces - 1], settings.substeps)
    late, fractions = (spread_scenes(np.array(part), which) for part in (late, fractions))
    params = Parameters(
        alpha=numbers["stiffness"] * force,
        beta=numbers["virtual_damping"] * period / mass,
        period=period,
        force=1.0 / force,
        resolution=numbers["resolution"],
        external_force=numbers["external_force"] * force,
        bilateral=np.array([settings.contact == "bilateral"]),
        pulling=np.array([settings.contact != "push_only"]),
        late=late,
        motor=Motor(
            numbers["max_force"] * force,
            numbers["max_rate"] * period * force,
            numbers["coulomb"] * force,
            numbers["static"] * force,
        ),
        tool=spread_scenes(ToolStep(*(np.array(column) for column in zip(*tools, strict=True))), which),
        **build_program(programs, estimates, which, options.filters_tool),
        **build_transitions(build_mechanics(chains), np.moveaxis(durations, -1, 0), which, options),
    )
    instants = durations = None
    if options.jitter:
        instants, durations = draw_instants(numbers["seed"], numbers["jitter"] / period, late, fractions, settings)
    tool = numbers.get("start_position.tool_position", mass * np.nan), numbers.get("start_velocity.tool_position", 0.0)
    return params, ExternalInputs(
        positions=np.stack([numbers[f"start_position.{name}"] for name in names]),
        velocities=np.stack([numbers[f"start_velocity.{name}"] for name in names]) * period,
        noise=draw_noise(numbers["seed"], numbers["noise"], settings.periods),
        history=(numbers["external_force_history"] * force[:, None]).T if "external_force_history" in numbers else None,
        tool=np.stack([tool[0], tool[1] * period]),
        durations=durations,
        instants=instants,
        period=period,
        mass=mass,
    )


def draw_noise(seeds: np.ndarray, sizes: np.ndarray, periods: int) -> np.ndarray | None:
    """Draw the errors of the measured positions in m from normal distributions.

    Simulations with equal seeds have the same sequence of errors, scaled by their standard deviations.

    Args:
        seeds: seed of each simulation.
        sizes: standard deviation in m of each simulation.
        periods: number of sampling periods.

    Returns:
        Errors of shape (periods, batch), or None if all standard deviations are 0.
    """
    if not np.any(sizes > 0):
        return None
    each, index = np.unique(seeds, return_inverse=True)
    drawn = np.stack([np.random.default_rng([0, seed]).standard_normal(periods) for seed in each], 1)
    return drawn[:, index] * sizes


def draw_instants(
    seeds: np.ndarray, most: np.ndarray, whole: np.ndarray, fractions: np.ndarray, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the jittered sampling instants, and compute the durations of the time intervals with constant force.

    Args:
        seeds: seed of each simulation; equal seeds yield equal jitter.
        most: largest jitter of each simulation, in periods.
        whole: integer delay, in periods.
        fractions: fractional delay, in periods.
        settings: number of periods and of substeps.

    Returns:
        Instants in periods, of shape (periods + 1, batch), and durations of constant force, of shape (periods,
        substeps, pieces, batch).
    """
    each, index = np.unique(seeds, return_inverse=True)
    periods = settings.periods
    drawn = np.stack([np.random.default_rng([1, seed]).random(periods + 1) for seed in each], 1)
    late = drawn[:, index] * most
    late[0] = 0.0
    whole, fractions = np.broadcast_to(whole, most.shape), np.broadcast_to(fractions, most.shape)
    k = np.arange(periods)[:, None]
    effective = []
    for age in (1, 0, -1):
        # Compute the time within period k at which each command takes effect. The age of a command is the number of
        # samples by which it precedes the command of sample k - whole, with the integer delay ``whole``. Clip the index
        # of the sample, because no command exists before the first sample.
        sample = np.clip(k - whole - age, 0, periods)
        effective.append(fractions - age + np.take_along_axis(late, sample, 0) - late[:-1])
    durations = cut_period(1.0 + np.diff(late, axis=0), effective, settings.substeps)
    return np.arange(periods + 1)[:, None] + late, durations
