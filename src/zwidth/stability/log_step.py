"""Newton's steps for log z on one pole, from the logarithm of T/B: accurate at any size of the two, and differentiable.

`zwidth.stability.pole_step` takes the same steps several times faster, by plain arithmetic.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.stability.circle import Loop, crossing, sides
from zwidth.xp import namespace


class Near(NamedTuple):
    """The loop at ``z = e^(re + j im)``, by logarithms; F' is the derivative of F = log(T/B) by log z."""

    level: Array  # log |T/B|
    past: Array  # arg T - arg B less the nearest odd multiple of pi
    re: Array  # F'
    im: Array
    wall_re: Array  # the derivative of log B
    wall_im: Array


def near(re: Array, im: Array, loop: Loop, fractional: bool) -> Near:
    """Evaluate at a point of the upper half plane, 0 <= im <= pi."""
    xp = namespace(re, loop.alpha)
    at = sides(re, loop)
    sine = xp.sin(0.5 * im)
    here = crossing(sine * sine, at, loop, fractional, xp)
    level = loop.turns * re + 0.5 * xp.log(here.quotient)
    part = here.theta / (2.0 * np.pi)
    past = 2.0 * np.pi * (part - xp.floor(part) - 0.5)
    return Near(level, past, here.re, here.im, here.wall_re, here.wall_im)


def ratio_step(at: Near) -> tuple[Array, Array]:
    """Newton's step on log(T/B), for poles of long delays: all but their powers of z is nearly constant."""
    norm = at.re * at.re + at.im * at.im
    return -(at.level * at.re + at.past * at.im) / norm, -(at.past * at.re - at.level * at.im) / norm


def newton_step(at: Near) -> tuple[Array, Array]:
    """Newton's step on P itself, for poles next to a zero of T or B.

    ``P/P' = (1 + y)/(y F' + (1 + y) B'/B)`` with y = T/B.
    """
    xp = namespace(at.level)
    size = xp.exp(at.level)
    y_re, y_im = -size * xp.cos(at.past), -size * xp.sin(at.past)
    sum_re = 1.0 + y_re
    # 1 + y cancels near a pole; that loses nothing that y had.
    slope_re = y_re * at.re - y_im * at.im + sum_re * at.wall_re - y_im * at.wall_im
    slope_im = y_re * at.im + y_im * at.re + sum_re * at.wall_im + y_im * at.wall_re
    norm = slope_re * slope_re + slope_im * slope_im
    return -(sum_re * slope_re + y_im * slope_im) / norm, -(y_im * slope_re - sum_re * slope_im) / norm
