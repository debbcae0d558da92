"""The edge of the stable set of any linear loop and the pieces of the set, by rows between which nothing changes.

A row is stable in intervals, each between two columns of its crossings, which are arcs or lines. As beta moves they
keep their columns, up to where two columns meet: a corner, or an end of arcs (docs/theory/scenes.md, V20). Rows stand
on both sides of every such damping, so that what they tell holds between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zwidth.arrays.roots import false_position
from zwidth.loops.linear.boundary import Boundary
from zwidth.loops.linear.curve import curve_at, zeros_of
from zwidth.loops.linear.rows import Island, bound_intervals, reaches_down
from zwidth.words.showing import shown

# Rows across the whole of the plane, and how far beyond the edge that nodes show the first and the last one are.
_ACROSS, _BEYOND = 65, 0.05
# Rows beside a damping at which columns meet, as shares of the way between the rows that enclosed it.
# The nearest two enclose it.
_BESIDE, _CLOSE = np.array([-1e-3, -1e-7, 1e-7, 1e-3]), 3e-7
# How often rows are added, and steps towards a corner, which is told to such a share of its damping.
_ROUNDS, _STEPS, _TOLD = 60, 60, 1e-13
# Edges of few nodes get so many points.
_FEW, _FILLED = 5, 33
# So near to an edge, as a share of its damping, a row is on it.
_NEAR = 1e-9


class Edge(NamedTuple):
    """A part of one column along which stable intervals end, in ascending damping, from meeting to meeting."""

    column: int
    piece: int
    rows: slice  # those that it ends intervals of
    meetings: tuple[int, int]  # the numbers of the first and of the last one
    w: np.ndarray  # NaN at both ends
    alpha: np.ndarray
    beta: np.ndarray


class _Rows(NamedTuple):
    """Rows in ascending order, and of each column the stable interval that it ends: (rows, columns), NaN for none."""

    beta: np.ndarray
    alpha: np.ndarray
    w: np.ndarray
    upper: np.ndarray  # of the lower end of an interval the column of the upper one, else -1


class _Meetings(NamedTuple):
    """Where two columns cease to end intervals together, or begin to: between which rows, and the wall there."""

    gap: np.ndarray  # the number of the row above
    columns: np.ndarray  # (meetings, 2)
    walls: np.ndarray  # (meetings, 2), alpha and beta
    known: np.ndarray  # whether that is a wall at which they meet, or one between the rows


@dataclass(frozen=True)
class Border:
    """The edge of the stable set of one loop."""

    boundary: Boundary

    @cached_property
    def _nodes(self) -> np.ndarray:
        """Angles, alpha and beta at the nodes of the curve, the extremes of alpha among them."""
        w = np.union1d(self.boundary.w, self.boundary.tops)
        return np.stack([w, *curve_at(self.boundary.loop, w)[:2]])

    @property
    def _upright(self) -> float:
        """The damping of a lossless loop if exactly two crossing lines bound its stable walls; otherwise NaN."""
        return self.boundary.lossless if len(self.boundary.lines) == 2 else np.nan

    def _first_rows(self) -> np.ndarray:
        """Rows on both sides of where nodes of the curve cease to be on the edge, and across the set."""
        b, (w, _, beta) = self.boundary, self._nodes
        own, held = b.arc_at(w), b.borders(w)
        parted = np.pad((held[1:] != held[:-1]) | (held[1:] & (own[1:] != own[:-1])), 1, constant_values=True)
        near = beta[parted[1:] | parted[:-1]]
        set_at = beta[held] if held.any() else np.array([arc.beta[[0, -1]] for arc in b.arcs]).ravel()
        set_at = set_at[np.isfinite(set_at)]
        if not set_at.size:
            return set_at
        room = _BEYOND * (np.ptp(set_at) + abs(set_at[0]) + 1e-300)
        across = np.linspace(set_at.min() - room, set_at.max() + room, _ACROSS)
        # Soft walls without damping are stable on a device that comes to rest, however few angles its edge has.
        across = across if held.any() else np.union1d(across, 0.0)
        # Nodes that are not on the edge may be next to where the curve runs to infinity.
        return np.union1d(across, near[(near > across[0]) & (near < across[-1])])

    def _look(self, beta: np.ndarray) -> _Rows:
        """The stable intervals of rows; of those alone whose crossings do not contradict each other."""
        b = self.boundary
        beta = beta[b.settle(beta)[1]]
        found, shape = bound_intervals(b, beta), (beta.size, len(b.arcs) + len(b.lines))
        rows = _Rows(beta, np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
        row, k = np.nonzero((found.below >= 0) & (found.above >= 0))
        below, above = found.below[row, k], found.above[row, k]
        rows.upper[row, below] = above
        for column, alpha, w in ((below, found.low, found.w_below), (above, found.high, found.w_above)):
            rows.alpha[row, column], rows.w[row, column] = alpha[row, k], w[row, k]
        return rows

    @cached_property
    def _found(self) -> tuple[_Rows, _Meetings]:
        """Rows on both sides of all dampings at which columns meet, and the meetings."""
        if np.isfinite(self._upright):
            one, other = self.boundary.lines
            corner = (one.q - other.q) / (one.f - other.f)
            rows = self._look(np.unique(corner + (self._upright - corner) * np.linspace(0.0, 1.0, _ACROSS + 1)[1:-1]))
            return rows, _pair_ends(rows, np.array([[one.q - corner * one.f, corner, np.inf]]))
        looked_at, corners = self._first_rows(), np.empty((0, 3))
        rows = self._look(looked_at)
        met = _pair_ends(rows, corners)
        for _ in range(_ROUNDS):
            left = np.flatnonzero(~met.known)
            if not left.size:
                break
            new, more = self._enclose(rows, met, left)
            new, corners = np.setdiff1d(new, looked_at), np.concatenate([corners, more])
            looked_at = np.append(looked_at, new)
            parts = [np.concatenate(both) for both in zip(rows, self._look(new), strict=True)]
            order = np.unique(parts[0], return_index=True)[1]
            rows = _Rows(*(part[order] for part in parts))
            met = _pair_ends(rows, corners)
            if not new.size:
                break
        return rows, met

    def _enclose(self, rows: _Rows, met: _Meetings, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows next to where columns meet, and the walls there as far as they are told: as `_pair_ends` takes them."""
        b, columns, beta = self.boundary, met.columns[left], rows.beta
        # The set may go on beyond the first row, or the last one.
        size = np.ptp(beta[np.isfinite(rows.alpha).any(1)]) + np.spacing(np.abs(beta).max())
        low, high = np.concatenate([[beta[0] - size], beta, [beta[-1] + size]])[met.gap[left] + np.array([[0], [1]])]
        # An arc ends; or two columns cross; else the rows are halved.
        ends = np.moveaxis(b.ends[..., columns], -1, 1).reshape(2, -1, left.size)
        inside = (ends[1] > low) & (ends[1] < high)
        alpha, at = np.where(inside.any(0), ends[:, inside.argmax(0), np.arange(left.size)], np.nan)
        first, last = self._gaps(np.tile(columns, (2, 1)), np.concatenate([low, high])).reshape(2, -1)
        k = np.flatnonzero(np.isnan(at) & (np.sign(first) * np.sign(last) == -1))
        if k.size:
            first, last = first[k], last[k]
            scale = np.sign(first) / (np.abs(first) + np.abs(last))
            width = _TOLD * np.maximum(np.abs(low[k]), np.abs(high[k]))
            ends = low[k], high[k], first * scale, last * scale
            at[k] = false_position(lambda at: scale * self._gaps(columns[k], at), *ends, _STEPS, width)
            alpha[k] = b.cross(columns[k, 0], at[k])
        told = np.isfinite(at) & np.isfinite(alpha)
        new = np.concatenate([[0.5 * (low + high)], at + (high - low) * _BESIDE[:, None]])
        return np.unique(new[(new > low) & (new < high)]), np.stack([alpha, at, _CLOSE * (high - low)], -1)[told]

    def _gaps(self, columns: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """How far two columns are apart in each row; NaN where one does not meet it."""
        return np.subtract(*self.boundary.cross(columns.T.ravel(), np.tile(beta, 2)).reshape(2, -1))

    @cached_property
    def edges(self) -> list[Edge]:
        """All of it, and the piece that each edge bounds."""
        (rows, met), edges = self._found, []
        if np.isfinite(self._upright):
            return self._triangle if met.gap.size else []
        held = np.pad(np.isfinite(rows.alpha.T), ((0, 0), (1, 1)))
        begins, ends = held[:, 1:-1] & ~held[:, :-2], held[:, 1:-1] & ~held[:, 2:]
        # Edges that one interval of a row is between bound one piece, and edges that meet.
        number = np.cumsum(begins).reshape(begins.shape).T - 1
        row, below = np.nonzero(rows.upper >= 0)
        pairs = [number[row, below], number[row, rows.upper[row, below]]]
        gap = met.gap[:, None]
        meeting = number[gap - ~held[met.columns, gap + 1], met.columns].T
        pieces = _join(np.concatenate([pairs, meeting], 1), int(begins.sum()))
        numbers = {(gap, column): k for k, gap in enumerate(met.gap.tolist()) for column in met.columns[k].tolist()}
        (columns, firsts), (_, lasts) = np.nonzero(begins), np.nonzero(ends)
        for piece, column, first, last in np.stack([pieces, columns, firsts, lasts], 1).tolist():
            own = numbers[first, column], numbers[last + 1, column]
            path = self._trace(column, rows.w[[first, last], column], met.walls[list(own)])
            edges.append(Edge(column, piece, slice(first, last + 1), own, *path))
        return edges

    @property
    def _triangle(self) -> list[Edge]:
        """The edges where all pole pairs are at one damping: two lines, and the curve upright between them."""
        b, ends, edges = self.boundary, [], []
        corner = next(wall[1] for wall in self._found[1].walls[self._found[1].known].tolist())
        for k, line in enumerate(b.lines):
            beta = np.sort([corner, self._upright])
            ends.append((line.w, float(line.q - self._upright * line.f)))
            meetings = (0, k + 1) if beta[0] == corner else (k + 1, 0)
            own = slice(0, self._found[0].beta.size)
            edges.append(Edge(len(b.arcs) + k, 0, own, meetings, np.full(2, np.nan), line.q - beta * line.f, beta))
        (first, low), (_, high) = ends
        w = b.w if first == 0.0 else b.w[::-1]
        alpha = np.concatenate([[low], curve_at(b.loop, w).alpha, [high]])
        w = np.concatenate([[np.nan], w, [np.nan]])
        return [*edges, Edge(-1, 0, slice(0), (1, 2), w, alpha, np.full(w.size, self._upright))]

    def _trace(self, column: int, within: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Angles, alpha and beta along a column from one wall to another, of few nodes with more of two angles."""
        b, path = self.boundary, np.empty((3, 0))
        if column < len(b.arcs):
            path = self._nodes[:, b.arc_at(self._nodes[0]) == column]
            path = path[:, (path[2] > ends[0, 1]) & (path[2] < ends[1, 1])]
            if path.shape[1] < _FEW:
                more = np.linspace(within.min(), within.max(), _FILLED)
                tops = zeros_of(b.loop, more, curve_at(b.loop, more).alpha_slope, "alpha_slope")
                w = np.unique(np.concatenate([path[0], more[1:-1], tops]))
                path = np.stack([w, *curve_at(b.loop, w)[:2]])
            path = path if b.arcs[column].w[0] < b.arcs[column].w[-1] else path[:, ::-1]
        return np.insert(path, [0, path.shape[1]], np.insert(ends.T, 0, np.nan, 0), 1)

    @cached_property
    def width(self) -> float:
        """Over which dampings its edges reach."""
        return float(np.ptp([edge.beta[[0, -1]] for edge in self.edges]))

    @cached_property
    def main(self) -> frozenset[int]:
        """Indices of the pieces of the stable set that are connected to K = 0.

        A piece that narrows to a point at K = 0 counts as connected. If no piece is, because the device is unstable
        without a wall: the piece that contains the softest stable wall, among the pieces with B > 0 if any exist.
        """
        ends: dict[int, list[float]] = {}
        damped = {edge.piece for edge in self.edges if edge.beta[-1] > 0}
        for edge in self.edges:
            ends.setdefault(edge.piece, []).extend([edge.alpha.min(), edge.alpha.max()])
        soft = frozenset(piece for piece, both in ends.items() if reaches_down(np.min(both), np.max(both)))
        stiff = [piece for piece, both in ends.items() if np.max(both) > 0]
        if soft or not stiff or not self.boundary.loop.device_is_unstable:
            return soft
        return frozenset([min(stiff, key=lambda piece: (piece not in damped, np.min(ends[piece])))])

    def find_softest(self, least: float) -> float:
        """Return the lowest alpha on the edges of the `main` pieces at dampings of at least ``least``; NaN if none."""
        walls = [edge.alpha[edge.beta >= least] for edge in self.soft_edges(least)]
        return float(min((alpha.min() for alpha in walls if alpha.size), default=np.nan))

    def holds_softly(self, alpha: float, beta: float) -> bool:
        """Whether a wall is stable in a piece with soft walls."""
        # The edges above it, on its row or beside: where several meet, that of the row may be another one.
        rows = beta + _NEAR * (abs(beta) + self.width) * np.array([0.0, -1.0, 1.0])
        found = bound_intervals(self.boundary, rows)
        row, k = np.nonzero((found.low < alpha) & (alpha < found.high))
        above = set(zip(rows[row].tolist(), found.above[row, k].tolist(), strict=True))
        edges = self.soft_edges(-np.inf)
        return any(edge.beta[0] <= at <= edge.beta[-1] and edge.column == end for edge in edges for at, end in above)

    def soft_edges(self, least: float) -> list[Edge]:
        """The edges of pieces with soft walls that reach beyond a damping: not by rounding of a meeting there."""
        main = [edge for edge in self.edges if edge.piece in self.main]
        return [edge for edge in main if edge.beta[-1] - least > _TOLD * np.ptp(edge.beta)]

    def find_highest(self, least: float) -> float:
        """Up to which alpha rows with that much damping or more are stable in pieces with soft walls; else -inf."""
        rows, highest = self._found[0], -np.inf
        for edge in self.soft_edges(least):
            own = rows.alpha[edge.rows, edge.column]
            highest = np.max(own, where=rows.beta[edge.rows] >= least, initial=highest)
        return float(highest)

    def islands(self, least: float) -> list[Island]:
        """The pieces without soft walls, with walls of alpha > 0 and beta > ``least``, the stiffest first."""
        found = []
        for piece in {edge.piece for edge in self.edges} - self.main:
            walls = np.concatenate([edge[-2:] for edge in self.edges if edge.piece == piece], 1)
            found.append(Island(*(tuple(pair) for pair in np.stack([walls.min(1), walls.max(1)], 1).tolist())))
        # Of one that ends at K = 0 rounding may leave a little above it.
        found = [one for one in found if one.stiffness[1] > _NEAR * np.ptp(one.stiffness)]
        found = [one for one in found if one.virtual_damping[1] > least]
        return sorted(found, key=lambda one: -one.stiffness[1])

    def outlines(self) -> list[Outline]:
        """All edges as closed outlines, the largest first."""
        joined: dict[int, list[tuple[int, int]]] = {}
        for k, edge in enumerate(self.edges):
            for end, meeting in enumerate(edge.meetings):
                joined.setdefault(meeting, []).append((k, end))
        follow = {one: other for both in joined.values() for one, other in (both, both[::-1])}
        found, left = [], dict.fromkeys(range(len(self.edges)))
        while left:
            at, path = (next(iter(left)), 0), []
            piece = self.edges[at[0]].piece
            while at[0] in left:
                del left[at[0]]
                walls = np.stack(self.edges[at[0]][-2:])
                path.append((walls[:, ::-1] if at[1] else walls)[:, :-1])
                at = follow[at[0], 1 - at[1]]
            stiffness, damping = np.concatenate(path, 1)
            found.append((piece, Outline(stiffness, damping, False, piece not in self.main)))
        # Where the curve has one damping but for rounding, rounding draws outlines of its own.
        found = [(piece, one) for piece, one in found if np.ptp(one.virtual_damping) > _TOLD * self.width]
        found.sort(key=lambda each: -each[1].area)
        # What else bounds a piece than the largest of its outlines are holes.
        outer = {piece: k for k, (piece, _) in reversed(list(enumerate(found)))}
        return [outline._replace(hole=outer[piece] != k) for k, (piece, outline) in enumerate(found)]


def _join(pairs: np.ndarray, count: int) -> np.ndarray:
    """The least number that each of so many is joined to, directly or not, by pairs (2, pairs)."""
    # A graph of SciPy's would take a third of a second to load.
    least, before = np.arange(count), np.full(count, -1)
    while not np.array_equal(least, before):
        before = least.copy()
        for one, other in (pairs, pairs[::-1]):
            np.minimum.at(least, one, before[other])
        least = least[least]
    return least


def _pair_ends(rows: _Rows, corners: np.ndarray) -> _Meetings:
    """The meetings between rows, and as their walls the nearest of the corners that these enclose."""
    # Of each corner (3,) alpha, beta, and how close to each other rows enclose it. Where an interval begins or ends, is
    # parted, or changes a column, two columns do; in order of alpha they are pairs.
    alpha = np.pad(rows.alpha, ((1, 1), (0, 0)), constant_values=np.nan)
    held = np.isfinite(alpha)
    gap, column = np.nonzero(held[1:] != held[:-1])
    beside = np.where(held[gap, column], alpha[gap, column], alpha[gap + 1, column])
    order = np.lexsort((beside, gap))
    gap, columns, beside = gap[order][::2], column[order].reshape(-1, 2), beside[order].reshape(-1, 2).mean(1)
    ends = np.concatenate([[-np.inf], rows.beta, [np.inf]])
    low, high = ends[gap][:, None], ends[gap + 1][:, None]
    inside = (corners[:, 1] > low) & (corners[:, 1] < high) & (high - low <= corners[:, 2])
    walls, known = np.stack([beside, 0.5 * (ends[gap] + ends[gap + 1])], -1), np.asarray(inside.any(1))
    for k in np.flatnonzero(known).tolist():
        own = corners[inside[k]]
        walls[k] = own[np.argmin(np.abs(own[:, 0] - beside[k])), :2]
    return _Meetings(gap, columns, walls, known)


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
