"""Compute the stability limit of alpha for given beta, delta and delay d = n + f in closed form.

Points of the boundary curve are given by s = sin(w/2), with the frequency w of the pole; b = beta + delta. Other
notation is that of `stability.rigid.boundary_curve`.

All walls with one (beta, delta, d) form a *line of constant beta*, also called row. The stable walls on this line are
``0 < alpha < limit`` (docs/theory/one-lobe.md, Theorem C). The *limit* is the point with this beta on the *lobe*, the
first part of the boundary curve, or a point of the line of walls with a pole at z = -1, which cuts the lobe off in the
*corner*.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import SINE, horner, iterate, materialize, namespace, nan_beyond, within
from zwidth.numerics.evaluate import FEW, Route, compile_kernel, convert_for_jax, evaluate_columns, precision
from zwidth.plant.rigid_mass import DelayClasses, DiscretePlant, discretize_plant
from zwidth.stability.rigid.boundary_curve import (
    Curve,
    CurveTerms,
    evaluate_curve,
    evaluate_polynomials,
    evaluate_wave,
    expand_curve_with_offset,
    expand_short_delay_curve,
)
from zwidth.stability.rigid.broadcasting import MIN_DENSE_SIZE, Points, group_by_value
from zwidth.stability.rigid.characteristic_polynomial import expand_wall
from zwidth.stability.rigid.crossover import stable_kernel
from zwidth.units.quantities import WALL_RANGE

# Numbers of Newton steps, each of which doubles the number of correct digits.
END_STEPS = 6  # to the end of a lobe; the last step only confirms convergence
ROW_STEPS = 2  # to the frequency of a limit; the relative error is then 2e-9, and a last step in alpha squares it

# Coefficients of arctan(t)/t in powers of t^2; error 1e-5 on [0, 1] (Abramowitz, Stegun 1964, eq. (4.4.47)).
ARCTAN = [0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351]


class LongLobe(NamedTuple):
    """The boundary curve of a device with d >= 1, the end of its lobe, and data for Newton's starting values."""

    delta: Array
    n: Array
    curve: Curve
    end: Array  # s at the end of the lobe
    end_angle: Array  # w/2 at the end of the lobe
    end_b: Array  # b at the end of the lobe
    # For a given b, Newton's method finds s. It starts from the angle w/2 that solves ``sqrt(b/end_b) = sin(start_angle
    # (w/2)/end_angle)/start_sine``, plus a correction.
    start_angle: Array
    start_sine: Array
    start_correction: Array


def find_on_short_lobe(b: Array, curve: Any) -> tuple[Array, Array]:
    """Return y of the lobe's point with a given b (the first root of a quadratic), and whether this root is real."""
    (u0, u1), (v0, v1, v2), _ = curve
    xp = namespace(b, u0)
    linear = u0 - b * v1
    discriminant = linear * linear + 4.0 * b * v0 * (u1 - b * v2)
    return 2.0 * b * v0 / (linear + xp.sqrt(xp.maximum(discriminant, 0.0))), discriminant >= 0


def limit_short_delay(beta: Array, plant: DiscretePlant) -> Array:
    """Return the limit of alpha for d < 1: on the lobe or, beyond the corner, on the line of poles at z = -1.

    It is 0 if no alpha is stable, and NaN for invalid input.
    """
    p1, psi, minus_one_coefficient = plant.p1, plant.psi, plant.minus_one_coefficient
    xp = namespace(beta, plant.delta)
    beta = expand_wall(0.0, beta).beta
    b = beta + plant.delta
    # Compute the limit for d = 0, phi1 b (1 - psi beta)/(psi (phi1 + phi2 b)), with phi1, phi2 and psi of the plant.
    integer_limit = p1 * b * (1.0 - psi * beta) / (psi * (p1 + plant.p2 * b))
    (u0, u1), modulus_terms, stiffness_terms = curve = expand_short_delay_curve(plant)
    y, meets_curve = find_on_short_lobe(b, curve)
    # Divide by |V|, because V >= 0 is 0 where the curve goes to infinity, and a rounding error must not make it
    # negative.
    limit = 4.0 * y * horner(y, stiffness_terms) / xp.abs(horner(y, modulus_terms))
    corner_reached = (minus_one_coefficient > 0) & (stiffness_terms[0] + stiffness_terms[1] + stiffness_terms[2] > 0)
    beyond = xp.where(corner_reached, xp.inf, 0.0)
    # Ignore intersections of the line of constant beta with the part of the curve beyond the lobe, which returns from
    # infinity with b < 0: they are not stability limits.
    fractional = xp.where(meets_curve & (y <= 1) & (u0 + u1 * y > 0), limit, beyond)
    limit = xp.where(plant.f == 0, integer_limit, fractional)
    line_limit = 1.0 / xp.where(minus_one_coefficient > 0, minus_one_coefficient, 1.0) - 2.0 * beta
    limit = xp.where(minus_one_coefficient > 0, xp.minimum(limit, line_limit), limit)
    return _mask_limit(limit, b)


def _mask_limit(limit: Array, b: Array) -> Array:
    """Replace the limit of alpha by 0 if no alpha is stable, and by NaN if b is not finite."""
    xp = namespace(b)
    return xp.where(xp.isfinite(b), xp.where((b > 0) & (limit > 0), limit, 0.0), xp.nan)


def build_long_lobe(plant: DiscretePlant) -> LongLobe:
    """Return the boundary curve of one device, the end of its lobe, and data for Newton's starting values."""
    curve, n, em = expand_curve_with_offset(plant), plant.whole, plant.em
    xp, D = namespace(plant.delta), n + 1.0
    end = _find_lobe_end(curve, n, em / (plant.p1 + plant.f * em), n + plant.f)
    wave = evaluate_wave(end, n, low=True)
    terms, end_angle = evaluate_curve(wave, curve), wave.half_omega
    end_b = terms.b / terms.V
    # Approximate the lobe by ``sqrt(b/end_b) = sin(start_angle (w/2)/end_angle)/sin(start_angle)``, with an error of at
    # most 0.4 %. At the end of the lobe, w/2 = end_angle and b = end_b; choose start_angle so that the derivative is
    # correct there, because strong damping makes the lobe nearly flat at its end. The relative derivative of the
    # approximation at the end is start_angle/tan(start_angle), which a rational function inverts. start_correction
    # corrects the derivative at w = 0. To convert derivatives from s to w, use ds/dw = cos(w/2)/2.
    slope = end_angle * end * xp.sqrt(wave.q) * (terms.d_b / terms.b - terms.dV / terms.V)
    flat = xp.clip(1.0 - slope, 0.0, 1.0)
    start_angle = xp.sqrt(3.0 * flat / (1.0 + flat * (0.2 + 0.01585 * flat)))
    start_sine = xp.sin(start_angle)
    # Replace start_angle by the approximate arcsine that also computes the start, so that the start is exact at the end
    # of the lobe. For strong damping and long delays db/dw vanishes there, and each Newton step would only halve an
    # error.
    start_angle = _approximate_arcsine(start_sine)
    # Near w = 0, b is approximately b_rate (w/2)^2.
    b_rate = (curve.excess[0] + 2.0 * n * D * curve.E[0] + (4.0 * n + 2.0) * curve.H[0]) / curve.at_one**2
    start_correction = xp.sqrt(end_b / b_rate) / end_angle - start_sine / start_angle
    # Use `materialize`, so that XLA computes the lobe once per device and not once per line of constant beta.
    return materialize(
        LongLobe(plant.delta, n, curve, end, end_angle, end_b, start_angle, start_sine, start_correction), plant.delta
    )


def _find_lobe_end(curve: Curve, n: Array, start_ratio: Array, d: Array) -> Array:
    """Return the first s > 0 with alpha = 0: the phase of ``e^(j D w) (E + j H sin w)``, D = n + 1, is pi at this s."""
    # Solve "phase = pi" for w by Newton's method, because the phase is nearly linear in w. The starting value lies
    # between pi/(2 D), for an undamped device, and pi/D; it is determined by ``start_ratio``, the ratio E/H at w = 0.
    xp, D = namespace(n), n + 1.0
    limit = xp.sin(xp.minimum(0.5 * np.pi / (d + 0.5), 0.5 * np.pi))

    def step(s: Array) -> Array:
        wave = evaluate_wave(s, n, low=True)
        E, H, _, dE, dH, _ = evaluate_polynomials(wave, curve)
        y, q, sin_squared = wave.y, wave.q, 4.0 * wave.y * wave.q
        # Compute ``remaining``: the difference between the phase and pi, approximated by sine times cosine of the phase
        # and divided by sin w. If the difference exceeds pi/2 (cosine >= 0), take a limited step instead.
        size = E * E + sin_squared * H * H
        cosine = wave.kappa * E - sin_squared * wave.tau * H
        per_sine = 1.0 / xp.sqrt(sin_squared)
        remaining = xp.where(cosine < 0, (wave.tau * E + wave.kappa * H) * cosine, -0.2 * size * per_sine)
        # Convert the step from w to s by the factor ds/dw = cos(w/2)/2.
        rate = D * size + E * ((q - y) * H + 2.0 * y * q * dH) - 2.0 * y * q * H * dE
        return xp.minimum(s - s * q * remaining / rate, limit)

    # Use a loop, which compiles five times faster than unrolled steps. It runs more slowly, but only once per device.
    start = 0.5 * np.pi / D * (1.0 + 0.7 * start_ratio / (start_ratio + 1.0 / D))
    return iterate(END_STEPS, step, xp.sin(0.5 * start), xp, lambda old, new: bool(np.all(old == new)))


def find_limit_long_delay(beta: Array, lobe: LongLobe) -> tuple[Array, Array]:
    """Return the limit of alpha for d >= 1, and s = sin(w/2) at the limit; s is arbitrary if the limit is 0.

    The limit is 0 if no alpha is stable, and NaN for invalid input.
    """
    # Apply Newton's method to sqrt(b), which is nearly linear in s. The root is bracketed by the ends of the lobe,
    # because b increases with s along the lobe. If a step leaves the lobe, clip it and do not bisect, because near
    # convergence a midpoint would be a worse approximation.
    delta, n, curve, end, end_angle, end_b, start_angle, start_sine, start_correction = lobe
    xp = namespace(beta, delta)
    b = expand_wall(0.0, beta).beta + delta
    meets_lobe = (b > 0) & (b < end_b)
    target_b = xp.where(meets_lobe, b, 0.5 * end_b)
    share = target_b / end_b
    r = xp.sqrt(share)
    angle = end_angle * (_approximate_arcsine(r * start_sine) / start_angle + start_correction * r * (1.0 - share))
    s = xp.minimum(angle * horner(angle * angle, SINE[:8]), end)
    for _ in range(ROW_STEPS):
        terms = evaluate_curve(evaluate_wave(s, n, low=True), curve)
        s = xp.clip(s - _compute_newton_step(target_b, terms) / s, 0.0, end)
    terms = evaluate_curve(evaluate_wave(s, n, low=True), curve)
    # Correct V alpha and V to first order for one more Newton step, instead of evaluating the curve again.
    step = _compute_newton_step(target_b, terms)
    limit = (terms.alpha - 2.0 * step * terms.d_alpha) / (terms.V - 2.0 * step * terms.dV)
    return _mask_limit(xp.where(meets_lobe, limit, 0.0), b), s - step / s


def _approximate_arcsine(x: Array) -> Array:
    """Approximate arcsin x for 0 <= x <= 1 to three or four digits, from the tangent of half the angle."""
    xp = namespace(x)
    t = x / (1.0 + xp.sqrt(xp.maximum((1.0 - x) * (1.0 + x), 0.0)))
    return 2.0 * t * horner(t * t, ARCTAN)


def _compute_newton_step(target_b: Array, terms: CurveTerms) -> Array:
    """Return s times the Newton step in s = sin(w/2) that changes b to ``target_b``, computed with a single division.

    The step is ``2 (b - sqrt(target_b b))/b'``, with sqrt(r) approximated by (1 + 3 r)/(3 + r).
    """
    # Divide only once: XLA fuses successive Newton steps into one loop over the lines of constant beta only if no
    # quotient is used twice.
    b, V = terms.b, terms.V
    target = target_b * V
    return 2.0 * b * V * (b - target) / ((terms.d_b * V - b * terms.dV) * (3.0 * b + target))


# Smallest number of points, and of lines of constant beta, with which the labels of a grid are copied from a pattern.
# For smaller grids it is faster to compare each point with its limit.
MIN_PATTERN_SIZE = 1 << 16
MIN_PATTERN_ROWS = 8
# Smallest number of walls per line of constant beta for which JAX computes the limit of each line first; for fewer
# walls it tests each wall separately.
MIN_ROW_LENGTH = 32


def label_grid(points: Points) -> np.ndarray:
    """Return whether each point of a grid is stable, i.e. ``0 < alpha < limit`` of its line; False if out of range."""
    # The comparison is exact up to rounding errors: a limit has a relative error of about 1e-15 or, near the end of the
    # lobe, an error of 1e-15 of the largest limit.
    alpha, beta = nan_beyond(WALL_RANGE, points.alpha, points.beta)
    return _compare_with_limits(alpha, row_limits(beta, points.delta, points.d))


def label_jax_arrays(
    arguments: Mapping[str, ArrayLike], kind: DelayClasses, kernel: Callable[..., Array] = stable_kernel
) -> Array:
    """Return whether each wall is stable, in code compiled by JAX.

    If the shapes of the arguments form a grid, alpha is compared with the limit of its line of constant beta, as in
    `label_grid`; otherwise each wall is tested separately.

    Args:
        arguments: alpha, beta, delta and d by name, at least one of them a JAX array; their shapes broadcast.
        kind: `DelayClasses` that occur in d.
        kernel: function that returns whether each wall is stable, used if the shapes form no grid.
    """
    values = arguments.values()
    with precision(values):
        arrays = convert_for_jax(arguments)
        shape, rows = (np.broadcast_shapes(*map(np.shape, parts)) for parts in (arrays, arrays[1:]))
        if np.prod(shape) >= MIN_DENSE_SIZE and MIN_ROW_LENGTH * np.prod(rows) <= np.prod(shape):
            return _compile_labels(kind)(*arrays)
        return compile_kernel(kernel, (kind,))(*arrays)


@cache
def _compile_labels(kind: DelayClasses) -> Callable[..., Array]:
    """Return a function, compiled by JAX, that compares alpha with the limit of its line of constant beta."""
    import jax
    import jax.numpy as jnp

    @jax.jit
    def label(alpha: Array, beta: Array, delta: Array, d: Array) -> Array:
        rank = max(map(jnp.ndim, (alpha, beta, delta, d)))
        alpha, beta, delta, d = (
            jnp.reshape(x, (1,) * (rank - jnp.ndim(x)) + jnp.shape(x)) for x in (alpha, beta, delta, d)
        )
        limits = [
            compute(beta, *jnp.broadcast_arrays(delta, d))
            for compute, occurs in ((_short_limit, kind.short), (_long_limit, kind.long))
            if occurs
        ]
        limit = jnp.where(d < 1.0, *limits) if len(limits) > 1 else limits[0]
        # Use `materialize`, because XLA would otherwise repeat the last Newton step and the range checks at each point
        # of the grid.
        limit = materialize(jnp.where(within(beta, WALL_RANGE), limit, 0.0), beta)
        return materialize(jnp.where((alpha > 0.0) & within(alpha, WALL_RANGE), alpha, jnp.inf), alpha) < limit

    return label


def row_limits(beta: np.ndarray, delta: np.ndarray, d: np.ndarray, route: Route = "auto") -> np.ndarray:
    """Return the largest stable alpha for each (beta, delta, d), of their broadcast shape; NaN if out of range."""
    shape = np.broadcast_shapes(beta.shape, delta.shape, d.shape)
    limits = np.empty(shape)
    for long, points, index in group_by_value((beta, delta, d), d >= 1):
        kernel = _long_limit if long else _short_limit
        if route == "numpy" or (route == "auto" and limits.size <= FEW):
            # Broadcast only delta and d and not beta, so that each device is computed only once for all its lines.
            with np.errstate(all="ignore"):
                limits[index] = kernel(points[0], *np.broadcast_arrays(*points[1:]))
        else:
            all_arrays = np.broadcast_arrays(*points)
            computed = evaluate_columns(kernel, [array.reshape(-1) for array in all_arrays], route="jax")
            limits[index] = computed.reshape(all_arrays[0].shape)
    return limits


def _short_limit(beta: Array, delta: Array, d: Array) -> Array:
    """Return the limits of alpha for d < 1, elementwise."""
    return limit_short_delay(beta, discretize_plant(delta, d))


def _long_limit(beta: Array, delta: Array, d: Array) -> Array:
    """Return the limits of alpha for d >= 1, elementwise."""
    return find_limit_long_delay(beta, build_long_lobe(discretize_plant(delta, d)))[0]


def _compare_with_limits(alpha: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return ``0 < alpha < limit`` for each point of a grid; large grids are filled from a pattern."""
    shape, values = np.broadcast_shapes(alpha.shape, limit.shape), alpha.reshape(-1)
    ascending = slice(None, None, -1 if values.size and values[0] > values[-1] else 1)
    values = values[ascending]
    varying = [axis for axis, length in enumerate(alpha.shape) if length > 1]
    large = np.prod(shape) >= MIN_PATTERN_SIZE and limit.size >= MIN_PATTERN_ROWS
    if not (large and len(varying) == 1 and limit.shape[varying[0]] == 1 and np.all(values[1:] >= values[:-1])):
        stable = alpha < limit
        stable &= alpha > 0
        return stable
    # Copy the labels of each line of constant beta from a pattern whose first half is True and whose second half is
    # False: the labels are True up to the limit, and copying is as fast as memory access.
    pattern = np.arange(2 * values.size) < values.size
    # Replace NaN by -inf, because searchsorted treats NaN as the largest value.
    count = np.searchsorted(values, np.where(np.isnan(limit), -np.inf, limit).reshape(-1))
    stable = np.lib.stride_tricks.sliding_window_view(pattern, values.size)[values.size - count]
    stable[:, : np.searchsorted(values, 0.0, side="right")] = False
    rows = [length for axis, length in enumerate(limit.shape) if axis != varying[0]]
    return np.moveaxis(stable[:, ascending].reshape(*rows, values.size), -1, varying[0])
