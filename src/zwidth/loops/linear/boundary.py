"""The boundary of any linear loop at constant damping, and the number of poles outside the unit circle of each wall.

A line of constant damping (a row) crosses each arc of `loops.linear.curve` at most once (docs/theory/scenes.md, V12).
As alpha increases, poles leave the unit circle at a crossing if ``Im(q' - beta F') > 0``, also at z = 1 and z = -1.
Hence

    poles outside(alpha, beta) = base + sum over the row's crossings below alpha of +-2 (pairs) or +-1 (real poles)

with one number ``base`` for the whole plane: far below every crossing the zeros of N1 decide (V13, V14).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from zwidth.loops.linear.curve import (
    Arc,
    CrossingLine,
    JoinedArcs,
    circle_zeros,
    curve_at,
    cut_arcs,
    find_lossless,
    level_arc,
    lines_at,
    nodes_of,
    zeros_of,
)
from zwidth.loops.linear.roots import LoopRoots
from zwidth.parts.circle import are_on_circle, circle, depths

# Newton steps at most, every sixth one a bisection; and the step, as a share of w, after which it has arrived.
_MOST_STEPS, _ARRIVED = 120, 1e-10
# By what share a row is moved, at most, that rounding keeps from being counted.
_SHIFTS = (1e-15, -1e-15, 1e-13, -1e-13, 1e-11, -1e-11)
# How near to an angle where the curve has no point of its own it is looked at, as a share of the way to a node.
_PROBE = 1e-6
# A pole that leaves a zero on the circle along it, to such a share, goes where that way bends to.
_ALONG = 1e-9
_SAME_ROW = 1e-12  # dampings with a smaller relative difference are equal up to rounding errors
# Pairs of rows and arcs that are looked at in one go: what they need stays in caches.
_BLOCK = 1 << 17


class Crossings(NamedTuple):
    """Where rows cross the boundary: shape (rows, arcs and lines), NaN where one does not."""

    alpha: np.ndarray
    w: np.ndarray
    leaving: np.ndarray  # poles that leave the circle as alpha rises past the crossing; negative for entering ones
    sound: np.ndarray  # of each row: whether its crossings lead from the count far below to that far above


@dataclass(frozen=True)
class Boundary:
    """The boundary of one loop, prepared for lines of constant damping."""

    loop: LoopRoots
    w: np.ndarray
    arcs: tuple[Arc, ...]
    lines: tuple[CrossingLine, ...]
    infinite: np.ndarray  # angles at which the curve runs to infinity
    limits: dict[float, tuple[float, float]]  # alpha and beta where it has no point of its own, NaN where it has no end
    lossless: float  # damping of a lossless loop (`find_lossless`); NaN for all other loops

    @classmethod
    def trace(cls, loop: LoopRoots) -> Boundary:
        """Lay out the curve."""
        w = nodes_of(loop)
        here = curve_at(loop, w)
        vertical = zeros_of(loop, w, here.fall, "fall")
        touched = [p for p in circle_zeros(loop) if np.all(np.abs(vertical - p) > 1e-7)]
        vertical = np.union1d(vertical, touched)
        lines = lines_at(loop, vertical)
        poles = np.array([p for p in vertical if all(p != line.w for line in lines)])
        turns = zeros_of(loop, w, here.turn, "turn")
        turns = np.array([t for t in turns if all(abs(t - line.w) > 1e-6 for line in lines)])
        lines += lines_at(loop, (0.0, np.pi))
        limits = dict.fromkeys([0.0, np.pi, *poles.tolist()], (np.nan, np.nan))
        limits |= {line.w: (line.q - line.meeting * line.f, line.meeting) for line in lines}
        lossless = find_lossless(loop, w, here, limits[0.0][1])
        arcs = [level_arc(w, here, lossless)] if np.isfinite(lossless) else cut_arcs(loop, w, here, turns, limits)
        return cls(loop, w, tuple(arcs), tuple(lines), poles, limits, lossless)

    def are_lossless(self, beta: np.ndarray) -> np.ndarray:
        """Return whether dampings equal that of a lossless loop, at which no wall is stable (`find_lossless`)."""
        with np.errstate(invalid="ignore"):
            return np.abs(beta - self.lossless) <= _SAME_ROW * np.abs(self.lossless)

    def crossings(self, beta: np.ndarray) -> Crossings:
        """Where the rows of these dampings, shape (rows,), cross the boundary."""
        beta, sound = self.settle(beta)
        steps = self._steps
        place, row, k = steps.meet(beta)
        w, alpha = self._solve(beta[row], place, k)
        shape = beta.size, len(self.arcs) + len(self.lines)
        out = Crossings(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape), sound)
        out.alpha[row, place], out.w[row, place] = alpha, w
        out.leaving[row, place] = steps.leaving[place]
        for place, line in enumerate(self.lines, len(self.arcs)):
            out.alpha[:, place] = line.q - beta * line.f
            out.w[:, place] = line.w
            out.leaving[:, place] = line.leaving(beta)
        return out

    def cross(self, column: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """The alpha at which rows cross one column of `crossings` each: shape (rows,), NaN where one does not."""
        steps, alpha = self._steps, np.full(beta.shape, np.nan)
        for place, line in enumerate(self.lines, len(self.arcs)):
            alpha = np.where(column == place, line.q - beta * line.f, alpha)
        row = np.flatnonzero(column < len(self.arcs))
        low, high = steps.ends[:, column[row]]
        row = row[(beta[row] >= low) & (beta[row] < high)]
        k = steps.find(column[row], np.searchsorted(steps.dampings, beta[row]))
        alpha[row] = self._solve(beta[row], column[row], k)[1]
        return alpha

    @cached_property
    def ends(self) -> np.ndarray:
        """The walls at both ends of each column of `crossings`: (alpha and beta, 2, columns), NaN where none is."""
        w = np.array([arc.w[[0, -1]] for arc in self.arcs]).T
        alpha = curve_at(self.loop, w.ravel()).alpha.reshape(w.shape)
        for angle, (limit, _) in self.limits.items():
            alpha[w == angle] = limit
        walls = np.stack([alpha, self._steps.ends])
        return np.pad(walls, ((0, 0), (0, 0), (0, len(self.lines))), constant_values=np.nan)

    def _solve(self, beta: np.ndarray, place: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The angle before node ``k`` of all arcs' at which each row crosses, and its alpha."""
        # Newton's method, inside a bracket, on ``Im(q - beta F)``, which rises with w where a pair leaves, over what
        # vanishes on every row; who has arrived takes no part any more.
        steps, nodes = self._steps, self._at_nodes
        lower = np.where(steps.w[k - 1] < steps.w[k], k - 1, k)
        upper = 2 * k - 1 - lower
        below, above = steps.w[lower], steps.w[upper]
        middle = np.cos(0.5 * (below + above))
        signs = [np.sign(middle - np.cos(w)) for w in self._fixed]
        rising = steps.leaving[place] * np.prod(signs, axis=0) > 0
        first, last = nodes.pick(lower).of_rows(beta), nodes.pick(upper).of_rows(beta)
        # A row through an end of its arc meets the line there in one point, with nothing between them.
        found = np.where(last.ratio == 0, above, np.where(first.ratio == 0, below, _between(below, above, first, last)))
        alpha = np.where(last.ratio == 0, last.alpha, first.alpha)
        here = np.flatnonzero((first.ratio != 0) & (last.ratio != 0))
        x, before = found[here], (above - below)[here]
        for _ in range(_MOST_STEPS if here.size else 0):
            row = self._look(x).of_rows(beta[here])
            ahead = (row.ratio < 0) == rising[here]
            below[here], above[here] = np.where(ahead, x, below[here]), np.where(ahead, above[here], x)
            with np.errstate(all="ignore"):
                move = -row.ratio / row.ratio_slope
            new = x + move
            # Steps that do not become half as short lead nowhere.
            good = (new >= below[here]) & (new <= above[here]) & (np.abs(move) <= 0.5 * before)
            # Who has arrived at an end of the bracket may leave it by rounding.
            good |= np.abs(new - x) <= _ARRIVED * x
            new = np.where(good, np.clip(new, below[here], above[here]), 0.5 * (below[here] + above[here]))
            # A step so short leaves rounding: each next one would be its square. Beside an undamped mode that of the
            # angle is too much for alpha.
            move = np.where(new == x + move, move, new - x)
            found[here], alpha[here] = new, row.alpha + move * row.alpha_slope
            on = (np.abs(new - x) > _ARRIVED * new) & (above[here] - below[here] > _ARRIVED * new)
            if not on.any():
                break
            here, x, before = here[on], new[on], np.abs(new - x)[on]
        return found, alpha

    def _look(self, w: np.ndarray) -> _LoopAngles:
        """The loop at angles, for any rows."""
        at, whole, turn = circle(w), np.where(w >= np.pi, 0.0, np.sin(w)), np.cos(w)
        for angle in self._fixed:
            factor = -2.0 * np.sin(0.5 * (w + angle)) * np.sin(0.5 * (w - angle))
            whole, turn = whole * factor, turn * factor - whole * np.sin(w)
        with np.errstate(all="ignore"):
            return _LoopAngles(*self.loop.required_wall(at), *self.loop.estimate.jet(at), whole, turn)

    @cached_property
    def _at_nodes(self) -> _LoopAngles:
        return self._look(self._steps.w)

    @cached_property
    def _steps(self) -> JoinedArcs:
        """The nodes of all arcs, in one sequence."""
        return JoinedArcs.join(self.arcs)

    def arc_at(self, w: np.ndarray) -> np.ndarray:
        """Return the index of the arc that contains each angle."""
        return np.searchsorted(self._steps.slowest, w, side="right") - 1

    @cached_property
    def tops(self) -> np.ndarray:
        """The angles at which alpha is extreme along the curve."""
        tops = zeros_of(self.loop, self.w, curve_at(self.loop, self.w).alpha_slope, "alpha_slope")
        return tops[np.isfinite(curve_at(self.loop, tops).alpha)]

    @cached_property
    def heights(self) -> tuple[np.ndarray, np.ndarray]:
        """Angles between which alpha is monotone along the curve, and alpha there; NaN where it runs to infinity."""
        nodes = np.union1d(self.w, self.tops)
        pieces, heights = [], []
        for a, b in pairwise(sorted(self.limits)):
            inner = nodes[(nodes > a) & (nodes < b)]
            inner = inner if inner.size else np.array([0.5 * (a + b)])
            # Towards an end at infinity the curve is looked at no further than this.
            probes = a + _PROBE * (inner[0] - a), b - _PROBE * (b - inner[-1])
            inner = np.concatenate([probes[:1], inner, probes[1:]])
            pieces.append(np.concatenate([[a], inner, [b]]))
            heights.append(np.concatenate([self.limits[a][:1], curve_at(self.loop, inner).alpha, self.limits[b][:1]]))
        return np.concatenate(pieces), np.concatenate(heights)

    @property
    def _fixed(self) -> list[float]:
        """The angles besides 0 and pi at which ``Im(q - beta F)`` vanishes on every row."""
        return [line.w for line in self.lines if line.poles == 2]

    def settle(self, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows whose crossings lead from the count far below to that far above, and which ones do (V15)."""
        # A row within rounding of a turn of the curve may miss one of two arcs: a neighbor that does not stands for it.
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
        return self.count_below(beta) - self.count_above(beta) + self._sum_leaving(beta)

    def _sum_leaving(self, beta: np.ndarray, most: float = np.inf) -> np.ndarray:
        """Poles that leave at all crossings of each row, where each counts for no more than ``most``."""
        steps = self._steps
        total = steps.sum_met(np.minimum(steps.leaving, most), beta)
        return total + sum(np.minimum(line.leaving(beta), most) for line in self.lines)

    def outside(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """How many poles of each wall lie outside the circle; -1 where the row's crossings contradict each other."""
        passed, sound = self._passed(alpha, beta)
        return np.where(sound, self.count_below(beta) + passed, -1)

    def _passed(self, alpha: np.ndarray, beta: np.ndarray, but: np.ndarray | int = -1) -> tuple[np.ndarray, np.ndarray]:
        """Poles that have left below each wall, without those of one column of the crossings; and if that is sound."""
        # Most walls are far above or below where an arc crosses their row, which the nodes beside tell.
        but = np.broadcast_to(but, beta.shape)
        beta, sound = self.settle(beta)
        steps = self._steps
        place, row, k = steps.meet(beta)
        counted = but[row] != place
        place, row, k = place[counted], row[counted], k[counted]
        with np.errstate(all="ignore"):
            share = (beta[row] - steps.beta[k - 1]) / (steps.beta[k] - steps.beta[k - 1])
            share = np.where(steps.straight[k], share, 0.5)
            away = alpha[row] - (steps.alpha[k - 1] + share * (steps.alpha[k] - steps.alpha[k - 1]))
            passed, near = away > steps.room[k], ~(np.abs(away) > steps.room[k])
        if near.any():
            passed[near] = self._solve(beta[row[near]], place[near], k[near])[1] < alpha[row[near]]
        total = np.zeros(beta.shape)
        np.add.at(total, row[passed], steps.leaving[place[passed]])
        for place, line in enumerate(self.lines, len(self.arcs)):
            passed = (line.q - beta * line.f < alpha) & (but != place)
            total += np.where(passed, line.leaving(beta), 0.0)
        return total.astype(int), sound

    def borders(self, w: np.ndarray) -> np.ndarray:
        """Whether the stable set lies on one side of the curve at each angle (V18)."""
        here = curve_at(self.loop, w)
        held = np.isfinite(here.alpha) & np.isfinite(here.beta)
        # Of a long delay's rows most hold no stable wall wherever: not enough poles enter on them.
        rows = self.settle(here.beta[held])[0]
        held[held] = self.count_below(rows) + self._sum_leaving(rows, 0.0) <= 0
        own, block = self.arc_at(w), max(1, _BLOCK // max(1, len(self.arcs)))
        for part in np.array_split(np.flatnonzero(held), 1 + held.sum() // block):
            passed, sound = self._passed(here.alpha[part], here.beta[part], own[part])
            # By the arc: next to z = -1 the slope at one angle may be rounding.
            below = self.count_below(here.beta[part])
            held[part] = sound & (below + passed == np.where(self._steps.leaving[own[part]] > 0, 0, 2))
        return held

    def count_below(self, beta: np.ndarray) -> np.ndarray | int:
        """Return the number of poles outside the circle for alpha below all crossings (docs/theory/scenes.md, V14).

        Args:
            beta: dampings of lines of constant B.
        """
        return self._count_far(-1.0, beta)

    def count_above(self, beta: np.ndarray) -> np.ndarray | int:
        """Return the number of poles outside the circle for alpha above all crossings.

        On every line of constant B the poles that cross account for the difference from `count_below`.

        Args:
            beta: dampings of lines of constant B.
        """
        return self._count_far(1.0, beta)

    def _count_far(self, side: float, beta: np.ndarray) -> np.ndarray | int:
        less, more = self._far_counts[side]
        # Only in a lossless loop does the number of poles depend on the damping.
        return less if less == more else np.where(beta > self.lossless, more, less)

    @cached_property
    def _far_counts(self) -> dict[float, tuple[int, int]]:
        """Poles outside at alpha -> -inf (key -1) and +inf (key 1): for beta below and above the lossless damping."""
        return {side: (self._far_outside(side, -1.0), self._far_outside(side, 1.0)) for side in (-1.0, 1.0)}

    def _far_outside(self, side: float, more: float) -> int:
        """Return the number of poles outside the unit circle as |alpha| -> inf.

        Poles then approach the zeros of the device; the remaining poles go to infinity.

        Args:
            side: sign of alpha.
            more: sign of beta minus the lossless damping; has no effect if the loop is not lossless.
        """
        loop = self.loop
        depth, on = depths(loop.zeros), are_on_circle(loop.zeros)
        leaving = 0
        for zero, times in zip(*np.unique(loop.zeros[on], return_counts=True), strict=True):
            # Next to such a zero G(w) = c x^times (1 + e x), x = w - w0, is -1/alpha, and |z| > 1 where Im x < 0.
            at = circle(np.angle(1.0 - zero))
            rest = replace(loop, zeros=loop.zeros[loop.zeros != zero]).response(at)
            power = -side / (rest.value * (1j * at.z) ** times)
            x = power ** (1.0 / times) * np.exp(2j * np.pi * np.arange(times) / times)
            if np.isfinite(self.lossless):
                # alpha moves the pole along the circle. Only excess damping moves it off the circle: x becomes
                # x (1 - (beta - lossless) F/alpha).
                leaving += int(np.sum(side * more * loop.estimate.jet(at).value.imag * x.real > 0))
                continue
            bend = -(rest.slope / rest.value + 0.5j * times) * x * x / times
            leaving += int(np.sum(np.where(np.abs(x.imag) > _ALONG * np.abs(x), x.imag, bend.imag) < 0))
        return loop.lag + loop.poles.size - loop.zeros.size + int(np.sum(depth[~on] < 0)) + leaving


class _Row(NamedTuple):
    """Of rows at angles: what vanishes at a crossing, ``Re(q - beta F)``, and their slopes in w."""

    ratio: np.ndarray
    ratio_slope: np.ndarray
    alpha: np.ndarray
    alpha_slope: np.ndarray


class _LoopAngles(NamedTuple):
    """q and F at angles with their slopes, and ``sin w prod(cos w - cos fixed)`` with its own."""

    q: np.ndarray
    q_slope: np.ndarray
    f: np.ndarray
    f_slope: np.ndarray
    whole: np.ndarray
    turn: np.ndarray

    def pick(self, index: np.ndarray) -> _LoopAngles:
        """Some of them."""
        return _LoopAngles(*(part[index] for part in self))

    def of_rows(self, beta: np.ndarray) -> _Row:
        """``Im(q - beta F)`` over what vanishes on every row, and the alpha of rows that cross there."""
        with np.errstate(all="ignore"):
            value, slope = self.q - beta * self.f, self.q_slope - beta * self.f_slope
            end = self.whole == 0
            safe = np.where(end, 1.0, self.whole)
            ratio = np.where(end, np.imag(slope) / self.turn, np.imag(value) / safe)
            return _Row(ratio, (np.imag(slope) - ratio * self.turn) / safe, np.real(value), np.real(slope))


@np.errstate(all="ignore")
def _between(below: np.ndarray, above: np.ndarray, first: _Row, last: _Row) -> np.ndarray:
    """Where a crossing between two angles is sought first: by the cubic of the inverse, or by a parabola."""
    rise, far = last.ratio - first.ratio, above - below
    share = -first.ratio / rise
    bends = rise * (1.0 - share) / first.ratio_slope, rise * share / last.ratio_slope
    cubic = below + share * (share * (3.0 - 2.0 * share) * far + (1.0 - share) * (bends[0] - bends[1]))
    # Next to an end at which the arc turns, with the slope of the flatter end.
    flat = np.abs(first.ratio_slope) < np.abs(last.ratio_slope)
    start, slope = np.where(flat, first.ratio, last.ratio), np.where(flat, first.ratio_slope, -last.ratio_slope) * far
    rise = np.where(flat, rise, -rise)
    root = np.sqrt(np.maximum(slope * slope - 4.0 * (rise - slope) * start, 0.0))
    away = -2.0 * start / (slope + np.where(rise < 0, -root, root))
    away = np.clip(np.where(np.isfinite(away), away, 0.5), 1e-9, 1.0 - 1e-9) * far
    parabola = np.where(flat, below + away, above - away)
    return np.where((share > 0) & (share < 1) & (cubic > below) & (cubic < above), cubic, parabola)
