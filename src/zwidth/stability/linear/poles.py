"""Compute all closed-loop poles and the spectral radius of walls in any linear loop.

Poles are the zeros z of the characteristic polynomial P, stored as ``zeta = z - 1``. With the offsets 1 - root of the
open loop, t for its poles and b for its zeros,

    P = z^lag prod(zeta + t) Q + gain prod(zeta + b) (alpha Q + beta R),     F = R/Q

with the numerator R and the denominator Q of the velocity estimate F. Companion eigenvalues are the starting values of
Aberth's method (Aberth 1973, Math. Comp. 27). It uses the factored form of P, because the coefficients of P lose the
significant digits of poles near z = 1. For the same reason, poles are stored as zeta. For long delays the spectral
radius is found by counting the poles in circles (`numerics.pole_counting`), at a cost that does not depend on the
delay.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.types import Array
from zwidth.core.xp import within
from zwidth.model.circle_functions import Jet
from zwidth.model.estimate import Estimate
from zwidth.numerics.pole_counting import count_poles
from zwidth.numerics.polynomials import abs2, companion, compute_aberth_step
from zwidth.stability.linear.roots import LoopRoots, affine_polynomial, factor_open_loop
from zwidth.units.quantities import MOST_POLES, WALL_RANGE

# Aberth's method for the poles
MAX_STEPS = 60
CONVERGED_STEP = 4e-16  # last step of a pole, relative to |zeta|
LONGEST_STEP = 0.5  # largest |step| of zeta; longer steps are shortened to this

# Limits for the restart of poles that did not converge.
NEAR_ONE = 1e-6  # |zeta| below which eigenvalues have no significant digits
UNCONVERGED_STEP = 1e-3  # step of a pole, relative to |zeta|, above which the pole has not converged
MAX_RESTARTS = 4

REAL_TOLERANCE = 1e-13  # imaginary part of a real pole, relative to |zeta|; smaller imaginary parts are rounding errors
BLOCK_SIZE = 1 << 20  # values per block of walls; eigenvalues and pole differences take order^2 values per wall


class FactoredValue(NamedTuple):
    """The polynomial P, its derivative, and the sum of the magnitudes of its terms, which scales its rounding error."""

    value: Array
    slope: Array
    size: Array


def _product(zeta: Array, offsets: Array, factor: float = 1.0) -> Jet:
    """Return the product of ``factor`` and all ``zeta + offset``, and its derivative in zeta = z - 1."""
    product = Jet(np.full_like(zeta, factor), np.zeros_like(zeta))
    for offset in offsets:
        product = product.times(Jet(zeta + offset, 1.0))
    return product


def _power(zeta: Array, exponent: int) -> Jet:
    """Return ``z^exponent`` and its derivative in z, from zeta = z - 1."""
    lower = (1.0 + zeta) ** (exponent - 1) if exponent else np.ones_like(zeta)
    return Jet(lower * (1.0 + zeta) if exponent else lower, exponent * lower)


def _difference(zeta: Array, window: int) -> Jet:
    """Return ``(z^window - 1)/window`` and its derivative in z, from zeta = z - 1."""
    power, slope = _power(zeta, window)
    log_z = 0.5 * np.log1p(np.maximum(2.0 * zeta.real + abs2(zeta), -0.999))
    exponent = window * (log_z + 1j * np.arctan2(zeta.imag, 1.0 + zeta.real))
    # Near z = 1 use expm1 of window log(z), because the subtraction of 1 from z^window would lose significant digits.
    near = np.abs(exponent) < 1.0
    small = np.where(near, exponent, 0.0)
    return Jet(np.where(near, np.expm1(small), power - 1.0) / window, slope / window)


def log_modulus(zeta: Array) -> Array:
    """Return ``log|z|`` with full relative accuracy for poles near z = 1."""
    with np.errstate(divide="ignore"):
        return 0.5 * np.log1p(np.maximum(2.0 * zeta.real + abs2(zeta), -1.0))


def evaluate_polynomial(loop: LoopRoots, alpha: Array, beta: Array, zeta: Array) -> FactoredValue:
    """Return the polynomial P, its derivative in zeta and the scale of its rounding error; the arrays broadcast."""
    f = loop.estimate
    delay = f.window + f.lag
    g_denominator = _product(zeta, loop.poles).times(_power(zeta, loop.lag))
    g_numerator = _product(zeta, loop.free_zeros, loop.gain)
    at_zero = _power(zeta, max(delay, 0))
    Q = _product(zeta, f.poles).times(at_zero)
    R = _product(zeta, f.zeros, float(f.gain))
    if f.window:
        R = R.times(_difference(zeta, f.window))
    R = R.times(_power(zeta, max(-delay, 0)))
    wall = Jet(alpha * Q.value + beta * R.value, alpha * Q.slope + beta * R.slope)
    free = _product(zeta, loop.free_poles).times(at_zero) if loop.shared else Q
    first, second = g_denominator.times(free), g_numerator.times(wall)
    size = np.abs(first.value) + np.abs(g_numerator.value) * (np.abs(alpha * Q.value) + np.abs(beta * R.value))
    return FactoredValue(first.value + second.value, first.slope + second.slope, size)


def find_poles(loop: LoopRoots, alpha: Array, beta: Array) -> Array:
    """Return zeta of all poles of each wall by Aberth's method, as an array of shape (walls, order)."""
    D, N1, N2 = affine_polynomial(loop)
    # Divide by the leading coefficient of each wall. It depends on the wall if G has as many zeros as poles, for
    # example if a simulated tool is integrated by the implicit Euler method; otherwise it is D[0].
    polynomials = D + alpha[:, None] * N1 + beta[:, None] * N2
    monic = polynomials / polynomials[:, :1]
    zeta = np.linalg.eigvals(companion(monic)) - 1.0 + 0j
    _refine_poles(loop, alpha, beta, zeta, np.arange(len(zeta)))
    # Aberth's steps keep real approximations real and complex pairs complex. They do not converge if rounding errors
    # have turned two nearly equal real poles into a complex pair of eigenvalues, or vice versa. Therefore multiply
    # approximations that have not converged by different complex factors, and repeat.
    for restart in range(MAX_RESTARTS):
        P = evaluate_polynomial(loop, alpha[:, None], beta[:, None], zeta)
        with np.errstate(all="ignore"):
            step = compute_aberth_step(zeta, P.slope / P.value)
        is_far = (np.abs(step) > UNCONVERGED_STEP * np.abs(zeta)) | (np.abs(zeta) < NEAR_ONE)
        unconverged = (np.abs(P.value) > 1e-10 * P.size) & is_far
        if not unconverged.any():
            break
        zeta *= np.where(unconverged, 1.0 + 0.3 * np.exp(2.4j * (np.arange(zeta.shape[1]) + restart)), 1.0)
        _refine_poles(loop, alpha, beta, zeta, np.flatnonzero(unconverged.any(1)))
    return zeta


def _refine_poles(loop: LoopRoots, alpha: Array, beta: Array, zeta: Array, walls: Array) -> None:
    """Refine the poles ``zeta`` of the walls with the indices ``walls`` in place, until Aberth's steps converge."""
    for _ in range(MAX_STEPS):
        if not walls.size:
            break
        current = zeta[walls]
        P = evaluate_polynomial(loop, alpha[walls, None], beta[walls, None], current)
        with np.errstate(all="ignore"):
            step = compute_aberth_step(current, P.slope / P.value)
        # Skip the step of a pole at which |P| is below its rounding error, because such a step would be random.
        is_significant = np.isfinite(step) & (np.abs(P.value) > 1e-16 * P.size)
        step = np.where(is_significant, step, 0.0)
        step *= LONGEST_STEP / np.maximum(np.abs(step), LONGEST_STEP)
        zeta[walls] = current - step
        walls = walls[(np.abs(step) > CONVERGED_STEP * np.abs(current)).any(1)]


def compute_poles_minus_one(loop: LoopRoots, alpha: Array, beta: Array) -> Array:
    """Return ``zeta = z - 1`` of all poles of walls.

    Args:
        loop: the loop without a wall.
        alpha: normalized stiffness, any shape.
        beta: normalized damping, the same shape.

    Returns:
        Array of shape ``(*alpha.shape, order)``; NaN for walls out of range.

    Raises:
        InputError: if the loop has more than `MOST_POLES` poles.
    """
    order, shape = loop.order, alpha.shape
    if order > MOST_POLES:
        raise InputError(
            f"scene: got {order} poles, at most {MOST_POLES} are computed because more take minutes per wall; "
            "use spectral_radius or is_stable"
        )
    alpha, beta = alpha.reshape(-1), beta.reshape(-1)
    out = np.full((alpha.size, order), complex(np.nan, np.nan))
    in_range = np.flatnonzero(within(alpha, WALL_RANGE) & within(beta, WALL_RANGE))
    block = max(1, BLOCK_SIZE // order**2)
    for damped in (True, False):
        walls = in_range[(beta[in_range] != 0) == damped]
        for k in range(0, walls.size, block):
            part = walls[k : k + block]
            out[part] = find_poles(loop, alpha[part], beta[part]) if damped else _find_spring_poles(loop, alpha[part])
    # Set imaginary parts to 0 if they are rounding errors of real poles. Complex pairs are not affected, because the
    # imaginary part of a pair is at least about 1e-8, even close to a double real pole.
    out = np.where(np.abs(np.imag(out)) <= REAL_TOLERANCE * np.abs(out), np.real(out) + 0j, out)
    return out.reshape(*shape, order)


def _find_spring_poles(loop: LoopRoots, alpha: Array) -> Array:
    """Return zeta of all poles of walls with beta = 0.

    The velocity estimate then has no effect on the force, and its own poles are poles of the closed loop.
    """
    f = loop.estimate
    filter_poles = np.concatenate([-loop.free_poles, -np.ones(max(f.window + f.lag, 0))])
    zeta = find_poles(replace(loop, estimate=Estimate(0), shared=0), alpha, np.zeros_like(alpha))
    return np.concatenate([zeta, np.broadcast_to(filter_poles, (alpha.size, filter_poles.size))], 1)


# A difference of two float64 values is treated as their rounding error below this fraction of their magnitudes.
CANCELLATION = 1e-14


def is_marginal(loop: LoopRoots, alpha: float, beta: float) -> bool:
    """Return whether a wall has a simple pole at exactly z = 1 and all other poles strictly inside the unit circle.

    The device then comes to rest, but at any position.
    """
    wall = np.array([alpha]), np.array([beta])
    P = evaluate_polynomial(loop, *wall, np.zeros(1, complex))
    undamped = evaluate_polynomial(loop, wall[0], 0.0 * wall[1], np.zeros(1, complex))
    # Treat P'(1) as 0 if it is not larger than its rounding error. The pole at z = 1 is then double, because the
    # negative damping of the wall cancels the damping of the device.
    terms = np.abs(undamped.slope[0]) + np.abs(P.slope[0] - undamped.slope[0])
    if P.value[0] != 0 or np.abs(P.slope[0]) <= CANCELLATION * terms:
        return False
    zeta = compute_poles_minus_one(loop, *wall)[0]
    return bool(np.all(log_modulus(np.delete(zeta, np.argmin(np.abs(zeta)))) < 0))


# If a loop has more poles than MAX_COMPUTED_POLES, counting them in circles is faster than computing all of them,
# except if the velocity window is longer than MAX_COUNTED_WINDOW samples. Such a window adds many zeros, which makes
# counting slow.
MAX_COMPUTED_POLES = 150
MAX_COUNTED_WINDOW = 40

# Search for the log radius by counts of the poles in circles.
N_CIRCLES = 16  # circles per call
MAX_ROUNDS = 24
BRACKET_WIDTH = 4e-16  # target width, relative to max(1, |log radius|)
MAX_BRACKET_WIDTH = 1e-6  # if the final bracket is wider, because counts were inconclusive, the result is NaN

# Search for the dominant pole on the circle whose radius is the spectral radius.
POINTS_PER_POLE = 8  # points on the half circle per pole at which P is evaluated
MAX_STARTS = 16  # points from which Newton's method starts
NEWTON_STEPS = 12
ON_CIRCLE = 1e-6  # largest difference between log|z| of the pole and the log radius

# Largest |log radius| at which the computed radius may contradict the result of the stability test. For a larger
# contradiction the radius is NaN, because either of the two may be wrong.
VERDICT_TOLERANCE = 1e-7


def compute_log_radius(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return the logarithm of the spectral radius of each wall, shape (walls,); NaN if it cannot be computed."""
    if loop.order <= MAX_COMPUTED_POLES or loop.estimate.window > MAX_COUNTED_WINDOW:
        return log_modulus(compute_poles_minus_one(loop, alpha, beta)).max(-1)
    return np.array([_bracket_log_radius(loop, a, b) for a, b in zip(alpha.tolist(), beta.tolist(), strict=True)])


def compute_dominant_poles(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``log|z|`` and the angle in rad, from 0 to pi, of the dominant pole of each wall; NaN if not computed."""
    if loop.order > MAX_COMPUTED_POLES and loop.estimate.window <= MAX_COUNTED_WINDOW:
        log = compute_log_radius(loop, alpha, beta)
        angles = [_find_angle(loop, *wall) for wall in zip(alpha.tolist(), beta.tolist(), log.tolist(), strict=True)]
        return log, np.array(angles)
    zeta = compute_poles_minus_one(loop, alpha, beta)
    dominant = np.take_along_axis(zeta, log_modulus(zeta).argmax(-1)[:, None], -1)[:, 0]
    return log_modulus(dominant), np.arctan2(np.abs(np.imag(dominant)), 1.0 + np.real(dominant))


def _find_angle(loop: LoopRoots, alpha: float, beta: float, log_radius: float) -> float:
    """Return the angle of a pole with a known log|z|, by Newton's method; NaN if the method does not converge."""
    if not np.isfinite(log_radius):
        return np.nan
    angles = np.linspace(0.0, np.pi, POINTS_PER_POLE * loop.order)
    zeta, evaluate = np.expm1(log_radius + 1j * angles), partial(evaluate_polynomial, loop, *np.array([alpha, beta]))
    with np.errstate(all="ignore"):
        P = evaluate(zeta)
        distance = np.abs(P.value / P.slope)
        inner = np.pad(distance, 1, constant_values=np.inf)
        minima = np.flatnonzero((distance <= inner[:-2]) & (distance <= inner[2:]))
        zeta = zeta[minima[np.argsort(distance[minima])[:MAX_STARTS]]]
        for _ in range(NEWTON_STEPS):
            P = evaluate(zeta)
            zeta = zeta - P.value / P.slope
        P = evaluate(zeta)
        misfit = np.where(np.abs(P.value) < 1e-10 * P.size, np.abs(log_modulus(zeta) - log_radius), np.inf)
    k = np.argmin(np.where(np.isnan(misfit), np.inf, misfit))
    re, im = np.real(zeta)[k], np.abs(np.imag(zeta)[k])
    im = 0.0 if im <= REAL_TOLERANCE * np.abs(re) else im
    return float(np.arctan2(im, 1.0 + re)) if misfit[k] < ON_CIRCLE else np.nan


def agree_with_verdict(log: np.ndarray, stable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the spectral radius of each wall, below 1 if and only if ``stable`` is True, and its logarithm.

    If a wall is on the stability boundary within rounding errors, the computed radius may contradict ``stable``. The
    radius is then 1, or the next smaller float64 for a stable wall.

    Args:
        log: computed log radius, shape (walls,).
        stable: True for stable walls, shape (walls,).

    Returns:
        Arrays of shape (walls,); NaN for a contradiction larger than `VERDICT_TOLERANCE`.
    """
    log = np.where((log < 0) != stable, np.where(np.abs(log) < VERDICT_TOLERANCE, 0.0, np.nan), log)
    radius = np.exp(log)
    return np.where(stable, np.minimum(radius, np.nextafter(1.0, 0.0)), radius), log


def spectral_radius(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray, stable: np.ndarray) -> np.ndarray:
    """Return the spectral radius ``max|z|`` of each wall, below 1 if and only if ``stable`` is True."""
    return agree_with_verdict(compute_log_radius(loop, alpha, beta), stable)[0]


def _bracket_log_radius(loop: LoopRoots, alpha: float, beta: float) -> float:
    """Return the log of the spectral radius of one wall, by narrowing a bracket with counts of poles in circles."""
    if not (np.isfinite(alpha) and np.isfinite(beta)):
        return np.nan
    zeros, poles, gain, lag = factor_open_loop(loop, alpha, beta)
    order = poles.size + lag
    low, high = -1.0, 1.0
    for round_ in range(MAX_ROUNDS):
        # In the first rounds, also count the poles at both ends of the bracket, because it may have to be enlarged.
        logs = np.linspace(low, high, N_CIRCLES + 2)[0 if round_ < 3 else 1 : None if round_ < 3 else -1]
        with np.errstate(all="ignore"):
            counts = count_poles(zeros, poles, gain, lag, np.exp(logs))
        above, below = logs[counts == order], logs[(counts >= 0) & (counts < order)]
        if not above.size and round_ < 3 and below.size:
            low, high = high, 8.0 * high
            continue
        if not below.size and round_ < 3 and above.size:
            low, high = 8.0 * low, low
            continue
        if not above.size and not below.size:
            break
        low, high = max([low, *below]), min([high, *above])
        if high - low <= BRACKET_WIDTH * max(1.0, abs(high)):
            break
    return 0.5 * (low + high) if high - low <= MAX_BRACKET_WIDTH else np.nan
