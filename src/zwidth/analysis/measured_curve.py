"""Stability of walls on a measured frequency response with error bounds, by a robust Nyquist test.

A device is given by its response G at measured frequencies, the *lines*, with a bound of the error at each line. The
wall is H = alpha + beta F with the velocity estimate F; the angle w = omega T is the frequency times the period. The
closed loop is stable if 1 + H G does not wind around 0 (docs/theory/measured.md, M1). With

    u = |z - 1|^2      S = u G      X = u (1 + H G) = u + alpha S + beta F S

X has the same winding number (M2). S is nearly constant while the device moves like a mass, so `ResponseCurve`
interpolates S between the lines, and bounds its distance rho from the true S: by the error of the lines (``band``, M3)
and by resonances that may hide between them (``gap``, M5 and M6). It also bounds |G| below the first and above the last
line (M7, M8).

A wall is *decided* if X stays away from 0 for every response within these bounds. With H at a point of the curve and
the chords from the point before and to the point after it, this holds (M4) if at each point

    |X|^2 > rho^2 |H|^2 + (|chord before|^2 + |chord after|^2)/4

which is a quadratic inequality in alpha and beta. At a fixed alpha or beta, the undecided walls are therefore a union
of intervals in closed form (M9). All walls between two of these intervals have the same winding
number, which `DecidedWalls` computes for the wall in the middle. Quantities are in units of the period and of the mass
of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.circle_functions import circle_points
from zwidth.model.estimate import Estimate
from zwidth.stability.linear.rows import arrange_by_line, collect_by_line

# Constants of the interpolation between adjacent lines (docs/theory/measured.md, M5 and M6).
LEAST_DAMPING_RATIO = 0.005  # smallest damping ratio zeta of a resonance between two lines (assumption A1)
# Factor in the bound of a resonance between two lines: if its frequency f is in the middle of the interval of length d,
# and it changes the second difference of S by D, the height of its peak in S is D d/(16/3 zeta f).
RESONANCE_FACTOR = 16.0 / 3.0
SMOOTH_FACTOR = 0.25  # ratio of the error of a chord of a smooth curve to its second difference: 1/8, doubled
MAX_TURN = 0.5  # rad; change of phase between two lines above which the bound covers all values of S between them
MAX_STEP = 0.005  # largest relative change of S, or of w^2, between two interpolated points
MAX_POINTS = 32  # largest number of interpolated points between two lines

# Constants of the bounds of |G| below the first and above the last line (docs/theory/measured.md, M7 and M8).
PHASE_TOLERANCE = 0.8  # rad; largest deviation of the first line's phase from that of a mass, damper or spring
N_FIRST = 4  # smallest number of lines from which the low-frequency asymptote is identified
EXTRAPOLATION_FACTOR = 2.0  # ratio of the bound of |G| above the last line to the root mean square of |G| below it
LAST_SHARE = 0.8  # lines above this fraction of the highest frequency are called the last lines
# Largest increase of |S| over the last lines, as a factor. If |S| increases more, a resonance may follow above the last
# line, so that |G| has no bound there.
MAX_RISE = 1.2
N_EXTRAPOLATED = 65  # angles below the first and above the last line at which |F| is bounded


@dataclass(frozen=True)
class ResponseCurve:
    """Measured response, interpolated at points dense enough for linear interpolation, with bounds of its error."""

    w: np.ndarray  # angles
    u: np.ndarray  # |z - 1|^2
    S: np.ndarray  # u G
    F: np.ndarray  # velocity estimate
    band: np.ndarray  # bound of the error of S due to the error of the lines
    gap: np.ndarray  # bound of the error of S due to the interpolation between the lines
    min_G: float  # lower bound of |G| at and below the first line
    max_G: float  # upper bound of |G| above the last line
    max_F_below: float  # upper bound of |F| below the first line
    max_F_above: float  # upper bound of |F| above the last line
    no_asymptote: bool  # True if the first line does not belong to a mass, a damper or a spring

    @property
    def radius(self) -> np.ndarray:
        """Bound rho of the distance of the true S from the curve."""
        return self.band + self.gap

    def evaluate(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate S and F linearly at the angles w; NaN outside the measured range."""

        def interpolate(values: np.ndarray) -> np.ndarray:
            """Interpolate real values, given at the points of the curve, at the angles w."""
            return np.interp(w, self.w, values, np.nan, np.nan)

        parts = (self.S, self.F)
        S, F = (interpolate(np.real(part)) + 1j * interpolate(np.imag(part)) for part in parts)
        return S, F

    @classmethod
    def interpolate(cls, device: Any, period: float, stiffness: float, estimate: Estimate) -> ResponseCurve:
        """Build the curve from the response of a `MeasuredDevice`, by cubic interpolation between its lines.

        Args:
            device: frequencies in Hz, response in m/N, and its deviation, the bound of the error (None for 0).
            period: sampling period in s.
            stiffness: unit of alpha in N/m, which makes the response dimensionless.
            estimate: the velocity estimate.
        """
        w = 2.0 * np.pi * device.frequency * period
        if w[-1] >= np.pi:
            raise InputError(
                f"frequency: got {device.frequency[-1]:g} Hz at a period of {period:g} s; it must be below the "
                f"Nyquist frequency, {0.5 / period:g} Hz: remove the higher frequencies, or correct the period"
            )
        G = device.response * stiffness
        r = np.zeros(w.size) if device.deviation is None else device.deviation * stiffness
        u = _compute_u(w)
        S, R = u * G, u * r
        E = _bound_gaps(w, S)
        # Compute the relative change of S between adjacent lines, reduced by the change that the errors of the lines
        # may cause.
        change = np.maximum(np.abs(np.diff(S)) - 2.0 * (R[1:] + R[:-1]), 0.0)
        change = change / (np.maximum(np.abs(S[1:]), np.abs(S[:-1])) + 1e-300)
        count = np.maximum(2.0 * np.diff(w) / w[1:], change) / MAX_STEP
        count = np.clip(np.ceil(count), 1, MAX_POINTS).astype(int)
        line = np.repeat(np.arange(w.size - 1), count)
        share = (np.arange(line.size) - np.repeat(np.cumsum(count) - count, count)) / count[line]
        step = np.diff(w)[line]
        angles = np.append(w[line] + share * step, w[-1])
        slope = np.gradient(S, w)
        # Interpolate S between two lines by a cubic Hermite polynomial, whose derivatives at the lines are finite
        # differences.
        t = share
        inner = (1 + 2 * t) * (1 - t) ** 2 * S[line] + t * (1 - t) ** 2 * step * slope[line]
        inner += t * t * (3 - 2 * t) * S[line + 1] + t * t * (t - 1) * step * slope[line + 1]
        F = estimate.jet(circle_points(angles)).value
        band, gap = np.append(np.maximum(R[:-1], R[1:])[line], R[-1]), np.append(E[line], E[-1])
        starts = np.flatnonzero(share == 0)[1:]
        # At each line, use the larger of the bounds in the two adjacent intervals, because the line is an end of both.
        for values in (band, gap):
            values[starts] = np.maximum(values[starts], values[starts - 1])
        below, above = np.linspace(0.0, w[0], N_EXTRAPOLATED), np.linspace(w[-1], np.pi, N_EXTRAPOLATED)
        max_below, max_above = (float(np.abs(estimate.jet(circle_points(part)).value).max()) for part in (below, above))
        return cls(
            angles, _compute_u(angles), np.append(inner, S[-1]), F, band, gap,
            float(abs(G[0]) - r[0]), _bound_above(w, np.abs(G), r), max_below, max_above,
            _lacks_asymptote(w, G, r),
        )  # fmt: skip


def _compute_u(w: np.ndarray) -> np.ndarray:
    """Return ``u = |z - 1|^2`` at the points ``z = exp(j w)`` of the unit circle."""
    return 4.0 * np.sin(0.5 * w) ** 2


def _lacks_asymptote(w: np.ndarray, G: np.ndarray, r: np.ndarray) -> bool:
    """Return whether the response at the first line differs from that of a mass, a damper or a spring.

    Theory assumes such a low-frequency asymptote (A2). If |G| is proportional to w^p near the first line, the phase of
    G must be p pi/2, with p between -2 and 0. The derivative of the phase detects a long delay, which may change the
    phase itself by a multiple of 2 pi.

    Args:
        w: angles of the lines.
        G: response.
        r: bound of the error of the response.
    """
    few = min(w.size, max(N_FIRST, int(np.sum(w <= 1.5 * w[0]))))
    if r[0] >= abs(G[0]) or not np.all(G[:few]):
        return True
    power = np.polyfit(np.log(w[:few]), np.log(np.abs(G[:few])), 1)[0]
    phase, uncertain = np.angle(1j * G[0]) - 0.5 * np.pi, np.arcsin(np.minimum(r[:few] / np.abs(G[:few]), 1.0))
    deviation = abs(phase - 0.5 * np.pi * np.clip(power, -2.0, 0.0)) + uncertain[0]
    # Estimate the phase of a delay at the first line from the least-squares derivative of the unwrapped phase over the
    # first lines.
    weights = w[:few] - np.mean(w[:few])
    weights *= w[0] / np.sum(weights**2)
    delay_phase = abs(weights @ np.unwrap(np.angle(G[:few]))) + np.abs(weights) @ uncertain
    return bool(max(deviation, delay_phase) > PHASE_TOLERANCE)


def _bound_above(w: np.ndarray, size: np.ndarray, r: np.ndarray) -> float:
    """Return an upper bound of |G| above the last line; infinity if |S| increases toward a resonance above it.

    The bound is assumption A3. It is computed from root mean squares of |G|, because noise can only increase them.

    Args:
        w: angles of the lines.
        size: |G|.
        r: bound of the error of G.
    """
    last = np.flatnonzero(w >= LAST_SHARE * w[-1])
    u, few = _compute_u(w), max(1, last.size // 4)
    first, final = (float(np.median((u * size)[part])) for part in (last[:few], last[-few:]))
    error = float(np.median((u * r)[last]))
    if final - error > MAX_RISE * (first + error):
        return np.inf
    halves = (part for part in np.array_split(last, 2) if part.size)
    return EXTRAPOLATION_FACTOR * max(float(np.sqrt(np.mean(size[part] ** 2))) for part in halves)


def _bound_gaps(w: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return bounds of the interpolation error of S, one per interval between adjacent lines; shape (lines - 1,)."""
    step, chord = np.diff(w), np.diff(S)
    # Compute the second difference of S for each interval: the larger one of the second derivatives at its two ends,
    # times the squared length of the interval.
    curvature = np.abs(2.0 * np.diff(chord / step) / (step[1:] + step[:-1]))
    difference = np.maximum(np.append(curvature[:1], curvature), np.append(curvature, curvature[-1:])) * step**2
    relative_step = 2.0 * step / (w[1:] + w[:-1])
    gap = difference * np.maximum(SMOOTH_FACTOR, relative_step / (RESONANCE_FACTOR * LEAST_DAMPING_RATIO))
    with np.errstate(all="ignore"):
        turn = np.abs(np.angle(S[1:] / S[:-1]))
    return np.where(turn > MAX_TURN, np.maximum(gap, np.abs(chord)), gap)


RADIUS_FACTOR = 1.02  # factor on rho^2 |H|^2, which covers the change of rho |H| between two points of the curve
MIN_WIDTH = 1e-9  # decided intervals shorter than this, relative to their upper end, are dropped as rounding errors
TINY = 1e-300  # value that replaces zero denominators, to avoid division by 0
BATCH_SIZE = 1 << 15  # fixed values of alpha or beta per batch, times points of the curve; limits the memory


class DecidedIntervals(NamedTuple):
    """Decided intervals of alpha for each of several fixed beta, or of beta for fixed alpha, in ascending order.

    The arrays have the shape (fixed values, intervals), with NaN if a fixed value has fewer intervals.
    """

    low: np.ndarray
    high: np.ndarray
    stable: np.ndarray  # True if the walls of the interval are stable, False if they are unstable


@dataclass(frozen=True)
class DecidedWalls:
    """Decision of the stability of walls, by intervals of alpha or beta, from a measured response."""

    curve: ResponseCurve

    @cached_property
    def _forms(self) -> np.ndarray:
        """Matrices of quadratic forms in (1, alpha, beta) that are positive for decided walls; shape (3, 3, points).

        The quadratic form of a point is positive for the walls that satisfy the inequality of M4 at this point.
        """
        c = self.curve
        X = np.stack([c.u + 0j, c.S, c.F * c.S])
        H = np.stack([0 * c.F, 1 + 0 * c.F, c.F])
        step = _gram(np.diff(X, axis=1))
        steps = np.pad(step, ((0, 0), (0, 0), (1, 0))) + np.pad(step, ((0, 0), (0, 0), (0, 1)))
        return _gram(X) - RADIUS_FACTOR * c.radius**2 * _gram(H) - 0.25 * steps

    def decide_alpha(self, beta: np.ndarray) -> DecidedIntervals:
        """Return the intervals of alpha in which walls are decided, for each given beta."""
        return self._find_intervals(1, beta, *self.bound_alpha(beta))

    def decide_beta(self, alpha: np.ndarray) -> DecidedIntervals:
        """Return the intervals of beta in which walls are decided, for each given alpha."""
        c = self.curve
        most = np.minimum((alpha - 1.0 / max(c.min_G, TINY)) / c.max_F_below, (1.0 / c.max_G - alpha) / c.max_F_above)
        return self._find_intervals(2, alpha, -most, most)

    def bound_alpha(self, beta: Any) -> tuple[Any, Any]:
        """Return the limits of alpha between which the bounds of |G| outside the measured range allow a decision.

        Below the first line |H G| > 1 is required (M7), above the last line |H G| < 1 (M8). If the lower limit exceeds
        the upper one, no wall with this beta is decided.
        """
        c = self.curve
        return np.abs(beta) * c.max_F_below + 1.0 / max(c.min_G, TINY), 1.0 / c.max_G - np.abs(beta) * c.max_F_above

    def _find_intervals(self, free: int, fixed: np.ndarray, least: np.ndarray, most: np.ndarray) -> DecidedIntervals:
        """Return the decided intervals of alpha at several fixed beta, or of beta at fixed alpha, computed in batches.

        Args:
            free: index of the free variable: 1 for alpha, 2 for beta.
            fixed: fixed values of the other variable.
            least: lower limit of the free variable at each fixed value, from the bounds outside the measured range.
            most: upper limit of the free variable at each fixed value.
        """
        batch = max(1, BATCH_SIZE // self.curve.w.size)
        low, high, stable = collect_by_line(partial(self._list_intervals, free), batch, fixed, least, most)
        return DecidedIntervals(low, high, stable == 1)

    def _list_intervals(
        self, free: int, fixed: np.ndarray, least: np.ndarray, most: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Return the decided intervals of one variable, alpha or beta, for one batch of fixed values of the other.

        Returns:
            Index of the fixed value of each interval, its lower and upper end, and the stability of its walls.
        """
        # At a fixed value of one variable, the quadratic form of a point is a x^2 + 2 half x + c in the free variable
        # x.
        M, other, across = self._forms, 3 - free, fixed[:, None]
        a = M[free, free]
        half = M[0, free] + across * M[free, other]
        c = M[0, 0] + 2.0 * across * M[0, other] + across * across * M[other, other]
        discriminant = half * half - a * c
        # If a > 0, the walls between the two roots of the quadratic form are undecided; if a <= 0, the walls outside of
        # them.
        has_roots, outer = discriminant >= 0, a <= 0
        # A fixed value is unusable if one point of the curve, or the bounds outside the measured range, leave all its
        # walls undecided.
        usable = (least < most) & ~np.any(outer & (discriminant <= 0), 1) & (not self.curve.no_asymptote)
        line, point = np.nonzero(has_roots & usable[:, None])
        half, c, a = half[line, point], c[line, point], a[point]
        with np.errstate(all="ignore"):
            # Compute the root of larger magnitude from a sum without cancellation, and the other root from the product
            # c/a of both roots.
            larger = -(half + np.where(half < 0, -1.0, 1.0) * np.sqrt(discriminant[line, point]))
            ends = larger / np.where(a == 0, TINY, a), c / larger
        invalid = np.isnan(ends[0] + ends[1])
        low, high = np.where(invalid, -np.inf, np.minimum(*ends)), np.where(invalid, np.inf, np.maximum(*ends))
        outer = outer[point]
        np.maximum.at(least := least.copy(), line[outer], low[outer])
        np.minimum.at(most := most.copy(), line[outer], high[outer])
        order = np.lexsort((low[~outer], line[~outer]))
        undecided = arrange_by_line(fixed.size, line[~outer][order], np.stack([low, high], -1)[~outer][order])
        low, high = np.moveaxis(undecided, -1, 0)
        # The decided intervals are the gaps between the undecided intervals, which are sorted by their lower ends.
        gap_low = np.fmax.accumulate(np.column_stack([least, high]), 1)
        low = np.minimum(np.where(np.isnan(low), -np.inf, low), most[:, None])
        gap_high = np.column_stack([low, most])
        line, gap = np.nonzero((gap_high > gap_low + MIN_WIDTH * np.abs(gap_high)) & usable[:, None])
        low, high = gap_low[line, gap], gap_high[line, gap]
        # Compute the winding number of each interval for its middle wall, because all walls of the interval have the
        # same one.
        walls = (0.5 * (low + high), fixed[line])[:: 1 if free == 1 else -1]
        return line, low, high, self._count_windings(*walls) == 0

    def _count_windings(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """Return the winding number of X around 0 for each of several decided walls; a wall is stable if it is 0.

        The winding number is the argument of X at z = -1 divided by 2 pi, continued along the curve from its asymptote
        at z = 1 (M1).
        """
        c = self.curve
        X = c.u + (alpha[:, None] + beta[:, None] * c.F) * c.S
        # Below the first line the open loop L = H G has |L| > 1. Therefore compute arg(1 + L) as arg L + arg(1 + 1/L),
        # with arg L continued from the phase of a mass, a damper or a spring, which lies between -pi and 0.
        L = X[:, 0] / c.u[0] - 1.0
        first = np.angle(1j * L) - 0.5 * np.pi + np.angle(1.0 + 1.0 / L)
        # Count the crossings of the negative real axis by X with their sign. Each step crosses the axis at most once,
        # because the argument of X changes by less than pi between two points.
        upper = np.imag(X) >= 0
        wall, k = np.nonzero(upper[:, 1:] != upper[:, :-1])
        direction = np.where(upper[wall, k], 1.0, -1.0)
        crosses = direction * np.imag(X[wall, k].conj() * X[wall, k + 1]) > 0
        turns = np.bincount(wall[crosses], direction[crosses], alpha.size)
        return np.round((first + np.angle(X[:, -1]) - np.angle(X[:, 0])) / (2.0 * np.pi) + turns)

    def find_undecided_points(self, alpha: float, beta: float) -> np.ndarray:
        """Return a boolean array that is True at the points of the curve at which one wall is undecided."""
        wall = np.array([1.0, alpha, beta])
        return np.einsum("i,ijk,j->k", wall, self._forms, wall) <= 0

    def find_critical_point(self, alpha: float, beta: float) -> int:
        """Return the index of the point of the curve at which a wall satisfies the inequality with the least margin."""
        wall, c = np.array([1.0, alpha, beta]), self.curve
        size = np.abs(c.u) ** 2 + np.abs((alpha + beta * c.F) * c.S) ** 2
        return int(np.argmin(np.einsum("i,ijk,j->k", wall, self._forms, wall) / size))


def _gram(parts: np.ndarray) -> np.ndarray:
    """Return the Gram matrix ``Re(conj(x_i) x_j)`` of three complex numbers at each point, shape (3, 3, points)."""
    return np.einsum("ik,jk->ijk", parts.conj(), parts).real
