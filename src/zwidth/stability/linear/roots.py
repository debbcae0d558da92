"""Represent the open loop of any linear scene by zeros, poles and gain, and as polynomials in z.

In normalized units (sampling period T = 1, mass m = 1), the wall is the controller ``alpha + beta F(z)``, with the
velocity estimate F from sampled position to velocity. G is the response from the force of the wall to the sampled
position. The characteristic polynomial P is affine in the wall,

    P(z) = D + alpha N1 + beta N2,     P(z) = 0  if and only if  alpha + beta F(z) = q(z) = -1/G(z)

and q is called the *critical controller* (docs/theory/scenes.md, V6 and V7). Roots are stored as *offsets* 1 - root,
because the poles of slow motions lie near z = 1 and would lose their significant digits in z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from math import gcd

import numpy as np

from zwidth.core.types import Array
from zwidth.model.circle_functions import CirclePoints, Jet, are_on_circle, circle_points, distances_inside
from zwidth.model.estimate import Estimate
from zwidth.model.loop_estimates import LoopEstimates, Response
from zwidth.model.mechanism import AnyChain
from zwidth.numerics.polynomials import Affine
from zwidth.plant.factored_plant import FactoredPlant

# Coefficients below this fraction of the largest one are regarded as rounding errors of 0.
NEGLIGIBLE_COEFFICIENT = 1e-12
POLE_AT_ONE = 1e-13  # distance from z = 1 below which a pole counts as a pole at z = 1

# Position estimate P, velocity estimate V and, if the loop has it, further feedback R, as functions on the unit circle.
Terms = tuple[Response, ...]


def respond_to_position(points: CirclePoints) -> Jet:
    """Return P = 1 and its derivative 0, the position estimate of a spring that acts on the sampled position itself."""
    return Jet(np.ones(()), np.zeros(()))


def list_terms(chain: AnyChain) -> Terms:
    """Return the transfer functions of a controller ``alpha P + beta V + R`` as functions on the unit circle.

    P is the position estimate, V the velocity estimate, and R the further feedback, which is omitted if there is none.
    """
    return (respond_to_position, chain.estimate.jet) if chain.estimates is None else chain.estimates.respond()


def evaluate_controller(terms: Terms, points: CirclePoints, alpha: Array, beta: Array) -> Jet:
    """Return the controller ``alpha P + beta V + R`` at points of the unit circle, and its derivative in the angle w.

    Args:
        terms: P, V and, if the loop has further feedback, R.
        points: points of the unit circle; they broadcast with alpha and beta.
        alpha: normalized stiffness.
        beta: normalized damping.
    """
    P, V, *R = (term(points) for term in terms)
    parts = (
        alpha * first + beta * second + sum(rest)
        for first, second, rest in zip(P, V, zip(*R, strict=True) if R else ((), ()), strict=True)
    )
    return Jet(*parts)


@dataclass(frozen=True)
class LoopRoots(FactoredPlant):
    """The loop without a wall: the response G of the plant and the velocity estimate F, as zeros, poles and gain.

    G and F have ``shared`` common roots: the last zeros of G are the last poles of F. These roots cancel in the open
    loop ``G (alpha + beta F)``, so they are not closed-loop poles (docs/theory/scenes.md, V26).
    """

    estimate: Estimate
    shared: int = 0
    # Only for controllers alpha P + beta V + R with further feedback R: the sampled plant H, and the position estimate
    # P, the velocity estimate V and R. G and F are then H P/(1 + H R) and V/P (V25).
    inner: tuple[FactoredPlant, LoopEstimates] | None = None

    @property
    def terms(self) -> tuple[FactoredPlant, Terms]:
        """The sampled plant H, and the terms P, V and R of the controller ``alpha P + beta V + R``.

        Without R, the plant is G instead of H, and the terms are 1 and F.
        """
        if self.inner is None:
            return self, (respond_to_position, self.estimate.jet)
        return self.inner[0], self.inner[1].respond()

    @property
    def open_poles(self) -> np.ndarray:
        """Offsets 1 - pole of the open loop L at the plant input.

        The array may lack poles of the estimates, which are inside the unit circle and need not be counted.
        """
        if self.inner is None:
            return self.poles
        feedback = self.inner[1].feedback
        return np.concatenate([self.inner[0].poles, np.zeros(0) if feedback is None else feedback.filter.poles])

    @property
    def free_zeros(self) -> np.ndarray:
        """Offsets 1 - root of those zeros of G that are not poles of F."""
        return self.zeros[: self.zeros.size - self.shared]

    @property
    def free_poles(self) -> np.ndarray:
        """Offsets 1 - root of those poles of F that are not zeros of G."""
        return self.estimate.poles[: self.estimate.poles.size - self.shared]

    @property
    def order(self) -> int:
        """The number of closed-loop poles with a damped wall (beta != 0)."""
        f = self.estimate
        return self.poles.size + self.lag + self.free_poles.size + max(f.window + f.lag, 0)

    @property
    def device_is_unstable(self) -> bool:
        """True if the device without a wall has a pole outside the unit circle."""
        return bool(np.any((distances_inside(self.poles) < 0) & ~are_on_circle(self.poles)))

    def as_damper(self) -> LoopRoots | None:
        """Return the loop of walls with stiffness K = 0, in which the damping B is the loop gain instead of K.

        The zero of the velocity estimate at z = 1 cancels a pole of the device there. Return None if the zero or the
        pole does not exist.
        """
        f = self.estimate
        device_poles, estimate_zeros = np.flatnonzero(self.poles == 0), np.flatnonzero(f.zeros == 0)
        if not device_poles.size or not (f.window or estimate_zeros.size):
            return None
        window = f.list_window_zeros()
        lag = self.lag + f.lag + f.window
        velocity = f.zeros if f.window else np.delete(f.zeros, estimate_zeros[0])
        zeros = np.concatenate([self.free_zeros, velocity, window, np.ones(max(-lag, 0))])
        poles = np.concatenate([np.delete(self.poles, device_poles[0]), self.free_poles])
        return LoopRoots(self.gain * float(f.gain) / max(f.window, 1), max(lag, 0), zeros, poles, Estimate())

    def invert_estimate(self) -> LoopRoots:
        """Return a loop with the plant 1/F and the backward difference as velocity estimate.

        F must have the same number of poles and zeros, including those at z = 0.
        """
        f = self.estimate
        lag, at_one = -f.lag - f.window, np.zeros(min(f.window, 1))
        zeros = np.concatenate([f.poles, np.ones(max(-lag, 0))])
        poles = np.concatenate([f.zeros, at_one, f.list_window_zeros()])
        return LoopRoots(max(f.window, 1) / float(f.gain), max(lag, 0), zeros, poles, Estimate())

    def contract_powers(self) -> tuple[LoopRoots, int]:
        """Return the loop in the variable z^k, for the largest k such that G and F are functions of z^k, and this k.

        Returns:
            The loop whose poles are the k-th powers of the poles of this loop, and k. For most loops k is 1.
        """
        f = self.estimate
        if self.shared:
            return self, 1
        parts = [_expand(each) for each in (self.zeros, self.poles, f.zeros, f.poles)]
        delays = [self.lag + parts[1].size - parts[0].size, f.lag + parts[3].size - parts[2].size]
        powers = [np.flatnonzero(np.abs(part) > NEGLIGIBLE_COEFFICIENT * np.abs(part).max()).tolist() for part in parts]
        k = gcd(f.window, *delays, *chain.from_iterable(powers))
        if k <= 1:
            return self, 1
        roots = [1.0 - np.roots(part[: each[-1] + 1 : k]) for part, each in zip(parts, powers, strict=True)]
        lags = [delay // k - roots[j + 1].size + roots[j].size for delay, j in zip(delays, (0, 2), strict=True)]
        slow = replace(f, window=f.window // k, gain=f.gain / k, lag=lags[1], zeros=roots[2], poles=roots[3])
        return replace(self, lag=lags[0], zeros=roots[0], poles=roots[1], estimate=slow, inner=None), k

    def bound_variation(self, w: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return a bound of the relative derivatives of q = -1/G and F in w, over all angles within ``reach`` of w."""
        z_minus_1 = circle_points(w).z_minus_1[..., None]
        roots = np.concatenate([self.poles, self.zeros, self.estimate.poles, self.estimate.zeros])
        distance = np.abs(z_minus_1 + roots) - reach[..., None]
        # Limit the distance from a root on the unit circle from below. Near the root, the phase of the factor (z -
        # root) hardly varies (V16), and only its modulus must be resolved.
        floor = np.where(are_on_circle(roots), np.where(roots == 0, 1e-9, 1e-5), 0.5 * np.abs(distances_inside(roots)))
        by_roots = (1.0 / np.maximum(distance, floor)).sum(-1)
        return by_roots + self.lag + self.estimate.window + abs(self.estimate.lag) + 1.0


def _expand(*offsets: np.ndarray) -> np.ndarray:
    """Return the real coefficients of the monic polynomial whose roots, in conjugate pairs, have the given offsets."""
    return np.atleast_1d(np.poly(1.0 - np.concatenate(offsets))).real


def expand_estimate(loop: LoopRoots) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients of the numerator and the denominator of the velocity estimate, highest power first."""
    f = loop.estimate
    numerator, denominator = f.gain * _expand(f.zeros), _expand(f.poles)
    if f.window:
        difference = np.zeros(f.window + 1)
        difference[[0, -1]] = 1.0 / f.window, -1.0 / f.window
        numerator = np.convolve(numerator, difference)
    delay = f.window + f.lag
    return np.pad(numerator, (0, max(-delay, 0))), np.pad(denominator, (0, max(delay, 0)))


def affine_polynomial(loop: LoopRoots) -> Affine:
    """Return the coefficients of D, N1 and N2 in the characteristic polynomial ``D + alpha N1 + beta N2``."""
    f, (f_numerator, f_denominator) = loop.estimate, expand_estimate(loop)
    denominator, numerator = np.pad(_expand(loop.poles), (0, loop.lag)), loop.gain * _expand(loop.free_zeros)
    parts = [
        np.convolve(denominator, np.pad(_expand(loop.free_poles), (0, max(f.window + f.lag, 0)))),
        np.convolve(numerator, f_denominator),
        np.convolve(numerator, f_numerator),
    ]
    length = max(part.size for part in parts)
    return Affine(*(np.pad(part, (length - part.size, 0)) for part in parts))


def factor_open_loop(loop: LoopRoots, alpha: float, beta: float) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return zeros, poles, gain and lag of ``P = z^lag prod(z - poles) + gain prod(z - zeros)`` for one wall."""
    f, (numerator, denominator) = loop.estimate, expand_estimate(loop)
    wall = np.trim_zeros(np.polyadd(alpha * denominator, beta * numerator), "f")
    lag = loop.lag + max(f.window + f.lag, 0)
    zeros = np.concatenate([1.0 - loop.free_zeros, np.roots(wall)])
    poles = 1.0 - np.concatenate([loop.poles, loop.free_poles])
    return zeros, poles, loop.gain * float(wall[0] if wall.size else 0.0), lag
