"""What an encoder adds to a position, and how far estimates are off for it.

An encoder of the step q reads q round(y/q) of y = x + n, n noise of the deviation sigma. Its error is a saw of y: over
the unknown zero of the encoder, errors of two samples correlate as

    E[e_i e_k] = sum_h w_h cos(2 pi h (x_i - x_k)/q),    w_h = q^2/(2 pi^2 h^2) exp(-(2 pi h sigma/q)^2),

so samples of a slow motion err alike. Neither knows of n, so that the variance of a sample is sigma^2 + q^2/12.

Samples of a rest all err the same: least squares that took them for thousands of errors would follow that one. So the
mean of a stretch that stays within a step counts by its own variance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

# Waves of the saw that are followed; the others are taken for white, 1.6 % of its variance.
_WAVES, _LEAST = 40, 1e-6
# How far positions may lie from whole steps, as a share of a step, and how many steps to a whole log at the most.
_OFF, _MOST = 0.02, 1e7


def find_resolution(position: np.ndarray) -> float:
    """The step that all positions are whole numbers of, but for a common offset; 0 where there is none."""
    ways = np.sort(np.diff(np.unique(position)))
    if ways.size < 2:
        return float(ways.sum())
    span, rest = float(np.ptp(position)), ways[:1]
    # Euclid's: what the smallest way leaves of the others, and what that leaves.
    while rest.size and span <= _MOST * rest.min():
        step = smallest = float(rest.min())
        # The smallest way is the least sure one: by ever longer ones.
        for way in [*ways[:: max(1, ways.size // 50)].tolist(), span]:
            step = way / max(1.0, np.round(way / step))
        if fits_steps(position, step):
            return step
        rest = np.abs(ways - smallest * np.round(ways / smallest))
        rest = rest[rest > _OFF * smallest]
    return 0.0


def fits_steps(position: np.ndarray, step: float) -> bool:
    """Whether positions are whole numbers of a step, but for a common offset."""
    ratios = (position - position[0]) / step
    return bool(np.all(np.abs(ratios - np.round(ratios)) <= _OFF))


@dataclass(frozen=True)
class MeasurementNoise:
    """Of positions that are where ``position`` says, of this variance a sample, read with steps of ``resolution``."""

    position: np.ndarray
    variance: float
    resolution: float

    @cached_property
    def _rests(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Samples of stretches within a step that err alike; where among them each begins, and how many it has."""
        # Last, how many times white noise's variance their means have.
        starts, first = [], np.inf
        for k, place in enumerate(self.position.tolist()):
            if not abs(place - first) < self.resolution:
                starts.append(k)
                first = place
        sizes = np.diff([*starts, self.position.size])
        alike = np.ones(sizes.size)
        for wave, weight in self._waves():
            alike += weight / self.variance * (np.abs(np.add.reduceat(wave, starts)) ** 2 / sizes - 1.0)
        few = sizes[alike > 1.0]
        return np.flatnonzero(np.repeat(alike > 1.0, sizes)), np.cumsum(few) - few, few, alike[alike > 1.0]

    @property
    def count(self) -> int:
        """How many samples of white noise have squares as large as these, weighed."""
        return int(self.position.size + np.sum(1.0 - self._rests[-1]))

    def weigh(self, columns: np.ndarray) -> np.ndarray:
        """Columns over samples in which the mean of every stretch is so small that it counts by its own variance."""
        rows, starts, sizes, alike = self._rests
        if not rows.size:
            return columns
        weighed, beyond = columns.copy(), (1.0 - alike**-0.5) / sizes
        weighed[rows] -= np.repeat((np.add.reduceat(columns[rows], starts).T * beyond).T, sizes, axis=0)
        return weighed

    def spread(self, slopes: np.ndarray) -> np.ndarray:
        """``J^T C J`` for columns J, with C the covariance of the samples."""
        plain = slopes.T @ slopes
        total = self.variance * plain
        for wave, weight in self._waves():
            along = slopes.T @ wave
            total = total + weight * (np.real(np.outer(along, along.conj())) - plain)
        return total

    def spread_each(self, columns: np.ndarray) -> np.ndarray:
        """The diagonal of `spread`."""
        plain = np.sum(columns**2, 0)
        total = self.variance * plain
        for wave, weight in self._waves():
            # Real and imaginary parts, for a product with complex numbers would copy the columns as such.
            total = total + weight * (np.sum((columns.T @ wave.view(float).reshape(-1, 2)) ** 2, 1) - plain)
        return total

    def spread_of_sums(self, count: int, weights: MeasurementNoise) -> float:
        """The mean square of sums of ``count`` neighbors, weighed as those of other positions would be."""
        starts = np.arange(0, self.position.size - count + 1, count)
        total = self.variance * count
        for wave, weight in self._waves():
            sums = np.add.reduceat(weights.weigh(wave)[: starts[-1] + count], starts)
            total += weight * (float(np.mean(np.abs(sums) ** 2)) - count)
        return total

    def _waves(self) -> Iterator[tuple[np.ndarray, float]]:
        """``e^(2 pi j h x/q)`` and w_h, as long as they count."""
        if not self.resolution:
            return
        sigma = np.sqrt(max(0.0, self.variance / self.resolution**2 - 1.0 / 12.0))
        turn = np.exp(2j * np.pi * (self.position / self.resolution))
        wave = np.ones_like(turn)
        for h in range(1, _WAVES + 1):
            wave = wave * turn
            weight = self.resolution**2 / (2.0 * (np.pi * h) ** 2) * np.exp(-((2.0 * np.pi * h * sigma) ** 2))
            if weight < _LEAST * self.variance:
                return
            yield wave, float(weight)
