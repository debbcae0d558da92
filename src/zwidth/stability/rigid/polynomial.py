"""Compute the characteristic polynomial of device and virtual wall: its coefficients, or walls with a given zero.

For the delay d = n + f (n integer, 0 <= f < 1) and N(z) = a2 z^2 + a1 z + a0 of the discretized plant
(`numerics.held_mass`),

    P(z) = z^(2+n) (z - 1)(z - c) + N(z) (alpha z + beta (z - 1)),   c = e^-delta

P is affine in the wall (alpha, beta): P = D + alpha N1 + beta N2. For integer d, a0 = 0 and one factor z cancels; the
result is the paper's polynomial (17) divided by -delta^2, which makes it monic. The pole methods use its coefficients
(`compute_coefficients`), the frequency methods the wall with a given pole on the unit circle (`find_boundary_wall`).
"""

from __future__ import annotations

from typing import NamedTuple

from zwidth.core.types import Array, ArrayLike, Coefficients, Reals
from zwidth.core.xp import namespace, nan_with_nan_derivatives
from zwidth.numerics.held_mass import Plant, discretize_mass, split_delay
from zwidth.numerics.polynomials import Affine
from zwidth.stability.rigid.broadcasting import Degree, map_by_degree
from zwidth.stability.rigid.normalization import valid_wall
from zwidth.stability.rigid.ridge_newton import evaluate_wall, evaluate_wave_at, expand_curve


def expand_affine(delta: Reals, d: Reals, degree: Degree) -> Affine:
    """Return the coefficients of D, N1, N2 of devices of one degree, along a new last axis of degree.poles + 1."""
    plant = discretize_mass(delta, d - degree.n if degree.fractional else None)
    xp = namespace(plant.a2)
    zero, one = 0.0 * plant.a2, 0.0 * plant.a2 + 1.0
    head = [one, -(1.0 + plant.c), plant.c]
    # List the coefficients of N(z) and of (z - 1) N(z). For an integer delay both are divided by the common factor z,
    # and ``plant.gap`` is a2 - a1.
    if degree.fractional:
        numerator = [plant.a2, plant.a1, plant.a0]
        differences = [plant.a1 - plant.a2, plant.a0 - plant.a1]
    else:
        numerator = [plant.a2, plant.a1]
        differences = [-plant.gap]
    pad = [zero] * (degree.poles - len(numerator))
    rows = (
        head + [zero] * (degree.poles - 2),
        [*pad, *numerator, zero],
        [*pad, numerator[0], *differences, -numerator[-1]],
    )
    return Affine(*(xp.stack(row, axis=-1) for row in rows))


def compute_coefficients(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Coefficients:
    """Return the coefficients of the monic P, highest power first, along a new last axis of degree.poles + 1."""
    # Replace arguments that are out of range by valid numbers; the caller sets their results to NaN.
    xp, ok = namespace(alpha, beta, delta, d), valid_wall(alpha, beta, delta, d)
    alpha, beta, delta = (xp.where(ok, value, 0.0) for value in (alpha, beta, delta))
    polynomials = expand_affine(delta, xp.where(ok, d, float(degree.n)), degree)
    return polynomials.D + alpha[..., None] * polynomials.N1 + beta[..., None] * polynomials.N2


class Wall(NamedTuple):
    """The normalized stiffness and damping of a wall, or arrays of them."""

    alpha: Reals
    beta: Reals


class FrequencyLoop(NamedTuple):
    """The parameters of one loop that do not depend on the frequency."""

    plant: Plant
    n: Array  # n, integer part of the delay


def build_frequency_loop(delta: Array, d: Array) -> FrequencyLoop:
    """Return the discretized plant and the integer part of the delay for one delta and d."""
    n, fraction = split_delay(d)
    return FrequencyLoop(discretize_mass(delta, fraction), n)


def find_boundary_wall(omega: Reals, loop: FrequencyLoop) -> Wall:
    """Return the wall that has a pole at z = e^(j omega), 0 <= omega <= pi, in closed form."""
    return Wall(*evaluate_wall(evaluate_wave_at(omega, loop.n), expand_curve(loop.plant)))


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
    nan_if_invalid = nan_with_nan_derivatives(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
    return compute_coefficients(alpha, beta, delta, d, degree) + nan_if_invalid[..., None]
