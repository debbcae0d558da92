"""The outermost pole of most loops, without a search: two starts, a fixed number of Newton steps, one proof.

Either the slow pole next to 1 is the outermost, or the first pair of the ring that a delay makes. Both are followed,
the larger one is taken. The proof: all poles are inside ``|z| = r (1 + tol)``, counted, and a pole is within tol of
where Newton's method ended (`pole_step`). What is not proved is left to the search of `zwidth.stability.radius`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth._types import Array
from zwidth.stability.circle import Loop, inside, loop_of
from zwidth.stability.pole_step import pole_step, ratio_step
from zwidth.stability.radius import Found, largest, level, slow_pole
from zwidth.xp import namespace, repeat

_LEVEL_STEPS = 3
_RATIO_STEPS = 2
_STEPS = 6
# Bounds of the distance to a pole at which Newton's method has nearly arrived.
_NEAR = 0.3
# A step after which a pole is within so much of where it began may be taken without looking again: N |P/P'| bounds
# the distance before the step, N >= 3, and the step is an N-th of it.
_AFTER = 1.4


def moved(re: Array, im: Array, by_re: Array, by_im: Array) -> tuple[Array, Array]:
    """The next place in the upper half plane: past the real axis the conjugate is meant."""
    xp = namespace(re)
    im = xp.abs(im + by_im)
    return re + by_re, xp.where(im > np.pi, 2.0 * np.pi - im, im)


def stepped(re: Array, im: Array, loop: Loop, fractional: bool, limit: bool = True) -> tuple[Array, Array]:
    """One Newton step, with ``limit`` not longer than about half the distance between poles."""
    xp = namespace(re)
    step = pole_step(re, im, loop, fractional)
    by_re, by_im = step.re, step.im
    if limit:
        size = xp.sqrt(by_re * by_re + by_im * by_im) * (loop.turns + 1.0)
        shorter = 1.0 / xp.maximum(size, 1.0)
        by_re, by_im = by_re * shorter, by_im * shorter
    return moved(re, im, by_re, by_im)


def _pair(loop: Loop, fractional: bool) -> tuple[Array, Array]:
    """The first pair of the ring, to a few digits."""
    xp = namespace(loop.alpha)
    re = level(largest(loop), loop, _LEVEL_STEPS)
    im = np.pi / (loop.turns + 1.0) + 0.0 * re

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        by_re, by_im = ratio_step(*state, loop, fractional)
        good = (by_re * by_re + by_im * by_im) * loop.turns * loop.turns < 4.0
        return moved(*state, xp.where(good, by_re, 0.0), xp.where(good, by_im, 0.0))

    return repeat(_RATIO_STEPS, step, (re, im), xp)


def candidate(loop: Loop, fractional: bool) -> Found:
    """The larger of two poles, nearly; NaN where both were lost."""
    xp = namespace(loop.alpha)
    slow = slow_pole(loop)
    starts: Any = (slow.re, slow.im, *_pair(loop, fractional))

    def step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, ...]:
        return (*stepped(*state[:2], loop, fractional), *stepped(*state[2:], loop, fractional))

    slow_re, slow_im, re, im = _iterated(step, starts, xp)
    last, last_pair = pole_step(slow_re, slow_im, loop, fractional), pole_step(re, im, loop, fractional)
    slow_re, slow_im = moved(slow_re, slow_im, last.re, last.im)
    re, im = moved(re, im, last_pair.re, last_pair.im)
    # A wall without stiffness has a pole at 1.
    still = loop.alpha == 0
    slow_re, slow_im = xp.where(still, 0.0, slow_re), xp.where(still, 0.0, slow_im)
    # What is still on its way says nothing about how large it will be.
    near_slow = still | (last.within < _NEAR)
    near_pair = last_pair.within < _NEAR
    first = xp.where(near_slow & near_pair, slow_re >= re, near_slow)
    re, im = xp.where(first, slow_re, re), xp.where(first, slow_im, im)
    at_one = still & (re == 0)
    after_re, after_im = stepped(re, im, loop, fractional)
    return Found(xp.where(at_one, 0.0, after_re), xp.where(at_one, 0.0, after_im))


def _iterated(step: Any, state: Any, xp: Any) -> Any:
    """All steps but the last; a single point stops where it stands still."""
    if xp is not np or np.ndim(state[0]):
        return repeat(_STEPS - 1, step, state, xp)
    for _ in range(_STEPS - 1):
        before, state = state, step(state)
        if all(abs(new - old) < 1e-6 for new, old in zip(state, before, strict=True)):
            break
    return state


def certified(found: Found, tolerance: Array, loop: Loop, fractional: bool) -> tuple[Array, Array, Array]:
    """The pole after one more step, and whether its modulus is proved to be the radius within the tolerance."""
    xp = namespace(found.re)
    at_one = (loop.alpha == 0) & (found.re == 0)
    step = pole_step(found.re, found.im, loop, fractional)
    is_pole = at_one | (_AFTER * step.within <= tolerance)
    after_re, after_im = moved(found.re, found.im, step.re, step.im)
    re, im = xp.where(at_one, 0.0, after_re), xp.where(at_one, 0.0, after_im)
    full, sure = inside(re + tolerance, loop, fractional)
    return re, im, is_pole & full & sure


def quick_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, tolerance: Array, fractional: bool
) -> tuple[Array, Array, Array]:
    """The outermost pole of each point by the logarithm of its modulus and its argument, and whether it is proved."""
    loop = loop_of(alpha, beta, delta, d, fractional)
    return certified(candidate(loop, fractional), tolerance, loop, fractional)
