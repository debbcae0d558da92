"""Find the modulus margin of the rigid loop: the least distance ``|1 + L|`` of its Nyquist curve from -1.

L is the open loop at z = e^(jw), with the factors W, M and Z (`stability.rigid.characteristic_polynomial`,
`UnitCircleFactors`), for the wall (alpha, beta) and the delay d = n + f. Two facts limit the range of frequencies in
which the minimum can lie: the gain |L| decreases strictly with frequency (docs/theory/one-crossover.md, Theorem 1), and
``|1 + L| >= ||L| - 1|``. Therefore:

- If the distance is r at one frequency, the minimum lies where ``1 - r <= |L| <= 1 + r``.
- Within one turn of the phase on either side of the gain crossover there is a frequency at which L is real and
  negative. Its distance is ``||L| - 1|``, and all frequencies beyond it are farther from -1.

So at most two turns of the phase of L have to be sampled, for any delay. `stability.open_loop` then refines the lowest
samples; it does the same for all linear loops.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import apply_each, expand_along, namespace, stop_gradient
from zwidth.numerics.root_finding import attach_root_derivatives
from zwidth.plant.rigid_mass import DiscretePlant
from zwidth.stability.open_loop import find_nearest_angle
from zwidth.stability.rigid.characteristic_polynomial import differentiate_open_loop, evaluate_on_unit_circle
from zwidth.stability.rigid.crossover import find_gain_crossover


def evaluate_gain_and_phase(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Return the gain ``|L|`` and the phase of L plus pi, at w in (0, pi].

    With the factors W, M and Z of L,

        |L|^2 = |W|^2 |M|^2 / (2 u |Z|^2)      with u = 1 - cos w
        phase = arg W + arg M + arg Z - (n + 1/2) w = pi + arg L

    The principal values of these arguments are continuous in w, so the phase needs no unwrapping.
    """
    xp = namespace(w, alpha)
    _, _, u, _, W, M, Z, abs2_Z = evaluate_on_unit_circle(w, alpha, beta, plant)
    gain = xp.sqrt((W[0] * W[0] + W[1] * W[1]) * (M[0] * M[0] + M[1] * M[1]) / (2.0 * u * abs2_Z))
    phase = xp.arctan2(W[1], W[0]) + xp.arctan2(M[1], M[0]) + xp.arctan2(Z[1], Z[0])
    return gain, phase - (plant.whole + 0.5) * w


def evaluate_at_crossover(alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array, Array]:
    """Return the gain crossover w, the phase of L plus pi there, and whether w exists; otherwise w is arbitrary."""
    xp = namespace(alpha, plant.delta)
    w, exists = find_gain_crossover(alpha, beta, plant)
    w = xp.where(exists, w, 1.0)
    return w, evaluate_gain_and_phase(w, alpha, beta, plant)[1], exists


# Computing cost of a wall, relative to other kernels. The cost is high, because |1 + L| is sampled at many frequencies.
# The kernel is not compiled, because compiling takes many seconds and the compiled kernel is not faster.
SAMPLES_WEIGHT = 8
# Numbers of sampled frequencies: evenly spaced over the whole range, and logarithmically spaced below and above the
# gain crossover.
SAMPLES_PER_TURN = 48
SAMPLES_BELOW = 32
SAMPLES_ABOVE = 48


def compute_squared_distance(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> Array:
    """Return ``|1 + L|^2``, the squared distance of L from -1, at frequencies w in (0, pi]."""
    xp = namespace(w, alpha)
    delay_phase = (2.0 * plant.whole + 1.0) * (0.5 * w)
    sine, _, _, _, W, M, Z, abs2_Z = evaluate_on_unit_circle(w, alpha, beta, plant)
    re, im = W[0] * M[0] - W[1] * M[1], W[0] * M[1] + W[1] * M[0]
    re, im = re * Z[0] - im * Z[1], re * Z[1] + im * Z[0]
    cos_delay, sin_delay = xp.cos(delay_phase), xp.sin(delay_phase)
    denominator = 2.0 * sine * abs2_Z
    minus_re_loop, im_part = (
        (re * cos_delay + im * sin_delay) / denominator,
        (im * cos_delay - re * sin_delay) / denominator,
    )
    return (1.0 - minus_re_loop) ** 2 + im_part * im_part


def find_modulus_margin(alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Return the least ``|1 + L|`` over (0, pi] and its frequency w, for alpha > 0, elementwise."""
    xp = namespace(alpha, plant.c)
    wall = alpha, beta, plant

    def slope(w: Array, *wall: Any) -> Array:
        """Return half the derivative of ``|1 + L|^2`` with respect to w."""
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
        return xp.where(exists, w, np.pi)

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
