"""Newton's steps on one pole by arithmetic alone, and a proof that a pole is near: the inner loop of many points.

P = z^p A + D with p = 1 + n, A = (z - 1)(z - c) and D = (a2 z + h)(s z - beta); for delays that are not whole periods
both take one factor more, z and z + q. On ``z = e^(re + j im)`` everything is formed from z - 1, so that poles next to
1 keep their digits, and the larger of z^p and 1 is divided out, so that nothing grows with n.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.stability.arcs import angle
from zwidth.stability.circle import Loop
from zwidth.xp import epsilon, horner, namespace

# sin(x)/x and cos(x) as series in x^2: on |x| <= pi/2 what is left out is below 1e-18.
_SINE = [1.0]
_COSINE = [1.0]
for _k in range(1, 12):
    _SINE.append(-_SINE[-1] / (2 * _k * (2 * _k + 1)))
    _COSINE.append(-_COSINE[-1] / ((2 * _k - 1) * 2 * _k))
# Rounding errors of P in units of the sum of its parts' moduli: of its factors, and of the angle p im.
_ROUNDING = 16.0


class Step(NamedTuple):
    """Newton's step for log z, and how far from here a pole is at most, both relative to z."""

    re: Array
    im: Array
    within: Array


def _half_turn(x: Array, xp: Any) -> tuple[Array, Array]:
    """Sine and cosine for |x| <= pi/2; several times faster than the compiler's, which serve every argument."""
    if xp is np:
        return np.sin(x), np.cos(x)
    square = x * x
    return x * horner(square, _SINE), horner(square, _COSINE)


class _Parts(NamedTuple):
    """P = T + D at one point, both without the larger of z^p and 1, and their derivatives by log z."""

    t: tuple[Array, Array]
    t_slope: tuple[Array, Array]
    d: tuple[Array, Array]
    d_slope: tuple[Array, Array]
    rounding: Array  # what rounding errors may add up to in P


def _times(x: tuple[Array, Array], y: tuple[Array, Array]) -> tuple[Array, Array]:
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _over(x: tuple[Array, Array], y: tuple[Array, Array]) -> tuple[Array, Array]:
    norm = y[0] * y[0] + y[1] * y[1]
    return (x[0] * y[0] + x[1] * y[1]) / norm, (x[1] * y[0] - x[0] * y[1]) / norm


def _parts(re: Array, im: Array, power: Array, loop: Loop, fractional: bool) -> _Parts:
    xp = namespace(re, loop.alpha)
    size = xp.expm1(re)
    r = 1.0 + size
    sine, cosine = _half_turn(0.5 * im, xp)
    one, z_im = size - 2.0 * r * sine * sine, 2.0 * r * sine * cosine
    z = (1.0 + one, z_im)
    pole = one + loop.em
    phase = power * im
    phase = phase - 2.0 * np.pi * xp.round(phase / (2.0 * np.pi))
    turned, level = _half_turn(0.5 * phase, xp)
    growth = power * re
    up, down = xp.exp(xp.minimum(growth, 0.0)), xp.exp(-xp.maximum(growth, 0.0))
    lag = (up * (1.0 - 2.0 * turned * turned), 2.0 * up * turned * level)
    a = (one * pole - z_im * z_im, z_im * (one + pole))
    # z A'
    slope = _times(z, (one + pole, 2.0 * z_im))
    t, t_slope = _times(lag, a), _times(lag, (power * a[0] + slope[0], power * a[1] + slope[1]))
    body = (down * (loop.h + loop.a2 * z[0]), down * loop.a2 * z_im)
    wall = (loop.alpha + loop.s * one, loop.s * z_im)
    d, lead = _times(body, wall), down * loop.a2
    e = (lead * wall[0] + loop.s * body[0], lead * wall[1] + loop.s * body[1])
    gap = xp.abs(one) + xp.abs(z_im)
    sizes = down * (loop.h + loop.a2 * r) * (xp.abs(loop.alpha) + xp.abs(loop.s) * gap)
    if fractional:
        late = (z[0] + loop.q, z_im)
        e = _times(e, late)
        e, d = (e[0] + d[0], e[1] + d[1]), _times(d, late)
        sizes = sizes * (r + loop.q)
    turning = power * (xp.abs(re) + xp.abs(im))
    rounding = up * gap * (gap + loop.em) * (_ROUNDING + turning) + _ROUNDING * sizes
    return _Parts(t, t_slope, d, _times(z, e), epsilon(re) * rounding)


def pole_step(re: Array, im: Array, loop: Loop, fractional: bool) -> Step:
    """One step from ``e^(re + j im)``, |im| <= pi."""
    xp = namespace(re, loop.alpha)
    power = loop.turns + 1.0 if fractional else loop.turns
    at = _parts(re, im, power, loop, fractional)
    p = (at.t[0] + at.d[0], at.t[1] + at.d[1])
    slope = (at.t_slope[0] + at.d_slope[0], at.t_slope[1] + at.d_slope[1])
    norm = slope[0] * slope[0] + slope[1] * slope[1]
    # A polynomial of degree N has a zero within N |P/P'| of any point.
    within = (power + 2.0) * (xp.sqrt(p[0] * p[0] + p[1] * p[1]) + at.rounding) / xp.sqrt(norm)
    by_re, by_im = _over(p, slope)
    return Step(-by_re, -by_im, within)


def ratio_step(re: Array, im: Array, loop: Loop, fractional: bool) -> tuple[Array, Array]:
    """Newton's step for ``log(-T/D) = 0``: with long delays all but the powers of z is nearly constant."""
    xp = namespace(re, loop.alpha)
    at = _parts(re, im, loop.turns + 1.0 if fractional else loop.turns, loop, fractional)
    t_re, t_im = _over(at.t, at.d)
    value = (0.5 * xp.log(t_re * t_re + t_im * t_im), angle(-t_re, -t_im))
    first, second = _over(at.t_slope, at.t), _over(at.d_slope, at.d)
    by_re, by_im = _over(value, (first[0] - second[0], first[1] - second[1]))
    return -by_re, -by_im
