"""The edge of the stable set of any linear loop: which parts of the boundary it is, and its corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.curve import CrossingLine, CurvePoints, curve_at, zeros_of
from zwidth.loops.linear.rows import Island, StablePieces, bound_intervals
from zwidth.words.showing import shown

# The place where an edge ends is told to the last digit by so many rounds over so many places.
_ROUNDS = 11
# Steps towards a corner at most, and the one, as a share of w, after which it is reached; how far beside it the edge
# must be seen to end.
_STEPS, _ARRIVED, _BESIDE = 20, 1e-15, 1e-11
_SHARES = np.arange(1, 32) / 32.0
# How often rows are looked at beside the ends of edges, and how far beside, as a share of what these span; edges of few
# nodes get so many.
_LOOKS, _BESIDE_ENDS, _FEW, _FILLED = 4, 1e-6, 5, 33
# What of |q| and |beta F| may be left of their difference where a curve has one damping.
_ONE_DAMPING = 1e-12
# How far beyond the corners a straight edge is looked for.
_BEYOND = 0.05
# Lines whose slopes differ by less, as a share, do not meet.
_PARALLEL = 1e-12
# Corners that differ by less, as a share, are one.
_SAME = 1e-12


class Edge(NamedTuple):
    """One part of the edge of the stable set, end to end."""

    w: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    line: int  # which of the boundary's lines, or -1 for the curve

    @property
    def is_point(self) -> bool:
        """Whether its walls differ by rounding, as those of a hardly sprung device's slowest angles do."""
        least = _SAME * np.max(np.abs(self.alpha) + np.abs(self.beta))
        return bool(np.ptp(self.alpha) <= least and np.ptp(self.beta) <= least)


@dataclass(frozen=True)
class Border:
    """The edge of the stable set of one loop."""

    boundary: Boundary

    @cached_property
    def curved(self) -> list[Edge]:
        """The edges on the curve of complex pairs."""
        # A resonance may sweep past the stable set between two nodes: beside the ends of the edges that these show,
        # rows tell what else bounds it.
        w = self.boundary.w
        if self._upright.size:
            ends = [self.boundary.limits[angle][0] for angle in (0.0, np.pi)]
            alpha = np.concatenate([ends[:1], curve_at(self.boundary.loop, w).alpha, ends[1:]])
            return [Edge(np.concatenate([[0.0], w, [np.pi]]), alpha, np.repeat(self._upright, alpha.size), -1)]
        edges, filled = self._edges_among(w), []
        for _ in range(_LOOKS):
            more = self._find_missed(edges, filled)
            if not more.size:
                break
            w = np.union1d(w, more)
            edges = self._edges_among(w)
        return edges

    @cached_property
    def _upright(self) -> np.ndarray:
        """The one damping of all pole pairs, of a loop of two poles whose product has the damping alone in it; else none."""
        here, damping = curve_at(self.boundary.loop, self.boundary.w), self.boundary.limits[0.0][1]
        away = np.abs((here.beta - damping) * here.fall)
        return np.repeat(damping, int(np.all(away <= _ONE_DAMPING * here.size)))

    def _edges_among(self, w: np.ndarray) -> list[Edge]:
        """The edges that nodes show."""
        b = self.boundary
        here = curve_at(b.loop, w)
        tops = zeros_of(b.loop, w, here.alpha_slope, "alpha_slope")
        tops = tops[np.isfinite(curve_at(b.loop, tops).alpha)] if tops.size else tops
        w = np.unique(np.concatenate([w, tops]))
        piece = np.searchsorted(b.infinite, w)
        held = b.borders(w)
        edges, runs = [], _runs(held, piece)
        ends = self._ends(w, piece, np.array(runs, int).reshape(-1, 2))
        for (start, stop), (first, last) in zip(runs, ends, strict=True):
            at = np.unique(np.concatenate([[first], w[start : stop + 1], [last]]))
            alpha, beta = curve_at(b.loop, at)[:2]
            for k, end in ((0, 0.0), (-1, np.pi)):
                if at[k] == end:
                    alpha[k], beta[k] = b.limits[end]
            edges.append(Edge(at, alpha, beta, -1))
        return edges

    def _find_missed(self, edges: list[Edge], filled: list[tuple[float, float]]) -> np.ndarray:
        """Angles on edges that are not among these, and within those of few nodes, each time others than before."""
        b = self.boundary
        few = [edge.w for edge in edges if edge.w.size < _FEW and not edge.is_point]
        # Next to z = 1 rounding may part an edge anew with each node: in a part of what was filled are nodes enough.
        few = [w for w in few if not any(low <= w[0] and w[-1] <= high for low, high in filled)]
        filled += [(w[0], w[-1]) for w in few]
        within = [np.empty(0), *(np.linspace(w[0], w[-1], _FILLED)[1:-1] for w in few)]
        # An undamped mode's angles may be too few for any of these nodes: beside the ends of arcs, then.
        ends = np.sort(np.concatenate([part.beta[[0, -1]] for part in edges or b.arcs]))
        ends = ends[np.isfinite(ends)]
        if not ends.size:
            return np.empty(0)
        beside = _BESIDE_ENDS * (np.ptp(ends) or np.abs(ends).max())
        # Most ends are those of two edges.
        ends = ends[np.diff(ends, prepend=-np.inf) > 0.1 * beside]
        rows = (ends[:, None] + beside * np.array([-1.0, 1.0])).ravel()
        # Soft walls without damping are stable on a device that comes to rest, however few angles its edge has.
        rows = rows if edges else np.append(rows, 0.0)
        found = bound_intervals(b, rows)
        for column, angles in ((found.below, found.w_below), (found.above, found.w_above)):
            w = angles[(column >= 0) & (column < len(b.arcs))]
            within.append(w[[not any(e.w[0] - _BESIDE <= at <= e.w[-1] + _BESIDE for e in edges) for at in w]])
        return np.unique(np.concatenate(within))

    def _ends(self, w: np.ndarray, piece: np.ndarray, runs: np.ndarray) -> np.ndarray:
        """Where runs of nodes on the edge, by their first and last, end beyond these: (runs, 2)."""
        b = self.boundary
        ends, after = w[runs], runs + np.array([-1, 1])
        for k, (end, last) in enumerate(((0.0, 0), (np.pi, w.size - 1))):
            if np.all(np.isfinite(b.limits[end])):
                ends[runs[:, k] == last, k] = end
        within = (after >= 0) & (after < w.size)
        after = np.where(within, after, runs)
        # Towards an angle at which the curve runs to infinity it may leave the stable set before.
        infinite = np.append(b.infinite, np.nan)[piece[runs] + np.array([-1, 0])]
        beyond = np.where(piece[after] == piece[runs], w[after], infinite)
        ends[within] = self._corners(ends[within], beyond[within])
        return ends

    def _corners(self, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
        """Where the curve stops to be an edge between pairs of angles: another crossing of its row meets it there."""
        b = self.boundary
        inside, outside = self._narrow(inside, outside, 1)
        ends = np.stack([inside, outside])
        here = curve_at(b.loop, ends.ravel())
        rows = b.crossings(here.beta)
        gaps = (rows.alpha - here.alpha[:, None]).reshape(*ends.shape, rows.alpha.shape[1])
        gaps[:, np.arange(inside.size), b.arc_at(inside)] = np.nan
        meets = np.sign(gaps[0]) * np.sign(gaps[1]) == -1
        k, other = np.flatnonzero(meets.sum(1) == 1), meets.argmax(1)
        other, found = other[k], np.full(inside.size, np.nan)
        both = np.stack([ends[:, k], rows.w.reshape(gaps.shape)[:, k, other]])
        found[k] = w = self._meet(both, gaps[:, k, other], other)
        beside = b.borders((w + _BESIDE * w * np.array([[-1.0], [1.0]])).ravel()).reshape(2, -1)
        found[k[beside[0] == beside[1]]] = np.nan
        left = np.flatnonzero(np.isnan(found))
        found[left] = self._narrow(inside[left], outside[left], _ROUNDS)[0]
        return found

    def _narrow(self, inside: np.ndarray, outside: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
        """Narrow the places at which the curve ceases to be an edge; many angles are looked at one time."""
        for _ in range(rounds if inside.size else 0):
            places = inside[:, None] + (outside - inside)[:, None] * np.pad(_SHARES, 1, constant_values=(0.0, 1.0))
            places[:, -1] = outside
            held = self.boundary.borders(places[:, 1:-1].ravel()).reshape(inside.size, -1)
            first = np.argmin(np.pad(held, ((0, 0), (0, 1))), axis=1)[:, None]
            inside, outside = (np.take_along_axis(places, first + step, 1)[:, 0] for step in (0, 1))
        return inside, outside

    def _meet(self, ends: np.ndarray, gaps: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Where the curve meets other crossings of its rows, by Newton's method."""
        # ``ends`` (2, 2, meetings) has the angles of the curve and of the crossing between which they meet, ``gaps``
        # how far their alphas are apart there.
        b = self.boundary
        numbers = np.array([*[(np.nan, np.nan)] * len(b.arcs), *((line.q, line.f) for line in b.lines)])
        (q, f), straight = numbers[other].T, other >= len(b.arcs)
        low, high = ends.min(1), ends.max(1)
        w = ends[:, 0] + gaps[0] / (gaps[0] - gaps[1]) * (ends[:, 1] - ends[:, 0])
        on = np.ones(other.size, bool)
        for _ in range(_STEPS):
            if not on.any():
                break
            at = CurvePoints(*(part.reshape(w.shape) for part in curve_at(b.loop, w.ravel())))
            with np.errstate(all="ignore"):
                beta_slope = at.turn / at.fall**2
                along = (q - at.beta[0] * f - at.alpha[0]) / (at.alpha_slope[0] + f * beta_slope[0])
                gap, apart = np.diff(at.alpha, axis=0), np.diff(at.beta, axis=0)
                across = gap * beta_slope[::-1] - apart * at.alpha_slope[::-1]
                across /= at.alpha_slope[0] * beta_slope[1] - at.alpha_slope[1] * beta_slope[0]
                step = np.where(straight, np.stack([along, 0.0 * along]), across)
            new = np.where(on, np.clip(w + step, low, high), w)
            on &= np.abs(new[0] - w[0]) > _ARRIVED * new[0]
            w = new
        return w[0]

    @cached_property
    def pieces(self) -> StablePieces:
        """The pieces that these edges enclose; what counts as soft is decided where edges pass alpha = 0."""
        b = self.boundary
        arcs = () if self._upright.size else b.arcs
        turns = np.array([(arc.first, arc.beta[np.argmin(arc.w)]) for arc in arcs]).reshape(-1, 2)
        found = [np.array([beta for _, beta, _ in self.line_meetings])]
        for edge in self.curved:
            found.append(edge.beta[[0, -1]])
            found.append(turns[(turns[:, 0] > edge.w[0]) & (turns[:, 0] < edge.w[-1]), 1])
            k = np.flatnonzero((edge.alpha[1:] > 0) != (edge.alpha[:-1] > 0))
            found.append(edge.beta[k])
        corners = np.unique(np.concatenate(found))
        zeros = np.array([line.q / line.f for line in b.lines if line.f != 0.0])
        within = zeros[(zeros > corners.min(initial=np.inf)) & (zeros < corners.max(initial=-np.inf))]
        corners = np.union1d(corners[np.isfinite(corners)], within)
        apart = np.diff(corners, prepend=-np.inf) > _SAME * np.abs(corners)
        return StablePieces(b, corners[apart])

    def piece_of(self, edge: Edge) -> int:
        """The piece that an edge borders, -1 where rows do not see it."""
        b, k = self.boundary, edge.w.size // 2
        if edge.line >= 0:
            return self.pieces.piece_at(float(edge.beta.mean()), len(b.arcs) + edge.line)
        return self.pieces.piece_at(float(edge.beta[k]), int(b.arc_at(edge.w[k])))

    def islands(self, least: float) -> list[Island]:
        """The pieces without soft walls, with walls of alpha > 0 and beta > ``least``, the stiffest first."""
        extents = self.pieces.extents()
        for edge in (*self.curved, *self.straight) if extents else ():
            piece = self.piece_of(edge)
            if piece in extents:
                walls = np.stack([edge.alpha, edge.beta])
                low, high = extents[piece]
                extents[piece] = np.minimum(low, walls.min(1)), np.maximum(high, walls.max(1))
        ends = [np.stack(extent, 1) for extent in extents.values()]
        found = [Island(*(tuple(pair.tolist()) for pair in both)) for both in ends]
        # Of one that ends at K = 0 rounding may leave a little above it.
        found = [one for one in found if one.stiffness[1] > _SAME * np.ptp(one.stiffness)]
        found = [one for one in found if one.virtual_damping[1] > least]
        return sorted(found, key=lambda one: -one.stiffness[1])

    @cached_property
    def straight(self) -> list[Edge]:
        """The edges on which a real pole, or a pair at one frequency, is on the circle."""
        # They end where an edge of the curve does, where two lines meet, or where the curve meets the line.
        lines = self.boundary.lines
        crossed = [beta for k, line in enumerate(lines) for beta in _meetings(lines[:k], line)]
        betas = np.concatenate([*(edge.beta for edge in self.curved), crossed, [0.0] if not self.curved else []])
        size = np.ptp(betas) + 1e-300
        first, last = betas.min() - _BEYOND * size, betas.max() + _BEYOND * size
        ends = np.concatenate([*(edge.beta[[0, -1]] for edge in self.curved), crossed, [m.meeting for m in lines]])
        ends = np.unique(ends[(ends > first) & (ends < last)])
        ends = np.concatenate([[first], ends[np.diff(ends, prepend=first) > _SAME * size], [last]])
        edges = []
        for place, line in enumerate(lines):
            held = self.boundary.line_borders(place, 0.5 * (ends[1:] + ends[:-1]))
            for start, stop in _runs(held, 0 * held):
                both = ends[[start, stop + 1]]
                edges.append(Edge(np.full(2, line.w), line.q - both * line.f, both, place))
        return edges

    @cached_property
    def line_meetings(self) -> list[tuple[float, float, int]]:
        """Corners of two lines, or of one and an upright curve: alpha, beta, a line; all other tops are on the curve."""
        b = self.boundary
        found = []
        for place, line in enumerate(b.lines):
            for beta in [*_meetings(b.lines[:place], line), *self._upright]:
                near = beta + 1e-9 * (1.0 + abs(beta)) * np.array([-1.0, 1.0])
                if b.line_borders(place, near).any():
                    found.append((float(line.q - beta * line.f), float(beta), place))
        return found


def _meetings(others: Sequence[CrossingLine], line: CrossingLine) -> list[float]:
    """The dampings at which a line meets others that are not parallel to it."""
    return [
        (line.q - other.q) / (line.f - other.f)
        for other in others
        if abs(other.f - line.f) > _PARALLEL * (abs(other.f) + abs(line.f))
    ]


def _runs(held: np.ndarray, piece: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of every run of true values within one piece."""
    joined = held[1:] & held[:-1] & (piece[1:] == piece[:-1])
    first, last = held & ~np.append(False, joined), held & ~np.append(joined, False)
    return list(zip(np.flatnonzero(first).tolist(), np.flatnonzero(last).tolist(), strict=True))


@shown()
class Outline(NamedTuple):
    """One closed outline of the stable set; a hole where unstable walls lie inside, an island where no soft ones do."""

    stiffness: np.ndarray
    virtual_damping: np.ndarray
    hole: bool
    island: bool  # of a piece without soft walls

    @property
    def area(self) -> float:
        """Inside, of the polygon."""
        x, y = self.stiffness, self.virtual_damping
        return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y)))


def outlines(border: Border) -> list[Outline]:
    """Join the edges to closed outlines, the largest first."""
    edges = [*border.curved, *border.straight]
    if not edges:
        return []
    scale = np.array([max(np.ptp(np.concatenate([e[k] for e in edges])), 1e-300) for k in (1, 2)])
    paths = [np.stack([e.alpha, e.beta], -1) for e in edges]
    main = [border.pieces.is_main(border.piece_of(edge)) for edge in edges]
    loops = []
    while paths:
        path, soft = paths.pop(), main.pop()
        while True:
            gaps = [
                (float(np.abs((path[-1] - other[end]) / scale).max()), k, end)
                for k, other in enumerate(paths)
                for end in (0, -1)
            ]
            closing = float(np.abs((path[-1] - path[0]) / scale).max())
            if not gaps or (path.shape[0] > 2 and closing <= min(min(gaps)[0], 1e-3)):
                break
            gap, k, end = min(gaps)
            if gap > 1e-3:
                break
            other, soft = paths.pop(k), soft | main.pop(k)
            path = np.concatenate([path, (other if end == 0 else other[::-1])[1:]])
        loops.append((path, soft))
    found = [Outline(path[:, 0], path[:, 1], False, not soft) for path, soft in loops]
    found.sort(key=lambda outline: -outline.area)
    return [o._replace(hole=_inside(found, k) % 2 == 1) for k, o in enumerate(found)]


def _inside(found: list[Outline], k: int) -> int:
    """How many of the larger outlines an outline lies in."""
    from matplotlib.path import Path

    point = found[k].stiffness[0], found[k].virtual_damping[0]
    return sum(bool(Path(np.stack([o.stiffness, o.virtual_damping], -1)).contains_point(point)) for o in found[:k])
