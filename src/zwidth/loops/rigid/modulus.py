"""The least distance of the rigid loop's Nyquist curve from -1, between bounds that no minimum can lie beyond.

``|L|`` falls strictly with the frequency (docs/theory/one-crossover.md, Theorem 1), and ``|1 + L| >= ||L| - 1|``. So
once a distance r has been seen, no lower one lies where ``|L| > 1 + r`` or ``|L| < 1 - r``. Within a turn of the phase
to either side of the gain crossover L is real and negative, at a distance of ``||L| - 1|``: what is beyond is farther.
The turns that remain are two, however long the delay.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.arrays.held_mass import DeviceTerms
from zwidth.arrays.roots import follow_root, newton
from zwidth.loops.rigid.crossover import find_gain_crossover
from zwidth.words.types import Array
from zwidth.words.xp import along, apply_each, frozen, namespace, store_once


def size_and_phase(w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array]:
    """``|L|`` and its phase above -pi, at w in (0, pi].

    Notation as in `loops.rigid.crossover`: with ``u = 1 - cos w``, ``s = sin w``, ``W = alpha + beta u + j beta s``, M
    at e^(j w) and ``Z = s + j (em - u)``,

        |L|^2 = |W|^2 |M|^2 / (2 u (em^2 + 2 c u))
        phase = arg W + arg M + arg Z - (n + 1/2) w = pi + arg L

    each argument principal and continuous in w, so that the phase needs no unwrapping.
    """
    xp = namespace(w, alpha)
    _, _, u, s, (wall_re, wall_im), (m_re, m_im) = _factors(w, alpha, beta, here)
    top = (wall_re * wall_re + wall_im * wall_im) * (m_re * m_re + m_im * m_im)
    size = xp.sqrt(top / (2.0 * u * (here.em * here.em + 2.0 * here.c * u)))
    phase = xp.arctan2(wall_im, wall_re) + xp.arctan2(m_im, m_re) + xp.arctan2(here.em - u, s)
    return size, phase - (here.whole + 0.5) * w


def _factors(w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Any, ...]:
    """sin and cos of w/2, u, s, and the parts of W and of M."""
    xp = namespace(w, alpha)
    sine, cosine = xp.sin(0.5 * w), xp.cos(0.5 * w)
    u, s = 2.0 * sine * sine, 2.0 * sine * cosine
    m_re = 2.0 * (here.a2 + here.a0) * cosine * cosine - here.gap
    return sine, cosine, u, s, (alpha + beta * u, beta * s), (m_re, (here.a2 - here.a0) * s)


def gain_frequency(alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array, Array]:
    """The gain crossover, the phase there, and whether there is one, without which both mean nothing."""
    xp = namespace(alpha, here.delta)
    w, exists = find_gain_crossover(alpha, beta, here)
    w, exists = store_once((xp.where(exists, w, 1.0), exists), alpha)
    return w, size_and_phase(w, alpha, beta, here)[1], exists


# For the samples of a point. Compiled they would take many seconds and then win nothing over NumPy.
SAMPLES_WEIGHT = 8
# Samples over the turns, and over the decades before and behind the crossover; dips that are followed, and how far.
_TURN, _BEFORE, _BEHIND, _DIPS, _STEPS = 48, 32, 48, 5, 8


def squared_distance(w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> Array:
    """``|1 + L|^2`` at w in (0, pi], by ``L = -W M Z e^(-j (n + 1/2) w)/(2 h |Z|^2)``."""
    # With h = sin(w/2), the functions of the sampled delay and of w/2 are all that is not arithmetic.
    xp = namespace(w, alpha)
    lag = (2.0 * here.whole + 1.0) * (0.5 * w)
    sine, _, u, s, (wall_re, wall_im), (m_re, m_im) = _factors(w, alpha, beta, here)
    re, im = wall_re * m_re - wall_im * m_im, wall_re * m_im + wall_im * m_re
    rise = here.em - u
    re, im = re * s - im * rise, re * rise + im * s
    turn_re, turn_im = xp.cos(lag), xp.sin(lag)
    size = 2.0 * sine * (here.em * here.em + 2.0 * here.c * u)
    ahead, across = (re * turn_re + im * turn_im) / size, (im * turn_re - re * turn_im) / size
    return (1.0 - ahead) ** 2 + across * across


def _slope_and_bend(w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array]:
    """Half the first and half the second derivative of `squared_distance`, by those of log L."""
    xp = namespace(w, alpha)
    half_lag, c = here.whole + 0.5, xp.cos(w)
    sine, cosine, u, s, wall, m = _factors(w, alpha, beta, here)
    z, lag = c + 1j * s, xp.cos(half_lag * w) - 1j * xp.sin(half_lag * w)
    wall, m, wall_slope = wall[0] + 1j * wall[1], m[0] + 1j * m[1], beta * (s + 1j * c)
    total, moved = here.a2 + here.a0, here.a2 - here.a0
    # The conjugate of Z, whose derivative is z.
    pole = s + 1j * (u - here.em)
    by_wall, by_m, by_pole = wall_slope / wall, (1j * moved * c - total * s) / m, z / pole
    rate = by_wall + by_m - by_pole - 1j * half_lag - 0.5 * cosine / sine
    bend = beta * xp.conj(z) / wall - by_wall**2 - (total * c + 1j * moved * s) / m - by_m**2
    bend = bend - 1j * by_pole + by_pole**2 + 0.25 / (sine * sine)
    loop = -wall * m * lag / (2.0 * sine * pole)
    slope, back = rate * loop, xp.conj(1.0 + loop)
    return xp.real(back * slope), xp.abs(slope) ** 2 + xp.real(back * (bend + rate * rate) * loop)


def modulus(alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array]:
    """The least ``|1 + L|`` over (0, pi] and its w, for alpha > 0, elementwise."""
    xp = namespace(alpha, here.c)
    wall = alpha, beta, here

    def is_dip(w: Array, bend: Array, _: Array) -> Array:
        return (w < np.pi) & (bend > 0)

    lowest = _lowest(*frozen(wall, xp), xp)
    w = follow_root(
        lambda *at: _slope_and_bend(*at)[0], lowest, is_dip, *wall, slope=lambda *at: _slope_and_bend(*at)[1]
    )
    return xp.sqrt(xp.maximum(squared_distance(w, *wall), 0.0)), w


def _lowest(alpha: Array, beta: Array, here: DeviceTerms, xp: Any) -> Array:
    """w of the minimum."""

    def at(level: Array) -> Array:
        """Where |L| has a value; pi if it is larger everywhere."""
        w, exists = find_gain_crossover(alpha / level, beta / level, here)
        w = xp.where(exists, w, np.pi)
        return store_once(w, w)

    alpha, beta = xp.asarray(alpha), xp.asarray(beta)
    here = DeviceTerms(*(xp.asarray(field) for field in here))
    wall = alpha[..., None], beta[..., None], DeviceTerms(*(field[..., None] for field in here))
    center = at(xp.ones_like(alpha))
    # With a share more: where the two bounds meet rounding has a say.
    reached = 1.0001 * xp.sqrt(squared_distance(center, alpha, beta, here))
    start, end = apply_each(at, [1.0 + reached, xp.where(reached < 1.0, 1.0 - reached, 1.0)], xp)
    end = xp.where(reached < 1.0, end, np.pi)
    # With room: the wall's own phase may rise by a quarter turn meanwhile.
    turn = 3.0 * np.pi / (here.whole + 0.5)
    low = xp.minimum(xp.maximum(start, center - turn), center)
    high = xp.maximum(xp.minimum(end, center + turn), center)

    def spread(count: int, least: float = 0.5) -> Array:
        return along((np.arange(count) + least) / count, center)

    grid = [
        low[..., None] + (high - low)[..., None] * spread(_TURN, 1.0),
        low[..., None] * (center / low)[..., None] ** spread(_BEFORE),
        center[..., None] * (high / center)[..., None] ** spread(_BEHIND),
    ]
    grid = xp.sort(xp.concatenate(grid, axis=-1), axis=-1)
    values = squared_distance(grid, *wall)
    edge = xp.full_like(values[..., :1], np.inf)
    before, after = xp.concatenate([edge, values[..., :-1]], -1), xp.concatenate([values[..., 1:], edge], -1)
    # A place that is there twice is one dip, whose zero may lie behind the second one.
    dips = xp.where((values < before) & (values <= after), values, np.inf)
    best = xp.argpartition(dips, _DIPS - 1, axis=-1)[..., :_DIPS]

    def beside(steps: int) -> Array:
        return xp.take_along_axis(grid, xp.clip(best + steps, 0, grid.shape[-1] - 1), axis=-1)

    middle = beside(0)
    found = newton(lambda w: _slope_and_bend(w, *wall), beside(-2), beside(2), middle, _STEPS)[0]
    # At an end of the range the lowest point is the end itself.
    places = xp.concatenate([found, middle], axis=-1)
    lowest = xp.argmin(squared_distance(places, *wall), axis=-1)[..., None]
    return xp.take_along_axis(places, lowest, axis=-1)[..., 0]
