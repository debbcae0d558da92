"""Floating-point filter of the certified method for long delays: the phase where the loop gain is one.

The recursion's bound grows with the degree. Here nothing does: with ``W = s z - beta``, s = alpha + beta,
``M = a2 z + a1 + a0/z`` and d = n + f the loop is

    Q(z) = T + B,     T = z^(1+n) (z - 1)(z - c),     B = M W,     P = Q (whole d) or z Q

and where its two parts are equally large on z = e^(jw), x = sin^2(w/2), is a cubic whatever n is:

    H(x) = |B|^2 - |T|^2 = (g - 4 m1 x + m2 x^2)(alpha^2 + b x) - 4 x (em^2 + 4 c x)
         = h0 + h1 x + h2 x^2 + h3 x^3
    h0 = g alpha^2                                                    h2 = m2 alpha^2 - 4 m1 b - 16 c
    h1 = 4 g ((beta - delta)(beta + delta) + alpha beta) - 4 m1 alpha^2     h3 = m2 b
    g = (a2 + a1 + a0)^2,  m1 = a1 (a2 + a0) + 4 a2 a0,  m2 = 16 a2 a0
    b = 4 beta s,  em = 1 - c = delta (a2 + a1 + a0)

Counting. Cut (0, pi] into arcs on which H has one sign and short gaps between them. In a gap
``Theta = arg T - arg B = (n + 3/2) w + pi/2 + arg(z - c) - arg M - arg W`` stays between (2 m - 1) pi and (2 m + 1) pi
for a whole number m: Q does not vanish there. On an arc arg Q follows the larger part to within pi/2. Summed up,
Q winds by half turns: 3 + n - 2 m on [0, pi] after one gap (T is larger at pi), and ``arg B(pi)/pi - 2 m + 2 m'``
after two. B is larger at w = 0, for alpha > 0. Stable means 3 + n half turns. Where B is larger everywhere, Q winds as
B does, by two half turns at most: unstable. arg M and arg W are principal values: their imaginary parts
(a2 - a0) sin w and s sin w keep one sign, and neither vanishes where B is the larger part.

Edge. At alpha = 0, P = (z - 1) R. With R in place of P, T has no factor z - 1, B = beta M and W = beta > 0 no argument,
2 + n half turns are stable, and ``H = g (beta^2 - delta^2) - 4 (m1 beta^2 + c) x + m2 beta^2 x^2``.

Errors (u = 2^-53, device as in `certified_filter`: a2 and a1 within 60u of themselves, a0 within 33u of itself and u of
a1). The coefficients of H are within 140u of the sum of their absolute terms, and of g |b|/16 x^2 (on the edge
g beta^2/16 x) for the part of a0 that is within u of a1. The blossom of H at (l, l, l), (l, l, r), (l, r, r), (r, r, r)
bounds H on [l, r]; with its own rounding it is within 2^-44 of the same blossom of the absolute terms. A gap is
``x (1 +- 2^-34)`` around any x at which Theta is evaluated; nothing need be known of how x was found. With y = 1 - x:

    dw <= 1.01 2^-34 sqrt(x/y)       the change of w in the gap, n + 1.5 times
    1.6 dw                           w itself, computed within 2^-35 of itself, n + 1.5 times
    dw/|z - c| <= 1.5 2^-34/y        as |z - c|^2 = em^2 + 4 c x >= x/2
    dw (a2 + a0)/|M| <= 182 dw       where |M| >= 2^-7.5 (a2 + a1 + a0) is asked for
    dw |s|/|W| <= 2^-34/y            as |W| >= |s| sin w
    2^-33                            three angles within 2^-36, of vectors within 2^-37 of their sizes

The tolerance is ``4 ((n + 200) dw + 2^-32/y + 2^-25)``. Gaps must end below x = 1 - 2^-16. The arctangent is a series
of 12 terms on |v| <= sqrt 2 - 1, inverse and root are Newton's method. No result exceeds 2^1000, and what is below
2^-1022 is nothing beside the absolute terms, which are above 2^-810: alpha (on the edge beta) is asked to be within
2^+-200, |beta| and delta below 2^200, n below 2^30.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from zwidth._types import Array
from zwidth.stability.certified_filter import OPEN, STABLE, UNSTABLE, HeldDevice

_GAP = 2.0**-34
_BLOSSOM_ERROR = 2.0**-44
_ANGLE_ERROR = 2.0**-25
_NEAREST_PI = 2.0**-16
_SMALLEST_M = 2.0**-15
_SMALLEST_PART = 2.0**-30
_LARGEST, _SMALLEST = 2.0**200, 2.0**-200
_LONGEST = 2.0**30
_NEWTON_STEPS = 5
_INVERSE_GUESS, _ROOT_GUESS = 0x7FDE623822FC16E6, 0x5FE6EB50C7B537A9
_ATAN_TERMS = [(-1.0) ** k / (2 * k + 1) for k in range(12)]


class _Loop(NamedTuple):
    """One side of the loop, or on the edge alpha = 0 what is left of it without the pole at z = 1."""

    edge: bool
    alpha: Array
    beta: Array
    delta: Array
    s: Array
    whole: Array
    plant: HeldDevice
    a0: Array
    gain: Array


class _Cubic(NamedTuple):
    """Coefficients, lowest power first, and the sums of the absolute values of their terms."""

    h: tuple[Array, Array, Array, Array]
    sizes: tuple[Array, Array, Array, Array]


class _Gap(NamedTuple):
    left: Array
    right: Array
    turns: Array  # m
    usable: Array


def crossover(
    alpha: Array, beta: Array, delta: Array, whole: Array, plant: HeldDevice, pair: bool, edge: bool
) -> Array:
    """UNSTABLE, STABLE or OPEN, elementwise, for alpha > 0, or with ``edge`` for P/(z - 1) at alpha = 0, beta > delta.

    Without ``pair`` it is OPEN wherever H has two zeros.
    """
    a0 = jnp.zeros_like(plant.a2) if plant.a0 is None else plant.a0
    gain = plant.a2 + plant.a1 + a0
    loop = _Loop(edge, alpha, beta, delta, alpha + beta, whole, plant, a0, gain)
    cubic = _edge_cubic(loop) if edge else _gain_cubic(loop)
    near, far = _zeros(cubic.h, 0 if plant.a0 is None else _NEWTON_STEPS)
    first = _gap(near, loop)
    starts = _keeps_sign(cubic, 0.0, first.left, 1.0) & first.usable
    decided = starts & _keeps_sign(cubic, first.right, 1.0, -1.0)
    stable = decided & (first.turns == 0)
    if pair:
        last = _gap(far, loop)
        between = _keeps_sign(cubic, first.right, last.left, -1.0) & (first.right < last.left)
        end, certain = _half_turns_at_pi(loop)
        two = starts & last.usable & between & _keeps_sign(cubic, last.right, 1.0, 1.0) & certain
        stable = stable | (two & (end - 2.0 * (first.turns - last.turns) == whole + (2.0 if edge else 3.0)))
        decided = decided | two | _keeps_sign(cubic, 0.0, 1.0, 1.0)
    label = jnp.where(stable, jnp.uint8(STABLE), jnp.uint8(UNSTABLE))
    return jnp.where(decided & _in_range(loop), label, jnp.uint8(OPEN))


def _in_range(loop: _Loop) -> Array:
    larger = loop.beta if loop.edge else loop.alpha
    tame = (larger > _SMALLEST) & (larger < _LARGEST) & (jnp.abs(loop.beta) < _LARGEST) & (loop.delta < _LARGEST)
    return tame & (loop.whole < _LONGEST)


def _gain_cubic(loop: _Loop) -> _Cubic:
    """H and the sizes of its terms."""
    _, alpha, beta, delta, s, _, plant, _, gain = loop
    g, a, b = gain * gain, alpha * alpha, 4.0 * (beta * s)
    # b/4 - delta^2, factored: it cancels where |beta| is close to delta.
    below, above, mixed = beta - delta, beta + delta, alpha * beta
    q, size_q = 4.0 * (below * above + mixed), 4.0 * (jnp.abs(below * above) + jnp.abs(mixed))
    m1, m2 = _squared_numerator(loop)
    size_b, c = jnp.abs(b), 16.0 * plant.c
    h = (g * a, g * q - 4.0 * m1 * a, m2 * a - 4.0 * m1 * b - c, m2 * b)
    sizes = (h[0], g * size_q + 4.0 * m1 * a, m2 * a + (4.0 * m1 + 0.0625 * g) * size_b + c, m2 * size_b)
    return _Cubic(h, sizes)


def _edge_cubic(loop: _Loop) -> _Cubic:
    """H without the pole at z = 1: a quadratic."""
    g, b = loop.gain * loop.gain, loop.beta * loop.beta
    m1, m2 = _squared_numerator(loop)
    h0, h1 = g * ((loop.beta - loop.delta) * (loop.beta + loop.delta)), 4.0 * (m1 * b + loop.plant.c)
    zero = jnp.zeros_like(b)
    return _Cubic((h0, -h1, m2 * b, zero), (jnp.abs(h0), h1 + 0.0625 * g * b, m2 * b, zero))


def _squared_numerator(loop: _Loop) -> tuple[Array, Array]:
    """m1 and m2 of ``|M|^2 = g - 4 m1 x + m2 x^2``."""
    _, a2, a1, _ = loop.plant
    product = 4.0 * (a2 * loop.a0)
    return a1 * (a2 + loop.a0) + product, 4.0 * product


def _zeros(h: tuple[Array, ...], steps: int) -> tuple[Array, Array]:
    """The two candidates for a zero of H in (0, 1), in order if both are; no error of them can do harm."""
    radicand = h[1] * h[1] - 4.0 * h[0] * h[2]
    root = _root(jnp.where(radicand > 0, radicand, 0.0))
    falling = h[1] < 0
    # Of one sign with h[1], so that nothing cancels.
    q = -0.5 * jnp.where(falling, h[1] - root, h[1] + root)
    near, far = h[0] * _inverse(q), q * _inverse(h[2])
    return _polished(jnp.where(falling, near, far), h, steps), _polished(far, h, steps)


def _polished(x: Array, h: tuple[Array, ...], steps: int) -> Array:
    """Newton's method for the whole cubic, from a zero of its quadratic part."""
    for _ in range(steps):
        value = ((h[3] * x + h[2]) * x + h[1]) * x + h[0]
        slope = (3.0 * h[3] * x + 2.0 * h[2]) * x + h[1]
        x = x - value * _inverse(slope)
    return x


def _blossom(h: tuple[Array, ...], x: Array | float, y: Array | float, z: Array | float) -> Array:
    """The polar form of a cubic: symmetric, affine in each argument, ``H(x)`` on the diagonal."""
    return h[0] + h[1] * ((x + y + z) / 3.0) + h[2] * ((x * y + (x + y) * z) / 3.0) + h[3] * (x * y * z)


def _keeps_sign(cubic: _Cubic, left: Array | float, right: Array | float, sign: float) -> Array:
    """Whether ``sign * H`` is provably positive on [left, right]."""
    proved = None
    for corner in ((left, left, left), (left, left, right), (left, right, right), (right, right, right)):
        positive = sign * _blossom(cubic.h, *corner) > _BLOSSOM_ERROR * _blossom(cubic.sizes, *corner)
        proved = positive if proved is None else proved & positive
    return proved


def _gap(x: Array, loop: _Loop) -> _Gap:
    """The gap around x, and the whole number of turns by which T leads B in it."""
    a2 = loop.plant.a2
    left, right = x * (1.0 - _GAP), x * (1.0 + _GAP)
    inside = (left > 0) & (right < 1.0 - _NEAREST_PI)
    x = jnp.where(inside, x, 0.5)
    y = 1.0 - x
    root_x, root_y = _root(x), _root(y)
    sine = 2.0 * root_x * root_y
    re_m = loop.gain - 2.0 * (a2 + loop.a0) * x
    im_m = (a2 - loop.a0) * sine
    w = 2.0 * _angle(root_x, root_y)
    theta = (loop.whole + 1.0) * w + _angle(sine, loop.delta * loop.gain - 2.0 * x) - _angle(im_m, re_m)
    if not loop.edge:
        theta = theta + 0.5 * (w + np.pi) - _angle(loop.s * sine, loop.alpha - 2.0 * loop.s * x)
    turns = jnp.round(theta / (2.0 * np.pi))
    dw = 1.01 * _GAP * root_x * _inverse(root_y)
    # More than what is derived above.
    tolerance = 4.0 * ((loop.whole + 200.0) * dw + 4.0 * _GAP * _inverse(y) + _ANGLE_ERROR)
    clear = jnp.abs(theta - turns * (2.0 * np.pi)) + tolerance < np.pi
    g = loop.gain * loop.gain
    large = re_m * re_m + im_m * im_m > _SMALLEST_M * g
    # Next to the negative real axis the side on which M lies must be certain.
    one_sided = (re_m > _SMALLEST_PART * loop.gain) | (im_m * im_m > _SMALLEST_PART**2 * g)
    return _Gap(left, right, turns, inside & clear & large & one_sided)


def _half_turns_at_pi(loop: _Loop) -> tuple[Array, Array]:
    """``arg B(pi)/pi``, and whether the signs that it depends on are certain."""
    _, a2, a1, _ = loop.plant
    m, side = -(a2 - a1 + loop.a0), a2 - loop.a0
    turns = jnp.where(m < 0, jnp.where(side < 0, -1.0, 1.0), 0.0)
    least = _SMALLEST_PART * loop.gain
    certain = (jnp.abs(m) > least) & ((m > 0) | (jnp.abs(side) > least))
    if loop.edge:
        return turns, certain
    w = -(loop.alpha + 2.0 * loop.beta)
    turns = turns + jnp.where(w < 0, jnp.where(loop.s < 0, -1.0, 1.0), 0.0)
    return turns, certain & (jnp.abs(w) > _SMALLEST_PART * (loop.alpha + jnp.abs(loop.beta)))


def _angle(y: Array, x: Array) -> Array:
    """arg(x + j y) within 2^-45, relatively too where it is small."""
    size_x, size_y = jnp.abs(x), jnp.abs(y)
    steep = size_y > size_x
    low, high = jnp.where(steep, size_x, size_y), jnp.where(steep, size_y, size_x)
    # Above pi/8 the angle is measured from pi/4, which takes no second division.
    far = low > 0.4142 * high
    v = jnp.where(far, low - high, low) * _inverse(jnp.where(far, low + high, high))
    square = v * v
    total = jnp.full_like(v, _ATAN_TERMS[-1])
    for term in reversed(_ATAN_TERMS[:-1]):
        total = total * square + term
    angle = v * total + jnp.where(far, 0.25 * np.pi, 0.0)
    angle = jnp.where(steep, 0.5 * np.pi - angle, angle)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def _inverse(x: Array) -> Array:
    """``1/x`` within 2^-47: a division would tear XLA's one fused kernel apart."""
    bits = lax.bitcast_convert_type(x, jnp.int64)
    # Reflecting the exponent and the mantissa is within 1/8; each step squares the error.
    y = lax.bitcast_convert_type(_INVERSE_GUESS - bits, jnp.float64)
    for _ in range(4):
        y = y * (2.0 - x * y)
    return y


def _root(x: Array) -> Array:
    """``sqrt(x)`` within 2^-50, 0 at 0."""
    bits = lax.bitcast_convert_type(x, jnp.int64)
    # Halving the exponent is within 1/28 for the inverse root; a step leaves 1.6 times the square.
    y = lax.bitcast_convert_type(_ROOT_GUESS - (bits >> 1), jnp.float64)
    half = 0.5 * x
    for _ in range(4):
        y = y * (1.5 - half * y * y)
    return x * y
