"""A loop by its roots, on the unit circle (any loop): what its device answers, what its velocity estimate answers.

Normalized to T = 1 and m = 1, the loop of a wall is affine in (alpha, beta),

    P(z) = D + alpha N1 + beta N2 = 0   exactly where   alpha + beta F(z) = q(z) = -1/G(z)

with G from the wall's force to the sampled position and F from position to the velocity estimate. Roots are kept by
their offsets ``1 - root``: next to z = 1, where slow loops live, a root itself has lost its digits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zwidth.arrays.circle import ON_CIRCLE, CirclePoints, Jet, circle, depths, lag_jet, product_jet
from zwidth.parts.estimate import Estimate
from zwidth.words.types import Array


@dataclass(frozen=True)
class LoopRoots:
    """A loop without its wall: ``G(z) = gain prod(z - zeros)/(z^lag prod(z - poles))`` and the velocity estimate F."""

    gain: float
    lag: int
    zeros: Array
    poles: Array
    estimate: Estimate

    def required_wall(self, at: CirclePoints) -> Jet:
        """``q = -1/G``: what the wall must answer to put a pole at z."""
        over = product_jet(at, self.poles, -1.0).over(product_jet(at, self.zeros, self.gain))
        return over.times(lag_jet(at, self.lag))

    def response(self, at: CirclePoints) -> Jet:
        """G: the sampled position that the wall's force leads to."""
        over = product_jet(at, self.zeros, self.gain).over(product_jet(at, self.poles, 1.0))
        return over.times(lag_jet(at, -self.lag))

    @property
    def order(self) -> int:
        """How many poles the loop with a wall that has damping has."""
        f = self.estimate
        return self.poles.size + self.lag + f.poles.size + max(f.window + f.lag, 0)

    def turning(self, w: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """How fast q and F vary at most within ``reach`` of w, relative to themselves."""
        before = circle(w).before[..., None]
        roots = np.concatenate([self.poles, self.zeros, self.estimate.poles, self.estimate.zeros])
        far = np.abs(before + roots) - reach[..., None]
        # A factor of a root on the circle changes its size there, not its argument: no need to look closer.
        depth = np.abs(depths(roots))
        floor = np.where(depth > ON_CIRCLE, 0.5 * depth, np.where(roots == 0, 1e-9, 1e-5))
        near = (1.0 / np.maximum(far, floor)).sum(-1)
        return near + abs(self.lag) + self.estimate.window + abs(self.estimate.lag) + 1.0
