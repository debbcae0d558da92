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

from zwidth.simulation.flow import DIGITS, Flow
from zwidth.simulation.lanes import Lanes
from zwidth.words.types import Array

# More events within a period than a motion has: what is left then is unknown, NaN.
_MOST_EVENTS = 512
_LAST_DIGIT = 0.5 ** (DIGITS - 1)


class BodyState(NamedTuple):
    """The bodies' state, and how friction acts on the first: -1 or 1 slipping that way, 0 held."""

    x: Array  # (n, lanes)
    slip: Array


class _Slide(NamedTuple):
    body: BodyState
    left: Array  # of the duration
    lost: Array
    rubbed: Array
    events: Array


def times(matrix: Array, vector: Array) -> Array:
    """A small matrix times a vector in every lane, as sums of products: no library call pays off for so little."""
    return jnp.stack([dot(row, vector) for row in matrix])


def dot(row: Array, vector: Array) -> Array:
    """A sum of products in every lane."""
    return reduce(add, (a * x for a, x in zip(row, vector, strict=True)))


def advance(
    digits: Flow, held: Array, x: Array, forces: Array, limit: Array, keep: Callable[[Array], Array] | None = None
) -> tuple[Array, Array, Array]:
    """The state after as long a time up to ``limit`` as ``keep`` holds at, that time, and what dampers have taken."""

    def pick(part: Array, k: Array) -> Array:
        return jnp.where(held, part[1, k], part[0, k]) if part.shape[0] > 1 else part[0, k]

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
    first = jnp.floor(-jnp.log2(jnp.max(limit))).clip(0, DIGITS - 1).astype(int)
    return jax.lax.while_loop(remain, step, (first, x, jnp.zeros_like(limit), jnp.zeros_like(limit)))[1:]


def slide(lanes: Lanes, body: BodyState, forces: Array, duration: Array) -> tuple[BodyState, Array, Array]:
    """The motion under constant forces, of which friction adds to the last; what dampers and friction have taken."""
    motion, (*lead, force) = lanes.motion[0], forces
    pull = [dot(motion, column) for column in jnp.moveaxis(lanes.rate, 1, 0)]
    coulomb, static = lanes.motor.coulomb, lanes.motor.static

    def pressed(x: Array) -> Array:
        """The force on the first body but for friction: its acceleration, for its mass is the unit."""
        return dot(pull[:-1], [*x, *lead]) + force

    def speed(x: Array) -> Array:
        return dot(motion, x)

    def decide(x: Array, slip: Array, stopped: Array) -> BodyState:
        """Hold or let go a body that has no velocity."""
        push = pressed(x)
        # What is left of the velocity goes as an impulse would, into the first body.
        x = jnp.where(stopped, x - lanes.rate[:, -1] * speed(x), x)
        return BodyState(x, jnp.where(stopped, jnp.where(jnp.abs(push) > static, jnp.sign(push), 0.0), slip))

    def step(state: _Slide) -> _Slide:
        x, slip = state.body
        held, driven = slip == 0, jnp.stack([*lead, force - slip * coulomb])
        limit = jnp.minimum(state.left, lanes.longest)
        far, time, lost = advance(lanes.digits, held, x, driven, limit)
        side = jnp.sign(pressed(x) + pressed(far))

        def remains(x: Array) -> Array:
            """What is left until the event: of the speed, or of the force that friction can still bear."""
            return jnp.where(held, static - side * pressed(x), slip * speed(x))

        def rises(x: Array) -> Array:
            change = times(lanes.rate, jnp.concatenate([x, driven]))
            stuck = -side * dot(pull[: len(x)], change - lanes.rate[:, -1] * dot(motion, change))
            return jnp.where(held, stuck, slip * (pressed(x) - slip * coulomb))

        # A body just let go starts with rounding errors for a velocity and an acceleration: it leaves.
        dips = (remains(far) > 0) & (rises(x) < 0) & (rises(far) > 0) & (held | (speed(x) != 0))

        def find_lowest(_: Any) -> tuple[Array, Array]:
            low, when, _ = advance(lanes.digits, held, x, driven, limit, lambda after: rises(after) < 0)
            return jnp.where(dips, low, far), jnp.where(dips, when, time)

        low, when = jax.lax.cond(jnp.any(dips), find_lowest, lambda _: (far, time), None)
        over = (remains(low) < 0) & (state.left > 0)

        def find_event(_: Any) -> tuple[BodyState, Array, Array]:
            at, moment, taken = advance(lanes.digits, held, x, driven, when, lambda after: remains(after) >= 0)
            after = decide(at, slip, over)
            # What friction can bear no longer is let go, whatever rounding says of the force.
            towards = jnp.where(held, side, after.slip)
            return (
                BodyState(jnp.where(over, after.x, far), jnp.where(over, towards, slip)),
                jnp.where(over, moment, time),
                jnp.where(over, taken, lost),
            )

        after, time, lost = jax.lax.cond(jnp.any(over), find_event, lambda _: (BodyState(far, slip), time, lost), None)
        moving = state.left > 0
        left = jnp.where(over, state.left - time, state.left - limit)
        way = dot(lanes.place[0], after.x - x)
        return _Slide(
            BodyState(jnp.where(moving, after.x, x), jnp.where(moving, after.slip, slip)),
            jnp.where(moving, jnp.where(left > _LAST_DIGIT, left, 0.0), 0.0),
            state.lost + jnp.where(moving, lost, 0.0),
            state.rubbed + jnp.where(moving, slip * coulomb * way, 0.0),
            state.events + moving,
        )

    # A new force may let go what was held, and a body may start at rest.
    start = decide(body.x, body.slip, (body.slip == 0) | (speed(body.x) == 0))
    none = 0.0 * force
    state = _Slide(start, duration + none, none, none, jnp.zeros_like(none, int))
    state = jax.lax.while_loop(lambda state: jnp.any((state.left > 0) & (state.events < _MOST_EVENTS)), step, state)
    known = state.left <= 0
    return BodyState(jnp.where(known, state.body.x, jnp.nan), state.body.slip), state.lost, state.rubbed
