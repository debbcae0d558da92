"""Find the dominant pole (largest |z|) of one loop from two starting points, with a certificate.

The dominant pole is usually the *slow pole*, the larger pole near z = 1, or the *first pair*, the complex pair at the
smallest angle among the poles that a delay places around the origin. Halley's method (`stability.rigid.dominant.steps`)
refines both, then only the larger one.

Certificate: let r be the modulus of the result and tol the tolerance. If a count of poles
(`stability.rigid.dominant.pole_count`) shows that all poles lie inside ``|z| = r (1 + tol)``, and a pole lies within
tol of the result, the spectral radius is r to within tol. Without a certificate, more starting points are tried, and
finally the radius is bisected by counts of poles.

P = T + B has the factors of `stability.rigid.characteristic_polynomial`; a *crossover* is a point with |T| = |B| on a
circle. Poles are given by their logarithms: a pole is ``e^(re + j im)`` with 0 <= im <= pi. The same source code serves
NumPy and JAX: `stability.rigid.dominant.arrays` applies it to NumPy arrays, `stability.rigid.dominant.compiled` to JAX
arrays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import (
    angle,
    apply_each,
    epsilon,
    iterate,
    materialize,
    namespace,
)
from zwidth.stability.rigid.characteristic_polynomial import (
    LoopFactors,
    bound_wall_part,
    expand_at_one,
    expand_on_circle,
    factor_loop,
)
from zwidth.stability.rigid.dominant.pole_count import count_poles
from zwidth.stability.rigid.dominant.steps import (
    halley_step,
    newton_step,
    shift_pole,
)

# Numbers of Halley steps.
STEPS_ON_BOTH = 2  # from both starting points (slow pole and first pair)
STEPS_ON_LARGER = 3  # then from the result with the larger modulus
STEPS_ON_ALL = 10  # from each of four starting points, for walls without a certificate

# Largest distance in log z from a pole at which a sequence of Halley steps counts as converged.
CONVERGED_RADIUS = 1e-6
# Before a Newton step, the distance to the nearest pole is at most R = N |P/P'|, where N >= 3 is the degree of P. The
# step has the length R/N. After the step, the distance to this pole is at most RADIUS_AFTER_STEP R.
RADIUS_AFTER_STEP = 1.4
# Distance in log r from the dominant pole to the circle on which poles are counted: the larger of the following two
# distances, but at most the tolerance of the radius.
COUNT_ROUNDING = 4096.0  # distance needed because of rounding errors of a count, in rounding units of log r
RATE_WIDTH = 2e-11  # distance relative to |re|; small enough for accurate decay rates

ANGLE_ROUNDING = 8.0  # rounding error of the angle pi of negative real poles, in rounding units

# Bisection of the radius to full precision. If many poles have nearly the same modulus, even the last digits of the
# radius matter, because the angles of the crossovers on the circle then depend on them.
MIN_LOG_RADIUS = -690.0  # e^-690 = 2e-300 is close to the smallest float64
BISECTIONS = 62
POLISHING_STEPS = 6  # Halley steps after the bisection
BISECTIONS_PER_COUNT = 3  # per call in NumPy, by counts on 7 circles, which for few walls take as long as on one
# Angles of the third and of the fourth starting point (`list_starts`), relative to the angle of the first pair.
OFF_AXIS_RATIO = 0.1  # close to the real axis, but not on it
BETWEEN_RATIO = 0.5  # near a third pole that exists for short delays


class DominantPoles(NamedTuple):
    """Dominant poles ``e^(re + j im)``, 0 <= im <= pi, with the certified relative error of the spectral radius."""

    re: Array
    im: Array
    error: Array  # certified relative error of the radius; infinite without a certificate
    pole_error: Array  # bound of the error of re; infinite if the radius is certified, but not the pole

    @property
    def certified(self) -> Array:
        """True for walls with a certified error bound of the radius."""
        return self.error < np.inf


def round_to_real(poles: DominantPoles) -> Array:
    """Return im of the poles; for poles that are real up to their error bound, exactly 0 or pi."""
    xp, error = namespace(poles.im), poles.pole_error + ANGLE_ROUNDING * epsilon(poles.im)
    return xp.where(poles.im <= poles.pole_error, 0.0, xp.where(np.pi - poles.im <= error, np.pi, poles.im))


def _bound_log_radius(loop: LoopFactors) -> Array:
    """Return the logarithm of a radius that exceeds the moduli of all poles: |T| > |B| on all larger circles."""
    xp = namespace(loop.alpha)
    wall_bound = bound_wall_part(1.0, 2.0, loop, True)
    bound_root = xp.sqrt(wall_bound)
    # For |z| = r > 1, |T| >= r^(1+n) (r - 1)^2 and |B| <= wall_bound r^2; return an r for which |T| > |B| follows.
    bound = xp.log1p(xp.where(loop.n_plus_1 > 1, bound_root, bound_root + wall_bound))
    steep_bound = xp.maximum(np.log(2.0), xp.log(4.0 * wall_bound) / loop.n_plus_1)
    return 1e-9 + xp.where(loop.n_plus_1 > 1, xp.minimum(bound, steep_bound), bound)


def approximate_slow_pole(loop: LoopFactors) -> tuple[Array, Array]:
    """Approximate the slow pole by the larger zero of the second-order Taylor polynomial of ``P/z^(1+n)`` at z = 1."""
    xp = namespace(loop.alpha)
    constant, linear, quadratic = expand_at_one(loop)
    quadratic = xp.where(quadratic > 0.1, quadratic, 1.0)
    discriminant = linear * linear - 4.0 * quadratic * constant
    discriminant_root = xp.sqrt(xp.abs(discriminant))
    doubled = linear + xp.where(linear < 0, -discriminant_root, discriminant_root)
    real = xp.where(linear < 0, -0.5 * doubled / quadratic, -2.0 * constant / doubled)
    is_complex = discriminant < 0
    re, im = (
        xp.where(is_complex, -0.5 * linear / quadratic, real),
        xp.where(is_complex, 0.5 * discriminant_root / quadratic, 0.0),
    )
    re = xp.maximum(re, -0.5)
    return 0.5 * xp.log1p(re * (2.0 + re) + im * im), angle(1.0 + re, im)


def approximate_first_pair(loop: LoopFactors, fractional: bool) -> tuple[Array, Array]:
    """Approximate the first pair: its angle from the delay, and its radius r from |T| = |B| with simplified factors.

    Only the factor z^(1+n) of T is evaluated at |z| = r, all other factors of T and B at |z| = 1.
    """
    xp = namespace(loop.alpha)
    im = np.pi / (loop.d_plus_1 + 1.0)
    # If beta is so negative that the factor W = alpha z + beta (z - 1) of B is nearly a negative multiple of z - 1, arg
    # B changes by pi, and the angle of the first pair is about twice as large.
    im = xp.where((loop.alpha < -loop.beta * im) & (loop.n_plus_1 > 1), 2.0 * im, im)
    x = xp.sin(0.5 * im) ** 2
    n_plus_1 = loop.n_plus_1
    z_minus_1, z_minus_c, W, numerator, late = (
        value * value + slope * x for value, slope in expand_on_circle(1.0, 0.0, loop)
    )
    if fractional:
        numerator, n_plus_1 = numerator * late, n_plus_1 + 1.0
    return xp.maximum(0.5 * xp.log(numerator * W / (z_minus_1 * z_minus_c)) / n_plus_1, -1.0), im


def approximate_larger_pole(loop: LoopFactors, fractional: bool) -> tuple[Array, Array]:
    """Approximate the larger of the slow pole and the first pair by a few Halley steps from approximations of both."""
    xp = namespace(loop.alpha)

    def follow(start: tuple[Array, Array]) -> tuple[Array, Array]:
        return iterate(STEPS_ON_BOTH, lambda point: halley_step(*point, loop, fractional), start, xp)

    slow, pair = apply_each(follow, [approximate_slow_pole(loop), approximate_first_pair(loop, fractional)], xp)
    slow_is_larger = (slow[0] >= pair[0]) | xp.isnan(pair[0])
    return xp.where(slow_is_larger, slow[0], pair[0]), xp.where(slow_is_larger, slow[1], pair[1])


def find_candidate(loop: LoopFactors, fractional: bool) -> tuple[Array, Array]:
    """Return the larger of the slow pole and the first pair, nearly converged, as a candidate for the dominant pole."""
    start = approximate_larger_pole(loop, fractional)
    return iterate(STEPS_ON_LARGER, lambda point: halley_step(*point, loop, fractional), start, namespace(loop.alpha))


def certification_width(re: Array, tolerance: Any, spread: Any = 1.0) -> Array:
    """Return the distance, in log |z|, from a pole to the circle on which poles are counted.

    The distance is as small as the rounding error of the count permits, because it adds to the error of decay rates.
    """
    xp = namespace(re)
    return xp.minimum(tolerance, spread * xp.maximum(COUNT_ROUNDING * epsilon(re), RATE_WIDTH * xp.abs(re)))


def certify_pole(
    re: Array, im: Array, tolerance: Any, loop: LoopFactors, fractional: bool, single: bool, spread: Any = 1.0
) -> DominantPoles:
    """Take a Newton step, and certify that the modulus of the result is the spectral radius within the tolerance.

    Args:
        re: Logarithm of the modulus of an approximate pole, nearly converged.
        im: Argument of this pole.
        tolerance: Largest relative error of the spectral radius.
        loop: Factors of P.
        fractional: Whether any delay is fractional.
        single: Count poles under the assumption of a single crossover, see `pole_count.count_poles`.
        spread: Factor of the distance from the pole to the circle on which poles are counted.
    """
    xp = namespace(re, loop.alpha)
    # If alpha = 0, one pole is exactly 1. Set the result to 1 unless the approximate pole is larger.
    at_one = (loop.alpha == 0) & ~(re > tolerance)
    step = newton_step(re, im, loop, fractional)
    re, im = (xp.where(at_one, 0.0, part) for part in shift_pole(re, im, step.re, step.im))
    poles_outside = count_poles(re + certification_width(re, tolerance, spread), loop, fractional, single)
    certified = (
        (at_one | (RADIUS_AFTER_STEP * step.radius <= tolerance)) & poles_outside.all_inside & poles_outside.certain
    )
    return DominantPoles(re, im, xp.where(certified, tolerance, np.inf), xp.where(at_one, 0.0, step.end_error))


def quick_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, tolerance: Array, fractional: bool
) -> DominantPoles:
    """Return the dominant pole of each wall, from two starting points; for most walls the pole is certified."""
    loop = materialize(factor_loop(alpha, beta, delta, d, fractional), delta)
    return certify_pole(*find_candidate(loop, fractional), tolerance, loop, fractional, fractional)


# The following functions serve the walls that `quick_kernel` does not certify; ``loop`` contains only these walls.


def bound_radius(poles: DominantPoles, tolerance: float, loop: LoopFactors, fractional: bool) -> DominantPoles:
    """Certify the spectral radius, but not the pole, by counts on a slightly larger and a slightly smaller circle."""
    above, below = (count_poles(poles.re + side, loop, fractional) for side in (tolerance, -tolerance))
    certified = above.all_inside & above.certain & ~below.all_inside & below.certain
    return poles._replace(
        error=np.where(certified, tolerance, np.inf), pole_error=np.where(certified, np.inf, poles.pole_error)
    )


def list_starts(loop: LoopFactors, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return four starting points, of shape (4, loops): approximate slow pole and first pair, and two others."""
    # For the third starting point, move the slow pole onto the real axis if it is complex, otherwise off the real axis.
    # Reason: Halley steps from a point on the real axis never leave the axis, and steps from other points rarely reach
    # it.
    (slow, turn), pair = approximate_slow_pole(loop), approximate_first_pair(loop, fractional)
    other = np.where(turn > 0, 0.0, OFF_AXIS_RATIO * pair[1])
    return np.stack([slow, pair[0], slow, 0.0 * slow]), np.stack([turn, pair[1], other, BETWEEN_RATIO * pair[1]])


def certify_starts(_: DominantPoles, tolerance: float, loop: LoopFactors, fractional: bool) -> DominantPoles:
    """Certify the largest pole found from four starting points; the count allows any number of crossovers."""
    starts = list_starts(loop, fractional)
    re, im = iterate(STEPS_ON_ALL, lambda point: halley_step(*point, loop, fractional), starts, np)
    converged = newton_step(re, im, loop, fractional).radius < CONVERGED_RADIUS
    best = np.where(converged, re, -np.inf).argmax(0), np.arange(re.shape[1])
    return certify_pole(re[best], im[best], tolerance, loop, fractional, False)


def find_by_bisection(loop: LoopFactors, fractional: bool) -> tuple[Array, Array, Array]:
    """Bisect the spectral radius by counting poles, and approximate the dominant pole on the circle with this radius.

    Returns:
        The log radius; and re and im of the pole, refined by Halley steps, which may not converge near multiple poles.
    """
    xp = namespace(loop.alpha)
    # With NumPy, count poles on several circles at once, because for few walls this takes no longer than on one circle.
    bits = BISECTIONS_PER_COUNT if xp is np else 1

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        low, width = state[0], (state[1] - state[0]) / 2**bits
        radii = xp.stack([low + k * width for k in range(1, 2**bits)])
        circles = LoopFactors(*(xp.broadcast_to(part, radii.shape) for part in loop))
        low = low + width * (~count_poles(radii, circles, fractional).all_inside).sum(0)
        return low, low + width

    high = _bound_log_radius(loop)
    _, radius = iterate(-(-BISECTIONS // bits), step, (0.0 * high + MIN_LOG_RADIUS, high), xp)
    # On the circle with the bisected radius, the dominant pole is at a crossover or on the real axis. Of these angles,
    # choose the one with the smallest bound of the distance to a pole.
    angles = [0.0 * radius, 0.0 * radius + np.pi, *count_poles(radius, loop, fractional).crossovers]
    distances = apply_each(lambda im: newton_step(radius, im, loop, fractional).radius, angles, xp)
    im, least_distance = angles[0], np.inf
    for candidate, distance in zip(angles, distances, strict=True):
        im, least_distance = xp.where(distance < least_distance, candidate, im), xp.minimum(distance, least_distance)
    return radius, *iterate(POLISHING_STEPS, lambda point: halley_step(*point, loop, fractional), (radius, im), xp)


def bisect_radius(_: DominantPoles, tolerance: float, loop: LoopFactors, fractional: bool) -> DominantPoles:
    """Certify the dominant pole that is found by bisection of the spectral radius."""
    radius, re, im = find_by_bisection(loop, fractional)
    poles = certify_pole(re, im, tolerance, loop, fractional, False)
    # Keep the bisected radius if the pole is not certified; near multiple poles the Halley steps usually do not
    # converge.
    return poles._replace(re=np.where(poles.certified, poles.re, radius))
