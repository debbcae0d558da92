"""Compute the passivity margin of walls with any velocity estimate, on a device that is a single mass.

Colgate's condition requires a physical damping of at least N(w) at every ``z = e^(jw)`` (docs/theory/passivity.md, P4).
For the wall ``C = alpha + beta F``, the velocity estimate ``F = (z - 1) E``, and the delay d = n + f (n integer,
0 <= f < 1), with s = sin(w/2), the required damping is

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
from zwidth.model.estimate import Estimate
from zwidth.numerics.polynomials import abs2
from zwidth.stability.passivity import limit_margin, solve_larger_root

# Settings of the search for the maximum of the required damping N(w).
N_NODES = 129  # number of angles w at which the search starts
MAX_INTERVALS = 1 << 18  # largest number of undecided intervals in one round
N_PARTS = 16  # number of parts into which an undecided interval of angles is divided
MAX_ROUNDS = 20  # largest number of rounds in which the undecided intervals are divided
SHARES = np.arange(1, N_PARTS)[:, None] / N_PARTS  # inner points of a divided interval, relative to its width
CERTIFIED_ERROR = 1e-13  # largest relative error of the maximum
BATCH_WALLS = 64  # walls per batch, which limits the number of intervals in memory


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
    "position": (
        "a position estimate",
        "for a filtered position; use is_stable with the hand as operator, or omit the position estimate",
    ),
    "feedback": (
        "further feedback",
        "for it; use is_stable with the hand as operator, or omit the feedback",
    ),
}


def find_unsupported_reason(tool: Any = None, *, coupling: Any = None, **parts: Any) -> str:
    """Return the reason why no passivity condition is available for a scene; "" if a condition is available.

    A condition is available only if the force acts on the point whose position is sensed.

    Args:
        tool: simulated tool of the scene.
        coupling: coupling of the device.
        **parts: the other fields of the device, and the position estimate and further feedback of the scene, by name.
    """
    if tool is not None:
        return "with a simulated tool: the wall is a coupling; use is_safe_for_every_world"
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


def find_obstacle(scene: Any) -> str:
    """Return the reason why no passivity condition is available for a scene; "" if a condition is available."""
    return find_unsupported_reason(scene.tool, **vars(scene.device), position=scene.position, feedback=scene.feedback)


@dataclass(frozen=True)
class PassivityCondition:
    """Colgate's passivity condition for one velocity estimate F and one delay n + f in periods."""

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
        # Divide the numerator of F - F(1) by zeta to obtain the numerator of E: drop the constant coefficient, which is
        # 0. If F is constant, no coefficient remains.
        quotient = np.trim_zeros(polynomial.polysub(numerator, spring * denominator)[1:], "b")
        quotient = quotient if quotient.size else np.zeros(1)
        E = Estimate(0, quotient[-1], lag, -polynomial.polyroots(quotient) + 0j, estimate.poles)
        return cls(E, float(spring), n, float(d - n))

    def _evaluate_quotient(self, w: np.ndarray) -> np.ndarray:
        """Return E = (F - F(1))/(z - 1) at angles w; a window contributes the mean of z^-1 to z^-window as a factor."""
        n, value = self.quotient.window, replace(self.quotient, window=0).jet(circle_points(w)).value
        if n:
            s = np.sin(0.5 * w)
            mean = np.where(s == 0, 1.0, np.sin(0.5 * n * w) / (n * np.where(s == 0, 1.0, s)))
            value = value * (mean * np.exp(-0.5j * (n + 1) * w))
        return value

    def require_damping(self, alpha: np.ndarray, beta: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the required damping N at angles w in [0, pi]; ``alpha`` >= 0 includes the stiffness ``beta F(1)``."""
        n, f = self.integer_delay, self.fractional_delay
        s = np.sin(0.5 * w)
        kernel = np.where(s == 0, 2.0 * n + 1.0, np.sin((n + 0.5) * w) / np.where(s == 0, 1.0, s))
        damper = beta * self._evaluate_quotient(w)
        wall: Array = alpha + damper * circle_points(w).z_minus_1
        a = -alpha * kernel + 2.0 * (np.exp(-1j * n * w) * damper - f * np.exp(-1j * (n + 1) * w) * wall).real
        return solve_larger_root(-0.5 * a, f * (1.0 - f) * abs2(wall), np)[0]

    def bound_curvature(self, alpha: np.ndarray, beta: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return an upper bound of ``|M''|``, with the matrix M(w), on each interval [low, high] of w."""
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
        """Return bounds of |E| and of the first two derivatives of E in w on each interval [low, high] of w."""
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
    """Return bounds of a product and of its first two derivatives, from the same bounds of both factors."""
    return (
        one[0] * other[0],
        one[1] * other[0] + one[0] * other[1],
        one[2] * other[0] + 2.0 * one[1] * other[1] + one[0] * other[2],
    )


def _bound_power(exponent: int, like: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return bounds of z^exponent (or z^-exponent) and of its first two derivatives in w, in the shape of ``like``."""
    return 1.0 + 0.0 * like, exponent + 0.0 * like, float(exponent) ** 2 + 0.0 * like


def _bound_difference(low: np.ndarray, high: np.ndarray, offset: complex) -> tuple[np.ndarray, ...]:
    """Return bounds of ``z - root`` and its first two derivatives in w; ``offset`` is 1 - root."""
    middle, one = 0.5 * (low + high), 1.0 + 0.0 * low
    return np.abs(circle_points(middle).z_minus_1 + offset) + 0.5 * (high - low), one, one


def find_needed_damping(condition: PassivityCondition, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """Return the maximum of the required damping N(w) over all w for each wall, with a relative error below 1e-13.

    Args:
        condition: the condition for velocity estimate and delay.
        alpha: normalized stiffness, shape (walls,).
        beta: normalized damping, shape (walls,).

    Returns:
        Array of shape (walls,); NaN for non-finite input.
    """
    stiffness = np.maximum(alpha + beta * condition.spring, 0.0)
    w = np.concatenate([[0.0], np.geomspace(1e-6, 1e-2, 24), np.linspace(1e-2, np.pi, N_NODES)[1:]])
    values = condition.require_damping(stiffness[:, None], beta[:, None], w)
    best = values.max(-1)
    # Store all undecided intervals of angles of all walls side by side: the index of the wall, the two ends, the
    # required damping at each end, and an upper bound of the required damping.
    wall: np.ndarray = np.repeat(np.arange(alpha.size), w.size - 1)
    low, high = (np.tile(end, alpha.size) for end in (w[:-1], w[1:]))
    at_low, at_high = values[:, :-1].reshape(-1), values[:, 1:].reshape(-1)
    curvature = condition.bound_curvature(stiffness[:, None], beta[:, None], w[:-1], w[1:]).reshape(-1)
    for round_ in range(MAX_ROUNDS + 1):
        upper = np.maximum(at_low, at_high) + curvature * (high - low) ** 2 / 8.0
        undecided = upper > (best + CERTIFIED_ERROR * (np.abs(best) + 1e-300))[wall]
        # For walls with too many undecided intervals, N is almost constant over these intervals. Return the upper bound
        # of N for these walls, a conservative result.
        count = np.bincount(wall[undecided], minlength=alpha.size)
        is_flat = (count > MAX_INTERVALS) | ((round_ == MAX_ROUNDS) & (count > 0))
        np.maximum.at(best, wall[undecided & is_flat[wall]], upper[undecided & is_flat[wall]])
        undecided &= ~is_flat[wall]
        if not undecided.any():
            break
        wall, low, high = wall[undecided], low[undecided], high[undecided]
        at_low, at_high = at_low[undecided], at_high[undecided]
        angles = low + (high - low) * SHARES
        inner = condition.require_damping(stiffness[wall], beta[wall], angles)
        np.maximum.at(best, wall, inner.max(0))
        angles, values = np.concatenate([[low], angles, [high]]), np.concatenate([[at_low], inner, [at_high]])
        wall = np.tile(wall, N_PARTS)
        low, high, at_low, at_high = (part.reshape(-1) for part in (angles[:-1], angles[1:], values[:-1], values[1:]))
        curvature = condition.bound_curvature(stiffness[wall], beta[wall], low, high)
    return np.where(np.isfinite(alpha + beta), best, np.nan)


def compute_passivity_margins(
    condition: PassivityCondition, alpha: np.ndarray, beta: np.ndarray, delta: float
) -> np.ndarray:
    """Return the passivity margins of walls: delta minus the required damping.

    Args:
        condition: the condition for velocity estimate and delay.
        alpha: normalized stiffness, any shape.
        beta: normalized damping, the same shape.
        delta: normalized physical damping.
    """
    walls = alpha.reshape(-1), beta.reshape(-1)
    needed = np.zeros(alpha.size)
    for start in range(0, alpha.size, BATCH_WALLS):
        part = slice(start, start + BATCH_WALLS)
        with np.errstate(invalid="ignore"):
            needed[part] = find_needed_damping(condition, walls[0][part], walls[1][part])
    return limit_margin(delta - needed.reshape(alpha.shape), alpha + beta * condition.spring)
