"""Rows of many devices at once by what each needs, ``q = -1/G``, on a grid of frequencies.

A row ends at its first crossing: the smallest K > 0 at which a pole reaches the unit circle, from K -> 0+, where it is
stable for all B below the first that puts a pole on the circle there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zwidth.words.types import Array

# Dampings of a column, as shares of its end, then refined so often.
_DAMPINGS, _REFINED, _TIMES = 33, 9, 3


@dataclass(frozen=True)
class DeviceRows:
    """Devices with ``needed`` q in N/m, a row each over frequencies, and F/T in 1/s, a row for all or for each."""

    needed: Array
    velocity: Array

    @cached_property
    def ends(self) -> np.ndarray:
        """Up to which damping soft walls are stable; inf where that is nowhere."""
        return _cross_first(self.needed * self.velocity.conj(), self.needed / self.velocity)

    def row_ends(self, virtual_damping: np.ndarray) -> np.ndarray:
        """Up to which stiffness every softer wall is stable, at one damping or at one for each device."""
        wall = self.needed - np.reshape(virtual_damping, (-1, 1)) * self.velocity
        ends = _cross_first(wall, wall)
        # A slower crossing than the grid's slowest, or no end at all, is not believed.
        real = (wall.imag[:, 0] < 0) & (virtual_damping < self.ends) & np.isfinite(ends)
        return np.where(real, ends, 0.0)

    def stiffest(self) -> np.ndarray:
        """K_max of each device, of walls with B >= 0 alone."""
        return find_highest(self.row_ends, np.where(np.isfinite(self.ends), self.ends, 0.0))[0]


def find_highest(limit: Callable[[np.ndarray], np.ndarray], top: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The highest limits over dampings from 0 to ``top``, and these dampings, all elementwise."""
    middle = width = limits = 0.5 * top
    for count in (_DAMPINGS, *_TIMES * [_REFINED]):
        tried = np.clip(middle + width * np.linspace(-1.0, 1.0, count)[:, None], 0.0, top)
        limits = np.array([limit(damping) for damping in tried])
        middle = np.take_along_axis(tried, limits.argmax(0)[None], 0)[0]
        width = 2.0 * width / (count - 1)
    return limits.max(0), middle


@np.errstate(all="ignore")
def _cross_first(turning: Array, value: Array) -> np.ndarray:
    """The smallest real part > 0 of ``value`` where ``turning`` is real; inf where there is none."""
    left, right = turning.imag[:, :-1], turning.imag[:, 1:]
    share = np.where(left == right, 0.0, left / (left - right))
    between = value.real[:, :-1] + share * (value.real[:, 1:] - value.real[:, :-1])
    crossed = (left * right <= 0) & (between > 0)
    first = np.where(crossed, between, np.inf).min(1)
    last = value.real[:, -1]
    return np.where((last > 0) & np.isfinite(last), np.minimum(first, last), first)
