"""Compute the largest stable environment stiffness of admittance displays, for many displays at once.

A display has the virtual mass M and damping D; the environment has the stiffness K and the damping B. The
characteristic polynomial is ``M p_M + D p_D + K p_K + B p_B`` (`zwidth.analysis.admittance_loop`). With
``z = e^(jw)`` and u_M = -p_M/p_K, u_D = -p_D/p_K, u_B = -p_B/p_K, a pole is at the angle w on the unit circle if

    K = M u_M(w) + D u_D(w) + B u_B(w)

is real. The angles w at which this sum is real are the *crossings*. In ``x = cos w`` they are the roots of a real
polynomial, because the imaginary part of ``p(z) p_K(1/z)`` is sin w times a sum of Chebyshev polynomials U_k(x), and
its coefficients are affine in M, D and B. The smallest positive K of all crossings is the limit if the display is
stable with smaller K (docs/theory/admittance.md, W5).

References:
    Good 1961, Quarterly Journal of Mathematics 12(1), 61-68 (colleague matrix, whose eigenvalues are the roots of a
    Chebyshev series).
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.analysis.admittance_loop import KEPT_LOOPS, AdmittanceLoop, to_zeta
from zwidth.core.status import Status
from zwidth.model.exact_polynomials import Polynomial
from zwidth.numerics.polynomials import companion

BLOCK = 4096  # largest number of displays per call of the eigenvalue solver; bounds the memory
NEWTON_STEPS = 8  # Newton steps for the angle of a crossing; 3 suffice after the eigenvalue solver
STEP = 1e-5  # relative step of the angle w for the numerical derivative in Newton's method
RESIDUAL = 1e-9  # largest |Im K|/|K| at a computed crossing; K is real at an exact crossing
# Imaginary part of a root x = cos w, relative to its distance from 1 or -1, below which it is unclear whether x is real
NEAR_REAL = 1e-3
# Smallest distance of a computed pole z from the unit circle, relative to |z - 1|, that exceeds its rounding error
CLEARANCE = 1e-6
LARGEST_DEGREE = 30  # largest degree of a characteristic polynomial whose roots are computed as eigenvalues
NEGLIGIBLE = 1e-18  # coefficients of a Chebyshev series below this, relative to the largest one, are rounding errors
TESTED = (1 / 16, 1 / 2, 15 / 16)  # tested fractions of the computed limit; stability must be the same at all three
# Angles w in rad per period at which the sign of Im K is tested, to find missing crossings (`_confirm_angles`)
NODES = np.concatenate([np.geomspace(1e-6, 0.3, 120), np.linspace(0.3, np.pi - 1e-6, 121)[1:]])


class Limits(NamedTuple):
    """Largest stable environment stiffness K of many displays, as arrays of equal shape; NaN without a stable K."""

    stiffness: np.ndarray  # K in N/m
    angle: np.ndarray  # angle w in rad per period of the oscillation at K
    status: np.ndarray  # code of OK, NO_BOUNDARY, or UNDECIDED (another method must compute the limit)


def find_limits(loop: AdmittanceLoop, M: np.ndarray, D: np.ndarray, B: np.ndarray) -> Limits:
    """Return the largest K such that a display is stable from 0 to K, for each entry of the vectors M, D and B."""
    if len(loop.coefficients.mass) > LARGEST_DEGREE + 1:
        unknown = np.full(len(M), np.nan)
        return Limits(unknown, unknown.copy(), np.full(len(M), int(Status.UNDECIDED)))
    series, polynomials = _convert(loop)
    factors = np.stack([M, D, B], -1)
    results = [
        _find_block(loop, series, polynomials, factors[start : start + BLOCK])
        for start in range(0, max(len(M), 1), BLOCK)
    ]
    return Limits(*(np.concatenate(column) for column in zip(*results, strict=True)))


@lru_cache(KEPT_LOOPS)
def _convert(loop: AdmittanceLoop) -> tuple[np.ndarray, np.ndarray]:
    """Return two matrices of polynomial coefficients that do not depend on M, D and B, with one row per polynomial.

    The rows of the first matrix are the Chebyshev coefficients of ``Im(p(z) p_K(1/z))/sin w`` for p = p_M, p_D and p_B.
    Those of the second matrix are the coefficients of p_M, p_D, p_B and p_K in powers of zeta = z - 1.
    """
    mass, damping, stiffness, environment_damping = loop.coefficients
    parts = mass, damping, environment_damping
    series = _stack([_expand_crossings(part, stiffness) for part in parts], at_end=True)
    return series, _stack([np.array(to_zeta(part), float) for part in (*parts, stiffness)], at_end=False)


def _find_block(loop: AdmittanceLoop, series: np.ndarray, polynomials: np.ndarray, factors: np.ndarray) -> Limits:
    """Return the largest stable K of each display of a block; ``factors`` has one row (M, D, B) per display."""
    coefficients = factors @ series
    with np.errstate(all="ignore"):
        angles, is_ambiguous = _find_angles(coefficients)
        angles = _refine(loop, factors, angles)
        is_ambiguous |= ~_confirm_angles(coefficients, angles)
        angles = np.concatenate([angles, np.full((len(factors), 1), np.pi)], -1)
        K = _evaluate(loop, factors, angles)
        is_crossing = (np.abs(K.imag) <= RESIDUAL * np.abs(K)) & (K.real > 0) & np.isfinite(K)
        candidates = np.where(is_crossing, K.real, np.inf)
    best = candidates.argmin(-1)[:, None]
    limit, angle = (np.take_along_axis(each, best, -1)[:, 0] for each in (candidates, angles))
    is_known = np.isfinite(limit) & ~is_ambiguous
    tested = np.where(is_known, limit, 1.0)
    labels = np.array([_label_poles(polynomials, factors, fraction * tested) for fraction in TESTED])
    is_stable, is_unstable = is_known & (labels > 0).all(0), is_known & (labels < 0).all(0)
    status = np.where(is_stable, Status.OK, np.where(is_unstable, Status.NO_BOUNDARY, Status.UNDECIDED))
    return Limits(np.where(is_stable, limit, np.nan), np.where(is_stable, angle, np.nan), status)


def _confirm_angles(coefficients: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return True for each display whose computed angles agree with the sign of the Chebyshev series at `NODES`.

    Between two neighboring nodes, the number of angles at which the series is 0 must be odd if and only if its sign
    changes. The check is needed, because the eigenvalue solver may miss such angles if the coefficients of the series
    differ by many orders of magnitude.
    """
    # Evaluate the series times sin w, which is a sum of sin((k + 1) w); sin w > 0 does not change the sign.
    values = coefficients @ np.sin(np.outer(np.arange(1, coefficients.shape[1] + 1), NODES))
    changes = np.signbit(values[:, 1:]) != np.signbit(values[:, :-1])
    between = (angles[:, :, None] > NODES[:-1]) & (angles[:, :, None] <= NODES[1:])
    return np.all((between.sum(1) % 2 == 1) == changes, -1)


def _expand_crossings(p: Polynomial, p_K: Polynomial) -> np.ndarray:
    """Return the coefficients of the Chebyshev polynomials U_0, U_1, ... in ``Im(p(z) p_K(1/z))/sin w``, z = e^(jw)."""
    ascending, other = p[::-1], p_K[::-1]
    size = max(len(ascending), len(other), 1)
    sums = [Fraction(0)] * size
    for i, a in enumerate(ascending):
        for j, b in enumerate(other):
            # For z = e^(jw), the imaginary part of z^(i - j) is sin((i - j) w) = sin w U_(i - j - 1)(cos w).
            if i != j:
                sums[abs(i - j) - 1] += a * b if i > j else -a * b
    return np.array(sums, float)


def _stack(rows: list[np.ndarray], *, at_end: bool) -> np.ndarray:
    """Return a matrix of rows that are padded with zeros, after the entries if ``at_end`` is True, else before them."""
    size = max(map(len, rows))
    return np.array([np.pad(row, (0, size - len(row)) if at_end else (size - len(row), 0)) for row in rows])


def _find_angles(series: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles w at which K is real, per display and padded with NaN, and True if their number is unclear.

    Args:
        series: coefficients of the Chebyshev polynomials U_0, U_1, ..., one row per display.
    """
    # Omit negligible coefficients of the highest orders, because the last coefficient is a divisor below.
    size = np.abs(series)
    used = np.flatnonzero((size > NEGLIGIBLE * size.max(-1, keepdims=True)).any(0))
    series = series[:, : used[-1] + 1] if used.size else series[:, :1]
    count, top = series.shape[1] - 1, series[:, -1:]
    is_invalid = (top[:, 0] == 0) | ~np.isfinite(series).all(-1)
    # Build the colleague matrix, whose eigenvalues are the roots x, from x U_k = (U_(k+1) + U_(k-1))/2 in row k.
    # In the last row, eliminate U_(k+1) by setting the Chebyshev series to 0.
    matrix = np.zeros((len(series), count, count))
    matrix += (np.eye(count, k=1) + np.eye(count, k=-1)) / 2.0
    if count:
        matrix[:, -1] -= np.where(is_invalid[:, None], 0.0, series[:, :-1] / top) / 2.0
    x: Any = np.linalg.eigvals(matrix) + 0j
    distance = np.minimum(np.abs(1.0 - x), np.abs(1.0 + x))
    is_real = (x.imag == 0) & (np.abs(x.real) < 1.0)
    is_near = ~is_real & (np.abs(x.imag) < NEAR_REAL * distance) & (np.abs(x.real) < 1.0)
    return np.where(is_real, np.arccos(np.clip(x.real, -1, 1)), np.nan), is_invalid | is_near.any(-1)


def _evaluate(loop: AdmittanceLoop, factors: np.ndarray, angles: np.ndarray) -> Any:
    """Return the stiffness K of the environment, in general complex, with which a pole is at e^(jw), for angles w.

    ``factors`` has a row (M, D, B) per row of ``angles``.
    """
    zeta = np.expm1(1j * angles)
    robot, program = loop.sampled_robot, loop.program

    def at(polynomial: Polynomial) -> np.ndarray:
        return np.polyval(np.array(polynomial, float), zeta) if polynomial else np.zeros_like(zeta)

    M, D, B = (factors[:, k : k + 1] for k in range(3))
    by_program = (M * at(program.mass) + D * at(program.damping)) / at(program.numerator)
    by_robot = np.exp(1j * robot.lag * angles) * at(robot.denominator)
    return -(by_program * by_robot + B * at(robot.velocity)) / at(robot.position)


def _refine(loop: AdmittanceLoop, factors: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Refine the angles at which K is real by Newton's method, so that the imaginary part of K becomes 0."""
    for _ in range(NEWTON_STEPS):
        low, high = angles * (1.0 - STEP), angles * (1.0 + STEP)
        slope = (_evaluate(loop, factors, high) - _evaluate(loop, factors, low)).imag / (high - low)
        angles = np.clip(angles - _evaluate(loop, factors, angles).imag / slope, 0.0, np.pi)
    return angles


def _label_poles(polynomials: np.ndarray, factors: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Return 1 for stable displays, -1 for unstable ones, and 0 if a pole is too close to the unit circle to decide.

    Args:
        polynomials: coefficients of p_M, p_D, p_B and p_K, in powers of zeta.
        factors: a row (M, D, B) per display.
        K: stiffness of the environment, one per display.
    """
    monic = np.concatenate([factors, K[:, None]], -1) @ polynomials
    monic = monic / monic[:, :1]
    is_valid: Any = np.isfinite(monic).all(-1)
    # Compute zeta = z - 1 of the poles z, because eigenvalues near 0 are more accurate than eigenvalues near 1.
    zeta: Any = np.linalg.eigvals(companion(np.where(is_valid[:, None], monic, 0.0)))
    excess, bound = 2.0 * zeta.real + np.abs(zeta) ** 2, CLEARANCE * np.abs(zeta)  # excess is |z|^2 - 1
    is_stable, is_unstable = (excess < -bound).all(-1), (excess > bound).any(-1)
    return np.where(is_valid, is_stable * 1.0 - is_unstable * 1.0, 0.0)
