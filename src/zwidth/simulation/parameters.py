"""Build the parameters of a batch of simulations, as arrays whose last axis is the batch.

Units are the sampling period, the mass that the force of the wall acts on, and m. A last axis of length 1 broadcasts
over the batch. A period is divided into equal *substeps*, and a substep into *pieces* with constant force. n is the
length of the state x of the bodies (`simulation.mechanics`). The first body *slips*, or friction *holds* it. FOAW is
the adaptive velocity estimate of Janabi-Sharifi et al. 2000. T1 to T7 are steps of docs/theory/simulation.md.

In every period the control program computes the position estimate p from the measured position, and the velocity
estimate v from p or from the measured position. The *further feedback* (`model.feedback`), such as an integral gain, is
a force r in addition to the spring and damper of the wall, computed from p, v or the measured position.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.types import Array
from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import LoopEstimates
from zwidth.model.state_space import realize_estimate
from zwidth.model.tool import ToolStep
from zwidth.model.velocity import FOAW
from zwidth.plant.transition import Transition, compute_transition
from zwidth.simulation.mechanics import Mechanics

# Longest step with friction, as the angle in rad by which the fastest oscillation advances. A longer step could contain
# two events, i.e. changes between slipping and holding (T5).
LONGEST_ANGLE = 0.25
DIGITS = 53  # number of binary digits of a float64 time below 2 periods: 1, 1/2, ... 2^-52
MOST_STEPS = 256  # largest number of steps per period with friction, to limit the run time


Law: TypeAlias = Callable[[Any, Any, Any], Any]
"""Force on the device in N as a function of the measured position in m, the estimated velocity in m/s and the time in
s. All arguments are JAX arrays with one value per simulation."""


class TracedLaw(NamedTuple):
    """Force law of the user, together with the program that JAX traces from it."""

    force: Law  # function of the user
    program: str  # text of the traced program, so that laws with different constants do not share a compiled block

    def __call__(self, position: Any, velocity: Any, time: Any) -> Any:
        return self.force(position, velocity, time)


class Options(NamedTuple):
    """Options that determine the compiled program of a simulation."""

    substeps: int  # number of substeps per period
    pieces: int  # number of pieces per substep, that is, of different forces within it
    friction: bool  # some simulation has dry friction
    jitter: bool  # some simulation has timestamp jitter
    foaw: int  # longest window of FOAW in samples; 0 for a linear velocity estimate
    position: bool  # the scenes have a position estimate
    feedback: bool  # the scenes have further feedback, such as an integral gain
    tool: bool  # the scenes have a tool that a virtual coupling connects to the device

    @property
    def filters_tool(self) -> bool:
        """True if the velocities of tool and device are estimated separately (docs/theory/simulation.md, T9)."""
        return self.tool and (self.position or self.feedback)

    record: bool  # readings and frames are recorded
    law: TracedLaw | None  # force law in place of the wall's spring and damper


class Settings(NamedTuple):
    """Settings that all simulations of a batch share: lengths, kind of contact and force law."""

    periods: int  # number of sampling periods
    substeps: int  # number of substeps per period
    tail: int  # number of periods at the end whose motion is classified
    contact: str  # "bilateral", "unilateral" or "push_only"
    record: bool  # readings and frames are recorded
    law: TracedLaw | None = None  # force law in place of the wall's spring and damper


class ExternalInputs(NamedTuple):
    """Initial state, external forces and random numbers in normalized units, and the units of time and mass in SI."""

    positions: np.ndarray  # initial positions, (bodies, batch)
    velocities: np.ndarray  # initial velocities, (bodies, batch)
    noise: np.ndarray | None  # errors of the measured positions in m, (periods, batch); None without noise
    history: np.ndarray | None  # external force per period, (periods, batch); None without a history
    tool: np.ndarray  # initial position of the tool (NaN: position of the device), and change per period; (2, batch)
    durations: np.ndarray | None  # durations of the pieces, (periods, substeps, pieces, batch); None without jitter
    instants: np.ndarray | None  # instants of the samples in periods, (periods + 1, batch); None without jitter
    period: np.ndarray  # sampling period, in s
    mass: np.ndarray  # mass that the force of the wall acts on, in kg


class Motor(NamedTuple):
    """Limits of the motor (infinite without limits) and dry friction of the first body (0 without friction)."""

    max_force: Array  # largest magnitude of the command
    max_rate: Array  # largest change of the command per period
    coulomb: Array  # Coulomb friction while the first body slips
    static: Array  # static friction while the first body is held


class Filter(NamedTuple):
    """State-space matrices of one filter per simulation, all of order q."""

    A: Array  # filter matrix, (q, q, batch)
    B: Array  # input vector, (q, batch)
    C: Array  # output vector, (q, batch)
    D: Array  # direct feedthrough, (batch,)


class Estimator(NamedTuple):
    """Velocity estimate: a position difference over a window, followed by a filter; or FOAW."""

    filter: Filter  # filter after the difference
    window: Array  # length of the window in samples; 0 if the input of the filter is the position
    bound: Array  # noise bound of FOAW, in m


class FeedbackLoop(NamedTuple):
    """Further feedback force: a filter of a weighted sum of the measured position and the two estimates."""

    filter: Filter
    weights: Array  # weights of measured position, position estimate and velocity estimate, (3, batch)


class Parameters(NamedTuple):
    """Parameters of the simulations of a batch, in units of sampling period, mass and m unless stated otherwise."""

    alpha: Array  # normalized stiffness
    beta: Array  # normalized virtual damping
    period: Array  # sampling period, in s
    force: Array  # unit of force, in N
    resolution: Array  # step of the encoder, in m
    external_force: Array  # constant external force
    bilateral: Array  # True if the wall acts on both sides of its surface
    pulling: Array  # True if the wall may pull the device
    late: Array  # integer delay, in periods
    motor: Motor  # limits of the motor and friction
    position: Filter  # position estimate
    filtered_input: Array  # True if the velocity estimate is computed from the position estimate, not the measurement
    estimator: Estimator  # velocity estimate
    feedback: FeedbackLoop  # feedback in addition to spring and damper, such as an integral gain
    tool: ToolStep  # integration step of the tool; its fields are 0 without a tool
    tool_estimator: Estimator  # estimate of the velocity of the tool in scenes with `Options.filters_tool`
    rate: Array  # matrix of x' = rate @ (x, u), (n, n + forces, batch)
    place: Array  # rows of the positions of the bodies, (bodies, n, batch)
    motion: Array  # rows of the velocities of the bodies, (bodies, n, batch)
    energy: Array  # quadratic form in x of the kinetic and elastic energy, (n, n, batch)
    durations: Array  # durations of the pieces without jitter, (substeps, pieces, batch)
    # Matrices of the motion over each piece, for a first body that slips and, with friction, for one that is held; the
    # axes are (1 or 2, substeps, pieces, ..., batch).
    pieces: Transition
    # Matrices of the motion over each binary digit of time, for a first body that slips and, with friction, for one
    # that is held; the axes are (1 or 2, DIGITS, ..., batch).
    digits: Transition
    longest: Array  # longest step with friction, in periods


def spread_scenes(parts: Any, which: np.ndarray) -> Any:
    """Return an array with one value per simulation, from an array with one value per scene.

    Args:
        parts: array whose first axis is the scene, or a named tuple of such arrays.
        which: index of the scene of each simulation.

    Returns:
        The arrays with the batch as their last axis, of length 1 if there is only one scene.
    """
    if isinstance(parts, tuple):
        return type(parts)(*(spread_scenes(part, which) for part in parts))
    last = np.moveaxis(parts, 0, -1)
    return last[..., which] if parts.shape[0] > 1 else last


def round_up(size: int) -> int:
    """Return the next power of 2, at least 2, to limit the number of compilations; 0 for a size of 0."""
    return 0 if size == 0 else max(2, 1 << (size - 1).bit_length())


def _build_filters(estimates: Sequence[Estimate]) -> Filter:
    """Return the state-space matrices of one filter per scene, padded to the largest order; first axis: scene."""
    count = len(estimates)
    # Omit the difference over a window from the filter, because the engine computes this difference from the stored
    # positions of the last samples.
    filters = {
        k: realize_estimate(replace(each, window=0)) for k, each in enumerate(estimates) if each.degree > each.window
    }
    order = round_up(max((matrices.A.shape[0] for matrices in filters.values()), default=0))
    A, B, C = np.zeros((count, order, order)), np.zeros((count, order)), np.zeros((count, order))
    D = np.array([float(each.gain) for each in estimates])
    for k, matrices in filters.items():
        size = matrices.A.shape[0]
        A[k, :size, :size], B[k, :size], C[k, :size] = matrices.A, matrices.B[:, 0], matrices.C[0]
        D[k] = matrices.D[0, 0]
    return Filter(A, B, C, D)


def build_program(
    programs: Sequence[LoopEstimates], velocities: Sequence[Any], which: np.ndarray, filters_tool: bool
) -> dict[str, Any]:
    """Return the filters of the control program for all simulations, keyed by field name in `Parameters`.

    Args:
        programs: position estimate, velocity estimate and further feedback of each scene, all linear.
        velocities: velocity estimate of each scene, used in place of that in ``programs``, because it may be FOAW,
            which is not linear.
        which: index of the scene of each simulation.
        filters_tool: True if the velocities of tool and device are estimated separately.
    """
    none = Estimate(0, 0.0)
    feedbacks = [each.feedback for each in programs]
    weights = np.zeros((len(programs), 3))
    for k, feedback in enumerate(feedbacks):
        weights[k] = (1.0, 0.0, 0.0) if feedback is None or feedback.weights is None else (0.0, *feedback.weights)
    adapts = isinstance(velocities[0], FOAW)
    estimator = Estimator(
        _build_filters([none if adapts else each for each in velocities]),
        np.array([each.samples if adapts else each.window for each in velocities]),
        np.array([each.noise if adapts else 0.0 for each in velocities]),
    )
    of_tool = [each.of_tool if filters_tool else none for each in programs]
    windows = np.array([each.window for each in of_tool])
    further = _build_filters([none if each is None else each.filter for each in feedbacks])
    return {
        "position": spread_scenes(_build_filters([each.position for each in programs]), which),
        "filtered_input": spread_scenes(np.array([each.structure == "series" for each in programs]), which),
        "estimator": spread_scenes(estimator, which),
        "tool_estimator": spread_scenes(Estimator(_build_filters(of_tool), windows, 0.0 * windows), which),
        "feedback": spread_scenes(FeedbackLoop(further, weights), which),
    }


def cut_period(lengths: np.ndarray, effective: Sequence[np.ndarray], substeps: int) -> np.ndarray:
    """Divide each period into substeps, and each substep into pieces with constant force.

    Args:
        lengths: lengths of the periods, (..., batch).
        effective: instants at which the force changes, relative to the start of the period, in increasing order; each
            an array of shape (..., batch).
        substeps: number of substeps per period.

    Returns:
        Durations of the pieces, (..., substeps, pieces, batch). The number of pieces is that of the changes plus 1.
    """
    substep = np.arange(substeps)[:, None] * lengths[..., None, :] / substeps
    part = np.broadcast_to(lengths[..., None, :] / substeps, substep.shape)
    cuts = [np.clip(time[..., None, :] - substep, 0.0, part) for time in effective]
    return np.moveaxis(np.diff([np.zeros(part.shape), *cuts, part], axis=0), 0, -2)


def find_longest_steps(machine: Mechanics) -> np.ndarray:
    """Return the longest step with friction of each scene, in periods (T5).

    The steps are powers of 2, of at most `LONGEST_ANGLE` of the fastest motion. For a single body without spring the
    result is 2, more than any period. Raise `InputError` if a period would need more than `MOST_STEPS` steps.
    """
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


def build_transitions(machine: Mechanics, durations: np.ndarray, which: np.ndarray, options: Options) -> dict[str, Any]:
    """Return the matrices of the mechanisms and of their motion over given times, keyed by the fields of `Parameters`.

    Args:
        machine: matrices of the mechanisms of all scenes.
        durations: durations of the pieces without jitter, (scenes, substeps, pieces).
        which: index of the scene of each simulation.
        options: structure of the compiled program.
    """
    ways = (machine.rate, machine.held) if options.friction else (machine.rate,)

    def integrate(times: np.ndarray) -> Transition:
        """Return the motion over times of shape (scenes, ...), for each way, with the batch as the last axis."""
        inner = (len(times), *(1,) * (times.ndim - 1))
        drain = machine.drain.reshape(*inner, *machine.drain.shape[1:])
        motions = (compute_transition(way.reshape(*inner, *way.shape[1:]), times, drain) for way in ways)
        spread = (spread_scenes(motion, which) for motion in motions)
        return Transition(*(np.stack(column) for column in zip(*spread, strict=True)))

    digits = Transition(*(np.zeros((1, 1, 1, 1, 1)) for _ in Transition._fields))
    if options.friction or options.jitter:
        times = np.broadcast_to(0.5 ** np.arange(DIGITS), (len(machine.rate), DIGITS))
        digits = integrate(times)
    longest = find_longest_steps(machine) if options.friction else np.array([2.0])
    return {
        "rate": spread_scenes(machine.rate, which),
        "place": machine.place[..., None],
        "motion": machine.motion[..., None],
        "energy": spread_scenes(machine.energy, which),
        "durations": spread_scenes(durations, which),
        "pieces": integrate(durations),
        "digits": digits,
        "longest": spread_scenes(longest, which),
    }
