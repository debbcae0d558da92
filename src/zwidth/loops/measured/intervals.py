"""Which walls a measured response decides, along a row or a column of the plane (docs/theory/measured.md, M9).

A wall is decided where ``X = u + alpha S + beta F S`` stays away from 0 for every curve within the radius: at each
point

    |X|^2 > rho^2 |alpha + beta F|^2 + (|step before|^2 + |step behind|^2)/4

a quadratic in alpha and beta. Along a row or a column what is not decided is therefore a union of intervals in closed
form; between them the curve winds around 0 equally often for every wall, which one wall in the middle tells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.loops.measured.curve import ResponseCurve

# rho |H| changes by so little from a point to the next.
_ROOM = 1.02
# Decided intervals that are shorter than this share of where they are say nothing.
_LEAST = 1e-9
_TINY = 1e-300
# Rows or columns, times points of the curve, that are looked at together.
_BLOCK = 1 << 15


class Decided(NamedTuple):
    """Decided intervals of alpha or beta, ascending: (lines, intervals), NaN where a line of the plane has fewer.

    Their ends, and whether the walls inside are stable.
    """

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

    @cached_property
    def most_damping(self) -> float:
        """The largest ``|beta|`` of a row with decided walls; negative where there is none."""
        low, high = self.ends(0.0)
        return (high - low) / (self.curve.slow + self.curve.fast)

    def _intervals(self, free: int, fixed: np.ndarray, least: np.ndarray, most: np.ndarray) -> Decided:
        """Of rows or columns, so many at a time."""
        size = max(1, _BLOCK // self.curve.w.size)
        parts = [
            self._some(free, fixed[part], least[part], most[part])
            for part in (slice(start, start + size) for start in range(0, max(fixed.size, 1), size))
        ]
        line, *found = (np.concatenate(column) for column in zip(*parts, strict=True))
        line += np.repeat(size * np.arange(len(parts)), [part[0].size for part in parts])
        low, high, stable = np.moveaxis(side_by_side(fixed.size, line, np.stack(found, -1)), -1, 0)
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
        both = side_by_side(fixed.size, line[~outer][order], np.stack([low, high], -1)[~outer][order])
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


def side_by_side(lines: int, line: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values that belong to ascending lines by line: (lines, most of one, ...), NaN where one has fewer."""
    place = np.arange(line.size) - np.searchsorted(line, line)
    out = np.full((lines, int(place.max(initial=-1)) + 1, *values.shape[1:]), np.nan)
    out[line, place] = values
    return out


def _gram(parts: np.ndarray) -> np.ndarray:
    """``Re(conj(x_i) x_j)`` of each point."""
    return np.einsum("ik,jk->ijk", parts.conj(), parts).real
