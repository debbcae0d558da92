"""Find the modulus margin of the rigid loop: the least distance ``|1 + L|`` of its Nyquist curve from -1.

L = B/T is the open loop of `stability.rigid.characteristic_polynomial`, with the factors W, M and Z at the frequency w
(`UnitCircleFactors`), c = e^-delta and em = 1 - c, for the wall (alpha, beta) and the delay d = n + f. Its gain |L|
decreases strictly with frequency (docs/theory/one-crossover.md, Theorem 1), and ``|1 + L| >= ||L| - 1|``. Both bound
the range of frequencies in which the minimum can lie:

- If the distance is r at one frequency, the minimum lies where ``1 - r <= |L| <= 1 + r``.
- Within one turn of the phase on either side of the gain crossover there is a frequency at which L is real and
  negative. Its distance is ``||L| - 1|``, and all frequencies beyond it are farther from -1.

So at most two turns of the phase have to be searched, whatever the delay: the distance is sampled, and the lowest
samples are refined by Newton's method.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import apply_each, expand_along, materialize, namespace, stop_gradient
from zwidth.numerics.root_finding import attach_root_derivatives, newton
from zwidth.plant.rigid_mass import DiscretePlant
from zwidth.stability.rigid.characteristic_polynomial import differentiate_open_loop, evaluate_on_unit_circle
from zwidth.stability.rigid.crossover import find_gain_crossover


def evaluate_gain_and_phase(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Return the gain ``|L|`` and the phase of L plus pi, at w in (0, pi].

    With the factors W, M and Z of L,

        |L|^2 = |W|^2 |M|^2 / (2 u |Z|^2)      u = 1 - cos w
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
# Number of local minima that are refined, the lowest ones first.
MAX_DIPS = 5
# Number of Newton steps from each of these minima.
NEWTON_STEPS = 8


def compute_squared_distance(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> Array:
    """Return ``|1 + L|^2`` at w in (0, pi]."""
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


def _differentiate_distance(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Return half the first and half the second derivative of |1 + L|^2 in w, from the derivatives of log L."""
    xp = namespace(w, alpha)
    loop, rate, curvature = differentiate_open_loop(w, alpha, beta, plant)
    slope, conj_distance = rate * loop, xp.conj(1.0 + loop)
    return xp.real(conj_distance * slope), xp.abs(slope) ** 2 + xp.real(
        conj_distance * (curvature + rate * rate) * loop
    )


def find_modulus_margin(alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, Array]:
    """Return the least ``|1 + L|`` over (0, pi] and its frequency w, for alpha > 0, elementwise."""
    xp = namespace(alpha, plant.c)
    wall = alpha, beta, plant

    def is_dip(w: Array, curvature: Array, _: Array) -> Array:
        return (w < np.pi) & (curvature > 0)

    lowest = _find_lowest(*stop_gradient(wall, xp), xp)
    w = attach_root_derivatives(
        lambda *point: _differentiate_distance(*point)[0],
        lowest,
        is_dip,
        *wall,
        slope=lambda *point: _differentiate_distance(*point)[1],
    )
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
    values = compute_squared_distance(grid, *wall)
    infinity = xp.full_like(values[..., :1], np.inf)
    previous, following = (
        xp.concatenate([infinity, values[..., :-1]], -1),
        xp.concatenate([values[..., 1:], infinity], -1),
    )
    # If two samples coincide, count them as one minimum. Because the minimum may lie to the right of the second one,
    # search between the second neighbors on both sides.
    dips = xp.where((values < previous) & (values <= following), values, np.inf)
    best = xp.argpartition(dips, MAX_DIPS - 1, axis=-1)[..., :MAX_DIPS]

    def take_neighbor(steps: int) -> Array:
        return xp.take_along_axis(grid, xp.clip(best + steps, 0, grid.shape[-1] - 1), axis=-1)

    middle = take_neighbor(0)
    refined = newton(
        lambda w: _differentiate_distance(w, *wall), take_neighbor(-2), take_neighbor(2), middle, NEWTON_STEPS
    )[0]
    # Compare each refined minimum with the sample from which the refinement started, because the minimum may be an end
    # of the range.
    candidates = xp.concatenate([refined, middle], axis=-1)
    lowest = xp.argmin(compute_squared_distance(candidates, *wall), axis=-1)[..., None]
    return xp.take_along_axis(candidates, lowest, axis=-1)[..., 0]
