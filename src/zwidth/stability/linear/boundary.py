"""Intersect lines of constant B with the stability boundary of any linear loop, and count the unstable poles of walls.

The boundary consists of the arcs and crossing lines of `stability.linear.curve`; a line of constant B crosses each of
them at most once (docs/theory/scenes.md, V12). As alpha increases along the line, a pole leaves the unit circle where
``Im(q' - beta F') > 0`` and enters it where this is negative (V11), with d/dw denoted by a prime. Here q = -1/G with
the response G of the device, F is the velocity estimate, and the poles z satisfy ``alpha + beta F(z) = q(z)``
(`stability.linear.roots`). A crossing line consists of the walls with a pole at an angle where F and q are real. Hence

    unstable poles(alpha, beta) = base + sum of +-2 (pairs) or +-1 (real poles) over the crossings below alpha

where ``base``, the number as alpha -> -inf, follows from the zeros of G, which poles approach (V13, V14). It is equal
for all walls, except in a lossless loop (`find_lossless`): there it differs below and above the lossless damping.

In the arrays of this module, a *row* belongs to a line of constant B, and a *column* to an arc or, after all arcs, to a
crossing line. ``leaving`` is the net number of poles that leave the circle as alpha increases past a crossing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from zwidth.model.circle_functions import are_on_circle, circle_points, distances_inside
from zwidth.stability.linear.curve import (
    Arc,
    CrossingLine,
    JoinedArcs,
    build_level_arc,
    cut_arcs,
    evaluate_curve,
    find_field_zeros,
    find_lines,
    find_lossless,
    list_circle_zeros,
    place_nodes,
)
from zwidth.stability.linear.roots import LoopRoots

# Largest number of steps of Newton's method for the angle w of a crossing.
MAX_STEPS = 120
CONVERGED_STEP = 1e-10  # relative to w; the error after it is of the order of its square

# Relative changes of the given beta, tried in this order if rounding errors make crossings of a line ambiguous (V15).
SHIFTS = (1e-15, -1e-15, 1e-13, -1e-13, 1e-11, -1e-11)
# Distance of an additional point of the curve from an end of an interval, at which the curve may be infinite, relative
# to the distance of the nearest node from this end.
PROBE_DISTANCE = 1e-6
# A pole leaves a zero of G along the circle if the radial part of its displacement is below this fraction (V14).
TANGENT_TOLERANCE = 1e-9
EQUAL_DAMPING = 1e-12  # dampings with a smaller relative difference are equal up to rounding errors
BLOCK_SIZE = 1 << 17  # pairs of lines and arcs per batch; its arrays fit in the cache


class Crossings(NamedTuple):
    """Crossings of lines of constant B with the boundary: shape (rows, columns), NaN without a crossing."""

    alpha: np.ndarray
    w: np.ndarray
    leaving: np.ndarray
    consistent: np.ndarray  # of each row: the crossings agree with the counts far below and far above (V15)


@dataclass(frozen=True)
class Boundary:
    """The stability boundary of one loop, cut into arcs and crossing lines."""

    loop: LoopRoots
    w: np.ndarray  # angles of the nodes
    arcs: tuple[Arc, ...]
    lines: tuple[CrossingLine, ...]
    asymptotes: np.ndarray  # angles at which the curve runs to infinity
    limits: dict[float, tuple[float, float]]  # angle -> limit of alpha and beta where Im q/Im F is 0/0; NaN if infinite
    lossless: float  # damping of a lossless loop (`find_lossless`); NaN for all other loops

    @classmethod
    def trace(cls, loop: LoopRoots) -> Boundary:
        """Compute the stability boundary of a loop: its nodes, arcs and crossing lines."""
        w = place_nodes(loop)
        curve = evaluate_curve(loop, w)
        # Find the angles with Im F = 0, where beta is infinite or 0/0. Im F may touch 0 at zeros on the circle.
        vertical = find_field_zeros(loop, w, curve.im_f, "im_f")
        touched = [p for p in list_circle_zeros(loop) if np.all(np.abs(vertical - p) > 1e-7)]
        vertical = np.union1d(vertical, touched)
        lines = find_lines(loop, vertical)
        asymptotes = np.array([p for p in vertical if all(p != line.w for line in lines)])
        extrema = find_field_zeros(loop, w, curve.wronskian, "wronskian")
        extrema = np.array([t for t in extrema if all(abs(t - line.w) > 1e-6 for line in lines)])
        lines += find_lines(loop, (0.0, np.pi))
        limits = dict.fromkeys([0.0, np.pi, *asymptotes.tolist()], (np.nan, np.nan))
        limits |= {line.w: (line.q - line.curve_beta * line.f, line.curve_beta) for line in lines}
        lossless = find_lossless(loop, w, curve, limits[0.0][1])
        arcs = (
            cut_arcs(loop, w, curve, extrema, limits) if np.isnan(lossless) else [build_level_arc(w, curve, lossless)]
        )
        return cls(loop, w, tuple(arcs), tuple(lines), asymptotes, limits, lossless)

    def are_lossless(self, beta: np.ndarray) -> np.ndarray:
        """Return a mask of the dampings at which the loop is lossless (`find_lossless`), so that no wall is stable."""
        with np.errstate(invalid="ignore"):
            return np.abs(beta - self.lossless) <= EQUAL_DAMPING * np.abs(self.lossless)

    def find_crossings(self, beta: np.ndarray) -> Crossings:
        """Return the crossings of lines of constant B with all arcs and crossing lines; ``beta`` has shape (rows,)."""
        beta, consistent = self.shift_ambiguous(beta)
        joined = self._joined
        column, row, k = joined.list_crossings(beta)
        w, alpha = self._solve_crossings(beta[row], column, k)
        shape = beta.size, len(self.arcs) + len(self.lines)
        out = Crossings(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape), consistent)
        out.alpha[row, column], out.w[row, column], out.leaving[row, column] = alpha, w, joined.leaving[column]
        for column, line in enumerate(self.lines, len(self.arcs)):
            out.alpha[:, column], out.w[:, column] = line.q - beta * line.f, line.w
            out.leaving[:, column] = line.count_leaving(beta)
        return out

    def find_alpha(self, column: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Return the alpha at which each line of constant B crosses its column, i.e. one arc or crossing line per line.

        Args:
            column: column of each line, shape (rows,).
            beta: damping of each line, shape (rows,).

        Returns:
            Array of shape (rows,); NaN if a line does not cross its column.
        """
        joined, alpha = self._joined, np.full(beta.shape, np.nan)
        for index, line in enumerate(self.lines, len(self.arcs)):
            alpha = np.where(column == index, line.q - beta * line.f, alpha)
        row = np.flatnonzero(column < len(self.arcs))
        low, high = joined.ends[:, column[row]]
        row = row[(beta[row] >= low) & (beta[row] < high)]
        k = joined.find_nodes(column[row], np.searchsorted(joined.dampings, beta[row]))
        alpha[row] = self._solve_crossings(beta[row], column[row], k)[1]
        return alpha

    @cached_property
    def ends(self) -> np.ndarray:
        """Alpha and beta (first axis) at both ends (second axis) of each arc; NaN in the columns of crossing lines."""
        w = np.array([arc.w[[0, -1]] for arc in self.arcs]).T
        alpha = evaluate_curve(self.loop, w.ravel()).alpha.reshape(w.shape)
        for angle, (limit, _) in self.limits.items():
            alpha[w == angle] = limit
        walls = np.stack([alpha, self._joined.ends])
        return np.pad(walls, ((0, 0), (0, 0), (0, len(self.lines))), constant_values=np.nan)

    def _solve_crossings(self, beta: np.ndarray, arc: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the crossings of lines of constant B with arcs by Newton's method within a bracket.

        Args:
            beta: damping of each line.
            arc: arc that it crosses.
            k: first node of the arc after the crossing, as an index of the joined arcs.

        Returns:
            Angle and alpha of each crossing.
        """
        # Solve ``ratio(w) = 0`` with ``ratio = Im(q - beta F)/common``. The sign of its derivative at the crossing
        # follows from ``leaving`` and from the ``signs`` of the factors of ``common``, because Im(q - beta F) increases
        # with w if a pole pair leaves the circle (V11). Converged crossings are removed from the iteration.
        joined, nodes = self._joined, self._node_values
        lower = np.where(joined.w[k - 1] < joined.w[k], k - 1, k)
        upper = 2 * k - 1 - lower
        below, above = joined.w[lower], joined.w[upper]
        middle = np.cos(0.5 * (below + above))
        signs = [np.sign(middle - np.cos(w)) for w in self._pair_angles]
        rising = joined.leaving[arc] * np.prod(signs, axis=0) > 0
        first, last = nodes.select(lower).evaluate_rows(beta), nodes.select(upper).evaluate_rows(beta)
        # If the line of constant B passes through a node, the node is the crossing; otherwise estimate the crossing.
        angle = np.where(
            last.ratio == 0, above, np.where(first.ratio == 0, below, _estimate_crossing(below, above, first, last))
        )
        alpha = np.where(last.ratio == 0, last.alpha, first.alpha)
        active = np.flatnonzero((first.ratio != 0) & (last.ratio != 0))
        x, before = angle[active], (above - below)[active]
        for _ in range(MAX_STEPS if active.size else 0):
            row = self._evaluate_loop(x).evaluate_rows(beta[active])
            ahead = (row.ratio < 0) == rising[active]
            below[active], above[active] = np.where(ahead, x, below[active]), np.where(ahead, above[active], x)
            with np.errstate(all="ignore"):
                move = -row.ratio / row.ratio_slope
            new = x + move
            # Bisect if the step leaves the bracket or is longer than half the previous step.
            good = (new >= below[active]) & (new <= above[active]) & (np.abs(move) <= 0.5 * before)
            # Accept a converged step even if rounding errors put it outside the bracket.
            good |= np.abs(new - x) <= CONVERGED_STEP * x
            new = np.where(good, np.clip(new, below[active], above[active]), 0.5 * (below[active] + above[active]))
            # The error after the last step is about the square of this step. Extrapolate alpha by the exact step,
            # because near an undamped mode the rounding error of the angle alone would change alpha too much.
            move = np.where(new == x + move, move, new - x)
            angle[active], alpha[active] = new, row.alpha + move * row.alpha_slope
            left = (np.abs(new - x) > CONVERGED_STEP * new) & (above[active] - below[active] > CONVERGED_STEP * new)
            if not left.any():
                break
            active, x, before = active[left], new[left], np.abs(new - x)[left]
        return angle, alpha

    def _evaluate_loop(self, w: np.ndarray) -> _LoopValues:
        """Return q, F and their derivatives at angles w; these values do not depend on the damping."""
        points, common, slope = circle_points(w), np.where(w >= np.pi, 0.0, np.sin(w)), np.cos(w)
        for angle in self._pair_angles:
            factor = -2.0 * np.sin(0.5 * (w + angle)) * np.sin(0.5 * (w - angle))
            common, slope = common * factor, slope * factor - common * np.sin(w)
        with np.errstate(all="ignore"):
            return _LoopValues(*self.loop.evaluate_controller(points), *self.loop.estimate.jet(points), common, slope)

    @cached_property
    def _node_values(self) -> _LoopValues:
        """q, F and their derivatives at the nodes of all arcs."""
        return self._evaluate_loop(self._joined.w)

    @cached_property
    def _joined(self) -> JoinedArcs:
        """The nodes of all arcs in one sequence."""
        return JoinedArcs.join(self.arcs)

    def find_arc(self, w: np.ndarray) -> np.ndarray:
        """Return the index of the arc that contains each angle."""
        return np.searchsorted(self._joined.lowest, w, side="right") - 1

    @cached_property
    def alpha_extrema(self) -> np.ndarray:
        """The angles at which alpha is extreme along the curve."""
        w = find_field_zeros(self.loop, self.w, evaluate_curve(self.loop, self.w).alpha_slope, "alpha_slope")
        return w[np.isfinite(evaluate_curve(self.loop, w).alpha)]

    @cached_property
    def alpha_nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Angles between which alpha is monotone along the curve, and alpha at these angles (NaN if infinite)."""
        nodes = np.union1d(self.w, self.alpha_extrema)
        pieces, values = [], []
        for a, b in pairwise(sorted(self.limits)):
            inner = nodes[(nodes > a) & (nodes < b)]
            inner = inner if inner.size else np.array([0.5 * (a + b)])
            # Add a point near each end of the interval to bracket intersections there, because the end may be infinite.
            probes = a + PROBE_DISTANCE * (inner[0] - a), b - PROBE_DISTANCE * (b - inner[-1])
            inner = np.concatenate([probes[:1], inner, probes[1:]])
            pieces.append(np.concatenate([[a], inner, [b]]))
            alpha = evaluate_curve(self.loop, inner).alpha
            values.append(np.concatenate([self.limits[a][:1], alpha, self.limits[b][:1]]))
        return np.concatenate(pieces), np.concatenate(values)

    @property
    def _pair_angles(self) -> list[float]:
        """Angles in (0, pi) of the crossing lines; ``Im(q - beta F)`` is 0 there for every beta."""
        return [line.w for line in self.lines if line.poles == 2]

    def shift_ambiguous(self, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shift the dampings of lines of constant B whose crossings are inconsistent (V15).

        A line within rounding errors of an extremum of beta may miss one of the two arcs that meet there. A line with a
        slightly different damping replaces it.

        Returns:
            The dampings, and for each line whether its crossings are consistent with the counts far below and above.
        """
        mismatch = self._count_mismatch(beta)
        shifted = beta.copy() if mismatch.any() else beta
        for shift in SHIFTS:
            row = np.flatnonzero(mismatch)
            if not row.size:
                break
            shifted[row] = beta[row] * (1.0 + shift)
            mismatch[row] = self._count_mismatch(shifted[row])
        return shifted, mismatch == 0

    def _count_mismatch(self, beta: np.ndarray) -> np.ndarray:
        """Return, for each line, the count below all crossings plus the sum of ``leaving`` minus the count above."""
        return self.count_below(beta) - self.count_above(beta) + self._sum_leaving(beta)

    def _sum_leaving(self, beta: np.ndarray, limit: float = np.inf) -> np.ndarray:
        """Sum min(``leaving``, ``limit``) over all crossings of each line of constant B; limit 0: entering poles."""
        joined = self._joined
        total = joined.sum_crossed(np.minimum(joined.leaving, limit), beta)
        return total + sum(np.minimum(line.count_leaving(beta), limit) for line in self.lines)

    def count_outside(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Return the number of poles outside the unit circle for each wall.

        Args:
            alpha: normalized stiffness, shape (walls,).
            beta: normalized damping, shape (walls,).

        Returns:
            Array of shape (walls,); -1 if the crossings of the line of constant B are inconsistent.
        """
        sums, consistent = self._sum_below(alpha, beta)
        return np.where(consistent, self.count_below(beta) + sums, -1)

    def _sum_below(
        self, alpha: np.ndarray, beta: np.ndarray, excluded: np.ndarray | int = -1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Sum ``leaving`` over the crossings below each wall, except the crossing in the column ``excluded``.

        Returns:
            The sums, and whether the crossings of each wall's line of constant B are consistent.
        """
        # Compare alpha of each wall with the interpolated alpha of the crossing. Solve for the exact crossing only if
        # they differ by less than the error bound of the interpolation, because few walls are so close.
        excluded = np.broadcast_to(excluded, beta.shape)
        beta, consistent = self.shift_ambiguous(beta)
        joined = self._joined
        column, row, k = joined.list_crossings(beta)
        counted = excluded[row] != column
        column, row, k = column[counted], row[counted], k[counted]
        with np.errstate(all="ignore"):
            share = (beta[row] - joined.beta[k - 1]) / (joined.beta[k] - joined.beta[k - 1])
            share = np.where(joined.straight[k], share, 0.5)
            distance = alpha[row] - (joined.alpha[k - 1] + share * (joined.alpha[k] - joined.alpha[k - 1]))
            passed, near = distance > joined.room[k], ~(np.abs(distance) > joined.room[k])
        if near.any():
            passed[near] = self._solve_crossings(beta[row[near]], column[near], k[near])[1] < alpha[row[near]]
        total = np.zeros(beta.shape)
        np.add.at(total, row[passed], joined.leaving[column[passed]])
        for column, line in enumerate(self.lines, len(self.arcs)):
            passed = (line.q - beta * line.f < alpha) & (excluded != column)
            total += np.where(passed, line.count_leaving(beta), 0.0)
        return total.astype(int), consistent

    def are_stable_edges(self, w: np.ndarray) -> np.ndarray:
        """Return a mask of the angles at which the curve bounds the stable set, i.e. one side is stable (V18)."""
        curve = evaluate_curve(self.loop, w)
        result = np.isfinite(curve.alpha) & np.isfinite(curve.beta)
        # Exclude most lines of constant B without stable walls before solving for crossings: with a long delay, fewer
        # poles enter the circle along most lines than are outside as alpha -> -inf.
        beta = self.shift_ambiguous(curve.beta[result])[0]
        result[result] = self.count_below(beta) + self._sum_leaving(beta, 0.0) <= 0
        arc, block = self.find_arc(w), max(1, BLOCK_SIZE // max(1, len(self.arcs)))
        for part in np.array_split(np.flatnonzero(result), 1 + result.sum() // block):
            sums, consistent = self._sum_below(curve.alpha[part], curve.beta[part], arc[part])
            # Use the value of ``leaving`` that holds for the whole arc, because rounding errors may change its sign at
            # a single angle.
            below = self.count_below(curve.beta[part])
            result[part] = consistent & (below + sums == np.where(self._joined.leaving[arc[part]] > 0, 0, 2))
        return result

    def count_below(self, beta: np.ndarray) -> np.ndarray | int:
        """Return, for each beta, the number of poles outside the circle if alpha is below all crossings (V14)."""
        return self._count_far(-1.0, beta)

    def count_above(self, beta: np.ndarray) -> np.ndarray | int:
        """Return, for each beta, the number of poles outside the circle if alpha is above all crossings (V14).

        The difference from `count_below` is the sum of ``leaving`` over the crossings of the line of constant B.
        """
        return self._count_far(1.0, beta)

    def _count_far(self, side: float, beta: np.ndarray) -> np.ndarray | int:
        """Return, for each beta, the number of poles outside the circle as alpha -> inf (side 1) or -inf (side -1)."""
        less, more = self._far_counts[side]
        # Compare beta with the lossless damping, because the number depends on beta only in a lossless loop.
        return less if less == more else np.where(beta > self.lossless, more, less)

    @cached_property
    def _far_counts(self) -> dict[float, tuple[int, int]]:
        """Counts of poles outside as alpha -> -inf (key -1) or inf (1), for beta below and above ``lossless``."""
        return {side: (self._far_outside(side, -1.0), self._far_outside(side, 1.0)) for side in (-1.0, 1.0)}

    def _far_outside(self, side: float, excess: float) -> int:
        """Return the number of poles outside the unit circle as |alpha| -> inf.

        As many poles as the device has zeros approach these zeros; the other poles go to infinity (z^lag: pole of G).

        Args:
            side: sign of alpha.
            excess: sign of beta minus the lossless damping; has no effect if the loop is not lossless.
        """
        loop = self.loop
        depth, on_circle = distances_inside(loop.zeros), are_on_circle(loop.zeros)
        leaving = 0
        for zero, order in zip(*np.unique(loop.zeros[on_circle], return_counts=True), strict=True):
            # Near a zero at w0 (stored as 1 - z), G = c x^order (1 + e x) with x = w - w0. Poles satisfy G = -1/alpha,
            # and |z| > 1 if and only if Im x < 0 (V14). The size of alpha only scales x; use alpha = +-1.
            points = circle_points(np.angle(1.0 - zero))
            rest = replace(loop, zeros=loop.zeros[loop.zeros != zero]).evaluate_response(points)
            power = -side / (rest.value * (1j * points.z) ** order)
            x = power ** (1.0 / order) * np.exp(2j * np.pi * np.arange(order) / order)
            if np.isfinite(self.lossless):
                # In a lossless loop, alpha moves the pole along the circle. Only a difference of beta from the lossless
                # damping moves it off the circle: x becomes x (1 - (beta - lossless) F/(order alpha)).
                leaving += int(np.sum(side * excess * loop.estimate.jet(points).value.imag * x.real > 0))
                continue
            # If x is real, the pole leaves the zero along the circle. The imaginary part of the next term of its
            # expansion, -e x^2/order, then decides whether the pole is outside.
            bend = -(rest.slope / rest.value + 0.5j * order) * x * x / order
            leaving += int(np.sum(np.where(np.abs(x.imag) > TANGENT_TOLERANCE * np.abs(x), x.imag, bend.imag) < 0))
        return loop.lag + loop.poles.size - loop.zeros.size + int(np.sum(depth[~on_circle] < 0)) + leaving


class _RowValues(NamedTuple):
    """Im(q - beta F), scaled, and alpha, at one angle per line of constant B; a crossing is a zero of ``ratio``."""

    ratio: np.ndarray  # Im(q - beta F)/common, with ``common`` of `_LoopValues`
    ratio_slope: np.ndarray  # its derivative in w
    alpha: np.ndarray  # Re(q - beta F)
    alpha_slope: np.ndarray  # its derivative in w


class _LoopValues(NamedTuple):
    """q, F and their derivatives at angles w, and the factor of ``Im(q - beta F)`` that all beta have in common."""

    q: np.ndarray
    q_slope: np.ndarray
    f: np.ndarray
    f_slope: np.ndarray
    common: np.ndarray  # sin w prod(cos w - cos w_k) over the angles w_k of `_pair_angles`
    common_slope: np.ndarray

    def select(self, index: np.ndarray) -> _LoopValues:
        """Return all values at the angles selected by an index or a mask."""
        return _LoopValues(*(part[index] for part in self))

    def evaluate_rows(self, beta: np.ndarray) -> _RowValues:
        """Return ``Im(q - beta F)/common``, alpha and their derivatives in w, for one damping beta per angle."""
        with np.errstate(all="ignore"):
            value, slope = self.q - beta * self.f, self.q_slope - beta * self.f_slope
            is_zero = self.common == 0
            divisor = np.where(is_zero, 1.0, self.common)
            ratio = np.where(is_zero, np.imag(slope) / self.common_slope, np.imag(value) / divisor)
            # The result is 0 where common is 0: the exact derivative at w = 0 and pi, where the ratio is even in the
            # distance from w; at other angles it only affects the starting value of Newton's method.
            ratio_slope = (np.imag(slope) - ratio * self.common_slope) / divisor
            return _RowValues(ratio, ratio_slope, np.real(value), np.real(slope))


@np.errstate(all="ignore")
def _estimate_crossing(below: np.ndarray, above: np.ndarray, first: _RowValues, last: _RowValues) -> np.ndarray:
    """Estimate the angle at which ``ratio`` is 0, from its values and derivatives at two angles.

    The estimate is the cubic interpolation of the inverse function or, if this leaves the interval, the root of a
    parabola.
    """
    rise, width = last.ratio - first.ratio, above - below
    share = -first.ratio / rise
    bends = rise * (1.0 - share) / first.ratio_slope, rise * share / last.ratio_slope
    cubic = below + share * (share * (3.0 - 2.0 * share) * width + (1.0 - share) * (bends[0] - bends[1]))
    # The cubic interpolation fails near an extremum of beta, where the derivative of ``ratio`` is 0. Use a parabola
    # with the values at both angles and the derivative at the angle where it is smaller in magnitude.
    flat = np.abs(first.ratio_slope) < np.abs(last.ratio_slope)
    start, slope = np.where(flat, first.ratio, last.ratio), np.where(flat, first.ratio_slope, -last.ratio_slope) * width
    rise = np.where(flat, rise, -rise)
    root = np.sqrt(np.maximum(slope * slope - 4.0 * (rise - slope) * start, 0.0))
    offset = -2.0 * start / (slope + np.where(rise < 0, -root, root))
    offset = np.clip(np.where(np.isfinite(offset), offset, 0.5), 1e-9, 1.0 - 1e-9) * width
    parabola = np.where(flat, below + offset, above - offset)
    return np.where((share > 0) & (share < 1) & (cubic > below) & (cubic < above), cubic, parabola)
