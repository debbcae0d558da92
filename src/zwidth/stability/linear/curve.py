"""Compute the walls that put poles on the unit circle in any linear loop: boundary curve and crossing lines.

On ``z = e^(jw)``, 0 < w < pi, a wall has a pole pair at z if and only if ``alpha + beta F = q``
(`stability.linear.roots`), that is (docs/theory/scenes.md, V8)

    beta = Im q/Im F        alpha = Re q - beta Re F

which is the *boundary curve* (alpha(w), beta(w)). A prime denotes d/dw. The curve is cut into *arcs* on which beta is
monotone, so a line of constant B crosses an arc at most once (V12). If F and q are both real at w, the equation is a
whole *crossing line* of walls: real poles at w = 0 and w = pi (V9), or pole pairs inside (V10), for example of
undamped devices. The *nodes* are the angles at which the curve is tabulated (V16).
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from zwidth.model.circle_functions import are_on_circle, circle_points
from zwidth.numerics.root_finding import find_zeros_between
from zwidth.stability.linear.roots import LoopRoots

# Settings for the placement of the nodes.
NODE_SPACING = 0.08  # relative change of q and F between neighboring nodes, estimated
MAX_ROUNDS = 60  # largest number of rounds in which intervals between nodes are halved
LAST_NODE = 1e-4  # pi - w of the last node, for a loop without delay and without roots near z = -1


class CurvePoints(NamedTuple):
    """Points of the boundary curve, one array entry per angle w."""

    alpha: np.ndarray
    beta: np.ndarray
    alpha_slope: np.ndarray  # d alpha/dw
    wronskian: np.ndarray  # Im q' Im F - Im q Im F'; has the sign of d beta/dw
    im_f: np.ndarray  # Im F
    size: np.ndarray  # |q| + |beta F|, the terms whose difference is alpha; scales its rounding error


def evaluate_curve(loop: LoopRoots, w: np.ndarray) -> CurvePoints:
    """Return the points of the boundary curve at angles w in (0, pi)."""
    points = circle_points(w)
    with np.errstate(all="ignore"):
        q, f = loop.evaluate_controller(points), loop.estimate.jet(points)
        beta = q.value.imag / f.value.imag
        alpha = q.value.real - beta * f.value.real
        wronskian = q.slope.imag * f.value.imag - q.value.imag * f.slope.imag
        beta_slope = wronskian / f.value.imag**2
        alpha_slope = q.slope.real - beta_slope * f.value.real - beta * f.slope.real
        size = np.abs(q.value) + np.abs(beta * f.value)
        return CurvePoints(alpha, beta, alpha_slope, wronskian, f.value.imag, size)


def place_nodes(loop: LoopRoots) -> np.ndarray:
    """Return the angles of the nodes in (0, pi), so dense that q and F change little between neighbors (V16)."""
    roots = np.concatenate([loop.poles, loop.zeros, loop.estimate.poles, loop.estimate.zeros])
    from_one, from_minus_one = np.abs(roots), np.abs(roots - 2.0)
    delay_angle = 1.0 / (loop.lag + loop.estimate.window + 1.0)
    first = 1e-3 * min([delay_angle, *from_one[from_one > 1e-13]])
    # Let x = pi - w, and let rho be the smallest distance of a root from z = -1. Near z = -1, imaginary parts have a
    # relative rounding error of eps/x, and beta changes in proportion to (x/rho)^2. Place the last node as close to pi
    # as the resulting error of d beta/dw allows.
    last = LAST_NODE * min([delay_angle, *from_minus_one[from_minus_one > 1e-13]]) ** (2.0 / 3.0)
    w = np.concatenate([np.geomspace(first, 0.1, 64), np.linspace(0.1, np.pi - last, 32)[1:]])
    nodes, low, high = [w], w[:-1], w[1:]
    for _ in range(MAX_ROUNDS):
        half = 0.5 * (high - low)
        # Estimate the change of q and F over each interval from two bounds on their derivatives: over the whole
        # interval (first row) and at its midpoint (second row). Accept a 16 times larger change by the first bound,
        # because this bound overestimates the change near roots.
        change = 2.0 * half * loop.bound_variation(low + half, half * np.array([[1.0], [0.0]]))
        wide = (change > NODE_SPACING * np.array([[16.0], [1.0]])).any(0)
        if not wide.any():
            break
        middle = (low + half)[wide]
        nodes.append(middle)
        low, high = np.concatenate([low[wide], middle]), np.concatenate([middle, high[wide]])
    return np.sort(np.concatenate(nodes))


def find_field_zeros(loop: LoopRoots, w: np.ndarray, values: np.ndarray, field: str) -> np.ndarray:
    """Return the angles at which one quantity of the curve is 0, found between neighboring nodes with different signs.

    Args:
        loop: the loop without a wall.
        w: angles of the nodes.
        values: the field at the nodes.
        field: its name.
    """
    k = np.flatnonzero((values[:-1] > 0) != (values[1:] > 0))
    return find_zeros_between(lambda angles: getattr(evaluate_curve(loop, angles), field), w, values, k)


# Tolerances for crossing lines.
REAL_TOLERANCE = 1e-11  # |Im q| of a real q, relative to |q|; smaller values are rounding errors
MIN_ESTIMATE_SLOPE = 1e-12  # |Im F'| up to which the boundary curve does not meet a crossing line


class CrossingLine(NamedTuple):
    """The walls with ``alpha + beta F = q`` and poles on the unit circle at an angle w where F and q are real."""

    w: float
    q: float
    f: float
    im_q_slope: float  # Im q'
    im_f_slope: float  # Im F'
    poles: int  # number of poles on the circle: 1 at z = 1 and z = -1, else 2

    @property
    def curve_beta(self) -> float:
        """The damping ``Im q'/Im F'`` at which the boundary curve meets the line; NaN if they do not meet."""
        return self.im_q_slope / self.im_f_slope if abs(self.im_f_slope) > MIN_ESTIMATE_SLOPE else np.nan

    def count_leaving(self, beta: np.ndarray) -> np.ndarray:
        """Return the net number of poles that leave the unit circle as alpha increases past the line (V11).

        A line of constant B through `curve_beta` is treated as if its beta were slightly larger.
        """
        if np.isnan(self.curve_beta):
            return np.full(beta.shape, self.poles * np.sign(self.im_q_slope))
        return self.poles * np.sign(self.im_f_slope) * np.where(beta < self.curve_beta, 1.0, -1.0)


def find_lines(loop: LoopRoots, angles: ArrayLike) -> list[CrossingLine]:
    """Return the crossing lines at the given angles; none for an angle at which q is not real.

    Args:
        loop: the loop without a wall.
        angles: zeros of Im F, including 0 and pi.
    """
    # Skip angles at which q or F is infinite, for example at a zero of G, because no wall solves the equation there.
    w = np.array(angles, float)
    points, is_end = circle_points(w), (w == 0.0) | (w == np.pi)
    with np.errstate(all="ignore"):
        q, f = loop.evaluate_controller(points), loop.estimate.jet(points)
        real = is_end | (np.abs(q.value.imag) <= REAL_TOLERANCE * np.abs(q.value))
    values = np.stack([w, q.value.real, f.value.real, q.slope.imag, f.slope.imag], -1)
    # Treat a zero of G as located at e^(jw) if its distance from this point is at most ``reach``, because zeros have
    # rounding errors. ``reach`` is smallest at z = 1, because the offsets of zeros near z = 1 have small errors.
    reach = np.where(w == 0.0, 1e-15, np.where(is_end, 1e-12, 1e-9))
    near = np.abs(points.z_minus_1[:, None] + loop.zeros) <= reach[:, None]
    selected = np.flatnonzero(real & ~near.any(1) & np.isfinite(values).all(1))
    return [CrossingLine(*values[k].tolist(), poles=1 if is_end[k] else 2) for k in selected]


def list_circle_zeros(loop: LoopRoots) -> np.ndarray:
    """Return the angles of zeros of G (where q is infinite) and of F (where Im F may touch 0) on the unit circle."""
    zeros = np.concatenate([loop.zeros, loop.estimate.zeros])
    angles = np.angle(1.0 - zeros[are_on_circle(zeros)])
    return np.unique(angles[(angles > 0) & (angles < np.pi - 1e-6)])


# Parts of the error bound of alpha between two nodes, relative to `CurvePoints.size`. If linear interpolation is not
# accurate, the bound is COARSE_TOLERANCE plus 1.5 times the difference of alpha between the nodes.
COARSE_TOLERANCE = 0.02
ROUNDING_TOLERANCE = 1e-6  # bound on the rounding errors


class Arc(NamedTuple):
    """A part of the boundary curve on which beta is monotone, tabulated at nodes in ascending order of beta."""

    w: np.ndarray
    beta: np.ndarray
    alpha: np.ndarray
    alpha_slope: np.ndarray  # d alpha/dw
    beta_slope: np.ndarray  # d beta/dw
    size: np.ndarray  # as in `CurvePoints`
    leaving: float  # net number of poles that leave the unit circle as alpha increases past the arc: 2 or -2

    @property
    def first(self) -> float:
        """The lowest angle of the arc."""
        return float(min(self.w[0], self.w[-1]))


def cut_arcs(
    loop: LoopRoots, w: np.ndarray, curve: CurvePoints, extrema: np.ndarray, limits: dict[float, tuple[float, float]]
) -> list[Arc]:
    """Cut the curve into arcs at extrema of beta, at angles where the curve is infinite, and where Im F changes sign.

    Args:
        loop: the loop without a wall.
        w: angles of the nodes.
        curve: the curve at the nodes.
        extrema: angles at which beta is extreme along the curve.
        limits: alpha and beta at angles where the formulas of the curve are undefined; NaN if it runs to infinity.

    Returns:
        The arcs in ascending angle. An arc starts and ends with its two limits; there alpha is NaN.
    """
    ends = np.unique(np.concatenate([list(limits), extrema]))
    betas = dict(zip(extrema.tolist(), evaluate_curve(loop, extrema).beta.tolist(), strict=True))
    betas |= {end: beta for end, (_, beta) in limits.items()}
    arcs, starts, stops = [], np.searchsorted(w, ends, "right").tolist(), np.searchsorted(w, ends, "left").tolist()
    for (a, b), start, stop in zip(pairwise(ends.tolist()), starts[:-1], stops[1:], strict=True):
        nodes, inner = w[start:stop], CurvePoints(*(values[start:stop] for values in curve))
        if not nodes.size:
            nodes = np.array([0.5 * (a + b)])
            inner = evaluate_curve(loop, nodes)
        rising = np.sum(np.sign(inner.wronskian)) > 0
        # As alpha increases past the arc at constant beta, a pole pair leaves the unit circle if (d beta/dw) Im F > 0,
        # and enters it if this product is negative (V11, V12). Take the sign that each factor has at the majority of
        # the nodes, because rounding errors may change the sign at single nodes near the ends of the arc.
        leaving = 2.0 if rising == (np.sum(np.sign(inner.im_f)) > 0) else -2.0
        first, last = (
            betas[end] if np.isfinite(betas[end]) else side * np.inf
            for end, side in ((a, -1.0 if rising else 1.0), (b, 1.0 if rising else -1.0))
        )
        # Add both ends of the arc to its nodes, with alpha = NaN. Near an end, a wall is then compared with the exact
        # crossing instead of an interpolated one.
        with np.errstate(all="ignore"):
            slope = inner.wronskian / inner.im_f**2
        parts = [nodes, inner.beta, inner.alpha, inner.alpha_slope, slope, inner.size]
        edges = [(a, b), (first, last), *[(np.nan, np.nan)] * 4]
        parts = [np.concatenate([[end[0]], part, [end[1]]]) for part, end in zip(parts, edges, strict=True)]
        if not rising:
            parts = [part[::-1] for part in parts]
        # Drop nodes near the ends of the arc at which rounding errors break the monotone order of beta.
        beta = parts[1]
        ordered = np.maximum.accumulate(beta) == beta
        ordered &= np.minimum.accumulate(beta[::-1])[::-1] == beta
        ordered[[0, -1]] = True
        if beta[0] <= beta[-1]:
            parts = [part[ordered] for part in parts]
            arcs.append(Arc(*parts, leaving))
    return arcs


# Tolerances of the test for a lossless loop.
LOSSLESS_ERROR = 1e-12  # of Im(q - beta F), relative to its terms and their conditioning; smaller values are 0
LOSSLESS_ANGLE = 1e-2  # rad; at smaller angles, rounding errors of poles at z = 1 dominate Im(q - beta F)


def find_lossless(loop: LoopRoots, w: np.ndarray, curve: CurvePoints, damping: float) -> float:
    """Return the damping beta at which the loop is lossless; NaN if no such damping exists.

    A loop is lossless if ``q - beta F`` is real on the whole unit circle. Then the reciprocal of every pole is also a
    pole, so no wall with this damping is stable. Example: an undamped joint in semi-implicit Euler, at beta = 0.

    Args:
        loop: the loop without its wall.
        w: angles of the nodes of the curve.
        curve: points of the curve at the nodes.
        damping: beta of the curve at z = 1. The only candidates are this value and 0.
    """
    tested = w >= LOSSLESS_ANGLE
    z_minus_1, curve = circle_points(w[tested]).z_minus_1[:, None], CurvePoints(*(values[tested] for values in curve))
    roots = np.concatenate([loop.poles, loop.zeros, loop.estimate.poles, loop.estimate.zeros])
    with np.errstate(all="ignore"):
        # Multiply the tolerance by the condition number, because near a root of q or F the relative rounding error
        # grows like 1/distance.
        condition = 1.0 + (np.abs(roots) / np.abs(z_minus_1 + roots)).sum(1)
        for beta in (0.0, damping):
            residual = np.abs((curve.beta - beta) * curve.im_f) / (curve.size * condition)
            if np.all(np.nan_to_num(residual, nan=0.0) <= LOSSLESS_ERROR):
                return beta
    return np.nan


def build_level_arc(w: np.ndarray, curve: CurvePoints, beta: float) -> Arc:
    """Return the curve of a loop that is lossless at ``beta`` as one arc of constant damping, which no line crosses."""
    blank, level = np.full(w.size + 2, np.nan), np.full(w.size + 2, beta)
    alpha = np.concatenate([[np.nan], curve.alpha, [np.nan]])
    return Arc(np.concatenate([[0.0], w, [np.pi]]), level, alpha, blank, blank, blank, 2.0)


def bound_interpolation(
    w: np.ndarray, alpha: np.ndarray, alpha_slope: np.ndarray, beta_slope: np.ndarray, size: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask of the steps between nodes over which alpha is nearly linear in beta, and bounds on its error.

    A step is the interval between two neighboring nodes. Where the mask is False, alpha is approximated by the mean of
    both ends, with the returned bound on the error.

    Args:
        w: angles of the nodes of all arcs, joined, shape (nodes,).
        alpha: alpha at the nodes; NaN at the ends of the arcs.
        alpha_slope: d alpha/dw.
        beta_slope: d beta/dw.
        size: as in `CurvePoints`.

    Returns:
        Two arrays of shape (nodes,); an entry describes the step from the previous node.
    """
    # Interpolate alpha linearly in beta if d beta/dw changes by less than a factor of 2 over the step from node to
    # node. If alpha(w) and beta(w) are quadratic, the error is at most the sum of two terms: step/8 times the change of
    # d alpha/dw, because alpha(w) is curved, and |ratio - 1|/6 times the change of alpha, because beta(w) is curved.
    # The returned bound is at least four times this sum. If alpha is not interpolated, the bound exceeds the difference
    # of alpha between both nodes.
    with np.errstate(all="ignore"):
        ratio = beta_slope / np.roll(beta_slope, 1)
        straight = (ratio > 0.5) & (ratio < 2.0)
        step, rise, change = (np.abs(np.diff(part, prepend=part[0])) for part in (w, alpha, alpha_slope))
        largest = np.maximum(size, np.roll(size, 1))
        fine = 0.5 * step * change + np.abs(ratio - 1.0) * rise + ROUNDING_TOLERANCE * largest
        return straight, np.where(straight, fine, 1.5 * rise + COARSE_TOLERANCE * largest)


class JoinedArcs(NamedTuple):
    """The nodes of all arcs, joined into one sequence; a *step* is the interval from one node to the next."""

    w: np.ndarray
    beta: np.ndarray
    alpha: np.ndarray
    straight: np.ndarray  # of each step: alpha may be interpolated linearly in beta; else use the mean of both ends
    room: np.ndarray  # of each step: bound on the error of this alpha
    keys: np.ndarray  # of each node: index of its arc times the number of dampings, plus index of its damping
    dampings: np.ndarray  # of all nodes, sorted
    first: np.ndarray  # of each arc: its first node
    ends: np.ndarray  # (2, arcs): smallest and largest damping
    order: np.ndarray  # order of the flattened ends
    sorted_ends: np.ndarray
    leaving: np.ndarray  # of each arc: net number of poles that leave the circle as alpha increases
    lowest: np.ndarray  # of each arc: its lowest angle

    @classmethod
    def join(cls, arcs: tuple[Arc, ...]) -> JoinedArcs:
        """Return the nodes of all arcs of a boundary in one sequence, with the tables for searches in them."""
        w, beta, *others = map(np.concatenate, zip(*(arc[:6] for arc in arcs), strict=True))
        sizes = [arc.w.size for arc in arcs]
        dampings, keys = np.unique(beta, return_inverse=True)
        keys = keys + np.repeat(np.arange(len(arcs)), sizes) * dampings.size
        ends = np.array([arc.beta[[0, -1]] for arc in arcs]).T
        order = np.argsort(ends, axis=None)
        ends, first = (ends, order, ends.ravel()[order]), np.cumsum([0, *sizes[:-1]])
        by_arc = np.array([(arc.leaving, arc.first) for arc in arcs]).T
        return cls(w, beta, others[0], *bound_interpolation(w, *others), keys, dampings, first, *ends, *by_arc)

    def sum_crossed(self, weights: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Return, for each line of constant B, the sum of the weights of the arcs that it crosses.

        A line through an end of an arc is treated as if its beta were slightly larger.
        """
        sums = np.cumsum(np.concatenate([[0.0], np.concatenate([weights, -weights])[self.order]]))
        return sums[np.searchsorted(self.sorted_ends, beta, side="right")]

    def list_crossings(self, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the crossings of arcs by lines of constant B, each as indices of arc, line and next node."""
        arc, row = np.nonzero((beta >= self.ends[0][:, None]) & (beta < self.ends[1][:, None]))
        return arc, row, self.find_nodes(arc, np.searchsorted(self.dampings, beta)[row])

    def find_nodes(self, arc: np.ndarray, rank: np.ndarray) -> np.ndarray:
        """Return the first node of each arc after its crossing; ``rank`` is the index of the line in ``dampings``."""
        return np.maximum(np.searchsorted(self.keys, arc * self.dampings.size + rank), self.first[arc] + 1)
