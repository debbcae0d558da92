"""A loop by its roots and as polynomials (any loop): what its device answers, what its velocity estimate answers.

Normalized to T = 1 and m = 1, the loop of a wall is affine in (alpha, beta),

    P(z) = D + alpha N1 + beta N2 = 0   exactly where   alpha + beta F(z) = q(z) = -1/G(z)

with G from the wall's force to the sampled position and F from position to the velocity estimate. Roots are kept by
their offsets ``1 - root``: next to z = 1, where slow loops live, a root itself has lost its digits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from math import gcd

import numpy as np

from zwidth.arrays.polynomials import Affine
from zwidth.parts.circle import CirclePoints, Jet, are_on_circle, circle, depths, lag_jet, product_jet
from zwidth.parts.velocity import Estimate
from zwidth.words.types import Array

# Of the largest coefficient: a power with less of it is not there.
_NO_TERM = 1e-12


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

    @property
    def device_is_unstable(self) -> bool:
        """True if the device has a pole outside the unit circle without a wall."""
        return bool(np.any((depths(self.poles) < 0) & ~are_on_circle(self.poles)))

    def as_damper(self) -> LoopRoots | None:
        """Return the loop at K = 0, with the damping B as its gain in place of K.

        A pole of the device at z = 1 cancels against the zero of the velocity estimate there. Return None if either
        does not exist.
        """
        f = self.estimate
        free, still = np.flatnonzero(self.poles == 0), np.flatnonzero(f.zeros == 0)
        if not free.size or not (f.window or still.size):
            return None
        # Zeros of F/(z - 1) for a window of n samples: the n-th roots of 1 without 1 itself, as offsets 1 - z.
        turns = 2.0 * np.pi * np.arange(1, f.window) / max(f.window, 1)
        # For z = -1 the offset is exactly 2, as for a device with a zero at exactly z = -1.
        window = np.where(turns == np.pi, 2.0, -2j * np.sin(0.5 * turns) * np.exp(0.5j * turns))
        lag = self.lag + f.lag + f.window
        velocity = f.zeros if f.window else np.delete(f.zeros, still[0])
        zeros = np.concatenate([self.zeros, velocity, window, np.ones(max(-lag, 0))])
        poles = np.concatenate([np.delete(self.poles, free[0]), f.poles])
        return LoopRoots(self.gain * float(f.gain) / max(f.window, 1), max(lag, 0), zeros, poles, Estimate())

    def take_root(self) -> tuple[LoopRoots, int]:
        """The loop in z whose poles are the k-th powers of its own, and the largest such k: mostly itself and 1."""
        f = self.estimate
        parts = [_product(each) for each in (self.zeros, self.poles, f.zeros, f.poles)]
        behind = [self.lag + parts[1].size - parts[0].size, f.lag + parts[3].size - parts[2].size]
        kept = [np.flatnonzero(np.abs(part) > _NO_TERM * np.abs(part).max()).tolist() for part in parts]
        k = gcd(f.window, *behind, *chain.from_iterable(kept))
        if k <= 1:
            return self, 1
        roots = [1.0 - np.roots(part[: each[-1] + 1 : k]) for part, each in zip(parts, kept, strict=True)]
        lags = [late // k - roots[j + 1].size + roots[j].size for late, j in zip(behind, (0, 2), strict=True)]
        slow = replace(f, window=f.window // k, gain=f.gain / k, lag=lags[1], zeros=roots[2], poles=roots[3])
        return replace(self, lag=lags[0], zeros=roots[0], poles=roots[1], estimate=slow), k

    def turning(self, w: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """How fast q and F vary at most within ``reach`` of w, relative to themselves."""
        before = circle(w).before[..., None]
        roots = np.concatenate([self.poles, self.zeros, self.estimate.poles, self.estimate.zeros])
        far = np.abs(before + roots) - reach[..., None]
        # A factor of a root on the circle changes its size there, not its argument: no need to look closer.
        floor = np.where(are_on_circle(roots), np.where(roots == 0, 1e-9, 1e-5), 0.5 * np.abs(depths(roots)))
        near = (1.0 / np.maximum(far, floor)).sum(-1)
        return near + self.lag + self.estimate.window + abs(self.estimate.lag) + 1.0


def step_apart(roots: Array, rate: Array) -> Array:
    """Aberth's step from approximations along the last axis, Newton's by ``P'/P``, from which each keeps off others."""
    apart = np.where(np.eye(roots.shape[-1], dtype=bool), np.inf, roots[..., :, None] - roots[..., None, :])
    return 1.0 / (rate - (1.0 / apart).sum(-1))


def _product(*offsets: np.ndarray) -> np.ndarray:
    """The monic polynomial of roots given by their offsets from 1; real, for they come in pairs."""
    return np.atleast_1d(np.poly(1.0 - np.concatenate(offsets))).real


def estimate_polynomials(loop: LoopRoots) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of the velocity estimate."""
    f = loop.estimate
    top, bottom = f.gain * _product(f.zeros), _product(f.poles)
    if f.window:
        difference = np.zeros(f.window + 1)
        difference[[0, -1]] = 1.0 / f.window, -1.0 / f.window
        top = np.convolve(top, difference)
    turns = f.window + f.lag
    return np.pad(top, (0, max(-turns, 0))), np.pad(bottom, (0, max(turns, 0)))


def affine_polynomial(loop: LoopRoots) -> Affine:
    """D, N1 and N2 of the closed loop."""
    top, bottom = estimate_polynomials(loop)
    device, answer = np.pad(_product(loop.poles), (0, loop.lag)), loop.gain * _product(loop.zeros)
    parts = [np.convolve(device, bottom), np.convolve(answer, bottom), np.convolve(answer, top)]
    length = max(part.size for part in parts)
    return Affine(*(np.pad(part, (length - part.size, 0)) for part in parts))


def closed_loop_roots(loop: LoopRoots, alpha: float, beta: float) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Zeros, poles, gain and lag of ``P = z^lag prod(z - poles) + gain prod(z - zeros)`` for one wall."""
    f, (top, bottom) = loop.estimate, estimate_polynomials(loop)
    wall = np.trim_zeros(np.polyadd(alpha * bottom, beta * top), "f")
    lag = loop.lag + max(f.window + f.lag, 0)
    zeros = np.concatenate([1.0 - loop.zeros, np.roots(wall)])
    poles = 1.0 - np.concatenate([loop.poles, f.poles])
    return zeros, poles, loop.gain * float(wall[0] if wall.size else 0.0), lag
