"""Propagate the bodies over any duration by its binary digits, and find the events of dry friction.

All functions are pure functions of JAX arrays whose last axis is the batch. ``x`` is the state of the bodies, of length
n. Dry friction acts on the first body. Its *slip* is -1 or 1 while the body slips in that direction, and 0 while
friction holds the body. An *event* starts or ends slip (docs/theory/simulation.md, T4 and T5). The *reserve* of the
body is positive between events and 0 at an event. While the body slips, the reserve is its speed. While the body is
held, the reserve is the static friction minus the sum of the other forces, taken in the mean direction of this sum
during the step, the *side* (-1 or 1). A *piece* is a time interval with constant forces, a *step* a part of a piece.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.core.types import Array
from zwidth.plant.transition import Transition
from zwidth.simulation.parameters import DIGITS, Parameters

MOST_EVENTS = 512  # largest number of steps per piece, nearly all to an event; beyond it the state is set to NaN
LAST_DIGIT = 0.5 ** (DIGITS - 1)  # shortest step, in sampling periods
# Propagate the simulations whose piece contains an event in groups of 1/FRACTION of the batch, because such a piece
# takes a hundred times as long as one without an event.
FRACTION = 8


class BodyState(NamedTuple):
    """State of the bodies, and slip of the first body, for each batch entry."""

    x: Array  # state, (n, batch)
    slip: Array  # slip of the first body: -1, 0 or 1, (batch,)


def read(rows: Array, index: Array | int, axis: int = 0) -> Array:
    """Return the entry at an index >= 0 along an axis, with fewer compiled operations than `jax.Array.__getitem__`."""
    return jax.lax.dynamic_index_in_dim(rows, index, axis, keepdims=False, allow_negative_indices=False)


def times(matrix: Array, vector: Array) -> Array:
    """Return the product of a small matrix and a vector for each batch entry, without a library call."""
    return jnp.stack([dot(row, vector) for row in matrix])


def dot(row: Array, vector: Array) -> Array:
    """Return the scalar product of a row and a vector for each batch entry."""
    return reduce(add, (a * x for a, x in zip(row, vector, strict=True)))


def advance(
    digits: Transition,
    held: Array,
    x: Array,
    forces: Array,
    limit: Array,
    keep: Callable[[Array], Array] | None = None,
    which: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Propagate by decreasing binary digits of time; skip a digit if the condition ``keep`` would be false after it.

    This bisects to the instant at which the condition becomes false, or propagates up to ``limit`` if it stays true.

    Args:
        digits: transitions over the binary digits of time, while the first body slips and while it is held.
        held: mask of the batch entries whose first body is held.
        x: state of the bodies.
        forces: constant forces.
        limit: longest time, in sampling periods.
        keep: function that returns the condition for a state; always true if left out.
        which: indices in the batch of the entries of ``x``; all if left out.

    Returns:
        State at the end, time, and energy dissipated by the dampers.
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

    # Begin with the largest binary digit that does not exceed the longest limit.
    first = jnp.floor(-jnp.log(jnp.max(limit)) / np.log(2.0)).clip(0, DIGITS - 1).astype(int)
    return jax.lax.while_loop(remain, step, (first, x, 0.0 * limit, 0.0 * limit))[1:]


def _take(part: Array, which: Array | None) -> Array:
    """Return the batch entries of an array with the indices ``which``; an index out of range selects the last entry."""
    return part if which is None or part.shape[-1] == 1 else part.at[..., which].get(mode="clip")


class _Slide(NamedTuple):
    """Intermediate state of the propagation over a piece with friction, with the energies dissipated so far."""

    body: BodyState  # state of the bodies
    left: Array  # remaining duration
    lost: Array  # energy dissipated by dampers so far
    rubbed: Array  # energy dissipated by friction so far
    events: Array  # number of steps so far, each of which ends with an event or at the longest step

    @property
    def pending(self) -> Array:
        """Mask of the batch entries whose piece is not finished."""
        return (self.left > 0) & (self.events < MOST_EVENTS)


class _Trip(NamedTuple):
    """Result of a step: the state at its end, or at the event that ends it, its duration, and the dissipated energy."""

    x: Array  # state at the end of the step
    time: Array  # duration of the step
    lost: Array  # energy dissipated by the dampers
    far: Array  # state at the end of the step if no event occurs
    spent: Array  # energy dissipated by the dampers if no event occurs
    over: Array  # True if an event ends the step


class _Joint(NamedTuple):
    """Dry friction of the first body during a piece; the friction force is added to the last of the constant forces."""

    motion: Array  # row that computes the velocity of the first body from x
    place: Array  # row that computes the position of the first body from x
    rate: Array  # matrix of x' = rate @ (x, forces)
    pull: Array  # row of the acceleration of the first body, which equals the force because its mass is 1
    longest: Array  # longest step, in sampling periods
    coulomb: Array  # Coulomb friction while the body slips
    static: Array  # static friction while the body is held
    forces: Array  # constant forces without friction

    def pressed(self, x: Array) -> Array:
        """Return the sum of all forces on the first body except friction."""
        return dot(self.pull[:-1], [*x, *self.forces[:-1]]) + self.forces[-1]

    def speed(self, x: Array) -> Array:
        """Return the velocity of the first body."""
        return dot(self.motion, x)

    def drive(self, slip: Array) -> Array:
        """Return the constant forces, with Coulomb friction added to the last one."""
        return jnp.stack([*self.forces[:-1], self.forces[-1] - slip * self.coulomb])

    def decide(self, x: Array, slip: Array, stopped: Array) -> BodyState:
        """Decide whether a stopped first body is held or slips, by comparing the other forces with static friction.

        Args:
            x: state of the bodies.
            slip: slip before.
            stopped: mask of the batch entries whose first body has stopped; the others are left unchanged.
        """
        push = self.pressed(x)
        # Set the velocity of a stopped first body to exactly 0, as by an impulse on it, because the search for the
        # event leaves a small velocity as a rounding error.
        x = jnp.where(stopped, x - self.rate[:, -1] * self.speed(x), x)
        return BodyState(x, jnp.where(stopped, jnp.where(jnp.abs(push) > self.static, jnp.sign(push), 0.0), slip))

    def reserve(self, x: Array, slip: Array, side: Array) -> Array:
        """Return the reserve of the first body in the state ``x``, for its slip and side."""
        return jnp.where(slip == 0, self.static - side * self.pressed(x), slip * self.speed(x))

    def slope(self, x: Array, slip: Array, side: Array) -> Array:
        """Return the time derivative of the reserve in the state ``x``, for the slip and the side of the first body."""
        change = times(self.rate, jnp.concatenate([x, self.drive(slip)]))
        stuck = -side * dot(self.pull[: len(x)], change - self.rate[:, -1] * self.speed(change))
        return jnp.where(slip == 0, stuck, slip * (self.pressed(x) - slip * self.coulomb))

    def find_side(self, x: Array, far: Array) -> Array:
        """Return the side, that is, the sign of the mean force on a held body over a step from ``x`` to ``far``."""
        return jnp.sign(self.pressed(x) + self.pressed(far))

    def dips(self, x: Array, slip: Array, far: Array, side: Array) -> Array:
        """Return a mask of the steps from ``x`` to ``far`` within which the reserve has a minimum.

        Steps at whose end the reserve is negative are excluded, because they contain an event in any case.
        """
        dips = (self.slope(x, slip, side) < 0) & (self.slope(far, slip, side) > 0)
        # Exclude a body that slips with velocity 0: it has just been released, so no event can follow at once.
        return (self.reserve(far, slip, side) > 0) & dips & ((slip == 0) | (self.speed(x) != 0))

    def account(self, state: _Slide, moving: Array, after: BodyState, left: Array, lost: Array) -> _Slide:
        """Return the intermediate state after a step, including the energy dissipated by friction.

        Args:
            state: intermediate state before the step.
            moving: mask of the batch entries that take the step; the others are left unchanged.
            after: state of the bodies after the step.
            left: remaining duration after the step.
            lost: energy dissipated by the dampers in the step.
        """
        (x, slip), way = state.body, dot(self.place, after.x - state.body.x)
        return _Slide(
            BodyState(jnp.where(moving, after.x, x), jnp.where(moving, after.slip, slip)),
            jnp.where(moving, jnp.where(left > LAST_DIGIT, left, 0.0), state.left),
            state.lost + jnp.where(moving, lost, 0.0),
            state.rubbed + jnp.where(moving, slip * self.coulomb * way, 0.0),
            state.events + moving,
        )

    def glide(self, state: _Slide, whole: Transition) -> _Slide:
        """Propagate the batch entries without an event over their whole piece, in one step by precomputed matrices."""
        x, slip = state.body

        def go(_: Any) -> Any:
            z = jnp.concatenate([x, self.drive(slip)])
            change, loss = (jnp.where(slip == 0, part[1], part[0]) for part in whole)
            far = x + times(change, z)
            side = self.find_side(x, far)
            monotone = (self.slope(x, slip, side) >= 0) | (self.slope(far, slip, side) <= 0)
            calm = (self.reserve(far, slip, side) >= 0) & monotone & (state.left > 0) & (state.left <= self.longest)
            return far, dot(z, times(loss, z)), calm

        # Skip the computation if no simulation has a remaining duration. The conditional also prevents XLA from
        # computing the mask ``calm`` again at each use.
        far, lost, calm = jax.lax.cond(
            jnp.any(state.left > 0), go, lambda _: (x, 0.0 * state.left, state.left < 0), None
        )
        return self.account(state, calm, BodyState(far, slip), 0.0 * state.left, lost)

    def step(self, state: _Slide, digits: Transition, which: Array | None) -> _Slide:
        """Propagate all batch entries to their next event, or by the longest step if it contains no event.

        Args:
            state: intermediate state before the step.
            digits: transitions over the binary digits of time.
            which: indices in the batch of the entries of ``state``; all if None.
        """
        x, slip = state.body
        held, driven, limit = slip == 0, self.drive(slip), jnp.minimum(state.left, self.longest)

        def search(trip: _Trip, turn: Array) -> Any:
            """Propagate by one of three searches: for the end of the step, the minimum of the reserve, or the event.

            Args:
                trip: result of the previous search.
                turn: index of the search, 0, 1 or 2. Search 1 applies only to the batch entries whose reserve has a
                    minimum during the step, search 2 only to those whose reserve is negative after search 1.
            """
            side = self.find_side(x, trip.far)
            wanted = jnp.stack([self.dips(x, slip, trip.far, side), self.reserve(trip.x, slip, side) < 0])
            # Search 0 applies to all batch entries, because ``turn == 0`` is true. The index turn - 1 = -1, which is
            # out of range in this search, therefore has no effect.
            wanted = (turn == 0) | read(wanted, turn - 1)

            def keep(after: Array) -> Array:
                bounds = jnp.stack([self.slope(after, slip, side) < 0, self.reserve(after, slip, side) >= 0])
                return (turn == 0) | read(bounds, turn - 1)

            reached = advance(digits, held, x, driven, jnp.where(wanted, trip.time, 0.0), keep, which)
            there, time, lost = (jnp.where(wanted, *each) for each in zip(reached, trip[:3], strict=True))
            far, spent = (jnp.where(turn == 0, *each) for each in ((there, trip.far), (lost, trip.spent)))
            return _Trip(there, time, lost, far, spent, wanted), None

        zero = 0.0 * limit
        trip = jax.lax.scan(search, _Trip(x, limit, zero, x, zero, zero > 0), np.arange(3))[0]
        over, side = trip.over & (state.left > 0), self.find_side(x, trip.far)
        after = self.decide(trip.x, slip, over)
        # Release a held body at its event even if the computed force does not exceed static friction, because the
        # difference is a rounding error.
        after = BodyState(jnp.where(over, after.x, trip.far), jnp.where(over & held, side, after.slip))
        left, lost = state.left - jnp.where(over, trip.time, limit), jnp.where(over, trip.lost, trip.spent)
        return self.account(state, state.left > 0, after, left, lost)


def propagate_with_friction(
    params: Parameters, body: BodyState, forces: Array, duration: Array, whole: Transition | None
) -> tuple[BodyState, Array, Array]:
    """Propagate the bodies over one piece with constant forces and dry friction, from event to event.

    Args:
        params: parameters of the batch.
        body: state at the start of the piece.
        forces: constant forces; friction is added to the last one.
        duration: duration of the piece, in sampling periods.
        whole: transitions over the whole piece, while the first body slips and while it is held; None with jitter,
            because the durations then vary from period to period.

    Returns:
        State at the end, energy dissipated by the dampers, and energy dissipated by friction.
    """
    motion, motor, zero = params.motion[0], params.motor, 0.0 * forces[-1]
    pull = jnp.stack([dot(motion, column) for column in jnp.moveaxis(params.rate, 1, 0)])
    joint = _Joint(motion, params.place[0], params.rate, pull, params.longest, motor.coulomb, motor.static, forces)
    # Decide again whether held or resting bodies slip, because the forces have changed since the last piece.
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
    finished = state.left <= 0
    return BodyState(jnp.where(finished, state.body.x, jnp.nan), state.body.slip), state.lost, state.rubbed
