"""Columns of any linear loop: the stable intervals of the damping at a stiffness."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from zwidth.arrays.roots import bisect, newton
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.curve import curve_at, find_dips, zeros_of
from zwidth.loops.linear.rows import label_walls

# How near to an angle where the curve has no point of its own it is looked at, as a share of the way to a node.
_PROBE = 1e-6
_MOST_STEPS = 120
# How far beside an end, as a share of it, walls must have the labels of the intervals that it parts: their rounding is
# that of a row, which may cross where a column hardly moves.
_BESIDE = 1e-7


def stable_dampings(boundary: Boundary, alpha: float) -> np.ndarray:
    """Where a column is stable: array (intervals, 2) of beta, ascending.

    Every damping at which the column meets the boundary is found, for alpha is monotone along the curve between two
    nodes once its extremes are among them; the walls between two such dampings share the label of one of them. An end
    whose own neighbors contradict that is sought by labels alone.
    """
    on_lines = np.array([(line.q - alpha) / line.f for line in boundary.lines if line.f != 0.0])
    met = np.unique(np.concatenate([_on_curve(boundary, alpha), on_lines]))
    met = met[np.isfinite(met)]
    if not np.isfinite(alpha) or not met.size:
        return np.zeros((0, 2))

    def label(beta: np.ndarray) -> np.ndarray:
        return label_walls(boundary, np.full(beta.size, alpha), beta)

    reach = np.ptp(met) + np.abs(met).max() + 1.0
    between = 0.5 * (np.concatenate([[met[0] - reach], met]) + np.concatenate([met, [met[-1] + reach]]))
    stable = label(between)
    k = np.flatnonzero(stable[1:] != stable[:-1])
    room = np.minimum(met[k] - between[k], between[k + 1] - met[k])
    beside = np.minimum(_BESIDE * np.abs(met[k]), 0.5 * room)
    wrong = (label(met[k] - beside) != stable[k]) | (label(met[k] + beside) != stable[k + 1])
    k, low, high = k[wrong], between[:-1][k[wrong]], between[1:][k[wrong]]
    # Twice: the last digit of a long way is not that of an end near 0.
    for _ in range(2 if k.size else 0):
        met[k] = bisect(lambda beta: label(beta) == stable[k], low, high)
        low, high = met[k] - 1e-12 * (high - low), met[k] + 1e-12 * (high - low)
    ends = np.concatenate([[-np.inf], met, [np.inf]])
    return np.stack([ends[:-1][stable], ends[1:][stable]], -1)


def _on_curve(boundary: Boundary, alpha: float) -> np.ndarray:
    loop = boundary.loop
    # Where the curve has no point of its own: it meets a line there, or runs to infinity in stiffness or damping.
    limits = dict.fromkeys([0.0, np.pi, *boundary.infinite.tolist()], np.nan)
    limits |= {line.w: line.q - line.meeting * line.f for line in boundary.lines}
    slope = curve_at(loop, boundary.w).alpha_slope
    tops = zeros_of(loop, boundary.w, slope, "alpha_slope")
    nodes = np.unique(np.concatenate([boundary.w, tops, find_dips(boundary.w, slope)]))
    pieces, heights = [], []
    for a, b in pairwise(sorted(limits)):
        inner = nodes[(nodes > a) & (nodes < b)]
        inner = inner if inner.size else np.array([0.5 * (a + b)])
        # Towards an end at infinity the curve is looked at no further than this.
        probes = a + _PROBE * (inner[0] - a), b - _PROBE * (b - inner[-1])
        inner = np.concatenate([probes[:1], inner, probes[1:]])
        pieces.append(np.concatenate([[a], inner, [b]]))
        heights.append(np.concatenate([[limits[a]], curve_at(loop, inner).alpha, [limits[b]]]))
    w, above = np.concatenate(pieces), np.concatenate(heights) - alpha
    k = np.flatnonzero(np.isfinite(above[1:] + above[:-1]) & ((above[1:] > 0) != (above[:-1] > 0)))
    sign = np.where(above[k + 1] > 0, 1.0, -1.0)

    def rise(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        curve = curve_at(loop, at)
        return sign * (curve.alpha - alpha), sign * curve.alpha_slope

    with np.errstate(all="ignore"):
        return curve_at(loop, newton(rise, w[k], w[k + 1], 0.5 * (w[k] + w[k + 1]), _MOST_STEPS)[0]).beta
