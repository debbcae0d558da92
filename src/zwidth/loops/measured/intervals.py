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
from typing import NamedTuple

import numpy as np

from zwidth.loops.measured.curve import ResponseCurve

# rho |H| changes by so little from a point to the next.
_ROOM = 1.02
# Decided intervals that are shorter than this share of where they are say nothing.
_LEAST = 1e-9
_TINY = 1e-300


class Decided(NamedTuple):
    """Decided intervals of alpha or beta, ascending: ends, and whether the walls inside are stable."""

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

    def row(self, beta: float) -> Decided:
        """Decided intervals of alpha at a damping."""
        low, high = self.ends(beta)
        return self._intervals(1, beta, low, high)

    def column(self, alpha: float) -> Decided:
        """Decided intervals of beta at a stiffness."""
        c = self.curve
        most = min((alpha - 1.0 / max(c.weakest, _TINY)) / c.slow, (1.0 / c.strongest - alpha) / c.fast)
        return self._intervals(2, alpha, -most, most)

    def ends(self, beta: float) -> tuple[float, float]:
        """Between which alpha the walls of a row are decided below the first line, and beyond the last one."""
        c = self.curve
        return abs(beta) * c.slow + 1.0 / max(c.weakest, _TINY), 1.0 / c.strongest - abs(beta) * c.fast

    @cached_property
    def most_damping(self) -> float:
        """The largest ``|beta|`` of a row with decided walls; negative where there is none."""
        low, high = self.ends(0.0)
        return (high - low) / (self.curve.slow + self.curve.fast)

    def _intervals(self, free: int, fixed: float, least: float, most: float) -> Decided:
        none = Decided(np.zeros(0), np.zeros(0), np.zeros(0, bool))
        if self.curve.odd or not least < most:
            return none
        M, other = self._forms, 3 - free
        a = M[free, free]
        half = M[0, free] + fixed * M[free, other]
        c = M[0, 0] + 2.0 * fixed * M[0, other] + fixed * fixed * M[other, other]
        spread = half * half - a * c
        if np.any((a <= 0) & (spread <= 0)):
            return none
        met = spread >= 0
        a, half, c, spread = a[met], half[met], c[met], spread[met]
        with np.errstate(all="ignore"):
            larger = -(half + np.where(half < 0, -1.0, 1.0) * np.sqrt(spread))
            ends = np.sort(np.stack([larger / np.where(a == 0, _TINY, a), c / larger]), axis=0)
        ends = np.where(np.isnan(ends), np.array([[-np.inf], [np.inf]]), ends)
        inner = a > 0
        low = np.concatenate([[-np.inf, most], ends[0, inner], np.full((~inner).sum(), -np.inf), ends[1, ~inner]])
        high = np.concatenate([[least, np.inf], ends[1, inner], ends[0, ~inner], np.full((~inner).sum(), np.inf)])
        order = np.argsort(low)
        low, reached = low[order], np.maximum.accumulate(high[order])
        gap = np.flatnonzero(low[1:] > reached[:-1] + _LEAST * np.abs(low[1:]))
        low, high = reached[gap], low[gap + 1]
        middle, same = 0.5 * (low + high), np.full(low.size, fixed)
        walls = (middle, same) if free == 1 else (same, middle)
        stable = np.array([self._turns(*wall) == 0 for wall in zip(*walls, strict=True)], bool)
        return Decided(low, high, stable)

    def _turns(self, alpha: float, beta: float) -> int:
        """How often the curve of a decided wall winds around 0, from z = 1 to z = -1 and back."""
        c = self.curve
        L = (alpha + beta * c.F) * c.S / c.u
        X = c.u * (1.0 + L)
        # Below the first line |L| > 1: 1 + L turns as L does, which is there the phase of a mass, a damper or a spring.
        first = np.angle(1j * L[0]) - 0.5 * np.pi + np.angle(1.0 + 1.0 / L[0])
        return int(np.round((first + np.angle(X[1:] / X[:-1]).sum()) / (2.0 * np.pi)))

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
