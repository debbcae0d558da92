"""The boundary curve of any linear loop: points of it, nodes along it, its zeros and extremes (V8, V12).

On ``z = e^(jw)``, 0 < w < pi, a pole pair is where ``beta = Im q/Im F`` and ``alpha = Re q - beta Re F``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.arrays.circle import circle
from zwidth.arrays.roots import false_position
from zwidth.loops.linear.roots import LoopRoots

# How far one node lies from the next, as a share of the distance over which the loop changes by its own size.
_STEP = 0.08
_ROUNDS = 60
# How near to z = -1 the last node is, for a loop without roots there.
_LAST = 1e-4
# Shares of a step at which a dip of the slope between two nodes is looked for.
_INSIDE = np.arange(1, 8) / 8.0
_MOST_STEPS = 120


class CurvePoints(NamedTuple):
    """Points of the boundary curve, and what decides their order."""

    alpha: np.ndarray
    beta: np.ndarray
    alpha_slope: np.ndarray  # d alpha/dw
    turn: np.ndarray  # Im q' Im F - Im q Im F', of the sign of d beta/dw
    fall: np.ndarray  # Im F
    size: np.ndarray  # |q| + |beta F|, of which alpha is a difference


def curve_at(loop: LoopRoots, w: np.ndarray) -> CurvePoints:
    """The boundary curve at angles in (0, pi)."""
    at = circle(w)
    with np.errstate(all="ignore"):
        q, f = loop.required_wall(at), loop.estimate.jet(at)
        beta = q.value.imag / f.value.imag
        alpha = q.value.real - beta * f.value.real
        turn = q.slope.imag * f.value.imag - q.value.imag * f.slope.imag
        beta_slope = turn / f.value.imag**2
        alpha_slope = q.slope.real - beta_slope * f.value.real - beta * f.slope.real
        size = np.abs(q.value) + np.abs(beta * f.value)
        return CurvePoints(alpha, beta, alpha_slope, turn, f.value.imag, size)


def nodes_of(loop: LoopRoots) -> np.ndarray:
    """Angles from nearly 0 to nearly pi, so close that the loop hardly changes from one to the next."""
    roots = np.concatenate([loop.poles, loop.zeros, loop.estimate.poles, loop.estimate.zeros])
    sizes, far = np.abs(roots), np.abs(roots - 2.0)
    turn = 1.0 / (abs(loop.lag) + loop.estimate.window + 1.0)
    first = 1e-3 * min([turn, *sizes[sizes > 1e-13]])
    # Next to z = -1 imaginary parts x = pi - w have lost eps/x of themselves, and beta varies by (x/far)^2: closer than
    # this its slope is rounding.
    last = _LAST * min([turn, *far[far > 1e-13]]) ** (2.0 / 3.0)
    w = np.concatenate([np.geomspace(first, 0.1, 64), np.linspace(0.1, np.pi - last, 32)[1:]])
    for _ in range(_ROUNDS):
        half = 0.5 * np.diff(w)
        wide = 2.0 * half * loop.turning(w[:-1] + half, half) > _STEP * 16.0
        wide |= 2.0 * half * loop.turning(w[:-1] + half, 0.0 * half) > _STEP
        if not wide.any():
            break
        w = np.sort(np.concatenate([w, w[:-1][wide] + half[wide]]))
    return w


def zeros_of(loop: LoopRoots, w: np.ndarray, values: np.ndarray, field: str) -> np.ndarray:
    """Zeros of a field of the curve between nodes where its sign changes."""
    k = np.flatnonzero((values[:-1] > 0) != (values[1:] > 0))
    low, high, sign = w[k], w[k + 1], np.sign(values[k])
    if not k.size:
        return low
    with np.errstate(all="ignore"):
        scale = sign / (np.abs(values[k]) + np.abs(values[k + 1]))
        ends = values[k] * scale, values[k + 1] * scale
        return false_position(
            lambda at: getattr(curve_at(loop, at), field) * scale, low, high, *ends, _MOST_STEPS, 2e-16 * high
        )


def find_dips(w: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Nodes to add where a slope of the curve keeps its sign from one node to the next but may not do so between them.

    The curve changes so little over a step that the slope is nearly a parabola there; where an end's tangent leads
    below a tenth of it, the step is looked at in eighths.
    """
    same = (values[:-1] > 0) == (values[1:] > 0)
    step = np.diff(w)
    # Slopes at the nodes by differences of the three around them.
    inner = np.gradient(values, w)
    first = np.abs(values[:-1]) + np.sign(values[:-1]) * inner[:-1] * step / 2
    last = np.abs(values[1:]) - np.sign(values[1:]) * inner[1:] * step / 2
    lowest = np.minimum(first, last)
    near = same & (lowest < 0.25 * np.minimum(np.abs(values[:-1]), np.abs(values[1:])))
    k = np.flatnonzero(near)
    return (w[k, None] + step[k, None] * _INSIDE).ravel()
