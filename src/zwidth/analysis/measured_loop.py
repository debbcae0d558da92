"""Loop of a measured device: the analyses of `zwidth.analysis.loop.LinearLoop` that need no model of the device.

A wall is stable or unstable only if all frequency responses within the error bounds agree (`measured_curve`,
docs/theory/measured.md); otherwise it is undecided. *Lines* are the measured frequencies; alpha and beta are the
normalized stiffness and damping of a wall, L is the open loop, and angles are w = omega T with the period T. A wall
counts as connected to K = 0 if it is stable and no softer wall of the same damping is unstable. The search for the
stiffest wall evaluates a grid of beta, and refines the best beta by golden-section search.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from zwidth.analysis.loop import DominantMode, LinearLoop
from zwidth.analysis.measured_curve import DecidedIntervals, DecidedWalls, ResponseCurve
from zwidth.core.errors import InputError
from zwidth.core.status import Method, RidgeKind, Status
from zwidth.core.types import Array
from zwidth.model.mechanism import AnyChain
from zwidth.numerics.root_finding import minimize_golden_section
from zwidth.stability.linear.regions import Outline
from zwidth.stability.linear.rows import Island, arrange_by_line
from zwidth.stability.open_loop import select_gain_margin, select_phase_margin
from zwidth.stability.results import Margins, RidgePoint, Stability
from zwidth.stability.rigid.verdict import StabilityMethod

# Settings of the search for the stiffest wall on a grid of beta.
N_SIDE = 60  # values of beta on each side of beta = 0
DENSITY = 5.0  # argument of sinh at the largest beta; larger values place more of them close to beta = 0
N_REFINED = 49  # further values of beta in the range with stable walls
SEARCH_STEPS = 30  # steps of the golden-section search for the best beta
INSIDE = 1e-9  # relative distance of the stiffest wall below the end of its decided interval


@dataclass(frozen=True, eq=False)
class MeasuredLoop(LinearLoop):
    """Analyses of a scene with a measured device; results hold for every response within the error bounds."""

    most_periods = 0.0  # prevents searches over the rate, because the response is valid for one rate only

    @cached_property
    def chain(self) -> AnyChain:
        """Mechanical model of the device, which a measured response lacks: always raises `InputError`."""
        raise InputError(
            "device: poles, responses in time, passivity and sensitivities need a model instead of a measured "
            "response; fit one with zwidth.fit_log"
        )

    @cached_property
    def walls(self) -> DecidedWalls:
        """Decision of the stability of walls from the measured response with its error bounds."""
        timing, device = self.scene.timing, self.scene.device
        if timing.delay != 0:
            raise InputError(
                f"delay: got {timing.delay:g} s with a measured response, which includes all delays; omit the delay"
            )
        estimate = self.scene.velocity.estimate(timing.period)
        unit = device.mass / timing.period**2
        return DecidedWalls(ResponseCurve.interpolate(device, timing.period, unit, estimate))

    @cached_property
    def nominal(self) -> MeasuredLoop:
        """Loop of the measured response if the errors of its lines are assumed to be 0."""
        loop = MeasuredLoop(self.scene)
        curve = self.walls.curve
        vars(loop)["walls"] = DecidedWalls(replace(curve, band=0.0 * curve.band))
        return loop

    def labels(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """Return a boolean array that is True for walls that are stable for every response within the error bounds."""
        return self.decide(alpha, beta, "auto", (alpha, beta)).stable

    def decide(
        self, alpha: np.ndarray, beta: np.ndarray, method: StabilityMethod = "auto", exact: Any = ()
    ) -> Stability:
        """Return for each wall whether it is stable for every response within the error bounds, with a status.

        The status is UNDECIDED if the lines are too far apart, if their errors are too large, or if the range of
        measured frequencies is too narrow. ``exact`` is an argument of the base class and ignored.
        """
        if method not in ("auto", "crossover"):
            raise InputError(f"method: got {method!r}, which needs a model; use 'crossover' for a measured response")
        alpha, beta = np.broadcast_arrays(alpha, beta)
        a, b = alpha.reshape(-1), beta.reshape(-1)
        finite = np.isfinite(a) & np.isfinite(b)
        stable, status = np.zeros(a.size, bool), np.full(a.size, np.int32(Status.INVALID_INPUT))
        status[finite] = Status.UNDECIDED
        a, b = a[finite], b[finite]
        (betas, beta_index), (alphas, alpha_index) = (np.unique(values, return_inverse=True) for values in (b, a))
        # Group the walls by equal beta or by equal alpha, whichever results in fewer groups, to save time.
        along_alpha = betas.size <= alphas.size
        decided, line = (
            (self.walls.decide_alpha(betas), beta_index)
            if along_alpha
            else (self.walls.decide_beta(alphas), alpha_index)
        )
        value, labels = a if along_alpha else b, np.zeros((2, a.size), bool)
        for low, high, interval_stable in zip(*(part.T for part in decided), strict=True):
            inside = (value > low[line]) & (value < high[line])
            labels |= inside & np.stack([interval_stable[line], inside])
        stable[finite] = labels[0]
        status[np.flatnonzero(finite)[labels[1]]] = Status.OK
        shape, used = alpha.shape, np.full(alpha.shape, Method.CROSSOVER, np.int32)
        return Stability(stable.reshape(shape)[()], status.reshape(shape)[()], used[()])

    def find_dominant(self, alpha: float, beta: float) -> DominantMode:
        """Return a dominant pole with NaN in all numbers, because a measured response does not determine the poles."""
        return DominantMode(False, np.nan, np.nan, np.nan)

    def find_stable_alpha(self, beta: np.ndarray) -> np.ndarray:
        """Return the intervals of stable alpha for each beta, shape (n, intervals, 2), padded with NaN."""
        return _select_stable(self.walls.decide_alpha(beta), True)

    def find_stable_beta(self, alpha: float) -> np.ndarray:
        """Return the intervals of stable beta for one alpha, shape (intervals, 2)."""
        return _select_stable(self.walls.decide_beta(np.array([alpha])), True)[0]

    def _find_connected_alpha(self, beta: np.ndarray) -> np.ndarray:
        """Return the intervals of stable alpha that lie below all unstable alpha of the same beta.

        The result has the shape (n, intervals, 2), with NaN if a beta has fewer intervals.
        """
        intervals = self.walls.decide_alpha(beta)
        unstable = np.min(intervals.low, 1, where=~(intervals.stable | np.isnan(intervals.low)), initial=np.inf)
        return _select_stable(intervals, intervals.low < unstable[:, None])

    def is_connected(self, alpha: float, beta: float) -> bool:
        """Return whether a wall is stable, and no softer wall with the same beta is unstable."""
        ends = self._find_connected_alpha(np.array([beta]))[0]
        return bool(np.any((ends[:, 0] < alpha) & (alpha < ends[:, 1])))

    def islands(self, least: float) -> list[Island]:
        """Return an empty list, because undecided walls may connect every piece of the stable set to K = 0."""
        return []

    def least_stiffness(self, least: float) -> None:
        """Return None, because a measured response does not show if the device is unstable without a wall."""

    @cached_property
    def _tops(self) -> tuple[np.ndarray, np.ndarray]:
        """Grid of beta, and for each beta the largest alpha of a stable wall connected to K = 0; 0 if none exists."""
        # Limit the grid to |beta| <= most, because no wall with a larger |beta| is decided.
        low, high = self.walls.bound_alpha(0.0)
        most = max((high - low) / (self.walls.curve.max_F_below + self.walls.curve.max_F_above), 1e-300)
        side = most * np.sinh(DENSITY * np.arange(1, N_SIDE + 1) / N_SIDE) / np.sinh(DENSITY)
        beta = np.concatenate([-side[::-1], [0.0], side])
        top = self._find_tops(beta)
        stable = np.flatnonzero(top > 0)
        if stable.size:
            ends = beta[[max(stable[0] - 1, 0), min(stable[-1] + 1, beta.size - 1)]]
            new = np.setdiff1d(np.linspace(ends[0], ends[1], N_REFINED), beta)
            top = np.append(top, self._find_tops(new))
            order = np.argsort(np.append(beta, new))
            beta, top = np.append(beta, new)[order], top[order]
        return beta, top

    def _find_tops(self, beta: np.ndarray) -> np.ndarray:
        """Return for each beta the largest alpha of a stable wall connected to K = 0; 0 if none exists."""
        return np.nanmax(self._find_connected_alpha(beta)[:, :, 1], 1, initial=0.0)

    def outlines(self) -> list[Outline]:
        """Return one closed outline of the stable walls connected to K = 0, for figures; none if no wall is stable.

        The outline joins the softest and the stiffest of these walls at each beta. Undecided walls between them lie
        inside the outline.
        """
        beta, top = self._tops
        beta, top = beta[top > 0], top[top > 0]
        low = self._find_connected_alpha(beta)[:, 0, 0] if beta.size else beta
        walls = np.concatenate([low, top[::-1], low[:1]]), np.concatenate([beta, beta[::-1], beta[:1]])
        return [Outline(*walls, False, False)] if beta.size else []

    def stiffest(self, negative: bool) -> RidgePoint:
        """Return the stiffest stable wall connected to K = 0; ``negative`` allows beta < 0."""
        beta, top = self._tops
        top = np.where((beta < 0) & (not negative), 0.0, top)
        best = int(np.argmax(top))
        nan, kind = np.float64(np.nan), np.int32(RidgeKind.SMOOTH)
        if not top[best] > 0:
            return RidgePoint(nan, nan, nan, np.int32(RidgeKind.NONE), np.int32(Status.UNDECIDED))
        low, middle, high = (float(beta[k]) for k in (max(best - 1, 0), best, min(best + 1, beta.size - 1)))
        low, middle, high, cost = (
            np.array([end]) for end in (low if negative else max(low, 0.0), middle, high, -top[best])
        )
        minimum = minimize_golden_section(lambda beta: -self._find_tops(beta), low, middle, high, cost, SEARCH_STEPS)
        middle, value = float(minimum[0][0]), -float(minimum[1][0])
        # Reduce alpha slightly below the end of its stable interval, because the wall at the end itself is undecided.
        value *= 1.0 - INSIDE
        omega = self.walls.curve.w[self.walls.find_critical_point(value, middle)]
        return RidgePoint(np.float64(value), np.float64(middle), np.float64(omega), kind, np.int32(Status.OK))

    def explain(self, alpha: float, beta: float) -> list[str]:
        """Return texts on why a wall is undecided and which frequencies to measure; an empty list if it is decided."""
        wall = np.array([alpha]), np.array([beta])
        if self.decide(*wall, "auto", wall).status[0] == Status.OK:
            return []
        c, hertz = self.walls.curve, 1.0 / (2.0 * np.pi * self.scene.timing.period)
        first, last, reasons = c.w[0] * hertz, c.w[-1] * hertz, []
        if c.no_asymptote:
            reasons.append(
                f"the response at {first:.4g} Hz is uncertain, or not that of a mass, damper or spring; "
                "measure lower frequencies"
            )
        if not alpha > self.walls.bound_alpha(beta)[0]:
            reasons.append(f"this wall is too soft for the measured range; measure below {first:.4g} Hz")
        if not alpha < self.walls.bound_alpha(beta)[1]:
            reasons.append(f"the loop gain above the measured range is too large; measure above {last:.4g} Hz")
        undecided = self.walls.find_undecided_points(alpha, beta)
        for by_gap, remedy in (
            (True, "finer frequency spacing"),
            (False, "more force or for longer"),
        ):
            points = np.flatnonzero(undecided & ((c.gap > c.band) == by_gap))
            if points.size:
                ends = c.w[points[[0, -1]]] * hertz
                band = "measure again from {:.4g} to {:.4g} Hz".format(*ends)
                reasons.append(
                    f"{band} with {remedy}" if by_gap else f"the deviation is too large; {band} with {remedy}"
                )
        return reasons

    def explain_limit(self) -> str:
        """Return a text with the reasons why no wall is decided: those of the wall undecided at fewest frequencies."""
        rows = [(*self.walls.bound_alpha(beta), beta) for beta in self._tops[0].tolist()]
        walls = [(0.5 * (low + high), beta) for low, high, beta in rows if low < high]
        count = f"the {self.scene.device.frequency.size} frequencies of the response decide the stability of no wall"
        if not walls:
            return f"{count}: extend the frequency range or reduce the deviation"
        alpha, beta = min(walls, key=lambda wall: np.count_nonzero(self.walls.find_undecided_points(*wall)))
        return "; ".join([count, *self.explain(float(alpha), float(beta))])

    def open_loop(self, alpha: np.ndarray, beta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return ``L = (alpha + beta F) G`` at angles between the first and the last line; NaN at other angles."""
        S, F = self.walls.curve.evaluate(w)
        return (alpha + beta * F) * S / (4.0 * np.sin(0.5 * w) ** 2)

    def margins(self, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str] = Margins._fields) -> Margins:
        """Return the stability margins of walls from the measured curve; NaN for undecided walls.

        Times are in periods, frequencies in rad per period. The delay margin is the smallest ratio of phase to
        frequency at a gain crossover. If no phase crossover in the measured range limits an increase of the gain, the
        gain margin is a lower bound: for factors up to it no crossover exists above the range.
        """
        decided = self.decide(alpha, beta, "auto", (alpha, beta))
        out = np.full((len(Margins._fields), *np.shape(alpha)), np.nan)
        for index in np.ndindex(np.shape(alpha)):
            if np.asarray(decided.status)[index] == Status.OK:
                stable = bool(np.asarray(decided.stable)[index])
                out[(slice(None), *index)] = self._compute_margins(float(alpha[index]), float(beta[index]), stable)
        return Margins(*(part[()] for part in out))

    def _compute_margins(self, alpha: float, beta: float, stable: bool) -> Margins:
        """Return the margins of one wall, by linear interpolation between the points of the curve."""
        c = self.walls.curve
        L = (alpha + beta * c.F) * c.S / c.u
        with np.errstate(all="ignore"):
            k, share = _find_zeros(L.imag)
            w, real = c.w[k] + share * np.diff(c.w)[k], L.real[k] + share * np.diff(L.real)[k]
            crossovers, sizes = w[real < 0], -real[real < 0]
            if stable and not np.any(sizes < 1.0):
                # If no phase crossover with |L| < 1 was measured, use the bound ``most`` of |L| above the last line,
                # because the loop stays stable there if its gain increases by a factor below 1/most.
                most = c.max_G * (abs(alpha) + abs(beta) * c.max_F_above)
                crossovers, sizes = np.append(crossovers, c.w[-1]), np.append(sizes, most)
            k, share = _find_zeros(np.log(np.abs(L)))
            w = c.w[k] + share * np.diff(c.w)[k]
            turns: Any = np.angle(-L[k]) + share * np.angle(L[k + 1] / L[k])
            gain, phase_w = select_gain_margin(stable, crossovers, sizes)
            phase, gain_w = select_phase_margin(stable, w, turns)
            delay = float(np.min(np.mod(turns, 2.0 * np.pi) / w, initial=np.inf)) if stable else 0.0
        closest = int(np.argmin(np.abs(1.0 + L)))
        return Margins(gain, phase, delay, float(abs(1.0 + L[closest])), phase_w, gain_w, float(c.w[closest]))


def _select_stable(intervals: DecidedIntervals, mask: np.ndarray | bool) -> np.ndarray:
    """Return the stable intervals that a mask selects, shape (fixed values, intervals, 2), padded with NaN."""
    line, k = np.nonzero(intervals.stable & mask)
    return arrange_by_line(len(intervals.low), line, np.stack([intervals.low[line, k], intervals.high[line, k]], -1))


def _find_zeros(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the value before each sign change, and the zero as a fraction of the step to the next one."""
    k = np.flatnonzero((values[:-1] > 0) != (values[1:] > 0))
    return k, values[k] / (values[k] - values[k + 1])
