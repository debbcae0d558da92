"""Many simulations side by side: what each of them needs, as arrays whose last axis are the simulations ("lanes").

Everything is in units of the period and of the mass that the wall's force acts on; a last axis of length 1 serves all.
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

# With friction, steps are so short a part of the fastest motion that two events within one are seen (T5), and never so
# many that a period would take forever.
_STEP, _MOST_STEPS = 0.25, 256


Law: TypeAlias = Callable[[Any, Any, Any], Any]
"""The force on the device in N, of the position in m and the velocity in m/s that the program knows and the time in s:
arrays of JAX, one value a simulation."""


class TracedLaw(NamedTuple):
    """A law and the text of its program, which differs as soon as a number that the law reads elsewhere does."""

    force: Law
    program: str

    def __call__(self, position: Any, velocity: Any, time: Any) -> Any:
        return self.force(position, velocity, time)


class Options(NamedTuple):
    """What decides the shape of the program that is compiled."""

    substeps: int
    pieces: int  # forces that may act one after the other within a substep
    friction: bool
    jitter: bool
    foaw: int  # longest window, 0 where the estimate is linear
    bodies: bool  # whether masses are known, or a linear system alone
    record: bool
    law: TracedLaw | None


class Course(NamedTuple):
    """What the simulations of a batch share."""

    periods: int
    substeps: int
    tail: int
    contact: str
    record: bool
    law: TracedLaw | None = None


class Given(NamedTuple):
    """What comes from outside, normalized, and the units of that."""

    positions: np.ndarray  # of all bodies, (bodies, lanes)
    velocities: np.ndarray
    noise: np.ndarray | None  # (periods, lanes), in m
    history: np.ndarray | None  # (periods, lanes)
    durations: np.ndarray | None  # (periods, substeps, pieces, lanes)
    instants: np.ndarray | None  # (periods + 1, lanes), in periods
    period: np.ndarray  # in s
    mass: np.ndarray  # in kg


class Motor(NamedTuple):
    """What the motor and its bearings do; 0 or infinity where they do nothing."""

    max_force: Array
    max_rate: Array
    coulomb: Array
    static: Array


class Estimator(NamedTuple):
    """The velocity estimate as a difference over a window and a filter; and FOAW's bound."""

    A: Array  # (p, p, lanes)
    B: Array  # (p, lanes)
    C: Array
    D: Array  # (lanes,)
    window: Array
    bound: Array


class Lanes(NamedTuple):
    """All that a simulation needs to know."""

    alpha: Array
    beta: Array
    period: Array  # in s
    force: Array  # what a unit of force is in N
    resolution: Array
    push: Array
    bilateral: Array  # whether the wall acts on both sides of its surface
    pulling: Array  # whether it may pull
    late: Array  # whole periods of delay
    motor: Motor
    estimator: Estimator
    rate: Array  # (n, n + forces, lanes)
    place: Array  # (bodies, n, lanes)
    motion: Array
    energy: Array  # (n, n, lanes)
    durations: Array  # (substeps, pieces, lanes), without jitter
    pieces: Flow  # over these, slipping and held, (1 or 2, substeps, pieces, ..., lanes)
    digits: Flow  # as pieces, (1 or 2, DIGITS, ..., lanes)
    longest: Array  # step with friction


def lay_scenes(parts: Any, which: np.ndarray) -> Any:
    """One array a scene, along the first axis, as one a lane along the last; of length 1 where there is one scene."""
    if isinstance(parts, tuple):
        return type(parts)(*(lay_scenes(part, which) for part in parts))
    last = np.moveaxis(parts, 0, -1)
    return last[..., which] if parts.shape[0] > 1 else last


def round_up(size: int) -> int:
    """0 or the next power of 2, at least 2: what is filled up so is compiled for a few sizes and not for every one."""
    return 0 if size == 0 else max(2, 1 << (size - 1).bit_length())


def lay_estimators(estimates: Sequence[Estimate | FOAW], which: np.ndarray) -> Estimator:
    """The estimators of all scenes, filters filled up to the longest."""
    # A window's shift register is the history of positions, which every lane has; most have nothing behind it.
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
    return lay_scenes(Estimator(*map(np.array, zip(*columns, strict=True))), which)


def cut_period(fractions: np.ndarray, substeps: int, pieces: int) -> np.ndarray:
    """How long the parts of a period are in which the force is constant, ``(scenes, substeps, pieces)``."""
    begin = np.arange(substeps) / substeps
    cut = np.clip(fractions[:, None] - begin, 0.0, 1.0 / substeps)
    parts = [cut, 1.0 / substeps - cut] if pieces > 1 else [np.full_like(cut, 1.0 / substeps)]
    return np.stack(parts, -1)


def find_longest_steps(machine: Mechanics) -> np.ndarray:
    """The longest steps with friction: powers of 2, 2 where the velocity is monotone under a constant force."""
    size = machine.rate.shape[1]
    fastest = np.abs(np.linalg.eigvals(machine.rate[:, :, :size])).max(-1)
    steps = 0.5 ** np.maximum(0, np.ceil(np.log2(np.maximum(fastest, 1e-9) / _STEP)))
    if size == 2:
        steps = np.where(machine.rate[:, 1, 0] == 0, 2.0, steps)
    if np.min(steps) * _MOST_STEPS < 1.0:
        raise InputError(
            f"coupling.stiffness, modes, actuator: a motion that turns by {fastest.max():.3g} radians a period takes "
            f"{1 / np.min(steps):.0f} steps a period to follow with friction; leave that part or the friction out"
        )
    return steps


def lay_machines(machine: Mechanics, durations: np.ndarray, which: np.ndarray, options: Options) -> dict[str, Any]:
    """The fields of `Lanes` that the bodies and the links between them decide."""
    ways = (machine.rate, machine.held) if options.friction else (machine.rate,)

    def lay(flows: Iterable[Flow]) -> Flow:
        return Flow(*(np.stack(column) for column in zip(*(lay_scenes(each, which) for each in flows), strict=True)))

    digits = Flow(*(np.zeros((1, 1, 1, 1, 1)) for _ in Flow._fields))
    if options.friction or options.jitter:
        times = np.broadcast_to(0.5 ** np.arange(DIGITS), (len(machine.rate), DIGITS))
        digits = lay(flow(way, machine.drain, times) for way in ways)
    longest = find_longest_steps(machine) if options.friction else np.array([2.0])
    return {
        "rate": lay_scenes(machine.rate, which),
        "place": machine.place[..., None],
        "motion": machine.motion[..., None],
        "energy": lay_scenes(machine.energy, which),
        "durations": lay_scenes(durations, which),
        "pieces": lay(flow(way, machine.drain, durations) for way in ways),
        "digits": digits,
        "longest": lay_scenes(longest, which),
    }
