"""Expand one or two poles of all walls of a cell in power series of the wall's position in the cell.

A cell is a rectangle of walls, ``|alpha - alpha0| <= a``, ``|beta - beta0| <= b``. Around a center z0, with z = z0 (1 +
u), alpha = alpha0 + a xi and beta = beta0 + b eta, the poles of the walls solve

    A(u) = tau(u)      A = Q(z) - alpha0 - beta0 f(z)      tau = a xi + b eta f(z)
    f = 1 - 1/z        Q = -T/(z M)

with the factors T and M of P (`stability.rigid.characteristic_polynomial`; docs/theory/maps.md). A *group* is one pole,
or two poles close to the real axis that may meet there. Two poles that meet are not analytic in xi and eta, but their
sums are. The coefficients of these sums are integrals along a circle ``|u| = U`` around the group (C1). The circle is
chosen such that ``|A| > R |tau|`` on it for all walls (C2); powers of 1/R bound the truncation error, relative to a
bound G (C3). A pole is e^(re + j im); ``log |z|`` = re is called its log radius.
"""

from __future__ import annotations

from functools import cache
from math import comb
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander

from zwidth.stability.rigid.characteristic_function import make_complex
from zwidth.stability.rigid.characteristic_polynomial import LoopFactors, TaylorSeries, expand_taylor, expand_wall

# Orders of the series in xi and eta that are tried; each group uses the lowest order that is accurate enough.
ORDERS = (2, 4, 8, 12, 20)
# Number of Chebyshev nodes per axis minus the order of the series. The radius, which is the exponential of the series
# of log |z|, is interpolated between these nodes.
EXTRA_NODES = 6
# Order of the Taylor series of A in u.
N_TERMS = 36
# Number of points on the circle per pole of the group. The integrals of C1 are computed as means over these points.
POINTS_PER_POLE = 48
# Required relative error of radii above which poles with radii that agree within this error need not be separated (C6).
COARSE_ACCURACY = 1e-5
# Value of |log radius| below which the closed-form verdict, instead of the computed radius, decides on which side of
# the unit circle a pole is. Within 1e-10 of the stability boundary, one in ten computed radii is on the wrong side.
VERDICT_WIDTH = 1e-7
# Ratio of the error allowed for the sums over two poles to that allowed for one pole. It is small, because each of two
# poles depends on the square root of a difference of the sums.
PAIR_FACTOR = 1e-3
# Largest relative error of decay rates from series; walls with a larger error are computed one by one.
RATE_ACCURACY = 1e-6
# Lower limit of the |log radius| for which the order of the series of a cell is chosen. The few walls closer to the
# unit circle may have to be computed one by one.
MIN_LOG_RADIUS = 1e-5
# Value of |sin(im)| below which a pole counts as real.
REAL_AXIS_WIDTH = 1e-7
# Number of Newton steps to the center of a group of two poles, the zero of A' between them.
NEWTON_STEPS = 4
# Radii of the circles that are tried, relative to the largest radius.
CIRCLE_RADII = 2.0 ** (-0.5 * np.arange(14))
# Distance, in indices of `CIRCLE_RADII`, from the chosen circle to the smaller and the larger circle that bound the
# error of its means (C3), for each number of poles in a group.
CIRCLE_OFFSET = {1: 2, 2: 1}
# Ratio R above which the choice of a circle does not depend on R, because the truncation error is then negligible.
AMPLE_RATIO = 100.0
# Rounding error of the series, relative to the bound G of C3.
ROUNDING = 1e-14
# Weights binomial(k, j)/k of C1, with k = i + j, for the coefficients of xi^i eta^j; the first index is j.
BINOMIAL_WEIGHTS = np.array(
    [[comb(i + j, j) / max(i + j, 1) for i in range(ORDERS[-1] + 1)] for j in range(ORDERS[-1] + 1)]
)


class AllowedErrors(NamedTuple):
    """The accuracy required of radii and rates, and the errors of log radii that it allows."""

    accuracy: float  # relative error of radii
    with_rate: bool  # decay rates are requested, which need a relative error of the logarithm

    @property
    def is_coarse(self) -> bool:
        """True if poles of similar radius need not be separated (C6)."""
        return self.accuracy > COARSE_ACCURACY and not self.with_rate

    @property
    def reserve(self) -> float:
        """Part of the allowed error that is reserved for slightly larger poles outside the groups."""
        return 0.5 * self.accuracy if self.is_coarse else 0.0

    @property
    def uncertain_width(self) -> float:
        """Largest |log radius| of a computed pole that may be on the wrong side of the unit circle."""
        return VERDICT_WIDTH + min(self.accuracy, COARSE_ACCURACY)

    def limit(self, size: np.ndarray) -> Any:
        """Return the largest error allowed in log radii of the magnitude ``size``."""
        if self.with_rate:
            return np.minimum(self.accuracy, RATE_ACCURACY * size)
        return np.minimum(self.accuracy - self.reserve, np.maximum(size, COARSE_ACCURACY))


class Cells(NamedTuple):
    """The loops at the centers of cells, and the half widths of the cells in alpha and beta."""

    loop: LoopFactors
    a: np.ndarray
    b: np.ndarray


class Group(NamedTuple):
    """One or two poles of each cell, with the Taylor series of A around the center and an enclosing circle (C2)."""

    poles: int  # 1 or 2
    re: np.ndarray  # the center is e^(re + j im)
    im: np.ndarray
    a: Any  # complex coefficients of A in u (terms, cells)
    f: Any  # f at the center
    disk: np.ndarray  # radius U of the circle, in u
    low: np.ndarray  # lower bound of log |z| of the group's poles for all walls of the cell
    error: np.ndarray  # truncation error for each order, relative to the bound G of C3 (orders, cells)
    order: np.ndarray  # index of the order to use; len(ORDERS) if none is accurate enough

    @property
    def n_poles(self) -> np.ndarray:
        """Number of poles including conjugates."""
        return np.where((self.poles == 1) & (np.sin(self.im) < REAL_AXIS_WIDTH), 1, 2)

    @property
    def log_error(self) -> np.ndarray:
        """Bound on the error of log |z| of one pole, or of the sum of u over two poles, of shape (orders, cells).

        The sum of u^2/U over two poles has at most twice this error.
        """
        return (self.error + ROUNDING) * (self.disk / (1.0 - self.disk)) + ROUNDING * np.abs(self.re)

    def is_disjoint(self, other: Group) -> np.ndarray:
        """Return a mask of the cells in which the circles around both groups are disjoint."""
        centers = [np.exp(group.re + 1j * group.im) for group in (self, other)]
        return np.abs(centers[0] - centers[1]) > np.abs(centers[0]) * self.disk + np.abs(centers[1]) * other.disk


def select_cells(tree: Any, index: Any) -> Any:
    """Return a nested tuple of arrays restricted to some cells; cells are the last axis of each array."""
    if isinstance(tree, tuple):
        return type(tree)(*(select_cells(leaf, index) for leaf in tree))
    return tree[..., index] if isinstance(tree, np.ndarray) else tree


def _expand_taylor(re: np.ndarray, im: np.ndarray, loop: LoopFactors, fractional: bool, terms: int) -> TaylorSeries:
    """Return the Taylor series of A in u around centers."""
    expm1_re, sine = np.expm1(re), np.sin(0.5 * im)
    r = 1.0 + expm1_re
    z_minus_1 = make_complex(expm1_re - 2.0 * r * sine * sine, 2.0 * r * sine * np.cos(0.5 * im))
    n, modulus = loop.n_plus_1 - 1.0, np.exp((loop.n_plus_1 - 1.0) * re)
    z_to_n = make_complex(modulus * np.cos(n * im), modulus * np.sin(n * im))
    return expand_taylor(z_minus_1, z_to_n, loop, fractional, terms)


def find_stationary_point(
    re: np.ndarray, im: np.ndarray, loop: LoopFactors, fractional: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the real point with A' = 0 near a pole, i.e. between two poles, by Newton's method."""
    re_z_minus_1 = np.expm1(re) - 2.0 * np.exp(re) * np.sin(0.5 * im) ** 2
    re, im = (
        np.where(re_z_minus_1 > -1.0, np.log1p(re_z_minus_1), np.log(-1.0 - re_z_minus_1)),
        np.where(re_z_minus_1 > -1.0, 0.0, np.pi),
    )
    max_step = 0.5 / loop.n_plus_1
    for _ in range(NEWTON_STEPS):
        _, slope, curvature = _expand_taylor(re, im, loop, fractional, 2).terms.real
        re = re + np.log1p(np.clip(-0.5 * slope / curvature, -max_step, max_step))
    return re, im


def enclose_poles(
    poles: int, re: np.ndarray, im: np.ndarray, cells: Cells, fractional: bool, errors: AllowedErrors
) -> Group:
    """Choose the circle on which ``|A|`` exceeds ``|tau|`` by the largest factor R, and bound all errors (C2, C3).

    Args:
        poles: Number of poles in the group, 1 or 2.
        re: log |z0| of the centers.
        im: arg z0 of the centers.
        cells: The cells.
        fractional: Whether the delays are fractional.
        errors: Errors allowed.

    Returns:
        The groups. Those that no circle encloses have infinite errors and no order.
    """
    loop, points, orders = cells.loop, POINTS_PER_POLE * poles, np.arange(N_TERMS + 1)
    a, f, (abs_z_minus_1, abs_z_minus_c, abs_q0, rho, abs_late) = _expand_taylor(re, im, loop, fractional, N_TERMS)
    r, abs_f, sizes, abs_w = np.exp(re), np.abs(f), np.abs(a), np.exp(-re)
    limit = 1.0 / np.maximum(1.0, np.maximum(rho, abs_late) if fractional else rho)
    largest = np.minimum(2.0 / loop.n_plus_1, 0.4 * limit)
    disk = largest * CIRCLE_RADII[:, None]
    # Bound the remainder of the Taylor series of A by the moduli of the factors of A on a wider disk.
    wider_disk = np.minimum(4.0 * disk, 0.5 * (disk + limit))
    majorant = (
        abs_q0
        * np.exp(loop.n_plus_1 * wider_disk)
        * (abs_z_minus_1 + r * wider_disk)
        * (abs_z_minus_c + r * wider_disk)
        / (1.0 - rho * wider_disk)
    )
    if fractional:
        majorant *= (1.0 + wider_disk) / (1.0 - abs_late * wider_disk)
    remainder = (majorant + np.abs(loop.beta) * abs_w / (1.0 - wider_disk)) * (disk / wider_disk) ** (N_TERMS + 1)
    total = ((sizes * largest ** orders[:, None]).T[:, None] @ CIRCLE_RADII ** orders[:, None])[:, 0].T
    # Add the rounding error of evaluating P, bounded as in `stability.rigid.characteristic_function`.
    rounding = 2.0**-52 * (16.0 + loop.n_plus_1 * (np.abs(re) + im))
    remainder += rounding * (total + 2.0 * (np.abs(loop.alpha) + np.abs(loop.beta) * abs_f))
    main_term = sizes[poles] * disk**poles
    low = 2.0 * main_term - total - remainder
    ratio = low / (cells.a + cells.b * (abs_f + abs_w * disk / (1.0 - disk)))
    score = np.where(ratio > 1.02, ratio / (1.0 + 1e3 / errors.accuracy * remainder / low), 0.0)
    # Bound the error of a mean over the points of a circle by the values of the integrand on a smaller and a larger
    # circle; no pole may lie between these two (C3).
    offset, cell_index = CIRCLE_OFFSET[poles], np.arange(re.size)
    # If R is so large that the truncation error is negligible for every order, prefer a smaller circle, which is
    # farther from the singularities outside.
    rank = np.minimum(score, AMPLE_RATIO) * (1.0 + 0.01 * np.arange(CIRCLE_RADII.size)[:, None])
    best = (rank[offset:-offset] * (score[: -2 * offset] > 0) * (score[2 * offset :] > 0)).argmax(0) + offset
    chosen, spread, alias = (
        (best, cell_index),
        np.log(main_term / low) - np.log1p(-1.0 / ratio),
        np.full(re.size, np.inf),
    )
    for step in (offset, offset + 1):
        outer, inner = np.maximum(best - step, 0), np.minimum(best + step, CIRCLE_RADII.size - 1)
        between = (outer + inner == 2 * best) & (np.minimum(score[outer, cell_index], score[inner, cell_index]) > 0)
        # Bound the error of the means of powers of tau/A. For the mean that yields the poles at the center of the cell,
        # the error may be larger by a factor of up to the number of points.
        missed = 2.0 ** (-0.5 * step * points) * (1 + points)
        missed = missed * (4.5 * spread[outer, cell_index] + spread[inner, cell_index])
        alias = np.where(between, np.fmin(alias, missed), alias)
    is_enclosed = score[chosen] > 0
    if poles == 1:
        # Require that a circle around a complex center does not reach the real axis. A single pole in a circle around a
        # real center is real.
        is_enclosed &= (im == 0.0) | (im == np.pi) | (np.sin(im) > disk[chosen])
    inverse, power = 1.0 / ratio[chosen], np.array(ORDERS)[:, None] + 1
    remainder_share = remainder[chosen] / (low[chosen] * (1.0 - inverse))
    error = inverse**power / (power * (1.0 - inverse)) + remainder_share / (1.0 - remainder_share)
    if poles == 1:
        # Add the error of interpolating the radii between nodes, which the Lebesgue constant of the nodes bounds.
        nodes = power + (EXTRA_NODES - 1)
        error = error + (1.0 + (1.0 + np.log(nodes) / 1.57) ** 2) * inverse**nodes / (1.0 - inverse) ** 2
    error = np.where(is_enclosed & (remainder_share < 0.5), error + alias, np.inf)
    # Bound the log radii of the poles from below, relative to re = log |z0|: both poles of a pair lie in the smallest
    # circle that encloses them; for a single pole a tighter bound exists.
    if poles == 1:
        reach = 1.0 / ratio + sizes[0] / low
        farthest = np.where((ratio > 1.02) & (reach < 0.98), np.log1p(-reach) * disk / (1.0 - disk), -np.inf)
    else:
        farthest = np.where(ratio > 1.02, np.log1p(-disk), -np.inf)
    group = Group(poles, re, im, a, f, disk[chosen], re + farthest.max(0), error, best)
    least = np.maximum(np.abs(re) - (re - group.low), MIN_LOG_RADIUS)
    allowed = errors.limit(least) * (1.0 if poles == 1 else PAIR_FACTOR)
    return group._replace(order=(~(group.log_error <= allowed)).sum(0))


def _compute_powers(x: Any, count: int, factor: Any = 1.0) -> np.ndarray:
    """Return ``factor x^k``, k = 0, 1, ..., for points x on circles.

    Args:
        x: Points (cells, points).
        count: Number of powers.
        factor: Common factor.

    Returns:
        Array (cells, powers, 2 points), with real and imaginary parts alternating.
    """
    powers = np.empty((count, *x.shape), complex)
    powers[0], computed = factor, 1
    while computed < count:
        np.multiply(powers[: min(computed, count - computed)], x, out=powers[computed : 2 * computed])
        computed, x = 2 * computed, x * x
    return powers.view(float).transpose(1, 0, 2)


@cache
def _list_points(poles: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the unit circle, or on its upper half for two poles, and their weights in the mean."""
    count = POINTS_PER_POLE * poles
    points = np.exp(2j * np.pi * np.arange(count) / count)
    weights = np.full(count, 1.0 / count)
    if poles == 2:
        points, weights = points[: count // 2 + 1], 2.0 * weights[: count // 2 + 1]
        weights[[0, -1]] *= 0.5
    return points, weights


def expand_sums(group: Group, cells: Cells, order: int) -> list[np.ndarray]:
    """Return the series of C1 in eta and xi: log |1 + u| of one pole; for two poles, the sums of u/U and (u/U)^2."""
    poles, powers = group.poles, np.arange(N_TERMS + 1)
    count = POINTS_PER_POLE * poles
    points, weights = _list_points(poles)
    u = group.disk[:, None] * points
    coefficients = (group.a * group.disk ** powers[:, None]).T
    inverse = 1.0 / np.fft.ifft(coefficients, count, norm="forward")[:, : points.size]
    log_derivative = np.fft.ifft(coefficients * powers, count, norm="forward")[:, : points.size] * inverse
    change = expand_wall(cells.a[:, None], cells.b[:, None])
    powers_xi = _compute_powers(np.conj(change.alpha * inverse), order + 1).transpose(0, 2, 1)
    # Insert f = 1 - 1/z at z = z0 (1 + u), with 1/z0 = 1 - f(z0).
    powers_eta = change.beta * inverse * (group.f[:, None] + (1.0 - group.f[:, None]) * (u / (1.0 + u)))
    orders, sums = np.arange(order + 1), []
    binomials = np.where(orders[:, None] + orders <= order, BINOMIAL_WEIGHTS[: order + 1, : order + 1], 0.0)
    for k in range(1, poles + 1):
        weight = weights * (u / (1.0 + u) if poles == 1 else k * points**k)
        series = _compute_powers(powers_eta, order + 1, weight) @ powers_xi * binomials
        # Compute the constant term separately, because the weights of C1 do not apply to it. It is the value for the
        # poles of the wall at the center of the cell.
        center_sum = (log_derivative * (weights * points**k)).sum(1)
        series[:, 0, 0] = np.log1p(group.disk * center_sum).real if poles == 1 else center_sum.real
        sums.append(series)
    return sums


def compute_larger(first: np.ndarray, second: np.ndarray, disk: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return log |1 + u| of the larger of two poles, from the sums of u/U and (u/U)^2, and the discriminant D (C3)."""
    # The poles, in units of U, are half +- sqrt(discriminant).
    half = 0.5 * first
    discriminant = 0.5 * second - half * half
    real = disk * (half + np.sqrt(np.maximum(discriminant, 0.0)))
    return 0.5 * np.log1p(real * (2.0 + real) - disk**2 * np.minimum(discriminant, 0.0)), discriminant


def is_larger_accurate(discriminant: np.ndarray, disk: Any, error: Any, limit: Any) -> np.ndarray:
    """Return whether the larger pole is accurate to ``limit``, for errors ``error`` and 2 ``error`` of the two sums."""
    discriminant_error = 2.01 * error
    # Two values bound the error of sqrt(D): the square root of the error of D, and the error of D divided by sqrt(D).
    remaining = np.maximum(limit * ((1.0 - disk) ** 2 / disk) - 0.5 * error - discriminant_error, 0.0)
    return np.abs(discriminant) * remaining**2 >= np.where(
        discriminant_error <= remaining**2, -1.0, discriminant_error**2
    )


@cache
def list_chebyshev_nodes(order: int) -> np.ndarray:
    """Return the Chebyshev nodes for interpolating the exponential of a series of the given order."""
    return chebpts1(order + EXTRA_NODES)


def compute_interpolation_weights(positions: np.ndarray, order: int) -> np.ndarray:
    """Return the weights by which the values at the nodes are multiplied to interpolate at positions: (..., nodes)."""
    nodes = list_chebyshev_nodes(order)
    polynomials = chebvander(nodes, nodes.size - 1).T * (2.0 / nodes.size)
    polynomials[0] *= 0.5
    return chebvander(positions, nodes.size - 1) @ polynomials
