"""Find the dominant pole of one loop: two starting points, a fixed number of steps, and one certificate.

The dominant pole (largest |z|) is usually one of two: the *slow pole*, the pole near z = 1 that belongs to the wall's
slow dynamics; or the *first pair*, the complex pair at the smallest angle among the poles that a delay places around
the origin (the *ring*). Halley's method (`stability.rigid.characteristic_function`) refines both, then only the larger
one.

Certificate: let r be the modulus of the result and tol the tolerance. A count (`stability.rigid.pole_count`) shows that
all poles lie inside ``|z| = r (1 + tol)``, and a pole lies within tol of the result. Then the spectral radius is r to
within tol. If this fails, more starting points are tried, and finally the radius is bisected by counts.

P = T + B has the factors of `stability.rigid.characteristic_polynomial`; a *crossover* is a point with |T| = |B| on a
circle. All positions are logarithms: a pole is ``e^(re + j im)`` with 0 <= im <= pi. There are two implementations:
NumPy functions, which `stability.rigid.dominant_poles` applies to walls without a certificate, and one program for JAX
transformations (`traced_kernel`).
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
    nan_unless,
    nan_with_nan_derivatives,
    stop_gradient,
)
from zwidth.numerics.root_finding import attach_root_derivatives
from zwidth.stability.rigid.characteristic_function import (
    evaluate_polynomial,
    halley_step,
    make_complex,
    newton_step,
    shift_pole,
)
from zwidth.stability.rigid.characteristic_polynomial import (
    LoopFactors,
    bound_wall_part,
    expand_at_one,
    expand_on_circle,
    factor_loop,
)
from zwidth.stability.rigid.normalization import valid_wall
from zwidth.stability.rigid.pole_count import count_poles

# Numbers of Halley steps.
STEPS_ON_BOTH = 2  # from both starting points
STEPS_ON_LARGER = 3  # then from the larger of both results
STEPS_AGAIN = 6  # without a certificate: from the result, and from the starting point that is farther from it
STEPS_ON_ALL = 10  # without a certificate again: from four starting points

# Distance in log z between a point and a pole below which a sequence of steps has converged.
CONVERGED_RADIUS = 1e-6
# Before a Newton step, the distance to the nearest pole is at most R = N |P/P'|, with the degree N >= 3 of P. After the
# step, of length R/N, this pole is at a distance of at most RADIUS_AFTER_STEP R.
RADIUS_AFTER_STEP = 1.4
# Distance in log r from a pole to the circle on which poles are counted: the larger of the following two, but at most
# the tolerance of the radius.
COUNT_ROUNDING = 4096.0  # rounding error of a count, in rounding units of log r
RATE_WIDTH = 2e-11  # relative to |re|; small enough for accurate decay rates

# Bisection of the radius to full precision. The last digits matter if many poles have nearly the same modulus, because
# then the angles of the crossovers on the circle depend on them.
MIN_LOG_RADIUS = -690.0  # e^-690 = 2e-300 is close to the smallest float64
BISECTIONS = 62
POLISHING_STEPS = 6  # Halley steps after the bisection
NEWTON_STEPS = 3  # Newton steps after those, in `_find_in_rounds`
BISECTIONS_PER_COUNT = 3  # per call in NumPy; for few walls, counting on 7 circles takes as long as on one
# Largest number of circles on which the last certificate counts poles, each ten times as far from the pole as the
# previous one, because on a closer circle the rounding error of the count may be too large.
MAX_TRIALS = 6

# Inside a JAX transformation, the walls are divided into at most MAX_PARTS parts with at least MIN_PART_SIZE walls.
MAX_PARTS = 16
MIN_PART_SIZE = 1 << 9
# Angles of the third and of the fourth starting point, relative to the angle of the first pair.
OFF_AXIS_RATIO = 0.1  # close to the real axis, but not on it
BETWEEN_RATIO = 0.5  # near a third pole that exists for short delays


class DominantPoles(NamedTuple):
    """Dominant poles ``e^(re + j im)``, 0 <= im <= pi, with the certified relative error of the spectral radius."""

    re: Array
    im: Array
    error: Array  # certified relative error of the radius; infinite without a certificate
    pole_error: Array  # bound of |re - true re|; infinite if only the radius is certified

    @property
    def certified(self) -> Array:
        """True if an error bound is certified."""
        return self.error < np.inf


def _bound_log_radius(loop: LoopFactors) -> Array:
    """Return the logarithm of a radius above the moduli of all poles: |T| > |B| on every larger circle."""
    xp = namespace(loop.alpha)
    wall_bound = bound_wall_part(1.0, 2.0, loop, True)
    bound_root = xp.sqrt(wall_bound)
    # For r > 1 use |T| >= r^(1+n) (r - 1)^2 and |B| <= wall_bound r^2.
    bound = xp.log1p(xp.where(loop.n_plus_1 > 1, bound_root, bound_root + wall_bound))
    steep_bound = xp.maximum(np.log(2.0), xp.log(4.0 * wall_bound) / loop.n_plus_1)
    return 1e-9 + xp.where(loop.n_plus_1 > 1, xp.minimum(bound, steep_bound), bound)


def approximate_slow_pole(loop: LoopFactors) -> tuple[Array, Array]:
    """Approximate the larger pole near 1, from the Taylor polynomial of P of second order in z - 1."""
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

    Only the factor r^(1+n) depends on r; all other factors of T and B are evaluated on the unit circle.
    """
    xp = namespace(loop.alpha)
    im = np.pi / (loop.d_plus_1 + 1.0)
    # If beta is so negative that W is nearly a negative multiple of z - 1, arg B changes by pi. The angle of the first
    # pair is then about twice as large.
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
    """Approximate the larger of the slow pole and the first pair by a few Halley steps on both."""
    xp = namespace(loop.alpha)

    def follow(start: tuple[Array, Array]) -> tuple[Array, Array]:
        return iterate(STEPS_ON_BOTH, lambda point: halley_step(*point, loop, fractional), start, xp)

    slow, pair = apply_each(follow, [approximate_slow_pole(loop), approximate_first_pair(loop, fractional)], xp)
    slow_is_larger = (slow[0] >= pair[0]) | xp.isnan(pair[0])
    return xp.where(slow_is_larger, slow[0], pair[0]), xp.where(slow_is_larger, slow[1], pair[1])


def find_candidate(loop: LoopFactors, fractional: bool) -> tuple[Array, Array]:
    """Return the larger of the slow pole and the first pair, nearly converged."""
    start = approximate_larger_pole(loop, fractional)
    return iterate(STEPS_ON_LARGER, lambda point: halley_step(*point, loop, fractional), start, namespace(loop.alpha))


def certification_width(re: Array, tolerance: Any) -> Array:
    """Return the distance, in log |z|, from a pole to the circle on which poles are counted.

    The distance is as small as the rounding error of the count permits, because it adds to the error of decay rates.
    """
    xp = namespace(re)
    return xp.minimum(tolerance, xp.maximum(COUNT_ROUNDING * epsilon(re), RATE_WIDTH * xp.abs(re)))


def certify_pole(
    re: Array, im: Array, tolerance: Array, loop: LoopFactors, fractional: bool, single: bool
) -> DominantPoles:
    """Take a Newton step, and certify within the tolerance that the modulus of the result is the spectral radius.

    Args:
        re: Log modulus of a pole, nearly converged.
        im: Argument of this pole.
        tolerance: Relative error of the radius.
        loop: Factors of P.
        fractional: Whether any delay is fractional.
        single: Count with a single crossover, see `pole_count.count_poles`.
    """
    xp = namespace(re, loop.alpha)
    # Set the pole to exactly 1 if alpha = 0 and no pole is larger, because one pole is then exactly 1.
    at_one = (loop.alpha == 0) & ~(re > tolerance)
    step = newton_step(re, im, loop, fractional)
    re, im = (xp.where(at_one, 0.0, part) for part in shift_pole(re, im, step.re, step.im))
    poles_outside = count_poles(re + certification_width(re, tolerance), loop, fractional, single)
    certified = (
        (at_one | (RADIUS_AFTER_STEP * step.radius <= tolerance)) & poles_outside.all_inside & poles_outside.certain
    )
    return DominantPoles(re, im, xp.where(certified, tolerance, np.inf), xp.where(at_one, 0.0, step.end_error))


def quick_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, tolerance: Array, fractional: bool
) -> DominantPoles:
    """Return the dominant pole of each wall from two starting points; for most walls it is certified."""
    loop = materialize(factor_loop(alpha, beta, delta, d, fractional), delta)
    return certify_pole(*find_candidate(loop, fractional), tolerance, loop, fractional, fractional)


# The following NumPy functions certify the walls that `quick_kernel` leaves without a certificate; ``loop`` contains
# only these.


def _certify_largest(
    starts: tuple[np.ndarray, np.ndarray], steps: int, tolerance: float, loop: LoopFactors, fractional: bool
) -> DominantPoles:
    """Certify the largest of the poles to which starting points lead, by a count with any number of crossovers."""
    re, im = iterate(steps, lambda point: halley_step(*point, loop, fractional), starts, np)
    converged = newton_step(re, im, loop, fractional).radius < CONVERGED_RADIUS
    best = np.where(converged, re, -np.inf).argmax(0), np.arange(re.shape[1])
    return certify_pole(re[best], im[best], tolerance, loop, fractional, False)


def certify_again(poles: DominantPoles, tolerance: float, loop: LoopFactors, fractional: bool) -> DominantPoles:
    """Take more steps from the result and from the starting point farther from it; certify the larger pole."""
    slow, pair = approximate_slow_pole(loop), approximate_first_pair(loop, fractional)
    farther = np.abs(poles.im - slow[1]) > np.abs(poles.im - pair[1])
    re, im = (np.stack([leaf, np.where(farther, *both)]) for leaf, *both in zip(poles[:2], slow, pair, strict=True))
    return _certify_largest((re, im), STEPS_AGAIN, tolerance, loop, fractional)


def bound_radius(poles: DominantPoles, tolerance: float, loop: LoopFactors, fractional: bool) -> DominantPoles:
    """Certify the radius, but not the pole, by counts on a slightly larger and a slightly smaller circle."""
    above, below = (count_poles(poles.re + side, loop, fractional) for side in (tolerance, -tolerance))
    certified = above.all_inside & above.certain & ~below.all_inside & below.certain
    return poles._replace(
        error=np.where(certified, tolerance, np.inf), pole_error=np.where(certified, np.inf, poles.pole_error)
    )


def list_starts(loop: LoopFactors, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return four starting points, of shape (4, loops): both approximations, and two at other angles."""
    # The third starting point is the slow pole moved onto the real axis if it is complex, and off the axis otherwise,
    # because steps from the real axis never leave it and other steps rarely reach it.
    (slow, turn), pair = approximate_slow_pole(loop), approximate_first_pair(loop, fractional)
    other = np.where(turn > 0, 0.0, OFF_AXIS_RATIO * pair[1])
    return np.stack([slow, pair[0], slow, 0.0 * slow]), np.stack([turn, pair[1], other, BETWEEN_RATIO * pair[1]])


def certify_starts(_: DominantPoles, tolerance: float, loop: LoopFactors, fractional: bool) -> DominantPoles:
    """Certify the largest of the poles to which all four starting points lead."""
    return _certify_largest(list_starts(loop, fractional), STEPS_ON_ALL, tolerance, loop, fractional)


def bisect_radius(_: DominantPoles, tolerance: float, loop: LoopFactors, fractional: bool) -> DominantPoles:
    """Find the dominant pole by bisecting the radius by means of counts, and refine the pole by a few Halley steps."""
    # Count on several circles at once, because for few walls this does not take longer than on one circle.
    parts = 2**BISECTIONS_PER_COUNT

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        low, width = state[0], (state[1] - state[0]) / parts
        radii = np.stack([low + k * width for k in range(1, parts)])
        all_inside = count_poles(
            radii, LoopFactors(*(np.broadcast_to(part, radii.shape) for part in loop)), fractional
        ).all_inside
        low = low + width * (~all_inside).sum(0)
        return low, low + width

    high = _bound_log_radius(loop)
    _, radius = iterate(-(-BISECTIONS // BISECTIONS_PER_COUNT), step, (0.0 * high + MIN_LOG_RADIUS, high), np)
    least_distance, im = np.inf, 0.0 * radius
    # On the circle with the bisected radius, the pole is at a crossover or on the real axis. Choose the candidate that
    # is nearest to a pole.
    for angle_guess in (0.0 * radius, 0.0 * radius + np.pi, *count_poles(radius, loop, fractional).crossovers):
        distance = newton_step(radius, angle_guess, loop, fractional).radius
        im, least_distance = np.where(distance < least_distance, angle_guess, im), np.minimum(distance, least_distance)
    point = iterate(POLISHING_STEPS, lambda point: halley_step(*point, loop, fractional), (radius, im), np)
    poles = certify_pole(*point, tolerance, loop, fractional, False)
    # Keep the bisected radius if the steps have not converged, as is usual near multiple poles.
    return poles._replace(re=np.where(poles.certified, poles.re, radius))


class _SearchState(NamedTuple):
    """The poles, certificates and bounds of the walls during the search in `_find_in_rounds`."""

    re: Array
    im: Array
    certified: Array
    low: Array  # lower bound of the log radius
    high: Array
    angles: Array  # angles of the crossovers on the last circle


def _find_traced(loop: LoopFactors, fractional: bool) -> tuple[Array, Array, Array]:
    """Return re and im of the dominant pole, and whether it is certified, under JAX transformations.

    The method is that of `quick_kernel`, then of `bisect_radius`.
    """
    # Divide the walls into parts and run the first round on each part. Then collect the walls without a certificate in
    # parts of the same size for the other rounds, so that one compiled program runs all rounds.
    import jax.numpy as xp
    from jax.lax import while_loop

    shape, size = loop.alpha.shape, loop.alpha.size
    length = max(-(-size // MAX_PARTS), MIN_PART_SIZE)
    if size <= length:
        return _find_in_rounds(0, 3, loop, fractional)
    columns, parts = [xp.broadcast_to(column, shape).reshape(-1) for column in loop], -(-size // length)

    def run_part(state: tuple[Any, ...]) -> tuple[Any, ...]:
        k, is_open, *results = state
        first = k < parts
        index = xp.where(first, k * length + xp.arange(length), xp.nonzero(is_open, size=length, fill_value=size)[0])
        part_loop = LoopFactors(*(column.at[index].get(mode="clip") for column in columns))
        part_results = _find_in_rounds(xp.where(first, 0, 1), xp.where(first, 1, 3), part_loop, fractional)
        is_open = is_open.at[index].set(first & ~(part_results[2] | xp.isnan(part_loop.alpha)), mode="drop")
        results = (column.at[index].set(new, mode="drop") for column, new in zip(results, part_results, strict=True))
        return k + 1, is_open, *results

    none = 0.0 * columns[0]
    start = 0, none > 0, none, none, none > 0
    part_results = while_loop(lambda state: (state[0] < parts) | state[1].any(), run_part, start)[2:]
    re, im, certified = (part.reshape(shape) for part in part_results)
    return re, im, certified


def _find_in_rounds(begin: Any, end: Any, loop: LoopFactors, fractional: bool) -> tuple[Array, Array, Array]:
    """Run the rounds ``begin`` to ``end - 1`` of the search on some walls, until all of them are certified.

    Round 0 refines and certifies the larger pole, round 1 bisects the radius, and round 2 refines and certifies the
    pole on the bisected circle.
    """
    # Newton step and count take long to compile. Therefore each of them is called at a single place, inside a program
    # loop, and the number of the round determines the first and the last iteration of this loop.
    import jax.numpy as xp
    from jax.lax import fori_loop, while_loop

    tolerance = epsilon(loop.c) ** 0.58
    high = _bound_log_radius(loop)
    # The candidates for the angle of the pole are 0, pi and the angles of the crossovers on the circle.
    n_candidates = 5 if fractional else 4
    n_steps = n_candidates + POLISHING_STEPS + NEWTON_STEPS
    # Ranges of the indices of steps and of counts in each round. In round 2 the first steps evaluate the candidates.
    # The counts after the bisections try the certificate on different circles.
    steps = xp.asarray([(n_candidates + POLISHING_STEPS - STEPS_ON_LARGER, n_steps), (n_steps, n_steps), (0, n_steps)])
    first_trial = BISECTIONS + 1
    counts = xp.asarray([(first_trial, first_trial + 1), (0, first_trial), (first_trial, first_trial + MAX_TRIALS)])

    def run_round(progress: tuple[Any, _SearchState]) -> tuple[Any, _SearchState]:
        round_index, state = progress

        def step(k: Any, position: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            re, im, distance = position
            is_candidate = k < n_candidates
            argument = xp.where(k < 2, np.pi * k, state.angles[xp.clip(k - 2, 0, n_candidates - 3)])
            argument = xp.where(is_candidate, argument, im)
            newton = newton_step(re, argument, loop, fractional)
            moves = halley_step(re, argument, loop, fractional), shift_pole(re, argument, newton.re, newton.im)
            to_re, to_im = (xp.where(k < n_steps - NEWTON_STEPS, *pair) for pair in zip(*moves, strict=True))
            # Keep the previous candidate unless the new one is nearer to a pole.
            keeps_previous = is_candidate & ~(newton.radius < distance)
            im = xp.where(keeps_previous, im, xp.where(is_candidate, argument, to_im))
            return xp.where(is_candidate, re, to_re), im, xp.where(keeps_previous, distance, newton.radius)

        start = xp.where(round_index == 0, state.re, state.high), state.im, xp.full_like(high, np.inf)
        re, im, distance = fori_loop(steps[round_index, 0], steps[round_index, 1], step, start)
        # Set log z to 0 if alpha = 0 and no pole is larger, because one pole is then exactly 1.
        at_one = (loop.alpha == 0) & ~(re > tolerance)
        re, im = xp.where(at_one, 0.0, re), xp.where(at_one, 0.0, im)

        def count_on_circle(k: Any, search: _SearchState) -> _SearchState:
            middle = xp.where(k < BISECTIONS, 0.5 * (search.low + search.high), search.high)
            width = xp.minimum(certification_width(re, tolerance) * 10.0 ** (k - first_trial), epsilon(re) ** 0.5)
            log_r = xp.where(k > BISECTIONS, re + width, middle)
            poles_outside = count_poles(log_r, loop, fractional)
            inside_level = materialize(
                xp.where(poles_outside.all_inside, xp.where(poles_outside.certain, 2.0, 1.0), 0.0), log_r
            )
            certifies = (
                (k > BISECTIONS)
                & ~search.certified
                & (inside_level > 1)
                & (at_one | (RADIUS_AFTER_STEP * distance <= tolerance))
            )
            return _SearchState(
                xp.where(certifies, re, search.re),
                xp.where(certifies, im, search.im),
                search.certified | certifies,
                xp.where((k < BISECTIONS) & (inside_level == 0), middle, search.low),
                xp.where((k < BISECTIONS) & (inside_level > 0), middle, search.high),
                xp.stack(poles_outside.crossovers),
            )

        return round_index + 1, fori_loop(counts[round_index, 0], counts[round_index, 1], count_on_circle, state)

    def is_unfinished(progress: tuple[Any, _SearchState]) -> Any:
        return (progress[0] == begin) | ((progress[0] < end) & ~(progress[1].certified | xp.isnan(loop.alpha)).all())

    no_angles = xp.stack([0.0 * high] * (n_candidates - 2))
    start = _SearchState(
        *approximate_larger_pole(loop, fractional), high > np.inf, 0.0 * high + MIN_LOG_RADIUS, high, no_angles
    )
    return while_loop(is_unfinished, run_round, (begin, start))[1][:3]


def traced_kernel(alpha: Array, beta: Array, delta: Array, d: Array, fractional: bool) -> Array:
    """Return the log of the spectral radius, with its derivatives, under JAX transformations.

    It is NaN if it could not be certified, or if the dominant pole is a multiple one.
    """
    xp = namespace(alpha, beta, delta, d)
    loop = materialize(factor_loop(alpha, beta, delta, d, fractional), delta)
    re, im, certified = _find_traced(stop_gradient(loop, xp), fractional)

    def evaluate(log_pole: Array, loop: LoopFactors) -> list[Array]:
        return [
            make_complex(part.real, part.imag)
            for part in evaluate_polynomial(log_pole.real, log_pole.imag, loop, fractional)[:2]
        ]

    log_pole = attach_root_derivatives(
        lambda *x: evaluate(*x)[0], make_complex(re, im), lambda *_: True, loop, slope=lambda *x: evaluate(*x)[1]
    )
    (log_radius,) = nan_unless(certified, log_pole.real)
    return log_radius + nan_with_nan_derivatives(valid_wall(alpha, beta, delta, d), alpha, beta, delta, d)
