"""The least distance of the rigid loop's Nyquist curve from -1, between bounds that no minimum can lie beyond.

``|L|`` falls strictly with the frequency (docs/theory/one-crossover.md, Theorem 1), and ``|1 + L| >= ||L| - 1|``. So
once a distance r has been seen, no lower one lies where ``|L| > 1 + r`` or ``|L| < 1 - r``. Within a turn of the phase
to either side of the gain crossover L is real and negative, at a distance of ``||L| - 1|``: what is beyond is farther.
The turns that remain are two, however long the delay.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.arrays.roots import follow_root
from zwidth.arrays.xp import along, apply_each, find_turn, frozen, namespace, repeat, store_once
from zwidth.loops.rigid.crossover import Crossover, gain_crossover
from zwidth.loops.rigid.device import DeviceTerms
from zwidth.words.types import Array


def find_angle(crossover: Crossover) -> Array:
    """w of u and 2 - u."""
    return find_turn(0.5 * crossover.u, 0.5 * crossover.y, namespace(crossover.u))


def size_and_phase(w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array]:
    """``|L|`` and its phase above -pi, at w in (0, pi].

    Notation as in `loops.rigid.crossover`: with ``u = 1 - cos w``, ``s = sin w``, ``W = alpha + beta u + j beta s``, M
    at e^(j w) and ``Z = s + j (em - u)``,

        |L|^2 = |W|^2 |M|^2 / (2 u (em^2 + 2 c u))
        phase = arg W + arg M + arg Z - (n + 1/2) w = pi + arg L

    each argument principal and continuous in w, so that the phase needs no unwrapping.
    """
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


def gain_frequency(alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array, Array]:
    """The gain crossover, the phase there, and whether there is one, without which both mean nothing."""
    xp = namespace(alpha, here.delta)
    found = gain_crossover(alpha, beta, here)
    w, exists = store_once((xp.where(found.exists, find_angle(found), 1.0), found.exists), alpha)
    return w, size_and_phase(w, alpha, beta, here)[1], exists


# For the samples of a point. Compiled they would take many seconds and then win nothing over NumPy.
SAMPLES_WEIGHT = 8
# Samples over the turns and over the decades below the crossover; how many dips are refined, by how many zooms.
_TURN, _DECADES, _DIPS, _ZOOMS, _TRIALS = 100, 50, 5, 5, 13


def squared_distance(w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> Array:
    """``|1 + L|^2`` at w in (0, pi]."""
    size, phase = size_and_phase(w, alpha, beta, here)
    half = namespace(phase).sin(0.5 * phase)
    # L = -|L| e^(j phase)
    return (1.0 - size) ** 2 + 4.0 * size * half * half


def modulus(alpha: Array, beta: Array, here: DeviceTerms) -> tuple[Array, Array]:
    """The least ``|1 + L|`` over (0, pi] and its w, for alpha > 0, elementwise."""
    xp = namespace(alpha, here.c)
    wall = alpha, beta, here
    w = _lowest(*frozen(wall, xp), xp)
    if xp is not np:
        import jax

        # The vertex of a parabola knows a flat minimum to fewer digits than its derivatives need.
        w = store_once(w, alpha)
        first, second = jax.jvp(lambda w: _slope(w, *frozen(wall, xp)), (w,), (xp.ones_like(w),))
        w = store_once(w - xp.where(_is_dip(w, second), first / second, 0.0), w)
        w = follow_root(_slope, w, _is_dip, *wall)
    return xp.sqrt(xp.maximum(squared_distance(w, *wall), 0.0)), w


def _is_dip(w: Array, bend: Array, _: Any = None) -> Array:
    return (w < np.pi) & (bend > 0)


def _slope(w: Array, *wall: Any) -> Array:
    """The derivative of the squared distance, in JAX."""
    import jax

    return jax.jvp(lambda w: squared_distance(w, *wall), (w,), (jax.numpy.ones_like(w),))[1]


def _lowest(alpha: Array, beta: Array, here: DeviceTerms, xp: Any) -> Array:
    """w of the minimum."""

    def at(level: Array) -> Array:
        """Where |L| has a value; pi if it is larger everywhere."""
        found = gain_crossover(alpha / level, beta / level, here)
        w = xp.where(found.exists, find_angle(found), np.pi)
        return store_once(w, w)

    def distance(w: Array) -> Array:
        fields = DeviceTerms(*(field[..., None] for field in here))
        return squared_distance(w, alpha[..., None], beta[..., None], fields)

    alpha, beta = xp.asarray(alpha), xp.asarray(beta)
    here = DeviceTerms(*(xp.asarray(field) for field in here))
    # The distance at the crossover is at most 2; at the low end |L| is 3.
    center, start = apply_each(at, [xp.ones_like(alpha), 3.0 * xp.ones_like(alpha)], xp)
    # With room: the wall's own phase may rise by a quarter turn meanwhile.
    turn = 3.0 * np.pi / (here.whole + 0.5)
    part = along(np.arange(1, _TURN + 1) / _TURN, center)
    low, high = xp.maximum(center - turn, 0.0), xp.minimum(center + turn, np.pi)
    turns = low[..., None] + (high - low)[..., None] * part
    part = along((np.arange(_DECADES) + 0.5) / _DECADES, center)
    start = xp.minimum(xp.maximum(start, low), center)
    decades = start[..., None] * (center / start)[..., None] ** part
    # Behind the crossover in equal steps of the logarithm as well.
    beyond = center[..., None] * (high / center)[..., None] ** part
    grid = xp.sort(xp.concatenate([turns, decades, beyond], axis=-1), axis=-1)
    values = distance(grid)
    return _refine_minimum(grid, values, distance, xp)


def _refine_minimum(grid: Array, values: Array, distance: Any, xp: Any) -> Array:
    """The lowest of the lowest dips, each zoomed in on."""
    edge = xp.full_like(values[..., :1], np.inf)
    before, after = xp.concatenate([edge, values[..., :-1]], -1), xp.concatenate([values[..., 1:], edge], -1)
    dips = xp.where((values <= before) & (values <= after), values, np.inf)
    best = xp.argsort(dips, axis=-1)[..., :_DIPS]
    last = grid.shape[-1] - 1
    low = xp.take_along_axis(grid, xp.maximum(best - 1, 0), axis=-1)
    high = xp.take_along_axis(grid, xp.minimum(best + 1, last), axis=-1)
    part = along(np.arange(_TRIALS) / (_TRIALS - 1.0), low)

    def zoom(ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        trials = low[..., None] + (high - low)[..., None] * part
        found = distance(trials.reshape(*grid.shape[:-1], _DIPS * _TRIALS)).reshape(trials.shape)
        place = xp.argmin(found, axis=-1)[..., None]
        low = xp.take_along_axis(trials, xp.maximum(place - 1, 0), axis=-1)[..., 0]
        return low, xp.take_along_axis(trials, xp.minimum(place + 1, _TRIALS - 1), axis=-1)[..., 0]

    low, high = repeat(_ZOOMS, zoom, (low, high), xp)
    # The vertex of a parabola: values alone know a minimum to half of the digits.
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    left, at, right = apply_each(distance, [low, middle, high], xp)
    bend = left + right - 2.0 * at
    vertex = middle + half * xp.where(bend > 0, 0.5 * (left - right) / xp.where(bend > 0, bend, 1.0), 0.0)
    vertex = xp.minimum(xp.maximum(vertex, low), high)
    # At an end of the range the lowest point is the end itself.
    ends = xp.stack([low, middle, high, vertex])
    values = xp.stack([left, at, right, distance(vertex)])
    best = xp.argmin(values, axis=0)[None]
    point, value = xp.take_along_axis(ends, best, axis=0)[0], xp.take_along_axis(values, best, axis=0)[0]
    lowest = xp.argmin(value, axis=-1)[..., None]
    return xp.take_along_axis(point, lowest, axis=-1)[..., 0]
