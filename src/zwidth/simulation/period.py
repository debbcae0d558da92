"""One sampling period of every lane: measure, estimate, command, and the motion until the next sample.

Pure functions of JAX arrays whose last axis are the lanes; a state is a tuple of such arrays
(docs/theory/simulation.md, T2, T3).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from zwidth.simulation.flow import Flow
from zwidth.simulation.lanes import Lanes, Options
from zwidth.simulation.motion import BodyState, advance, dot, slide, times
from zwidth.words.types import Array


class Program(NamedTuple):
    """What the program keeps from one sample to the next."""

    positions: Array  # ring of measured positions, (length, lanes)
    filtered: Array  # state of the velocity filter
    commands: Array  # ring of commands, (length, lanes)
    touching: Array


class Reading(NamedTuple):
    """What the program made of one sample."""

    measured: Array
    velocity: Array
    command: Array
    touching: Array


class Work(NamedTuple):
    """Energy since the start."""

    wall: Array  # given by the wall
    push: Array  # given by the hand's push
    damping: Array  # taken by dampers
    friction: Array  # taken by friction


def look_back(ring: Array, k: Array, back: Array) -> Array:
    """The entry of ``back`` samples ago in every lane."""
    place = jnp.mod(k - back, ring.shape[0])
    if back.shape[-1] == 1:
        return ring[place[0]]
    return jnp.take_along_axis(ring, place[None], 0)[0]


def round_to(quantum: Any, position: Any) -> Any:
    """A position as an encoder of these steps reads it; as it is where they are 0."""
    xp = np if isinstance(position, np.ndarray) else jnp
    return xp.where(quantum > 0, quantum * xp.floor(position / xp.where(quantum > 0, quantum, 1.0) + 0.5), position)


# Of FOAW's bound.
_SLACK = 1.0 + 1e-9


def control(lanes: Lanes, options: Options, program: Program, k: Array, sensed: Array) -> tuple[Program, Reading]:
    """Measure, estimate the velocity and command a force (T2)."""
    measured = round_to(lanes.resolution, sensed)
    positions = program.positions.at[k % program.positions.shape[0]].set(measured)
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
    wanted = jnp.where(touching, wanted, 0.0)
    wanted = jnp.where(lanes.pulling, wanted, jnp.minimum(wanted, 0.0))
    motor, last = lanes.motor, program.commands[(k - 1) % program.commands.shape[0]]
    wanted = jnp.clip(wanted, -motor.max_force, motor.max_force)
    command = jnp.clip(wanted, last - motor.max_rate, last + motor.max_rate)
    commands = program.commands.at[k % program.commands.shape[0]].set(command)
    return Program(positions, filtered, commands, touching), Reading(measured, velocity, command, touching)


def _adapt_window(ring: Array, k: Array, newest: Array, bound: Array, most: int) -> Array:
    """FOAW with the line through both ends of its window: the longest before the first that fails."""
    past = ring[jnp.mod(k - np.arange(most + 1), ring.shape[0])]
    back = np.arange(1, most + 1)[:, None]
    slopes = (newest - past[1:]) / back
    missed = jnp.abs(past[1:] - (newest - slopes[:, None] * back))  # (window, sample, lanes)
    # Positions are counts: a line that misses by just the bound is not left to rounding.
    within = jnp.all((missed <= bound * _SLACK) | (back > back[:, None]), axis=1)
    length = jnp.sum(jnp.cumprod(within, 0), 0)
    return jnp.take_along_axis(slopes, jnp.maximum(length - 1, 0)[None], 0)[0]


def forces_of(lanes: Lanes, options: Options, commands: Array, k: Array) -> list[Array]:
    """The commands that act one after the other until the next sample."""
    ages = {1: (0,), 2: (1, 0), 4: (2, 1, 0, -1)}[options.pieces]
    return [look_back(commands, k, lanes.late + age) for age in ages]


def stored(lanes: Lanes, x: Array) -> Array:
    """Kinetic and elastic energy."""
    return dot(x, jnp.stack([dot(row, x) for row in lanes.energy]))


def move(
    lanes: Lanes,
    options: Options,
    body: BodyState,
    work: Work,
    force: Array,
    push: Array,
    place: tuple[Array, int],
    time: Array,
) -> tuple[BodyState, Work]:
    """The motion over one piece of a period, ``place`` its substep and its number, and what it costs."""
    none, at_once = 0.0 * body.x[0], lanes.rate.shape[1] == lanes.rate.shape[0] + 1
    forces = jnp.stack([force + push + none] if at_once else [force + none, push + none])
    whole = None if options.jitter else Flow(*(part[:, *place] for part in lanes.pieces))
    if options.friction:
        after, lost, rubbed = slide(lanes, body, forces, time, whole)
    elif whole is None:
        x, _, lost = advance(lanes.digits, np.zeros((), bool), body.x, forces, time + none)
        after, rubbed = BodyState(x, body.slip), 0.0
    else:
        z = jnp.concatenate([body.x, forces])
        x = body.x + times(whole.change[0], z)
        after, rubbed = BodyState(x, body.slip), 0.0
        lost = dot(z, times(whole.loss[0], z))
    way = dot(lanes.place[0], after.x - body.x)
    # What an actuator or modes make of the command varies within the piece: its work by the balance of the others.
    given = force * way if at_once else stored(lanes, after.x) - stored(lanes, body.x) + lost + rubbed - push * way
    moved = Work(work.wall + given, work.push + push * way, work.damping + lost, work.friction + rubbed)
    return after, moved
