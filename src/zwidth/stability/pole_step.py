"""Newton's steps on one pole by arithmetic alone, and a proof that a pole is near: the inner loop of many points.

P = z^p A + D with p = 1 + n, A = (z - 1)(z - c) and D = (a2 z + h)(s z - beta); for delays that are not whole periods
both take one factor more, z and z + q. On ``z = e^(re + j im)`` everything is formed from z - 1, so that poles next to 1
keep their digits, and the larger of z^p and 1 is divided out, so that nothing grows with n.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
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


def pole_step(re: Array, im: Array, loop: Loop, fractional: bool) -> Step:
    """One step from ``e^(re + j im)``, |im| <= pi."""
    xp = namespace(re, loop.alpha)
    power = loop.turns + 1.0 if fractional else loop.turns
    size = xp.expm1(re)
    r = 1.0 + size
    sine, cosine = _half_turn(0.5 * im, xp)
    one, z_im = size - 2.0 * r * sine * sine, 2.0 * r * sine * cosine
    z_re = 1.0 + one
    pole = one + loop.em
    # z^p and 1, the larger of the two divided out.
    phase = power * im
    phase = phase - 2.0 * np.pi * xp.round(phase / (2.0 * np.pi))
    turned, level = _half_turn(0.5 * phase, xp)
    growth = power * re
    up, down = xp.exp(xp.minimum(growth, 0.0)), xp.exp(-xp.maximum(growth, 0.0))
    lag_re, lag_im = up * (1.0 - 2.0 * turned * turned), 2.0 * up * turned * level
    a_re, a_im = one * pole - z_im * z_im, z_im * (one + pole)
    t_re, t_im = lag_re * a_re - lag_im * a_im, lag_re * a_im + lag_im * a_re
    # z A'
    both, both_im = one + pole, 2.0 * z_im
    g_re, g_im = power * a_re + z_re * both - z_im * both_im, power * a_im + z_re * both_im + z_im * both
    slope_re, slope_im = lag_re * g_re - lag_im * g_im, lag_re * g_im + lag_im * g_re
    body, body_im = loop.h + loop.a2 * z_re, loop.a2 * z_im
    wall, wall_im = loop.alpha + loop.s * one, loop.s * z_im
    d_re, d_im = body * wall - body_im * wall_im, body * wall_im + body_im * wall
    e_re, e_im = loop.a2 * wall + loop.s * body, loop.a2 * wall_im + loop.s * body_im
    gap = xp.abs(one) + xp.abs(z_im)
    parts = (loop.h + loop.a2 * r) * (xp.abs(loop.alpha) + xp.abs(loop.s) * gap)
    if fractional:
        late = z_re + loop.q
        e_re, e_im = e_re * late - e_im * z_im + d_re, e_re * z_im + e_im * late + d_im
        d_re, d_im = d_re * late - d_im * z_im, d_re * z_im + d_im * late
        parts = parts * (r + loop.q)
    slope_re = slope_re + down * (z_re * e_re - z_im * e_im)
    slope_im = slope_im + down * (z_re * e_im + z_im * e_re)
    p_re, p_im = t_re + down * d_re, t_im + down * d_im
    norm = slope_re * slope_re + slope_im * slope_im
    # A polynomial of degree N has a zero within N |P/P'| of any point.
    poles = power + 2.0
    turning = power * (xp.abs(re) + xp.abs(im))
    rounding = up * gap * (gap + loop.em) * (_ROUNDING + turning) + _ROUNDING * down * parts
    within = poles * (xp.sqrt(p_re * p_re + p_im * p_im) + epsilon(re) * rounding) / xp.sqrt(norm)
    return Step(-(p_re * slope_re + p_im * slope_im) / norm, -(p_im * slope_re - p_re * slope_im) / norm, within)
