"""Propagation over any duration by its binary digits, with the events of dry friction.

Pure functions of JAX arrays whose last axis is the batch. The slip of the first body is -1 or 1 while it slips in that
direction, 0 while friction holds it. Events start and end slip (docs/theory/simulation.md, T4 and T5). The reserve of
the first body is positive between events and 0 at an event. While the body slips, it is the speed. While the body is
held, it is the static friction minus the sum of the other forces, in the mean direction of this sum during the step.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.simulation.flow import DIGITS, Flow
from zwidth.simulation.parameters import Parameters
from zwidth.words.types import Array

MOST_EVENTS = 512  # events per piece; a simulation with more is NaN
LAST_DIGIT = 0.5 ** (DIGITS - 1)  # shortest step, in sampling periods
# Simulations with events continue in groups of 1/FRACTION of the batch, because a piece with an event takes a hundred
# times as long as one without.
FRACTION = 8


class BodyState(NamedTuple):
    """State of the bodies and slip of the first one."""

    x: Array  # (n, batch)
    slip: Array


def read(rows: Array, index: Array | int, axis: int = 0) -> Array:
    """Return the row at an index >= 0; `jax.Array.__getitem__` compiles more operations."""
    return jax.lax.dynamic_index_in_dim(rows, index, axis, keepdims=False, allow_negative_indices=False)


def times(matrix: Array, vector: Array) -> Array:
    """Return the product of a small matrix and a vector for each batch entry, without a library call."""
    return jnp.stack([dot(row, vector) for row in matrix])


def dot(row: Array, vector: Array) -> Array:
    """Return the sum of products for each batch entry."""
    return reduce(add, (a * x for a, x in zip(row, vector, strict=True)))


def advance(
    digits: Flow,
    held: Array,
    x: Array,
    forces: Array,
    limit: Array,
    keep: Callable[[Array], Array] | None = None,
    which: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Propagate for the longest time up to ``limit`` at whose end ``keep`` holds.

    Args:
        digits: flows over the binary digits of time, slipping and held.
        held: mask of the batch entries whose first body is held.
        x: state of the bodies.
        forces: constant forces.
        limit: longest time, in sampling periods.
        keep: condition on the state; always true if left out.
        which: indices of the batch entries in ``x``; all if left out.

    Returns:
        State, time, and energy dissipated by the dampers.
    """

    def pick(part: Array, k: Array) -> Array:
        ways = [_take(read(way, k), which) for way in part]
        return jnp.where(held, ways[1], ways[0]) if len(ways) > 1 else ways[0]

    def remain(state: Any) -> Array:
        k, _, time, _ = state
        return (k < DIGITS) & jnp.any(time < limit)

    def step(state: Any) -> Any:
        k, x, time, lost = state
        z = jnp.concatenate([x, forces])
        longer, after = time + jnp.exp2(-k.astype(time.dtype)), x + times(pick(digits.change, k), z)
        taken = (longer <= limit) & (True if keep is None else keep(after))
        lost = jnp.where(taken, lost + dot(z, times(pick(digits.loss, k), z)), lost)
        return k + 1, jnp.where(taken, after, x), jnp.where(taken, longer, time), lost

    # Skip the digits that are longer than the longest limit.
    first = jnp.floor(-jnp.log(jnp.max(limit)) / np.log(2.0)).clip(0, DIGITS - 1).astype(int)
    return jax.lax.while_loop(remain, step, (first, x, 0.0 * limit, 0.0 * limit))[1:]


def _take(part: Array, which: Array | None) -> Array:
    """Return the selected batch entries; the last entry in place of an index out of range."""
    return part if which is None or part.shape[-1] == 1 else part.at[..., which].get(mode="clip")


class _Slide(NamedTuple):
    """State of a piece with friction."""

    body: BodyState
    left: Array  # remaining duration
    lost: Array  # energy dissipated by dampers
    rubbed: Array  # energy dissipated by friction
    events: Array

    @property
    def pending(self) -> Array:
        """Mask of the batch entries whose piece is not finished."""
        return (self.left > 0) & (self.events < MOST_EVENTS)


class _Trip(NamedTuple):
    """State, time and loss at the end of a step, with and without an event."""

    x: Array
    time: Array
    lost: Array
    far: Array  # state at the end of the step if no event occurs
    spent: Array  # energy dissipated by the dampers if no event occurs
    over: Array  # an event ends the step


class _Joint(NamedTuple):
    """Dry friction of the first body under constant forces; friction adds to the last force."""

    motion: Array  # row of the velocity that friction acts on
    place: Array  # row of its position
    rate: Array
    pull: Array  # row of its acceleration, which equals the force, because its mass is the unit
    longest: Array
    coulomb: Array
    static: Array
    forces: Array

    def pressed(self, x: Array) -> Array:
        """Return the force on the first body without friction."""
        return dot(self.pull[:-1], [*x, *self.forces[:-1]]) + self.forces[-1]

    def speed(self, x: Array) -> Array:
        """Return the velocity of the first body."""
        return dot(self.motion, x)

    def drive(self, slip: Array) -> Array:
        """Return the forces including Coulomb friction."""
        return jnp.stack([*self.forces[:-1], self.forces[-1] - slip * self.coulomb])

    def decide(self, x: Array, slip: Array, stopped: Array) -> BodyState:
        """Hold or release a stopped body."""
        push = self.pressed(x)
        # Remove the remaining velocity as an impulse on the first body does.
        x = jnp.where(stopped, x - self.rate[:, -1] * self.speed(x), x)
        return BodyState(x, jnp.where(stopped, jnp.where(jnp.abs(push) > self.static, jnp.sign(push), 0.0), slip))

    def reserve(self, x: Array, slip: Array, side: Array) -> Array:
        """Return the reserve; ``side``: direction of the force on a held body."""
        return jnp.where(slip == 0, self.static - side * self.pressed(x), slip * self.speed(x))

    def slope(self, x: Array, slip: Array, side: Array) -> Array:
        """Return the rate of change of the reserve."""
        change = times(self.rate, jnp.concatenate([x, self.drive(slip)]))
        stuck = -side * dot(self.pull[: len(x)], change - self.rate[:, -1] * self.speed(change))
        return jnp.where(slip == 0, stuck, slip * (self.pressed(x) - slip * self.coulomb))

    def find_side(self, x: Array, far: Array) -> Array:
        """Return the direction of the mean force on a held body during a step that ends at ``far``."""
        return jnp.sign(self.pressed(x) + self.pressed(far))

    def dips(self, x: Array, slip: Array, far: Array, side: Array) -> Array:
        """Return a mask of the steps at whose start the reserve decreases and at whose end it increases."""
        dips = (self.slope(x, slip, side) < 0) & (self.slope(far, slip, side) > 0)
        # Exclude a body just released, because its velocity is a rounding error.
        return (self.reserve(far, slip, side) > 0) & dips & ((slip == 0) | (self.speed(x) != 0))

    def account(self, state: _Slide, moving: Array, after: BodyState, left: Array, lost: Array) -> _Slide:
        """Return the state after a step of the moving batch entries."""
        (x, slip), way = state.body, dot(self.place, after.x - state.body.x)
        return _Slide(
            BodyState(jnp.where(moving, after.x, x), jnp.where(moving, after.slip, slip)),
            jnp.where(moving, jnp.where(left > LAST_DIGIT, left, 0.0), state.left),
            state.lost + jnp.where(moving, lost, 0.0),
            state.rubbed + jnp.where(moving, slip * self.coulomb * way, 0.0),
            state.events + moving,
        )

    def glide(self, state: _Slide, whole: Flow) -> _Slide:
        """Propagate the batch entries without an event over the whole duration in one step."""
        x, slip = state.body

        def go(_: Any) -> Any:
            z = jnp.concatenate([x, self.drive(slip)])
            change, loss = (jnp.where(slip == 0, part[1], part[0]) for part in whole)
            far = x + times(change, z)
            side = self.find_side(x, far)
            monotone = (self.slope(x, slip, side) >= 0) | (self.slope(far, slip, side) <= 0)
            calm = (self.reserve(far, slip, side) >= 0) & monotone & (state.left > 0) & (state.left <= self.longest)
            return far, dot(z, times(loss, z)), calm

        # Skip a piece without duration; the conditional also computes the mask once instead of in each use.
        far, lost, calm = jax.lax.cond(
            jnp.any(state.left > 0), go, lambda _: (x, 0.0 * state.left, state.left < 0), None
        )
        return self.account(state, calm, BodyState(far, slip), 0.0 * state.left, lost)

    def step(self, state: _Slide, digits: Flow, which: Array | None) -> _Slide:
        """Propagate to the next event, or by the longest step."""
        x, slip = state.body
        held, driven, limit = slip == 0, self.drive(slip), jnp.minimum(state.left, self.longest)

        def search(trip: _Trip, turn: Array) -> Any:
            """Propagate over the whole step (turn 0), to the minimum of the reserve (1), and to the event (2)."""
            side = self.find_side(x, trip.far)
            wanted = jnp.stack([self.dips(x, slip, trip.far, side), self.reserve(trip.x, slip, side) < 0])
            # Turn 0 ignores the value that it reads.
            wanted = (turn == 0) | read(wanted, turn - 1)

            def keep(after: Array) -> Array:
                bounds = jnp.stack([self.slope(after, slip, side) < 0, self.reserve(after, slip, side) >= 0])
                return (turn == 0) | read(bounds, turn - 1)

            found = advance(digits, held, x, driven, jnp.where(wanted, trip.time, 0.0), keep, which)
            there, time, lost = (jnp.where(wanted, *each) for each in zip(found, trip[:3], strict=True))
            far, spent = (jnp.where(turn == 0, *each) for each in ((there, trip.far), (lost, trip.spent)))
            return _Trip(there, time, lost, far, spent, wanted), None

        zero = 0.0 * limit
        trip = jax.lax.scan(search, _Trip(x, limit, zero, x, zero, zero > 0), np.arange(3))[0]
        over, side = trip.over & (state.left > 0), self.find_side(x, trip.far)
        after = self.decide(trip.x, slip, over)
        # Release a body whose reserve has ended, whatever the rounding error of the force.
        after = BodyState(jnp.where(over, after.x, trip.far), jnp.where(over & held, side, after.slip))
        left, lost = state.left - jnp.where(over, trip.time, limit), jnp.where(over, trip.lost, trip.spent)
        return self.account(state, state.left > 0, after, left, lost)


def propagate_with_friction(
    params: Parameters, body: BodyState, forces: Array, duration: Array, whole: Flow | None
) -> tuple[BodyState, Array, Array]:
    """Propagate under constant forces and dry friction, which adds to the last force.

    Args:
        params: parameters of the batch.
        body: state at the beginning.
        forces: constant forces.
        duration: in sampling periods.
        whole: flow over the duration, slipping and held; None if it varies.

    Returns:
        State at the end, energy dissipated by the dampers and by friction.
    """
    motion, motor, zero = params.motion[0], params.motor, 0.0 * forces[-1]
    pull = jnp.stack([dot(motion, column) for column in jnp.moveaxis(params.rate, 1, 0)])
    joint = _Joint(motion, params.place[0], params.rate, pull, params.longest, motor.coulomb, motor.static, forces)
    # A changed force may release a held body, and a body may start at rest.
    start = joint.decide(body.x, body.slip, (body.slip == 0) | (joint.speed(body.x) == 0))
    state = _Slide(start, duration + zero, zero, zero, zero)
    size = zero.shape[-1]
    few = max(size // FRACTION, min(size, 16))

    def finish(joint: _Joint, state: _Slide, which: Array | None) -> _Slide:
        return jax.lax.while_loop(
            lambda state: jnp.any(state.pending), lambda state: joint.step(state, params.digits, which), state
        )

    def finish_few(state: _Slide) -> _Slide:
        which = jnp.sort(jnp.where(state.pending, np.arange(size), size))[:few]
        few_joint, part = jax.tree.map(lambda part: _take(part, which), (joint, state))
        part = finish(few_joint, part._replace(left=jnp.where(which < size, part.left, 0.0)), which)
        return jax.tree.map(lambda rows, part: rows.at[..., which].set(part, mode="drop"), state, part)

    if whole is None or few == size:
        state = finish(joint, state, None)
    else:
        state = jax.lax.while_loop(lambda state: jnp.any(state.pending), finish_few, joint.glide(state, whole))
    known = state.left <= 0
    return BodyState(jnp.where(known, state.body.x, jnp.nan), state.body.slip), state.lost, state.rubbed
