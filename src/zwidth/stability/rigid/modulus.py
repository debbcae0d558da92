"""Find the modulus margin of the rigid loop: the least distance ``|1 + L|`` of its Nyquist curve from -1.

L = B/T is the open loop of `stability.rigid.crossover`. With the wall (alpha, beta), the delay d = n + f, u = 1 - cos
w, s = sin w, c = e^-delta, em = 1 - c and z = e^(j w), its factors at the frequency w are

    W = alpha + beta u + j beta s      M = a2 z + a1 + a0/z      Z = s + j (em - u)

Its gain |L| decreases strictly with frequency (docs/theory/one-crossover.md, Theorem 1), and ``|1 + L| >= ||L| - 1|``.
Both bound the range of frequencies in which the minimum can lie:

- If the distance is r at one frequency, the minimum lies where ``1 - r <= |L| <= 1 + r``.
- Within one turn of the phase on either side of the gain crossover there is a frequency at which L is real and
  negative. Its distance is ``||L| - 1|``, and all frequencies beyond it are farther from -1.

So at most two turns of the phase have to be searched, whatever the delay. They are searched by `stability.open_loop`,
as for every linear loop.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import apply_each, expand_along, materialize, namespace, stop_gradient
from zwidth.model.circle_functions import Jet
from zwidth.numerics.held_mass import DiscretePlant
from zwidth.numerics.root_finding import attach_root_derivatives
from zwidth.stability.open_loop import find_nearest_angle
from zwidth.stability.rigid.crossover import find_gain_crossover


def evaluate_gain_and_phase(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Return the gain ``|L|`` and the phase of L plus pi, at w in (0, pi].

    With the factors W, M and Z of L,

        |L|^2 = |W|^2 |M|^2 / (2 u (em^2 + 2 c u))
        phase = arg W + arg M + arg Z - (n + 1/2) w = pi + arg L

    The principal values of these arguments are continuous in w, so the phase needs no unwrapping.
    """
    xp = namespace(w, alpha)
    _, _, u, s, (wall_re, wall_im), (m_re, m_im) = _evaluate_factors(w, alpha, beta, plant)
    numerator = (wall_re * wall_re + wall_im * wall_im) * (m_re * m_re + m_im * m_im)
    gain = xp.sqrt(numerator / (2.0 * u * (plant.em * plant.em + 2.0 * plant.c * u)))
    phase = xp.arctan2(wall_im, wall_re) + xp.arctan2(m_im, m_re) + xp.arctan2(plant.em - u, s)
    return gain, phase - (plant.whole + 0.5) * w


def _evaluate_factors(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Any, ...]:
    """Return sin(w/2), cos(w/2), u, s, and the real and imaginary parts of W and of M."""
    xp = namespace(w, alpha)
    sine, cosine = xp.sin(0.5 * w), xp.cos(0.5 * w)
    u, s = 2.0 * sine * sine, 2.0 * sine * cosine
    m_re = 2.0 * (plant.a2 + plant.a0) * cosine * cosine - plant.gap
    return sine, cosine, u, s, (alpha + beta * u, beta * s), (m_re, (plant.a2 - plant.a0) * s)


def evaluate_at_crossover(alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array, Array]:
    """Return the gain crossover w, the phase of L plus pi there, and whether w exists; otherwise w is arbitrary."""
    xp = namespace(alpha, plant.delta)
    w, exists = find_gain_crossover(alpha, beta, plant)
    w, exists = materialize((xp.where(exists, w, 1.0), exists), alpha)
    return w, evaluate_gain_and_phase(w, alpha, beta, plant)[1], exists


# Computing cost of a wall, relative to other kernels. The cost is high, because |1 + L| is sampled at many frequencies.
# The kernel is not compiled, because compiling takes many seconds and the compiled kernel is not faster.
SAMPLES_WEIGHT = 8
# Numbers of sampled frequencies: evenly spaced over the whole range, and logarithmically spaced below and above the
# gain crossover.
SAMPLES_PER_TURN = 48
SAMPLES_BELOW = 32
SAMPLES_ABOVE = 48


def _multiply_factors(w: Array, plant: DiscretePlant, factors: tuple[Any, ...]) -> tuple[Array, Array]:
    """Return real and imaginary part of ``L = -W M Z e^(-j (n + 1/2) w)/(2 |Z|^2 sin(w/2))`` at w in (0, pi]."""
    sine, _, u, s, (wall_re, wall_im), (m_re, m_im) = factors
    xp, delay_phase = namespace(sine), (2.0 * plant.whole + 1.0) * (0.5 * w)
    re, im = wall_re * m_re - wall_im * m_im, wall_re * m_im + wall_im * m_re
    em_minus_u = plant.em - u
    re, im = re * s - im * em_minus_u, re * em_minus_u + im * s
    cosine, sine_of_delay = xp.cos(delay_phase), xp.sin(delay_phase)
    denominator = 2.0 * sine * (plant.em * plant.em + 2.0 * plant.c * u)
    return -(re * cosine + im * sine_of_delay) / denominator, (re * sine_of_delay - im * cosine) / denominator


def differentiate_open_loop(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> Jet:
    """Return L and its derivative in w, from the derivative of log L."""
    factors = _evaluate_factors(w, alpha, beta, plant)
    sine, cosine, u, s, wall, m = factors
    c, total, difference = 1.0 - u, plant.a2 + plant.a0, plant.a2 - plant.a0
    # The derivative of the conjugate of Z with respect to w is z.
    rate = beta * (s + 1j * c) / (wall[0] + 1j * wall[1])
    rate = rate + (1j * difference * c - total * s) / (m[0] + 1j * m[1])
    rate = rate - (c + 1j * s) / (s + 1j * (u - plant.em)) - 1j * (plant.whole + 0.5)
    re, im = _multiply_factors(w, plant, factors)
    L = re + 1j * im
    return Jet(L, (rate - 0.5 * cosine / sine) * L)


def compute_squared_distance(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> Array:
    """Return ``|1 + L|^2`` at w in (0, pi]."""
    re, im = _multiply_factors(w, plant, _evaluate_factors(w, alpha, beta, plant))
    return (1.0 + re) ** 2 + im * im


def find_modulus_margin(alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Return the least ``|1 + L|`` over (0, pi] and its frequency w, for alpha > 0, elementwise."""
    xp = namespace(alpha, plant.c)
    wall = alpha, beta, plant

    def slope(w: Array, *wall: Any) -> Array:
        """Return half the derivative of ``|1 + L|^2`` in w."""
        loop = differentiate_open_loop(w, *wall)
        return xp.real(xp.conj(1.0 + loop.value) * loop.slope)

    def is_dip(w: Array, curvature: Array, _: Array) -> Array:
        return (w < np.pi) & (curvature > 0)

    w = attach_root_derivatives(slope, _find_lowest(*stop_gradient(wall, xp), xp), is_dip, *wall)
    return xp.sqrt(xp.maximum(compute_squared_distance(w, *wall), 0.0)), w


def _find_lowest(alpha: Array, beta: Array, plant: DiscretePlant, xp: Any) -> Array:
    """Return the frequency w at which |1 + L| is smallest."""

    def find_frequency_of_gain(level: Array) -> Array:
        """Return the frequency at which |L| equals ``level``; pi if |L| is larger at all frequencies."""
        w, exists = find_gain_crossover(alpha / level, beta / level, plant)
        w = xp.where(exists, w, np.pi)
        return materialize(w, w)

    alpha, beta = xp.asarray(alpha), xp.asarray(beta)
    plant = DiscretePlant(*(xp.asarray(field) for field in plant))
    wall = alpha[..., None], beta[..., None], DiscretePlant(*(field[..., None] for field in plant))
    center = find_frequency_of_gain(xp.ones_like(alpha))
    # Increase the distance slightly, because rounding errors matter if the bounds of the range nearly coincide.
    distance = 1.0001 * xp.sqrt(compute_squared_distance(center, alpha, beta, plant))
    start, end = apply_each(find_frequency_of_gain, [1.0 + distance, xp.where(distance < 1.0, 1.0 - distance, 1.0)], xp)
    end = xp.where(distance < 1.0, end, np.pi)
    # Three half turns of the delay phase contain one turn of the phase of L, because meanwhile arg W may increase by a
    # quarter turn.
    turn = 3.0 * np.pi / (plant.whole + 0.5)
    low = xp.minimum(xp.maximum(start, center - turn), center)
    high = xp.maximum(xp.minimum(end, center + turn), center)

    def list_fractions(count: int, least: float = 0.5) -> Array:
        return expand_along((np.arange(count) + least) / count, center)

    grid = [
        low[..., None] + (high - low)[..., None] * list_fractions(SAMPLES_PER_TURN, 1.0),
        low[..., None] * (center / low)[..., None] ** list_fractions(SAMPLES_BELOW),
        center[..., None] * (high / center)[..., None] ** list_fractions(SAMPLES_ABOVE),
    ]
    grid = xp.sort(xp.concatenate(grid, axis=-1), axis=-1)
    return find_nearest_angle(lambda w: differentiate_open_loop(w, *wall), grid, compute_squared_distance(grid, *wall))
