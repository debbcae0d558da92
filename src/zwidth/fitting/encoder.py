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
# Lattices of positions.
_OFF = 0.02  # largest distance of a position from whole steps, in steps
_EXACT = 1e-4  # the same for a column that is rounded to whole steps, which leaves only rounding errors of float64
_ROUNDINGS = 5.0  # least encoder step, in steps of the rounded column; finer ones are not distinguished from it
_MOST = 1e7  # largest range of positions, in steps
_CHANCE = 1e-6  # largest probability that positions which are no whole steps look like ones
_PICKS = 100  # positions that refine a step


def find_steps(position: np.ndarray) -> tuple[float, float]:
    """Return the encoder step and the step of the column, as of an angle in degrees with three decimals.

    Both are equal if the column has encoder counts; 0 if there is no such step.
    """
    values = np.unique(position)
    # Subtracting a common offset leaves errors of the size of the spacing of float64.
    error = 16.0 * float(np.spacing(np.abs(values).max()))
    column = _find_lattice(values, _EXACT, error)
    return _find_lattice(values, _OFF, max(column, error)) or column, column


def find_resolution(position: np.ndarray) -> float:
    """Return the encoder step, of which all positions are whole multiples except for a common offset; 0 if none."""
    return find_steps(position)[0]


def _find_lattice(values: np.ndarray, off: float, slack: float) -> float:
    """Return the largest step whose whole multiples are all values, 0 if there is none, by Euclid's algorithm.

    Args:
        values: positions, sorted, each once.
        off: largest distance of a value from a whole multiple, in steps.
        slack: largest distance in SI units, if that is more; steps below ``_ROUNDINGS`` times of it do not count.
    """
    gaps = np.diff(values)
    if gaps.size < 2:
        return float(gaps.sum())
    gaps = gaps[gaps > 2.0 * slack]  # smaller ones are rounding errors of equal positions
    span, rest = float(np.ptp(values)), gaps
    picks = (values - values[0])[np.unique(np.geomspace(1, values.size - 1, _PICKS).astype(int))]
    while rest.size and span <= _MOST * (least := float(rest.min())) and least >= (_ROUNDINGS - 1.0) * slack:
        step = smallest = float(np.mean(rest[rest <= least + 2.0 * slack]))
        # Refine by ever larger distances, because rounding errors of small ones are large relative to them.
        for way in picks.tolist():
            step = way / max(1.0, np.round(way / step))
        chance = (2.0 * max(off, slack / step)) ** (values.size - 1)
        if step >= _ROUNDINGS * slack and chance < _CHANCE and fits_steps(values, step, off, slack):
            return step
        rest = np.abs(gaps - smallest * np.round(gaps / smallest))
        rest = rest[rest > max(off * smallest, slack)]
    return 0.0


def fits_steps(position: np.ndarray, step: float, off: float = _OFF, slack: float = 0.0) -> bool:
    """Return whether positions are whole multiples of a step, except for a common offset."""
    ratios = (position - position[0]) / step
    return bool(np.all(np.abs(ratios - np.round(ratios)) <= max(off, slack / step)))


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
