"""How much gain, phase and delay a wall bears: the margins of control engineering, exact for the rigid loop.

``|L|`` has one crossover, and the phase there decides (docs/theory/one-crossover.md): each margin is the distance to
the one place where the loop becomes unstable, and its sign is the verdict.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zwidth.arrays.evaluate import evaluate
from zwidth.arrays.held_mass import ANY, DeviceTerms, device, split_delay
from zwidth.arrays.roots import false_position, follow_root, narrow_dips
from zwidth.loops.rigid.crossover import decide_in_floats, expand_short_delay_curve
from zwidth.loops.rigid.modulus import SAMPLES_WEIGHT, gain_frequency, modulus, size_and_phase
from zwidth.loops.rigid.normalization import valid_wall
from zwidth.words.results import Margins
from zwidth.words.types import Array, ArrayLike
from zwidth.words.xp import along, apply_each, epsilon, frozen, horner, namespace, nan_with_nan_slopes, store_once

# Steps of false position at most; every sixth one halves the bracket.
_STEPS = 240
# Samples of the fraction of a delay, and by how much closer than 1/delta, in which the held force of a strongly damped
# device changes, they lie to whole delays; a damping as good as none for that; steps to the lowest place they show.
_FRACTIONS, _GRADED, _LIGHT, _NARROWED = 64, 50.0, 1e-3, 24
# alpha, beta, delta, d and any phase.
_STABLE_WALL = (0.1, 0.4, 0.1, 0.0, 1.0)
# Of a stable wall whose margins vanish in rounding.
_LEAST_MARGIN = float(np.finfo(np.float32).tiny)
# A phase in radians below which its rounding may matter.
_SMALL_PHASE = 0.1
# A damping whose square float64 does not have.
_NO_DAMPING = 1e-150
# A phase that says unstable, where |L| is above 1 at every frequency.
_NO_CROSSOVER = -1e-3


def margins(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Margins:
    """Return the gain, phase, delay and modulus margin of a wall, with their frequencies.

    The open loop is ``L = N(z) (alpha z + beta (z - 1))/(z^(2+n) (z - 1)(z - c))``, d = n + f, see `char_poly`.

    - ``gain_margin``: the factor on both stiffness and virtual damping at which the loop becomes unstable. Of an
      unstable wall: the factor below 1 at which it becomes stable. No stable wall is known that becomes unstable with
      a smaller gain.
    - ``phase_margin``: the phase of L at the gain crossover plus 180 degrees. Of an unstable wall: the negative
      distance of this sum from the nearest multiple of 360 degrees. The wall is stable if and only if the phase
      margin is positive (and ``beta > -delta``).
    - ``delay_margin``: the additional delay, in periods, at which the loop first becomes unstable, with held fractional
      delays. A still longer delay may be stable again.
    - ``modulus_margin``: the smallest distance of L from -1, which is the inverse of the peak sensitivity.

    Args:
        alpha: normalized stiffness, > 0.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, integer or fractional (held). All four broadcast.

    Returns:
        Margins of the broadcast shape: ``gain_margin`` (a factor), ``phase_margin`` (degrees), ``delay_margin``
        (periods), ``modulus_margin``, and ``phase_crossover``, ``gain_crossover``, ``modulus_frequency`` in rad per
        sample, at most pi; ``omega/(2 pi T)`` is in Hz. NaN if alpha <= 0 or an argument is out of range.
        Of an unstable wall ``gain_margin`` is below 1, and 0 (with a NaN ``phase_crossover``) if no factor makes the
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
    """`margins` of arrays of one shape; the two margins that take a search may be left out, as NaN."""
    xp = namespace(alpha, beta, delta, d)
    ok = valid_wall(alpha, beta, delta, d) & (alpha > 0)
    spoiled = nan_with_nan_slopes(ok, alpha, beta, delta, d)
    alpha, beta, delta = xp.where(ok, alpha, 1.0), xp.where(ok, beta, 1.0), xp.where(ok, delta, 1.0)
    d = xp.where(ok, d, 0.0)
    # A damping whose square or inverse is beyond what there is moves no margin.
    delta = xp.where((delta > 0) & (delta < max(float(xp.finfo(delta.dtype).tiny), _NO_DAMPING)), 0.0, delta)
    here = store_once(device(delta, d), delta)
    w, phase, crosses = gain_frequency(alpha, beta, here)
    stable = store_once(decide_in_floats(*frozen((alpha, beta, here), xp), ANY), delta)
    gain, phase_crossover = _gain_margin(alpha, beta, here, xp)
    delay = distance = closest = xp.nan * alpha
    if with_delay:
        # Elsewhere a wall that is stable is asked about.
        known = zip((alpha, beta, delta, d, phase), _STABLE_WALL, strict=True)
        *wall, lag, lead = (xp.where(stable, value, other)[()] for value, other in known)
        delay = xp.where(stable, _delay_margin(tuple(wall), lag, lead, xp), 0.0)
    if with_modulus:
        distance, closest = modulus(alpha, beta, here)
    # Phases that differ by 360 degrees are equivalent: reduce the phase margin of an unstable wall to [-180, 0].
    turns = 2.0 * np.pi * xp.round(frozen(phase, xp) / (2.0 * np.pi))
    phase = xp.where(stable, phase, -xp.abs(phase - turns))
    decided = nan_with_nan_slopes(crosses & (beta > -delta), alpha, beta, delta, d)
    fields = (
        _on_the_side(gain, 1.0, epsilon(gain), stable, xp),
        _on_the_side(phase * (180.0 / np.pi), 0.0, _LEAST_MARGIN, stable, xp) + decided,
        _on_the_side(delay, 0.0, _LEAST_MARGIN, stable, xp),
        distance,
        phase_crossover,
        w + nan_with_nan_slopes(crosses, alpha, beta, delta, d),
        closest,
    )
    return Margins(*(field + spoiled for field in fields))


def _on_the_side(margin: Array, edge: float, least: float, stable: Array, xp: Any) -> Array:
    """A margin on the verdict's side of the edge: within rounding of it the two would contradict each other."""
    nearest = xp.where(stable, edge + least, edge)
    # It keeps its slopes there.
    return xp.where((margin < nearest) == stable, nearest + (margin - frozen(margin, xp)), margin)


def _gain_margin(alpha: Array, beta: Array, here: DeviceTerms, xp: Any) -> tuple[Array, Array]:
    """The factor on the wall at which its ray leaves the stable set, and the frequency there."""
    # The phase of L does not depend on the factor, and the gain crossover rises with it: the first zero of the phase
    # ends the stable part, or where there is none before z = -1 the line of that, where ``|L(-1)| = 1``.

    def phase(log_w: Array, alpha: Array, beta: Array, here: DeviceTerms) -> Array:
        # Times a positive factor: of order one on either side of sqrt(em), where for light damping the phase itself
        # is below rounding long before it changes sign.
        w, whole, em = xp.exp(log_w), here.whole, here.em
        (u0, u1), size, shape = expand_short_delay_curve(here)
        found = size_and_phase(w, alpha, beta, here)[1]
        # Below one period it vanishes at z = -1 in any case, and its other zero is lost in rounding beside that: there
        # the curve is read, which has that one only, by its sign ``beta alpha_w > alpha beta_w``.
        y = xp.sin(0.5 * w) ** 2
        terms = 4.0 * beta * y * horner(y, shape), here.delta * alpha * horner(y, size), -alpha * y * (u0 + u1 * y)
        ahead = sum(terms) / frozen(sum(map(xp.abs, terms)), xp)
        return xp.where((whole == 0) & (xp.abs(found) < _SMALL_PHASE), ahead, found * ((w + em) / (w * w + em)))

    # Here the phase of an undamped device is still that of its slope, of any other it is above pi/2 - 1/2.
    whole, em = here.whole, here.em
    slowness = 1.0 / xp.where(em > 0, em, 1e-9) + whole + 2.0 + xp.abs(beta) / alpha
    wall, (low, high) = frozen(((alpha, beta, here), (-xp.log(2.0 * slowness), xp.log(np.pi / (whole + 1.0)))), xp)
    start, end = apply_each(lambda x: phase(x, *wall), [low, high], xp)
    none = ~(start > 0)
    ends = low, high, xp.where(none, 1.0, start), -1.0 + 0.0 * low
    found = false_position(lambda x: phase(x, *wall), *ends, _STEPS, 1e-15)
    w = xp.minimum(xp.exp(follow_root(phase, found, _falling, alpha, beta, here)), np.pi)
    first = 1.0 / size_and_phase(w, alpha, beta, here)[0]
    line = xp.abs(here.gap * (alpha + 2.0 * beta))
    last = 2.0 * (1.0 + here.c) / xp.where(line > 0, line, 1.0)
    # From one period on the phase falls to 0 before, but for rounding.
    at_line = (whole == 0) & (line > 0) & (end > 0)
    gain = xp.where(none, 0.0, xp.where(at_line, last, first))
    return gain, xp.where(at_line, np.pi, w) + nan_with_nan_slopes(~none, alpha, beta, here.em)


def _falling(_: Array, slope: Array, step: Array) -> Array:
    """At an end of the range there is no zero to follow."""
    return (slope < 0) & (abs(step) < 1e-3)


def _delay_margin(wall: tuple[Array, ...], d: Array, phase: Array, xp: Any) -> Array:
    """The periods of delay up to the first loss of stability, for a stable wall."""
    # With the fraction f fixed the wall bears fewer than ``nu(f) = phase(n = 0)/w_c - 1/2`` whole periods, and one
    # period more moves nothing but n: the samples of nu serve every period.
    still = tuple(frozen(value, xp) for value in wall)
    whole, fraction = split_delay(d)
    grid = _grade_fractions(still[2], xp)
    crossings, phases, exist = _bound_undelayed(grid, *(value[..., None] + 0.0 * grid for value in still))
    periods = _borne(crossings, phases, exist)

    def sample(of: Array, at: Array) -> Array:
        return xp.take_along_axis(of, at, axis=-1)[..., 0][()]

    # Just before a whole delay a strongly damped device may bear less than at it: there is one such dip at most.
    dips = (periods[..., 1:-1] <= periods[..., :-2]) & (periods[..., 1:-1] < periods[..., 2:])
    if xp is not np or dips.any():
        place = xp.argmax(dips, axis=-1)[..., None] + 1
        left, middle, right = (sample(grid, place + k) for k in (-1, 0, 1))
        f, least = narrow_dips(
            lambda f: _borne(*_bound_undelayed(f, *still)), left, middle, right, sample(periods, place), _NARROWED
        )
        dips = xp.any(dips, axis=-1)[..., None] & (along(np.arange(_FRACTIONS + 1), xp.asarray(d)) == place)
        grid, periods = xp.where(dips, f[..., None], grid), xp.where(dips, least[..., None], periods)
    # One period on, f = 0 again, but for n: exactly so, whatever the rounding.
    periods = xp.concatenate([periods[..., :-1], periods[..., :1] - 1.0], axis=-1)
    now, part = frozen((whole, fraction), xp)
    ahead = (grid > part[..., None]) & (periods <= now[..., None])
    soon = xp.any(ahead, axis=-1)
    there = xp.where(soon, now, xp.maximum(now + 1.0, xp.ceil(xp.min(periods, axis=-1))))[()]
    lost = xp.where(soon[..., None], ahead, periods <= there[..., None])
    place = xp.maximum(xp.argmax(lost, axis=-1), 1)[..., None]
    excess_of = xp.where(exist, (periods - there[..., None]) * crossings, _NO_CROSSOVER)
    low, at_low = sample(grid, place - 1), sample(excess_of, place - 1)
    here_first = soon & (low < part)
    low = xp.where(here_first, part, low)[()]
    at_low = xp.where(here_first, frozen(phase, xp), at_low)[()]

    def excess(f: Array, there: Array, *wall: Array) -> Array:
        w, phase, exists = _bound_undelayed(f, *wall)
        return xp.where(exists, phase - there * w, _NO_CROSSOVER)

    high, at_high = sample(grid, place), xp.minimum(sample(excess_of, place), 0.0)
    # The delay is known to a rounding error of the whole of it.
    width = 4e-16 * (1.0 + there)
    f = false_position(lambda f: excess(f, there, *still), low, high, at_low, at_high, _STEPS, width)
    return there + follow_root(excess, f, _falling, there, *wall) - d


def _grade_fractions(delta: Array, xp: Any) -> Array:
    """Fractions from 0 to almost 1, along a last axis: at both ends in equal ratios, evenly where damping is light."""
    share = along(np.arange(_FRACTIONS + 1) / _FRACTIONS, xp.asarray(delta))
    growth = xp.log1p(_GRADED * xp.maximum(delta, _LIGHT))[..., None]
    from_end = 0.5 * xp.expm1(2.0 * xp.minimum(share, 1.0 - share) * growth) / xp.expm1(growth)
    return xp.minimum(xp.where(share <= 0.5, from_end, 1.0 - from_end), 1.0 - epsilon(delta))


def _borne(w: Array, phase: Array, exists: Array) -> Array:
    """nu of `_delay_margin`, which no crossover leaves below all periods."""
    xp = namespace(w)
    return xp.where(exists, phase / w, -xp.inf)


def _bound_undelayed(f: Array, alpha: Array, beta: Array, delta: Array) -> tuple[Array, Array, Array]:
    """Below one period of delay: the crossover, the phase there, and whether there is one."""
    return gain_frequency(alpha, beta, store_once(device(delta, f), f))
