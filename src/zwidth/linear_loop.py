"""A loop by its roots, on the unit circle (any loop): what its device answers, what its velocity estimate answers.

Normalized to T = 1 and m = 1, the loop of a wall is affine in (alpha, beta),

    P(z) = D + alpha N1 + beta N2 = 0   exactly where   alpha + beta F(z) = q(z) = -1/G(z)

with G from the wall's force to the sampled position and F from position to the velocity estimate. Roots are kept by
their offsets ``1 - root``: next to z = 1, where slow loops live, a root itself has lost its digits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.xp import frozen, namespace

# Nearer to the circle than this a root of the loop is on it: an undamped mode, or a zero of an undamped device.
ON_CIRCLE = 1e-12


class Jet(NamedTuple):
    """A complex function of w and its derivative."""

    value: Array
    slope: Array

    def times(self, other: Jet) -> Jet:
        """The product."""
        return Jet(self.value * other.value, self.slope * other.value + self.value * other.slope)

    def over(self, other: Jet) -> Jet:
        """The quotient."""
        value = self.value / other.value
        return Jet(value, (self.slope - value * other.slope) / other.value)


class CirclePoints(NamedTuple):
    """Points ``z = e^(jw)``, and z - 1 with all its digits."""

    w: Array
    z: Array
    before: Array


def circle(w: Array) -> CirclePoints:
    """The points of the unit circle at the angles ``w``, exactly -1 at pi."""
    xp = namespace(w)
    half = 0.5 * w
    s, c = xp.sin(half), _exactly_at_pi(w, 0.0, xp.cos(half), xp)
    before = -2.0 * s * s + 2j * s * c
    return CirclePoints(w, 1.0 + before, before)


def depths(offsets: np.ndarray) -> np.ndarray:
    """``1 - |root|`` of roots given by their offsets from 1, with the digits that they have next to 1."""
    return (2.0 * np.real(offsets) - np.abs(offsets) ** 2) / (1.0 + np.abs(1.0 - offsets))


def _exactly_at_pi(w: Array, exact: complex, value: Array, xp: Any) -> Array:
    """``value`` without its rounding error at pi, which derivatives must not mistake for a constant."""
    if xp is np:
        return np.where(w >= np.pi, exact, value)
    return value - frozen(xp.where(w >= np.pi, value - exact, 0.0), xp)


def lag_jet(at: CirclePoints, turns: float) -> Jet:
    """``z^turns``."""
    # At pi a whole number of half turns is a sign.
    even = 1.0 - 2.0 * (turns % 2)
    xp = namespace(at.w)
    value = _exactly_at_pi(at.w, even + 0j, xp.exp(1j * turns * at.w), xp)
    return Jet(value, 1j * turns * value)


def product_jet(at: CirclePoints, offsets: Any, factor: Any) -> Jet:
    """``factor prod(z - root)`` of roots given by their offsets from 1."""
    value = 0.0 * at.z + factor
    slope = 0.0 * at.z
    turn = 1j * at.z
    for offset in offsets:
        one = at.before + offset
        value, slope = value * one, slope * one + value * turn
    return Jet(value, slope)


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


@dataclass(frozen=True)
class LinearLoop:
    """A loop without its wall: ``G(z) = gain prod(z - zeros)/(z^lag prod(z - poles))`` and the velocity estimate F."""

    gain: float
    lag: int
    zeros: Array
    poles: Array
    estimate: Estimate

    def needed(self, at: CirclePoints) -> Jet:
        """``q = -1/G``: what the wall must answer to put a pole at z."""
        over = product_jet(at, self.poles, -1.0).over(product_jet(at, self.zeros, self.gain))
        return over.times(lag_jet(at, self.lag))

    def answer(self, at: CirclePoints) -> Jet:
        """G: the sampled position that the wall's force leads to."""
        over = product_jet(at, self.zeros, self.gain).over(product_jet(at, self.poles, 1.0))
        return over.times(lag_jet(at, -self.lag))

    @property
    def order(self) -> int:
        """How many poles the closed loop has."""
        filtered = self.estimate
        return self.poles.size + max(self.lag, 0) + filtered.poles.size + filtered.window + max(filtered.lag, 0)

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
