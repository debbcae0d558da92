"""Compute the gain, phase, delay and modulus margin of walls on rigid devices.

The open loop L of `stability.rigid.crossover` has at most one gain crossover, and the phase at this frequency decides
stability (docs/theory/one-crossover.md). Therefore each margin is the distance to a single point where the loop becomes
unstable, and its sign agrees with the stability verdict.

A wall has the normalized stiffness alpha and damping beta, its device the normalized damping delta; the delay is
d = n + f periods (n integer, 0 <= f < 1), c = e^-delta and em = 1 - c. In the code the *phase* is arg L + pi in rad at
the frequency w, so that the loop is stable if the phase at the gain crossover is positive. (alpha_w, beta_w) is the
wall with a pole at e^(j w).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import (
    apply_each,
    epsilon,
    expand_along,
    horner,
    materialize,
    namespace,
    nan_with_nan_derivatives,
    stop_gradient,
)
from zwidth.numerics.evaluate import evaluate
from zwidth.numerics.root_finding import attach_root_derivatives, false_position, minimize_golden_section
from zwidth.plant.rigid_mass import ANY, DiscretePlant, discretize_plant, split_delay
from zwidth.stability.results import Margins
from zwidth.stability.rigid.characteristic_polynomial import evaluate_at_nyquist
from zwidth.stability.rigid.crossover import decide_in_floats, expand_short_delay_curve
from zwidth.stability.rigid.modulus import (
    SAMPLES_WEIGHT,
    evaluate_at_crossover,
    evaluate_gain_and_phase,
    find_modulus_margin,
)
from zwidth.stability.rigid.normalization import valid_wall

# Maximum number of steps of false position; every sixth step bisects the bracket.
FALSE_POSITION_STEPS = 240
# Number of samples of the fractional part f of the delay, from which the delay margin is computed.
N_FRACTIONS = 64
# Grading of these samples: those next to an integer delay are closer to it than 1/delta by this factor, because for
# strong damping the effect of a fractional delay changes within 1/delta periods.
GRADING = 50.0
# Value of delta below which the samples are practically evenly spaced.
LIGHT_DAMPING = 1e-3
# Number of golden-section steps to a local minimum between these samples.
GOLDEN_SECTION_STEPS = 24
# A stable wall (alpha, beta, delta, d and an arbitrary phase), which replaces unstable ones in the delay margin search.
STABLE_WALL = (0.1, 0.4, 0.1, 0.0, 1.0)
# Margin reported for a stable wall if the computed margin is 0 within rounding error.
LEAST_MARGIN = float(np.finfo(np.float32).tiny)
# Phase in rad below which the sign of a computed phase may be wrong because of rounding errors.
SMALL_PHASE = 0.1
# Values of delta below this one are set to 0, because their squares underflow in float64.
NEGLIGIBLE_DAMPING = 1e-150
# Phase in rad assumed if |L| is above 1 at every frequency; negative, because the loop is then unstable.
NO_CROSSOVER_PHASE = -1e-3


def margins(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Margins:
    """Return the gain, phase, delay and modulus margin of a wall, with their frequencies.

    The open loop is ``L = N(z) (alpha z + beta (z - 1))/(z^(2+n) (z - 1)(z - c))``, d = n + f, see `char_poly`.

    - ``gain_margin``: the factor on both stiffness and virtual damping at which the loop becomes unstable; for an
      unstable wall, the factor below 1 at which it becomes stable. No stable wall is known that becomes unstable with
      a smaller gain.
    - ``phase_margin``: the phase of L at the gain crossover plus 180 degrees; for an unstable wall, the negative
      distance of this sum from the nearest multiple of 360 degrees. The wall is stable if and only if the phase
      margin is positive (and ``beta > -delta``).
    - ``delay_margin``: the additional delay, in periods, at which the loop first becomes unstable. Fractional delays
      are exact (zero-order hold). A still longer delay may be stable again.
    - ``modulus_margin``: the smallest distance of L from -1, which is the inverse of the peak sensitivity.

    Args:
        alpha: normalized stiffness, > 0.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, integer or fractional. All four broadcast.

    Returns:
        Margins of the broadcast shape: ``gain_margin`` (a factor), ``phase_margin`` (degrees), ``delay_margin``
        (periods), ``modulus_margin``, and ``phase_crossover``, ``gain_crossover``, ``modulus_frequency`` in rad per
        sample, at most pi; ``omega/(2 pi T)`` is in Hz. NaN if alpha <= 0 or an argument is out of range.
        For an unstable wall ``gain_margin`` is below 1, and 0 (with a NaN ``phase_crossover``) if no factor makes the
        wall stable; ``phase_margin`` is between -180 and 0 degrees; ``delay_margin`` is 0. ``phase_margin`` and
        ``gain_crossover`` are NaN if ``|L|`` is above 1 at every frequency. ``phase_margin`` is also NaN if
        beta <= -delta, because stability then does not depend on the phase.

    Numerics:
        Phase margin and gain crossover are in closed form. The other margins are computed to about 1e-14, at a cost
        independent of d. For the delay margin, fractional delays are sampled 64 times per period, most densely near
        integer delays, and the lowest loss of stability between the samples is refined: with strong damping a wall may
        be unstable only in a short interval below an integer delay. Traceable: `jit`, `vmap`, `grad`. A margin that is
        NaN has NaN derivatives. `jax.jacrev` of several margins then returns NaN for all margins of the wall;
        `jax.jacfwd` does not.

    References:
        Landau 1990 (modulus margin); python-control's `stability_margins`, which calls them gm, pm, sm, wpc, wgc, wms.

    Example:
        >>> import zwidth
        >>> found = zwidth.margins(0.1, 0.4, 0.1, 1)
        >>> print(f"{found.gain_margin:.3f} {found.phase_margin:.2f} {found.delay_margin:.3f}")
        1.593 22.78 0.837
    """
    arguments = {"alpha": alpha, "beta": beta, "delta": delta, "d": d}
    return evaluate(margins_kernel, arguments, weight=SAMPLES_WEIGHT, route="numpy")


def margins_kernel(
    alpha: Array, beta: Array, delta: Array, d: Array, with_delay: bool = True, with_modulus: bool = True
) -> Margins:
    """Return `margins` of arrays of one shape; the delay and modulus margins are NaN if they are not requested."""
    xp = namespace(alpha, beta, delta, d)
    ok = valid_wall(alpha, beta, delta, d) & (alpha > 0)
    nan_if_invalid = nan_with_nan_derivatives(ok, alpha, beta, delta, d)
    alpha, beta, delta = xp.where(ok, alpha, 1.0), xp.where(ok, beta, 1.0), xp.where(ok, delta, 1.0)
    d = xp.where(ok, d, 0.0)
    # Set delta to 0 if its square underflows or its inverse overflows, because so small a delta has no effect on the
    # margins.
    delta = xp.where((delta > 0) & (delta < max(float(xp.finfo(delta.dtype).tiny), NEGLIGIBLE_DAMPING)), 0.0, delta)
    plant = materialize(discretize_plant(delta, d), delta)
    w, phase, crosses = evaluate_at_crossover(alpha, beta, plant)
    stable = decide_in_floats(*stop_gradient((alpha, beta, plant), xp), ANY)
    gain, phase_crossover = _find_gain_margin(alpha, beta, plant, xp)
    delay = distance = closest = xp.nan * alpha
    if with_delay:
        # Replace unstable walls by `STABLE_WALL`, so that the search is well defined; its result is not used for them.
        pairs = zip((alpha, beta, delta, d, phase), STABLE_WALL, strict=True)
        *wall, delay0, phase0 = (xp.where(stable, value, substitute)[()] for value, substitute in pairs)
        delay = xp.where(stable, _find_delay_margin(tuple(wall), delay0, phase0, xp), 0.0)
    if with_modulus:
        distance, closest = find_modulus_margin(alpha, beta, plant)
    # Phases that differ by 360 degrees are equivalent: reduce the phase margin of an unstable wall to [-180, 0].
    turns = 2.0 * np.pi * xp.round(stop_gradient(phase, xp) / (2.0 * np.pi))
    phase = xp.where(stable, phase, -xp.abs(phase - turns))
    nan_if_undecided = nan_with_nan_derivatives(crosses & (beta > -delta), alpha, beta, delta, d)
    fields = (
        _place_by_verdict(gain, 1.0, epsilon(gain), stable, xp),
        _place_by_verdict(phase * (180.0 / np.pi), 0.0, LEAST_MARGIN, stable, xp) + nan_if_undecided,
        _place_by_verdict(delay, 0.0, LEAST_MARGIN, stable, xp),
        distance,
        phase_crossover,
        w + nan_with_nan_derivatives(crosses, alpha, beta, delta, d),
        closest,
    )
    return Margins(*(field + nan_if_invalid for field in fields))


def _place_by_verdict(margin: Array, edge: float, least: float, stable: Array, xp: Any) -> Array:
    """Move a margin to the side of ``edge`` that agrees with the verdict, because rounding errors may contradict it.

    Args:
        margin: Computed margin.
        edge: Margin of a wall on the stability boundary: 1 for the gain margin, otherwise 0.
        least: Least difference between the margin of a stable wall and the edge.
        stable: The verdict.
        xp: Array namespace.
    """
    nearest = xp.where(stable, edge + least, edge)
    # Add a difference whose value is 0 but whose derivatives are those of the margin.
    return xp.where((margin < nearest) == stable, nearest + (margin - stop_gradient(margin, xp)), margin)


def _find_gain_margin(alpha: Array, beta: Array, plant: DiscretePlant, xp: Any) -> tuple[Array, Array]:
    """Return the factor on alpha and beta at which the loop becomes unstable, and the frequency of this onset."""
    # The phase does not depend on a common factor of alpha and beta, and the gain crossover increases with it. So the
    # loop is stable until the crossover reaches the first zero of the phase or, if the phase has no zero below the
    # Nyquist frequency (z = -1), until ``|L(-1)| = 1``.

    def evaluate_phase(log_w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> Array:
        # Multiply the phase by a positive factor that makes it of order 1 on both sides of w = sqrt(em), because for
        # light damping the phase is smaller than its rounding error even far from its zero.
        w, n, em = xp.exp(log_w), plant.whole, plant.em
        (u0, u1), modulus_terms, stiffness_terms = expand_short_delay_curve(plant)
        phase_at_w = evaluate_gain_and_phase(w, alpha, beta, plant)[1]
        # For d < 1 the phase is 0 at z = -1 in any case, and near there rounding errors may hide its other zero.
        # Therefore use the sign of ``beta alpha_w - alpha beta_w``, which has only the other zero.
        y = xp.sin(0.5 * w) ** 2
        terms = (
            4.0 * beta * y * horner(y, stiffness_terms),
            plant.delta * alpha * horner(y, modulus_terms),
            -alpha * y * (u0 + u1 * y),
        )
        normalized = sum(terms) / stop_gradient(sum(map(xp.abs, terms)), xp)
        return xp.where(
            (n == 0) & (xp.abs(phase_at_w) < SMALL_PHASE), normalized, phase_at_w * ((w + em) / (w * w + em))
        )

    # Choose the lower end of the bracket so low that the phase of an undamped device is still linear in w; with damping
    # the phase is above pi/2 - 1/2 there.
    n, em = plant.whole, plant.em
    slowness = 1.0 / xp.where(em > 0, em, 1e-9) + n + 2.0 + xp.abs(beta) / alpha
    wall, (low, high) = stop_gradient(((alpha, beta, plant), (-xp.log(2.0 * slowness), xp.log(np.pi / (n + 1.0)))), xp)
    start, end = apply_each(lambda x: evaluate_phase(x, *wall), [low, high], xp)
    never_stable = ~(start > 0)
    bracket = low, high, xp.where(never_stable, 1.0, start), -1.0 + 0.0 * low
    log_w = false_position(lambda x: evaluate_phase(x, *wall), *bracket, FALSE_POSITION_STEPS, 1e-15)
    w = xp.minimum(xp.exp(attach_root_derivatives(evaluate_phase, log_w, _is_falling, alpha, beta, plant)), np.pi)
    gain_at_zero = 1.0 / evaluate_gain_and_phase(w, alpha, beta, plant)[0]
    wall_at_nyquist, device_at_nyquist = evaluate_at_nyquist(alpha, beta, plant)
    wall_at_nyquist = xp.abs(wall_at_nyquist)
    gain_at_nyquist = device_at_nyquist / xp.where(wall_at_nyquist > 0, wall_at_nyquist, 1.0)
    # Require n = 0, because for d >= 1 the phase has a zero below w = pi, although rounding errors may hide it.
    ends_at_nyquist = (n == 0) & (wall_at_nyquist > 0) & (end > 0)
    gain = xp.where(never_stable, 0.0, xp.where(ends_at_nyquist, gain_at_nyquist, gain_at_zero))
    return gain, xp.where(ends_at_nyquist, np.pi, w) + nan_with_nan_derivatives(~never_stable, alpha, beta, plant.em)


def _is_falling(_: Array, slope: Array, step: Array) -> Array:
    """Return whether a function decreases at its computed zero; otherwise the zero is an end of the range."""
    return (slope < 0) & (abs(step) < 1e-3)


def _find_delay_margin(wall: tuple[Array, ...], d: Array, phase: Array, xp: Any) -> Array:
    """Return the additional delay, in periods, at which a stable wall first becomes unstable."""
    # For a fixed fraction f, the wall is stable for integer delays n < nu(f), where nu(f) is the phase for n = 0 at the
    # gain crossover, divided by its frequency. The crossover does not depend on n, so the samples of nu serve all n.
    frozen_wall = tuple(stop_gradient(value, xp) for value in wall)
    n, fraction = split_delay(d)
    grid = _grade_fractions(frozen_wall[2], xp)
    crossings, phases, exist = _evaluate_fraction(grid, *(value[..., None] + 0.0 * grid for value in frozen_wall))
    limits = _limit_delay(crossings, phases, exist)

    def sample(values: Array, index: Array) -> Array:
        return xp.take_along_axis(values, index, axis=-1)[..., 0][()]

    # Refine the local minimum of nu(f) between the samples. For strong damping nu may have one just below an integer
    # delay, but no second one.
    dips = (limits[..., 1:-1] <= limits[..., :-2]) & (limits[..., 1:-1] < limits[..., 2:])
    if xp is not np or dips.any():
        index = xp.argmax(dips, axis=-1)[..., None] + 1
        left, middle, right = (sample(grid, index + k) for k in (-1, 0, 1))
        f, least = minimize_golden_section(
            lambda f: _limit_delay(*_evaluate_fraction(f, *frozen_wall)),
            left,
            middle,
            right,
            sample(limits, index),
            GOLDEN_SECTION_STEPS,
        )
        dips = xp.any(dips, axis=-1)[..., None] & (expand_along(np.arange(N_FRACTIONS + 1), xp.asarray(d)) == index)
        grid, limits = xp.where(dips, f[..., None], grid), xp.where(dips, least[..., None], limits)
    # The delay n + f with f = 1 is the delay n + 1 with f = 0. Therefore set nu(1) = nu(0) - 1 without rounding errors.
    limits = xp.concatenate([limits[..., :-1], limits[..., :1] - 1.0], axis=-1)
    n_now, f_now = stop_gradient((n, fraction), xp)
    later = (grid > f_now[..., None]) & (limits <= n_now[..., None])
    is_this_period = xp.any(later, axis=-1)
    n_lost = xp.where(is_this_period, n_now, xp.maximum(n_now + 1.0, xp.ceil(xp.min(limits, axis=-1))))[()]
    unstable = xp.where(is_this_period[..., None], later, limits <= n_lost[..., None])
    index = xp.maximum(xp.argmax(unstable, axis=-1), 1)[..., None]
    excesses = xp.where(exist, (limits - n_lost[..., None]) * crossings, NO_CROSSOVER_PHASE)
    low, excess_low = sample(grid, index - 1), sample(excesses, index - 1)
    starts_at_d = is_this_period & (low < f_now)
    low = xp.where(starts_at_d, f_now, low)[()]
    excess_low = xp.where(starts_at_d, stop_gradient(phase, xp), excess_low)[()]

    def excess(f: Array, n_lost: Array, *wall: Array) -> Array:
        w, phase, exists = _evaluate_fraction(f, *wall)
        return xp.where(exists, phase - n_lost * w, NO_CROSSOVER_PHASE)

    high, excess_high = sample(grid, index), xp.minimum(sample(excesses, index), 0.0)
    # Stop if the bracket is as narrow as the rounding error of the total delay.
    width = 4e-16 * (1.0 + n_lost)
    f = false_position(
        lambda f: excess(f, n_lost, *frozen_wall), low, high, excess_low, excess_high, FALSE_POSITION_STEPS, width
    )
    return n_lost + attach_root_derivatives(excess, f, _is_falling, n_lost, *wall) - d


def _grade_fractions(delta: Array, xp: Any) -> Array:
    """Return fractions f from 0 to almost 1 along a last axis, denser at both ends; evenly spaced for light damping."""
    share = expand_along(np.arange(N_FRACTIONS + 1) / N_FRACTIONS, xp.asarray(delta))
    growth = xp.log1p(GRADING * xp.maximum(delta, LIGHT_DAMPING))[..., None]
    from_end = 0.5 * xp.expm1(2.0 * xp.minimum(share, 1.0 - share) * growth) / xp.expm1(growth)
    return xp.minimum(xp.where(share <= 0.5, from_end, 1.0 - from_end), 1.0 - epsilon(delta))


def _limit_delay(w: Array, phase: Array, exists: Array) -> Array:
    """Return nu, such that integer delays n < nu are stable; -inf without a gain crossover, where no n is stable."""
    xp = namespace(w)
    return xp.where(exists, phase / w, -xp.inf)


def _evaluate_fraction(f: Array, alpha: Array, beta: Array, delta: Array) -> tuple[Array, Array, Array]:
    """Return the gain crossover, the phase there, and whether the crossover exists, for a delay f < 1."""
    return evaluate_at_crossover(alpha, beta, discretize_plant(delta, f))
