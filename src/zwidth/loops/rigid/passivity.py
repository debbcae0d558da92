"""Passivity of the sampled wall of the rigid loop (Colgate's condition), for any delay.

Per frequency the condition is a lower bound on the physical damping (docs/theory/passivity.md), convex and homogeneous
in (alpha, beta): one convex set for each delay, whatever the device. Where the bound is highest:
`loops.rigid.needed_damping`. On a map of one delay it is a polynomial of one variable, the direction.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from zwidth.arrays.evaluate import FEW, as_number, check_scalars, evaluate, evaluate_columns, to_caller
from zwidth.arrays.held_mass import ANY, DelayClasses, classify_delays, valid_device
from zwidth.arrays.roots import integrate
from zwidth.loops.rigid.folding import NAMES, Points, fold_arguments, group_by_value, restore_shape
from zwidth.loops.rigid.needed_damping import compute_needed_damping, find_directions, solve_larger_root
from zwidth.loops.rigid.normalization import valid_wall
from zwidth.words.quantities import LONGEST_DELAY
from zwidth.words.types import Array, ArrayLike
from zwidth.words.xp import frozen, horner, is_traced, namespace, nan_with_nan_slopes

# Chebyshev terms: the last one is below 1e-16 for every delay.
_TERMS = 30
# Each narrows the bracket of a direction eightfold.
_ROUNDS = 17
_NO_DELAY = DelayClasses(True, False, False)


def _margin_kernel(alpha: Array, beta: Array, delta: Array, d: Array, kind: DelayClasses) -> Array:
    xp = namespace(alpha, beta, delta, d)
    ok = valid_wall(alpha, beta, delta, d)
    # At 0 with the slope from the right, which the larger of the two would halve.
    stiff = xp.where(ok & (alpha >= 0), alpha, 0.0)
    damper, delay = xp.where(ok, beta, 0.0), xp.where(ok, d, 0.0)
    margin = delta - compute_needed_damping(stiff, damper, delay, kind)
    return _limit_margin(margin, alpha) + nan_with_nan_slopes(ok, alpha, beta, delta, d)


def _limit_margin(margin: Array, alpha: Array) -> Array:
    """A spring of negative stiffness gives unbounded energy, which the frequency condition does not see."""
    xp = namespace(margin, alpha)
    return xp.where(alpha < 0, xp.minimum(margin, alpha), margin)


@lru_cache(maxsize=256)
def table(d: float) -> tuple[float, ...]:
    """What all walls of one delay need, as one polynomial of the direction: what `_map_kernel` takes."""
    # Between its directions ``needed/(beta + (width - first) alpha)`` is analytic in ``x/(x + width alpha)``, ``x =
    # beta - first alpha``, up to beta = infinity; its Chebyshev series falls by a factor of 4 a term, for every delay.
    first, last_turn = find_directions(np.float64(d))
    width = 0.5 * (d + 0.5)
    span = last_turn - first
    last = span / (span + width) if np.isfinite(span) else 1.0
    # Whole turns taken off in whole numbers: an angle of 30 pi would leave half of them without their last digits.
    turns = np.outer(np.arange(_TERMS), 2 * np.arange(_TERMS) + 1) % (4 * _TERMS)
    cosines = np.cos(np.pi * turns / (2 * _TERMS))
    node = cosines[1]
    place = 0.5 * last * (node + 1.0)
    alpha = 1.0 - place
    beta = first * alpha + place * width
    with np.errstate(all="ignore"):
        needed = compute_needed_damping(alpha, beta, np.full(_TERMS, d))
    # place width + alpha width is the width.
    terms = cosines @ needed * (2.0 / (_TERMS * width))
    terms[0] *= 0.5
    # By powers, whose coefficients fall as well: Clenshaw's sum loses two digits towards the ends.
    powers = np.polynomial.chebyshev.cheb2poly(terms)
    limit = float(last) if np.isfinite(span) else np.inf
    return d - np.floor(d), d + 0.5, float(first), width, float(last), limit, *powers.tolist()


def _map_kernel(alpha: Array, beta: Array, delta: Array, *known: Any) -> Array:
    """`passivity_margin` at one delay, given its `table`."""
    # The fraction; the slope in alpha of what is needed at w = 0, for whole d; the first of the `directions`, a width,
    # and the last one in the variable of the polynomial, twice: the limit is infinite where there is none.
    xp = namespace(alpha)
    f, at_zero, first, width, last, limit, *powers = known
    ok = valid_wall(alpha, beta, delta, 0.0 * delta)
    stiff = xp.maximum(alpha, 0.0)
    beyond = beta - first * stiff
    size = beyond + width * stiff
    place = beyond / xp.where(beyond > 0, size, 1.0)
    y = 2.0 * place / last - 1.0
    inside = size * horner(y, powers)
    zero, _ = solve_larger_root(at_zero * stiff - beta, f * (1.0 - f) * stiff * stiff, xp)
    pi = (1.0 - f) * (beta + 0.5 * stiff)
    needed = xp.where(beyond > 0, xp.where(place < limit, inside, pi), zero)
    return xp.where(ok, _limit_margin(delta - needed, alpha), xp.nan)


def margin_at_one_delay(alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: float) -> np.ndarray:
    """`passivity_margin` of arrays of one shape by NumPy; a point's value does not depend on the others."""
    if not 0 <= d <= LONGEST_DELAY:
        return np.full(alpha.shape, np.nan)
    with np.errstate(all="ignore"):
        return _map_kernel(alpha, beta, delta, *table(d))


def _on_maps(values: tuple[ArrayLike, ...]) -> Array | None:
    """`passivity_margin` of many walls that share few delays; None where they do not."""
    points, shape = fold_arguments(values)
    if points.size <= FEW or np.unique(points.d).size * FEW > points.size:
        return None
    out = np.full(points.shape, np.nan)
    for delay, arrays, place in group_by_value(points, points.d):
        if not 0 <= delay <= LONGEST_DELAY:
            continue
        walls = Points(*arrays)
        columns = [*walls.columns()[:3], *map(np.atleast_1d, table(float(delay)))]
        out[place] = evaluate_columns(_map_kernel, columns, route="jax").reshape(walls.shape)
    return to_caller(restore_shape(out, shape), values)


def passivity_margin(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return by how much the physical damping exceeds what a passive wall needs.

    ``margin = delta - sup_w needed(w)``, in units of delta = b T/m; the wall is passive where it is positive. At
    d = 0 it is ``delta - alpha/2 - |beta|``, eq. (21).

    Args:
        alpha: normalized stiffness; no damping makes a wall of negative stiffness passive, and its margin is at most
            alpha itself.
        beta: normalized virtual damping.
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held). All four broadcast.

    Returns:
        Array of the broadcast shape; NaN where the input is out of range (see `loops.rigid.normalization`).

    Numerics:
        About 1e-15 of what is needed, at a cost that does not grow with d. Where the condition peaks is proved for
        whole d, and seen for held delays (`loops.rigid.needed_damping`). Many walls that share a delay go by a
        polynomial of their direction. Traceable, also twice; at whole d derivatives in d are those from the right, as
        those in alpha at alpha = 0; those in beta at beta = 0 are from below where d = 0, and 0 at the peak without a
        wall.

    References:
        Colgate, Schenkel 1994; Hulin, Preusche, Hirzinger 2006, eqs. (20), (21), here extended to any delay.

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.passivity_margin(0.2, 0.3, 1.0, 0):.2f}")
        0.60
    """
    values = (alpha, beta, delta, d)
    arguments = dict(zip(NAMES, values, strict=True))
    if is_traced(*values):
        return evaluate(_margin_kernel, arguments, ANY)
    if not all(isinstance(value, int | float | np.number) for value in values):
        check_scalars(arguments)
        found = _on_maps(values)
        if found is not None:
            return found
    return evaluate(_margin_kernel, arguments, _NO_DELAY if classify_delays(d) == _NO_DELAY else ANY)


def is_passive(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Whether the wall is passive, for any delay: `passivity_margin` > 0.

    Passive implies stable for alpha > 0; stable does not imply passive.

    Args:
        alpha, beta, delta, d: as for `passivity_margin`.

    Returns:
        Boolean array of the broadcast shape; False where the input is out of range. Right beyond about 1e-15 of the
        boundary.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> import zwidth
        >>> bool(zwidth.is_passive(0.2, 0.3, 1.0, 0)), bool(zwidth.is_passive(0.2, 0.9, 1.0, 0))
        (True, False)
    """
    values = (alpha, beta, delta, d)
    margin = passivity_margin(*values)
    if is_traced(*values):
        return margin > 0
    # Compared by NumPy: outside float64 mode JAX would warn of the type it keeps.
    return to_caller(np.asarray(margin) > 0, values)


def passive_stiffness_slope(d: float) -> tuple[float, float]:
    """The stiffest passive wall and its damping, both over delta, for one delay: the condition is homogeneous."""
    check_scalars({"d": d})
    delay = as_number("d", d, 0.0)
    period = delay + 1.0
    if period == np.floor(period):
        # Where cos((d + 1) w) = 0 the damping has no effect on the peak.
        half = np.pi / (4.0 * period)
        slope = 2.0 * np.tan(half)
        return float(slope), float(slope * (0.25 / (period * np.sin(half) ** 2) - 0.5))
    unit = 1.0 / (period - 0.5)

    def stiffness(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        alpha, beta = unit * np.cos(angles), np.sin(angles)
        needed = compute_needed_damping(alpha, beta, np.full(angles.shape, delay))
        return alpha / needed, beta / needed

    lower, upper = -0.49 * np.pi, 0.49 * np.pi
    # The passive set is convex, so that it has one tip.
    with np.errstate(all="ignore"):
        for _ in range(_ROUNDS):
            angles = np.linspace(lower, upper, 17)
            best = int(np.argmax(stiffness(angles)[0]))
            lower, upper = angles[max(best - 1, 0)], angles[min(best + 1, 16)]
        alpha, beta = stiffness(np.array([0.5 * (lower + upper)]))
    return float(alpha[0]), float(beta[0])


# Gauss-Legendre nodes for each of the three parts of what is needed, and what a point weighs for them.
_PASSIVE_NODES, _PASSIVE_WEIGHT = (64, 64, 32), 64


def passive_area(delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the area of the passive set in the (alpha, beta) plane.

    The condition is convex and homogeneous in (alpha, beta, delta): with ``needed(phi)`` the physical damping that
    the wall ``(cos phi, sin phi)`` needs, ``A = (delta^2/2) integral of needed(phi)^-2`` over phi from -pi/2 to pi/2.
    At d = 0 it is the triangle ``delta > alpha/2 + |beta|``: ``A = 2 delta^2``.

    Args:
        delta: normalized physical damping, >= 0.
        d: delay in periods, >= 0, whole or not (held). Both broadcast.

    Returns:
        Array of the broadcast shape; NaN out of range (see `loops.rigid.normalization`).

    Numerics:
        Gauss-Legendre quadrature between the kinks of ``needed``: about 1e-14 relative, at a cost that does not grow
        with d. Traceable, with derivatives; those in d at whole d are from the right.

    References:
        Colgate, Brown 1994 (Z-width); Hulin, Preusche, Hirzinger 2006, eq. (21), here extended to any delay.

    Example:
        >>> from zwidth import passive_area
        >>> print(f"{passive_area(0.5, 0):.4f}")
        0.5000
    """
    return evaluate(_passive_area_kernel, {"delta": delta, "d": d}, weight=_PASSIVE_WEIGHT)


def _passive_area_kernel(delta: Array, d: Array) -> Array:
    """By direction: ``alpha = cos(theta)/(d + 1/2)``, ``beta = sin(theta)``."""
    # Below the first of `directions` what a wall needs is decided at omega = 0, above the last one (d < 2/9 only) at
    # pi, between them at one omega that rises with theta, without a jump: what is needed is analytic in theta there.
    xp = namespace(delta, d)
    ok = valid_device(delta, d)
    safe_d = xp.where(ok, d, 1.0)
    unit = 1.0 / (safe_d + 0.5)
    # Where the kinks lie does not matter to the first order.
    first, last = (xp.arctan(t * frozen(unit, xp)) for t in find_directions(frozen(safe_d, xp)))
    end = 0.5 * np.pi + 0.0 * safe_d

    def share(theta: Array) -> Array:
        # The straight edge alpha = 0 is the range of theta: rounding must not lead beyond it.
        alpha = xp.maximum(xp.cos(theta), 0.0) * unit[..., None]
        return compute_needed_damping(alpha, xp.sin(theta), safe_d[..., None] + 0.0 * theta) ** -2

    inverse_squares = integrate(share, (-end, first, last, end), _PASSIVE_NODES)
    return 0.5 * delta * delta * unit * inverse_squares + nan_with_nan_slopes(ok, delta, d)
