"""Columns of any linear loop: the stable intervals of the damping at a stiffness."""

from __future__ import annotations

import numpy as np

from zwidth.linear.boundary import Boundary
from zwidth.linear.curve import curve_at, zeros_of
from zwidth.linear.rows import label_walls

# Halvings of a step between two nodes: to the last digit of its angle.
_HALVINGS = 60
# How near to the column a point of the curve is on it, of what its alpha is a difference of.
_MEETS = 1e-6


def stable_dampings(boundary: Boundary, alpha: float) -> np.ndarray:
    """Where a column is stable: array (intervals, 2) of beta, ascending.

    Every damping at which the column meets the boundary is found, for alpha is monotone along the curve between two
    nodes once its extremes are among them; the walls between two such dampings share the label of one of them.
    """
    met = np.unique(np.concatenate([_on_curve(boundary, alpha), _on_lines(boundary, alpha)]))
    met = met[np.isfinite(met)]
    if not np.isfinite(alpha) or not met.size:
        return np.zeros((0, 2))
    reach = np.ptp(met) + np.abs(met).max() + 1.0
    ends = np.concatenate([[-np.inf], met, [np.inf]])
    between = 0.5 * (np.concatenate([[met[0] - reach], met]) + np.concatenate([met, [met[-1] + reach]]))
    stable = label_walls(boundary, np.full(between.size, alpha), between)
    return np.stack([ends[:-1][stable], ends[1:][stable]], -1)


def _on_lines(boundary: Boundary, alpha: float) -> np.ndarray:
    return np.array([(line.q - alpha) / line.f for line in boundary.lines if line.f != 0.0])


def _on_curve(boundary: Boundary, alpha: float) -> np.ndarray:
    loop = boundary.loop
    tops = zeros_of(loop, boundary.w, curve_at(loop, boundary.w).alpha_slope, "alpha_slope")
    lows, highs, rising = [], [], []
    for arc in boundary.arcs:
        order = np.argsort(arc.w)
        w, height = arc.w[order], arc.alpha[order]
        inside = tops[(tops > w[0]) & (tops < w[-1])]
        w, height = np.append(w, inside), np.append(height, curve_at(loop, inside).alpha if inside.size else inside)
        order = np.argsort(w, kind="stable")
        w, above = w[order], height[order] > alpha
        k = np.flatnonzero(above[1:] != above[:-1])
        lows.append(w[k])
        highs.append(w[k + 1])
        rising.append(above[k + 1])
    low, high, up = (np.concatenate(parts) for parts in (lows, highs, rising))
    for _ in range(_HALVINGS if low.size else 0):
        middle = 0.5 * (low + high)
        beyond = (curve_at(loop, middle).alpha > alpha) == up
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    found = curve_at(loop, 0.5 * (low + high))
    # Where the curve jumps through infinity it does not meet the column.
    return found.beta[np.abs(found.alpha - alpha) <= _MEETS * (found.size + abs(alpha))]
