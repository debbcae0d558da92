"""How many poles lie inside the circle |z| = r, in closed form: where the two parts of the loop are equally large.

P = T + B as in `zwidth.stability.crossover`, ``T = z^(1+n) (z - 1)(z - c)`` and ``B = M(z) (s z - beta)`` with
s = alpha + beta and ``M = (a2 z + h)(1 + q/z)``, whose zeros are real and not positive. On ``z = r e^(j w)``,
0 < w < pi, with x = sin^2(w/2) every factor has ``|z - a|^2 = (r - a)^2 + 4 r a x`` and an imaginary part of one sign.
Hence

- |T|^2 - |B|^2 is a quadratic in x (whole delays) or a cubic; its zeros in (0, 1) are the crossovers;
- every argument is continuous where it is principal, and between crossovers that of P stays within a quarter turn of
  that of the larger part. At a crossover the two differ by ``theta = arg T - arg B``; P continues with the other part
  plus or minus 2 pi m, m the whole number nearest to theta/(2 pi).

The number of zeros inside is the turn of P over pi; nothing in it grows with n. The logarithm of r is what is given, so
that circles a hair beside the unit circle are told apart from it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.loop import valid_wall
from zwidth.plant import held_plant, split_delay, undelayed_plant
from zwidth.stability.arcs import angle, turn_of
from zwidth.xp import epsilon, namespace

# What rounding makes of a bracket, and of an odd multiple over the number of turns, in rounding units.
_NEAR = 5e3
_MET = 50.0
# Steps of the bracketed Newton iteration for the zeros of the cubic.
_CUBIC_STEPS = 6


class Loop(NamedTuple):
    """One loop by its factors; NaN throughout where an input is out of range."""

    alpha: Array
    beta: Array
    s: Array  # alpha + beta
    turns: Array  # 1 + n, the powers of z in T
    c: Array
    em: Array  # 1 - c
    a2: Array
    h: Array
    q: Array  # 0 for whole delays


def loop_of(alpha: Array, beta: Array, delta: Array, d: Array, fractional: bool) -> Loop:
    """The factors of P; ``fractional`` says whether any delay has a fraction."""
    xp = namespace(alpha, beta, delta, d)
    ok = valid_wall(alpha, beta, delta, d)
    delta, d = xp.where(ok, delta, 1.0), xp.where(ok, d, 0.0)
    whole, f = split_delay(d)
    if fractional:
        plant = held_plant(delta, f)
        h = 0.5 * (plant.a1 + xp.sqrt(xp.maximum(plant.a1 * plant.a1 - 4.0 * plant.a2 * plant.a0, 0.0)))
        q = plant.a0 / h
    else:
        plant = undelayed_plant(delta)
        h, q = plant.a1, 0.0 * plant.a1
    spoiled = xp.where(ok, 0.0, np.nan)
    return Loop(alpha + spoiled, beta + spoiled, alpha + beta, whole + 1.0, plant.c, plant.em, plant.a2, h, q)


class Circle(NamedTuple):
    """What the count at one radius has seen."""

    count: Array  # zeros inside, less the pole at 0 of a held delay
    full: Array  # every pole is inside
    sure: Array  # rounding errors cannot have decided the count, as far as asked for
    re: Array  # logarithm of the modulus and argument of the pole that Newton's method on the crossovers expects
    im: Array


class Sides(NamedTuple):
    """The sizes of the factors on one circle."""

    r: Array
    near: Array  # r - 1
    off: Array  # r - c
    front: Array  # s r - beta
    body: Array  # a2 r + h
    up: Array  # what T and B are multiplied by: r^(1+n) where it is below 1, and its inverse where that is
    down: Array


def sides(log_r: Array, loop: Loop) -> Sides:
    xp = namespace(log_r, loop.alpha)
    r, near = xp.exp(log_r), xp.expm1(log_r)
    power = loop.turns * log_r
    up, down = xp.exp(xp.minimum(power, 0.0)), xp.exp(-xp.maximum(power, 0.0))
    front = loop.alpha * r + loop.beta * near
    return Sides(r, near, near + loop.em, front, loop.a2 * r + loop.h, up, down)


class _Sizes(NamedTuple):
    """Squares of the factors' moduli at w = 0 and their growth with x, and the coefficients of |T|^2 - |B|^2."""

    device: tuple[Array, Array, Array, Array]
    wall: tuple[Array, Array, Array]
    h: tuple[Array, Array, Array, Array]

    def parts(self, x: Array) -> Array:
        """What the difference is a difference of, at x."""
        t0, t1, c0, c1 = self.device
        m0, w0, w1 = self.wall
        return (t0 + t1 * x) * (c0 + c1 * x) + m0 * (w0 + w1 * x)


def _sizes(at: Sides, loop: Loop, fractional: bool) -> _Sizes:
    xp = namespace(at.r)
    r = at.r
    t0, t1 = at.up * at.near * (at.up * at.near), 4.0 * r * at.up * at.up
    c0, c1 = at.off * at.off, 4.0 * r * loop.c
    w0, w1 = at.front * at.front, 4.0 * r * loop.s * loop.beta
    m0, m1 = at.down * at.body * (at.down * at.body), -4.0 * r * loop.a2 * loop.h * at.down * at.down
    b0, b1, b2, b3 = m0 * w0, m0 * w1 + m1 * w0, m1 * w1, 0.0 * m0
    if fractional:
        ratio = loop.q / r
        g0, g1 = (1.0 + ratio) * (1.0 + ratio), -4.0 * ratio
        b0, b1, b2, b3 = b0 * g0, b1 * g0 + b0 * g1, b2 * g0 + b1 * g1, b2 * g1
        m0 = m0 * g0
    h = (t0 * c0 - b0, t0 * c1 + t1 * c0 - b1, t1 * c1 - b2, -b3)
    return _Sizes((t0, t1, c0, c1), (m0, w0, xp.abs(w1)), h)


def _quadratic_zeros(h0: Array, h1: Array, h2: Array, xp: Any) -> list[Array]:
    """Both zeros in order, NaN where they are complex."""
    root = xp.sqrt(h1 * h1 - 4.0 * h0 * h2)
    half = -0.5 * (h1 + xp.where(h1 < 0, -root, root))
    one, other = half / h2, h0 / half
    # Without a leading coefficient one zero is at infinity, or both.
    one = xp.where(h2 == 0, np.inf, one)
    other = xp.where(half == 0, one, other)
    return [xp.minimum(one, other), xp.maximum(one, other)]


def _cubic_zeros(h0: Array, h1: Array, h2: Array, h3: Array, xp: Any) -> list[Array]:
    """The zeros in (0, 1) in order, at most one between two extremes; NaN where there is none."""
    low, high = _quadratic_zeros(h1, 2.0 * h2, 3.0 * h3, xp)
    low, high = (xp.where(xp.isfinite(x), xp.clip(x, 0.0, 1.0), 0.0) for x in (low, high))
    low, high = xp.minimum(low, high), xp.maximum(low, high)
    ends = [0.0 * h0, low, high, 0.0 * h0 + 1.0]
    values = [h0 + x * (h1 + x * (h2 + x * h3)) for x in ends]
    return [_between(ends[k], ends[k + 1], values[k], values[k + 1], (h0, h1, h2, h3), xp) for k in range(3)]


def _between(low: Array, high: Array, first: Array, last: Array, h: tuple[Array, ...], xp: Any) -> Array:
    """The zero of a monotone piece of a cubic: each step solves for the parabola that touches it twice."""
    exists = (first < 0) != (last < 0)
    if xp is np and not np.any(exists):
        return low + np.nan
    falls = first > 0
    sign = xp.where(falls, -2.0, 2.0)
    x = xp.where(xp.abs(first) < xp.abs(last), low, high)
    for _ in range(_CUBIC_STEPS):
        value = h[0] + x * (h[1] + x * (h[2] + x * h[3]))
        slope = h[1] + x * (2.0 * h[2] + 3.0 * x * h[3])
        bend = 2.0 * h[2] + 6.0 * x * h[3]
        before = (value > 0) == falls
        low, high = xp.where(before, x, low), xp.where(before, high, x)
        new = x - sign * value / (xp.abs(slope) + xp.sqrt(xp.maximum(slope * slope - 2.0 * value * bend, 0.0)))
        old, x = x, xp.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        if xp is np and np.all((old == x) | ~exists):
            break
    return xp.where(exists, x, np.nan)


class _Crossing(NamedTuple):
    theta: Array
    w: Array
    re: Array  # F' of F = log(T/B) as a function of log z
    im: Array
    rate: Array  # a bound of |F'| without the cancellation of its parts
    quotient: Array  # |T/B|^2 over r^(2 (1 + n))
    wall_re: Array  # the derivative of log B
    wall_im: Array


def crossing(x: Array, at: Sides, loop: Loop, fractional: bool, xp: Any) -> _Crossing:
    """``arg T - arg B`` at a crossover, continuous from w = 0, and the derivative of ``log(T/B)``."""
    y = 1.0 - x
    r = at.r
    im, twice = 2.0 * r * xp.sqrt(x * y), 2.0 * r * x
    z = r - twice
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
    w = turn_of(x, y, xp)
    theta = loop.turns * w + phase + xp.where(loop.s < 0, np.pi, 0.0)
    sizes = [
        one * one + im * im,
        pole * pole + im * im,
        body * body + body_im * body_im,
        wall * wall + wall_im * wall_im,
    ]
    # z/(z - a) = 1 + a/(z - a)
    parts = [
        (1.0, one, im, sizes[0]),
        (loop.c, pole, im, sizes[1]),
        (loop.h, body, body_im, sizes[2]),
        (-sign * loop.beta, wall, wall_im, sizes[3]),
    ]
    quotient = sizes[0] / sizes[2] * (sizes[1] / sizes[3])
    re, slope_im, rate = loop.turns, 0.0 * x, loop.turns
    for zero, part, part_im, size in parts:
        scaled = zero / size
        re = re + scaled * part
        slope_im = slope_im - scaled * part_im
        rate = rate + xp.abs(scaled) * xp.sqrt(size)
    b_re = loop.turns + 2.0 + parts[0][1] / sizes[0] + loop.c * pole / sizes[1] - re
    b_im = -im / sizes[0] - loop.c * im / sizes[1] - slope_im
    if fractional:
        late, late_size = z + loop.q, (z + loop.q) * (z + loop.q) + im * im
        # arg(1 + q/z) = arg(z + q) - w, in [-pi, 0]
        ratio = loop.q / r
        theta = theta - angle(1.0 + ratio - 2.0 * ratio * x, -ratio * im / r)
        scaled = loop.q / late_size
        re, slope_im = re + scaled * late, slope_im - scaled * im
        b_re, b_im = b_re - scaled * late, b_im + scaled * im
        rate = rate + scaled * xp.sqrt(late_size)
        quotient = quotient / (1.0 + ratio * ratio + 2.0 * ratio * (1.0 - 2.0 * x))
    return _Crossing(theta, w, re, slope_im, rate, quotient, b_re, b_im)


class _End(NamedTuple):
    """T and B where the circle meets the real axis."""

    device: Array  # its argument over pi, continuous along the half circle
    wall: Array
    opposite: Array  # their signs differ
    level: Array  # log |T/B|
    slope: Array  # F' there, a real number
    device_size: Array  # |T| and |B|
    wall_size: Array


def _end(
    log_r: Array,
    at: Sides,
    factors: tuple[Array, ...],
    signs: tuple[Array, Array],
    angles: tuple[Array, Array],
    loop: Loop,
) -> _End:
    """From z - 1, z - c, a2 z + h, 1 + q/z, s z - beta and z + q, all real."""
    one, pole, body, late, wall, shifted = factors
    xp = namespace(one)
    level = loop.turns * log_r + xp.log(xp.abs(one * pole / (body * late * wall)))
    slope = loop.turns + 1.0 / one + loop.c / pole + loop.h / body - loop.beta / wall
    slope = slope + xp.where(loop.q > 0, loop.q / shifted, 0.0)
    sizes = at.up * xp.abs(one * pole), at.down * xp.abs(body * late * wall)
    return _End(*angles, signs[0] != signs[1], level, slope, *sizes)


def real_ends(log_r: Array, at: Sides, loop: Loop) -> tuple[_End, _End]:
    xp = namespace(at.r)
    r = at.r
    half = xp.where(loop.s < 0, -1.0, 1.0)
    ratio = loop.q / r
    device = xp.where(at.near < 0, 1.0, 0.0) + xp.where(at.off < 0, 1.0, 0.0)
    behind = at.front < 0
    front = _end(
        log_r,
        at,
        (at.near, at.off, at.body, 1.0 + ratio, at.front, r + loop.q),
        ((at.near < 0) != (at.off < 0), behind),
        (device, xp.where(behind, half, 0.0)),
        loop,
    )
    body, late, wall = loop.h - loop.a2 * r, 1.0 - ratio, -(loop.alpha * r + loop.beta * (1.0 + r))
    flipped = (body < 0) != ((late < 0) != (wall < 0))
    back = _end(
        log_r,
        at,
        (-1.0 - r, -loop.c - r, body, late, wall, loop.q - r),
        (xp.mod(loop.turns, 2.0) == 1.0, flipped),
        (
            loop.turns + 2.0,
            xp.where(body < 0, 1.0, 0.0) - xp.where(late < 0, 1.0, 0.0) + xp.where(wall < 0, half, 0.0),
        ),
        loop,
    )
    return front, back


def _tied(end: _End, blur: Array) -> Array:
    """Whether T and B may cancel there but for rounding errors."""
    xp = namespace(blur)
    return end.opposite & (xp.abs(end.device_size - end.wall_size) < blur * end.wall_size)


class _Count(NamedTuple):
    """How many poles are inside, and what was seen on the way."""

    count: Array
    full: Array
    sure: Array
    at: Sides
    ends: tuple[_End, _End]
    crossings: list[tuple[_Crossing, Array, Array]]


def _counted(log_r: Array, loop: Loop, fractional: bool) -> _Count:
    xp = namespace(log_r, loop.alpha)
    at = sides(log_r, loop)
    sizes = _sizes(at, loop, fractional)
    zeros = _cubic_zeros(*sizes.h, xp) if fractional else _quadratic_zeros(*sizes.h[:3], xp)
    front, back = real_ends(log_r, at, loop)
    outer = (sizes.h[0] > 0) | ((sizes.h[0] == 0) & (sizes.h[1] < 0))
    left = xp.where(outer, front.device, front.wall)
    eps = epsilon(log_r)
    blur = 4.0 * eps * (loop.turns + 8.0)
    # Where a real pole is on the circle itself.
    sure = ~(_tied(front, blur) | _tied(back, blur))
    turn, crossings = 0.0 * left, []
    for x in zeros:
        valid = (x >= 0) & (x < 1.0)
        x = xp.where(valid, x, 0.5)
        here = crossing(x, at, loop, fractional, xp)
        part = here.theta / (2.0 * np.pi)
        whole = xp.round(part)
        turn = turn + xp.where(valid, xp.where(outer, whole, -whole), 0.0)
        outer = outer != valid
        # The rounding of theta, and that of x where the two sizes cross at a small angle.
        slope = xp.abs(sizes.h[1] + x * (2.0 * sizes.h[2] + 3.0 * x * sizes.h[3]))
        shift = here.rate * sizes.parts(x) / (slope * xp.sqrt(x * (1.0 - x)))
        rest = part - whole
        sure = sure & (~valid | (0.5 - xp.abs(rest) > blur + 4.0 * eps * shift))
        crossings.append((here, rest, valid))
    right = xp.where(outer, back.device, back.wall)
    count = right - left + 2.0 * turn
    return _Count(count, count == loop.turns + 2.0, sure, at, (front, back), crossings)


def inside(log_r: Array, loop: Loop, fractional: bool) -> tuple[Array, Array]:
    """Whether every pole is inside ``|z| = e^log_r``, and whether rounding errors cannot have decided that."""
    found = _counted(log_r, loop, fractional)
    return found.full, found.sure


def circle(log_r: Array, loop: Loop, fractional: bool, low: Array = -np.inf, high: Array = np.inf) -> Circle:
    """Count the poles inside ``|z| = e^log_r``, and tell where Newton's method expects the next one.

    On a crossover T and B are equally large: one Newton step for ``log(T/B) = an odd multiple of j pi`` leads to a
    pole, outwards where there are poles outside, else inwards. On the real axis the same in real numbers.
    """
    found = _counted(log_r, loop, fractional)
    expected = _expected((log_r, low, high), found.full, found.crossings, found.ends, found.at, loop)
    return Circle(found.count, found.full, found.sure, *expected)


def _expected(
    bracket: tuple[Array, Array, Array], full: Array, crossings: list, ends: tuple[_End, _End], at: Sides, loop: Loop
) -> tuple[Array, Array]:
    """The largest pole inside the bracket that one Newton step leads to; NaN where none does."""
    log_r, low, high = bracket
    xp = namespace(log_r, loop.alpha)
    side = xp.where(full, -1.0, 1.0)
    low, high = (xp.where(full, low, log_r), xp.where(full, log_r, high))
    slack = _NEAR * epsilon(log_r) * (1.0 + xp.abs(log_r))
    low, high = low - slack, high + slack
    best, best_im = xp.where(loop.alpha == 0, 0.0, -np.inf), 0.0 * side
    best = xp.where((best > low) & (best < high), best, -np.inf)
    front, back = ends
    # Near z = 1 the logarithm of r - 1 is what goes in a straight line.
    shrink = at.near * xp.exp(-front.level * at.r / (front.slope * at.near))
    slow = (at.near < 0) & (front.slope * at.near > 0)
    candidates = [
        (front.opposite, xp.where(slow, xp.log1p(shrink), log_r - front.level / front.slope), 0.0),
        (back.opposite, log_r - back.level / back.slope, np.pi),
    ]
    for here, rest, valid in crossings:
        norm = here.re * here.re + here.im * here.im
        # Of the odd multiples on both sides one lies outwards; one that is met already counts as either.
        wanted = xp.where(here.im * side > 0, 0.5, -0.5)
        met = 0.5 - xp.abs(rest) < _MET * epsilon(log_r) * (loop.turns + 100.0)
        wanted = xp.where(met, xp.where(rest > 0, 0.5, -0.5), wanted)
        gap = 2.0 * np.pi * (wanted - rest) / norm
        # A circle on which the sizes barely differ leads nowhere.
        moves = met | (xp.abs(gap * here.im) > slack)
        candidates.append((valid & moves, log_r + gap * here.im, here.w + gap * here.re))
    for good, new, im in candidates:
        better = good & (new > best) & (new > low) & (new < high)
        best, best_im = xp.where(better, new, best), xp.where(better, im, best_im)
    return xp.where(best == -np.inf, np.nan, best), xp.clip(best_im, 0.0, np.pi)
