"""The boundary curve of any linear loop, cut into arcs on which the damping is monotone; rows of it and their counts.

On ``z = e^(jw)``, 0 < w < pi, a pole pair is where ``beta = Im q/Im F`` and ``alpha = Re q - beta Re F``
(docs/theory/one-crossover.md tells it for the rigid loop). Between the zeros of ``d beta/dw`` and of Im F beta is
monotone, so that each row meets an arc once at most. Along a row a pole leaves the circle where
``Im(q' - beta F') > 0``, which at z = 1 and z = -1 holds for the real poles as well. Hence

    poles outside(alpha, beta) = base + sum over the row's crossings below alpha of +-2 (pairs) or +-1 (real poles)

with one number ``base`` for the whole plane: far below every crossing the zeros of N1 decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from zwidth.linear_loop import ON_CIRCLE, LinearLoop, circle, depths, lag_jet, product_jet
from zwidth.numerics.roots import false_position

# How far one node lies from the next, as a share of the distance over which the loop changes by its own size.
_STEP = 0.08
_ROUNDS = 60
# Shares of a step at which a dip of the slope between two nodes is looked for.
_INSIDE = np.arange(1, 8) / 8.0
# Newton steps at most, every sixth one a bisection; and the step, as a share of w, after which it has arrived.
_MOST_STEPS, _ARRIVED = 120, 1e-10
# Of |q|: less of an imaginary part than that where Im F vanishes is none.
_NONE = 1e-11
# A velocity estimate that turns less than this at z = 1, -1 or a line does not answer there.
_FLAT = 1e-12
# By how much a row is moved, at most, that rounding keeps from being counted.
_SHIFTS = (1e-15, -1e-15, 1e-13, -1e-13)


class CurvePoints(NamedTuple):
    """Points of the boundary curve, and what decides their order."""

    alpha: np.ndarray
    beta: np.ndarray
    alpha_slope: np.ndarray  # d alpha/dw
    turn: np.ndarray  # Im q' Im F - Im q Im F', of the sign of d beta/dw
    fall: np.ndarray  # Im F


class Arc(NamedTuple):
    """A part of the curve on which beta is monotone, by its nodes in ascending beta."""

    w: np.ndarray
    beta: np.ndarray
    leaving: float  # 1 where a pair leaves the circle as alpha rises past the arc, -1 where one enters

    @property
    def first(self) -> float:
        """Its lowest angle."""
        return float(min(self.w[0], self.w[-1]))


class CrossingLine(NamedTuple):
    """A frequency at which a whole line ``alpha + beta real(F) = q`` puts poles on the circle."""

    w: float
    q: float
    f: float
    q_turn: float  # Im dq/dw
    f_turn: float
    poles: int  # 1 at z = 1 and z = -1, else 2

    @property
    def meeting(self) -> float:
        """The damping at which the curve meets the line, NaN where it does not."""
        return self.q_turn / self.f_turn if abs(self.f_turn) > _FLAT else np.nan

    def leaving(self, beta: np.ndarray) -> np.ndarray:
        """Poles that leave the circle there as alpha rises; on the row through the meeting, as just above it."""
        if np.isnan(self.meeting):
            return np.full(beta.shape, self.poles * np.sign(self.q_turn))
        return self.poles * np.sign(self.f_turn) * np.where(beta < self.meeting, 1.0, -1.0)


class Crossings(NamedTuple):
    """Where rows cross the boundary: shape (rows, arcs and lines), NaN where one does not."""

    alpha: np.ndarray
    w: np.ndarray
    leaving: np.ndarray  # poles that leave the circle as alpha rises past the crossing; negative for entering ones
    sound: np.ndarray  # of each row: whether its crossings lead from the count far below to that far above


def curve_at(loop: LinearLoop, w: np.ndarray) -> CurvePoints:
    """The boundary curve at angles in (0, pi)."""
    at = circle(w)
    with np.errstate(all="ignore"):
        q, f = loop.needed(at), loop.estimate.jet(at)
        beta = q.value.imag / f.value.imag
        alpha = q.value.real - beta * f.value.real
        turn = q.slope.imag * f.value.imag - q.value.imag * f.slope.imag
        beta_slope = turn / f.value.imag**2
        alpha_slope = q.slope.real - beta_slope * f.value.real - beta * f.slope.real
        return CurvePoints(alpha, beta, alpha_slope, turn, f.value.imag)


def nodes_of(loop: LinearLoop) -> np.ndarray:
    """Angles from nearly 0 to nearly pi, so close that the loop hardly changes from one to the next."""
    sizes = np.abs(np.concatenate([loop.poles, loop.zeros, loop.estimate.poles, loop.estimate.zeros]))
    slowest = min([1.0 / (abs(loop.lag) + loop.estimate.window + 1.0), *sizes[sizes > 1e-13]])
    first = 1e-3 * min(slowest, 1.0)
    w = np.concatenate([np.geomspace(first, 0.1, 64), np.linspace(0.1, np.pi - 1e-6, 32)[1:]])
    for _ in range(_ROUNDS):
        half = 0.5 * np.diff(w)
        wide = 2.0 * half * loop.turning(w[:-1] + half, half) > _STEP * 16.0
        wide |= 2.0 * half * loop.turning(w[:-1] + half, 0.0 * half) > _STEP
        if not wide.any():
            break
        w = np.sort(np.concatenate([w, w[:-1][wide] + half[wide]]))
    return w


@dataclass(frozen=True)
class Boundary:
    """The boundary of one loop, laid out for rows."""

    loop: LinearLoop
    w: np.ndarray
    arcs: tuple[Arc, ...]
    lines: tuple[CrossingLine, ...]
    infinite: np.ndarray  # angles at which the curve runs to infinity

    @classmethod
    def trace(cls, loop: LinearLoop) -> Boundary:
        """Lay out the curve."""
        w = nodes_of(loop)
        here = curve_at(loop, w)
        w = np.unique(np.concatenate([w, _dips(loop, w, here)]))
        here = curve_at(loop, w)
        poles = zeros_of(loop, w, here.fall, "fall")
        lines = tuple(line for p in poles if (line := _interior_line(loop, p)) is not None)
        poles = np.array([p for p in poles if all(abs(p - line.w) > 1e-9 for line in lines)])
        poles = np.union1d(poles, _circle_zeros(loop))
        turns = zeros_of(loop, w, here.turn, "turn")
        turns = np.array([t for t in turns if all(abs(t - line.w) > 1e-6 for line in lines)])
        lines = (*lines, *_end_lines(loop))
        return cls(loop, w, tuple(_arcs(loop, w, here, poles, turns, lines)), lines, poles)

    def crossings(self, beta: np.ndarray) -> Crossings:
        """Where the rows of these dampings, shape (rows,), cross the boundary.

        A row within rounding of a turn of the curve may miss one of its two arcs; a neighbor that does not stands for it.
        """
        found = self._cross(beta)
        for shift in _SHIFTS:
            row = np.flatnonzero(~found.sound & np.isfinite(beta))
            if not row.size:
                break
            for part, new in zip(found, self._cross(beta[row] * (1.0 + shift)), strict=True):
                part[row] = new
        return found

    def _cross(self, beta: np.ndarray) -> Crossings:
        rows, places, low, high, signs = [], [], [], [], []
        for place, arc in enumerate(self.arcs):
            # A row through an end of arcs and lines is counted as the row just above it.
            row = np.flatnonzero((beta >= arc.beta[0]) & (beta < arc.beta[-1]))
            k = np.clip(np.searchsorted(arc.beta, beta[row]), 1, arc.beta.size - 1)
            rows.append(row)
            places.append(np.full(row.size, place))
            signs.append(np.full(row.size, arc.leaving))
            low.append(arc.w[k - 1])
            high.append(arc.w[k])
        row, place = np.concatenate(rows), np.concatenate(places)
        sign = np.concatenate(signs)
        at_lines = [line.w for line in self.lines if 0 < line.w < np.pi]
        w, alpha = _solve_rows(self.loop, at_lines, beta[row], np.concatenate(low), np.concatenate(high), sign)
        shape = beta.size, len(self.arcs) + len(self.lines)
        out = Crossings(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape), np.zeros(beta.size, bool))
        out.alpha[row, place], out.w[row, place], out.leaving[row, place] = alpha, w, 2.0 * sign
        for place, line in enumerate(self.lines, len(self.arcs)):
            out.alpha[:, place] = line.q - beta * line.f
            out.w[:, place] = line.w
            out.leaving[:, place] = line.leaving(beta)
        out.sound[:] = self.base + out.leaving.sum(-1) == self.top
        return out

    def outside(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """How many poles of each wall lie outside the unit circle, for arrays of one shape (points,); -1 if not told."""
        passed, sound = self._passed(alpha, beta)
        return np.where(sound, self.base + passed, -1)

    def _passed(self, alpha: np.ndarray, beta: np.ndarray, but: np.ndarray | int = -1) -> tuple[np.ndarray, np.ndarray]:
        """Poles that have left below each wall, without those of one column of the crossings; whether that is told."""
        found = self.crossings(beta)
        counts = (found.alpha < alpha[:, None]) & (np.arange(found.alpha.shape[1]) != np.reshape(but, (-1, 1)))
        return np.where(counts, found.leaving, 0.0).sum(-1).astype(int), found.sound

    def borders(self, w: np.ndarray) -> np.ndarray:
        """Whether the stable set lies on one side of the curve at each angle."""
        here = curve_at(self.loop, w)
        with np.errstate(all="ignore"):
            leaves = here.turn * here.fall > 0
        own = np.searchsorted([arc.first for arc in self.arcs], w, side="right") - 1
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
        """Poles outside far below every crossing (docs/theory/scenes.md, S14)."""
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
        at = circle(np.abs(np.angle(1.0 - loop.zeros[on])))
        answer = product_jet(at, loop.zeros, loop.gain).over(product_jet(at, loop.poles, 1.0))
        answer = answer.times(lag_jet(at, -loop.lag))
        # Towards a zero on the circle: G(w) = -1/alpha, and |z| > 1 where Im w < 0.
        leaving = int(np.sum(side * answer.slope.imag < 0))
        return loop.lag + loop.poles.size - loop.zeros.size + int(np.sum(depth[~on] < 0)) + leaving


def _solve_rows(
    loop: LinearLoop, lines: list[float], beta: np.ndarray, low: np.ndarray, high: np.ndarray, leaving: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The angle between two nodes at which each row crosses, and its alpha.

    ``Im(q - beta F)``, which rises with w where a pair leaves, over what it is 0 with on every row; by Newton's method
    kept inside its bracket; who has arrived takes no part any more.
    """
    cosine = np.cos(0.5 * (low + high))
    rising = leaving * np.prod([np.sign(cosine - np.cos(line)) for line in lines], axis=0) > 0
    below, above = np.minimum(low, high), np.maximum(low, high)
    first, last = _residual(loop, lines, beta, below)[0], _residual(loop, lines, beta, above)[0]
    with np.errstate(all="ignore"):
        share = first / (first - last)
    share = np.where((share > 0) & (share < 1), share, np.where(share >= 1, 1.0 - 1e-9, 1e-9))
    found = below + np.where(np.isfinite(first) & np.isfinite(last), share, 0.5) * (above - below)
    here = np.arange(beta.size)
    x = found.copy()
    for step in range(_MOST_STEPS):
        value, slope, _ = _residual(loop, lines, beta[here], x)
        ahead = (value < 0) == rising[here]
        below[here], above[here] = np.where(ahead, x, below[here]), np.where(ahead, above[here], x)
        with np.errstate(all="ignore"):
            new = x - value / slope
        good = (new >= below[here]) & (new <= above[here]) & (step % 6 != 5)
        new = np.where(good, new, 0.5 * (below[here] + above[here]))
        found[here] = new
        # A step so short leaves rounding: each next one would be its square.
        on = (np.abs(new - x) > _ARRIVED * new) & (above[here] - below[here] > _ARRIVED * new)
        if not on.any():
            break
        here, x = here[on], new[on]
    return found, _residual(loop, lines, beta, found)[2]


def _residual(loop: LinearLoop, lines: list[float], beta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, ...]:
    """``Im(q - beta F)`` over sin w and the lines' ``cos w - cos line``, its derivative; and ``Re(q - beta F)``."""
    at = circle(w)
    with np.errstate(all="ignore"):
        q, f = loop.needed(at), loop.estimate.jet(at)
        value, slope = q.value - beta * f.value, q.slope - beta * f.slope
        sine, cosine = np.where(w >= np.pi, 0.0, np.sin(w)), np.cos(w)
        whole, turn = sine, cosine
        for line in lines:
            factor = np.where(w == line, 0.0, -2.0 * np.sin(0.5 * (w + line)) * np.sin(0.5 * (w - line)))
            whole, turn = whole * factor, turn * factor - whole * sine
        end = whole == 0
        safe = np.where(end, 1.0, whole)
        ratio = np.where(end, slope.imag / turn, value.imag / safe)
        return ratio, (slope.imag - ratio * turn) / safe, value.real


def zeros_of(loop: LinearLoop, w: np.ndarray, values: np.ndarray, field: str) -> np.ndarray:
    """Zeros of a field of the curve between nodes where its sign changes."""
    k = np.flatnonzero((values[:-1] > 0) != (values[1:] > 0))
    low, high, sign = w[k], w[k + 1], np.sign(values[k])
    if not k.size:
        return low
    with np.errstate(all="ignore"):
        scale = sign / (np.abs(values[k]) + np.abs(values[k + 1]))
        ends = values[k] * scale, values[k + 1] * scale
        return false_position(
            lambda at: getattr(curve_at(loop, at), field) * scale, low, high, *ends, _MOST_STEPS, 2e-16 * high
        )


def _dips(loop: LinearLoop, w: np.ndarray, here: CurvePoints) -> np.ndarray:
    """Nodes to add where d beta/dw keeps its sign from one node to the next but may not do so between them.

    The curve changes so little over a step that the slope is nearly a parabola there; where an end's tangent leads
    below a tenth of it, the step is looked at in eighths.
    """
    values = here.turn
    same = (values[:-1] > 0) == (values[1:] > 0)
    step = np.diff(w)
    # Slopes at the nodes by differences of the three around them.
    inner = np.gradient(values, w)
    first = np.abs(values[:-1]) + np.sign(values[:-1]) * inner[:-1] * step / 2
    last = np.abs(values[1:]) - np.sign(values[1:]) * inner[1:] * step / 2
    lowest = np.minimum(first, last)
    near = same & (lowest < 0.25 * np.minimum(np.abs(values[:-1]), np.abs(values[1:])))
    k = np.flatnonzero(near)
    return (w[k, None] + step[k, None] * _INSIDE).ravel()


def _interior_line(loop: LinearLoop, w: float) -> CrossingLine | None:
    """The line of a zero of Im F at which q is real as well, as for an undamped device and some windows."""
    at = circle(np.array([w]))
    q, f = loop.needed(at), loop.estimate.jet(at)
    if not abs(q.value[0].imag) <= _NONE * abs(q.value[0]):
        return None
    value, turn = float(q.value[0].real), float(q.slope[0].imag)
    return CrossingLine(w, value, float(f.value[0].real), turn, float(f.slope[0].imag), 2)


def _circle_zeros(loop: LinearLoop) -> np.ndarray:
    """Angles of the device's zeros on the circle, where q is infinite: nothing damps the masses beyond the sensor."""
    angles = np.angle(1.0 - loop.zeros[np.abs(depths(loop.zeros)) <= ON_CIRCLE])
    return angles[(angles > 0) & (angles < np.pi - 1e-6)]


def _end_lines(loop: LinearLoop) -> list[CrossingLine]:
    """The lines of real poles at z = 1 and z = -1; where the device does not move there is none."""
    lines = []
    for w in (0.0, np.pi):
        at = circle(np.array([w]))
        with np.errstate(all="ignore"):
            q, f = loop.needed(at), loop.estimate.jet(at)
        numbers = q.value[0].real, f.value[0].real, q.slope[0].imag, f.slope[0].imag
        infinite = np.any(np.abs(loop.zeros - (2.0 if w else 0.0)) <= ON_CIRCLE)
        if np.all(np.isfinite(numbers)) and not infinite:
            q_value, f_value, q_turn, f_turn = (float(n) for n in numbers)
            lines.append(CrossingLine(w, q_value, f_value, q_turn, f_turn, 1))
    return lines


def _arcs(
    loop: LinearLoop,
    w: np.ndarray,
    here: CurvePoints,
    poles: np.ndarray,
    turns: np.ndarray,
    lines: tuple[CrossingLine, ...],
) -> list[Arc]:
    """Cut the curve where beta turns or runs to infinity, and where it meets a line: Im F changes its sign there."""
    limits = {line.w: line.meeting for line in lines}
    cuts = np.unique(np.concatenate([poles, turns, [w for w in limits if 0 < w < np.pi]]))
    ends = np.concatenate([[0.0], cuts, [np.pi]])
    at_pole = {float(p) for p in poles}
    arcs = []
    for a, b in pairwise(ends.tolist()):
        inner = (w > a) & (w < b)
        nodes, beta, slope, fall = w[inner], here.beta[inner], here.turn[inner], here.fall[inner]
        if not nodes.size:
            nodes = np.array([0.5 * (a + b)])
            middle = curve_at(loop, nodes)
            beta, slope, fall = middle.beta, middle.turn, middle.fall
        rising = np.sum(np.sign(slope)) > 0
        # As alpha passes the arc a pair leaves where Im(q - beta F) rises with w. By its nodes this is told once.
        leaving = 1.0 if rising == (np.sum(np.sign(fall)) > 0) else -1.0
        first = _end_value(loop, float(a), at_pole, -1 if rising else 1, limits)
        last = _end_value(loop, float(b), at_pole, 1 if rising else -1, limits)
        nodes, beta = np.concatenate([[a], nodes, [b]]), np.concatenate([[first], beta, [last]])
        if not rising:
            nodes, beta = nodes[::-1], beta[::-1]
        # Next to a limit or an extreme rounding may leave a node out of order; without it nothing is lost.
        good = np.maximum.accumulate(beta) == beta
        good &= np.minimum.accumulate(beta[::-1])[::-1] == beta
        good[[0, -1]] = True
        if beta[0] <= beta[-1]:
            arcs.append(Arc(nodes[good], beta[good], leaving))
    return arcs


def _end_value(loop: LinearLoop, w: float, at_pole: set[float], side: int, limits: dict[float, float]) -> float:
    if w in (0.0, np.pi) or w in limits or w in at_pole:
        limit = limits.get(w, np.nan)
        return limit if np.isfinite(limit) else side * np.inf
    return float(curve_at(loop, np.array([w])).beta[0])
