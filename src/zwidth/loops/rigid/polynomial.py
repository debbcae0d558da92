"""The closed loop of device and virtual wall, affine in (alpha, beta).

Held delay d = n + f, with N(z) = a2 z^2 + a1 z + a0 of `arrays.held_mass`:

    P(z) = z^(2+n) (z - 1)(z - c) + N(z) (alpha z + beta (z - 1))

For integer d, a0 = 0 and one factor z cancels; that is the paper's polynomial (17) over -delta^2, monic and
factored. Pole methods use the coefficients `coefficients`, frequency methods `frequency_boundary`.
"""

from __future__ import annotations

from typing import NamedTuple

from zwidth.arrays.held_mass import Plant, held_plant, split_delay
from zwidth.arrays.polynomials import Affine
from zwidth.loops.rigid.folding import Degree, map_by_degree
from zwidth.loops.rigid.normalization import valid_wall
from zwidth.loops.rigid.ridge_newton import expand_curve, wall, wave_at
from zwidth.words.types import Array, ArrayLike, Coefficients, Reals
from zwidth.words.xp import namespace, nan_with_nan_slopes


def affine(delta: Reals, d: Reals, degree: Degree) -> Affine:
    """The three coefficient vectors of devices of one degree, along a new last axis of degree.poles + 1."""
    plant = held_plant(delta, d - degree.whole if degree.fractional else None)
    xp = namespace(plant.a2)
    zero, one = 0.0 * plant.a2, 0.0 * plant.a2 + 1.0
    head = [one, -(1.0 + plant.c), plant.c]
    # N(z) and (z - 1) N(z), without the common factor z that a whole delay leaves in them; a2 - a1 is then the gap.
    if degree.fractional:
        n = [plant.a2, plant.a1, plant.a0]
        differences = [plant.a1 - plant.a2, plant.a0 - plant.a1]
    else:
        n = [plant.a2, plant.a1]
        differences = [-plant.gap]
    pad = [zero] * (degree.poles - len(n))
    rows = (head + [zero] * (degree.poles - 2), [*pad, *n, zero], [*pad, n[0], *differences, -n[-1]])
    return Affine(*(xp.stack(row, axis=-1) for row in rows))


def coefficients(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Coefficients:
    """Coefficients of P, highest power first, along a new last axis of degree.poles + 1; P is monic."""
    # Of what is out of range any numbers.
    xp, ok = namespace(alpha, beta, delta, d), valid_wall(alpha, beta, delta, d)
    alpha, beta, delta = (xp.where(ok, value, 0.0) for value in (alpha, beta, delta))
    parts = affine(delta, xp.where(ok, d, float(degree.whole)), degree)
    return parts.D + alpha[..., None] * parts.N1 + beta[..., None] * parts.N2


class Wall(NamedTuple):
    """A wall by its normalized stiffness and damping, or an array of them."""

    alpha: Reals
    beta: Reals


class FrequencyLoop(NamedTuple):
    """Parameters of one loop that do not depend on the frequency."""

    plant: Plant
    lag: Array  # integer periods of delay


def frequency_loop(delta: Array, d: Array) -> FrequencyLoop:
    """Return the loop of one (delta, d) for evaluation on the unit circle."""
    whole, fraction = split_delay(d)
    return FrequencyLoop(held_plant(delta, fraction), whole)


def frequency_boundary(omega: Reals, loop: FrequencyLoop) -> Wall:
    """Return the wall that puts a pole at z = e^(j omega), 0 <= omega <= pi, in closed form."""
    return Wall(*wall(wave_at(omega, loop.lag), expand_curve(loop.plant)))


def char_poly(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Coefficients:
    """Return the coefficients of the monic characteristic polynomial, highest power first.

    ``P(z) = z^(2+n) (z - 1)(z - c) + (z n0(z) + n1(z)) (alpha z + beta (z - 1))``, d = n + f, ``c = e^-delta``; for
    integer d the paper's (17) over ``-delta^2``, also for delta = 0. The loop is stable if all zeros lie inside the
    unit circle.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional; concrete also inside `jit`, because it determines the degree.
            All four broadcast.

    Returns:
        Array of the broadcast shape with one more axis at the end: 4 + d coefficients for integer d, 5 + n otherwise.
        If degrees are mixed, shorter polynomials have leading zeros. A point out of range is NaN.

    Raises:
        InputError: an argument is no real number or a scalar out of range, or shapes do not broadcast.
        TracedDelayError: d is traced.

    Numerics:
        Each coefficient is a sum; its error is a few rounding errors of the terms of this sum, for all delta.

    References:
        Hulin, Preusche, Hirzinger 2006, eqs. (15), (17).

    Example:
        >>> import numpy as np, zwidth
        >>> print(np.array2string(zwidth.char_poly(0.5, 0.5, 0.0, 0), precision=2))
        [ 1.   -1.5   1.25 -0.25]
    """
    return map_by_degree(_char_poly_kernel, (alpha, beta, delta, d), lead=True)


def _char_poly_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Coefficients:
    spoiled = nan_with_nan_slopes(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
    return coefficients(alpha, beta, delta, d, degree) + spoiled[..., None]
