"""Compute the stability limits of walls on a batch of devices, on a grid of frequencies.

A wall with stiffness K and damping B has a closed-loop pole at a point z of the unit circle if and only if ``K + B
F(z)/T = q(z)``, with the critical controller q of the device (`plant.sampled_plant`), the velocity estimate F and the
sampling period T. K_max is the largest stable K.

On a line of constant B, the stability limit is the smallest K > 0 with a pole on the unit circle (the first crossing),
provided that the walls with K -> 0+ are stable. They are stable for all B > 0 below the smallest B with a pole on the
circle at K = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zwidth.core.types import Array

# Constants of the maximization over B (`find_highest`), on a grid that is repeatedly refined around its best point.
_DAMPINGS = 33  # number of values of B on the first grid
_REFINED = 9  # number of values of B on each refined grid
_TIMES = 3  # number of refinements of the grid


@dataclass(frozen=True)
class GridLimits:
    """Stability limits of a batch of devices for walls with B >= 0, computed on a grid of ascending frequencies."""

    critical: Array  # critical controller q in N/m, one row per device and one column per frequency
    velocity: Array  # velocity estimate F/T in 1/s, one row for all devices or one row per device

    @cached_property
    def damping_limits(self) -> np.ndarray:
        """Limit of B for each device, below which all walls with K -> 0+ are stable; infinite if no limit exists."""
        return _cross_first(self.critical * self.velocity.conj(), self.critical / self.velocity)

    def limit_stiffness(self, virtual_damping: np.ndarray) -> np.ndarray:
        """Return, for each device, the K below which all walls with a given B are stable; 0 if no such wall is stable.

        Args:
            virtual_damping: B, one value for all devices or one per device.
        """
        stiffness = self.critical - np.reshape(virtual_damping, (-1, 1)) * self.velocity
        limits = _cross_first(stiffness, stiffness)
        # Set the limit to 0 if it is infinite, if walls with K -> 0+ are unstable, or if the first crossing may be
        # below the lowest frequency of the grid.
        valid = (stiffness.imag[:, 0] < 0) & (virtual_damping < self.damping_limits) & np.isfinite(limits)
        return np.where(valid, limits, 0.0)

    def find_stiffness_max(self) -> np.ndarray:
        """Return K_max of each device, the largest stability limit over all B >= 0."""
        limits = self.damping_limits
        return find_highest(self.limit_stiffness, np.where(np.isfinite(limits), limits, 0.0))[0]


def find_highest(limit: Callable[[np.ndarray], np.ndarray], top: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maximize a function of B over 0 <= B <= ``top`` for each device of a batch, on a grid that is refined repeatedly.

    Args:
        limit: function that returns one value per device for an array of one B per device.
        top: largest B of each device.

    Returns:
        The maxima, and the B of each maximum.
    """
    middle = width = limits = 0.5 * top
    for count in (_DAMPINGS, *_TIMES * [_REFINED]):
        tried = np.clip(middle + width * np.linspace(-1.0, 1.0, count)[:, None], 0.0, top)
        limits = np.array([limit(damping) for damping in tried])
        middle = np.take_along_axis(tried, limits.argmax(0)[None], 0)[0]
        width = 2.0 * width / (count - 1)
    return limits.max(0), middle


@np.errstate(all="ignore")
def _cross_first(criterion: Array, value: Array) -> np.ndarray:
    """Return the smallest positive Re(``value``) at the frequencies at which Im(``criterion``) crosses zero.

    Rows are devices and columns frequencies. Both arrays are interpolated linearly between neighboring frequencies. At
    the last frequency, ``criterion`` is treated as real, because this frequency is at or near z = -1.

    Returns:
        One value per device; infinite if no such frequency exists.
    """
    left, right = criterion.imag[:, :-1], criterion.imag[:, 1:]
    share = np.where(left == right, 0.0, left / (left - right))
    between = value.real[:, :-1] + share * (value.real[:, 1:] - value.real[:, :-1])
    crossed = (left * right <= 0) & (between > 0)
    first = np.where(crossed, between, np.inf).min(1)
    last = value.real[:, -1]
    return np.where((last > 0) & np.isfinite(last), np.minimum(first, last), first)
