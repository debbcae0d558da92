"""Arcs: the parts of the boundary curve of any linear loop on which beta is monotone, so that a row meets each once."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from zwidth.loops.linear.curve import CurvePoints, curve_at
from zwidth.loops.linear.roots import LoopRoots

# How far beyond two neighboring nodes the curve may be between them, of what alpha is a difference of.
_ROOM, _ROUNDING = 0.02, 1e-6


class Arc(NamedTuple):
    """A part of the curve on which beta is monotone, by its nodes in ascending beta."""

    w: np.ndarray
    beta: np.ndarray
    alpha: np.ndarray
    straight: np.ndarray  # of each step: whether alpha may be interpolated in beta, else both ends' mean counts
    room: np.ndarray  # of each step: how far alpha may be from that
    leaving: float  # poles that leave the circle as alpha rises past it: 2, or -2

    @property
    def first(self) -> float:
        """Its lowest angle."""
        return float(min(self.w[0], self.w[-1]))


def cut_arcs(
    loop: LoopRoots,
    w: np.ndarray,
    here: CurvePoints,
    poles: np.ndarray,
    turns: np.ndarray,
    limits: dict[float, float],
) -> list[Arc]:
    """Cut the curve where beta turns or runs to infinity, and where Im F changes its sign."""
    ends = np.unique(np.concatenate([list(limits), poles, turns]))
    at_pole = {float(p) for p in poles}
    arcs = []
    for a, b in pairwise(ends.tolist()):
        inner = (w > a) & (w < b)
        nodes, curve = w[inner], CurvePoints(*(values[inner] for values in here))
        if not nodes.size:
            nodes = np.array([0.5 * (a + b)])
            curve = curve_at(loop, nodes)
        rising = np.sum(np.sign(curve.turn)) > 0
        # As alpha passes the arc a pair leaves where Im(q - beta F) rises with w: told once, by the nodes.
        leaving = 2.0 if rising == (np.sum(np.sign(curve.fall)) > 0) else -2.0
        first = _end_value(loop, float(a), at_pole, -1 if rising else 1, limits)
        last = _end_value(loop, float(b), at_pole, 1 if rising else -1, limits)
        # The ends have no alpha: next to them every wall is compared with the crossing itself.
        with np.errstate(all="ignore"):
            slope = curve.turn / curve.fall**2
        parts = [nodes, curve.beta, curve.alpha, curve.alpha_slope, slope, curve.size]
        edges = [(a, b), (first, last), *[(np.nan, np.nan)] * 4]
        parts = [np.concatenate([[end[0]], part, [end[1]]]) for part, end in zip(parts, edges, strict=True)]
        if not rising:
            parts = [part[::-1] for part in parts]
        # Next to a limit or an extreme rounding may leave a node out of order; without it nothing is lost.
        beta = parts[1]
        good = np.maximum.accumulate(beta) == beta
        good &= np.minimum.accumulate(beta[::-1])[::-1] == beta
        good[[0, -1]] = True
        if beta[0] <= beta[-1]:
            parts = [part[good] for part in parts]
            arcs.append(Arc(*parts[:3], *_bands(*parts), leaving))
    return arcs


def _bands(
    w: np.ndarray,
    beta: np.ndarray,
    alpha: np.ndarray,
    alpha_slope: np.ndarray,
    beta_slope: np.ndarray,
    size: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Where alpha may be between two nodes: `Arc.straight` and `Arc.room`.

    Where the slope of beta hardly changes over a step, a straight line misses alpha by an eighth of the step times what
    alpha's slope changes, and by what beta bends; four times that is allowed. Elsewhere, by far more than both ends
    differ.
    """
    with np.errstate(all="ignore"):
        bend = beta_slope[1:] / beta_slope[:-1]
        straight = (bend > 0.5) & (bend < 2.0)
        rise, largest = np.abs(np.diff(alpha)), np.maximum(size[1:], size[:-1])
        close = 0.5 * np.abs(np.diff(w) * np.diff(alpha_slope)) + np.abs(bend - 1.0) * rise + _ROUNDING * largest
        return straight, np.where(straight, close, 1.5 * rise + _ROOM * largest)


def _end_value(loop: LoopRoots, w: float, at_pole: set[float], side: int, limits: dict[float, float]) -> float:
    if w in at_pole:
        return side * np.inf
    if w in limits:
        return limits[w] if np.isfinite(limits[w]) else side * np.inf
    return float(curve_at(loop, np.array([w])).beta[0])
