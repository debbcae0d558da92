"""The boundary curve of any linear loop, cut into arcs on which the damping is monotone; rows of it and their counts.

On ``z = e^(jw)``, 0 < w < pi, a pole pair is where ``beta = Im q/Im F`` and ``alpha = Re q - beta Re F``
(docs/theory/scenes.md, V8). Between the zeros of ``d beta/dw`` and of Im F beta is monotone (V12), so that each row
meets an arc once at most. Along a row a pole leaves the circle where
``Im(q' - beta F') > 0``, which at z = 1 and z = -1 holds for the real poles as well. Hence

    poles outside(alpha, beta) = base + sum over the row's crossings below alpha of +-2 (pairs) or +-1 (real poles)

with one number ``base`` for the whole plane: far below every crossing the zeros of N1 decide (V13, V14).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zwidth.arrays.circle import ON_CIRCLE, circle, depths
from zwidth.loops.linear.curve import (
    Arc,
    CrossingLine,
    circle_zeros,
    curve_at,
    cut_arcs,
    end_lines,
    find_dips,
    interior_line,
    nodes_of,
    zeros_of,
)
from zwidth.loops.linear.roots import LoopRoots

# Newton steps at most, every sixth one a bisection; and the step, as a share of w, after which it has arrived.
_MOST_STEPS, _ARRIVED = 120, 1e-10
# By what share a row is moved, at most, that rounding keeps from being counted.
_SHIFTS = (1e-15, -1e-15, 1e-13, -1e-13, 1e-11, -1e-11)


class Crossings(NamedTuple):
    """Where rows cross the boundary: shape (rows, arcs and lines), NaN where one does not."""

    alpha: np.ndarray
    w: np.ndarray
    leaving: np.ndarray  # poles that leave the circle as alpha rises past the crossing; negative for entering ones
    sound: np.ndarray  # of each row: whether its crossings lead from the count far below to that far above


@dataclass(frozen=True)
class Boundary:
    """The boundary of one loop, laid out for rows."""

    loop: LoopRoots
    w: np.ndarray
    arcs: tuple[Arc, ...]
    lines: tuple[CrossingLine, ...]
    infinite: np.ndarray  # angles at which the curve runs to infinity

    @classmethod
    def trace(cls, loop: LoopRoots) -> Boundary:
        """Lay out the curve."""
        w = nodes_of(loop)
        here = curve_at(loop, w)
        w = np.unique(np.concatenate([w, find_dips(w, here.turn)]))
        here = curve_at(loop, w)
        vertical = zeros_of(loop, w, here.fall, "fall")
        touched = [p for p in circle_zeros(loop) if np.all(np.abs(vertical - p) > 1e-7)]
        vertical = np.union1d(vertical, touched)
        lines = tuple(line for p in vertical if (line := interior_line(loop, p)) is not None)
        poles = np.array([p for p in vertical if all(p != line.w for line in lines)])
        turns = zeros_of(loop, w, here.turn, "turn")
        turns = np.array([t for t in turns if all(abs(t - line.w) > 1e-6 for line in lines)])
        lines = (*lines, *end_lines(loop))
        limits = {0.0: np.nan, np.pi: np.nan} | {line.w: line.meeting for line in lines}
        return cls(loop, w, tuple(cut_arcs(loop, w, here, poles, turns, limits)), lines, poles)

    def crossings(self, beta: np.ndarray) -> Crossings:
        """Where the rows of these dampings, shape (rows,), cross the boundary."""
        beta, sound = self._settle(beta)
        cells = [_cells(arc, beta) for arc in self.arcs]
        row = np.concatenate([rows for rows, _ in cells])
        place = np.repeat(np.arange(len(cells)), [rows.size for rows, _ in cells])
        low = np.concatenate([arc.w[k - 1] for arc, (_, k) in zip(self.arcs, cells, strict=True)])
        high = np.concatenate([arc.w[k] for arc, (_, k) in zip(self.arcs, cells, strict=True)])
        leaving = np.array([arc.leaving for arc in self.arcs])[place]
        w, alpha = _solve_rows(self.loop, self._fixed, beta[row], low, high, leaving)
        shape = beta.size, len(self.arcs) + len(self.lines)
        out = Crossings(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape), sound)
        out.alpha[row, place], out.w[row, place] = alpha, w
        out.leaving[row, place] = leaving
        for place, line in enumerate(self.lines, len(self.arcs)):
            out.alpha[:, place] = line.q - beta * line.f
            out.w[:, place] = line.w
            out.leaving[:, place] = line.leaving(beta)
        return out

    def arc_at(self, w: np.ndarray) -> np.ndarray:
        """The arc that an angle lies on."""
        return np.searchsorted([arc.first for arc in self.arcs], w, side="right") - 1

    @property
    def _fixed(self) -> list[float]:
        """The angles besides 0 and pi at which ``Im(q - beta F)`` vanishes on every row."""
        return [line.w for line in self.lines if line.poles == 2]

    def is_sound(self, beta: np.ndarray) -> np.ndarray:
        """Whether the crossings of each row agree with the counts far below and far above."""
        return self._settle(beta)[1]

    def _settle(self, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows whose crossings lead from the count far below to that far above, and which ones do (V15).

        A row within rounding of a turn of the curve may miss one of two arcs: a neighbor that does not stands for it.
        """
        missed = self._missed(beta)
        for shift in _SHIFTS:
            row = np.flatnonzero(missed)
            if not row.size:
                break
            beta = beta.copy()
            beta[row] = beta[row] * (1.0 + shift)
            missed[row] = self._missed(beta[row])
        return beta, missed == 0

    def _missed(self, beta: np.ndarray) -> np.ndarray:
        """By how many poles the crossings of each row fail to lead to the count far above."""
        total = np.full(beta.shape, float(self.base - self.top))
        for arc in self.arcs:
            total += np.where((beta >= arc.beta[0]) & (beta < arc.beta[-1]), arc.leaving, 0.0)
        for line in self.lines:
            total += line.leaving(beta)
        return total

    def outside(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """How many poles of each wall lie outside the unit circle, for arrays of one shape (points,).

        -1 where the row's crossings contradict each other.
        """
        passed, sound = self._passed(alpha, beta)
        return np.where(sound, self.base + passed, -1)

    def _passed(self, alpha: np.ndarray, beta: np.ndarray, but: np.ndarray | int = -1) -> tuple[np.ndarray, np.ndarray]:
        """Poles that have left below each wall, without those of one column of the crossings; and if that is sound.

        Most walls are far above or below where an arc crosses their row, which the nodes beside tell.
        """
        but = np.broadcast_to(but, beta.shape)
        beta, sound = self._settle(beta)
        total = np.zeros(beta.shape)
        near: list[tuple[np.ndarray, ...]] = []
        for place, arc in enumerate(self.arcs):
            row, k = _cells(arc, beta)
            with np.errstate(all="ignore"):
                share = (beta[row] - arc.beta[k - 1]) / (arc.beta[k] - arc.beta[k - 1])
                share = np.where(arc.straight[k - 1], share, 0.5)
                away = alpha[row] - (arc.alpha[k - 1] + share * (arc.alpha[k] - arc.alpha[k - 1]))
                above, below = away > arc.room[k - 1], away < -arc.room[k - 1]
            counted = but[row] != place
            total[row[above & counted]] += arc.leaving
            left = ~(above | below) & counted
            near.append((row[left], np.full(left.sum(), arc.leaving), arc.w[k[left] - 1], arc.w[k[left]]))
        row, leaving, low, high = (np.concatenate(column) for column in zip(*near, strict=True))
        if row.size:
            passed = _solve_rows(self.loop, self._fixed, beta[row], low, high, leaving)[1] < alpha[row]
            np.add.at(total, row[passed], leaving[passed])
        for place, line in enumerate(self.lines, len(self.arcs)):
            passed = (line.q - beta * line.f < alpha) & (but != place)
            total += np.where(passed, line.leaving(beta), 0.0)
        return total.astype(int), sound

    def borders(self, w: np.ndarray) -> np.ndarray:
        """Whether the stable set lies on one side of the curve at each angle (V18)."""
        here = curve_at(self.loop, w)
        own = self.arc_at(w)
        # By the arc: next to z = -1 the slope at one angle may be rounding.
        leaves = np.array([arc.leaving for arc in self.arcs])[own] > 0
        finite = np.isfinite(here.alpha) & np.isfinite(here.beta)
        at = np.where(finite, here.alpha, 0.0), np.where(finite, here.beta, 0.0)
        passed, sound = self._passed(*at, own)
        return finite & sound & (self.base + passed == np.where(leaves, 0, 2))

    def line_borders(self, line: int, beta: np.ndarray) -> np.ndarray:
        """Whether the stable set lies on one side of a line at each damping."""
        at = self.lines[line]
        passed, sound = self._passed(at.q - beta * at.f, beta, len(self.arcs) + line)
        return sound & (self.base + passed == np.where(at.leaving(beta) > 0, 0, at.poles))

    @cached_property
    def base(self) -> int:
        """Poles outside far below every crossing (docs/theory/scenes.md, V14)."""
        return self._far_outside(-1.0)

    @cached_property
    def top(self) -> int:
        """Poles outside far above every crossing: every row's crossings must lead from ``base`` to it."""
        return self._far_outside(1.0)

    def _far_outside(self, side: float) -> int:
        """Where the wall's spring is all there is, the poles are at the device's zeros, the others at infinity."""
        loop = self.loop
        depth = depths(loop.zeros)
        on = np.abs(depth) <= ON_CIRCLE
        answer = loop.response(circle(np.abs(np.angle(1.0 - loop.zeros[on]))))
        # Towards a zero on the circle: G(w) = -1/alpha, and |z| > 1 where Im w < 0.
        leaving = int(np.sum(side * answer.slope.imag < 0))
        return loop.lag + loop.poles.size - loop.zeros.size + int(np.sum(depth[~on] < 0)) + leaving


def _cells(arc: Arc, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rows that meet an arc, and before which of its nodes."""
    # A row through an end of arcs is counted as the row just above it.
    row = np.flatnonzero((beta >= arc.beta[0]) & (beta < arc.beta[-1]))
    return row, np.clip(np.searchsorted(arc.beta, beta[row]), 1, arc.beta.size - 1)


def _solve_rows(
    loop: LoopRoots, fixed: list[float], beta: np.ndarray, low: np.ndarray, high: np.ndarray, leaving: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The angle between two nodes at which each row crosses, and its alpha.

    ``Im(q - beta F)``, which rises with w where a pair leaves, over what vanishes on every row, by Newton's method kept
    inside its bracket; who has arrived takes no part any more.
    """
    cosine = np.cos(0.5 * (low + high))
    rising = leaving * np.prod([np.sign(cosine - np.cos(w)) for w in fixed], axis=0) > 0
    below, above = np.minimum(low, high), np.maximum(low, high)
    first, last = _residual(loop, fixed, beta, below)[0], _residual(loop, fixed, beta, above)[0]
    with np.errstate(all="ignore"):
        share = first / (first - last)
    share = np.where((share > 0) & (share < 1), share, np.where(share >= 1, 1.0 - 1e-9, 1e-9))
    found = below + np.where(np.isfinite(first) & np.isfinite(last), share, 0.5) * (above - below)
    # A row through an end of its arc meets the line there in one point, with nothing between them.
    found = np.where(last == 0, above, np.where(first == 0, below, found))
    here = np.flatnonzero((first != 0) & (last != 0))
    x = found[here]
    for step in range(_MOST_STEPS if here.size else 0):
        value, slope, _ = _residual(loop, fixed, beta[here], x)
        ahead = (value < 0) == rising[here]
        below[here], above[here] = np.where(ahead, x, below[here]), np.where(ahead, above[here], x)
        with np.errstate(all="ignore"):
            new = x - value / slope
        good = (new >= below[here]) & (new <= above[here]) & (step % 6 != 5)
        # Who has arrived at an end of the bracket may leave it by rounding.
        good |= np.abs(new - x) <= _ARRIVED * x
        new = np.where(good, np.clip(new, below[here], above[here]), 0.5 * (below[here] + above[here]))
        found[here] = new
        # A step so short leaves rounding: each next one would be its square.
        on = (np.abs(new - x) > _ARRIVED * new) & (above[here] - below[here] > _ARRIVED * new)
        if not on.any():
            break
        here, x = here[on], new[on]
    return found, _residual(loop, fixed, beta, found)[2]


def _residual(loop: LoopRoots, fixed: list[float], beta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, ...]:
    """``Im(q - beta F)`` over ``sin w prod(cos w - cos fixed)``, its derivative; and ``Re(q - beta F)``."""
    at = circle(w)
    with np.errstate(all="ignore"):
        q, f = loop.required_wall(at), loop.estimate.jet(at)
        value, slope = q.value - beta * f.value, q.slope - beta * f.slope
        whole = np.where(w >= np.pi, 0.0, np.sin(w))
        turn = np.cos(w)
        for angle in fixed:
            factor = -2.0 * np.sin(0.5 * (w + angle)) * np.sin(0.5 * (w - angle))
            whole, turn = whole * factor, turn * factor - whole * np.sin(w)
        end = whole == 0
        safe = np.where(end, 1.0, whole)
        ratio = np.where(end, slope.imag / turn, value.imag / safe)
        return ratio, (slope.imag - ratio * turn) / safe, value.real
