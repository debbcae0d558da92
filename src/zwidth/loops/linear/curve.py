"""The boundary of any linear loop: the curve of pole pairs, its nodes, zeros and arcs, and the lines (V8 to V12).

On ``z = e^(jw)``, 0 < w < pi, a pole pair is where ``beta = Im q/Im F`` and ``alpha = Re q - beta Re F``. On an arc
beta is monotone, so that a row meets it once. Where F is real, ``alpha + beta F = q`` is a line as soon as q is real as
well: real poles, and pairs of undamped devices at one frequency.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from zwidth.arrays.roots import zeros_between
from zwidth.loops.linear.roots import LoopRoots
from zwidth.parts.circle import are_on_circle, circle

# How far one node lies from the next, as a share of the distance over which the loop changes by its own size.
_STEP = 0.08
_ROUNDS = 60
# How near to z = -1 the last node is, for a loop without roots there.
_LAST = 1e-4


class CurvePoints(NamedTuple):
    """Points of the boundary curve, and what decides their order."""

    alpha: np.ndarray
    beta: np.ndarray
    alpha_slope: np.ndarray  # d alpha/dw
    turn: np.ndarray  # Im q' Im F - Im q Im F', of the sign of d beta/dw
    fall: np.ndarray  # Im F
    size: np.ndarray  # |q| + |beta F|, of which alpha is a difference


def curve_at(loop: LoopRoots, w: np.ndarray) -> CurvePoints:
    """The boundary curve at angles in (0, pi)."""
    at = circle(w)
    with np.errstate(all="ignore"):
        q, f = loop.required_wall(at), loop.estimate.jet(at)
        beta = q.value.imag / f.value.imag
        alpha = q.value.real - beta * f.value.real
        turn = q.slope.imag * f.value.imag - q.value.imag * f.slope.imag
        beta_slope = turn / f.value.imag**2
        alpha_slope = q.slope.real - beta_slope * f.value.real - beta * f.slope.real
        size = np.abs(q.value) + np.abs(beta * f.value)
        return CurvePoints(alpha, beta, alpha_slope, turn, f.value.imag, size)


def nodes_of(loop: LoopRoots) -> np.ndarray:
    """Angles from nearly 0 to nearly pi, so close that the loop hardly changes from one to the next."""
    roots = np.concatenate([loop.poles, loop.zeros, loop.estimate.poles, loop.estimate.zeros])
    sizes, far = np.abs(roots), np.abs(roots - 2.0)
    turn = 1.0 / (loop.lag + loop.estimate.window + 1.0)
    first = 1e-3 * min([turn, *sizes[sizes > 1e-13]])
    # Next to z = -1 imaginary parts x = pi - w have lost eps/x of themselves, and beta varies by (x/far)^2: closer than
    # this its slope is rounding.
    last = _LAST * min([turn, *far[far > 1e-13]]) ** (2.0 / 3.0)
    w = np.concatenate([np.geomspace(first, 0.1, 64), np.linspace(0.1, np.pi - last, 32)[1:]])
    nodes, low, high = [w], w[:-1], w[1:]
    for _ in range(_ROUNDS):
        half = 0.5 * (high - low)
        steps = 2.0 * half * loop.turning(low + half, half * np.array([[1.0], [0.0]]))
        wide = (steps > _STEP * np.array([[16.0], [1.0]])).any(0)
        if not wide.any():
            break
        middle = (low + half)[wide]
        nodes.append(middle)
        low, high = np.concatenate([low[wide], middle]), np.concatenate([middle, high[wide]])
    return np.sort(np.concatenate(nodes))


def zeros_of(loop: LoopRoots, w: np.ndarray, values: np.ndarray, field: str) -> np.ndarray:
    """Zeros of a field of the curve between nodes where its sign changes."""
    k = np.flatnonzero((values[:-1] > 0) != (values[1:] > 0))
    return zeros_between(lambda at: getattr(curve_at(loop, at), field), w, values, k)


# Of |q|: less of an imaginary part than that where Im F vanishes is none.
_NONE = 1e-11
# A velocity estimate that turns less than this at z = 1, -1 or a line does not answer there.
_FLAT = 1e-12


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
        """The damping at which the curve meets the line, ``Im q'/Im F'``; NaN where it does not."""
        return self.q_turn / self.f_turn if abs(self.f_turn) > _FLAT else np.nan

    def leaving(self, beta: np.ndarray) -> np.ndarray:
        """Poles that leave the circle there as alpha rises; on the row through the meeting, as just above it."""
        if np.isnan(self.meeting):
            return np.full(beta.shape, self.poles * np.sign(self.q_turn))
        return self.poles * np.sign(self.f_turn) * np.where(beta < self.meeting, 1.0, -1.0)


def lines_at(loop: LoopRoots, angles: ArrayLike) -> list[CrossingLine]:
    """The lines of zeros of Im F where q is real as well: at z = 1 and -1, inside of undamped devices and windows."""
    # There is none where q or F is infinite: where the device does not move, say.
    w = np.array(angles, float)
    at, end = circle(w), (w == 0.0) | (w == np.pi)
    with np.errstate(all="ignore"):
        q, f = loop.required_wall(at), loop.estimate.jet(at)
        real = end | (np.abs(q.value.imag) <= _NONE * np.abs(q.value))
    numbers = np.stack([w, q.value.real, f.value.real, q.slope.imag, f.slope.imag], -1)
    # A slow zero has an offset of its own from z = 1.
    reach = np.where(w == 0.0, 1e-15, np.where(end, 1e-12, 1e-9))
    near = np.abs(at.before[:, None] + loop.zeros) <= reach[:, None]
    found = np.flatnonzero(real & ~near.any(1) & np.isfinite(numbers).all(1))
    return [CrossingLine(*numbers[k].tolist(), poles=1 if end[k] else 2) for k in found]


def circle_zeros(loop: LoopRoots) -> np.ndarray:
    """Angles of zeros on the circle: of an undamped device, where q is infinite, or of F, where Im F may touch 0."""
    zeros = np.concatenate([loop.zeros, loop.estimate.zeros])
    angles = np.angle(1.0 - zeros[are_on_circle(zeros)])
    return np.unique(angles[(angles > 0) & (angles < np.pi - 1e-6)])


# How far beyond two neighboring nodes the curve may be between them, of what alpha is a difference of.
_ROOM, _ROUNDING = 0.02, 1e-6


class Arc(NamedTuple):
    """A part of the curve on which beta is monotone, by its nodes in ascending beta."""

    w: np.ndarray
    beta: np.ndarray
    alpha: np.ndarray
    alpha_slope: np.ndarray  # in w, as beta's
    beta_slope: np.ndarray
    size: np.ndarray  # that of `CurvePoints`
    leaving: float  # poles that leave the circle as alpha rises past it: 2, or -2

    @property
    def first(self) -> float:
        """Its lowest angle."""
        return float(min(self.w[0], self.w[-1]))


def cut_arcs(
    loop: LoopRoots, w: np.ndarray, here: CurvePoints, turns: np.ndarray, limits: dict[float, tuple[float, float]]
) -> list[Arc]:
    """Cut the curve where beta turns or runs to infinity, and where Im F changes its sign."""
    ends = np.unique(np.concatenate([list(limits), turns]))
    betas = dict(zip(turns.tolist(), curve_at(loop, turns).beta.tolist(), strict=True))
    betas |= {end: beta for end, (_, beta) in limits.items()}
    arcs, starts, stops = [], np.searchsorted(w, ends, "right").tolist(), np.searchsorted(w, ends, "left").tolist()
    for (a, b), start, stop in zip(pairwise(ends.tolist()), starts[:-1], stops[1:], strict=True):
        nodes, curve = w[start:stop], CurvePoints(*(values[start:stop] for values in here))
        if not nodes.size:
            nodes = np.array([0.5 * (a + b)])
            curve = curve_at(loop, nodes)
        rising = np.sum(np.sign(curve.turn)) > 0
        # As alpha passes the arc a pair leaves where Im(q - beta F) rises with w: told once, by the nodes.
        leaving = 2.0 if rising == (np.sum(np.sign(curve.fall)) > 0) else -2.0
        first, last = (
            betas[end] if np.isfinite(betas[end]) else side * np.inf
            for end, side in ((a, -1.0 if rising else 1.0), (b, 1.0 if rising else -1.0))
        )
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
            arcs.append(Arc(*parts, leaving))
    return arcs


# Tests for a lossless loop
_LOSSLESS_ERROR = 1e-12  # of Im(q - beta F), relative to its terms and their conditioning; smaller values are 0
_LOSSLESS_ANGLE = 1e-2  # rad; at smaller angles, rounding errors of poles at z = 1 dominate Im(q - beta F)


def find_lossless(loop: LoopRoots, w: np.ndarray, here: CurvePoints, damping: float) -> float:
    """Return the damping at which the loop is lossless, or NaN.

    A loop is lossless if ``q - beta F`` is real on the whole unit circle. Then the reciprocal of every pole is also a
    pole, so no wall with this damping is stable. Example: an undamped joint in semi-implicit Euler, at beta = 0.

    Args:
        loop: the loop without its wall.
        w: angles of the nodes of the curve.
        here: points of the curve at the nodes.
        damping: beta of the curve at z = 1. The only candidates are this value and 0.
    """
    shows = w >= _LOSSLESS_ANGLE
    before, here = circle(w[shows]).before[:, None], CurvePoints(*(values[shows] for values in here))
    roots = np.concatenate([loop.poles, loop.zeros, loop.estimate.poles, loop.estimate.zeros])
    with np.errstate(all="ignore"):
        # Conditioning: near a root, the relative error is proportional to 1/distance.
        near = 1.0 + (np.abs(roots) / np.abs(before + roots)).sum(1)
        for beta in (0.0, damping):
            rest = np.abs((here.beta - beta) * here.fall) / (here.size * near)
            if np.all(np.nan_to_num(rest, nan=0.0) <= _LOSSLESS_ERROR):
                return beta
    return np.nan


def level_arc(w: np.ndarray, here: CurvePoints, beta: float) -> Arc:
    """Return the curve of a lossless loop: one arc of constant damping, which no line of constant B crosses."""
    blank, level = np.full(w.size + 2, np.nan), np.full(w.size + 2, beta)
    alpha = np.concatenate([[np.nan], here.alpha, [np.nan]])
    return Arc(np.concatenate([[0.0], w, [np.pi]]), level, alpha, blank, blank, blank, 2.0)


def bands(
    w: np.ndarray, alpha: np.ndarray, alpha_slope: np.ndarray, beta_slope: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask of the steps over which alpha may be interpolated linearly in beta, and bounds of its error.

    The arguments are those of joined arcs; alpha is NaN at their ends. Use the mean alpha of both ends for the other
    steps.
    """
    # If the slope of beta hardly changes over a step, linear interpolation misses alpha by at most an eighth of the
    # step times the change of alpha's slope, plus the curvature of beta. Allow four times this error. For other steps
    # allow more than the difference of both ends.
    with np.errstate(all="ignore"):
        bend = beta_slope / np.roll(beta_slope, 1)
        straight = (bend > 0.5) & (bend < 2.0)
        step, rise, turn = (np.abs(np.diff(part, prepend=part[0])) for part in (w, alpha, alpha_slope))
        largest = np.maximum(size, np.roll(size, 1))
        close = 0.5 * step * turn + np.abs(bend - 1.0) * rise + _ROUNDING * largest
        return straight, np.where(straight, close, 1.5 * rise + _ROOM * largest)


class JoinedArcs(NamedTuple):
    """The nodes of all arcs, one arc after another; a step leads to each node from the previous one."""

    w: np.ndarray
    beta: np.ndarray
    alpha: np.ndarray
    straight: np.ndarray  # of each step: alpha may be interpolated linearly in beta; else use the mean of both ends
    room: np.ndarray  # of each step: bound of the error of this alpha
    keys: np.ndarray  # of each node: index of its arc times the number of dampings, plus index of its damping
    dampings: np.ndarray  # of all nodes, sorted
    first: np.ndarray  # of each arc: its first node
    ends: np.ndarray  # (2, arcs): smallest and largest damping
    order: np.ndarray  # order of the flattened ends
    sorted_ends: np.ndarray
    leaving: np.ndarray  # of each arc: poles that leave the circle as alpha increases
    slowest: np.ndarray  # of each arc: its lowest angle

    @classmethod
    def join(cls, arcs: tuple[Arc, ...]) -> JoinedArcs:
        """Join the arcs of a boundary."""
        w, beta, *rest = map(np.concatenate, zip(*(arc[:6] for arc in arcs), strict=True))
        sizes = [arc.w.size for arc in arcs]
        dampings, keys = np.unique(beta, return_inverse=True)
        keys = keys + np.repeat(np.arange(len(arcs)), sizes) * dampings.size
        ends = np.array([arc.beta[[0, -1]] for arc in arcs]).T
        order = np.argsort(ends, axis=None)
        ends, first = (ends, order, ends.ravel()[order]), np.cumsum([0, *sizes[:-1]])
        own = np.array([(arc.leaving, arc.first) for arc in arcs]).T
        return cls(w, beta, rest[0], *bands(w, *rest), keys, dampings, first, *ends, *own)

    def sum_met(self, weights: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Return the sum of the weights of the arcs that contain each beta, without the larger end of each arc."""
        sums = np.cumsum(np.concatenate([[0.0], np.concatenate([weights, -weights])[self.order]]))
        return sums[np.searchsorted(self.sorted_ends, beta, side="right")]

    def meet(self, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for each crossing of an arc with a beta the indices of arc and beta, and the first node after it."""
        place, row = np.nonzero((beta >= self.ends[0][:, None]) & (beta < self.ends[1][:, None]))
        return place, row, self.find(place, np.searchsorted(self.dampings, beta)[row])

    def find(self, place: np.ndarray, among: np.ndarray) -> np.ndarray:
        """Return the first node of each arc after its crossing; ``among``: index of the beta in the sorted dampings."""
        return np.maximum(np.searchsorted(self.keys, place * self.dampings.size + among), self.first[place] + 1)
