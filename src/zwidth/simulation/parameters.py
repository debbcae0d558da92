"""Parameters of a batch of simulations, as arrays whose last axis is the batch.

Units: the sampling period and the mass that the wall's force acts on are 1; positions are in m. A last axis of length 1
broadcasts over the batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.parts.state_space import estimate_matrices
from zwidth.parts.velocity import FOAW
from zwidth.simulation.flow import DIGITS, Flow, Mechanics, flow
from zwidth.words.errors import InputError
from zwidth.words.types import Array

LONGEST_ANGLE = 0.25  # rad of the fastest motion per step with friction; a longer step could hide two events (T5)
MOST_STEPS = 256  # largest number of steps per period with friction, to limit the run time


Law: TypeAlias = Callable[[Any, Any, Any], Any]
"""Force on the device in N as a function of the measured position in m, the estimated velocity in m/s and the time in
s. All arguments are JAX arrays with one value per simulation."""


class TracedLaw(NamedTuple):
    """Force law and its program."""

    force: Law
    program: str  # changes with every constant that the law reads, so equal tuples compile once

    def __call__(self, position: Any, velocity: Any, time: Any) -> Any:
        return self.force(position, velocity, time)


class Options(NamedTuple):
    """Structure of the compiled program."""

    substeps: int
    pieces: int  # largest number of different forces within a substep
    friction: bool
    jitter: bool
    foaw: int  # longest window of FOAW; 0 for a linear estimate
    record: bool
    law: TracedLaw | None


class Settings(NamedTuple):
    """Settings that all simulations of a batch share."""

    periods: int
    substeps: int
    tail: int
    contact: str
    record: bool
    law: TracedLaw | None = None


class ExternalInputs(NamedTuple):
    """Initial state, external forces and random numbers in normalized units, and the units in SI."""

    positions: np.ndarray  # (bodies, batch)
    velocities: np.ndarray  # (bodies, batch)
    noise: np.ndarray | None  # (periods, batch), in m
    history: np.ndarray | None  # external force, (periods, batch)
    durations: np.ndarray | None  # with jitter, (periods, substeps, pieces, batch)
    instants: np.ndarray | None  # with jitter, (periods + 1, batch), in periods
    period: np.ndarray  # in s
    mass: np.ndarray  # in kg


class Motor(NamedTuple):
    """Limits of the motor (infinite for none) and dry friction of its bearings (0 for none)."""

    max_force: Array
    max_rate: Array
    coulomb: Array
    static: Array


class Estimator(NamedTuple):
    """Velocity estimate: a difference over a window, followed by a filter in state space; or FOAW."""

    A: Array  # (p, p, batch)
    B: Array  # (p, batch)
    C: Array  # (p, batch)
    D: Array  # (batch,)
    window: Array  # in samples; 0 if the filter takes the position
    bound: Array  # noise bound of FOAW, in m


class Parameters(NamedTuple):
    """Parameters of the simulations of a batch."""

    alpha: Array
    beta: Array
    period: Array  # in s
    force: Array  # unit of force, in N
    resolution: Array
    push: Array
    bilateral: Array  # the wall acts on both sides of its surface
    pulling: Array  # the wall may pull
    late: Array  # integer delay
    motor: Motor
    estimator: Estimator
    rate: Array  # (n, n + forces, batch)
    place: Array  # (bodies, n, batch)
    motion: Array  # (bodies, n, batch)
    energy: Array  # (n, n, batch)
    durations: Array  # of the pieces without jitter, (substeps, pieces, batch)
    pieces: Flow  # over these durations, slipping and held, (1 or 2, substeps, pieces, ..., batch)
    digits: Flow  # over the binary digits of time, slipping and held, (1 or 2, DIGITS, ..., batch)
    longest: Array  # longest step with friction


def spread_scenes(parts: Any, which: np.ndarray) -> Any:
    """Return arrays over the scenes (first axis) as arrays over the batch (last axis, of length 1 for one scene)."""
    if isinstance(parts, tuple):
        return type(parts)(*(spread_scenes(part, which) for part in parts))
    last = np.moveaxis(parts, 0, -1)
    return last[..., which] if parts.shape[0] > 1 else last


def round_up(size: int) -> int:
    """Return 0 for 0, otherwise the next power of 2, at least 2, so that few sizes are compiled."""
    return 0 if size == 0 else max(2, 1 << (size - 1).bit_length())


def build_estimators(estimates: Sequence[Any], which: np.ndarray) -> Estimator:
    """Return the velocity estimates of all scenes, the filters padded to the largest order."""
    count, adapts = len(estimates), isinstance(estimates[0], FOAW)
    # The ring of measured positions replaces the shift register of a window.
    filters = {
        k: estimate_matrices(replace(each, window=0))
        for k, each in enumerate(estimates)
        if not adapts and each.degree > each.window
    }
    order = round_up(max((matrices.A.shape[0] for matrices in filters.values()), default=0))
    A, B, C = np.zeros((count, order, order)), np.zeros((count, order)), np.zeros((count, order))
    D = np.array([0.0 if adapts else each.gain for each in estimates])
    for k, matrices in filters.items():
        size = matrices.A.shape[0]
        A[k, :size, :size], B[k, :size], C[k, :size] = matrices.A, matrices.B[:, 0], matrices.C[0]
        D[k] = matrices.D[0, 0]
    window = np.array([each.samples if adapts else each.window for each in estimates])
    bound = np.array([each.noise if adapts else 0.0 for each in estimates])
    return spread_scenes(Estimator(A, B, C, D, window, bound), which)


def cut_period(lengths: np.ndarray, effective: Sequence[np.ndarray], substeps: int) -> np.ndarray:
    """Return the durations of constant force within periods.

    Args:
        lengths: lengths of the periods, (..., batch).
        effective: times since the start of the period at which the force changes, each (..., batch), increasing.
        substeps: number of substeps.

    Returns:
        Durations (..., substeps, pieces, batch), with one piece more than there are changes.
    """
    substep = np.arange(substeps)[:, None] * lengths[..., None, :] / substeps
    part = np.broadcast_to(lengths[..., None, :] / substeps, substep.shape)
    cuts = [np.clip(time[..., None, :] - substep, 0.0, part) for time in effective]
    return np.moveaxis(np.diff([np.zeros(part.shape), *cuts, part], axis=0), 0, -2)


def find_longest_steps(machine: Mechanics) -> np.ndarray:
    """Return the longest steps with friction, in periods: powers of 2, and 2 for a single body without spring (T5)."""
    size = machine.rate.shape[1]
    fastest = np.abs(np.linalg.eigvals(machine.rate[:, :, :size])).max(-1)
    steps = 0.5 ** np.maximum(0, np.ceil(np.log2(np.maximum(fastest, 1e-9) / LONGEST_ANGLE)))
    if size == 2:
        steps = np.where(machine.rate[:, 1, 0] == 0, 2.0, steps)
    if np.min(steps) * MOST_STEPS < 1.0:
        raise InputError(
            f"coupling.stiffness, modes, actuator: got a pole of {fastest.max():.3g} rad per period; at most "
            f"{LONGEST_ANGLE * MOST_STEPS:g} with friction. Remove that part or the friction"
        )
    return steps


def build_flows(machine: Mechanics, durations: np.ndarray, which: np.ndarray, options: Options) -> dict[str, Any]:
    """Return the fields of `Parameters` that follow from the bodies and the links between them."""
    ways = (machine.rate, machine.held) if options.friction else (machine.rate,)

    def stack(flows: Iterable[Flow]) -> Flow:
        return Flow(*(np.stack(column) for column in zip(*(spread_scenes(each, which) for each in flows), strict=True)))

    digits = Flow(*(np.zeros((1, 1, 1, 1, 1)) for _ in Flow._fields))
    if options.friction or options.jitter:
        times = np.broadcast_to(0.5 ** np.arange(DIGITS), (len(machine.rate), DIGITS))
        digits = stack(flow(way, machine.drain, times) for way in ways)
    longest = find_longest_steps(machine) if options.friction else np.array([2.0])
    return {
        "rate": spread_scenes(machine.rate, which),
        "place": machine.place[..., None],
        "motion": machine.motion[..., None],
        "energy": spread_scenes(machine.energy, which),
        "durations": spread_scenes(durations, which),
        "pieces": stack(flow(way, machine.drain, durations) for way in ways),
        "digits": digits,
        "longest": spread_scenes(longest, which),
    }
