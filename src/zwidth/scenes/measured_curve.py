"""A measured response as a curve, how far from it the true one may be, and which walls it decides.

With ``u = |z - 1|^2`` and ``S = u G`` the closed loop is decided by ``X = u (1 + H G) = u + alpha S + beta F S``, which
winds around 0 as ``1 + H G`` does, and stays of one size where the device moves like a mass (docs/theory/measured.md,
M2 to M8).

Along a row or a column of the plane a wall is decided (M9) where X stays away from 0 for every curve within the radius:
at each point

    |X|^2 > rho^2 |alpha + beta F|^2 + (|step before|^2 + |step behind|^2)/4

a quadratic in alpha and beta. What is not decided is therefore a union of intervals in closed form; between them the
curve winds around 0 equally often for every wall, which one wall in the middle tells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from zwidth.loops.linear.rows import arrange_by_line, collect_by_line
from zwidth.parts.circle import circle
from zwidth.parts.velocity import Estimate
from zwidth.words.errors import InputError

# The least damping ratio that a resonance between two lines is taken to have.
LEAST_DAMPING_RATIO = 0.005
# What a resonance half-way between two lines, d apart, adds at its top, over the second difference that it leaves at
# them: d/(2 zeta f) times 1/(2 + 2/3).
_SEEN = 16.0 / 3.0
# Of a smooth curve a chord misses an eighth of the second difference; twice that.
_SMOOTH = 0.25
# A turn of the response between two lines, in rad, beyond which nothing between them is known.
MOST_TURN = 0.5
# By what share of itself the curve may change between points, and how many are laid between two lines at most.
_STEP, _MOST = 0.005, 32
# By what the first line's phase may miss those of a mass, a damper or a spring, told apart by so many lines or more.
_PHASE, _FIRST = 0.8, 4
# Beyond the last line the response is at most so many times that of the lines from this share of the band on, unless it
# has risen there by so much against a mass: then a resonance is in sight, and nothing is known.
_BEYOND, _LAST, _RISEN = 2.0, 0.8, 1.2
_ACROSS = 65


@dataclass(frozen=True)
class ResponseCurve:
    """Points of the curve, laid so densely that chords serve; in units of the period and of the scene's mass."""

    w: np.ndarray
    u: np.ndarray  # |z - 1|^2
    S: np.ndarray  # u G
    F: np.ndarray  # the velocity estimate
    band: np.ndarray  # radius of S by the deviation of the lines
    gap: np.ndarray  # radius of S by what may be between the lines
    weakest: float  # |G| at the first line, at least, and below it
    strongest: float  # |G| beyond the last line, at most
    slow: float  # |F| below the first line, at most
    fast: float  # |F| beyond the last line, at most
    odd: bool  # whether the first line moves like neither mass, damper nor spring

    @property
    def radius(self) -> np.ndarray:
        """How far S may be from the curve."""
        return self.band + self.gap

    def at(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """S and F at other angles, by straight lines; NaN beyond the ends."""

        def between(values: np.ndarray) -> np.ndarray:
            return np.interp(w, self.w, values, np.nan, np.nan)

        parts = (self.S, self.F)
        S, F = (between(np.real(part)) + 1j * between(np.imag(part)) for part in parts)
        return S, F

    @classmethod
    def lay_out(cls, device: Any, period: float, stiffness: float, estimate: Estimate) -> ResponseCurve:
        """The curve of a `MeasuredDevice` at a period, its response times the unit of stiffness."""
        w = 2.0 * np.pi * device.frequency * period
        if w[-1] >= np.pi:
            raise InputError(
                f"frequency: got {device.frequency[-1]:g} Hz at a period of {period:g} s; a controller sees less than "
                f"half its rate, {0.5 / period:g} Hz: leave the lines above out, or correct the period"
            )
        G = device.response * stiffness
        r = np.zeros(w.size) if device.deviation is None else device.deviation * stiffness
        u = _square(w)
        S, R = u * G, u * r
        E = _gaps(w, S)
        # By what share the curve changes from line to line, beyond what its deviation explains.
        change = np.maximum(np.abs(np.diff(S)) - 2.0 * (R[1:] + R[:-1]), 0.0)
        change = change / (np.maximum(np.abs(S[1:]), np.abs(S[:-1])) + 1e-300)
        count = np.maximum(2.0 * np.diff(w) / w[1:], change) / _STEP
        count = np.clip(np.ceil(count), 1, _MOST).astype(int)
        line = np.repeat(np.arange(w.size - 1), count)
        share = (np.arange(line.size) - np.repeat(np.cumsum(count) - count, count)) / count[line]
        step = np.diff(w)[line]
        at = np.append(w[line] + share * step, w[-1])
        slope = np.gradient(S, w)
        # Cubic between two lines, with the slopes of their neighbors.
        t = share
        inner = (1 + 2 * t) * (1 - t) ** 2 * S[line] + t * (1 - t) ** 2 * step * slope[line]
        inner += t * t * (3 - 2 * t) * S[line + 1] + t * t * (t - 1) * step * slope[line + 1]
        F = estimate.jet(circle(at)).value
        band, gap = np.append(np.maximum(R[:-1], R[1:])[line], R[-1]), np.append(E[line], E[-1])
        starts = np.flatnonzero(share == 0)[1:]
        for values in (band, gap):
            values[starts] = np.maximum(values[starts], values[starts - 1])
        below, above = np.linspace(0.0, w[0], _ACROSS), np.linspace(w[-1], np.pi, _ACROSS)
        slow, fast = (float(np.abs(estimate.jet(circle(part)).value).max()) for part in (below, above))
        return cls(
            at, _square(at), np.append(inner, S[-1]), F, band, gap,
            float(abs(G[0]) - r[0]), _bound_beyond(w, np.abs(G), r), slow, fast,
            _is_odd(w, G, r),
        )  # fmt: skip


def _square(w: np.ndarray) -> np.ndarray:
    """``|z - 1|^2``."""
    return 4.0 * np.sin(0.5 * w) ** 2


def _is_odd(w: np.ndarray, G: np.ndarray, r: np.ndarray) -> bool:
    """Whether the first line moves like neither mass, damper nor spring: a quarter turn behind for each power of w."""
    few = min(w.size, max(_FIRST, int(np.sum(w <= 1.5 * w[0]))))
    if r[0] >= abs(G[0]) or not np.all(G[:few]):
        return True
    power = np.polyfit(np.log(w[:few]), np.log(np.abs(G[:few])), 1)[0]
    phase, uncertain = np.angle(1j * G[0]) - 0.5 * np.pi, np.arcsin(np.minimum(r[:few] / np.abs(G[:few]), 1.0))
    away = abs(phase - 0.5 * np.pi * np.clip(power, -2.0, 0.0)) + uncertain[0]
    # Whole turns of a long delay are in no phase, but in how it turns from line to line.
    share = w[:few] - np.mean(w[:few])
    share *= w[0] / np.sum(share**2)
    turned = abs(share @ np.unwrap(np.angle(G[:few]))) + np.abs(share) @ uncertain
    return bool(max(away, turned) > _PHASE)


def _bound_beyond(w: np.ndarray, size: np.ndarray, r: np.ndarray) -> float:
    """The largest |G| beyond the last line, by means that noise only raises; infinite with a resonance in sight."""
    last = np.flatnonzero(w >= _LAST * w[-1])
    u, few = _square(w), max(1, last.size // 4)
    first, final = (float(np.median((u * size)[part])) for part in (last[:few], last[-few:]))
    room = float(np.median((u * r)[last]))
    if final - room > _RISEN * (first + room):
        return np.inf
    halves = (part for part in np.array_split(last, 2) if part.size)
    return _BEYOND * max(float(np.sqrt(np.mean(size[part] ** 2))) for part in halves)


def _gaps(w: np.ndarray, S: np.ndarray) -> np.ndarray:
    """How far the true curve may be from the interpolated one between each two lines."""
    step, chord = np.diff(w), np.diff(S)
    bend = np.abs(2.0 * np.diff(chord / step) / (step[1:] + step[:-1]))
    bend = np.maximum(np.append(bend[:1], bend), np.append(bend, bend[-1:])) * step**2
    share = 2.0 * step / (w[1:] + w[:-1])
    gap = bend * np.maximum(_SMOOTH, share / (_SEEN * LEAST_DAMPING_RATIO))
    with np.errstate(all="ignore"):
        turn = np.abs(np.angle(S[1:] / S[:-1]))
    return np.where(turn > MOST_TURN, np.maximum(gap, np.abs(chord)), gap)


# rho |H| changes by so little from a point to the next.
_ROOM = 1.02
# Decided intervals that are shorter than this share of where they are say nothing.
_LEAST = 1e-9
_TINY = 1e-300
# Rows or columns, times points of the curve, that are looked at together.
_BLOCK = 1 << 15


class Decided(NamedTuple):
    """Decided intervals of alpha or beta, ascending: (lines of the plane, intervals), NaN where one has fewer."""

    low: np.ndarray
    high: np.ndarray
    stable: np.ndarray


@dataclass(frozen=True)
class DecidedWalls:
    """What one curve decides."""

    curve: ResponseCurve

    @cached_property
    def _forms(self) -> np.ndarray:
        """A symmetric form in (1, alpha, beta) for each point, positive where a wall passes it."""
        c = self.curve
        X = np.stack([c.u + 0j, c.S, c.F * c.S])
        H = np.stack([0 * c.F, 1 + 0 * c.F, c.F])
        step = _gram(np.diff(X, axis=1))
        steps = np.pad(step, ((0, 0), (0, 0), (1, 0))) + np.pad(step, ((0, 0), (0, 0), (0, 1)))
        return _gram(X) - _ROOM * c.radius**2 * _gram(H) - 0.25 * steps

    def rows(self, beta: np.ndarray) -> Decided:
        """Decided intervals of alpha at dampings."""
        return self._intervals(1, beta, *self.ends(beta))

    def columns(self, alpha: np.ndarray) -> Decided:
        """Decided intervals of beta at stiffnesses."""
        c = self.curve
        most = np.minimum((alpha - 1.0 / max(c.weakest, _TINY)) / c.slow, (1.0 / c.strongest - alpha) / c.fast)
        return self._intervals(2, alpha, -most, most)

    def ends(self, beta: Any) -> tuple[Any, Any]:
        """Between which alpha the walls of rows are decided below the first line, and beyond the last one."""
        c = self.curve
        return np.abs(beta) * c.slow + 1.0 / max(c.weakest, _TINY), 1.0 / c.strongest - np.abs(beta) * c.fast

    def _intervals(self, free: int, fixed: np.ndarray, least: np.ndarray, most: np.ndarray) -> Decided:
        """Of rows or columns, so many at a time."""
        together = max(1, _BLOCK // self.curve.w.size)
        low, high, stable = collect_by_line(partial(self._some, free), together, fixed, least, most)
        return Decided(low, high, stable == 1)

    def _some(self, free: int, fixed: np.ndarray, least: np.ndarray, most: np.ndarray) -> tuple[np.ndarray, ...]:
        """One after another: the row or column that each interval is of, its ends, and whether its walls are stable."""
        M, other, across = self._forms, 3 - free, fixed[:, None]
        a = M[free, free]
        half = M[0, free] + across * M[free, other]
        c = M[0, 0] + 2.0 * across * M[0, other] + across * across * M[other, other]
        spread = half * half - a * c
        # Between its ends a point decides nothing, or, where its form opens downwards, outside of them.
        met, outer = spread >= 0, a <= 0
        known = (least < most) & ~np.any(outer & (spread <= 0), 1) & (not self.curve.odd)
        line, point = np.nonzero(met & known[:, None])
        half, c, a = half[line, point], c[line, point], a[point]
        with np.errstate(all="ignore"):
            larger = -(half + np.where(half < 0, -1.0, 1.0) * np.sqrt(spread[line, point]))
            ends = larger / np.where(a == 0, _TINY, a), c / larger
        unknown = np.isnan(ends[0] + ends[1])
        low, high = np.where(unknown, -np.inf, np.minimum(*ends)), np.where(unknown, np.inf, np.maximum(*ends))
        outer = outer[point]
        np.maximum.at(least := least.copy(), line[outer], low[outer])
        np.minimum.at(most := most.copy(), line[outer], high[outer])
        order = np.lexsort((low[~outer], line[~outer]))
        both = arrange_by_line(fixed.size, line[~outer][order], np.stack([low, high], -1)[~outer][order])
        low, high = np.moveaxis(both, -1, 0)
        reached = np.fmax.accumulate(np.column_stack([least, high]), 1)
        low = np.minimum(np.where(np.isnan(low), -np.inf, low), most[:, None])
        after = np.column_stack([low, most])
        line, gap = np.nonzero((after > reached + _LEAST * np.abs(after)) & known[:, None])
        low, high = reached[line, gap], after[line, gap]
        walls = (0.5 * (low + high), fixed[line])[:: 1 if free == 1 else -1]
        return line, low, high, self._turn(*walls) == 0

    def _turn(self, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
        """How often the curves of decided walls wind around 0, from z = 1 to z = -1 and back."""
        c = self.curve
        X = c.u + (alpha[:, None] + beta[:, None] * c.F) * c.S
        # Below the first line |L| > 1: 1 + L turns as L does, which is there the phase of a mass, a damper or a spring.
        L = X[:, 0] / c.u[0] - 1.0
        first = np.angle(1j * L) - 0.5 * np.pi + np.angle(1.0 + 1.0 / L)
        # Whole turns are where X, which never turns by half a turn from a point to the next, passes the negative axis.
        upper = np.imag(X) >= 0
        wall, k = np.nonzero(upper[:, 1:] != upper[:, :-1])
        up = np.where(upper[wall, k], 1.0, -1.0)
        passed = up * np.imag(X[wall, k].conj() * X[wall, k + 1]) > 0
        turns = np.bincount(wall[passed], up[passed], alpha.size)
        return np.round((first + np.angle(X[:, -1]) - np.angle(X[:, 0])) / (2.0 * np.pi) + turns)

    def doubts(self, alpha: float, beta: float) -> np.ndarray:
        """At which points a wall is not decided."""
        wall = np.array([1.0, alpha, beta])
        return np.einsum("i,ijk,j->k", wall, self._forms, wall) <= 0

    def binding(self, alpha: float, beta: float) -> int:
        """The point that is nearest to leave a wall undecided."""
        wall, c = np.array([1.0, alpha, beta]), self.curve
        size = np.abs(c.u) ** 2 + np.abs((alpha + beta * c.F) * c.S) ** 2
        return int(np.argmin(np.einsum("i,ijk,j->k", wall, self._forms, wall) / size))


def _gram(parts: np.ndarray) -> np.ndarray:
    """``Re(conj(x_i) x_j)`` of each point."""
    return np.einsum("ik,jk->ijk", parts.conj(), parts).real
