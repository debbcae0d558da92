"""The spectral radius of any linear loop with walls: from all poles, or for long delays by counting on circles."""

from __future__ import annotations

import numpy as np

from zwidth.loops.linear.poles import abs2, evaluate, log_size, poles_less_one
from zwidth.loops.linear.polynomial import closed_loop_roots
from zwidth.loops.linear.roots import LoopRoots
from zwidth.loops.rigid.counting import count_poles

# Beyond so many poles a count, whose cost no delay changes, is faster than all of them; but the window's zeros count.
_MOST_POLES, _LONGEST_WINDOW = 150, 40
# Circles looked at in one call, which narrow the bracket by one more; and where the bracket ends.
_CIRCLES, _ROUNDS, _WIDTH = 16, 24, 4e-16
# A bracket that stays wider holds poles that the count cannot tell apart from the circle.
_UNKNOWN = 1e-6
# Where label and radius contradict each other by more than that, one of the two is wrong: neither is given.
_CONTRADICTION = 1e-7


def log_radius(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """``log max|z|`` of walls of shape (walls,); NaN where it is not known."""
    if loop.order <= _MOST_POLES or loop.estimate.window > _LONGEST_WINDOW:
        return log_size(poles_less_one(loop, alpha, beta)).max(-1)
    return np.array([_by_circles(loop, a, b) for a, b in zip(alpha.tolist(), beta.tolist(), strict=True)])


def spectral_radius(loop: LoopRoots, alpha: np.ndarray, beta: np.ndarray, stable: np.ndarray) -> np.ndarray:
    """``max|z|`` on the verdict's side of 1: within rounding of the boundary the two would contradict each other."""
    log = log_radius(loop, alpha, beta)
    log = np.where((log < 0) != stable, np.where(np.abs(log) < _CONTRADICTION, 0.0, np.nan), log)
    radius = np.exp(log)
    return np.where(stable, np.minimum(radius, np.nextafter(1.0, 0.0)), radius)


def _by_circles(loop: LoopRoots, alpha: float, beta: float) -> float:
    if not (np.isfinite(alpha) and np.isfinite(beta)):
        return np.nan
    zeros, poles, gain, lag = closed_loop_roots(loop, alpha, beta)
    full = poles.size + lag
    low, high = -1.0, 1.0
    for round_ in range(_ROUNDS):
        logs = np.linspace(low, high, _CIRCLES + 2)[0 if round_ < 3 else 1 : None if round_ < 3 else -1]
        with np.errstate(all="ignore"):
            counts = count_poles(zeros, poles, gain, lag, np.exp(logs))
        holds, lacks = logs[counts == full], logs[(counts >= 0) & (counts < full)]
        if not holds.size and round_ < 3 and lacks.size:
            low, high = high, 8.0 * high
            continue
        if not lacks.size and round_ < 3 and holds.size:
            low, high = 8.0 * low, low
            continue
        if not holds.size and not lacks.size:
            break
        low, high = max([low, *lacks]), min([high, *holds])
        if high - low <= _WIDTH * max(1.0, abs(high)):
            break
    if not high - low <= _UNKNOWN:
        return np.nan
    return _polish(loop, alpha, beta, low, high)


def _polish(loop: LoopRoots, alpha: float, beta: float, low: float, high: float) -> float:
    """Newton's method from where P is smallest on the circle; the pole counts if it lies within the bracket."""
    middle = 0.5 * (low + high)
    w = np.concatenate([np.geomspace(1e-9, 1e-2, 200), np.linspace(1e-2, np.pi, 16 * loop.order)])
    # e^(middle + jw) - 1
    zeta = np.expm1(middle) * np.cos(w) - 2.0 * np.sin(0.5 * w) ** 2 + 1j * np.exp(middle) * np.sin(w)
    a, b = np.float64(alpha), np.float64(beta)
    with np.errstate(all="ignore"):
        at = evaluate(loop, a, b, zeta)
        # By how far Newton's method would go, in units of the way between the points.
        away = np.abs(at.value / at.slope)
        zeta = zeta[np.argsort(np.where(np.isfinite(away), away, np.inf))[:16]]
        for _ in range(8):
            at = evaluate(loop, a, b, zeta)
            step = at.value / at.slope
            zeta = zeta - np.where(np.isfinite(step) & (abs2(step) < 1e-2), step, 0.0)
    logs = log_size(zeta)
    spare = 1e-13 + (high - low)
    near = (logs > low - spare) & (logs < high + spare)
    return float(logs[near][np.argmin(np.abs(logs[near] - middle))]) if near.any() else middle
