"""Errors of encoder positions, and the covariance of estimates from such positions.

An encoder with step q returns q round(y/q) with y = x + n, the position x and noise n of standard deviation sigma. Its
error e is a sawtooth function of y. Averaged over the unknown zero of the encoder, two samples have the covariance

    E[e_i e_k] = sum_h w_h cos(2 pi h (x_i - x_k)/q),    w_h = q^2/(2 pi^2 h^2) exp(-(2 pi h sigma/q)^2),

so the errors of a slow motion are autocorrelated. Averaged over the zero, e is not correlated with n; therefore the
variance of one sample is sigma^2 + q^2/12.

At rest, all samples have the same error. Least squares with independent errors would fit this error. Therefore the mean
of each stretch within one step is weighted by its own variance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

# Fourier series of the covariance.
_WAVES = 40  # terms h that are computed; the rest, about 1.5 % of q^2/12, counts as white noise
_MIN_WEIGHT = 1e-6  # smallest weight w_h, relative to the variance of a sample; the series ends there
# Detection of the step, of which all positions are integer multiples except for a common offset.
_MAX_OFFSET = 0.02  # largest distance of a position from a multiple, in steps
_MAX_ROUNDING_OFFSET = 1e-4  # the same for the rounding step of a column, with rounding errors of float64 only
_ROUNDINGS = 5.0  # least encoder step, in rounding steps of the column; finer ones are not distinguished from these
_MAX_STEPS = 1e7  # largest range of positions, in steps
_CHANCE = 1e-6  # largest probability that random positions are as close to multiples
_PICKS = 100  # positions that refine the estimate of a step


def find_steps(position: np.ndarray) -> tuple[float, float]:
    """Return the encoder step and the rounding step of the column; 0 for a step that does not exist.

    An angle printed in degrees with three decimals has the rounding step 0.001 deg. Both steps are equal if the column
    contains encoder counts.
    """
    values = np.unique(position)
    # Subtracting a common offset leaves errors of the size of the spacing of float64.
    error = 16.0 * float(np.spacing(np.abs(values).max()))
    column = _find_lattice(values, _MAX_ROUNDING_OFFSET, error)
    return _find_lattice(values, _MAX_OFFSET, max(column, error)) or column, column


def find_resolution(position: np.ndarray) -> float:
    """Return the encoder step, of which all positions are integer multiples except for a common offset; 0 if none."""
    return find_steps(position)[0]


def _find_lattice(values: np.ndarray, off: float, slack: float) -> float:
    """Return the largest step of which all values are integer multiples, except for a common offset; 0 if none.

    Applies Euclid's algorithm to the differences of neighboring values, with tolerances.

    Args:
        values: sorted positions without duplicates.
        off: largest distance of a value from a multiple, in steps.
        slack: largest distance in SI units, if larger than ``off`` steps. Steps below ``_ROUNDINGS * slack`` are not
            searched for.
    """
    gaps = np.diff(values)
    if gaps.size < 2:
        return float(gaps.sum())
    gaps = gaps[gaps > 2.0 * slack]  # smaller gaps are rounding errors of equal positions
    span, rest = float(np.ptp(values)), gaps
    picks = (values - values[0])[np.unique(np.geomspace(1, values.size - 1, _PICKS).astype(int))]
    while rest.size and span <= _MAX_STEPS * (least := float(rest.min())) and least >= (_ROUNDINGS - 1.0) * slack:
        step = smallest = float(np.mean(rest[rest <= least + 2.0 * slack]))
        # Refine the step from distances of n steps in ascending order: their rounding error is divided by n, but n is
        # known only if the step is accurate enough.
        for distance in picks.tolist():
            step = distance / max(1.0, np.round(distance / step))
        chance = (2.0 * max(off, slack / step)) ** (values.size - 1)
        if step >= _ROUNDINGS * slack and chance < _CHANCE and fits_steps(values, step, off, slack):
            return step
        rest = np.abs(gaps - smallest * np.round(gaps / smallest))
        rest = rest[rest > max(off * smallest, slack)]
    return 0.0


def fits_steps(position: np.ndarray, step: float, off: float = _MAX_OFFSET, slack: float = 0.0) -> bool:
    """Return whether positions are integer multiples of a step, except for a common offset."""
    ratios = (position - position[0]) / step
    return bool(np.all(np.abs(ratios - np.round(ratios)) <= max(off, slack / step)))


@dataclass(frozen=True)
class MeasurementNoise:
    """Noise of logged positions: white noise plus the quantization error of an encoder."""

    position: np.ndarray  # x of each sample
    variance: float  # of a sample, sigma^2 + q^2/12
    resolution: float  # encoder step q; 0 for white noise only

    @cached_property
    def _rests(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The stretches within one encoder step whose mean has a larger variance than that of white noise.

        Four arrays: indices of the samples of all these stretches; and for each stretch its offset in that array, its
        number of samples, and the variance of its mean divided by that of white noise.
        """
        starts, first = [], np.inf
        for k, place in enumerate(self.position.tolist()):
            if not abs(place - first) < self.resolution:
                starts.append(k)
                first = place
        sizes = np.diff([*starts, self.position.size])
        inflation = np.ones(sizes.size)
        for wave, weight in self._waves():
            inflation += weight / self.variance * (np.abs(np.add.reduceat(wave, starts)) ** 2 / sizes - 1.0)
        kept = sizes[inflation > 1.0]
        return (
            np.flatnonzero(np.repeat(inflation > 1.0, sizes)),
            np.cumsum(kept) - kept,
            kept,
            inflation[inflation > 1.0],
        )

    @property
    def count(self) -> int:
        """Number of samples of white noise with the same expected sum of squares as the weighted samples."""
        return int(self.position.size + np.sum(1.0 - self._rests[-1]))

    def weigh(self, columns: np.ndarray) -> np.ndarray:
        """Return columns over samples, with the mean of each stretch of `_rests` scaled to white noise."""
        rows, starts, sizes, inflation = self._rests
        if not rows.size:
            return columns
        weighed, removed = columns.copy(), (1.0 - inflation**-0.5) / sizes
        weighed[rows] -= np.repeat((np.add.reduceat(columns[rows], starts).T * removed).T, sizes, axis=0)
        return weighed

    def spread(self, columns: np.ndarray) -> np.ndarray:
        """Return ``J^T C J`` for columns J, with the covariance C of the samples."""
        white = columns.T @ columns
        total = self.variance * white
        for wave, weight in self._waves():
            projection = columns.T @ wave
            total = total + weight * (np.real(np.outer(projection, projection.conj())) - white)
        return total

    def spread_each(self, columns: np.ndarray) -> np.ndarray:
        """Return the diagonal of `spread`."""
        white = np.sum(columns**2, 0)
        total = self.variance * white
        for wave, weight in self._waves():
            # Use real and imaginary parts, because a complex product would convert the columns to complex numbers.
            total = total + weight * (np.sum((columns.T @ wave.view(float).reshape(-1, 2)) ** 2, 1) - white)
        return total

    def spread_of_sums(self, count: int, weights: MeasurementNoise) -> float:
        """Return the mean square of sums of ``count`` neighboring samples, after they are weighted by ``weights``."""
        starts = np.arange(0, self.position.size - count + 1, count)
        total = self.variance * count
        for wave, weight in self._waves():
            sums = np.add.reduceat(weights.weigh(wave)[: starts[-1] + count], starts)
            total += weight * (float(np.mean(np.abs(sums) ** 2)) - count)
        return total

    def _waves(self) -> Iterator[tuple[np.ndarray, float]]:
        """Yield ``e^(2 pi j h x/q)`` and w_h for h = 1, 2, ... until w_h is negligible."""
        if not self.resolution:
            return
        sigma = np.sqrt(max(0.0, self.variance / self.resolution**2 - 1.0 / 12.0))
        fundamental = np.exp(2j * np.pi * (self.position / self.resolution))
        wave = np.ones_like(fundamental)
        for h in range(1, _WAVES + 1):
            wave = wave * fundamental
            weight = self.resolution**2 / (2.0 * (np.pi * h) ** 2) * np.exp(-((2.0 * np.pi * h * sigma) ** 2))
            if weight < _MIN_WEIGHT * self.variance:
                return
            yield wave, float(weight)
