"""The stiffest stable wall of any linear loop, and what binds it.

The top of the stable set is a smooth maximum of its edge, a corner where two conditions meet, or, where only
dampings beta >= 0 are allowed, the end of the row beta = 0. Each is the solution of two conditions of two equations
each, with ``r(z) = alpha + beta F(z) - q(z)``:

    first     r(e^(j w1)) = 0 of a pole pair, or of a real pole at z = -1 or z = 1
    second    the same at w2; or the curve of the first is stationary in alpha; or beta = 0
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from zwidth.arrays.circle import circle
from zwidth.loops.linear.border import Border
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.linear.rows import bound_intervals
from zwidth.words.status import RidgeKind

# Newton steps on a corner at most; the residual, as a share of |q|, at which it holds; how far it may move a start.
_MOST_STEPS, _HOLDS, _NEAR = 12, 1e-11, 1e-5
# By what share rounding may make a row's wall stiffer.
_ABOVE = 1e-7
# Rows next to a top, as shares of the plane, that must reach nearly as high; and how many tops are looked at.
_BESIDE, _NEARLY = np.array([0.0, 1e-3, -1e-3, 1e-5, -1e-5, 1e-7, -1e-7]), 0.99
_MOST_TOPS = 32


class Condition(IntEnum):
    """What holds at the stiffest wall."""

    PAIR = 0
    MINUS_ONE = 1
    PLUS_ONE = 2
    STATIONARY = 3
    NO_DAMPING = 4


class BoundRidge(NamedTuple):
    """The stiffest stable wall and the two conditions that make it so; ``w2`` is w1 where the second has no angle."""

    alpha: float
    beta: float
    w1: float
    w2: float
    first: Condition
    second: Condition

    @property
    def omega(self) -> float:
        """The angle at which the loop oscillates there, the higher one at a corner."""
        return max(self.w1, self.w2) if self.second <= Condition.PLUS_ONE else self.w1

    @property
    def kind(self) -> RidgeKind:
        """Smooth, a corner, or the end of the allowed damping."""
        if self.second == Condition.NO_DAMPING:
            return RidgeKind.NO_DAMPING
        smooth = self.first == Condition.PAIR and self.second == Condition.STATIONARY
        return RidgeKind.SMOOTH if smooth else RidgeKind.CORNER


def find_ridge(border: Border, negative_damping: bool) -> BoundRidge | None:
    """The stiffest stable wall with alpha > 0, None where no such wall is stable.

    Raises:
        ArithmeticError: the rows of the plane contradict what was found.
    """
    least = -np.inf if negative_damping else 0.0
    tops = _tops(border, least) if border.curved else []
    for top in tops[:_MOST_TOPS]:
        # Where the curve runs to infinity rounding may take a part of it for an edge; rows do not see it.
        if not border.pieces.is_main(border.pieces.piece_at(top.beta, top.place)) or not _is_reached(
            border, top, least
        ):
            continue
        found = _describe(border, top, negative_damping)
        _refuse_stiffer(border, found, least)
        return found
    if len(tops) > _MOST_TOPS:
        raise ArithmeticError(f"none of the {_MOST_TOPS} highest of {len(tops)} tops holds")
    return None


class _Top(NamedTuple):
    """A local maximum of the edges: which column of a row's crossings it is on, and whether it lies inside its edge."""

    alpha: float
    beta: float
    w: float
    place: int
    inner: bool


def _tops(border: Border, least: float) -> list[_Top]:
    """Local maxima of the edges with beta of ``least`` or more, highest first."""
    found, b = [], border.boundary
    for edge in border.curved:
        padded = np.concatenate([[-np.inf], np.where(edge.beta >= least, edge.alpha, -np.inf), [-np.inf]])
        alpha, last = padded[1:-1], edge.w.size - 1
        for k in np.flatnonzero((alpha >= padded[:-2]) & (alpha >= padded[2:]) & (alpha > 0)):
            # An end may be that of an arc as well.
            place = int(b.arc_at(edge.w[min(max(k, 1), max(last - 1, 0))]))
            found.append(_Top(float(alpha[k]), float(edge.beta[k]), float(edge.w[k]), place, bool(0 < k < last)))
    # Straight edges end on the curve or on each other.
    for alpha, beta, w in border.line_meetings():
        if alpha > 0 and beta >= least:
            line = next(k for k, line in enumerate(b.lines) if line.w == w)
            found.append(_Top(alpha, beta, w, len(b.arcs) + line, False))
    return sorted(found + (_ends_of_row(b, least) if np.isfinite(least) else []), key=lambda top: -top.alpha)


def _describe(border: Border, top: _Top, negative: bool) -> BoundRidge:
    alpha, beta, w = top[:3]
    if not negative and beta == 0.0:
        return BoundRidge(alpha, beta, w, w, _condition(w), Condition.NO_DAMPING)
    if top.inner:
        return BoundRidge(alpha, beta, w, w, Condition.PAIR, Condition.STATIONARY)
    return _corner(border, alpha, beta)


def _condition(w: float) -> Condition:
    if w == 0.0:
        return Condition.PLUS_ONE
    return Condition.MINUS_ONE if w == np.pi else Condition.PAIR


def _ends_of_row(boundary: Boundary, beta: float) -> list[_Top]:
    """The upper ends with alpha > 0 of a row's stable intervals."""
    row = np.array([beta])
    found, w = bound_intervals(boundary, row), boundary.crossings(row).w[0]
    ends = zip(found.high[0].tolist(), found.above[0].tolist(), strict=True)
    return [_Top(high, beta, float(w[place]), place, False) for high, place in ends if 0 < high < np.inf]


def _corner(border: Border, alpha: float, beta: float) -> BoundRidge:
    """The two conditions that meet at a corner, and the corner to the last place."""
    found = border.boundary.crossings(np.array([beta]))
    away = np.abs(found.alpha[0] - alpha)
    near = [int(k) for k in np.argsort(np.where(np.isnan(away), np.inf, away))[:2]]
    angles = sorted(float(found.w[0, k]) for k in near)
    met = len(near) == 2 and away[near[1]] <= 1e-4 * abs(alpha)
    if met and angles[1] - angles[0] > 1e-6:
        start = BoundRidge(alpha, beta, angles[0], angles[1], _condition(angles[0]), _condition(angles[1]))
        held = _polish(border.boundary.loop, start)
        if held is not None:
            return held
    # A double pole at z = -1: the curve ends on the line there.
    top, damping = border.at_end(np.pi)
    if not abs(top - alpha) <= _NEAR * abs(alpha):
        raise ArithmeticError(f"no two conditions meet at alpha = {alpha!r}, beta = {beta!r}")
    return BoundRidge(top, damping, np.pi, np.pi, Condition.MINUS_ONE, Condition.STATIONARY)


def _polish(loop: LoopRoots, start: BoundRidge) -> BoundRidge | None:
    """Newton's method on a corner of two different angles; None where it does not hold near the start."""
    x = np.array([start.alpha, start.beta, start.w1, start.w2])
    moves = np.array([start.first == Condition.PAIR, start.second == Condition.PAIR])
    best, worst = x, np.inf
    for _ in range(_MOST_STEPS):
        at = circle(x[2:])
        q, f = loop.required_wall(at), loop.estimate.jet(at)
        rest, slope = x[0] + x[1] * f.value - q.value, x[1] * f.slope - q.slope
        size = np.abs(q.value) + np.abs(x[1] * f.value) + 1e-300
        error = float(np.max(np.abs(np.where(moves, rest, rest.real)) / size))
        if not error < worst:
            break
        best, worst = x, error
        matrix, right = np.zeros((4, 4)), np.zeros(4)
        for k in range(2):
            matrix[2 * k, :2], right[2 * k] = (1.0, f.value[k].real), rest[k].real
            if moves[k]:
                matrix[2 * k + 1, 1], right[2 * k + 1] = f.value[k].imag, rest[k].imag
                matrix[2 * k : 2 * k + 2, 2 + k] = slope[k].real, slope[k].imag
            else:
                matrix[2 * k + 1, 2 + k] = 1.0
        try:
            x = x - np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:
            break
        if not np.all((x[2:] > 0) & (x[2:] < np.pi) | ~moves):
            break
    near = abs(best[0] - start.alpha) <= _NEAR * abs(start.alpha) and abs(best[3] - best[2]) > 1e-7
    if worst > _HOLDS or not near:
        return None
    alpha, beta, w1, w2 = (float(value) for value in best)
    return start._replace(alpha=alpha, beta=beta, w1=w1, w2=w2)


def _is_reached(border: Border, top: _Top, least: float) -> bool:
    """Whether rows next to a top are stable nearly up to it."""
    size = float(np.ptp(border.pieces.corners)) + abs(top.beta)
    found = bound_intervals(border.boundary, np.maximum(top.beta + size * _BESIDE, least))
    own = (found.above == top.place) | (found.below == top.place)
    return bool(np.any(own & (found.high >= _NEARLY * top.alpha)))


def _refuse_stiffer(border: Border, found: BoundRidge, least: float) -> None:
    """Refuse a ridge above which rows of its piece hold a stable wall."""
    rows, high = border.pieces.main_intervals()
    highest = float(np.nanmax(high[rows >= least], initial=-np.inf))
    if highest > found.alpha * (1.0 + _ABOVE):
        raise ArithmeticError(f"rows reach {highest!r}, the ridge {found.alpha!r}")
