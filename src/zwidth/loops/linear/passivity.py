"""Passivity of a wall with any velocity estimate, on a device that moves as one mass where force and sensor are.

Colgate's condition (docs: `loops.rigid.passivity`) with the wall C = alpha + beta F, d = n + f. Per frequency the
physical damping must exceed, with s = sin(w/2),

    needed = (-a + sqrt(a^2 + 4 f (1 - f) |C|^2))/4
    a = -alpha sin((n + 1/2) w)/s + 2 beta Re(z^-n E) - 2 f Re(z^-(n+1) C),     F = (z - 1) E

Its maximum is proved by bounds of a'' and C'' (docs/theory/passivity.md, P4): intervals that cannot hold it are left,
the others halved. An estimate that answers a position at rest with F(1) != 0 adds ``beta F(1)`` to the stiffness; E is
then that of F - F(1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from zwidth.parts.circle import circle
from zwidth.parts.velocity import Estimate
from zwidth.words.types import Array

_NODES, _MOST = 129, 1 << 18
# Into how many parts an interval is cut that may hold the maximum, and how often.
_PARTS, _ROUNDS = 16, 20
_SHARES = np.arange(1, _PARTS)[:, None] / _PARTS
# By how much more, relatively, no frequency may need for the search to end.
_PROVED = 1e-13


# What of a device has no such condition: with what, and where none is known.
_OBSTACLES = {
    "response": ("a measured response", "without a model; measure the device with the hands it meets"),
    "system": (
        "a linear device",
        "where damping is not that of one body; ask is_stable of devices with the hands they meet",
    ),
    "actuator": (
        "an actuator",
        "where the force lags behind the command; ask is_stable with the hand as operator, or leave the actuator out",
    ),
    "modes": (
        "modes",
        "where the sensor sees more than the body that the hand holds; ask is_stable with the hand as operator, or "
        "leave the modes out",
    ),
}


def find_obstacle(*, coupling: Any = None, **parts: Any) -> str:
    """Why parts of a device have no such condition; nothing where force and sensed motion are those of one point."""
    for name, (what, where) in _OBSTACLES.items():
        part = parts.get(name)
        if part if isinstance(part, tuple | list) else part is not None:
            return f"with {what}: no passivity condition of this kind is known {where}"
    if coupling is not None and coupling.sensor == "tip":
        return (
            "with the sensor at the tip: there is no passivity condition of this kind, for force and sensed motion are "
            "not those of one point and no damping of the motor bounds the energy; ask is_stable with the hand as "
            "operator"
        )
    return ""


@dataclass(frozen=True)
class PassivityCondition:
    """What a velocity estimate and a delay ask of the damping."""

    quotient: Estimate  # E
    spring: float  # F(1)
    whole: int
    fraction: float

    @classmethod
    def derive(cls, estimate: Estimate, d: float) -> PassivityCondition:
        """The condition of an estimate and a delay in periods."""
        whole = int(np.floor(d))
        if estimate.window:
            return cls(estimate, 0.0, whole, float(d - whole))
        zeta = np.polynomial.polynomial
        lag = max(estimate.lag, 0)
        top = float(estimate.gain) * zeta.polyfromroots([*-estimate.zeros, *[-1.0] * max(-estimate.lag, 0)]).real
        bottom = zeta.polyfromroots([*-estimate.poles, *[-1.0] * lag]).real
        rest = top[0] / bottom[0]
        # (F - F(1))/(z - 1): without the constant coefficient, which the subtraction takes away; 0 of a constant F.
        over = np.trim_zeros(zeta.polysub(top, rest * bottom)[1:], "b")
        over = over if over.size else np.zeros(1)
        quotient = Estimate(0, over[-1], lag, -zeta.polyroots(over) + 0j, estimate.poles)
        return cls(quotient, float(rest), whole, float(d - whole))

    def _quotient(self, w: np.ndarray) -> np.ndarray:
        """E; of a window's difference the mean of z^-1 to z^-window."""
        n, value = self.quotient.window, replace(self.quotient, window=0).jet(circle(w)).value
        if n:
            s = np.sin(0.5 * w)
            mean = np.where(s == 0, 1.0, np.sin(0.5 * n * w) / (n * np.where(s == 0, 1.0, s)))
            value = value * (mean * np.exp(-0.5j * (n + 1) * w))
        return value

    def needed(self, alpha: float, beta: float, w: np.ndarray) -> np.ndarray:
        """The damping that each angle in [0, pi] asks for; alpha with the estimate's own spring, >= 0."""
        n, f = self.whole, self.fraction
        s = np.sin(0.5 * w)
        kernel = np.where(s == 0, 2.0 * n + 1.0, np.sin((n + 0.5) * w) / np.where(s == 0, 1.0, s))
        over = beta * self._quotient(w)
        wall: Array = alpha + over * circle(w).before
        a = -alpha * kernel + 2.0 * (np.exp(-1j * n * w) * over).real
        if f == 0:
            return np.maximum(-0.5 * a, 0.0)
        a = a - 2.0 * f * (np.exp(-1j * (n + 1) * w) * wall).real
        return 0.25 * (-a + np.sqrt(a * a + 4.0 * f * (1.0 - f) * np.abs(wall) ** 2))

    def curvature(self, alpha: float, beta: float, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """A bound of ``|M''|`` from low to high."""
        n, f = self.whole, self.fraction
        step = _enclose_difference(low, high, 0.0)
        over = _times(self._enclose_quotient(low, high), _turns(n, low))
        wall = _times(over, step)[2]
        bound = alpha * n * (n + 1) * (2 * n + 1) / 3.0 + 2.0 * abs(beta) * over[2]
        late = _times(_times(over, step), _turns(1, low))[2]
        bound = bound + 2.0 * f * (alpha * (n + 1) ** 2 + abs(beta) * late)
        # C itself turns no more than z^-n C does.
        return 0.5 * (bound + np.sqrt(f * (1.0 - f)) * abs(beta) * wall)

    def _enclose_quotient(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
        f = self.quotient
        value = _times((abs(f.gain) + 0.0 * low, 0.0 * low, 0.0 * low), _turns(abs(f.lag), low))
        if f.window:
            n = f.window
            value = _times(value, (1.0 + 0.0 * low, 0.5 * (n + 1) + 0.0 * low, (n + 1) * (2 * n + 1) / 6.0 + 0.0 * low))
        for zero in f.zeros:
            value = _times(value, _enclose_difference(low, high, zero))
        for pole in f.poles:
            middle = 0.5 * (low + high)
            far = np.abs(circle(middle).before + pole) - 0.5 * (high - low)
            # No point of the circle is closer than its own distance from the pole.
            depth = 1.0 - abs(1.0 - pole)
            far = np.maximum(far, depth)
            value = _times(value, (1.0 / far, 1.0 / far**2, 2.0 / far**3 + 1.0 / far**2))
        return value


def _times(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Bounds of a product and of its first two derivatives."""
    return (
        one[0] * other[0],
        one[1] * other[0] + one[0] * other[1],
        one[2] * other[0] + 2.0 * one[1] * other[1] + one[0] * other[2],
    )


def _turns(count: int, like: np.ndarray) -> tuple[np.ndarray, ...]:
    return 1.0 + 0.0 * like, count + 0.0 * like, float(count) ** 2 + 0.0 * like


def _enclose_difference(low: np.ndarray, high: np.ndarray, offset: complex) -> tuple[np.ndarray, ...]:
    """``z - root``, the root by its offset from 1."""
    middle, one = 0.5 * (low + high), 1.0 + 0.0 * low
    return np.abs(circle(middle).before + offset) + 0.5 * (high - low), one, one


def find_needed_damping(condition: PassivityCondition, alpha: float, beta: float) -> float:
    """Return the largest damping required at any frequency, certified to a relative 1e-13; NaN for non-finite input."""
    if not (np.isfinite(alpha) and np.isfinite(beta)):
        return np.nan
    stiff = max(alpha + beta * condition.spring, 0.0)
    w = np.concatenate([[0.0], np.geomspace(1e-6, 1e-2, 24), np.linspace(1e-2, np.pi, _NODES)[1:]])
    values = condition.needed(stiff, beta, w)
    # Both ends of each interval of angles, and the damping required at each end.
    ends, needs = np.stack([w[:-1], w[1:]]), np.stack([values[:-1], values[1:]])
    best, most = float(values.max()), values
    for _ in range(_ROUNDS):
        most = needs.max(0) + condition.curvature(stiff, beta, *ends) * np.diff(ends, axis=0)[0] ** 2 / 8.0
        open_ = most > best + _PROVED * (abs(best) + 1e-300)
        if not open_.any():
            return best
        if open_.sum() > _MOST:
            # Flat all over: what is left open is a bound, on the side of caution.
            break
        (low, high), needs = ends[:, open_], needs[:, open_]
        places = low + (high - low) * _SHARES
        inner = condition.needed(stiff, beta, places.ravel())
        best = max(best, float(inner.max()))
        places = np.concatenate([[low], places, [high]])
        values = np.concatenate([needs[:1], inner.reshape(_PARTS - 1, -1), needs[1:]])
        ends, needs = (np.stack([part[:-1].ravel(), part[1:].ravel()]) for part in (places, values))
    return float(most.max())


def passivity_margins(condition: PassivityCondition, alpha: np.ndarray, beta: np.ndarray, delta: float) -> np.ndarray:
    """By how much delta exceeds what walls of one shape need; at most their stiffness where that is negative."""
    pairs = zip(alpha.ravel().tolist(), beta.ravel().tolist(), strict=True)
    needed = [find_needed_damping(condition, *wall) for wall in pairs]
    margin = delta - np.array(needed).reshape(alpha.shape)
    stiff = alpha + beta * condition.spring
    return np.where(stiff < 0, np.minimum(margin, stiff), margin)
