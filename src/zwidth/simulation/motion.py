"""Motion over any duration by its binary digits, and friction's events on the way (docs/theory/simulation.md, T4, T5).

Pure functions of JAX arrays whose last axis are the lanes.
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
from zwidth.simulation.lanes import Lanes
from zwidth.words.types import Array

# More events within a period than a motion has: what is left then is unknown, NaN.
_MOST_EVENTS = 512
_LAST_DIGIT = 0.5 ** (DIGITS - 1)
# An event takes a hundred times the work of a way without one, and few lanes have one at a time: these go on together,
# this share of all.
_SHARE = 8


class BodyState(NamedTuple):
    """The bodies' state, and how friction acts on the first: -1 or 1 slipping that way, 0 held."""

    x: Array  # (n, lanes)
    slip: Array


def read(rows: Array, place: Array | int, axis: int = 0) -> Array:
    """The row at a place that is no less than 0: any other index of JAX's costs some operations to compile."""
    return jax.lax.dynamic_index_in_dim(rows, place, axis, keepdims=False, allow_negative_indices=False)


def times(matrix: Array, vector: Array) -> Array:
    """A small matrix times a vector in every lane, as sums of products: no library call pays off for so little."""
    return jnp.stack([dot(row, vector) for row in matrix])


def dot(row: Array, vector: Array) -> Array:
    """A sum of products in every lane."""
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
    """The state after as long a time up to ``limit`` as ``keep`` holds at, that time, and what dampers have taken."""
    # Of the lanes ``which``, where these are not all that have digits.

    def pick(part: Array, k: Array) -> Array:
        ways = [_take(read(way, k), which) for way in part]
        return jnp.where(held, ways[1], ways[0]) if len(ways) > 1 else ways[0]

    def remain(state: tuple[Array, ...]) -> Array:
        k, _, time, _ = state
        return (k < DIGITS) & jnp.any(time < limit)

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        k, x, time, lost = state
        z = jnp.concatenate([x, forces])
        longer, after = time + jnp.exp2(-k.astype(time.dtype)), x + times(pick(digits.change, k), z)
        taken = (longer <= limit) & (True if keep is None else keep(after))
        lost = jnp.where(taken, lost + dot(z, times(pick(digits.loss, k), z)), lost)
        return k + 1, jnp.where(taken, after, x), jnp.where(taken, longer, time), lost

    # No digit longer than all of the time is taken.
    first = jnp.floor(-jnp.log(jnp.max(limit)) / np.log(2.0)).clip(0, DIGITS - 1).astype(int)
    return jax.lax.while_loop(remain, step, (first, x, 0.0 * limit, 0.0 * limit))[1:]


class _Slide(NamedTuple):
    body: BodyState
    left: Array  # of the duration
    lost: Array
    rubbed: Array
    events: Array

    @property
    def pending(self) -> Array:
        return (self.left > 0) & (self.events < _MOST_EVENTS)

    def pack(self) -> Array:
        """All of it as rows, which are picked and put back at once."""
        return jnp.concatenate([self.body.x, jnp.stack([self.body.slip, *self[1:]])])

    @classmethod
    def unpack(cls, rows: Array) -> _Slide:
        return cls(BodyState(rows[:-5], rows[-5]), *rows[-4:])


class _Trip(NamedTuple):
    x: Array
    time: Array
    lost: Array
    far: Array  # where all of the way leads
    spent: Array  # what dampers take on all of it
    over: Array  # whether an event ends it


def _take(part: Array, which: Array | None) -> Array:
    """Some of the lanes; all of them where one serves all. Beyond the last lane stands the last."""
    return part if which is None or part.shape[-1] == 1 else part.at[..., which].get(mode="clip")


class _Joint(NamedTuple):
    """Friction of the first body in some lanes, under constant forces, of which it adds to the last."""

    motion: Array  # the velocity that friction acts on
    place: Array
    rate: Array
    pull: Array  # its acceleration, for the first body's mass is the unit
    longest: Array
    coulomb: Array
    static: Array
    forces: Array

    def pressed(self, x: Array) -> Array:
        """The force on the first body but for friction."""
        return dot(self.pull[:-1], [*x, *self.forces[:-1]]) + self.forces[-1]

    def speed(self, x: Array) -> Array:
        return dot(self.motion, x)

    def drive(self, slip: Array) -> Array:
        """The forces with friction's."""
        return jnp.stack([*self.forces[:-1], self.forces[-1] - slip * self.coulomb])

    def decide(self, x: Array, slip: Array, stopped: Array) -> BodyState:
        """Hold or let go a body that has no velocity."""
        push = self.pressed(x)
        # What is left of the velocity goes as an impulse would, into the first body.
        x = jnp.where(stopped, x - self.rate[:, -1] * self.speed(x), x)
        return BodyState(x, jnp.where(stopped, jnp.where(jnp.abs(push) > self.static, jnp.sign(push), 0.0), slip))

    def remains(self, x: Array, slip: Array, side: Array) -> Array:
        """What is left until the event: of the speed, or of the force that friction can still bear."""
        return jnp.where(slip == 0, self.static - side * self.pressed(x), slip * self.speed(x))

    def rises(self, x: Array, slip: Array, side: Array) -> Array:
        change = times(self.rate, jnp.concatenate([x, self.drive(slip)]))
        stuck = -side * dot(self.pull[: len(x)], change - self.rate[:, -1] * self.speed(change))
        return jnp.where(slip == 0, stuck, slip * (self.pressed(x) - slip * self.coulomb))

    def find_side(self, x: Array, far: Array) -> Array:
        """To which side a held body is pressed on the way."""
        return jnp.sign(self.pressed(x) + self.pressed(far))

    def dips(self, x: Array, slip: Array, far: Array, side: Array) -> Array:
        """Whether less remains on the way than at both of its ends."""
        falls, recovers = self.rises(x, slip, side) < 0, self.rises(far, slip, side) > 0
        # A body just let go starts with rounding errors for a velocity and an acceleration: it leaves.
        return (self.remains(far, slip, side) > 0) & falls & recovers & ((slip == 0) | (self.speed(x) != 0))

    def account(self, state: _Slide, moving: Array, after: BodyState, left: Array, lost: Array) -> _Slide:
        """The state where those that move have come."""
        (x, slip), way = state.body, dot(self.place, after.x - state.body.x)
        return _Slide(
            BodyState(jnp.where(moving, after.x, x), jnp.where(moving, after.slip, slip)),
            jnp.where(moving, jnp.where(left > _LAST_DIGIT, left, 0.0), state.left),
            state.lost + jnp.where(moving, lost, 0.0),
            state.rubbed + jnp.where(moving, slip * self.coulomb * way, 0.0),
            state.events + moving,
        )

    def glide(self, state: _Slide, whole: Flow) -> _Slide:
        """All of the way at once where nothing happens on it; the others have not moved."""
        x, slip = state.body

        def go(_: Any) -> tuple[Array, Array, Array]:
            z = jnp.concatenate([x, self.drive(slip)])
            change, loss = (jnp.where(slip == 0, part[1], part[0]) for part in whole)
            far = x + times(change, z)
            side = self.find_side(x, far)
            # What never falls, or falls to the end.
            plain = (self.rises(x, slip, side) >= 0) | (self.rises(far, slip, side) <= 0)
            calm = (self.remains(far, slip, side) >= 0) & plain & (state.left > 0) & (state.left <= self.longest)
            return far, dot(z, times(loss, z)), calm

        # A command often lasts for no time; and what is chosen by is computed once, not with each of its choices.
        far, lost, calm = jax.lax.cond(
            jnp.any(state.left > 0), go, lambda _: (x, 0.0 * state.left, state.left < 0), None
        )
        return self.account(state, calm, BodyState(far, slip), 0.0 * state.left, lost)

    def step(self, state: _Slide, digits: Flow, which: Array | None) -> _Slide:
        """As far as the next event, or one longest step."""
        x, slip = state.body
        held, driven, limit = slip == 0, self.drive(slip), jnp.minimum(state.left, self.longest)

        def search(trip: _Trip, turn: Array) -> tuple[_Trip, None]:
            """All of the way, then to where least remains, then to the event; by one program, for it is long."""
            side = self.find_side(x, trip.far)
            wanted = jnp.stack([self.dips(x, slip, trip.far, side), self.remains(trip.x, slip, side) < 0])
            # What the first turn reads counts for nothing.
            wanted = (turn == 0) | read(wanted, turn - 1)

            def keep(after: Array) -> Array:
                bounds = jnp.stack([self.rises(after, slip, side) < 0, self.remains(after, slip, side) >= 0])
                return (turn == 0) | read(bounds, turn - 1)

            found = advance(digits, held, x, driven, jnp.where(wanted, trip.time, 0.0), keep, which)
            there, time, lost = (jnp.where(wanted, *each) for each in zip(found, trip[:3], strict=True))
            far, spent = (jnp.where(turn == 0, *each) for each in ((there, trip.far), (lost, trip.spent)))
            return _Trip(there, time, lost, far, spent, wanted), None

        none = 0.0 * limit
        trip = jax.lax.scan(search, _Trip(x, limit, none, x, none, none > 0), np.arange(3))[0]
        over, side = trip.over & (state.left > 0), self.find_side(x, trip.far)
        after = self.decide(trip.x, slip, over)
        # What friction can bear no longer is let go, whatever rounding says of the force.
        after = BodyState(jnp.where(over, after.x, trip.far), jnp.where(over & held, side, after.slip))
        left, lost = state.left - jnp.where(over, trip.time, limit), jnp.where(over, trip.lost, trip.spent)
        return self.account(state, state.left > 0, after, left, lost)


def slide(
    lanes: Lanes, body: BodyState, forces: Array, duration: Array, whole: Flow | None
) -> tuple[BodyState, Array, Array]:
    """The motion under constant forces, of which friction adds to the last; what dampers and friction have taken."""
    # ``whole`` is the flow over all of the duration, slipping and held, where it is known.
    motion, motor, none = lanes.motion[0], lanes.motor, 0.0 * forces[-1]
    pull = jnp.stack([dot(motion, column) for column in jnp.moveaxis(lanes.rate, 1, 0)])
    joint = _Joint(motion, lanes.place[0], lanes.rate, pull, lanes.longest, motor.coulomb, motor.static, forces)
    # A new force may let go what was held, and a body may start at rest.
    start = joint.decide(body.x, body.slip, (body.slip == 0) | (joint.speed(body.x) == 0))
    state = _Slide(start, duration + none, none, none, none)
    size = none.shape[-1]
    few = max(size // _SHARE, min(size, 16))

    def go_on(joint: _Joint, state: _Slide, which: Array | None) -> _Slide:
        return jax.lax.while_loop(
            lambda state: jnp.any(state.pending), lambda state: joint.step(state, lanes.digits, which), state
        )

    def go_on_with_few(state: _Slide) -> _Slide:
        which = jnp.sort(jnp.where(state.pending, np.arange(size), size))[:few]
        own, rows = jax.tree.map(lambda part: _take(part, which), joint), state.pack()
        part = _Slide.unpack(_take(rows, which))
        part = go_on(own, part._replace(left=jnp.where(which < size, part.left, 0.0)), which)
        return _Slide.unpack(rows.at[:, which].set(part.pack(), mode="drop"))

    if whole is None or few == size:
        state = go_on(joint, state, None)
    else:
        state = jax.lax.while_loop(lambda state: jnp.any(state.pending), go_on_with_few, joint.glide(state, whole))
    known = state.left <= 0
    return BodyState(jnp.where(known, state.body.x, jnp.nan), state.body.slip), state.lost, state.rubbed
