"""Find the edges, the connected pieces and the outlines of the stable set of any linear loop.

A line of constant B is stable in intervals of alpha, and each end of an interval lies in one *column*, an arc or a
crossing line of `stability.linear.boundary`. As beta varies, the intervals keep their columns up to a *meeting*, where
two columns start or stop bounding intervals together: a corner, where they cross, or an extremum of beta, where two
arcs end (docs/theory/scenes.md, V20). The part of a column between two meetings that bounds stable intervals is an
*edge*. Lines of constant B are placed on both sides of every meeting, so their intervals determine all edges and
*pieces*, the connected components. A piece is *connected to K = 0* if a path of stable walls leads from its walls to K
= 0; the other pieces are *islands*. In arrays, a *row* belongs to a line of constant B.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from zwidth.numerics.root_finding import false_position
from zwidth.stability.linear.boundary import Boundary
from zwidth.stability.linear.curve import evaluate_curve, find_field_zeros
from zwidth.stability.linear.rows import Island, are_connected, find_stable_intervals
from zwidth.units.display import compact_repr

# Initial lines of constant B.
N_ACROSS = 65  # equidistant lines across the stable set
BEYOND = 0.05  # distance in beta of the first and last line from the stable nodes, relative to the range of their betas

# Refinement near meetings. New lines of constant B have these offsets in beta from a meeting, relative to the gap
# between the two lines that enclose the meeting.
MEETING_OFFSETS = np.array([-1e-3, -1e-7, 1e-7, 1e-3])
# Largest gap in beta between two lines that enclose a meeting, after refinement, relative to the gap before it.
ENCLOSED_GAP = 3e-7
MAX_ROUNDS = 60  # rounds in which lines are added
MAX_CORNER_STEPS = 60  # steps of false position for a corner
DAMPING_TOLERANCE = 1e-13  # relative accuracy of the damping of a corner

# Tabulation of edges.
MIN_NODES = 5  # an edge with fewer nodes of the curve is tabulated at N_FILLED points
N_FILLED = 33  # number of points of such an edge
NEAR_EDGE = 1e-9  # relative distance in beta from a meeting within which rounding errors may select a neighboring edge


class Edge(NamedTuple):
    """The part of one column between two meetings along which stable intervals end, tabulated in ascending damping."""

    column: int
    piece: int
    rows: slice  # lines of constant B whose intervals it bounds
    meetings: tuple[int, int]  # indices of the meetings at its first and last damping
    w: np.ndarray  # NaN at both ends
    alpha: np.ndarray
    beta: np.ndarray


class _Rows(NamedTuple):
    """Ends of stable intervals on lines of constant B: shape (rows, columns), NaN where a column bounds no interval.

    The rows are in ascending order of beta. ``alpha`` and ``w`` are those of the end that lies in the column.
    """

    beta: np.ndarray  # shape (rows,)
    alpha: np.ndarray
    w: np.ndarray
    upper: np.ndarray  # in the column of the lower end of an interval: the column of its upper end; otherwise -1


class _Meetings(NamedTuple):
    """The meetings, each of two columns, that lie in the gaps between neighboring lines of constant B."""

    gap: np.ndarray  # index of the line above
    columns: np.ndarray  # shape (meetings, 2)
    walls: np.ndarray  # alpha and beta of each meeting, shape (meetings, 2); only an estimate if not ``enclosed``
    enclosed: np.ndarray  # True if the wall of the meeting has been computed and two close lines enclose it


@dataclass(frozen=True)
class StableSet:
    """The set of stable walls of one loop, represented by the edges that bound it."""

    boundary: Boundary

    @cached_property
    def _nodes(self) -> np.ndarray:
        """Angle, alpha and beta (first axis) at the curve's nodes and at its extrema of alpha, shape (3, nodes)."""
        w = np.union1d(self.boundary.w, self.boundary.alpha_extrema)
        return np.stack([w, *evaluate_curve(self.boundary.loop, w)[:2]])

    @property
    def _triangle_beta(self) -> float:
        """The damping of a lossless loop if exactly two crossing lines bound its stable walls; otherwise NaN."""
        return self.boundary.lossless if len(self.boundary.lines) == 2 else np.nan

    def _place_rows(self) -> np.ndarray:
        """Return the dampings beta of the initial lines of constant B.

        They are equidistant across the stable set, and close to each point of the curve where an edge starts or ends.
        """
        b, (w, _, beta) = self.boundary, self._nodes
        arc, is_edge = b.find_arc(w), b.are_stable_edges(w)
        changes = np.pad((is_edge[1:] != is_edge[:-1]) | (is_edge[1:] & (arc[1:] != arc[:-1])), 1, constant_values=True)
        near = beta[changes[1:] | changes[:-1]]
        reached = beta[is_edge] if is_edge.any() else np.array([arc.beta[[0, -1]] for arc in b.arcs]).ravel()
        reached = reached[np.isfinite(reached)]
        if not reached.size:
            return reached
        margin = BEYOND * (np.ptp(reached) + abs(reached[0]) + 1e-300)
        across = np.linspace(reached.min() - margin, reached.max() + margin, N_ACROSS)
        # If no node is on an edge, add the line beta = 0. The set may contain walls on this line, because on a device
        # that comes to rest by itself all sufficiently soft walls are stable.
        across = across if is_edge.any() else np.union1d(across, 0.0)
        # Drop lines outside the range of ``across``, because they may lie near an asymptote of the curve.
        return np.union1d(across, near[(near > across[0]) & (near < across[-1])])

    def _scan_rows(self, beta: np.ndarray) -> _Rows:
        """Return the stable intervals on lines of constant B; lines with inconsistent crossings are left out."""
        b = self.boundary
        beta = beta[b.shift_ambiguous(beta)[1]]
        intervals, shape = find_stable_intervals(b, beta), (beta.size, len(b.arcs) + len(b.lines))
        rows = _Rows(beta, np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, -1))
        row, k = np.nonzero((intervals.below >= 0) & (intervals.above >= 0))
        below, above = intervals.below[row, k], intervals.above[row, k]
        rows.upper[row, below] = above
        for column, alpha, w in (
            (below, intervals.low, intervals.w_below),
            (above, intervals.high, intervals.w_above),
        ):
            rows.alpha[row, column], rows.w[row, column] = alpha[row, k], w[row, k]
        return rows

    @cached_property
    def _enclosed(self) -> tuple[_Rows, _Meetings]:
        """Stable intervals on lines of constant B, two of which closely enclose each meeting, and the meetings."""
        if np.isfinite(self._triangle_beta):
            one, other = self.boundary.lines
            corner = (one.q - other.q) / (one.f - other.f)
            rows = self._scan_rows(
                np.unique(corner + (self._triangle_beta - corner) * np.linspace(0.0, 1.0, N_ACROSS + 1)[1:-1])
            )
            return rows, _pair_ends(rows, np.array([[one.q - corner * one.f, corner, np.inf]]))
        scanned, corners = self._place_rows(), np.empty((0, 3))
        rows = self._scan_rows(scanned)
        meetings = _pair_ends(rows, corners)
        for _ in range(MAX_ROUNDS):
            left = np.flatnonzero(~meetings.enclosed)
            if not left.size:
                break
            new, more = self._refine_meetings(rows, meetings, left)
            new, corners = np.setdiff1d(new, scanned), np.concatenate([corners, more])
            scanned = np.append(scanned, new)
            parts = [np.concatenate(both) for both in zip(rows, self._scan_rows(new), strict=True)]
            order = np.unique(parts[0], return_index=True)[1]
            rows = _Rows(*(part[order] for part in parts))
            meetings = _pair_ends(rows, corners)
            if not new.size:
                break
        return rows, meetings

    def _refine_meetings(self, rows: _Rows, meetings: _Meetings, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Locate meetings more accurately, and return lines of constant B just below and just above each meeting.

        Args:
            rows: stable intervals on all lines so far.

        Returns:
            Dampings of further lines near these meetings, and the located corners as in `_pair_ends`.
        """
        b, columns, beta = self.boundary, meetings.columns[left], rows.beta
        # Add a gap below the lowest and above the highest line of constant B, because meetings may lie there, too.
        size = np.ptp(beta[np.isfinite(rows.alpha).any(1)]) + np.spacing(np.abs(beta).max())
        low, high = np.concatenate([[beta[0] - size], beta, [beta[-1] + size]])[
            meetings.gap[left] + np.array([[0], [1]])
        ]
        # Locate a meeting at an end of an arc, if one lies in the gap; otherwise at the corner of the two columns, if
        # their difference in alpha changes its sign. Always halve the gap as well, in case neither exists.
        ends = np.moveaxis(b.ends[..., columns], -1, 1).reshape(2, -1, left.size)
        inside = (ends[1] > low) & (ends[1] < high)
        alpha, damping = np.where(inside.any(0), ends[:, inside.argmax(0), np.arange(left.size)], np.nan)
        first, last = self._subtract_columns(np.tile(columns, (2, 1)), np.concatenate([low, high])).reshape(2, -1)
        k = np.flatnonzero(np.isnan(damping) & (np.sign(first) * np.sign(last) == -1))
        if k.size:
            first, last = first[k], last[k]
            scale = np.sign(first) / (np.abs(first) + np.abs(last))
            width = DAMPING_TOLERANCE * np.maximum(np.abs(low[k]), np.abs(high[k]))
            ends = low[k], high[k], first * scale, last * scale
            damping[k] = false_position(
                lambda beta: scale * self._subtract_columns(columns[k], beta), *ends, MAX_CORNER_STEPS, width
            )
            alpha[k] = b.find_alpha(columns[k, 0], damping[k])
        located = np.isfinite(damping) & np.isfinite(alpha)
        new = np.concatenate([[0.5 * (low + high)], damping + (high - low) * MEETING_OFFSETS[:, None]])
        return (
            np.unique(new[(new > low) & (new < high)]),
            np.stack([alpha, damping, ENCLOSED_GAP * (high - low)], -1)[located],
        )

    def _subtract_columns(self, columns: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Return the difference in alpha between the crossings of each line with two columns; NaN unless both exist."""
        return np.subtract(*self.boundary.find_alpha(columns.T.ravel(), np.tile(beta, 2)).reshape(2, -1))

    @cached_property
    def edges(self) -> list[Edge]:
        """All edges of the stable set, each with the index of the piece that it bounds."""
        (rows, meetings), edges = self._enclosed, []
        if np.isfinite(self._triangle_beta):
            return self._triangle if meetings.gap.size else []
        bounds = np.pad(np.isfinite(rows.alpha.T), ((0, 0), (1, 1)))
        begins, ends = bounds[:, 1:-1] & ~bounds[:, :-2], bounds[:, 1:-1] & ~bounds[:, 2:]
        # Assign two edges to the same piece if they bound the same stable interval or if they end at the same meeting.
        number = np.cumsum(begins).reshape(begins.shape).T - 1
        row, below = np.nonzero(rows.upper >= 0)
        pairs = [number[row, below], number[row, rows.upper[row, below]]]
        gap = meetings.gap[:, None]
        meeting = number[gap - ~bounds[meetings.columns, gap + 1], meetings.columns].T
        pieces = _join_pairs(np.concatenate([pairs, meeting], 1), int(begins.sum()))
        index = {
            (gap, column): k for k, gap in enumerate(meetings.gap.tolist()) for column in meetings.columns[k].tolist()
        }
        (columns, firsts), (_, lasts) = np.nonzero(begins), np.nonzero(ends)
        for piece, column, first, last in np.stack([pieces, columns, firsts, lasts], 1).tolist():
            both = index[first, column], index[last + 1, column]
            path = self._trace_edge(column, rows.w[[first, last], column], meetings.walls[list(both)])
            edges.append(Edge(column, piece, slice(first, last + 1), both, *path))
        return edges

    @property
    def _triangle(self) -> list[Edge]:
        """The three edges of a triangular stable set: two crossing lines, and the curve at the lossless damping."""
        b, ends, edges = self.boundary, [], []
        corner = next(wall[1] for wall in self._enclosed[1].walls[self._enclosed[1].enclosed].tolist())
        for k, line in enumerate(b.lines):
            beta = np.sort([corner, self._triangle_beta])
            ends.append((line.w, float(line.q - self._triangle_beta * line.f)))
            both = (0, k + 1) if beta[0] == corner else (k + 1, 0)
            rows = slice(0, self._enclosed[0].beta.size)
            edges.append(Edge(len(b.arcs) + k, 0, rows, both, np.full(2, np.nan), line.q - beta * line.f, beta))
        (first, low), (_, high) = ends
        w = b.w if first == 0.0 else b.w[::-1]
        alpha = np.concatenate([[low], evaluate_curve(b.loop, w).alpha, [high]])
        w = np.concatenate([[np.nan], w, [np.nan]])
        return [*edges, Edge(-1, 0, slice(0), (1, 2), w, alpha, np.full(w.size, self._triangle_beta))]

    def _trace_edge(self, column: int, angles: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return the tabulated points of an edge, the part of a column between two walls.

        Args:
            column: index of the column.

        Returns:
            Angle (NaN at both walls), alpha and beta, shape (3, points).
        """
        b, path = self.boundary, np.empty((3, 0))
        if column < len(b.arcs):
            path = self._nodes[:, b.find_arc(self._nodes[0]) == column]
            path = path[:, (path[2] > ends[0, 1]) & (path[2] < ends[1, 1])]
            if path.shape[1] < MIN_NODES:
                more = np.linspace(angles.min(), angles.max(), N_FILLED)
                extrema = find_field_zeros(b.loop, more, evaluate_curve(b.loop, more).alpha_slope, "alpha_slope")
                w = np.unique(np.concatenate([path[0], more[1:-1], extrema]))
                path = np.stack([w, *evaluate_curve(b.loop, w)[:2]])
            path = path if b.arcs[column].w[0] < b.arcs[column].w[-1] else path[:, ::-1]
        return np.insert(path, [0, path.shape[1]], np.insert(ends.T, 0, np.nan, 0), 1)

    @cached_property
    def width(self) -> float:
        """The range of beta on all edges: the largest minus the smallest value."""
        return float(np.ptp([edge.beta[[0, -1]] for edge in self.edges]))

    @cached_property
    def main(self) -> frozenset[int]:
        """Indices of the pieces of the stable set that are connected to K = 0.

        A piece that narrows to a point at K = 0 counts as connected. If no piece is connected, because the device is
        unstable without a wall, this is the piece with the softest stable wall, if possible one with B > 0.
        """
        ends: dict[int, list[float]] = {}
        damped = {edge.piece for edge in self.edges if edge.beta[-1] > 0}
        for edge in self.edges:
            ends.setdefault(edge.piece, []).extend([edge.alpha.min(), edge.alpha.max()])
        connected = frozenset(piece for piece, both in ends.items() if are_connected(np.min(both), np.max(both)))
        stiff = [piece for piece, both in ends.items() if np.max(both) > 0]
        if connected or not stiff or not self.boundary.loop.device_is_unstable:
            return connected
        return frozenset([min(stiff, key=lambda piece: (piece not in damped, np.min(ends[piece])))])

    def find_softest(self, least: float) -> float:
        """Return the lowest alpha of the edges of `main` pieces (connected to K = 0) with beta >= ``least``, or NaN."""
        walls = [edge.alpha[edge.beta >= least] for edge in self.main_edges(least)]
        return float(min((alpha.min() for alpha in walls if alpha.size), default=np.nan))

    def is_in_main(self, alpha: float, beta: float) -> bool:
        """Return whether a wall lies in a piece that is connected to K = 0."""
        # Find the column at the upper end of the wall's stable interval, and search the edges of main pieces for an
        # edge in this column. Near a meeting, rounding errors may select a neighboring edge; therefore also test two
        # lines of constant B close to the wall.
        rows = beta + NEAR_EDGE * (abs(beta) + self.width) * np.array([0.0, -1.0, 1.0])
        intervals = find_stable_intervals(self.boundary, rows)
        row, k = np.nonzero((intervals.low < alpha) & (alpha < intervals.high))
        above = set(zip(rows[row].tolist(), intervals.above[row, k].tolist(), strict=True))
        edges = self.main_edges(-np.inf)
        return any(edge.beta[0] <= row <= edge.beta[-1] and edge.column == end for edge in edges for row, end in above)

    def main_edges(self, least: float) -> list[Edge]:
        """Return the edges of `main` pieces (connected to K = 0) whose largest damping clearly exceeds ``least``."""
        main = [edge for edge in self.edges if edge.piece in self.main]
        return [edge for edge in main if edge.beta[-1] - least > DAMPING_TOLERANCE * np.ptp(edge.beta)]

    def find_highest(self, least: float) -> float:
        """Return the largest stable alpha for beta >= ``least`` in pieces connected to K = 0; -inf if there is none."""
        rows, highest = self._enclosed[0], -np.inf
        for edge in self.main_edges(least):
            alpha = rows.alpha[edge.rows, edge.column]
            highest = np.max(alpha, where=rows.beta[edge.rows] >= least, initial=highest)
        return float(highest)

    def islands(self, least: float) -> list[Island]:
        """Return the islands that contain walls with alpha > 0 and beta > ``least``, the stiffest first."""
        islands = []
        for piece in {edge.piece for edge in self.edges} - self.main:
            walls = np.concatenate([edge[-2:] for edge in self.edges if edge.piece == piece], 1)
            islands.append(Island(*(tuple(pair) for pair in np.stack([walls.min(1), walls.max(1)], 1).tolist())))
        # Drop islands that consist of walls with K <= 0. Rounding errors may make their largest alpha slightly
        # positive.
        islands = [one for one in islands if one.stiffness[1] > NEAR_EDGE * np.ptp(one.stiffness)]
        islands = [one for one in islands if one.virtual_damping[1] > least]
        return sorted(islands, key=lambda one: -one.stiffness[1])

    def outlines(self) -> list[Outline]:
        """Join the edges of the stable set to closed outlines; return them by area, the largest first."""
        joined: dict[int, list[tuple[int, int]]] = {}
        for k, edge in enumerate(self.edges):
            for end, meeting in enumerate(edge.meetings):
                joined.setdefault(meeting, []).append((k, end))
        successor = {one: other for both in joined.values() for one, other in (both, both[::-1])}
        outlines, left = [], dict.fromkeys(range(len(self.edges)))
        while left:
            current, path = (next(iter(left)), 0), []
            piece = self.edges[current[0]].piece
            while current[0] in left:
                del left[current[0]]
                walls = np.stack(self.edges[current[0]][-2:])
                path.append((walls[:, ::-1] if current[1] else walls)[:, :-1])
                current = successor[current[0], 1 - current[1]]
            stiffness, damping = np.concatenate(path, 1)
            outlines.append((piece, Outline(stiffness, damping, False, piece not in self.main)))
        # Drop outlines without width in beta. Rounding errors create them along parts of the curve with constant
        # damping.
        outlines = [
            (piece, one) for piece, one in outlines if np.ptp(one.virtual_damping) > DAMPING_TOLERANCE * self.width
        ]
        outlines.sort(key=lambda each: -each[1].area)
        # Mark all outlines of a piece except the largest as holes, because the largest one is its outer outline.
        outer = {piece: k for k, (piece, _) in reversed(list(enumerate(outlines)))}
        return [outline._replace(hole=outer[piece] != k) for k, (piece, outline) in enumerate(outlines)]


def _join_pairs(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the connected component of each of ``count`` nodes of a graph with edges of shape (2, pairs).

    A component is denoted by the smallest index of its nodes.
    """
    # Do not use `scipy.sparse.csgraph`, because its import takes a third of a second.
    least, before = np.arange(count), np.full(count, -1)
    while not np.array_equal(least, before):
        before = least.copy()
        for one, other in (pairs, pairs[::-1]):
            np.minimum.at(least, one, before[other])
        least = least[least]
    return least


def _pair_ends(rows: _Rows, corners: np.ndarray) -> _Meetings:
    """Return the meetings of columns in each gap between neighboring lines of constant B.

    Args:
        rows: stable intervals on the lines.
    """
    # Find the columns that bound an interval on one line but not on the next. Between these lines, each of them meets
    # another one, where an interval begins, ends, splits, or changes a column. In order of alpha, two successive
    # columns form a pair.
    alpha = np.pad(rows.alpha, ((1, 1), (0, 0)), constant_values=np.nan)
    bounds = np.isfinite(alpha)
    gap, column = np.nonzero(bounds[1:] != bounds[:-1])
    near = np.where(bounds[gap, column], alpha[gap, column], alpha[gap + 1, column])
    order = np.lexsort((near, gap))
    gap, columns, near = gap[order][::2], column[order].reshape(-1, 2), near[order].reshape(-1, 2).mean(1)
    ends = np.concatenate([[-np.inf], rows.beta, [np.inf]])
    low, high = ends[gap][:, None], ends[gap + 1][:, None]
    inside = (corners[:, 1] > low) & (corners[:, 1] < high) & (high - low <= corners[:, 2])
    walls, enclosed = np.stack([near, 0.5 * (ends[gap] + ends[gap + 1])], -1), np.asarray(inside.any(1))
    for k in np.flatnonzero(enclosed).tolist():
        candidates = corners[inside[k]]
        walls[k] = candidates[np.argmin(np.abs(candidates[:, 0] - near[k])), :2]
    return _Meetings(gap, columns, walls, enclosed)


@compact_repr()
class Outline(NamedTuple):
    """A closed outline of the stable set, a polygon whose corners are walls."""

    stiffness: np.ndarray
    virtual_damping: np.ndarray
    hole: bool  # the walls inside are unstable
    island: bool  # outline of a piece that is not connected to K = 0

    @property
    def area(self) -> float:
        """The area of the polygon."""
        x, y = self.stiffness, self.virtual_damping
        return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y)))
