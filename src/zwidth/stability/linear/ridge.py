"""Find the stiffest stable wall of any linear loop and its active constraints.

A wall has the normalized stiffness alpha and damping beta. Arcs of the boundary of the stable set are called *edges*.
On an edge, a pole is on the unit circle at ``e^(jw)``. The maximum of alpha over the stable set is a smooth maximum on
an edge, a corner where two edges meet, or, if only beta >= 0 is allowed, a point of an edge with beta = 0. It solves
two conditions on ``r(z) = alpha + beta F(z) - q(z)`` (q and F as in `stability.linear.roots`; docs/theory/scenes.md,
V19):

    first     r(e^(j w1)) = 0 for a pole pair, or for a real pole at z = -1 or z = 1
    second    the same at w2; or alpha is stationary along the curve of the first condition; or beta = 0

If a parameter changes slightly, the same conditions remain active, so the derivatives of alpha follow from them by the
implicit function theorem (V21; `stability.linear.derivatives`). In arrays of crossings, a *row* belongs to a line of
constant B and a *column* to an arc or crossing line, as in `stability.linear.boundary`.

A *main* piece of the stable set is one that is connected to K = 0 (`stability.linear.regions`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from zwidth.core.status import RidgeKind
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.curve import evaluate_curve
from zwidth.stability.linear.regions import StableSet
from zwidth.stability.linear.rows import find_stable_intervals

# Settings of the search for corners.
CORNER_TOLERANCE = 1e-8  # largest difference in alpha of the two crossings at a corner, relative to alpha
NEAR_CORNER = 1e-5  # largest relative change of beta from its starting value; at an end of the curve, of alpha
MAX_STEPS = 4  # Newton steps
CONVERGED_STEP = 1e-15  # last Newton step, relative to beta

ON_LOSSLESS = 1e-9  # largest distance from the lossless damping, relative to the width of the stable set in beta
# If the alpha of a stable wall exceeds the computed maximum by more than this fraction, the result is rejected. Smaller
# differences are rounding errors.
CONTRADICTION = 1e-7

# Test of a maximum on nearby lines of constant B. The scale of the offsets is the width of the stable set plus |beta|.
NEIGHBOR_OFFSETS = np.array([0.0, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3, -1e-3])  # offsets in beta / scale
REACHED_FRACTION = 0.99  # fraction of the maximum alpha that a stable interval of one line must reach


class Condition(IntEnum):
    """An active constraint of the stiffest wall."""

    PAIR = 0  # a pole pair on the unit circle
    MINUS_ONE = 1  # a pole at z = -1
    PLUS_ONE = 2  # a pole at z = 1
    STATIONARY = 3  # d alpha/dw = 0 along the boundary curve
    NO_DAMPING = 4  # beta = 0


class RidgeSolution(NamedTuple):
    """The stiffest stable wall and its two active constraints; w2 is w1 if the second constraint has no angle."""

    alpha: float
    beta: float
    w1: float
    w2: float
    first: Condition
    second: Condition

    @property
    def omega(self) -> float:
        """The angle of the poles on the unit circle with this wall; at a corner, the higher of the two angles."""
        return max(self.w1, self.w2) if self.second <= Condition.PLUS_ONE else self.w1

    @property
    def kind(self) -> RidgeKind:
        """The kind of the maximum: smooth, a corner, or on the line beta = 0 that bounds the allowed dampings."""
        if self.second == Condition.NO_DAMPING:
            return RidgeKind.NO_DAMPING
        smooth = self.first == Condition.PAIR and self.second == Condition.STATIONARY
        return RidgeKind.SMOOTH if smooth else RidgeKind.CORNER


def find_ridge(stable_set: StableSet, negative_damping: bool) -> RidgeSolution | None:
    """Return the stiffest stable wall with alpha > 0.

    Args:
        stable_set: the stable walls of the loop.
        negative_damping: if False, require beta >= 0.

    Returns:
        The wall and its active constraints; None if no wall with alpha > 0 is stable.

    Raises:
        ArithmeticError: if lines of constant B contradict the result, or a corner was not resolved.
    """
    least = -np.inf if negative_damping else 0.0
    # Compare alpha with 13 digits, because on an edge of constant alpha both corners differ by rounding errors. Among
    # equal maxima prefer the largest beta, then the crossing on a line of constant B, because the end of an edge has no
    # angle.
    maxima = sorted(
        _list_maxima(stable_set, least), key=lambda top: (-float(f"{top.alpha:.12e}"), -top.beta, math.isnan(top.w))
    )
    # Skip maxima on spurious edges, which rounding errors create near an asymptote of the curve. Such an edge bounds no
    # stable interval of a line of constant B.
    top = next((top for top in maxima if _is_reached(stable_set, top, least)), None)
    ridge = None if top is None else _identify_conditions(stable_set, top, least)
    lossless = stable_set.boundary.lossless
    if ridge is not None and abs(ridge.beta - lossless) <= ON_LOSSLESS * stable_set.width:
        # Set beta to exactly the lossless damping, at which no wall is asymptotically stable. At a beta with a rounding
        # error some walls would appear stable.
        ridge = ridge._replace(beta=lossless)
    highest = stable_set.find_highest(least)
    if highest > (0.0 if ridge is None else ridge.alpha) * (1.0 + CONTRADICTION):
        raise ArithmeticError(f"lines of constant B reach alpha = {highest!r}, above the maximum {ridge!r}")
    return ridge


class _Maximum(NamedTuple):
    """A local maximum of alpha along the edges."""

    alpha: float
    beta: float
    w: float
    column: int
    inner: bool  # the maximum lies inside its edge, not at an end


def _list_maxima(stable_set: StableSet, least: float) -> Iterator[_Maximum]:
    """Yield the local maxima of alpha for beta >= ``least`` along the edges of main pieces."""
    edges = stable_set.main_edges(least)
    for edge in edges:
        padded = np.pad(np.where(edge.beta >= least, edge.alpha, -np.inf), 1, constant_values=-np.inf)
        alpha, last = padded[1:-1], edge.w.size - 1
        for k in np.flatnonzero((alpha >= padded[:-2]) & (alpha >= padded[2:]) & (alpha > 0)):
            yield _Maximum(float(alpha[k]), float(edge.beta[k]), float(edge.w[k]), edge.column, bool(0 < k < last))
    if np.isfinite(least):
        # Add the crossings of the edges with the line beta = least, where the allowed range of beta ends.
        row = stable_set.boundary.find_crossings(np.array([least]))
        for edge in edges:
            high, w = float(row.alpha[0, edge.column]), float(row.w[0, edge.column])
            if edge.beta[0] <= least and high > 0:
                yield _Maximum(high, least, w, edge.column, False)


def _is_reached(stable_set: StableSet, top: _Maximum, least: float) -> bool:
    """Return whether a stable interval on a line of constant B near a maximum extends to nearly the same alpha."""
    scale = stable_set.width + abs(top.beta)
    intervals = find_stable_intervals(stable_set.boundary, np.maximum(top.beta + scale * NEIGHBOR_OFFSETS, least))
    bounded = (intervals.above == top.column) | (intervals.below == top.column)
    return bool(np.any(bounded & (intervals.high >= REACHED_FRACTION * top.alpha)))


def _identify_conditions(stable_set: StableSet, top: _Maximum, least: float) -> RidgeSolution:
    """Return the `RidgeSolution` of a local maximum, with its two active constraints."""
    alpha, beta, w = top[:3]
    if beta == least:
        return RidgeSolution(alpha, beta, w, w, _classify_angle(w), Condition.NO_DAMPING)
    if top.inner:
        return RidgeSolution(alpha, beta, w, w, Condition.PAIR, Condition.STATIONARY)
    return _solve_corner(stable_set, alpha, beta)


def _classify_angle(w: float) -> Condition:
    """Return the type of the active constraint at the angle w: a pole pair, or a real pole at z = 1 or z = -1."""
    if w == 0.0:
        return Condition.PLUS_ONE
    return Condition.MINUS_ONE if w == np.pi else Condition.PAIR


def _solve_corner(stable_set: StableSet, alpha: float, beta: float) -> RidgeSolution:
    """Compute the corner close to a wall by Newton's method, and its two active constraints."""
    # Solve for the beta at which two crossings have the same alpha. Do not use the tabulated end of an edge, because
    # near an undamped mode a rounding error of its angle changes alpha considerably.
    (w, other), heights, slopes, step = _find_nearest_two(stable_set.boundary, alpha, beta)
    for _ in range(MAX_STEPS):
        if not CONVERGED_STEP * abs(beta) < abs(step) <= NEAR_CORNER * abs(beta):
            break
        alpha, beta = heights[0] + slopes[0] * step, beta + step
        (w, other), heights, slopes, step = _find_nearest_two(stable_set.boundary, alpha, beta)
    w, other = sorted((w, other))
    # Multiply the remaining difference of the two alphas by ``flatness``, because an error of beta changes the alpha of
    # the corner only in proportion to the smaller of the two derivatives d alpha/d beta.
    difference, gap = abs(slopes[0] - slopes[1]), abs(heights[1] - heights[0]) / abs(alpha)
    flatness = min(1.0, min(map(abs, slopes)) / difference) if difference > 0 else 1.0
    if (
        abs(step) <= NEAR_CORNER * (stable_set.width + abs(beta))
        and flatness * gap <= CORNER_TOLERANCE
        and other - w > 1e-6
    ):
        return RidgeSolution(alpha, beta, w, other, _classify_angle(w), _classify_angle(other))
    # Otherwise the corner is a double pole at z = -1, or at z = 1 for a device with negative static gain, where an end
    # of the boundary curve lies on the crossing line.
    for w in (np.pi, 0.0):
        limit, damping = stable_set.boundary.limits[w]
        if abs(limit - alpha) <= NEAR_CORNER * abs(alpha):
            return RidgeSolution(limit, damping, w, w, _classify_angle(w), Condition.STATIONARY)
    raise ArithmeticError(f"no two conditions meet at alpha = {alpha!r}, beta = {beta!r}")


def _find_nearest_two(b: Boundary, alpha: float, beta: float) -> tuple[list[float], list[float], list[float], float]:
    """Return the two crossings nearest to a wall on its line of constant B.

    Returns:
        The angles, alphas and derivatives d alpha/d beta of the crossings, and the Newton step in beta that makes both
        alphas equal.
    """
    row = b.find_crossings(np.array([beta]))
    distance = np.abs(row.alpha[0] - alpha)
    near = np.resize(np.argsort(np.where(np.isnan(distance), np.inf, distance))[:2], 2)
    curve = evaluate_curve(b.loop, row.w[0, near])
    with np.errstate(all="ignore"):
        slopes = curve.alpha_slope * curve.im_f**2 / curve.wronskian
    for k in np.flatnonzero(near >= len(b.arcs)):
        slopes[k] = -b.lines[near[k] - len(b.arcs)].f
    heights = row.alpha[0, near]
    step = (heights[1] - heights[0]) / ((slopes[0] - slopes[1]) or np.inf)
    return row.w[0, near].tolist(), heights.tolist(), slopes.tolist(), float(step)
