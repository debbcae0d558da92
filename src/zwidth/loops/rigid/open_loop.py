"""Size and phase of the rigid loop ``L = B/T`` at a frequency, for the margins.

Notation as in `loops.rigid.crossover`: with ``u = 1 - cos w``, ``s = sin w``,

    L = -(W M)/(Z e^...)      W = alpha + beta u + j beta s,  M at e^(j w),  Z = s + j (em - u)
    |L|^2 = |W|^2 |M|^2 / (2 u (em^2 + 2 c u))
    phase = arg W + arg M + arg Z - (n + 1/2) w = pi + arg L

each argument principal and continuous in w, so that the phase needs no unwrapping.
"""

from __future__ import annotations

import numpy as np

from zwidth.arrays.xp import namespace
from zwidth.loops.rigid.crossover import Crossover
from zwidth.loops.rigid.delay_classes import DeviceTerms
from zwidth.words.types import Array


def find_angle(crossover: Crossover) -> Array:
    """w of u and 2 - u, from the smaller of them."""
    xp = namespace(crossover.u)
    near = crossover.u <= 1.0
    small = xp.maximum(xp.where(near, crossover.u, crossover.y), 0.0)
    angle = 2.0 * xp.arcsin(xp.sqrt(0.5 * xp.where(small > 0, small, 1.0)))
    angle = xp.where(small > 0, angle, 0.0)
    return xp.where(near, angle, np.pi - angle)


def size_and_phase(w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array]:
    """``|L|`` and its phase above -pi, at w in (0, pi]."""
    xp = namespace(w, alpha)
    half = xp.sin(0.5 * w)
    u, s = 2.0 * half * half, xp.sin(w)
    wall_re, wall_im = alpha + beta * u, beta * s
    cos_half = xp.cos(0.5 * w)
    m_re, m_im = 2.0 * (here.a2 + here.a0) * cos_half * cos_half - here.gap, (here.a2 - here.a0) * s
    top = (wall_re * wall_re + wall_im * wall_im) * (m_re * m_re + m_im * m_im)
    size = xp.sqrt(top / (2.0 * u * (here.em * here.em + 2.0 * here.c * u)))
    phase = xp.arctan2(wall_im, wall_re) + xp.arctan2(m_im, m_re) + xp.arctan2(here.em - u, s)
    return size, phase - (here.whole + 0.5) * w
