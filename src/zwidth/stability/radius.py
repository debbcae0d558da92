"""The spectral radius of single points: the outermost pole by Newton's method, proved by two counts.

All poles lie inside ``|z| = r (1 + tol)`` and not all inside ``r (1 - tol)``: then the radius is r up to that
tolerance, whatever led to it. Where rounding could have decided a count (next to multiple poles) nothing is claimed.
Every count also tells where the next pole is expected (`zwidth.stability.circle`), so a few of them find the radius;
an expectation that contradicts earlier counts is replaced by halving the interval that they leave.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.loop import poison, valid_wall
from zwidth.stability.arcs import angle
from zwidth.stability.circle import Loop, circle, loop_of, real_ends, sides
from zwidth.stability.log_step import Near, near, newton_step, ratio_step
from zwidth.stability.pole_derivative import followed
from zwidth.xp import epsilon, frozen, namespace

_LEVEL_STEPS = 6
# How far beyond a pole the next circle lies, as a power of the rounding unit: 1e-10 in float64.
_BEYOND = 0.64
_GUESS_STEPS = 3
# Squares of steps, over the distance between poles: longer ones lead astray, shorter ones have settled.
_LONGEST_STEP = 4.0
_SETTLED = 1e-4
_DONE = 1e-24


class Found(NamedTuple):
    """The outermost pole ``e^(re + j im)``, 0 <= im <= pi."""

    re: Array
    im: Array


def largest(loop: Loop) -> Array:
    """The logarithm of a radius that no pole exceeds: beyond it T is the larger part."""
    xp = namespace(loop.alpha)
    size = (loop.a2 + loop.h) * (1.0 + loop.q) * (xp.abs(loop.alpha) + 2.0 * xp.abs(loop.beta))
    root = xp.sqrt(size)
    # |T| >= r^(1+n) (r - 1)^2, |B| <= size r^2
    short = xp.log1p(xp.where(loop.turns > 1, root, root + size))
    steep = xp.maximum(np.log(2.0), xp.log(4.0 * size) / loop.turns)
    return 1e-9 + xp.where(loop.turns > 1, xp.minimum(short, steep), short)


def smallest(loop: Loop, fractional: bool) -> Array:
    """The logarithm of a radius that some pole reaches: ``max (|p_(N-i)|/C(N, i))^(1/i)`` of the coefficients."""
    xp = namespace(loop.alpha)
    c, s, beta = loop.c, loop.s, loop.beta
    a1, a0 = loop.h + loop.a2 * loop.q, loop.h * loop.q
    tiny = 1e-300
    if fractional:
        poles = loop.turns + 3.0
        first = xp.abs(loop.a2 * s - (1.0 + c)) / 4.0
        second = xp.sqrt(xp.abs(c + a1 * s - loop.a2 * beta) / 6.0)
        third = xp.cbrt(xp.abs(a0 * s - a1 * beta) / 4.0)
        last = xp.sqrt(xp.sqrt(xp.abs(a0 * beta)))
        undelayed = xp.maximum(xp.maximum(first, second), xp.maximum(third, last))
    else:
        poles = loop.turns + 2.0
        first = xp.abs(loop.a2 * s - (1.0 + c)) / 3.0
        second = xp.sqrt(xp.abs(c + a1 * s - loop.a2 * beta) / 3.0)
        undelayed = xp.maximum(xp.maximum(first, second), xp.cbrt(xp.abs(a1 * beta)))
    return xp.log(xp.maximum(xp.where(loop.turns > 1, (1.0 + c) / poles, undelayed), tiny)) - 1e-9


def beyond(value: Array) -> float:
    """How far beyond a pole the next circle lies, in a value's precision."""
    return epsilon(value) ** _BEYOND


def until(steps: int, step: Callable[[Any], Any], done: Callable[[Any], Array], state: Any, xp: Any) -> Any:
    """Apply ``step`` up to so many times, or until every point is done, which at the start none may be."""
    if xp is np:
        for _ in range(steps):
            state = step(state)
            if np.all(done(state)):
                break
        return state
    from jax.lax import while_loop

    return while_loop(
        lambda carry: (carry[0] < steps) & ~done(carry[1]).all(),
        lambda carry: (carry[0] + 1, step(carry[1])),
        (0, state),
    )[1]


def level(high: Array, loop: Loop, steps: int = _LEVEL_STEPS) -> Array:
    """Where T and B are equally large on the real axis, the top of the curve on which the poles lie."""
    xp = namespace(high)

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        at, moved = state
        front, _ = real_ends(at, sides(at, loop), loop)
        new = at - front.level / front.slope
        # What is done stays: a point's value must not depend on how long its neighbors take.
        going = xp.isfinite(new) & ~(moved < 1e-3 * at)
        new = xp.where(going, xp.clip(new, 0.1 * at, high), at)
        return new, xp.where(going, xp.abs(new - at), moved)

    return until(steps, step, lambda state: state[1] < 1e-3 * state[0], (high, 0.0 * high + np.inf), xp)[0]


def slow_pole(loop: Loop) -> Found:
    """The larger pole near 1, of P to second order in z - 1."""
    xp = namespace(loop.alpha)
    alpha, s, turns = loop.alpha, loop.s, loop.turns
    m0, m1 = (loop.a2 + loop.h) * (1.0 + loop.q), loop.a2 - loop.h * loop.q
    constant = m0 * alpha
    linear = loop.em + m0 * s + (m1 - turns * m0) * alpha
    lead = 1.0 + (m1 - turns * m0) * s + (0.5 * turns * (turns + 1.0) * m0 - turns * m1) * alpha
    lead = xp.where(lead > 0.1, lead, 1.0)
    inside = linear * linear - 4.0 * lead * constant
    root = xp.sqrt(xp.abs(inside))
    sum_ = linear + xp.where(linear < 0, -root, root)
    real = xp.where(linear < 0, -0.5 * sum_ / lead, -2.0 * constant / sum_)
    pair = inside < 0
    re, im = xp.where(pair, -0.5 * linear / lead, real), xp.where(pair, 0.5 * root / lead, 0.0)
    re = xp.maximum(re, -0.5)
    return Found(0.5 * xp.log1p(re * (2.0 + re) + im * im), angle(1.0 + re, im))


def guesses(loop: Loop, high: Array, fractional: bool) -> tuple[Found, Array]:
    """The pole that is the outermost of most loops, NaN where it was not found, and the level of the real axis."""
    xp = namespace(high)
    top = level(high, loop)
    slow = polished(slow_pole(loop), loop, fractional, newton_step, _GUESS_STEPS)
    pair = polished(Found(top, np.pi / (loop.turns + 1.0)), loop, fractional, ratio_step, _GUESS_STEPS)
    later = (pair.re > slow.re) | xp.isnan(slow.re)
    return Found(xp.where(later, pair.re, slow.re), xp.where(later, pair.im, slow.im)), top


def outermost(loop: Loop, fractional: bool, steps: int, halve: bool = False) -> Found:
    """Look for the outermost pole in so many counts; with ``halve`` every third one bisects."""
    xp = namespace(loop.alpha)
    bound, low = largest(loop), smallest(loop, fractional)
    # A wall without stiffness has a pole at 1.
    low = xp.where(loop.alpha == 0, xp.maximum(low, 0.0), low)
    guess, top = guesses(loop, bound, fractional)
    past = beyond(low)
    known = (guess.re > low) & (guess.re < bound)
    # Where the delay is short other poles may lead by far.
    unknown = xp.where(loop.turns > 1, top, 0.5 * (low + top))
    start = xp.where(known, guess.re + past, xp.maximum(low, unknown))

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        at, low, high, re, im, done, turn = state
        seen = circle(at, loop, fractional, low, high)
        high = xp.where(seen.full & ~done, at, high)
        low = xp.where(seen.full | done, low, at)
        # What has been found before counts until it is refuted.
        kept = ~xp.isfinite(seen.re) & (guess.re > low - past) & (guess.re < high + past)
        new_re, new_im = xp.where(kept, guess.re, seen.re), xp.where(kept, guess.im, seen.im)
        expected = xp.isfinite(new_re) & ~done
        re, im = xp.where(expected, new_re, re), xp.where(expected, new_im, im)
        # With more than a pair outside, the next pole is seldom the outermost.
        good = expected & (seen.count >= loop.turns)
        if halve:
            good = good & (turn < 2)
        # Climbing, one pole is left behind before the next is looked for.
        new = new_re + xp.where(seen.full, 0.0, past)
        middle = xp.where((high == bound) & (top > low) & (top < 0.99 * high), top, 0.5 * (low + high))
        found = expected & seen.full & (xp.abs(new_re - at) < 3.0 * past)
        return xp.where(good, new, middle), low, high, re, im, done | found, xp.mod(turn + 1.0, 3.0)

    state = (start, low, bound, guess.re, guess.im, bound < low, 0.0 * start)
    state = until(steps, step, lambda state: state[5], state, xp)
    return Found(state[3], state[4])


def polished(
    found: Found, loop: Loop, fractional: bool, stepper: Callable[[Near], tuple[Array, Array]], steps: int
) -> Found:
    """Newton steps on a pole, NaN where they do not settle; the pole at 1 of a wall without stiffness stays there."""
    xp = namespace(found.re)

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        re, im, last = state
        by_re, by_im = stepper(near(re, im, loop, fractional))
        going = ~(last < _DONE)
        size = xp.where(going, (by_re * by_re + by_im * by_im) * loop.turns * loop.turns, last)
        good = going & (size < _LONGEST_STEP) & ((loop.alpha != 0) | (re != 0))
        re, im = xp.where(good, re + by_re, re), xp.where(good, im + by_im, im)
        # Past the real axis the conjugate is meant.
        im = xp.abs(im)
        return re, xp.where(im > np.pi, 2.0 * np.pi - im, im), size

    start = (found.re, found.im, 0.0 * found.re + np.inf)
    re, im, size = until(steps, step, lambda state: state[2] < _DONE, start, xp)
    settled = (size < _SETTLED) | ((loop.alpha == 0) & (re == 0))
    return Found(xp.where(settled, re, np.nan), im)


def proved(log_r: Array, tolerances: Sequence[Any], loop: Loop, fractional: bool) -> list[Array]:
    """Whether the radius is ``e^log_r`` within each relative tolerance, in float64 arithmetic."""
    xp = namespace(log_r)
    offsets = [sign * tolerance + 0.0 * log_r for tolerance in tolerances for sign in (1.0, -1.0)]
    if len(tolerances) == 1:
        seen = [circle(log_r + offset, loop, fractional) for offset in offsets]
        full, sure = [at.full for at in seen], [at.sure for at in seen]
    else:
        # One text for all circles compiles sooner; a text for each runs faster.
        shape = (len(offsets), *np.shape(log_r))
        spread = Loop(*(xp.broadcast_to(field, shape) for field in loop))
        at = circle(xp.broadcast_to(log_r, shape) + xp.stack(offsets), spread, fractional)
        full, sure = at.full, at.sure
    return [full[k] & sure[k] & ~full[k + 1] & sure[k + 1] for k in range(0, len(offsets), 2)]


def radius_kernel(
    alpha: Array,
    beta: Array,
    delta: Array,
    d: Array,
    tolerance: Array,
    fractional: bool,
    steps: int,
    halve: bool,
    polishing: int,
) -> tuple[Array, Array, Array]:
    """The outermost pole of each point by the logarithm of its modulus and its argument, and whether it is proved."""
    loop = loop_of(alpha, beta, delta, d, fractional)
    found = polished(outermost(loop, fractional, steps, halve), loop, fractional, newton_step, polishing)
    return found.re, found.im, proved(found.re, [tolerance], loop, fractional)[0]


def traced_kernel(alpha: Array, beta: Array, delta: Array, d: Array, fractional: bool) -> Array:
    """The logarithm of the radius with its derivatives, inside somebody's transformation.

    NaN where it was not found; derivatives are those of the outermost pole, NaN where that is a multiple one.
    """
    xp = namespace(alpha, beta, delta, d)
    still = loop_of(*frozen((alpha, beta, delta, d), xp), fractional)
    found = polished(outermost(still, fractional, 60), still, fractional, newton_step, 3)
    eps = epsilon(found.re)
    known, simple = proved(found.re, [eps**0.25, eps**0.58], still, fractional)
    moved = followed(found.re, found.im, loop_of(alpha, beta, delta, d, fractional), still, fractional)
    change = moved * xp.where(simple, 1.0, np.nan)
    # The value itself is not changed by what its derivatives are worth.
    value = frozen(xp.where(simple, found.re + moved, found.re), xp) + (change - frozen(change, xp))
    value = xp.where(simple, value, frozen(found.re, xp) + 0.0 * change)
    return xp.where(known, value, np.nan) + poison(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
