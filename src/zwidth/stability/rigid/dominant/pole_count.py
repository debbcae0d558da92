"""Count the poles outside a circle |z| = r by the argument principle, from the gain crossovers on that circle.

The poles are the zeros of P = T + B. A *crossover* is a point of the circle with |T| = |B|, given by x = sin^2(w/2) at
z = r e^(j w). T and B have the factors of `stability.rigid.characteristic_polynomial`; the zeros of M are real and not
positive. For 0 < w < pi, the squared modulus of each factor is linear in x, and the imaginary part of the factor does
not change its sign. Therefore

- |T|^2 - |B|^2 is a quadratic in x for integer delays and a cubic for fractional ones; its zeros are the crossovers;
- the principal values of all arguments are continuous in w, so that no phase has to be unwrapped.

The number of poles inside follows from the phase difference arg T - arg B at each crossover
(docs/theory/one-crossover.md, Theorem 4). The circle is given by log r, because r itself cannot distinguish circles
very close to the unit circle. `count_poles_in_cell` counts for all walls of a *cell*, a rectangle in the (alpha, beta)
plane, at once (docs/theory/maps.md, C4).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import angle, apply_each, epsilon, invert_haversine, iterate, namespace
from zwidth.stability.rigid.characteristic_polynomial import CircleFactors, LoopFactors, expand_on_circle
from zwidth.stability.rigid.crossover import find_first_root

# Largest number of steps of the bracketed iteration for a zero of the cubic |T|^2 - |B|^2.
CUBIC_STEPS = 6
# Factor that enlarges the bounds on the changes within a cell, to cover the rounding errors of these bounds.
WIDENING = 1.0 + 1e-12
# For the walls of a cell, the angle w of a crossover varies within an interval. This interval is divided into four
# equal pieces, and the phase change is bounded on each piece. PIECE_POINTS are the ends (even indices) and the
# midpoints (odd indices) of the pieces, as fractions of the interval.
PIECE_POINTS = np.arange(9)[:, None, None] / 8.0


class _Circle(NamedTuple):
    """The factors of T and B on one circle |z| = r, and |T|^2 - |B|^2 as a polynomial in x = sin^2(w/2).

    T and B are divided by the larger of r^(1+n) and 1.
    """

    r: Array
    r_minus_1: Array
    r_minus_c: Array
    wall: Array  # W at z = r, i.e. s r - beta
    numerator: Array  # a2 z + h at z = r
    factors: CircleFactors
    h: tuple[Array, Array, Array, Array]  # |T|^2 - |B|^2, lowest power of x first
    at_start: tuple[Array, Array]  # |T| and |B| at x = 0, i.e. z = r
    at_end: tuple[Array, Array]  # |T| and |B| at x = 1, i.e. z = -r
    terms: tuple[Array, ...]  # coefficients in x of |T|^2 and of an upper bound on |B|^2, for error bounds

    def sum_magnitudes(self, x: Array) -> Array:
        """Return |T|^2 plus an upper bound on |B|^2 at x, as the scale of the rounding error of |T|^2 - |B|^2."""
        t0, t1, c0, c1, m0, w0, w1 = self.terms
        return (t0 + t1 * x) * (c0 + c1 * x) + m0 * (w0 + w1 * x)

    def differentiate(self, x: Array) -> Array:
        """Return the derivative of |T|^2 - |B|^2 with respect to x."""
        return self.h[1] + x * (2.0 * self.h[2] + 3.0 * x * self.h[3])

    def evaluate(self, x: Array) -> Array:
        """Return |T|^2 - |B|^2 at x."""
        return self.h[0] + x * (self.h[1] + x * (self.h[2] + x * self.h[3]))


def _evaluate_on_circle(log_r: Array, loop: LoopFactors, fractional: bool, xp: Any) -> _Circle:
    """Compute the factors of T and B, and the coefficients of |T|^2 - |B|^2 in x, on the circle |z| = e^log_r."""
    r, r_minus_1 = xp.exp(log_r), xp.expm1(log_r)
    factors = expand_on_circle(r, r_minus_1, loop)
    (r_minus_c, c1), (wall, w1), (numerator, m1), (one_plus_ratio, g1) = factors[1:]
    power = loop.n_plus_1 * log_r
    smaller = xp.exp(-xp.abs(power))
    # Divide T and B by the larger of r^(1+n) and 1 to avoid overflow.
    device_scale, wall_scale = xp.where(power < 0, smaller, 1.0), xp.where(power < 0, 1.0, smaller)
    t0, t1 = device_scale * r_minus_1 * (device_scale * r_minus_1), factors.z_minus_1[1] * device_scale * device_scale
    c0, w0 = r_minus_c * r_minus_c, wall * wall
    m0, m1 = wall_scale * numerator * (wall_scale * numerator), m1 * wall_scale * wall_scale
    b0, b1, b2, b3 = m0 * w0, m0 * w1 + m1 * w0, m1 * w1, 0.0 * m0
    one_minus_ratio = 1.0 - loop.q / r if fractional else 1.0
    if fractional:
        g0 = one_plus_ratio * one_plus_ratio
        b0, b1, b2, b3 = b0 * g0, b1 * g0 + b0 * g1, b2 * g0 + b1 * g1, b2 * g1
        m0 = m0 * g0
    at_start = device_scale * xp.abs(r_minus_1 * r_minus_c), wall_scale * xp.abs(numerator * one_plus_ratio * wall)
    wall_at_end = (loop.h - loop.a2 * r) * one_minus_ratio * (wall + 2.0 * loop.beta)
    at_end = device_scale * (1.0 + r) * (loop.c + r), wall_scale * xp.abs(wall_at_end)
    h = (t0 * c0 - b0, t0 * c1 + t1 * c0 - b1, t1 * c1 - b2, -b3)
    return _Circle(
        r, r_minus_1, r_minus_c, wall, numerator, factors, h, at_start, at_end, (t0, t1, c0, c1, m0, w0, xp.abs(w1))
    )


def _find_quadratic_zeros(h0: Array, h1: Array, h2: Array, xp: Any) -> list[Array]:
    """Return both zeros of h0 + h1 x + h2 x^2 in ascending order; NaN if they are complex."""
    root = xp.sqrt(h1 * h1 - 4.0 * h0 * h2)
    half = -0.5 * (h1 + xp.where(h1 < 0, -root, root))
    one, other = half / h2, h0 / half
    # Set one zero to infinity if h2 = 0, and both zeros if h1 = 0 as well.
    one = xp.where(h2 == 0, np.inf, one)
    other = xp.where(half == 0, one, other)
    return [xp.minimum(one, other), xp.maximum(one, other)]


def _find_cubic_zeros(circle: _Circle, xp: Any) -> list[Array]:
    """Return the zeros of the cubic |T|^2 - |B|^2 in 0 < x < 1, one per interval between its extrema; NaN if none."""
    h0, h1, h2, h3 = circle.h
    low, high = _find_quadratic_zeros(h1, 2.0 * h2, 3.0 * h3, xp)
    low, high = (xp.where(xp.isfinite(x), xp.clip(x, 0.0, 1.0), 0.0) for x in (low, high))
    ends = [0.0 * h0, xp.minimum(low, high), xp.maximum(low, high), 0.0 * h0 + 1.0]
    values = [circle.evaluate(x) for x in ends]
    pieces = list(zip(ends[:-1], ends[1:], values[:-1], values[1:], strict=True))
    return apply_each(lambda piece: _find_zero_between(piece, circle, xp), pieces, xp)


def _find_zero_between(piece: tuple[Array, ...], circle: _Circle, xp: Any) -> Array:
    """Return the zero of the cubic |T|^2 - |B|^2 on an interval on which the cubic is monotone; NaN if it has no zero.

    In each step, the next iterate is the zero of the parabola with the value and first two derivatives of the cubic.

    Args:
        piece: Both ends of the interval, and the values of the cubic there.
        circle: The circle with the cubic.
        xp: Array namespace.
    """
    low, high, first, last = piece
    exists = (first < 0) != (last < 0)
    if xp is np and not np.any(exists):
        return low + np.nan
    falls = first > 0
    sign = xp.where(falls, -2.0, 2.0)

    def step(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, low, high = state
        value, slope, bend = circle.evaluate(x), circle.differentiate(x), 2.0 * circle.h[2] + 6.0 * x * circle.h[3]
        is_before_zero = (value > 0) == falls
        low, high = xp.where(is_before_zero, x, low), xp.where(is_before_zero, high, x)
        new = x - sign * value / (xp.abs(slope) + xp.sqrt(xp.maximum(slope * slope - 2.0 * value * bend, 0.0)))
        return xp.where((new >= low) & (new <= high), new, 0.5 * (low + high)), low, high

    def has_converged(old: tuple[Array, ...], new: tuple[Array, ...]) -> bool:
        return bool(np.all((old[0] == new[0]) | ~exists))

    x = iterate(CUBIC_STEPS, step, (xp.where(xp.abs(first) < xp.abs(last), low, high), low, high), xp, has_converged)[0]
    return xp.where(exists, x, np.nan)


def _find_only_zero(circle: _Circle, xp: Any) -> tuple[Array, Array]:
    """Return a zero x of |T|^2 - |B|^2, whose signs at x = 0 and 1 must differ, and whether it is the only one."""
    h0, h1, h2, h3 = circle.h
    sign = xp.where(h0 > 0, 1.0, -1.0)
    x = find_first_root(tuple([sign * h for h in circle.h]))
    # Given different signs at x = 0 and 1, the cubic has a single zero in (0, 1) if it is monotone or has only one
    # extremum in this interval. The four conditions are each sufficient for this. Require in addition that the
    # iteration has converged.
    is_only_zero = (
        (h2 * h2 < 3.0 * h1 * h3)
        | (h1 * circle.differentiate(1.0) < 0)
        | (xp.abs(h2) > 3.0 * xp.abs(h3))
        | (h2 * h3 > 0)
    )
    return x, is_only_zero & (xp.abs(circle.evaluate(x)) <= 8.0 * epsilon(x) * circle.sum_magnitudes(x))


def _evaluate_phase_difference(
    x: Array, circle: _Circle, loop: LoopFactors, fractional: bool, xp: Any
) -> tuple[Array, Array, Array]:
    """Return arg T - arg B at a crossover x, the angle w of the crossover, and a bound on |d(arg T - arg B)/dw|.

    The phase difference arg T - arg B is continuous in w from w = 0 on.
    """
    y = 1.0 - x
    im, drop = 2.0 * circle.r * xp.sqrt(x * y), 2.0 * circle.r * x
    re_z_minus_1, re_z_minus_c = circle.r_minus_1 - drop, circle.r_minus_c - drop
    sign = xp.where(loop.s < 0, -1.0, 1.0)
    wall_re, wall_im = sign * (circle.wall - loop.s * drop), sign * loop.s * im
    numerator_re, numerator_im = circle.numerator - loop.a2 * drop, loop.a2 * im
    # Compute the sum of two arguments: arg((z - 1)/(a2 z + h)), which is in (0, pi), and arg((z - c)/W), which is in
    # (-pi, pi). Add 2 pi to the principal value of the sum if the sum exceeds pi.
    p_re, p_im = re_z_minus_1 * numerator_re + im * numerator_im, im * numerator_re - re_z_minus_1 * numerator_im
    q_re, q_im = re_z_minus_c * wall_re + im * wall_im, im * wall_re - re_z_minus_c * wall_im
    v_re, v_im = p_re * q_re - p_im * q_im, p_re * q_im + p_im * q_re
    phase = angle(v_re, v_im)
    phase = xp.where((v_im < 0) & (q_im >= 0), phase + 2.0 * np.pi, phase)
    w = invert_haversine(x, y, xp)
    theta = loop.n_plus_1 * w + phase + xp.where(loop.s < 0, np.pi, 0.0)
    if fractional:
        # Subtract the argument of the factor 1 + q/z of B. It equals arg(z + q) - w and is in [-pi, 0], so that its
        # principal value is continuous.
        ratio = loop.q / circle.r
        theta = theta - angle(1.0 + ratio - 2.0 * ratio * x, -ratio * im / circle.r)
    # Bound the derivative of arg T - arg B in w by the sum of those of its terms. The derivative of arg(z - a) is the
    # real part of z/(z - a) = 1 + a/(z - a).
    rate = loop.n_plus_1 + 0.0 * x
    parts = [
        (1.0, re_z_minus_1, im),
        (loop.c, re_z_minus_c, im),
        (loop.h, numerator_re, numerator_im),
        (xp.abs(loop.beta), wall_re, wall_im),
    ]
    for zero, part, part_im in [*parts, (loop.q, circle.r - drop + loop.q, im)] if fractional else parts:
        rate = rate + zero / xp.maximum(xp.abs(part), part_im)
    return theta, w, rate


class PoleCount(NamedTuple):
    """The number of poles on or outside a circle, and whether this count is certain."""

    outside: Array  # number of poles that are not inside the circle
    certain: Array  # True if rounding errors cannot have changed the count
    crossovers: list[Array]  # angles w of the crossovers; arbitrary for crossovers that do not exist

    @property
    def all_inside(self) -> Array:
        """True if every pole is inside the circle."""
        return self.outside == 0


def count_poles(log_r: Array, loop: LoopFactors, fractional: bool, single: bool = False) -> PoleCount:
    """Count the poles that are not inside ``|z| = e^log_r``.

    Args:
        log_r: Logarithm of the radius of the circle.
        loop: Factors of P.
        fractional: Whether any delay is fractional.
        single: Assume that the circle has a single crossover (only for fractional delays). This halves the time. If the
            number of crossovers is not one, the count is marked as uncertain.

    Returns:
        The count, elementwise.
    """
    xp = namespace(log_r, loop.alpha)
    circle = _evaluate_on_circle(log_r, loop, fractional, xp)
    device_larger, device_larger_at_end = circle.at_start[0] > circle.at_start[1], circle.at_end[0] > circle.at_end[1]
    eps = epsilon(log_r)
    tolerance = 4.0 * eps * (loop.n_plus_1 + 8.0)
    certain = ~(_may_cancel(circle.at_start, tolerance) | _may_cancel(circle.at_end, tolerance))
    if single:
        x, is_only_zero = _find_only_zero(circle, xp)
        zeros = [xp.where(device_larger != device_larger_at_end, x, -1.0)]
        certain = certain & (device_larger != device_larger_at_end) & is_only_zero
    else:
        zeros = _find_cubic_zeros(circle, xp) if fractional else _find_quadratic_zeros(*circle.h[:3], xp)
    start, stop, _ = _evaluate_end_arguments(circle, loop, device_larger, device_larger_at_end)
    full_turns, crossovers = 0.0 * start, []
    valid_masks = [(x >= 0) & (x < 1.0) for x in zeros]
    zeros = [xp.where(valid, x, 0.5) for valid, x in zip(valid_masks, zeros, strict=True)]

    def evaluate_phase(x: Array) -> tuple[Array, Array, Array]:
        theta, w, rate = _evaluate_phase_difference(x, circle, loop, fractional, xp)
        # As the third result, return the error of theta = arg T - arg B that a rounding error of the crossover x
        # causes, in rounding units. This error is large if |T| and |B| have nearly the same slope at the crossover.
        return theta, w, rate * circle.sum_magnitudes(x) / (xp.abs(circle.differentiate(x)) * xp.sqrt(x * (1.0 - x)))

    # With three zeros, `apply_each` lets JAX trace the function only once, which halves the compile time. With two
    # zeros, `apply_each` would double the run time.
    phases = list(map(evaluate_phase, zeros)) if len(zeros) < 3 else apply_each(evaluate_phase, zeros, xp)
    for valid, (theta, w, shift) in zip(valid_masks, phases, strict=True):
        turns = theta / (2.0 * np.pi)
        nearest = xp.round(turns)
        full_turns = full_turns + xp.where(valid, xp.where(device_larger, nearest, -nearest), 0.0)
        device_larger = device_larger != valid
        certain = certain & (~valid | (0.5 - xp.abs(turns - nearest) > tolerance + 4.0 * eps * shift))
        crossovers.append(w)
    # Along the circle, |T| > |B| changes to |T| < |B| or back at each crossover. Mark the count as uncertain if the
    # result of these changes contradicts the comparison of |T| and |B| at z = -r.
    certain = certain & (device_larger == device_larger_at_end)
    return PoleCount(loop.n_plus_1 + 2.0 - (stop - start + 2.0 * full_turns), certain, crossovers)


def count_poles_in_cell(
    log_r: Array, loop: LoopFactors, half: tuple[Array, Array], fractional: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Count the poles outside ``|z| = e^log_r`` for all walls of each cell (docs/theory/maps.md, C4).

    Args:
        log_r: Logarithm of the radius of the circle, for each cell.
        loop: Factors of P at the center of each cell.
        half: Half widths a and b of the cell in alpha and beta.
        fractional: Whether any delay is fractional.

    Returns:
        The number of poles outside the circle, and whether this number is certified for every wall of the cell.
    """
    circle = _evaluate_on_circle(log_r, loop, fractional, np)
    a, b = half
    r, abs_r_minus_1, power = circle.r, np.abs(circle.r_minus_1), loop.n_plus_1 * log_r
    # Bound the changes of three quantities over the walls of the cell: W at z = r (wall_change), and the coefficients
    # w0 and w1 of |W|^2 = w0 + w1 x (e0 and e1).
    (_, w1), (_, m1), (one_plus_ratio, g1) = circle.factors[2:]
    wall_change = a * r + b * abs_r_minus_1
    e0 = (2.0 * np.abs(circle.wall) * wall_change + wall_change * wall_change) * WIDENING + 1e-14 * circle.wall**2
    e1 = 4.0 * r * (np.abs(loop.s) * b + (np.abs(loop.beta) + b) * (a + b)) * WIDENING + 1e-14 * np.abs(w1)
    wall_scale = np.where(power < 0, 1.0, np.exp(-np.abs(power)))
    m0, m1_scaled = (wall_scale * circle.numerator) ** 2, m1 * wall_scale * wall_scale
    changes = [m0 * e0, m0 * e1 + m1_scaled * e0, m1_scaled * e1, 0.0 * m0]
    if fractional:
        g0 = one_plus_ratio**2
        changes = [
            changes[0] * g0,
            changes[1] * g0 + changes[0] * g1,
            changes[2] * g0 + changes[1] * g1,
            changes[2] * g1,
        ]
    bounds = []
    for side in (-1.0, 1.0):
        h = tuple(h_k + side * change for h_k, change in zip(circle.h, changes, strict=True))
        zeros = (
            _find_cubic_zeros(circle._replace(h=h), np) if fractional else _find_quadratic_zeros(h[0], h[1], h[2], np)
        )
        zeros = np.sort([np.where((x >= 0) & (x < 1.0), x, np.nan) for x in zeros], axis=0)
        bounds.append((h[0] > 0, h[0] + h[1] + h[2] + h[3] > 0, zeros))
    (device_larger, device_larger_at_end, low), (other_larger, other_larger_at_end, high) = bounds
    certain = (device_larger == other_larger) & (device_larger_at_end == other_larger_at_end)
    start, stop, wall_at_end = _evaluate_end_arguments(circle, loop, device_larger, device_larger_at_end)
    # The count is certain only if, at z = r and at z = -r, either |T| > |B| or the wall's factor W of B has the same
    # sign for all walls of the grid cell.
    certain &= (device_larger | (np.abs(circle.wall) > wall_change)) & (
        device_larger_at_end | (np.abs(wall_at_end) > a * r + b * (1.0 + r))
    )
    valid = ~np.isnan(low)
    certain &= (valid == ~np.isnan(high)).all(0)
    first, second = (np.where(valid, end(low, high), 0.5) for end in (np.fmin, np.fmax))
    w_first, w_second = (invert_haversine(x, 1.0 - x, np) for x in (first, second))
    cuts = np.sin(0.5 * (w_first + PIECE_POINTS * (w_second - w_first))) ** 2
    first, x, second = cuts[:-1:2], cuts[1::2], cuts[2::2]
    turns = _evaluate_phase_difference(x, circle, loop, fractional, np)[0] / (2.0 * np.pi)
    nearest = np.round(turns[0])
    # On each piece, bound the derivative of arg T - arg B in w. For each factor z - a, the derivative of arg(z - a) is
    # the real part of z/(z - a) = 1 + a/(z - a); use the end of the piece at which |z - a| is smaller.
    least_wall = np.sqrt(np.maximum(circle.wall**2 + np.minimum(w1 * first, w1 * second), 0.0))
    rate = (
        loop.n_plus_1
        + 1.0 / np.sqrt(abs_r_minus_1**2 + circle.factors.z_minus_1[1] * first)
        + np.abs(loop.beta) / least_wall
    )
    rate = rate + loop.c / np.sqrt(circle.r_minus_c**2 + circle.factors.z_minus_c[1] * first)
    rate = rate + loop.h / np.sqrt(np.maximum(circle.numerator**2 + m1 * second, 0.0))
    if fractional:
        rate = rate + loop.q / np.sqrt(np.maximum((r + loop.q) ** 2 - 4.0 * r * loop.q * second, 0.0))
    relative_change = (a * r + b * np.sqrt(abs_r_minus_1**2 + 4.0 * r * second)) / least_wall
    phase_change = PIECE_POINTS[1] * (w_second - w_first) * rate + np.where(
        relative_change < 1.0, 0.5 * np.pi * relative_change, np.inf
    )
    certain &= (~valid | (2.0 * np.pi * np.abs(turns - nearest) + phase_change < np.pi - 1e-9)).all((0, 1))
    # Between successive crossovers, |T| > |B| and |T| < |B| alternate.
    signs = np.where(device_larger, 1.0, -1.0) * (-1.0) ** np.arange(len(valid))[:, None]
    full_turns = np.where(valid, signs * nearest, 0.0).sum(0)
    return loop.n_plus_1 + 2.0 - (stop - start + 2.0 * full_turns), certain


def _evaluate_end_arguments(
    circle: _Circle, loop: LoopFactors, device_larger: Array, device_larger_at_end: Array
) -> tuple[Array, Array, Array]:
    """Return arg(P)/pi at z = r and at z = -r, from the larger of the two terms T and B of P; and W at z = -r."""
    xp = namespace(circle.r)
    half = xp.where(loop.s < 0, -1.0, 1.0)
    start = xp.where(
        device_larger,
        xp.where(circle.r_minus_1 < 0, 1.0, 0.0) + xp.where(circle.r_minus_c < 0, 1.0, 0.0),
        xp.where(circle.wall < 0, half, 0.0),
    )
    numerator, wall = loop.h - loop.a2 * circle.r, -(circle.wall + 2.0 * loop.beta)
    stop = xp.where(numerator < 0, 1.0, 0.0) - xp.where(loop.q > circle.r, 1.0, 0.0) + xp.where(wall < 0, half, 0.0)
    return start, xp.where(device_larger_at_end, loop.n_plus_1 + 2.0, stop), wall


def _may_cancel(sizes: tuple[Array, Array], tolerance: Array) -> Array:
    """Return whether T + B may be 0 up to rounding errors at a point z = r or z = -r, given |T| and |B| there."""
    return namespace(tolerance).abs(sizes[0] - sizes[1]) <= tolerance * sizes[1]
