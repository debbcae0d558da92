"""The loop of a measured device: what samples of its response answer of `zwidth.scenes.loop.LinearLoop`."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from zwidth.arrays.roots import minimize_golden_section
from zwidth.loops.linear.border import Outline
from zwidth.loops.linear.margins import select_gain_margin, select_phase_margin
from zwidth.loops.linear.rows import Island, arrange_by_line
from zwidth.loops.rigid.verdict import StabilityMethod
from zwidth.parts.chain import AnyChain
from zwidth.scenes.loop import LinearLoop, SlowestMotion
from zwidth.scenes.measured_curve import Decided, DecidedWalls, ResponseCurve
from zwidth.words.errors import InputError
from zwidth.words.results import Margins, RidgePoint, Stability
from zwidth.words.status import Method, RidgeKind, Status
from zwidth.words.types import Array

# Rows on each side of beta = 0, denser towards it, and again across those with stable walls; steps to the highest row.
_ROWS, _DENSER, _AGAIN = 60, 5.0, 49
_STEPS = 30
_INSIDE = 1e-9


@dataclass(frozen=True, eq=False)
class MeasuredLoop(LinearLoop):
    """Verdicts that hold for every response within the deviation; alpha and beta are arrays of one shape."""

    # At no other rate is the response known.
    most_periods = 0.0

    @cached_property
    def chain(self) -> AnyChain:
        """Refused, and with it every question that poles or matrices answer."""
        raise InputError(
            "device: poles, motions, passivity and sensitivities need a model, and a response is none; fit one "
            "to a log (zwidth.fit_log), or ask for stability, rows, columns, the stiffest wall, outlines and margins"
        )

    @cached_property
    def walls(self) -> DecidedWalls:
        """Which walls its curve decides."""
        timing, device = self.scene.timing, self.scene.device
        if timing.delay != 0:
            raise InputError(
                f"delay: got {timing.delay:g} s with a measured response, which holds every delay already; leave it out"
            )
        estimate = self.scene.velocity.estimate(timing.period)
        unit = device.mass / timing.period**2
        return DecidedWalls(ResponseCurve.lay_out(device, timing.period, unit, estimate))

    @cached_property
    def nominal(self) -> MeasuredLoop:
        """The same without the deviation: what the measured curve itself says."""
        loop = MeasuredLoop(self.scene)
        curve = self.walls.curve
        vars(loop)["walls"] = DecidedWalls(replace(curve, band=0.0 * curve.band))
        return loop

    def labels(self, alpha: np.ndarray, beta: np.ndarray) -> Array:
        """Whether walls are stable, for every response in the band."""
        return self.decide(alpha, beta, "auto", (alpha, beta)).stable

    def decide(
        self, alpha: np.ndarray, beta: np.ndarray, method: StabilityMethod = "auto", exact: Any = ()
    ) -> Stability:
        """Labels with status; UNDECIDED where lines are too far apart, too uncertain, or end too early."""
        if method not in ("auto", "crossover"):
            raise InputError(f"method: got {method!r}, which needs a model; a measured response decides by 'crossover'")
        alpha, beta = np.broadcast_arrays(alpha, beta)
        a, b = alpha.reshape(-1), beta.reshape(-1)
        known = np.isfinite(a) & np.isfinite(b)
        stable, status = np.zeros(a.size, bool), np.full(a.size, np.int32(Status.INVALID_INPUT))
        status[known] = Status.UNDECIDED
        a, b = a[known], b[known]
        (rows, of_row), (columns, of_column) = (np.unique(values, return_inverse=True) for values in (b, a))
        by_row = rows.size <= columns.size
        decided, line = (self.walls.rows(rows), of_row) if by_row else (self.walls.columns(columns), of_column)
        value, held = a if by_row else b, np.zeros((2, a.size), bool)
        for low, high, sure in zip(*(part.T for part in decided), strict=True):
            inside = (value > low[line]) & (value < high[line])
            held |= inside & np.stack([sure[line], inside])
        stable[known] = held[0]
        status[np.flatnonzero(known)[held[1]]] = Status.OK
        shape, used = alpha.shape, np.full(alpha.shape, Method.CROSSOVER, np.int32)
        return Stability(stable.reshape(shape)[()], status.reshape(shape)[()], used[()])

    def slowest(self, alpha: float, beta: float) -> SlowestMotion:
        """Not known without a model: NaN."""
        return SlowestMotion(False, np.nan, np.nan, np.nan)

    def row(self, beta: np.ndarray) -> np.ndarray:
        """The intervals of alpha that are surely stable: shape (rows, intervals, 2), NaN where a row has fewer."""
        return _only(self.walls.rows(beta), True)

    def column(self, alpha: float) -> np.ndarray:
        """The intervals of beta that are surely stable: shape (intervals, 2)."""
        return _only(self.walls.columns(np.array([alpha])), True)[0]

    def soft_rows(self, beta: np.ndarray) -> np.ndarray:
        """The surely stable intervals of alpha below all walls of rows that are surely unstable; as `row` has them."""
        found = self.walls.rows(beta)
        first = np.min(found.low, 1, where=~(found.stable | np.isnan(found.low)), initial=np.inf)
        return _only(found, found.low < first[:, None])

    def holds_softly(self, alpha: float, beta: float) -> bool:
        """Whether a wall is surely stable, and no softer one of its damping surely unstable."""
        ends = self.soft_rows(np.array([beta]))[0]
        return bool(np.any((ends[:, 0] < alpha) & (alpha < ends[:, 1])))

    def islands(self, least: float) -> list[Island]:
        """None is named: between stable walls that softer ones do not lead to others may be undecided."""
        return []

    def least_stiffness(self, least: float) -> None:
        """Return None: a measured response without a model does not contain the poles of the device."""

    @cached_property
    def _tops(self) -> tuple[np.ndarray, np.ndarray]:
        """Dampings of rows across the plane, and the stiffest wall of each, 0 where there is none."""
        # No row with more damping has decided walls.
        low, high = self.walls.ends(0.0)
        most = max((high - low) / (self.walls.curve.slow + self.walls.curve.fast), 1e-300)
        side = most * np.sinh(_DENSER * np.arange(1, _ROWS + 1) / _ROWS) / np.sinh(_DENSER)
        beta = np.concatenate([-side[::-1], [0.0], side])
        top = self._find_tops(beta)
        held = np.flatnonzero(top > 0)
        if held.size:
            ends = beta[[max(held[0] - 1, 0), min(held[-1] + 1, beta.size - 1)]]
            new = np.setdiff1d(np.linspace(ends[0], ends[1], _AGAIN), beta)
            top = np.append(top, self._find_tops(new))
            order = np.argsort(np.append(beta, new))
            beta, top = np.append(beta, new)[order], top[order]
        return beta, top

    def _find_tops(self, beta: np.ndarray) -> np.ndarray:
        return np.nanmax(self.soft_rows(beta)[:, :, 1], 1, initial=0.0)

    def outlines(self) -> list[Outline]:
        """The stiffest surely stable wall of each damping and the softest, a closed curve for pictures, if any is."""
        beta, top = self._tops
        beta, top = beta[top > 0], top[top > 0]
        low = self.soft_rows(beta)[:, 0, 0] if beta.size else beta
        walls = np.concatenate([low, top[::-1], low[:1]]), np.concatenate([beta, beta[::-1], beta[:1]])
        return [Outline(*walls, False, False)] if beta.size else []

    def stiffest(self, negative: bool) -> RidgePoint:
        """The stiffest wall that `holds_softly`, with beta >= 0 unless negative ones count."""
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
        found = minimize_golden_section(lambda beta: -self._find_tops(beta), low, middle, high, cost, _STEPS)
        middle, value = float(found[0][0]), -float(found[1][0])
        # Just inside: the end itself is not decided.
        value *= 1.0 - _INSIDE
        omega = self.walls.curve.w[self.walls.binding(value, middle)]
        return RidgePoint(np.float64(value), np.float64(middle), np.float64(omega), kind, np.int32(Status.OK))

    def explain(self, alpha: float, beta: float) -> list[str]:
        """What keeps a wall undecided, a sentence each with the frequencies to measure; empty where it is decided."""
        wall = np.array([alpha]), np.array([beta])
        if self.decide(*wall, "auto", wall).status[0] == Status.OK:
            return []
        c, hertz = self.walls.curve, 1.0 / (2.0 * np.pi * self.scene.timing.period)
        first, last, said = c.w[0] * hertz, c.w[-1] * hertz, []
        if c.odd:
            said.append(f"the first line, {first:.4g} Hz, is uncertain, or no mass, damper or spring; begin lower")
        if not alpha > self.walls.ends(beta)[0]:
            said.append(f"this wall is too soft for the first line; measure below {first:.4g} Hz")
        if not alpha < self.walls.ends(beta)[1]:
            said.append(f"this wall answers beyond the last line; measure above {last:.4g} Hz")
        doubts = self.walls.doubts(alpha, beta)
        for by_gap, remedy in ((True, "lines there are too far apart; measure more"), (False, "more force, or longer")):
            places = np.flatnonzero(doubts & ((c.gap > c.band) == by_gap))
            if places.size:
                ends = c.w[places[[0, -1]]] * hertz
                where = "measure anew from {:.4g} to {:.4g} Hz".format(*ends)
                said.append(f"{where}: {remedy}" if by_gap else f"the deviation is too large; {where}, with {remedy}")
        return said

    def explain_limit(self) -> str:
        """Return the reason why no wall is decided, from the wall with the fewest undecided frequencies."""
        rows = [(*self.walls.ends(beta), beta) for beta in self._tops[0].tolist()]
        walls = [(0.5 * (low + high), beta) for low, high, beta in rows if low < high]
        count = f"the {self.scene.device.frequency.size} frequencies of the response decide the stability of no wall"
        if not walls:
            return f"{count}: extend the frequency range or reduce the deviation"
        alpha, beta = min(walls, key=lambda wall: np.count_nonzero(self.walls.doubts(*wall)))
        return "; ".join([count, *self.explain(float(alpha), float(beta))])

    def open_loop(self, alpha: np.ndarray, beta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """``L = (alpha + beta F) G`` at angles between the first line and the last; NaN at others."""
        S, F = self.walls.curve.at(w)
        return (alpha + beta * F) * S / (4.0 * np.sin(0.5 * w) ** 2)

    def margins(self, alpha: np.ndarray, beta: np.ndarray, wanted: Container[str] = Margins._fields) -> Margins:
        """Margins on the measured curve in periods and radians a period; NaN for walls that are not surely decided.

        The delay margin is that of a pure delay, phase over frequency; where no line shows what more gain brings to the
        circle, the gain margin is the factor below which it is not beyond them.
        """
        decided = self.decide(alpha, beta, "auto", (alpha, beta))
        out = np.full((len(Margins._fields), *np.shape(alpha)), np.nan)
        for place in np.ndindex(np.shape(alpha)):
            if np.asarray(decided.status)[place] == Status.OK:
                stable = bool(np.asarray(decided.stable)[place])
                out[(slice(None), *place)] = self._margins_of(float(alpha[place]), float(beta[place]), stable)
        return Margins(*(part[()] for part in out))

    def _margins_of(self, alpha: float, beta: float, stable: bool) -> Margins:
        """The nearest crossovers of one wall, between points of the curve by straight lines."""
        c = self.walls.curve
        L = (alpha + beta * c.F) * c.S / c.u
        with np.errstate(all="ignore"):
            k, share = _zeros(L.imag)
            at, real = c.w[k] + share * np.diff(c.w)[k], L.real[k] + share * np.diff(L.real)[k]
            places, sizes = at[real < 0], -real[real < 0]
            if stable and not np.any(sizes < 1.0):
                # What more gain brings to the circle is beyond the last line, and not before L may be so large there.
                most = c.strongest * (abs(alpha) + abs(beta) * c.fast)
                places, sizes = np.append(places, c.w[-1]), np.append(sizes, most)
            k, share = _zeros(np.log(np.abs(L)))
            at = c.w[k] + share * np.diff(c.w)[k]
            turns: Any = np.angle(-L[k]) + share * np.angle(L[k + 1] / L[k])
            gain, phase_at = select_gain_margin(stable, places, sizes)
            phase, gain_at = select_phase_margin(stable, at, turns)
            delay = float(np.min(np.mod(turns, 2.0 * np.pi) / at, initial=np.inf)) if stable else 0.0
        closest = int(np.argmin(np.abs(1.0 + L)))
        return Margins(gain, phase, delay, float(abs(1.0 + L[closest])), phase_at, gain_at, float(c.w[closest]))


def _only(found: Decided, held: np.ndarray | bool) -> np.ndarray:
    """Stable intervals of each line of the plane, of those some: (lines, intervals, 2), NaN where one has fewer."""
    line, k = np.nonzero(found.stable & held)
    return arrange_by_line(len(found.low), line, np.stack([found.low[line, k], found.high[line, k]], -1))


def _zeros(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Before which zeros values stand, and at what share of the step each lies."""
    k = np.flatnonzero((values[:-1] > 0) != (values[1:] > 0))
    return k, values[k] / (values[k] - values[k + 1])
