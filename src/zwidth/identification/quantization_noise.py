"""Model the errors of encoder positions, and compute the covariance of estimates from such positions.

An encoder with step q returns q round(y/q) with y = x + n, the position x and noise n of standard deviation sigma. Its
error e is a sawtooth function of y. Averaged over the unknown zero of the encoder, samples i and k have the covariance

    E[e_i e_k] = sum_h w_h cos(2 pi h (x_i - x_k)/q),    w_h = q^2/(2 pi^2 h^2) exp(-(2 pi h sigma/q)^2),

so the errors of a slow motion are autocorrelated. In the same average, e is not correlated with n; therefore the
variance of one sample is sigma^2 + q^2/12.

At rest, all samples have the same error, and ordinary least squares would fit this error as if it were motion.
Therefore the positions are divided into *stretches* whose motion is shorter than one encoder step, and the mean of
each stretch is weighted according to its variance.

The *rounding step* of a column is the resolution to which its numbers were rounded when the log was written.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

# Truncation of the Fourier series of the covariance.
_WAVES = 40  # number of terms h; the omitted ones, about 1.5 % of q^2/12, are treated as white noise
_MIN_WEIGHT = 1e-6  # smallest w_h that is included, relative to the variance of a sample
# Constants of the detection of the encoder step. Positions are integer multiples of it, plus a common offset.
_MAX_OFFSET = 0.02  # largest distance of a position from an integer multiple of the encoder step, in steps
# Largest distance of a number from an integer multiple of the rounding step, in rounding steps. It is smaller than
# `_MAX_OFFSET`, because only rounding errors of float64 contribute to it.
_MAX_ROUNDING_OFFSET = 1e-4
# Least encoder step that is detected, in rounding steps of the column. Smaller encoder steps are hidden by the
# rounding.
_ROUNDINGS = 5.0
_MAX_STEPS = 1e7  # largest range of the positions for which a step is accepted, in steps
_CHANCE = 1e-6  # largest probability, for an accepted step, that random positions are as close to its multiples
_PICKS = 100  # number of positions with which the estimate of a step is refined


def find_steps(position: np.ndarray) -> tuple[float, float]:
    """Detect the encoder step of logged positions and the rounding step of their column; 0 for a step not detected.

    For example, a column of angles printed in degrees with three decimals has the rounding step 0.001 deg. If the
    column contains encoder counts, both steps are equal.
    """
    values = np.unique(position)
    # Tolerate errors of this size, because the subtraction of the common offset from the positions causes rounding
    # errors.
    error = 16.0 * float(np.spacing(np.abs(values).max()))
    column = _find_lattice(values, _MAX_ROUNDING_OFFSET, error)
    return _find_lattice(values, _MAX_OFFSET, max(column, error)) or column, column


def find_resolution(position: np.ndarray) -> float:
    """Detect the encoder step: the largest step of which all positions are integer multiples, up to a common offset.

    The result is 0 if no such step exists.
    """
    return find_steps(position)[0]


def _find_lattice(values: np.ndarray, off: float, slack: float) -> float:
    """Return the largest step such that all values are integer multiples of it plus a common offset; 0 if none exists.

    The method is Euclid's algorithm with tolerances, applied to the differences of neighboring values.

    Args:
        values: sorted positions without duplicates.
        off: largest allowed distance of a value from a multiple, in steps.
        slack: largest allowed distance in SI units, used if it is larger than ``off`` steps. Steps below
            ``_ROUNDINGS * slack`` are not searched for.
    """
    gaps = np.diff(values)
    if gaps.size < 2:
        return float(gaps.sum())
    gaps = gaps[gaps > 2.0 * slack]  # omit smaller differences, because they are rounding errors of equal positions
    span, rest = float(np.ptp(values)), gaps
    picks = (values - values[0])[np.unique(np.geomspace(1, values.size - 1, _PICKS).astype(int))]
    while rest.size and span <= _MAX_STEPS * (least := float(rest.min())) and least >= (_ROUNDINGS - 1.0) * slack:
        step = smallest = float(np.mean(rest[rest <= least + 2.0 * slack]))
        # Refine the step by distances between values that are n steps apart: the error of distance/n decreases with n.
        # Use the distances in ascending order, because a larger n requires a more accurate step.
        for distance in picks.tolist():
            step = distance / max(1.0, np.round(distance / step))
        chance = (2.0 * max(off, slack / step)) ** (values.size - 1)
        if step >= _ROUNDINGS * slack and chance < _CHANCE and fits_steps(values, step, off, slack):
            return step
        rest = np.abs(gaps - smallest * np.round(gaps / smallest))
        rest = rest[rest > max(off * smallest, slack)]
    return 0.0


def fits_steps(position: np.ndarray, step: float, off: float = _MAX_OFFSET, slack: float = 0.0) -> bool:
    """Return whether all positions are integer multiples of a step plus a common offset, within a tolerance.

    Args:
        position: the positions.
        step: step to test, in the same unit.
        off: tolerance in steps.
        slack: tolerance in the unit of the positions, used if it is larger.
    """
    ratios = (position - position[0]) / step
    return bool(np.all(np.abs(ratios - np.round(ratios)) <= max(off, slack / step)))


@dataclass(frozen=True)
class MeasurementNoise:
    """Model of the noise of logged positions: white noise plus the quantization error of an encoder."""

    position: np.ndarray  # position x of each sample
    variance: float  # variance of the error of one sample, sigma^2 + q^2/12
    resolution: float  # encoder step q; 0 if the noise is only white noise

    @cached_property
    def _rests(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The stretches whose mean has a larger variance than it would have with white noise, as four arrays.

        The four arrays are: the sample indices of all these stretches, joined; and for each stretch the offset in the
        first array, the number of samples, and the variance of its mean divided by that with white noise.
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
        """The effective number of samples: the expected sum of squared weighted errors, divided by ``variance``."""
        return int(self.position.size + np.sum(1.0 - self._rests[-1]))

    def weigh(self, columns: np.ndarray) -> np.ndarray:
        """Weight an array with one row per sample: scale the mean of each stretch to the variance of white noise.

        Deviations from the mean of a stretch do not change.
        """
        rows, starts, sizes, inflation = self._rests
        if not rows.size:
            return columns
        weighed, removed = columns.copy(), (1.0 - inflation**-0.5) / sizes
        weighed[rows] -= np.repeat((np.add.reduceat(columns[rows], starts).T * removed).T, sizes, axis=0)
        return weighed

    def spread(self, columns: np.ndarray) -> np.ndarray:
        """Return the covariance ``J^T C J`` of linear combinations of the errors, with coefficients J and covariance C.

        Args:
            columns: the matrix J, one row per sample and one column per linear combination.
        """
        white = columns.T @ columns
        total = self.variance * white
        for wave, weight in self._waves():
            projection = columns.T @ wave
            total = total + weight * (np.real(np.outer(projection, projection.conj())) - white)
        return total

    def spread_each(self, columns: np.ndarray) -> np.ndarray:
        """Return the variances of linear combinations of the errors, without computing their covariances."""
        white = np.sum(columns**2, 0)
        total = self.variance * white
        for wave, weight in self._waves():
            # Multiply by the real and imaginary parts separately, because a complex product would copy the real columns
            # to a complex array of twice the size.
            total = total + weight * (np.sum((columns.T @ wave.view(float).reshape(-1, 2)) ** 2, 1) - white)
        return total

    def spread_of_sums(self, count: int, weights: MeasurementNoise) -> float:
        """Return the expected square of the sum of ``count`` successive errors, averaged over a log.

        Args:
            count: number of errors per sum.
            weights: noise model whose `weigh` weights the errors before they are added.
        """
        starts = np.arange(0, self.position.size - count + 1, count)
        total = self.variance * count
        for wave, weight in self._waves():
            sums = np.add.reduceat(weights.weigh(wave)[: starts[-1] + count], starts)
            total += weight * (float(np.mean(np.abs(sums) ** 2)) - count)
        return total

    def _waves(self) -> Iterator[tuple[np.ndarray, float]]:
        """Yield the terms of the Fourier series of the covariance: ``e^(2 pi j h x/q)`` and w_h.

        The terms are h = 1, 2, ... until w_h is negligible.
        """
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
