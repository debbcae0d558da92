"""Virtual couplings, a spring K and a damper B, that are safe for every passive virtual world.

With c = K T/(2 b) and u = c + B/b, a coupling is safe if and only if u <= 1 and c^2 <= u h(u)
(docs/theory/passivity.md, U1 to U3).

A virtual coupling connects the device to a simulated tool. Its force acts, with a delay of n periods, on a rigid device
with the damping b. The loop is stable with every passive tool, world and operator (the coupling is *safe*) if and only
if

    b (B + K T/2) >= sin^2((n + 1) w/2) [ (B + K T/2)^2 + (K T/2)^2 cot^2(w/2) ]     for all w in (0, pi]

Divided by b^2, this condition is the one on u and c, with

    h(u) = min over w of (1 - u s)/t,     s = sin^2((n + 1) w/2),  t = s cot^2(w/2)

The set of safe (c, B/b) is convex and depends only on n, not on the mass or the damping of the device.
"""

from __future__ import annotations

import numpy as np

from zwidth.core.types import Array
from zwidth.numerics.root_finding import minimize_golden_section

# Number of frequencies w per half period of sin((n + 1) w/2) at which the minimum h(u) is searched; 16 would find the
# same minima.
NODES = 64
# Number of steps of the golden-section search. Each shrinks the bracket by a factor of 0.62; after 52 steps only
# rounding errors remain.
STEPS = 52
# Largest number of array elements computed at once; 8 MB per array.
BLOCK = 1_000_000


def find_margin(spring: Array, damper: Array, n_delay: int) -> Array:
    """Return the margin ``u h(u) - c^2`` elementwise; it is not negative if and only if the coupling is safe.

    Args:
        spring: ``c = K T/(2 b)``; the margin is NaN if c is NaN or negative.
        damper: ``B/b``; the margin is NaN if B/b is NaN or negative.
        n_delay: integer delay n in periods.

    Returns:
        Array of the shape to which ``spring`` and ``damper`` broadcast; -inf where u > 1.
    """
    spring, damper = np.broadcast_arrays(np.asarray(spring, float), np.asarray(damper, float))
    valid = (spring >= 0) & (damper >= 0)
    u = np.where(valid, spring + damper, 0.0)
    margin = np.where(u <= 1, u * find_limit(np.minimum(u, 1.0), n_delay) - spring**2, -np.inf)
    return np.where(valid, margin, np.nan)


def find_limit(u: np.ndarray, n_delay: int) -> np.ndarray:
    """Return h(u) elementwise for u in [0, 1]. For n = 0 it is 1, the value of the minimum at w = 0."""
    if n_delay == 0:
        return np.ones(u.shape)
    nodes = np.linspace(0.0, np.pi, NODES * (n_delay + 1) + 1)
    flat, size = u.ravel(), max(1, BLOCK // nodes.size)
    parts = [_minimize(flat[start : start + size], nodes, n_delay) for start in range(0, flat.size, size)]
    return np.concatenate([*parts, np.empty(0)]).reshape(u.shape)


def _minimize(u: np.ndarray, nodes: np.ndarray, n_delay: int) -> np.ndarray:
    """Return h(u) for a vector u: the minimum over the frequencies ``nodes``, refined between the neighboring nodes."""

    def bound(w: np.ndarray) -> np.ndarray:
        """Return (1 - u s)/t, the function minimized by h(u); it is infinite where t = 0, i.e. without a constraint."""
        s = np.sin(0.5 * (n_delay + 1) * w) ** 2
        # For w -> 0, t = s cot^2(w/2) tends to (n + 1)^2.
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(w > 0, s / np.tan(0.5 * w) ** 2, (n_delay + 1.0) ** 2)
            return np.where(ratio > 0, (1.0 - u * s) / ratio, np.inf)

    best = np.argmin(bound(nodes[:, None]), axis=0)
    lower, upper = nodes[np.maximum(best - 1, 0)], nodes[np.minimum(best + 1, len(nodes) - 1)]
    return minimize_golden_section(bound, lower, nodes[best], upper, bound(nodes[best]), STEPS)[1]


def find_stiffest(n_delay: int) -> tuple[float, float]:
    """Return c = K T/(2 b) and B/b of the stiffest safe coupling with B >= 0."""
    # The set of safe couplings is convex, so the largest safe c as a function of u has a single maximum.
    u = np.linspace(0.0, 1.0, NODES + 1)

    def find_spring(u: np.ndarray) -> np.ndarray:
        """Return the largest safe c for the given u, at most u, because c = u means B = 0."""
        return np.minimum(np.sqrt(u * np.maximum(find_limit(u, n_delay), 0.0)), u)

    best = int(np.argmax(find_spring(u)))
    low, high = u[[max(best - 1, 0)]], u[[min(best + 1, NODES)]]
    (top,), (cost,) = minimize_golden_section(
        lambda u: -find_spring(u), low, u[[best]], high, -find_spring(u[[best]]), STEPS
    )
    return float(-cost), float(top + cost)
