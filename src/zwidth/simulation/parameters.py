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
from zwidth.parts.velocity import FOAW, Estimate
from zwidth.simulation.flow import DIGITS, Flow, Mechanics, flow
from zwidth.words.errors import InputError
from zwidth.words.types import Array

LONGEST_ANGLE = 0.25  # rad of the fastest motion per step with friction; a longer step could hide two events (T5)
MOST_STEPS = 256  # steps per period with friction, to limit the run time


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
    """Return arrays with one row per scene as arrays with one last entry per simulation; length 1 for one scene."""
    if isinstance(parts, tuple):
        return type(parts)(*(spread_scenes(part, which) for part in parts))
    last = np.moveaxis(parts, 0, -1)
    return last[..., which] if parts.shape[0] > 1 else last


def round_up(size: int) -> int:
    """Return 0 or the next power of 2, at least 2, so that few sizes are compiled."""
    return 0 if size == 0 else max(2, 1 << (size - 1).bit_length())


def build_estimators(estimates: Sequence[Estimate | FOAW], which: np.ndarray) -> Estimator:
    """Return the velocity estimates of all scenes, the filters padded to the largest order."""
    # The ring of measured positions replaces the shift register of a window.
    filters = [
        estimate_matrices(replace(each, window=0)) if isinstance(each, Estimate) and each.degree > each.window else None
        for each in estimates
    ]
    order = round_up(max(0 if each is None else each.A.shape[0] for each in filters))
    columns = []
    for each, matrices in zip(estimates, filters, strict=True):
        A, B, C = np.zeros((order, order)), np.zeros(order), np.zeros(order)
        D = each.gain if isinstance(each, Estimate) else 0.0
        if matrices is not None:
            size = matrices.A.shape[0]
            A[:size, :size], B[:size], C[:size] = matrices.A, matrices.B[:, 0], matrices.C[0]
            D = matrices.D[0, 0]
        window, bound = (each.window, 0.0) if isinstance(each, Estimate) else (each.samples, each.noise)
        columns.append((A, B, C, D, window, bound))
    return spread_scenes(Estimator(*map(np.array, zip(*columns, strict=True))), which)


def cut_period(fractions: np.ndarray, substeps: int, pieces: int) -> np.ndarray:
    """Return the durations of constant force within a period, (scenes, substeps, pieces)."""
    begin = np.arange(substeps) / substeps
    cut = np.clip(fractions[:, None] - begin, 0.0, 1.0 / substeps)
    parts = [cut, 1.0 / substeps - cut] if pieces > 1 else [np.full_like(cut, 1.0 / substeps)]
    return np.stack(parts, -1)


def find_longest_steps(machine: Mechanics) -> np.ndarray:
    """Return the longest steps with friction: powers of 2; 2 if the velocity is monotone under a constant force."""
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
