"""Factored form of a linear velocity or position estimate F(z): gain, zeros, poles and a difference of two samples.

F is the transfer function from the measured position to the estimate, for the sampling period T = 1. Zeros and poles
are stored as *offsets* ``1 - root``, which are accurate for roots near z = 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from zwidth.core.xp import namespace
from zwidth.model.circle_functions import CirclePoints, Jet, power_jet, product_jet


@dataclass(frozen=True)
class Estimate:
    """A linear estimate F for T = 1: a difference over ``window`` periods, followed by a filter.

    ``F(z) = gain prod(z - z_i)/(z^lag prod(z - p_i)) (1 - z^-window)/window`` with zeros z_i and poles p_i. The last
    factor is omitted for a window of 0.
    """

    window: int = 1  # length of the difference in periods; 0: no difference
    gain: Any = 1.0
    lag: int = 0  # number of poles at z = 0; if negative, number of zeros at z = 0
    zeros: Any = field(default_factory=lambda: np.zeros(0, complex))  # offsets 1 - z_i of the zeros
    poles: Any = field(default_factory=lambda: np.zeros(0, complex))  # offsets 1 - p_i of the poles

    def jet(self, points: CirclePoints) -> Jet:
        """Return F and its derivative with respect to the angle w, at points e^(jw) of the unit circle."""
        xp = namespace(points.w)
        product = product_jet(points, self.zeros, self.gain)
        if self.poles.size:
            product = product.over(product_jet(points, self.poles, 1.0))
        if self.lag:
            product = product.times(power_jet(points, -self.lag))
        if self.window:
            delayed = power_jet(points, -self.window)
            n = self.window
            s = xp.sin(0.5 * n * points.w)
            # Compute the real part 1 - cos(n w) as 2 sin^2(n w/2), because the difference loses digits for small w.
            value = xp.where(points.w >= np.pi, 1.0 - delayed.value, 2.0 * s * s - 1j * delayed.value.imag) / n
            product = product.times(Jet(value, -delayed.slope / n))
        return product

    def list_window_zeros(self) -> np.ndarray:
        """Return the offsets 1 - z of the zeros of (z^n - 1)/(z - 1), for a window of n periods.

        These zeros are the n-th roots of 1, except z = 1.
        """
        angles = 2.0 * np.pi * np.arange(1, self.window) / max(self.window, 1)
        # Set the offset of z = -1 to exactly 2, so that it equals the offset of a zero of the device at z = -1.
        return np.where(angles == np.pi, 2.0, -2j * np.sin(0.5 * angles) * np.exp(0.5j * angles))

    @property
    def is_difference(self) -> bool:
        """True if the estimate is the difference of two successive samples, multiplied by a gain."""
        window = self.window == 1 and not self.lag and not np.size(self.zeros) and not np.size(self.poles)
        coefficients = not self.window and self.lag == 1 and not np.size(self.poles)
        return window or (coefficients and np.size(self.zeros) == 1 and bool(np.all(np.equal(self.zeros, 0))))

    @property
    def degree(self) -> int:
        """Sum of window, abs(lag), number of zeros and number of poles; equals ``window`` if there is no filter."""
        return self.window + abs(self.lag) + self.zeros.size + self.poles.size
