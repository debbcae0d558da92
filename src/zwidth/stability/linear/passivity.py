"""Compute the passivity margin of walls with any velocity estimate, on a device that is a single mass.

Colgate's condition (docs/theory/passivity.md, P4) is a lower bound on the physical damping at every frequency. For the
wall ``C = alpha + beta F``, the velocity estimate ``F = (z - 1) E``, and the delay d = n + f (n integer, 0 <= f < 1),
the required damping at ``z = e^(jw)``, with s = sin(w/2), is

    N(w) = (-a + sqrt(a^2 + 4 f (1 - f) |C|^2))/4
    a = -alpha sin((n + 1/2) w)/s + 2 beta Re(z^-n E) - 2 f Re(z^-(n+1) C)

the larger eigenvalue of a 2x2 matrix M(w). Its maximum is computed with a certificate: between two angles that are h
apart, N exceeds its chord by at most h^2/8 times a bound of |M''|, so intervals that cannot contain the maximum are
discarded and the others divided. An estimate with F(1) != 0 adds ``beta F(1)`` to the stiffness; E is then that of
F - F(1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from zwidth.core.types import Array
from zwidth.model.circle_functions import circle_points
from zwidth.model.velocity import Estimate

# Settings of the search for the maximum of N.
N_NODES = 129  # initial angles
MAX_INTERVALS = 1 << 18  # largest number of undecided intervals in one round
N_PARTS = 16  # parts into which an interval is divided
MAX_ROUNDS = 20  # largest number of rounds in which the undecided intervals are divided
SHARES = np.arange(1, N_PARTS)[:, None] / N_PARTS  # inner points of a divided interval, relative to its width
CERTIFIED_ERROR = 1e-13  # largest relative error of the maximum


# Fields of a device for which no passivity condition is available, each with a description, a reason and a remedy.
UNSUPPORTED = {
    "response": (
        "a measured response",
        "without a model; measure the device together with the hand",
    ),
    "system": (
        "a linear device",
        "in general; use is_stable on devices that include the hand",
    ),
    "actuator": (
        "an actuator",
        "because the force lags; use is_stable with the hand as operator, or omit the actuator",
    ),
    "modes": (
        "modes",
        "because the sensor moves relative to the hand; use is_stable with the hand as operator, or omit the modes",
    ),
}


def find_unsupported_reason(*, coupling: Any = None, **parts: Any) -> str:
    """Return the reason why no passivity condition is available for a device; "" if a condition is available.

    The condition requires that the force acts on the point whose position is sensed.

    Args:
        coupling: coupling of the device.
        **parts: its other fields.
    """
    for name, (description, reason) in UNSUPPORTED.items():
        part = parts.get(name)
        if part if isinstance(part, tuple | list) else part is not None:
            return f"with {description}: no passivity condition is known {reason}"
    if coupling is not None and coupling.sensor == "tip":
        return (
            "with the sensor at the tip: there is no passivity condition, because motor damping does not bound the "
            "energy; use is_stable with the hand as operator"
        )
    return ""


@dataclass(frozen=True)
class PassivityCondition:
    """Colgate's condition of passivity for one velocity estimate and one delay."""

    quotient: Estimate  # E
    spring: float  # F(1)
    integer_delay: int  # n
    fractional_delay: float  # f

    @classmethod
    def derive(cls, estimate: Estimate, d: float) -> PassivityCondition:
        """Return the passivity condition for a velocity estimate and a delay d in periods."""
        n = int(np.floor(d))
        if estimate.window:
            return cls(estimate, 0.0, n, float(d - n))
        # Represent the polynomials in z by their coefficients in zeta = z - 1, lowest power first.
        polynomial = np.polynomial.polynomial
        lag = max(estimate.lag, 0)
        numerator = (
            float(estimate.gain) * polynomial.polyfromroots([*-estimate.zeros, *[-1.0] * max(-estimate.lag, 0)]).real
        )
        denominator = polynomial.polyfromroots([*-estimate.poles, *[-1.0] * lag]).real
        spring = numerator[0] / denominator[0]
        # Compute the numerator of E by dividing that of F - F(1) by zeta: drop the constant coefficient, which is 0. If
        # F is constant, no coefficient remains.
        quotient = np.trim_zeros(polynomial.polysub(numerator, spring * denominator)[1:], "b")
        quotient = quotient if quotient.size else np.zeros(1)
        E = Estimate(0, quotient[-1], lag, -polynomial.polyroots(quotient) + 0j, estimate.poles)
        return cls(E, float(spring), n, float(d - n))

    def _evaluate_quotient(self, w: np.ndarray) -> np.ndarray:
        """Return E at angles w; for a windowed difference, E has the mean of z^-1 to z^-window as a factor."""
        n, value = self.quotient.window, replace(self.quotient, window=0).jet(circle_points(w)).value
        if n:
            s = np.sin(0.5 * w)
            mean = np.where(s == 0, 1.0, np.sin(0.5 * n * w) / (n * np.where(s == 0, 1.0, s)))
            value = value * (mean * np.exp(-0.5j * (n + 1) * w))
        return value

    def require_damping(self, alpha: float, beta: float, w: np.ndarray) -> np.ndarray:
        """Return the required damping N at angles in [0, pi]; ``alpha`` >= 0 includes the stiffness ``beta F(1)``."""
        n, f = self.integer_delay, self.fractional_delay
        s = np.sin(0.5 * w)
        kernel = np.where(s == 0, 2.0 * n + 1.0, np.sin((n + 0.5) * w) / np.where(s == 0, 1.0, s))
        damper = beta * self._evaluate_quotient(w)
        wall: Array = alpha + damper * circle_points(w).z_minus_1
        a = -alpha * kernel + 2.0 * (np.exp(-1j * n * w) * damper).real
        if f == 0:
            return np.maximum(-0.5 * a, 0.0)
        a = a - 2.0 * f * (np.exp(-1j * (n + 1) * w) * wall).real
        return 0.25 * (-a + np.sqrt(a * a + 4.0 * f * (1.0 - f) * np.abs(wall) ** 2))

    def bound_curvature(self, alpha: float, beta: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return a bound of ``|M''|`` on each interval of angles [low, high]."""
        n, f = self.integer_delay, self.fractional_delay
        difference = _bound_difference(low, high, 0.0)
        damper = _multiply_bounds(self._bound_quotient(low, high), _bound_power(n, low))
        wall = _multiply_bounds(damper, difference)[2]
        bound = alpha * n * (n + 1) * (2 * n + 1) / 3.0 + 2.0 * abs(beta) * damper[2]
        late = _multiply_bounds(_multiply_bounds(damper, difference), _bound_power(1, low))[2]
        bound = bound + 2.0 * f * (alpha * (n + 1) ** 2 + abs(beta) * late)
        # ``wall`` bounds the second derivative of z^-n (z - 1) E. Use it as a bound for the second derivative of
        # C/beta, too, because the factor z^-n can only increase the bound.
        return 0.5 * (bound + np.sqrt(f * (1.0 - f)) * abs(beta) * wall)

    def _bound_quotient(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return bounds of |E| and of its first two derivatives in w on each interval of angles [low, high]."""
        f = self.quotient
        value = _multiply_bounds((abs(f.gain) + 0.0 * low, 0.0 * low, 0.0 * low), _bound_power(abs(f.lag), low))
        if f.window:
            n = f.window
            value = _multiply_bounds(
                value, (1.0 + 0.0 * low, 0.5 * (n + 1) + 0.0 * low, (n + 1) * (2 * n + 1) / 6.0 + 0.0 * low)
            )
        for zero in f.zeros:
            value = _multiply_bounds(value, _bound_difference(low, high, zero))
        for pole in f.poles:
            middle = 0.5 * (low + high)
            distance = np.abs(circle_points(middle).z_minus_1 + pole) - 0.5 * (high - low)
            # Increase the computed distance to at least 1 - |pole|, because no point of the unit circle is closer to
            # the pole.
            depth = 1.0 - abs(1.0 - pole)
            distance = np.maximum(distance, depth)
            value = _multiply_bounds(value, (1.0 / distance, 1.0 / distance**2, 2.0 / distance**3 + 1.0 / distance**2))
        return value


def _multiply_bounds(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Return bounds of a product and its first two derivatives, from those of both factors."""
    return (
        one[0] * other[0],
        one[1] * other[0] + one[0] * other[1],
        one[2] * other[0] + 2.0 * one[1] * other[1] + one[0] * other[2],
    )


def _bound_power(exponent: int, like: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return bounds of z^exponent or z^-exponent and its first two derivatives in w, in the shape of ``like``."""
    return 1.0 + 0.0 * like, exponent + 0.0 * like, float(exponent) ** 2 + 0.0 * like


def _bound_difference(low: np.ndarray, high: np.ndarray, offset: complex) -> tuple[np.ndarray, ...]:
    """Return bounds of ``z - root`` and its first two derivatives in w; ``offset`` is 1 - root."""
    middle, one = 0.5 * (low + high), 1.0 + 0.0 * low
    return np.abs(circle_points(middle).z_minus_1 + offset) + 0.5 * (high - low), one, one


def find_needed_damping(condition: PassivityCondition, alpha: float, beta: float) -> float:
    """Return the maximum of N over all frequencies with a relative error below 1e-13; NaN for non-finite input."""
    if not (np.isfinite(alpha) and np.isfinite(beta)):
        return np.nan
    stiffness = max(alpha + beta * condition.spring, 0.0)
    w = np.concatenate([[0.0], np.geomspace(1e-6, 1e-2, 24), np.linspace(1e-2, np.pi, N_NODES)[1:]])
    values = condition.require_damping(stiffness, beta, w)
    # Store the two ends of each interval of angles, and the required damping at each end, along the first axis.
    ends, needs = np.stack([w[:-1], w[1:]]), np.stack([values[:-1], values[1:]])
    best, upper = float(values.max()), values
    for _ in range(MAX_ROUNDS):
        upper = needs.max(0) + condition.bound_curvature(stiffness, beta, *ends) * np.diff(ends, axis=0)[0] ** 2 / 8.0
        undecided = upper > best + CERTIFIED_ERROR * (abs(best) + 1e-300)
        if not undecided.any():
            return best
        if undecided.sum() > MAX_INTERVALS:
            # Stop and return the upper bound, a conservative result: N is so flat that too many intervals remain
            # undecided.
            break
        (low, high), needs = ends[:, undecided], needs[:, undecided]
        angles = low + (high - low) * SHARES
        inner = condition.require_damping(stiffness, beta, angles.ravel())
        best = max(best, float(inner.max()))
        angles = np.concatenate([[low], angles, [high]])
        values = np.concatenate([needs[:1], inner.reshape(N_PARTS - 1, -1), needs[1:]])
        ends, needs = (np.stack([part[:-1].ravel(), part[1:].ravel()]) for part in (angles, values))
    return float(upper.max())


def compute_passivity_margins(
    condition: PassivityCondition, alpha: np.ndarray, beta: np.ndarray, delta: float
) -> np.ndarray:
    """Return the passivity margins of walls: delta minus the required damping.

    The margin of a wall with negative stiffness is at most its stiffness, because such a wall supplies unlimited
    energy, which the condition at w > 0 does not detect.

    Args:
        condition: the condition for velocity estimate and delay.
        alpha: normalized stiffness, any shape.
        beta: normalized damping, the same shape.
        delta: normalized physical damping.
    """
    pairs = zip(alpha.ravel().tolist(), beta.ravel().tolist(), strict=True)
    needed = [find_needed_damping(condition, *wall) for wall in pairs]
    margin = delta - np.array(needed).reshape(alpha.shape)
    stiffness = alpha + beta * condition.spring
    return np.where(stiffness < 0, np.minimum(margin, stiffness), margin)
