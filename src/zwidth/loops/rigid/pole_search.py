"""The outermost pole of one loop: two starts, a fixed number of steps, one proof; a search for what that leaves.

Either the slow pole next to 1 is the outermost, or the first pair of the ring that a delay makes. Halley's method
follows both, and the larger one to its end. The proof: all poles are inside ``|z| = r (1 + tol)``, counted, and a pole
is within tol of where the method ended. Where that fails the radius is searched for by halving an interval of counts.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.roots import follow_root
from zwidth.loops.rigid.circle import Loop, count, factor_loop
from zwidth.loops.rigid.normalization import valid_wall
from zwidth.loops.rigid.pole_step import halley_step, join, move_pole, newton_step, value_at
from zwidth.words.types import Array
from zwidth.words.xp import (
    angle,
    apply_each,
    epsilon,
    frozen,
    namespace,
    nan_unless,
    nan_with_nan_slopes,
    repeat,
    store_once,
)

# Steps on both starts, then on the larger of the two; where that was not enough, on it and the other one, then on all.
_BOTH, _LARGER, _AGAIN, _PATIENT = 2, 3, 6, 10
# A start that is within so much of a pole has arrived.
_ARRIVED = 1e-6
# A step after which a pole is within so much of where it began may be taken without looking again: N |P/P'| bounds
# the distance before the step, N >= 3, and the step is an N-th of it.
_AFTER = 1.4
# Of counts next to a pole: what their rounding allows, and what rates of decay promise.
_COUNTED, _RELATIVE = 4096.0, 2e-11
# From the smallest radius that float64 has, to the last digit: where many poles are of nearly one size, the places of
# crossovers depend on it.
_SMALLEST, _HALVINGS, _POLISHING, _NEWTON = -690.0, 62, 6, 3
_TOGETHER = 3
# Counts that the last proof tries, each ten times as far from the pole as the one before: rounding may blur near ones.
_FARTHER = 6
# Inside a transformation walls are taken in so many parts, or fewer of so many walls.
_PARTS, _LEAST_PART = 16, 1 << 9
# Off the real axis, of the angle of the first pair.
_OFF = 0.1
# And between there and the pair's angle, where a short delay has a third pole.
_BETWEEN = 0.5


class OutermostPoles(NamedTuple):
    """Outermost poles ``e^(re + j im)``, 0 <= im <= pi, by the relative error proved of the radius."""

    re: Array
    im: Array
    error: Array  # infinite where none is proved
    doubt: Array  # how far re may be from the pole; infinite where the proof is of the radius alone

    @property
    def proved(self) -> Array:
        """Whether some error is."""
        return self.error < np.inf


def _largest(loop: Loop) -> Array:
    """The logarithm of a radius that no pole exceeds: beyond it T is the larger part."""
    xp = namespace(loop.alpha)
    size = (loop.a2 + loop.h) * (1.0 + loop.q) * (xp.abs(loop.alpha) + 2.0 * xp.abs(loop.beta))
    root = xp.sqrt(size)
    # |T| >= r^(1+n) (r - 1)^2, |B| <= size r^2
    short = xp.log1p(xp.where(loop.turns > 1, root, root + size))
    steep = xp.maximum(np.log(2.0), xp.log(4.0 * size) / loop.turns)
    return 1e-9 + xp.where(loop.turns > 1, xp.minimum(short, steep), short)


def slow_pole(loop: Loop) -> tuple[Array, Array]:
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
    return 0.5 * xp.log1p(re * (2.0 + re) + im * im), angle(1.0 + re, im)


def first_pair(loop: Loop, fractional: bool) -> tuple[Array, Array]:
    """The first pair of the ring, where T and B have one size as they change with |z| from the unit circle on."""
    xp = namespace(loop.alpha)
    im = np.pi / (loop.lag + 1.0)
    # Where W is nearly a negative multiple of z - 1, the phases of T and B meet a half turn later.
    im = xp.where((loop.alpha < -loop.beta * im) & (loop.turns > 1), 2.0 * im, im)
    x = xp.sin(0.5 * im) ** 2
    sizes = [(1.0 - zero) * (1.0 - zero) + 4.0 * zero * x for zero in (1.0, loop.c)]
    body = (loop.a2 + loop.h) ** 2 - 4.0 * loop.a2 * loop.h * x
    wall = loop.alpha * loop.alpha + 4.0 * loop.s * loop.beta * x
    turns = loop.turns
    if fractional:
        body, turns = body * ((1.0 + loop.q) ** 2 - 4.0 * loop.q * x), turns + 1.0
    return xp.maximum(0.5 * xp.log(body * wall / (sizes[0] * sizes[1])) / turns, -1.0), im


def larger_pole(loop: Loop, fractional: bool) -> tuple[Array, Array]:
    """The larger of the slow pole and the first pair of the ring, roughly."""
    xp = namespace(loop.alpha)

    def follow(start: tuple[Array, Array]) -> tuple[Array, Array]:
        return repeat(_BOTH, lambda at: halley_step(*at, loop, fractional), start, xp)

    slow, pair = apply_each(follow, [slow_pole(loop), first_pair(loop, fractional)], xp)
    first = (slow[0] >= pair[0]) | xp.isnan(pair[0])
    return xp.where(first, slow[0], pair[0]), xp.where(first, slow[1], pair[1])


def candidate(loop: Loop, fractional: bool) -> tuple[Array, Array]:
    """The larger of the two, nearly."""
    start = larger_pole(loop, fractional)
    return repeat(_LARGER, lambda at: halley_step(*at, loop, fractional), start, namespace(loop.alpha))


def certification_width(re: Array, tolerance: Any) -> Array:
    """How far outside of a pole the count finds no other: as near as its rounding allows, for rates of decay."""
    xp = namespace(re)
    return xp.minimum(tolerance, xp.maximum(_COUNTED * epsilon(re), _RELATIVE * xp.abs(re)))


def certify_pole(re: Array, im: Array, tolerance: Array, loop: Loop, fractional: bool, single: bool) -> OutermostPoles:
    """The pole after one more step, and whether its modulus is proved to be the radius within the tolerance."""
    xp = namespace(re, loop.alpha)
    # A wall without stiffness has a pole at 1.
    at_one = (loop.alpha == 0) & ~(re > tolerance)
    step = newton_step(re, im, loop, fractional)
    re, im = (xp.where(at_one, 0.0, part) for part in move_pole(re, im, step.re, step.im))
    seen = count(re + certification_width(re, tolerance), loop, fractional, single)
    proved = (at_one | (_AFTER * step.within <= tolerance)) & seen.full & seen.sure
    return OutermostPoles(re, im, xp.where(proved, tolerance, np.inf), xp.where(at_one, 0.0, step.doubt))


def quick_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, tolerance: Array, fractional: bool
) -> OutermostPoles:
    """The outermost pole of most points."""
    loop = store_once(factor_loop(alpha, beta, delta, d, fractional), delta)
    return certify_pole(*candidate(loop, fractional), tolerance, loop, fractional, fractional)


# Attempts to prove what the quick kernel has found but not proved, in NumPy; the loops are those of the walls.


def _certify_largest(
    starts: tuple[np.ndarray, np.ndarray], steps: int, tolerance: float, loop: Loop, fractional: bool
) -> OutermostPoles:
    """The largest of the poles to which starts lead, with a count that may meet several crossovers."""
    re, im = repeat(steps, lambda at: halley_step(*at, loop, fractional), starts, np)
    arrived = newton_step(re, im, loop, fractional).within < _ARRIVED
    best = np.where(arrived, re, -np.inf).argmax(0), np.arange(re.shape[1])
    return certify_pole(re[best], im[best], tolerance, loop, fractional, False)


def certify_again(found: OutermostPoles, tolerance: float, loop: Loop, fractional: bool) -> OutermostPoles:
    """What was found, and the start that is farther from it."""
    slow, pair = slow_pole(loop), first_pair(loop, fractional)
    farther = np.abs(found.im - slow[1]) > np.abs(found.im - pair[1])
    re, im = (np.stack([leaf, np.where(farther, *both)]) for leaf, *both in zip(found[:2], slow, pair, strict=True))
    return _certify_largest((re, im), _AGAIN, tolerance, loop, fractional)


def bound_radius(found: OutermostPoles, tolerance: float, loop: Loop, fractional: bool) -> OutermostPoles:
    """What was found, where two counts prove its radius alone."""
    above, below = (count(found.re + side, loop, fractional) for side in (tolerance, -tolerance))
    proved = above.full & above.sure & ~below.full & below.sure
    return found._replace(error=np.where(proved, tolerance, np.inf), doubt=np.where(proved, np.inf, found.doubt))


def all_starts(loop: Loop, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """Both starts, then the slow one put on the real axis or off it, which steps do not leave or meet: (4, loops)."""
    # Where the slow one is off the axis it is put on it, and the other way round.
    (slow, turn), pair = slow_pole(loop), first_pair(loop, fractional)
    other = np.where(turn > 0, 0.0, _OFF * pair[1])
    return np.stack([slow, pair[0], slow, 0.0 * slow]), np.stack([turn, pair[1], other, _BETWEEN * pair[1]])


def certify_starts(_: OutermostPoles, tolerance: float, loop: Loop, fractional: bool) -> OutermostPoles:
    """What all of the starts lead to."""
    return _certify_largest(all_starts(loop, fractional), _PATIENT, tolerance, loop, fractional)


def search(_: OutermostPoles, tolerance: float, loop: Loop, fractional: bool) -> OutermostPoles:
    """The outermost pole by halvings of the interval that counts leave, then a few steps."""
    # Of few walls several radii are counted in the time of one.
    parts = 2**_TOGETHER

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        low, width = state[0], (state[1] - state[0]) / parts
        radii = np.stack([low + k * width for k in range(1, parts)])
        full = count(radii, Loop(*(np.broadcast_to(part, radii.shape) for part in loop)), fractional).full
        low = low + width * (~full).sum(0)
        return low, low + width

    high = _largest(loop)
    _, radius = repeat(-(-_HALVINGS // _TOGETHER), step, (0.0 * high + _SMALLEST, high), np)
    best, im = np.inf, 0.0 * radius
    # On that circle the pole is at a crossover or at one of the ends.
    for place in (0.0 * radius, 0.0 * radius + np.pi, *count(radius, loop, fractional).crossings):
        within = newton_step(radius, place, loop, fractional).within
        im, best = np.where(within < best, place, im), np.minimum(within, best)
    at = repeat(_POLISHING, lambda at: halley_step(*at, loop, fractional), (radius, im), np)
    found = certify_pole(*at, tolerance, loop, fractional, False)
    # Next to multiple poles the steps end anywhere; the counts still know the radius.
    return found._replace(re=np.where(found.proved, found.re, radius))


class _Round(NamedTuple):
    """What a round of `_find_part` knows."""

    re: Array
    im: Array
    proved: Array
    low: Array  # halved interval of logarithms of the radius
    high: Array
    places: Array  # arguments of the crossovers on the last circle


def _find_traced(loop: Loop, fractional: bool) -> tuple[Array, Array, Array]:
    """The outermost pole, and whether it is proved to be it, a single one: as `quick_kernel` and `search` find it."""
    # Part by part; then those walls alone that this has left are searched for, as many at one time, by one program.
    import jax.numpy as xp
    from jax.lax import while_loop

    shape, size = loop.alpha.shape, loop.alpha.size
    length = max(-(-size // _PARTS), _LEAST_PART)
    if size <= length:
        return _find_part(0, 3, loop, fractional)
    columns, parts = [xp.broadcast_to(column, shape).reshape(-1) for column in loop], -(-size // length)

    def take(state: tuple[Any, ...]) -> tuple[Any, ...]:
        k, left, *known = state
        first = k < parts
        index = xp.where(first, k * length + xp.arange(length), xp.nonzero(left, size=length, fill_value=size)[0])
        some = Loop(*(column.at[index].get(mode="clip") for column in columns))
        found = _find_part(xp.where(first, 0, 1), xp.where(first, 1, 3), some, fractional)
        left = left.at[index].set(first & ~(found[2] | xp.isnan(some.alpha)), mode="drop")
        known = (whole.at[index].set(new, mode="drop") for whole, new in zip(known, found, strict=True))
        return k + 1, left, *known

    none = 0.0 * columns[0]
    start = 0, none > 0, none, none, none > 0
    found = while_loop(lambda state: (state[0] < parts) | state[1].any(), take, start)[2:]
    re, im, proved = (part.reshape(shape) for part in found)
    return re, im, proved


def _find_part(begin: Any, end: Any, loop: Loop, fractional: bool) -> tuple[Array, Array, Array]:
    """Some of the rounds of `_find_traced`, of some walls."""
    # A step on a pole and a count, which take a compiler its time, stand in two loops that every round runs through:
    # the larger pole and its proof; where that leaves any wall, the halvings; the pole on the circle, and its proof.
    import jax.numpy as xp
    from jax.lax import fori_loop, while_loop

    tolerance = epsilon(loop.c) ** 0.58
    high = _largest(loop)
    # At the ends of the circle, then at the crossovers.
    looks = 5 if fractional else 4
    last = looks + _POLISHING + _NEWTON
    # By rounds: the steps on a pole, the first of which look at the places, and the counts, the last of which proves.
    steps = xp.asarray([(looks + _POLISHING - _LARGER, last), (last, last), (0, last)])
    first = _HALVINGS + 1
    counts = xp.asarray([(first, first + 1), (0, first), (first, first + _FARTHER)])

    def run(state: tuple[Any, _Round]) -> tuple[Any, _Round]:
        turn, known = state

        def step(k: Any, at: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            re, im, within = at
            looking = k < looks
            place = xp.where(k < 2, np.pi * k, known.places[xp.clip(k - 2, 0, looks - 3)])
            place = xp.where(looking, place, im)
            by = newton_step(re, place, loop, fractional)
            ahead = halley_step(re, place, loop, fractional), move_pole(re, place, by.re, by.im)
            to_re, to_im = (xp.where(k < last - _NEWTON, *pair) for pair in zip(*ahead, strict=True))
            # Of the places the nearest to a pole is kept.
            kept = looking & ~(by.within < within)
            im = xp.where(kept, im, xp.where(looking, place, to_im))
            return xp.where(looking, re, to_re), im, xp.where(kept, within, by.within)

        at = xp.where(turn == 0, known.re, known.high), known.im, xp.full_like(high, np.inf)
        re, im, within = fori_loop(steps[turn, 0], steps[turn, 1], step, at)
        # A wall without stiffness has a pole at 1.
        at_one = (loop.alpha == 0) & ~(re > tolerance)
        re, im = xp.where(at_one, 0.0, re), xp.where(at_one, 0.0, im)

        def look(k: Any, at: _Round) -> _Round:
            middle = xp.where(k < _HALVINGS, 0.5 * (at.low + at.high), at.high)
            width = xp.minimum(certification_width(re, tolerance) * 10.0 ** (k - first), epsilon(re) ** 0.5)
            log_r = xp.where(k > _HALVINGS, re + width, middle)
            seen = count(log_r, loop, fractional)
            inside = store_once(xp.where(seen.full, xp.where(seen.sure, 2.0, 1.0), 0.0), log_r)
            proved = (k > _HALVINGS) & ~at.proved & (inside > 1) & (at_one | (_AFTER * within <= tolerance))
            return _Round(
                xp.where(proved, re, at.re),
                xp.where(proved, im, at.im),
                at.proved | proved,
                xp.where((k < _HALVINGS) & (inside == 0), middle, at.low),
                xp.where((k < _HALVINGS) & (inside > 0), middle, at.high),
                xp.stack(seen.crossings),
            )

        return turn + 1, fori_loop(counts[turn, 0], counts[turn, 1], look, known)

    def going(state: tuple[Any, _Round]) -> Any:
        return (state[0] == begin) | ((state[0] < end) & ~(state[1].proved | xp.isnan(loop.alpha)).all())

    none = xp.stack([0.0 * high] * (looks - 2))
    start = _Round(*larger_pole(loop, fractional), high > np.inf, 0.0 * high + _SMALLEST, high, none)
    return while_loop(going, run, (begin, start))[1][:3]


def traced_kernel(alpha: Array, beta: Array, delta: Array, d: Array, fractional: bool) -> Array:
    """The logarithm of the radius with its derivatives, inside somebody's transformation."""
    # NaN where it was not found or the outermost pole is a multiple one.
    xp = namespace(alpha, beta, delta, d)
    loop = store_once(factor_loop(alpha, beta, delta, d, fractional), delta)
    re, im, proved = _find_traced(frozen(loop, xp), fractional)

    def at(place: Array, loop: Loop) -> list[Array]:
        return [join(part.real, part.imag) for part in value_at(place.real, place.imag, loop, fractional)[:2]]

    place = follow_root(lambda *x: at(*x)[0], join(re, im), lambda *_: True, loop, slope=lambda *x: at(*x)[1])
    (log_radius,) = nan_unless(proved, place.real)
    return log_radius + nan_with_nan_slopes(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
