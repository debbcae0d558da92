"""Compute the stability limit of alpha for given beta, delta and d in closed form.

For each (beta, delta, d), d = n + f, the stable walls are ``0 < alpha < limit`` (docs/theory/one-lobe.md, Theorem C).
The *limit* is the point with this beta on the *lobe*, the first part of the boundary curve, or a point of the line of
walls with a pole at z = -1, which cuts the lobe off in the *corner*. All walls with one (beta, delta, d) form a *line
of constant beta*, also called row.

A wall on the boundary curve has a pole at z = e^(j w). With M = N(z)/z of the discretized plant and its pole c,

    E + j H sin w = (z - c) conj(M)      V = |M|^2      y = sin^2(w/2)      k = n + 1/2      b = beta + delta

The curve is used in its form with half angles (docs/theory/boundary.md, B1). b vanishes like w^2 at w = 0. Therefore
``V b = delta V - cos(k w)/cos(w/2) E + ...`` is rearranged such that nothing cancels, for every delta.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import COSINE, SINE, horner, iterate, materialize, namespace, nan_beyond, within
from zwidth.numerics.evaluate import FEW, Route, compile_kernel, convert_for_jax, evaluate_columns, precision
from zwidth.numerics.held_mass import DelayClasses, DiscretePlant, discretize_plant
from zwidth.stability.rigid.broadcasting import MIN_DENSE_SIZE, Points, group_by_value
from zwidth.stability.rigid.crossover import expand_long_delay_curve, expand_short_delay_curve, stable_kernel
from zwidth.units.quantities import WALL_RANGE

# Numbers of Newton steps, each of which doubles the number of correct digits.
END_STEPS = 6  # to the end of a lobe; the last step only confirms convergence
ROW_STEPS = 2  # to the frequency of a limit; the relative error is then 2e-9, and a last step in alpha squares it

# Coefficients of arctan(t)/t in powers of t^2; error 1e-5 on [0, 1] (Abramowitz, Stegun 1964, eq. (4.4.47)).
ARCTAN = [0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351]


class LongLobe(NamedTuple):
    """The boundary curve of a device with d >= 1, in powers of y = sin^2(w/2), and starts of Newton's method."""

    delta: Array
    k: Array  # n + 1/2
    E0: Array  # E = E0 + E1 y + E2 y^2
    E1: Array
    E2: Array
    H0: Array  # H = H0 + H1 y
    H1: Array
    V0: Array  # V = V0 + V1 y + V2 y^2
    V1: Array
    V2: Array
    excess1: Array  # delta V - E = excess1 y + excess2 y^2
    excess2: Array
    end: Any = None  # w at the end of the lobe
    end_b: Any = None  # b at the end of the lobe
    # Newton's method for w at a given b starts from the solution of ``sqrt(b/end_b) = sin(start_angle
    # w/end)/start_sine``, plus a correction. At the end of the lobe, w = end and b = end_b.
    start_angle: Any = None
    start_sine: Any = None
    start_correction: Any = None


def _compute_sine_and_cosine(x: Array) -> tuple[Array, Array]:
    """Return sine and cosine for 0 <= x <= pi/4 by their series."""
    square = x * x
    return x * horner(square, SINE[:8]), horner(square, COSINE[:9])


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


def expand_long_lobe(plant: DiscretePlant) -> LongLobe:
    """Expand E, H and V of one device in powers of y; the end of the lobe and the starting values stay None."""
    E, H, V, excess = expand_long_delay_curve(plant)
    return LongLobe(plant.delta, plant.whole + 0.5, *E, *H, *V, *excess)


def build_long_lobe(plant: DiscretePlant) -> LongLobe:
    """Expand E, H and V of one device in powers of y; find the end of its lobe and starts of Newton's method."""
    lobe = expand_long_lobe(plant)
    em, p1, n, f = plant.em, plant.p1, plant.whole, plant.f
    xp = namespace(lobe.delta)
    end = _find_lobe_end(lobe, em / (p1 + f * em), n + f)
    numerator, d_numerator, denominator, d_denominator = evaluate_offset(LobeTerms(end, lobe))
    end_b = numerator / denominator
    # Approximate the lobe by ``sqrt(b/end_b) = sin(start_angle w/end)/sin(start_angle)``, where w = end and b = end_b
    # at the end of the lobe. This curve has the right derivative at w = end, where strong damping makes the lobe nearly
    # flat; `start_correction` corrects the derivative at w = 0. The error is at most 0.4 %. The relative derivative at
    # the end is start_angle/tan(start_angle); a rational function inverts it.
    flat = xp.clip(1.0 - 0.5 * end * (d_numerator / numerator - d_denominator / denominator), 0.0, 1.0)
    start_angle = xp.sqrt(3.0 * flat / (1.0 + flat * (0.2 + 0.01585 * flat)))
    start_sine = xp.sin(start_angle)
    # Replace start_angle by the approximate arcsine that also computes the start, so that the start is exact at the end
    # of the lobe. For strong damping and long delays db/dw vanishes there, and each Newton step would only halve an
    # error.
    start_angle = _approximate_arcsine(start_sine)
    d_b = (0.25 * lobe.excess1 + 0.5 * lobe.E0 * (lobe.k * lobe.k - 0.25) + lobe.k * lobe.H0) / lobe.V0
    start_correction = xp.sqrt(end_b / d_b) / end - start_sine / start_angle
    # Stack the fields into one array, so that XLA computes them once per device and not once per line of constant beta.
    return LongLobe(*xp.stack([*lobe[:-5], end, end_b, start_angle, start_sine, start_correction]))


class LobeTerms:
    """E, H, V, and sines and cosines of w/2 (s, c) and k w (sin_k, cos_k) at one w; the prefix d denotes d/dw."""

    def __init__(self, omega: Array, lobe: LongLobe):
        _, k, E0, E1, E2, H0, H1, V0, V1, V2, excess1, excess2, *_ = lobe
        self.k = k
        s4, c4 = _compute_sine_and_cosine(0.25 * omega)
        sk4, ck4 = _compute_sine_and_cosine(0.25 * k * omega)
        # Compute sines of half angles first, because differences of cosines computed from them keep their relative
        # accuracy for small w.
        s_half = 2.0 * sk4 * ck4
        self.s, self.c = 2.0 * s4 * c4, 1.0 - 2.0 * s4 * s4
        self.sin_k = 2.0 * s_half * (1.0 - 2.0 * sk4 * sk4)
        self.cos_k = 1.0 - 2.0 * s_half * s_half
        # cos(w/2) - cos(k w)
        self.cosine_drop = 2.0 * (s_half * s_half - s4 * s4)
        y = self.s * self.s
        self.E, self.H, self.V = E0 + y * (E1 + y * E2), H0 + y * H1, V0 + y * (V1 + y * V2)
        # Compute the derivatives with respect to w, where dy/dw = sin(w/2) cos(w/2).
        dy = self.s * self.c
        self.dE, self.dH, self.dV = dy * (E1 + 2.0 * y * E2), dy * H1, dy * (V1 + 2.0 * y * V2)
        self.excess, self.d_excess = y * (excess1 + y * excess2), dy * (excess1 + 2.0 * y * excess2)


def evaluate_offset(terms: LobeTerms) -> tuple[Array, Array, Array, Array]:
    """Return numerator and denominator of b on the boundary curve, each with its derivative in w.

    Both are accurate relative to b.

    Args:
        terms: Terms of one frequency.

    Returns:
        Numerator, its derivative, denominator, its derivative.
    """
    k, s, c = terms.k, terms.s, terms.c
    numerator = c * terms.excess + terms.E * terms.cosine_drop + s * c * 2.0 * terms.sin_k * terms.H
    d_numerator = (
        c * terms.d_excess
        - 0.5 * s * terms.excess
        + terms.dE * terms.cosine_drop
        + terms.E * (k * terms.sin_k - 0.5 * s)
    )
    d_numerator += (
        terms.H * (terms.sin_k * (1.0 - 2.0 * s * s) + 2.0 * k * s * c * terms.cos_k)
        + 2.0 * s * c * terms.sin_k * terms.dH
    )
    return numerator, d_numerator, c * terms.V, c * terms.dV - 0.5 * s * terms.V


class AlphaTerms(NamedTuple):
    """The numerator of alpha on the boundary curve, and the terms from which alpha and its derivative are computed."""

    projection: Array  # sin((n + 1) w) E + cos((n + 1) w) F, proportional to alpha
    quadrature: Array  # cos((n + 1) w) E - sin((n + 1) w) F
    d_projection: Array  # derivative of the projection in w
    F: Array  # H sin w
    dF: Array


def evaluate_alpha_terms(terms: LobeTerms) -> AlphaTerms:
    """Evaluate the numerator of alpha on the boundary curve, and its derivative, at one frequency w."""
    # (n + 1) w = k w + w/2
    n_plus_1 = terms.k + 0.5
    sine = terms.sin_k * terms.c + terms.cos_k * terms.s
    cosine = terms.cos_k * terms.c - terms.sin_k * terms.s
    sin_w, cos_w = 2.0 * terms.s * terms.c, 1.0 - 2.0 * terms.s * terms.s
    F, dF = sin_w * terms.H, cos_w * terms.H + sin_w * terms.dH
    quadrature = cosine * terms.E - sine * F
    return AlphaTerms(
        sine * terms.E + cosine * F, quadrature, n_plus_1 * quadrature + sine * terms.dE + cosine * dF, F, dF
    )


def _find_lobe_end(lobe: LongLobe, start_ratio: Array, d: Array) -> Array:
    """Return the first w > 0 at which alpha is 0: the phase of ``e^(j (n+1) w) (E + j H sin w)`` reaches pi there."""
    # Solve for the w with the phase pi by Newton's method, because the phase is nearly linear in w. ``start_ratio``,
    # which is E/H at w = 0, determines the start between pi/(2 (n+1)), for an undamped device, and pi/(n+1).
    n_plus_1 = lobe.k + 0.5
    xp = namespace(n_plus_1)
    limit = np.pi / (d + 0.5)

    def step(omega: Array) -> Array:
        terms = LobeTerms(omega, lobe)
        alpha_terms = evaluate_alpha_terms(terms)
        size = terms.E * terms.E + alpha_terms.F * alpha_terms.F
        # If the phase differs from pi by less than pi/2, approximate the difference by the product of its sine and
        # cosine; otherwise take a limited step.
        remaining = xp.where(alpha_terms.quadrature < 0, alpha_terms.projection * alpha_terms.quadrature, -0.2 * size)
        return xp.minimum(
            omega - remaining / (n_plus_1 * size + (terms.E * alpha_terms.dF - alpha_terms.F * terms.dE)), limit
        )

    # Use a loop, which compiles five times faster than unrolled steps. It runs more slowly, but only once per device.
    start = 0.5 * np.pi / n_plus_1 * (1.0 + 0.7 * start_ratio / (start_ratio + 1.0 / n_plus_1))
    return iterate(END_STEPS, step, start, xp)


def find_limit_long_delay(beta: Array, lobe: LongLobe) -> tuple[Array, Array]:
    """Return the limit of alpha for d >= 1, and the frequency w of the limit if it exists.

    The limit is 0 if no alpha is stable, and NaN for invalid input.
    """
    # Apply Newton's method to sqrt(b), which is nearly linear in w. The lobe itself is the bracket, because b increases
    # with w along it. If a step leaves the lobe, clip it and do not bisect, because near convergence a midpoint would
    # be a worse approximation.
    delta, end, end_b, start_angle, start_sine, start_correction = lobe.delta, *lobe[-5:]
    xp = namespace(beta, delta)
    b = beta + delta
    meets_lobe = (b > 0) & (b < end_b)
    target_b = xp.where(meets_lobe, b, 0.5 * end_b)
    share = target_b / end_b
    r = xp.sqrt(share)
    omega = xp.minimum(
        end * (_approximate_arcsine(r * start_sine) / start_angle + start_correction * r * (1.0 - share)), end
    )
    for _ in range(ROW_STEPS):
        omega = xp.clip(omega - _compute_newton_step(target_b, LobeTerms(omega, lobe)), 0.0, end)
    terms = LobeTerms(omega, lobe)
    alpha_terms = evaluate_alpha_terms(terms)
    numerator, denominator = 2.0 * terms.s * alpha_terms.projection, terms.c * terms.V
    # Add the effect of the last Newton step in w to the numerator of alpha, to first order.
    step = _compute_newton_step(target_b, terms)
    numerator -= step * (terms.c * alpha_terms.projection + 2.0 * terms.s * alpha_terms.d_projection)
    denominator -= step * (terms.c * terms.dV - 0.5 * terms.s * terms.V)
    return _mask_limit(xp.where(meets_lobe, numerator / denominator, 0.0), b), omega - step


def _approximate_arcsine(x: Array) -> Array:
    """Approximate arcsin x for 0 <= x <= 1 to three or four digits, from the tangent of half the angle."""
    xp = namespace(x)
    t = x / (1.0 + xp.sqrt(xp.maximum((1.0 - x) * (1.0 + x), 0.0)))
    return 2.0 * t * horner(t * t, ARCTAN)


def _compute_newton_step(target_b: Array, terms: LobeTerms) -> Array:
    """Return the Newton step in w from b to ``target_b``, computed with a single division.

    The step is ``2 (b - sqrt(target_b b))/b'``, with sqrt(r) approximated by (1 + 3 r)/(3 + r).
    """
    # Divide only once, because XLA fuses successive steps into one loop over the lines only if no quotient is used
    # twice.
    numerator, d_numerator, denominator, d_denominator = evaluate_offset(terms)
    target_numerator = target_b * denominator
    return (
        4.0
        * numerator
        * denominator
        * (numerator - target_numerator)
        / ((d_numerator * denominator - numerator * d_denominator) * (3.0 * numerator + target_numerator))
    )


# Smallest number of points, and of lines of constant beta, with which the labels of a grid are copied from a pattern.
# For smaller grids it is faster to compare each point with its limit.
MIN_PATTERN_SIZE = 1 << 16
MIN_PATTERN_ROWS = 8
# Smallest number of walls per line of constant beta with which JAX computes the limits of the lines.
MIN_ROW_LENGTH = 32


def label_grid(points: Points) -> np.ndarray:
    """Return whether each point of a grid is stable, i.e. ``0 < alpha < limit`` of its line; False if out of range."""
    # The comparison is exact up to rounding errors: a limit has a relative error of about 1e-15 or, near the end of the
    # lobe, an error of 1e-15 of the largest limit.
    alpha, beta = nan_beyond(WALL_RANGE, points.alpha, points.beta)
    return _compare_with_limits(alpha, row_limits(beta, points.delta, points.d))


def label_jax_arrays(arguments: Mapping[str, ArrayLike], kind: DelayClasses) -> Array:
    """Return whether each wall is stable, in code compiled by JAX; as `label_grid` does if the shapes form a grid.

    Args:
        arguments: alpha, beta, delta and d by name, some of them JAX arrays; they broadcast.
        kind: classes of the delays.
    """
    values = arguments.values()
    with precision(values):
        arrays = convert_for_jax(arguments)
        shape, rows = (np.broadcast_shapes(*map(np.shape, parts)) for parts in (arrays, arrays[1:]))
        if np.prod(shape) >= MIN_DENSE_SIZE and MIN_ROW_LENGTH * np.prod(rows) <= np.prod(shape):
            return _compile_labels(kind)(*arrays)
        return compile_kernel(stable_kernel, (kind,))(*arrays)


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
        # Without `materialize`, XLA repeats the last Newton step at each point of the grid.
        limit = materialize(jnp.where(within(beta, WALL_RANGE), limit, 0.0), beta)
        return (alpha > 0.0) & (alpha < limit) & within(alpha, WALL_RANGE)

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
