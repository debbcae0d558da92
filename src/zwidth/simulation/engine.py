"""Every period of every lane: measure, estimate, command, and the motion until the next sample, in compiled blocks.

Pure functions of JAX arrays whose last axis are the lanes; a state is a tuple of such arrays
(docs/theory/simulation.md, T2, T3). A block has a fixed number of periods, so that a longer simulation compiles nothing
new.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.simulation.flow import Flow
from zwidth.simulation.lanes import Course, Given, Lanes, Options
from zwidth.simulation.motion import BodyState, advance, dot, read, slide, times
from zwidth.words.types import Array
from zwidth.words.xp import known_options

# Samples that a cycle of readings is looked for in.
CYCLE = 256
BLOCK = 128
# XLA's older emitters of loops, in one piece: compiles in half of the time, and runs no slower.
_PLAIN = ("xla_cpu_use_fusion_emitters", False), ("xla_cpu_parallel_codegen_split_count", 1)


class Program(NamedTuple):
    """What the program keeps from one sample to the next."""

    positions: Array  # ring of measured positions, (length, lanes)
    filtered: Array  # state of the velocity filter
    commands: Array  # ring of commands, (length, lanes)
    touching: Array


class Reading(NamedTuple):
    """What the program made of one sample, recorded in the rows of one array behind the position that was sensed."""

    measured: Array
    velocity: Array
    command: Array
    touching: Array


def _write(rows: Array, row: Array, place: Array) -> Array:
    return jax.lax.dynamic_update_index_in_dim(rows, row, place, 0, allow_negative_indices=False)


# A ring is as long as a power of 2, so that a place in it takes no division.
def look_back(ring: Array, k: Array, back: Array) -> Array:
    """The entry of ``back`` samples ago in every lane."""
    place = (k - back) & (len(ring) - 1)
    if back.shape[-1] == 1:
        return read(ring, place[0])
    return jnp.take_along_axis(ring, place[None], 0)[0]


@np.errstate(all="ignore")
def round_to(quantum: Any, position: Any) -> Any:
    """A position as an encoder of these steps reads it; as it is where they are 0, or too fine to be counted."""
    xp = np if isinstance(position, np.ndarray) else jnp
    read = quantum * xp.floor(position / quantum + 0.5)
    return xp.where(xp.isfinite(read), read, position)


# Of FOAW's bound.
_SLACK = 1.0 + 1e-9


def control(lanes: Lanes, options: Options, program: Program, k: Array, sensed: Array) -> tuple[Program, Reading]:
    """Measure, estimate the velocity and command a force (T2)."""
    measured = round_to(lanes.resolution, sensed)
    positions = _write(program.positions, measured, k & (len(program.positions) - 1))
    estimator = lanes.estimator
    if options.foaw:
        velocity, filtered = _adapt_window(positions, k, measured, estimator.bound, options.foaw), program.filtered
    else:
        window = estimator.window
        wide = jnp.maximum(window, 1)
        entering = jnp.where(window > 0, (measured - look_back(positions, k, window)) / wide, measured)
        velocity, filtered = estimator.D * entering, program.filtered
        if len(filtered):
            velocity = velocity + dot(estimator.C, filtered)
            filtered = times(estimator.A, filtered) + estimator.B * entering
    touching = lanes.bilateral | (measured > 0)
    if options.law is None:
        wanted = -(lanes.alpha * measured + lanes.beta * velocity)
    else:
        wanted = options.law(measured, velocity / lanes.period, k * lanes.period) / lanes.force
        # Contact of a force law means a nonzero force, because a law has no surface.
        touching &= wanted != 0
    wanted = jnp.where(touching, wanted, 0.0)
    wanted = jnp.where(lanes.pulling, wanted, jnp.minimum(wanted, 0.0))
    ring, motor = program.commands, lanes.motor
    last = read(ring, (k - 1) & (len(ring) - 1))
    wanted = jnp.clip(wanted, -motor.max_force, motor.max_force)
    command = jnp.clip(wanted, last - motor.max_rate, last + motor.max_rate)
    commands = _write(ring, command, k & (len(ring) - 1))
    return Program(positions, filtered, commands, touching), Reading(measured, velocity, command, touching)


def _adapt_window(ring: Array, k: Array, newest: Array, bound: Array, most: int) -> Array:
    """FOAW with the line through both ends of its window: the longest before the first that fails."""
    past = ring[(k - np.arange(most + 1)) & (len(ring) - 1)]
    back = np.arange(1, most + 1)[:, None]
    slopes = (newest - past[1:]) / back
    missed = jnp.abs(past[1:] - (newest - slopes[:, None] * back))  # (window, sample, lanes)
    # Positions are counts: a line that misses by just the bound is not left to rounding.
    within = jnp.all((missed <= bound * _SLACK) | (back > back[:, None]), axis=1)
    length = jnp.sum(jnp.cumprod(within, 0), 0)
    return jnp.take_along_axis(slopes, jnp.maximum(length - 1, 0)[None], 0)[0]


def stored(lanes: Lanes, x: Array) -> Array:
    """Kinetic and elastic energy."""
    return dot(x, jnp.stack([dot(row, x) for row in lanes.energy]))


def move(
    lanes: Lanes,
    options: Options,
    body: BodyState,
    work: Array,
    force: Array,
    push: Array,
    place: tuple[Array | int, Array | int],
    time: Array,
) -> tuple[BodyState, Array]:
    """The motion over one piece of a period, ``place`` its substep and its number, and what it costs."""
    none, at_once = 0.0 * body.x[0], lanes.rate.shape[1] == lanes.rate.shape[0] + 1
    forces = jnp.stack([force + push + none] if at_once else [force + none, push + none])
    whole = None if options.jitter else Flow(*(read(read(part, place[0], 1), place[1], 1) for part in lanes.pieces))
    if options.friction:
        after, lost, rubbed = slide(lanes, body, forces, time, whole)
    elif whole is None:
        x, _, lost = advance(lanes.digits, np.zeros((), bool), body.x, forces, time + none)
        after, rubbed = BodyState(x, body.slip), none
    else:
        z = jnp.concatenate([body.x, forces])
        x = body.x + times(whole.change[0], z)
        after, rubbed = BodyState(x, body.slip), none
        lost = dot(z, times(whole.loss[0], z))
    way = dot(lanes.place[0], after.x - body.x)
    # What an actuator or modes make of the command varies within the piece: its work by the balance of the others.
    given = force * way if at_once else stored(lanes, after.x) - stored(lanes, body.x) + lost + rubbed - push * way
    return after, work + jnp.stack([given, push * way, lost, rubbed])


class Summary(NamedTuple):
    """What is kept of a motion that is not recorded."""

    exits: Array  # times the wall was left
    impact: Array  # velocity at the first sample in contact
    given: Array  # the most energy that the wall has given so far
    far: Array  # how far every body went down and up, before the tail and in each of its halves, (3, 2, bodies, lanes)
    turns: Array  # how often the velocity turned positive then, (3, lanes)
    turned: Array  # when it did first and last in the tail, (2, lanes)

    @property
    def low(self) -> Array:
        return -self.far[:, 0]

    @property
    def high(self) -> Array:
        return self.far[:, 1]

    @property
    def deepest(self) -> Array:
        """The largest position at a sample."""
        return np.maximum(self.high[:, 0].max(0), 0.0)

    @property
    def widest(self) -> Array:
        """The largest distance of a body from 0."""
        return np.maximum(self.far.max((0, 1, 2)), 0.0)


class State(NamedTuple):
    """All that goes from one sample to the next."""

    body: BodyState
    program: Program
    # Energy since the start, given by the wall and by the hand's push, taken by dampers and by friction, (4, lanes).
    work: Array
    summary: Summary


class Frame(NamedTuple):
    """What is recorded at an instant, in the rows of one array: one to write is compiled sooner than nine."""

    positions: Sequence[Array]  # of each body
    velocity: Array
    force: Array
    slip: Array
    energy: Array
    work: Sequence[Array]  # as in `State`


class Inputs(NamedTuple):
    """What a period is given from outside."""

    k: Array
    noise: Array
    push: Array
    durations: Array  # (substeps, pieces, lanes) with jitter


def begin(lanes: Lanes, positions: np.ndarray, velocities: np.ndarray, rings: tuple[int, int]) -> State:
    """The state before the first sample: coming on a line, and no command on its way (T2); modes are at rest."""
    count, size = lanes.place.shape[:2]
    body = np.zeros((size, positions.shape[1]))
    # Of the bodies only: those that start together stretch nothing.
    own, first = np.linalg.inv(lanes.place[:, :count, 0]), np.argmax(lanes.motion[0, :, 0])
    body[:count], body[first : first + count] = own @ positions, own @ velocities
    x, v = body[0], body[first]
    back = np.mod(-np.arange(rings[0]), rings[0])
    # What the program would have read.
    positions = round_to(lanes.resolution, x - back[:, None] * v)
    zero, far = np.zeros(x.size), np.full((3, 2, count, x.size), -np.inf)
    program = Program(positions, _settle(lanes, positions[0], v), np.zeros((rings[1], x.size)), np.zeros(x.size, bool))
    turns = np.zeros((3, x.size))
    summary = Summary(zero, zero + np.nan, zero, far, turns, np.full((2, x.size), np.nan))
    return State(BodyState(body, np.sign(velocities[0])), program, np.zeros((4, x.size)), summary)


def _settle(lanes: Lanes, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The state of the velocity filter behind a long past on the line: of a difference constant, else growing."""
    A, B, window = (np.asarray(part) for part in (lanes.estimator.A, lanes.estimator.B, lanes.estimator.window))
    level, slope = np.where(window > 0, v, x), np.where(window > 0, 0.0, v)
    left = np.moveaxis(np.eye(len(B))[..., None] - A, -1, 0)
    columns = np.moveaxis(B, -1, 0)[..., None]
    grows = np.linalg.solve(left, columns * slope[:, None, None])
    return np.moveaxis(np.linalg.solve(left, columns * level[:, None, None] - grows)[..., 0], 0, -1)


def _period(lanes: Lanes, options: Options, ends: Array, state: State, given: Inputs) -> tuple[State, Any]:
    """One period; ``ends`` the periods at which the halves of the tail begin, and the end."""
    sensed = state.body.x[0] + given.noise
    program, reading = control(lanes, options, state.program, given.k, sensed)
    # The commands that act one after the other until the next sample.
    ages = {1: (0,), 2: (1, 0), 4: (2, 1, 0, -1)}[options.pieces]
    forces = [look_back(program.commands, given.k, lanes.late + age) for age in ages]
    durations = given.durations if options.jitter else lanes.durations
    motion = lanes.motion[0]

    def substep(carry: tuple[BodyState, Array], j: Array | int) -> tuple[tuple[BodyState, Array], Array | None]:
        body, work = carry
        frame, lasting = None, read(durations, j)
        if options.record:
            # Of pieces that take no time the force is never felt.
            acting = forces[-1]
            for piece in reversed(range(options.pieces - 1)):
                acting = jnp.where(lasting[piece] > 0, forces[piece], acting)
            positions = [dot(row, body.x) for row in lanes.place]
            frame = jnp.stack([*positions, dot(motion, body.x), acting, body.slip, stored(lanes, body.x), *work])

        def one(carry: tuple[BodyState, Array], piece: Any) -> tuple[tuple[BodyState, Array], None]:
            number, force = piece
            return move(lanes, options, *carry, force, given.push, (j, number), read(lasting, number)), None

        # What is long is compiled once, not once a piece.
        if options.friction or options.jitter:
            return jax.lax.scan(one, carry, (np.arange(options.pieces), jnp.stack(forces)))[0], frame
        for piece in enumerate(forces):
            carry, _ = one(carry, piece)
        return carry, frame

    carry = state.body, state.work
    if options.substeps > 1:
        (body, work), frames = jax.lax.scan(substep, carry, np.arange(options.substeps))
    else:
        (body, work), frame = substep(carry, 0)
        frames = None if frame is None else frame[None]
    summary = _summarize(lanes, state, reading, body, work, given.k, ends, motion)
    rows = jnp.stack([sensed, *reading] if options.record else [sensed])
    return State(body, program, work, summary), (rows, frames)


def _summarize(
    lanes: Lanes, state: State, reading: Reading, body: BodyState, work: Array, k: Array, ends: Array, motion: Array
) -> Summary:
    known = state.summary
    places = jnp.stack([dot(row, state.body.x) for row in lanes.place])
    v, next_v = dot(motion, state.body.x), dot(motion, body.x)
    hits = reading.touching & ~state.program.touching & (k > 0) & jnp.isnan(known.impact)
    turning = (v <= 0) & (next_v > 0)
    moment = k - v / jnp.where(next_v > v, next_v - v, 1.0)
    half, (first, _) = jnp.sum(k >= ends), known.turned
    turned = jnp.stack([jnp.where(jnp.isnan(first), moment, first), moment])
    return Summary(
        known.exits + (state.program.touching & ~reading.touching),
        jnp.where(hits, v, known.impact),
        jnp.fmax(known.given, work[0]),
        _write(known.far, jnp.fmax(read(known.far, half), jnp.stack([-places, places])), half),
        _write(known.turns, read(known.turns, half) + turning, half),
        jnp.where(turning & (half > 0), turned, known.turned),
    )


# Each law of the user's is a program of its own.
@lru_cache(256)
def compile_block(options: Options) -> Any:
    """A block of periods, compiled."""

    def block(lanes: Lanes, ends: Array, state: State, given: Inputs) -> tuple[State, Any]:
        size, bodies = state.work.shape[-1], len(lanes.place)
        rows = np.broadcast_to(0.0, (BLOCK, 5 if options.record else 1, size))
        frames = np.broadcast_to(0.0, (BLOCK, options.substeps, bodies + 8, size)) if options.record else None

        def one(j: Array, carry: Any) -> Any:
            state, kept = carry
            state, found = _period(lanes, options, ends, state, jax.tree.map(lambda part: read(part, j), given))
            return state, jax.tree.map(lambda rows, row: _write(rows, row, j), kept, found)

        return jax.lax.fori_loop(0, jnp.minimum(BLOCK, ends[-1] - given.k[0]), one, (state, (rows, frames)))

    return jax.jit(block, donate_argnums=2, compiler_options=known_options(*_PLAIN))


def run_lanes(
    lanes: Lanes, options: Options, course: Course, given: Given, rings: tuple[int, int]
) -> tuple[State, np.ndarray, Reading | None, Frame | None]:
    """The last state, the last positions, and what is recorded along a first axis of periods (and of substeps)."""
    edges = course.periods - course.tail * np.arange(2, -1, -1) // 2
    # All arrays in one go: one by one they cost as much as the motion.
    start: Any = begin(lanes, given.positions, given.velocities, rings)
    state, placed, ends = jax.device_put((start, lanes, edges))
    recorded: Any = deque(maxlen=None if options.record else CYCLE // BLOCK + 1)
    for first in range(0, course.periods, BLOCK):
        inputs = Inputs(
            np.arange(first, first + BLOCK),
            _cut(given.noise, first, (1,)),
            lanes.push[None] + _cut(given.history, first, (1,)),
            _cut(given.durations, first, (0, 0, 1)),
        )
        # Lanes are last axes on purpose, whatever the caller wants of arrays of theirs.
        with jax.numpy_rank_promotion("allow"):
            state, found = compile_block(options)(placed, ends, state, inputs)
        recorded.append(jax.tree.map(np.asarray, found))
    behind = -course.periods % BLOCK
    rows, frames = jax.tree.map(lambda *parts: np.concatenate(parts)[: BLOCK * len(parts) - behind], *recorded)
    sensed, *read = np.moveaxis(rows, 1, 0)
    reading = frame = None
    if options.record:
        *positions, velocity, force, slip, energy, wall, push, damping, friction = np.moveaxis(frames, 2, 0)
        reading = Reading(*read)
        frame = Frame(positions, velocity, force, slip, energy, (wall, push, damping, friction))
    return jax.tree.map(np.asarray, state), sensed[-CYCLE:], reading, frame


def _cut(values: np.ndarray | None, first: int, shape: tuple[int, ...]) -> np.ndarray:
    """The block of values along time that begins there, filled up with 0; of one lane where there are none."""
    if values is None:
        return np.zeros((BLOCK, *shape))
    part = values[first : first + BLOCK]
    return np.pad(part, ((0, BLOCK - len(part)), *((0, 0),) * (part.ndim - 1)))
