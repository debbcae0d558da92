"""How many poles lie inside the circle |z| = r, in closed form: where the two parts of the loop are equally large.

P = T + B as in `loops.rigid.crossover`, ``T = z^(1+n) (z - 1)(z - c)`` and ``B = M(z) (s z - beta)`` with
s = alpha + beta and ``M = (a2 z + h)(1 + q/z)``, whose zeros are real and not positive. On ``z = r e^(j w)``,
0 < w < pi, with x = sin^2(w/2) every factor has ``|z - a|^2 = (r - a)^2 + 4 r a x`` and an imaginary part of one sign.
Hence |T|^2 - |B|^2 is a quadratic in x (whole delays) or a cubic, every argument is continuous where it is principal,
and the poles inside are counted as in docs/theory/one-crossover.md, Theorem 4. The logarithm of r is what is given, so
that circles a hair beside the unit circle are told apart from it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.held_mass import factor_numerator, held_plant, split_delay
from zwidth.loops.rigid.crossover import first_zero
from zwidth.loops.rigid.normalization import valid_wall
from zwidth.words.types import Array
from zwidth.words.xp import angle, apply_each, epsilon, find_turn, namespace, nan_unless, repeat

# Steps of the bracketed Newton iteration for the zeros of the cubic.
_CUBIC_STEPS = 6
# Cells are taken a little wider than they are, for rounding errors.
_WIDER = 1.0 + 1e-12
# Ends and middles of the pieces of an interval between zeros, each with a bound of its own.
_CUTS = np.arange(9)[:, None, None] / 8.0


class Loop(NamedTuple):
    """One loop by its factors; NaN throughout where an input is out of range."""

    alpha: Array
    beta: Array
    s: Array  # alpha + beta
    turns: Array  # 1 + n, the powers of z in T
    lag: Array  # 1 + d
    c: Array
    em: Array  # 1 - c
    a2: Array
    h: Array
    q: Array  # 0 for whole delays


def factor_loop(alpha: Array, beta: Array, delta: Array, d: Array, fractional: bool) -> Loop:
    """The factors of P; ``fractional`` says whether any delay has a fraction."""
    xp = namespace(alpha, beta, delta, d)
    ok = valid_wall(alpha, beta, delta, d)
    delta, d = xp.where(ok, delta, 1.0), xp.where(ok, d, 0.0)
    whole, f = split_delay(d)
    plant = held_plant(delta, f if fractional else None)
    h, q = factor_numerator(plant) if fractional else (plant.a1, 0.0 * plant.a1)
    alpha, beta, s = nan_unless(ok, alpha, beta, alpha + beta)
    return Loop(alpha, beta, s, whole + 1.0, d + 1.0, plant.c, plant.em, plant.a2, h, q)


class _Circle(NamedTuple):
    """One circle: the factors at z = r, what T and B are multiplied by, and |T|^2 - |B|^2 by powers of x."""

    r: Array
    near: Array  # r - 1
    off: Array  # r - c
    front: Array  # s r - beta
    body: Array  # a2 r + h
    h: tuple[Array, Array, Array, Array]
    first: tuple[Array, Array]  # |T| and |B| at x = 0
    last: tuple[Array, Array]  # and at x = 1
    sizes: tuple[Array, ...]  # the parts of |T|^2 and of a bound of |B|^2, by powers of x

    def parts(self, x: Array) -> Array:
        """What the difference is a difference of, at x."""
        t0, t1, c0, c1, m0, w0, w1 = self.sizes
        return (t0 + t1 * x) * (c0 + c1 * x) + m0 * (w0 + w1 * x)

    def slope(self, x: Array) -> Array:
        """The derivative of the difference."""
        return self.h[1] + x * (2.0 * self.h[2] + 3.0 * x * self.h[3])

    def value(self, x: Array) -> Array:
        """The difference."""
        return self.h[0] + x * (self.h[1] + x * (self.h[2] + x * self.h[3]))


def _circle(log_r: Array, loop: Loop, fractional: bool, xp: Any) -> _Circle:
    r, near = xp.exp(log_r), xp.expm1(log_r)
    off, front, body = near + loop.em, loop.alpha * r + loop.beta * near, loop.a2 * r + loop.h
    power = loop.turns * log_r
    less = xp.exp(-xp.abs(power))
    # The larger of r^(1+n) and 1 is divided out.
    up, down = xp.where(power < 0, less, 1.0), xp.where(power < 0, 1.0, less)
    t0, t1 = up * near * (up * near), 4.0 * r * up * up
    c0, c1 = off * off, 4.0 * r * loop.c
    w0, w1 = front * front, 4.0 * r * loop.s * loop.beta
    m0, m1 = down * body * (down * body), -4.0 * r * loop.a2 * loop.h * down * down
    b0, b1, b2, b3 = m0 * w0, m0 * w1 + m1 * w0, m1 * w1, 0.0 * m0
    held, late = 1.0, 1.0
    if fractional:
        ratio = loop.q / r
        held, late = 1.0 + ratio, 1.0 - ratio
        g0, g1 = held * held, -4.0 * ratio
        b0, b1, b2, b3 = b0 * g0, b1 * g0 + b0 * g1, b2 * g0 + b1 * g1, b2 * g1
        m0 = m0 * g0
    first = up * xp.abs(near * off), down * xp.abs(body * held * front)
    turned = (loop.h - loop.a2 * r) * late * (front + 2.0 * loop.beta)
    last = up * (1.0 + r) * (loop.c + r), down * xp.abs(turned)
    h = (t0 * c0 - b0, t0 * c1 + t1 * c0 - b1, t1 * c1 - b2, -b3)
    return _Circle(r, near, off, front, body, h, first, last, (t0, t1, c0, c1, m0, w0, xp.abs(w1)))


def _quadratic_zeros(h0: Array, h1: Array, h2: Array, xp: Any) -> list[Array]:
    """Both zeros in order, NaN where they are complex."""
    root = xp.sqrt(h1 * h1 - 4.0 * h0 * h2)
    half = -0.5 * (h1 + xp.where(h1 < 0, -root, root))
    one, other = half / h2, h0 / half
    # Without a leading coefficient one zero is at infinity, or both.
    one = xp.where(h2 == 0, np.inf, one)
    other = xp.where(half == 0, one, other)
    return [xp.minimum(one, other), xp.maximum(one, other)]


def _cubic_zeros(at: _Circle, xp: Any) -> list[Array]:
    """The zeros in (0, 1) in order, at most one between two extremes; NaN where there is none."""
    h0, h1, h2, h3 = at.h
    low, high = _quadratic_zeros(h1, 2.0 * h2, 3.0 * h3, xp)
    low, high = (xp.where(xp.isfinite(x), xp.clip(x, 0.0, 1.0), 0.0) for x in (low, high))
    ends = [0.0 * h0, xp.minimum(low, high), xp.maximum(low, high), 0.0 * h0 + 1.0]
    values = [at.value(x) for x in ends]
    pieces = list(zip(ends[:-1], ends[1:], values[:-1], values[1:], strict=True))
    return apply_each(lambda piece: _find_zero_between(piece, at, xp), pieces, xp)


def _find_zero_between(piece: tuple[Array, ...], at: _Circle, xp: Any) -> Array:
    """The zero of a monotone piece of a cubic: each step solves for the parabola that touches it twice."""
    # A piece is its two ends and the values there.
    low, high, first, last = piece
    exists = (first < 0) != (last < 0)
    if xp is np and not np.any(exists):
        return low + np.nan
    falls = first > 0
    sign = xp.where(falls, -2.0, 2.0)

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, low, high = state
        value, slope, bend = at.value(x), at.slope(x), 2.0 * at.h[2] + 6.0 * x * at.h[3]
        before = (value > 0) == falls
        low, high = xp.where(before, x, low), xp.where(before, high, x)
        new = x - sign * value / (xp.abs(slope) + xp.sqrt(xp.maximum(slope * slope - 2.0 * value * bend, 0.0)))
        return xp.where((new >= low) & (new <= high), new, 0.5 * (low + high)), low, high

    def arrived(old: tuple[Array, ...], new: tuple[Array, ...]) -> bool:
        return bool(np.all((old[0] == new[0]) | ~exists))

    x = repeat(_CUBIC_STEPS, step, (xp.where(xp.abs(first) < xp.abs(last), low, high), low, high), xp, arrived)[0]
    return xp.where(exists, x, np.nan)


def _only_zero(at: _Circle, xp: Any) -> tuple[Array, Array]:
    """The one zero in (0, 1) of a cubic whose signs at the ends differ, and whether it is known to be the one."""
    h0, h1, h2, h3 = at.h
    sign = xp.where(h0 > 0, 1.0, -1.0)
    x = first_zero(tuple([sign * h for h in at.h]))
    # Monotone, or with one extreme, or none inside; and the steps have arrived.
    alone = (h2 * h2 < 3.0 * h1 * h3) | (h1 * at.slope(1.0) < 0) | (xp.abs(h2) > 3.0 * xp.abs(h3)) | (h2 * h3 > 0)
    return x, alone & (xp.abs(at.value(x)) <= 8.0 * epsilon(x) * at.parts(x))


def _phase(x: Array, at: _Circle, loop: Loop, fractional: bool, xp: Any) -> tuple[Array, Array, Array]:
    """``arg T - arg B`` at a crossover, continuous from w = 0, w, and a bound of what moves the one with the other."""
    y = 1.0 - x
    im, twice = 2.0 * at.r * xp.sqrt(x * y), 2.0 * at.r * x
    one, pole = at.near - twice, at.off - twice
    sign = xp.where(loop.s < 0, -1.0, 1.0)
    wall, wall_im = sign * (at.front - loop.s * twice), sign * loop.s * im
    body, body_im = at.body - loop.a2 * twice, loop.a2 * im
    # (z - 1)/(a2 z + h), its argument in (0, pi), and (z - c)/W in (-pi, pi).
    p_re, p_im = one * body + im * body_im, im * body - one * body_im
    q_re, q_im = pole * wall + im * wall_im, im * wall - pole * wall_im
    v_re, v_im = p_re * q_re - p_im * q_im, p_re * q_im + p_im * q_re
    phase = angle(v_re, v_im)
    phase = xp.where((v_im < 0) & (q_im >= 0), phase + 2.0 * np.pi, phase)
    w = find_turn(x, y, xp)
    theta = loop.turns * w + phase + xp.where(loop.s < 0, np.pi, 0.0)
    if fractional:
        # arg(1 + q/z) = arg(z + q) - w, in [-pi, 0]
        ratio = loop.q / at.r
        theta = theta - angle(1.0 + ratio - 2.0 * ratio * x, -ratio * im / at.r)
    # z/(z - a) = 1 + a/(z - a) of every factor
    rate = loop.turns + 0.0 * x
    parts = [(1.0, one, im), (loop.c, pole, im), (loop.h, body, body_im), (xp.abs(loop.beta), wall, wall_im)]
    for zero, part, part_im in [*parts, (loop.q, at.r - twice + loop.q, im)] if fractional else parts:
        rate = rate + zero / xp.maximum(xp.abs(part), part_im)
    return theta, w, rate


class Count(NamedTuple):
    """What the count on one circle has seen."""

    missing: Array  # poles that are not inside
    sure: Array  # rounding errors cannot have decided that
    crossings: list[Array]  # the arguments w of the crossovers, and where there is none of any point

    @property
    def full(self) -> Array:
        """Every pole is inside."""
        return self.missing == 0


def count(log_r: Array, loop: Loop, fractional: bool, single: bool = False) -> Count:
    """How many poles are not inside ``|z| = e^log_r``."""
    # With ``single``, for fractional delays, nothing is sure without one crossover alone; that takes half of the time.
    xp = namespace(log_r, loop.alpha)
    at = _circle(log_r, loop, fractional, xp)
    outer, ends_outer = at.first[0] > at.first[1], at.last[0] > at.last[1]
    eps = epsilon(log_r)
    blur = 4.0 * eps * (loop.turns + 8.0)
    sure = ~(_may_cancel(at.first, blur) | _may_cancel(at.last, blur))
    if single:
        x, alone = _only_zero(at, xp)
        zeros = [xp.where(outer != ends_outer, x, -1.0)]
        sure = sure & (outer != ends_outer) & alone
    else:
        zeros = _cubic_zeros(at, xp) if fractional else _quadratic_zeros(*at.h[:3], xp)
    start, stop, _ = _ends(at, loop, outer, ends_outer)
    turn, crossings = 0.0 * start, []
    inside = [(x >= 0) & (x < 1.0) for x in zeros]
    zeros = [xp.where(valid, x, 0.5) for valid, x in zip(inside, zeros, strict=True)]

    def phase(x: Array) -> tuple[Array, Array, Array]:
        theta, w, rate = _phase(x, at, loop, fractional, xp)
        # The rounding of theta, and that of x where the two sizes cross at a small angle.
        return theta, w, rate * at.parts(x) / (xp.abs(at.slope(x)) * xp.sqrt(x * (1.0 - x)))

    # One text for all three takes half of the time to compile; of two it would run half as fast.
    phases = list(map(phase, zeros)) if len(zeros) < 3 else apply_each(phase, zeros, xp)
    for valid, (theta, w, shift) in zip(inside, phases, strict=True):
        part = theta / (2.0 * np.pi)
        whole = xp.round(part)
        turn = turn + xp.where(valid, xp.where(outer, whole, -whole), 0.0)
        outer = outer != valid
        sure = sure & (~valid | (0.5 - xp.abs(part - whole) > blur + 4.0 * eps * shift))
        crossings.append(w)
    # Rounding must not have changed the number of crossovers.
    sure = sure & (outer == ends_outer)
    return Count(loop.turns + 2.0 - (stop - start + 2.0 * turn), sure, crossings)


def count_in_cell(
    log_r: Array, loop: Loop, half: tuple[Array, Array], fractional: bool
) -> tuple[np.ndarray, np.ndarray]:
    """How many poles are outside ``|z| = e^log_r``, and whether that is so for every wall of a cell."""
    # The walls are those whose alpha and beta differ by at most ``half`` from the loop's (docs/theory/maps.md, C4).
    at = _circle(log_r, loop, fractional, np)
    a, b = half
    r, near, power = at.r, np.abs(at.near), loop.turns * log_r
    # How far W = alpha z + beta (z - 1) moves at x = 0, and |W|^2 = w0 + w1 x by its two coefficients.
    moved, w1 = a * r + b * near, 4.0 * r * loop.s * loop.beta
    e0 = (2.0 * np.abs(at.front) * moved + moved * moved) * _WIDER + 1e-14 * at.front**2
    e1 = 4.0 * r * (np.abs(loop.s) * b + (np.abs(loop.beta) + b) * (a + b)) * _WIDER + 1e-14 * np.abs(w1)
    down = np.where(power < 0, 1.0, np.exp(-np.abs(power)))
    m0, m1 = (down * at.body) ** 2, -4.0 * r * loop.a2 * loop.h * down * down
    by = [m0 * e0, m0 * e1 + m1 * e0, m1 * e1, 0.0 * m0]
    if fractional:
        ratio = loop.q / r
        g0, g1 = (1.0 + ratio) ** 2, -4.0 * ratio
        by = [by[0] * g0, by[1] * g0 + by[0] * g1, by[2] * g0 + by[1] * g1, by[2] * g1]
    ends = []
    for side in (-1.0, 1.0):
        h = tuple(part + side * change for part, change in zip(at.h, by, strict=True))
        zeros = _cubic_zeros(at._replace(h=h), np) if fractional else _quadratic_zeros(h[0], h[1], h[2], np)
        zeros = np.sort([np.where((x >= 0) & (x < 1.0), x, np.nan) for x in zeros], axis=0)
        ends.append((h[0] > 0, h[0] + h[1] + h[2] + h[3] > 0, zeros))
    (outer, ends_outer, low), (other, ends_other, high) = ends
    sure = (outer == other) & (ends_outer == ends_other)
    start, stop, last = _ends(at, loop, outer, ends_outer)
    # Where the wall's part is the larger at an end, its sign is that of every wall.
    sure &= (outer | (np.abs(at.front) > moved)) & (ends_outer | (np.abs(last) > a * r + b * (1.0 + r)))
    valid = ~np.isnan(low)
    sure &= (valid == ~np.isnan(high)).all(0)
    first, second = (np.where(valid, end(low, high), 0.5) for end in (np.fmin, np.fmax))
    w_first, w_second = (find_turn(x, 1.0 - x, np) for x in (first, second))
    cuts = np.sin(0.5 * (w_first + _CUTS * (w_second - w_first))) ** 2
    first, x, second = cuts[:-1:2], cuts[1::2], cuts[2::2]
    part = _phase(x, at, loop, fractional, np)[0] / (2.0 * np.pi)
    whole = np.round(part[0])
    # z/(z - a) = 1 + a/(z - a) of every factor, where z is nearest to its zero.
    wall = np.sqrt(np.maximum(at.front**2 + np.minimum(w1 * first, w1 * second), 0.0))
    rate = loop.turns + 1.0 / np.sqrt(near**2 + 4.0 * r * first) + np.abs(loop.beta) / wall
    rate = rate + loop.c / np.sqrt(at.off**2 + 4.0 * r * loop.c * first)
    rate = rate + loop.h / np.sqrt(np.maximum(at.body**2 - 4.0 * r * loop.a2 * loop.h * second, 0.0))
    if fractional:
        rate = rate + loop.q / np.sqrt(np.maximum((r + loop.q) ** 2 - 4.0 * r * loop.q * second, 0.0))
    reach = (a * r + b * np.sqrt(near**2 + 4.0 * r * second)) / wall
    moves = _CUTS[1] * (w_second - w_first) * rate + np.where(reach < 1.0, 0.5 * np.pi * reach, np.inf)
    sure &= (~valid | (2.0 * np.pi * np.abs(part - whole) + moves < np.pi - 1e-9)).all((0, 1))
    # The larger part alternates.
    signs = np.where(outer, 1.0, -1.0) * (-1.0) ** np.arange(len(valid))[:, None]
    turn = np.where(valid, signs * whole, 0.0).sum(0)
    return loop.turns + 2.0 - (stop - start + 2.0 * turn), sure


def _ends(at: _Circle, loop: Loop, outer: Array, ends_outer: Array) -> tuple[Array, Array, Array]:
    """The argument of P over pi at both ends, that of its larger part; and the wall's part at the last one."""
    xp = namespace(at.r)
    half = xp.where(loop.s < 0, -1.0, 1.0)
    start = xp.where(
        outer, xp.where(at.near < 0, 1.0, 0.0) + xp.where(at.off < 0, 1.0, 0.0), xp.where(at.front < 0, half, 0.0)
    )
    body, wall = loop.h - loop.a2 * at.r, -(at.front + 2.0 * loop.beta)
    stop = xp.where(body < 0, 1.0, 0.0) - xp.where(loop.q > at.r, 1.0, 0.0) + xp.where(wall < 0, half, 0.0)
    return start, xp.where(ends_outer, loop.turns + 2.0, stop), wall


def _may_cancel(sizes: tuple[Array, Array], blur: Array) -> Array:
    """Whether T and B may cancel but for rounding errors where the circle meets the real axis."""
    return namespace(blur).abs(sizes[0] - sizes[1]) <= blur * sizes[1]
