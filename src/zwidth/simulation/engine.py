"""Simulate a batch period by period: measure, estimate, command, and propagate the bodies until the next sample.

All functions are pure functions of JAX arrays whose last axis is the batch (docs/theory/simulation.md, T2 and T3). k is
the index of a sample. One compiled *block* simulates a fixed number of periods, so that a longer simulation needs no
further compilation. A period is divided into *substeps*, at whose starts a *frame* is recorded, and a substep into
*pieces* with constant force; a *reading* is the result of the control program at one sample. A *ring* is a circular
buffer of positions or commands, indexed by k modulo its length. The *tail* is the last part of a simulation, in which
its behavior is classified. ``x`` is the state of the bodies; its products with the rows of ``params.place`` and
``params.motion`` are their positions and velocities. FOAW is the adaptive velocity estimate of Janabi-Sharifi et al.
2000.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import compile_with_options
from zwidth.plant.transition import Transition
from zwidth.simulation.controller import Controller, Reading, control, look_back, start_controller, write
from zwidth.simulation.parameters import ExternalInputs, Options, Parameters, Settings
from zwidth.simulation.propagation import BodyState, advance, dot, propagate_with_friction, read, times

BLOCK = 128  # number of sampling periods that one call of the compiled program simulates
SEGMENTS = 6  # number of equal segments of the tail; even, because the trend compares the two halves of the tail
# Use XLA's older loop emitters, and generate the code of a program in one part, because this halves the compile time
# and does not change the run time. Require full optimization even if XLA_FLAGS sets a lower level, because a simulation
# runs for thousands of periods.
COMPILER_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
    "xla_backend_optimization_level": 3,
}


class Summary(NamedTuple):
    """Statistics of the motion from the start to the current sample.

    Index 0 of the first axis of `far` and `turns` is the time before the tail; the others are the segments of the tail.
    """

    exits: Array  # number of samples at which contact ends, (batch,)
    impact: Array  # velocity at the first sample at which contact begins, (batch,); NaN before
    given: Array  # maximum over time of the energy supplied by the wall, (batch,)
    far: Array  # maximum of -position and of position per body, (1 + SEGMENTS, 2, bodies, batch); initially -inf
    turns: Array  # number of times that the velocity of the device becomes positive, (1 + SEGMENTS, batch)
    turned: Array  # first and last instant in the tail at which it becomes positive, in periods, (2, batch)


class State(NamedTuple):
    """State of all simulations of the batch at a sample."""

    body: BodyState  # state of the bodies
    controller: Controller  # state of the control program
    work: Array  # energies supplied by the wall and the external force, dissipated by dampers and friction, (4, batch)
    summary: Summary  # statistics of the motion


class PeriodInputs(NamedTuple):
    """External inputs of one period, or of a block of periods along a first axis."""

    k: Array  # index of the period and of the sample at its start
    noise: Array  # error of the measured position
    external_force: Array  # external force on the device
    durations: Array  # durations of constant force, (substeps, pieces, batch); used with jitter only


def stored_energy(params: Parameters, x: Array) -> Array:
    """Return the sum of the kinetic and the elastic energies of all bodies in the state ``x``."""
    return dot(x, jnp.stack([dot(row, x) for row in params.energy]))


def propagate(
    params: Parameters,
    options: Options,
    body: BodyState,
    work: Array,
    force: Array,
    external_force: Array,
    indices: tuple[Array | int, Array | int],
    time: Array,
) -> tuple[BodyState, Array]:
    """Propagate the bodies over one piece with constant forces, and add the work and the losses to the energies.

    Args:
        params: parameters of the simulations.
        options: structure of the compiled program.
        body: state of the bodies at the start of the piece.
        work: the four energies of `State` at the start of the piece.
        force: force of the wall (with an actuator, its command).
        external_force: external force on the device.
        indices: indices of the substep and of the piece.
        time: duration of the piece, in periods.

    Returns:
        The state of the bodies and the energies at the end of the piece.
    """
    zero, direct = 0.0 * body.x[0], params.rate.shape[1] == params.rate.shape[0] + 1
    forces = jnp.stack([force + external_force + zero] if direct else [force + zero, external_force + zero])
    selected = (read(read(part, indices[0], 1), indices[1], 1) for part in params.pieces)
    step = None if options.jitter else Transition(*selected)
    rubbed = zero
    if options.friction:
        after, lost, rubbed = propagate_with_friction(params, body, forces, time, step)
    elif step is None:
        x, _, lost = advance(params.digits, np.zeros((), bool), body.x, forces, time + zero)
        after = BodyState(x, body.slip)
    else:
        z = jnp.concatenate([body.x, forces])
        after = BodyState(body.x + times(step.change[0], z), body.slip)
        lost = dot(z, times(step.loss[0], z))
    pushed = external_force * dot(params.place[0], after.x - body.x)
    if direct:
        given = force * dot(params.place[0], after.x - body.x)
    else:
        # Compute the work of the wall from the energy balance, because with an actuator or modes the force of the wall
        # on the bodies varies within the piece.
        given = stored_energy(params, after.x) - stored_energy(params, body.x) + lost + rubbed - pushed
    return after, work + jnp.stack([given, pushed, lost, rubbed])


def initial_state(params: Parameters, options: Options, inputs: ExternalInputs, rings: tuple[int, int]) -> State:
    """Return the state before the first sample, after uniform motion without commands and with modes at rest (T2).

    ``rings`` contains the lengths of the rings of positions and of commands.
    """
    count, size = params.place.shape[:2]
    body = np.zeros((size, inputs.positions.shape[1]))
    # Set the coordinates of the bodies and leave those of the modes at 0. Links between bodies at equal positions are
    # then unstretched.
    inverse, first = np.linalg.inv(params.place[:, :count, 0]), np.argmax(params.motion[0, :, 0])
    body[:count], body[first : first + count] = inverse @ inputs.positions, inverse @ inputs.velocities
    x, v = body[0], body[first]
    controller, zero = start_controller(params, options, (x, v), inputs.tool, rings), np.zeros(x.size)
    count += options.tool  # one more row of statistics for the position of the tool
    far, turns = np.full((1 + SEGMENTS, 2, count, x.size), -np.inf), np.zeros((1 + SEGMENTS, x.size))
    summary = Summary(zero, zero + np.nan, zero, far, turns, np.full((2, x.size), np.nan))
    return State(BodyState(body, np.sign(inputs.velocities[0])), controller, np.zeros((4, x.size)), summary)


def _simulate_period(
    params: Parameters, options: Options, ends: Array, state: State, inputs: PeriodInputs
) -> tuple[State, Any]:
    """Simulate one sampling period: run the control program at its start and propagate the bodies to its end.

    Args:
        params: parameters of the simulations.
        options: structure of the compiled program.
        ends: indices of the periods at which the segments of the tail begin, and the number of periods.
        state: state at the sample at the start of the period.
        inputs: external inputs of the period.

    Returns:
        The state at the next sample, and the reading and the frames of the period; None if nothing is recorded.
    """
    controller, reading = control(params, options, state.controller, inputs.k, state.body.x[0] + inputs.noise)
    # List the commands that may act before the next sample, in the order in which they take effect. Each is selected by
    # its age, the number of samples by which it precedes the command of sample k - late, where late is the integer
    # delay.
    ages = {1: (0,), 2: (1, 0), 4: (2, 1, 0, -1)}[options.pieces]
    forces = [look_back(controller.commands, inputs.k, params.late + age) for age in ages]
    durations = inputs.durations if options.jitter else params.durations

    def substep(carry: Any, j: Any) -> Any:
        (body, work), frame, lasting = carry, None, read(durations, j)
        if options.record:
            # Record the force of the first piece whose duration is positive, because a force over a piece without
            # duration has no effect.
            acting = forces[-1]
            for piece in reversed(range(options.pieces - 1)):
                acting = jnp.where(lasting[piece] > 0, forces[piece], acting)
            positions = [dot(row, body.x) for row in params.place]
            rows = dot(params.motion[0], body.x), acting, body.slip, stored_energy(params, body.x)
            frame = jnp.stack([*positions, *rows, *work])

        def one(carry: Any, piece: Any) -> Any:
            number, force = piece
            body, work = carry
            return propagate(
                params, options, body, work, force, inputs.external_force, (j, number), read(lasting, number)
            ), None

        # With friction or jitter, loop over the pieces by `scan`, because the program of one piece is then long and
        # should be compiled only once.
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
    summary = _summarize(params, state, reading, body, work, inputs.k, ends)
    readings = jnp.stack([row for row in reading if row is not None])
    return State(body, controller, work, summary), (readings, frames) if options.record else None


def _summarize(
    params: Parameters, state: State, reading: Reading, body: BodyState, work: Array, k: Array, ends: Array
) -> Summary:
    """Return the statistics of the motion, updated by the motion during period k.

    Args:
        params: parameters of the simulations.
        state: state at the start of the period.
        reading: reading at the start of the period.
        body: state of the bodies at the end of the period.
        work: energies at the end of the period.
        k: index of the period.
        ends: indices of the periods at which the segments of the tail begin, and the number of periods.
    """
    summary, before = state.summary, state.controller.touching
    places = [dot(row, state.body.x) for row in params.place]
    places = jnp.stack(places if reading.tool_position is None else [*places, reading.tool_position])
    v, next_v = dot(params.motion[0], state.body.x), dot(params.motion[0], body.x)
    hits = reading.touching & ~before & (k > 0) & jnp.isnan(summary.impact)
    turning = (v <= 0) & (next_v > 0)
    moment = k - v / jnp.where(next_v > v, next_v - v, 1.0)
    segment, first = jnp.sum(k >= ends), summary.turned[0]
    turned = jnp.stack([jnp.where(jnp.isnan(first), moment, first), moment])
    return Summary(
        summary.exits + (before & ~reading.touching),
        jnp.where(hits, v, summary.impact),
        jnp.fmax(summary.given, work[0]),
        write(summary.far, jnp.fmax(read(summary.far, segment), jnp.stack([-places, places])), segment),
        write(summary.turns, read(summary.turns, segment) + turning, segment),
        jnp.where(turning & (segment > 0), turned, summary.turned),
    )


@lru_cache(256)  # bound the number of cached programs, because each force law needs a separate one
def compile_block(options: Options) -> Any:
    """Return the compiled function that simulates one block of periods."""

    def block(params: Parameters, ends: Array, state: State, inputs: PeriodInputs) -> tuple[State, Any]:
        size, bodies = state.work.shape[-1], len(params.place)
        shapes = (BLOCK, 6 if options.tool else 4, size), (BLOCK, options.substeps, bodies + 8, size)
        rows = tuple(np.broadcast_to(0.0, shape) for shape in shapes) if options.record else None

        def one(j: Array, carry: Any) -> Any:
            state, kept = carry
            period = jax.tree.map(lambda part: read(part, j), inputs)
            state, record = _simulate_period(params, options, ends, state, period)
            return state, jax.tree.map(lambda rows, row: write(rows, row, j), kept, record)

        return jax.lax.fori_loop(0, jnp.minimum(BLOCK, ends[-1] - inputs.k[0]), one, (state, rows))

    return compile_with_options(block, COMPILER_OPTIONS, donate_argnums=2)


def run_batch(
    params: Parameters, options: Options, settings: Settings, inputs: ExternalInputs, rings: tuple[int, int]
) -> tuple[State, np.ndarray | None, np.ndarray | None]:
    """Simulate a batch block by block, from the initial state to the last period.

    Args:
        params: parameters of the simulations.
        options: structure of the compiled program.
        settings: settings that all simulations share.
        inputs: initial state and external inputs.
        rings: lengths of the rings of positions and of commands.

    Returns:
        The final state; the readings, of shape (periods, 4, batch) or, with a tool, (periods, 6, batch); and the
        frames, of shape (periods, substeps, rows, batch). Readings and frames are None if nothing is recorded.
    """
    edges = settings.periods - settings.tail * np.arange(SEGMENTS, -1, -1) // SEGMENTS
    # Transfer all arrays to JAX in one call, because separate transfers would take as long as the simulation itself.
    start: Any = initial_state(params, options, inputs, rings)
    state, placed, ends = jax.device_put((start, params, edges))
    recorded: Any = []
    for first in range(0, settings.periods, BLOCK):
        block = PeriodInputs(
            np.arange(first, first + BLOCK),
            _select_block(inputs.noise, first, (1,)),
            params.external_force[None] + _select_block(inputs.history, first, (1,)),
            _select_block(inputs.durations, first, (0, 0, 1)),
        )
        # Allow rank promotion even if the caller's settings of JAX forbid it, because arrays without a batch axis must
        # broadcast.
        with jax.numpy_rank_promotion("allow"):
            state, block_records = compile_block(options)(placed, ends, state, block)
        if options.record:
            recorded.append(jax.tree.map(np.asarray, block_records))
    final = jax.tree.map(np.asarray, state)
    if not options.record:
        return final, None, None
    readings, frames = (np.concatenate(parts)[: settings.periods] for parts in zip(*recorded, strict=True))
    return final, readings, frames


def _select_block(values: np.ndarray | None, first: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return the values of the periods in one block; ``first`` is the index of its first period.

    Args:
        values: values per period along the first axis; None if all are 0.
        first: index of the first period of the block.
        shape: shape of the zeros that are returned per period if ``values`` is None.

    Returns:
        Values of shape (BLOCK, ...), padded with zeros after the last period.
    """
    if values is None:
        return np.zeros((BLOCK, *shape))
    part = values[first : first + BLOCK]
    return np.pad(part, ((0, BLOCK - len(part)), *((0, 0),) * (part.ndim - 1)))
