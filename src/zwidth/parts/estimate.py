"""The velocity estimate as a transfer function, for T = 1: what every kind of estimate becomes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zwidth.arrays.circle import CirclePoints, Jet, lag_jet, product_jet
from zwidth.arrays.xp import namespace


def _no_roots() -> np.ndarray:
    return np.zeros(0, complex)


@dataclass(frozen=True)
class Estimate:
    """The velocity estimate F: a difference over ``window`` periods, then a filter.

    ``F(z) = gain prod(z - zeros)/(z^lag prod(z - poles)) (1 - z^-window)/window``, without the last factor for a window
    of 0.
    """

    window: int = 1
    gain: Any = 1.0
    lag: int = 0
    zeros: Any = field(default_factory=_no_roots)
    poles: Any = field(default_factory=_no_roots)

    def jet(self, at: CirclePoints) -> Jet:
        """F and its derivative in w."""
        xp = namespace(at.w)
        parts = product_jet(at, self.zeros, self.gain)
        if self.poles.size:
            parts = parts.over(product_jet(at, self.poles, 1.0))
        if self.lag:
            parts = parts.times(lag_jet(at, -self.lag))
        if self.window:
            back = lag_jet(at, -self.window)
            n = self.window
            s = xp.sin(0.5 * n * at.w)
            value = xp.where(at.w >= np.pi, 1.0 - back.value, 2.0 * s * s - 1j * back.value.imag) / n
            parts = parts.times(Jet(value, -back.slope / n))
        return parts

    @property
    def degree(self) -> int:
        """By how much the estimate turns in all, a bound for how fast it varies."""
        return self.window + abs(self.lag) + self.zeros.size + self.poles.size
