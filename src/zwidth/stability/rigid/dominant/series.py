"""Expand one pole z = z0 (1 + u) of all walls of a cell in a power series in the position (xi, eta) of the wall.

A cell is a rectangle of walls alpha = alpha0 + a xi, beta = beta0 + b eta with |xi|, |eta| <= 1. Around a center z0,
the poles of the walls solve

    A(u) = tau(u)      A = Q(z) - alpha0 - beta0 f(z)      tau = a xi + b eta f(z)
    f = 1 - 1/z        Q = -T/(z M)

with T and M of `stability.rigid.characteristic_polynomial`. C1 to C5 denote sections of docs/theory/maps.md. The
coefficients of the series are integrals along a circle ``|u| = U`` around the pole (C1). The circle is chosen such that
``|A| > R |tau|`` on the circle for all walls (C2); powers of 1/R bound the truncation error, relative to a bound G
(C3). A pole is e^(re + j im); re is its *log radius*.
"""

from __future__ import annotations

from math import comb
from typing import Any, NamedTuple

import numpy as np

from zwidth.numerics.complex_pairs import make_complex
from zwidth.stability.rigid.characteristic_polynomial import LoopFactors, TaylorSeries, expand_taylor, expand_wall

# Possible orders of the series in xi and eta; each pole uses the lowest order that is accurate enough.
ORDERS = (2, 4, 8, 12, 20)
# Order of the Taylor series in u of A, the function whose zero is the pole at the center of a cell.
N_TERMS = 36
# Number of points on the circle |u| = U. The integrals along the circle (C1) are computed as means over these points.
N_POINTS = 48
POINTS = np.exp(2j * np.pi * np.arange(N_POINTS) / N_POINTS)
# Largest error of a log radius relative to its magnitude, so that the decay rate is accurate, too. Walls with a larger
# error are computed separately.
RATE_ACCURACY = 1e-6
# Lower limit of the |log radius| for which the order of the series of a cell is chosen. The few walls with poles closer
# to the unit circle may have to be computed separately.
MIN_LOG_RADIUS = 1e-5
# Distance of the angle im from 0 or pi below which a pole counts as real.
REAL_AXIS_WIDTH = 1e-7
# Radii U of the circles that are tried, relative to the largest one.
CIRCLE_RADII = 2.0 ** (-0.5 * np.arange(14))
# A smaller and a larger circle bound the error of the means on the chosen circle (C3). CIRCLE_OFFSET is the difference
# between their indices in `CIRCLE_RADII` and the index of the chosen circle.
CIRCLE_OFFSET = 2
# Ratio R = |A|/|tau| above which R does not influence the choice of the circle, because the truncation error is then
# negligible.
AMPLE_RATIO = 100.0
# Rounding error of the series, relative to the bound G of C3.
ROUNDING = 1e-14
# Weights of the integrals (C1): the coefficient of xi^i eta^j has the weight binomial(k, j)/k with k = i + j. The first
# index of the array is j.
BINOMIAL_WEIGHTS = np.array(
    [[comb(i + j, j) / max(i + j, 1) for i in range(ORDERS[-1] + 1)] for j in range(ORDERS[-1] + 1)]
)


class Cells(NamedTuple):
    """The loops at the centers of cells, and the half widths a in alpha and b in beta of the cells."""

    loop: LoopFactors
    a: np.ndarray
    b: np.ndarray


class EnclosedPole(NamedTuple):
    """One pole of each cell: the Taylor series of A(u) around a center z0, and the enclosing circle |u| = U (C2)."""

    re: np.ndarray  # the center is z0 = e^(re + j im)
    im: np.ndarray
    a: Any  # complex coefficients of the Taylor series of A in u, shape (terms, cells)
    f: Any  # f = 1 - 1/z at the center
    disk: np.ndarray  # radius U of the circle, in u
    low: np.ndarray  # lower bound of the log radius of the pole for all walls of the cell
    error: np.ndarray  # bound on the error of log z for each order, shape (orders, cells)
    order: np.ndarray  # index in `ORDERS` of the order to use; len(ORDERS) if none is accurate enough

    @property
    def is_real(self) -> np.ndarray:
        """True for cells with a real center, in which the poles of all walls are real, too."""
        return (self.im == 0.0) | (self.im == np.pi)

    def is_disjoint(self, other: EnclosedPole) -> np.ndarray:
        """Return a mask of the cells in which the circles around both poles are disjoint."""
        centers = [np.exp(pole.re + 1j * pole.im) for pole in (self, other)]
        return np.abs(centers[0] - centers[1]) > np.abs(centers[0]) * self.disk + np.abs(centers[1]) * other.disk


def select_cells(tree: Any, index: Any) -> Any:
    """Select some cells in each array of a nested tuple; the last axis of each array is that of the cells."""
    if isinstance(tree, tuple):
        return type(tree)(*(select_cells(leaf, index) for leaf in tree))
    return tree[..., index]


def _expand_taylor(re: np.ndarray, im: np.ndarray, loop: LoopFactors, fractional: bool) -> TaylorSeries:
    """Return the Taylor series of A(u) around the centers z0 = e^(re + j im)."""
    expm1_re, sine = np.expm1(re), np.sin(0.5 * im)
    r = 1.0 + expm1_re
    z_minus_1 = make_complex(expm1_re - 2.0 * r * sine * sine, 2.0 * r * sine * np.cos(0.5 * im))
    n, modulus = loop.n_plus_1 - 1.0, np.exp((loop.n_plus_1 - 1.0) * re)
    z_to_n = make_complex(modulus * np.cos(n * im), modulus * np.sin(n * im))
    return expand_taylor(z_minus_1, z_to_n, loop, fractional, N_TERMS)


def enclose_poles(re: np.ndarray, im: np.ndarray, cells: Cells, fractional: bool, accuracy: float) -> EnclosedPole:
    """Choose the circle on which ``|A|`` exceeds ``|tau|`` by the largest factor R, and bound the errors (C2, C3).

    The poles of the walls of a cell solve A(u) = tau(u). |A| is bounded from below by the magnitude of its linear term
    minus those of all other terms. If this bound exceeds |tau| on a circle, the circle encloses exactly one pole of
    each wall.

    Args:
        re: log |z0| for each center z0.
        im: arg z0 for each center z0.
        cells: The cells.
        fractional: Whether the delays are fractional.
        accuracy: Largest error of log radii.

    Returns:
        The poles. If no circle encloses a pole, its error is infinite and its order is ``len(ORDERS)``.
    """
    loop, orders = cells.loop, np.arange(N_TERMS + 1)
    a, f, (abs_z_minus_1, abs_z_minus_c, abs_q0, rho, abs_late) = _expand_taylor(re, im, loop, fractional)
    r, abs_f, sizes, abs_w = np.exp(re), np.abs(f), np.abs(a), np.exp(-re)
    limit = 1.0 / np.maximum(1.0, np.maximum(rho, abs_late) if fractional else rho)
    largest = np.minimum(2.0 / loop.n_plus_1, 0.4 * limit)
    disk = largest * CIRCLE_RADII[:, None]
    # Bound the remainder of the Taylor series of A by a majorant of A on a wider disk, which follows from the moduli of
    # the factors of A.
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
    # Add a bound of the rounding error of evaluating A, as for P in `stability.rigid.dominant.steps`.
    rounding = 2.0**-52 * (16.0 + loop.n_plus_1 * (np.abs(re) + im))
    remainder += rounding * (total + 2.0 * (np.abs(loop.alpha) + np.abs(loop.beta) * abs_f))
    main_term = sizes[1] * disk
    low = 2.0 * main_term - total - remainder
    ratio = low / (cells.a + cells.b * (abs_f + abs_w * disk / (1.0 - disk)))
    score = np.where(ratio > 1.02, ratio / (1.0 + 1e3 / accuracy * remainder / low), 0.0)
    # The error of a mean over the points of a circle is bounded by the integrand on a smaller and on a larger circle,
    # between which no pole may lie (C3); require that both circles exist. If R exceeds AMPLE_RATIO, prefer a smaller
    # circle, because it is farther from the singularities outside.
    offset, cell_index = CIRCLE_OFFSET, np.arange(re.size)
    rank = np.minimum(score, AMPLE_RATIO) * (1.0 + 0.01 * np.arange(CIRCLE_RADII.size)[:, None])
    best = (rank[offset:-offset] * (score[: -2 * offset] > 0) * (score[2 * offset :] > 0)).argmax(0) + offset
    chosen = best, cell_index
    spread, alias = np.log(main_term / low) - np.log1p(-1.0 / ratio), np.full(re.size, np.inf)
    for step in (offset, offset + 1):
        outer, inner = np.maximum(best - step, 0), np.minimum(best + step, CIRCLE_RADII.size - 1)
        between = (outer + inner == 2 * best) & (np.minimum(score[outer, cell_index], score[inner, cell_index]) > 0)
        # Bound the error of the means of powers of tau/A. The mean for the constant term, the pole at the center of the
        # cell, may have an error that is larger by a factor of up to the number of points.
        missed = 2.0 ** (-0.5 * step * N_POINTS) * (1 + N_POINTS)
        missed = missed * (4.5 * spread[outer, cell_index] + spread[inner, cell_index])
        alias = np.where(between, np.fmin(alias, missed), alias)
    # Require that the circle around a complex center does not reach the real axis. For a real center no such condition
    # is needed, because a single pole inside its circle is real.
    disk_chosen = disk[chosen]
    is_enclosed = (score[chosen] > 0) & ((im == 0.0) | (im == np.pi) | (np.sin(im) > disk_chosen))
    inverse, power = 1.0 / ratio[chosen], np.array(ORDERS)[:, None] + 1
    remainder_share = remainder[chosen] / (low[chosen] * (1.0 - inverse))
    error = inverse**power / (power * (1.0 - inverse)) + remainder_share / (1.0 - remainder_share) + alias + ROUNDING
    error = error * (disk_chosen / (1.0 - disk_chosen)) + ROUNDING * np.abs(re)
    error = np.where(is_enclosed & (remainder_share < 0.5), error, np.inf)
    # Compute ``farthest``, a lower bound of log |z/z0| for the poles z of all walls of the cell (C5).
    reach = 1.0 / ratio + sizes[0] / low
    farthest = np.where((ratio > 1.02) & (reach < 0.98), np.log1p(-reach) * disk / (1.0 - disk), -np.inf).max(0)
    allowed = np.minimum(accuracy, RATE_ACCURACY * np.maximum(np.abs(re) + farthest, MIN_LOG_RADIUS))
    return EnclosedPole(re, im, a, f, disk_chosen, re + farthest, error, (~(error <= allowed)).sum(0))


def _compute_powers(x: Any, count: int, factor: Any) -> np.ndarray:
    """Return the products ``factor x^k``, k = 0, 1, ..., for complex points x.

    Args:
        x: Complex points, shape (cells, points).
        count: Number of powers.
        factor: Factor of all powers.

    Returns:
        Real array of shape (cells, powers, 2 points), in which real and imaginary parts alternate along the last axis.
    """
    powers = np.empty((count, *x.shape), complex)
    powers[0], computed = factor, 1
    while computed < count:
        np.multiply(powers[: min(computed, count - computed)], x, out=powers[computed : 2 * computed])
        computed, x = 2 * computed, x * x
    return powers.view(float).transpose(1, 0, 2)


def expand_log(pole: EnclosedPole, cells: Cells, order: int, with_angle: bool) -> list[np.ndarray]:
    """Return the coefficients of the series of re in eta and xi (C1); if ``with_angle`` is True, also those of im."""
    powers, u = np.arange(N_TERMS + 1), pole.disk[:, None] * POINTS
    coefficients = (pole.a * pole.disk ** powers[:, None]).T
    inverse = 1.0 / np.fft.ifft(coefficients, N_POINTS, norm="forward")
    log_derivative = np.fft.ifft(coefficients * powers, N_POINTS, norm="forward") * inverse
    change = expand_wall(cells.a[:, None], cells.b[:, None])
    powers_xi = _compute_powers(np.conj(change.alpha * inverse), order + 1, 1.0).transpose(0, 2, 1)
    # Compute f = 1 - 1/z at z = z0 (1 + u) from f(z0), because 1/z0 = 1 - f(z0).
    base = change.beta * inverse * (pole.f[:, None] + (1.0 - pole.f[:, None]) * (u / (1.0 + u)))
    orders, weight = np.arange(order + 1), u / ((1.0 + u) * N_POINTS)
    binomials = np.where(orders[:, None] + orders <= order, BINOMIAL_WEIGHTS[: order + 1, : order + 1], 0.0)
    # Compute the constant term separately, because the weights (C1) do not apply to it. The constant term is log z of
    # the wall at the center of the cell.
    center = np.log1p(pole.disk * (log_derivative * (POINTS / N_POINTS)).sum(1))
    # Compute the real part of a complex sum as a product of real arrays. For the imaginary part, multiply the sum by -j
    # first, because the real part of -j x is the imaginary part of x.
    all_series = []
    for factor, constant in ((1.0, pole.re + center.real), (-1j, pole.im + center.imag))[: 1 + with_angle]:
        series = _compute_powers(base, order + 1, factor * weight) @ powers_xi * binomials
        series[:, 0, 0] = constant
        all_series.append(series)
    if with_angle:
        # Set im to exactly 0 or pi if the center is real, because the pole is then real for every wall of the cell
        # (C2).
        all_series[1][pole.is_real] = 0.0
        all_series[1][pole.is_real, 0, 0] = pole.im[pole.is_real]
    return all_series
