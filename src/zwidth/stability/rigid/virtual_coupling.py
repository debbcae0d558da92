"""Virtual couplings that are safe for every passive virtual world (docs/theory/passivity.md, U1 to U3).

A virtual coupling is a spring K and a damper B between the device and a simulated tool. The force acts n periods late
on a rigid device with the damping b. The loop is stable with every passive tool, world and operator if and only if

    b (B + K T/2) >= sin^2((n + 1) w/2) [ (B + K T/2)^2 + (K T/2)^2 cot^2(w/2) ]     for all w in (0, pi]

In units of b, with u = (B + K T/2)/b and c = K T/(2 b), the condition is u <= 1 and c^2 <= u h(u), where

    h(u) = min over w of (1 - u s)/t,     s = sin^2((n + 1) w/2),  t = s cot^2(w/2)

The set of safe couplings is convex, and its shape depends on n only: neither on the mass nor on the damping.
"""

from __future__ import annotations

import numpy as np

from zwidth.core.types import Array
from zwidth.numerics.root_finding import minimize_golden_section

# Frequencies per half period of sin((n + 1) w/2) at which h is searched; 16 find the same minima.
NODES = 64
# Steps of the golden-section search; each shrinks the bracket by a factor of 0.62, and 52 resolve rounding errors.
STEPS = 52
# Largest number of values evaluated at once; 8 MB per array.
BLOCK = 1_000_000


def find_margin(spring: Array, damper: Array, n_delay: int) -> Array:
    """Return ``u h(u) - c^2`` elementwise, which is not negative if and only if the coupling is safe.

    Args:
        spring: ``c = K T/(2 b)``; NaN or negative values return NaN.
        damper: ``B/b``; NaN or negative values return NaN.
        n_delay: delay n in periods.

    Returns:
        Array of the broadcast shape of the two; -inf if u > 1.
    """
    spring, damper = np.broadcast_arrays(np.asarray(spring, float), np.asarray(damper, float))
    valid = (spring >= 0) & (damper >= 0)
    u = np.where(valid, spring + damper, 0.0)
    margin = np.where(u <= 1, u * find_limit(np.minimum(u, 1.0), n_delay) - spring**2, -np.inf)
    return np.where(valid, margin, np.nan)


def find_limit(u: np.ndarray, n_delay: int) -> np.ndarray:
    """Return h(u) elementwise for u in [0, 1]; 1 for n = 0, where the minimum is at w = 0."""
    if n_delay == 0:
        return np.ones(u.shape)
    nodes = np.linspace(0.0, np.pi, NODES * (n_delay + 1) + 1)
    flat, size = u.ravel(), max(1, BLOCK // nodes.size)
    parts = [_minimize(flat[start : start + size], nodes, n_delay) for start in range(0, flat.size, size)]
    return np.concatenate([*parts, np.empty(0)]).reshape(u.shape)


def _minimize(u: np.ndarray, nodes: np.ndarray, n_delay: int) -> np.ndarray:
    """Return h(u) for a vector u: the smallest value on the nodes, refined between the neighboring nodes."""

    def bound(w: np.ndarray) -> np.ndarray:
        """Return (1 - u s)/t, which is infinite at frequencies without effect (t = 0)."""
        s = np.sin(0.5 * (n_delay + 1) * w) ** 2
        # The limit of s cot^2(w/2) for w -> 0 is (n + 1)^2.
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(w > 0, s / np.tan(0.5 * w) ** 2, (n_delay + 1.0) ** 2)
            return np.where(ratio > 0, (1.0 - u * s) / ratio, np.inf)

    best = np.argmin(bound(nodes[:, None]), axis=0)
    lower, upper = nodes[np.maximum(best - 1, 0)], nodes[np.minimum(best + 1, len(nodes) - 1)]
    return minimize_golden_section(bound, lower, nodes[best], upper, bound(nodes[best]), STEPS)[1]


def find_stiffest(n_delay: int) -> tuple[float, float]:
    """Return c and B/b of the stiffest safe coupling with B >= 0."""
    # The set of safe couplings is convex, so c as a function of u has a single maximum.
    u = np.linspace(0.0, 1.0, NODES + 1)

    def find_spring(u: np.ndarray) -> np.ndarray:
        """Return the largest c for the given u; c = u is a coupling without damper."""
        return np.minimum(np.sqrt(u * np.maximum(find_limit(u, n_delay), 0.0)), u)

    best = int(np.argmax(find_spring(u)))
    low, high = u[[max(best - 1, 0)]], u[[min(best + 1, NODES)]]
    (top,), (cost,) = minimize_golden_section(
        lambda u: -find_spring(u), low, u[[best]], high, -find_spring(u[[best]]), STEPS
    )
    return float(-cost), float(top + cost)
