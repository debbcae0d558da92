"""Evaluate the two formulas of Colgate's passivity condition that the rigid and every linear loop share.

At one frequency a wall needs the physical damping N, the larger root of ``N^2 - A N - S/4 = 0``. A is the damping that
the wall would need with an integer delay, and S >= 0, proportional to f (1 - f), is the effect of the fraction f of the
delay (docs/theory/passivity.md, P4). The wall is passive if the damping of the device exceeds N at every frequency; the
passivity margin is the least difference.
"""

from __future__ import annotations

from typing import Any

from zwidth.core.types import Array
from zwidth.core.xp import namespace


def solve_larger_root(A: Array, S: Array, xp: Any) -> tuple[Array, Array]:
    """Return the larger root N of ``N^2 - A N - S/4 = 0``, and ``2 N - A``, with finite derivatives at A = S = 0."""
    discriminant = A * A + S
    root = xp.where(discriminant > 0, xp.sqrt(xp.where(discriminant > 0, discriminant, 1.0)), 0.0)
    difference = root - A
    return xp.where(A > 0, 0.5 * (root + A), 0.5 * S / xp.where(difference > 0, difference, 1.0)), root


def limit_margin(margin: Array, stiffness: Array) -> Array:
    """Return the passivity margin, reduced to at most the stiffness if the stiffness is negative.

    A wall with negative stiffness supplies energy without limit for w -> 0, which the condition at w > 0 does not
    detect.

    Args:
        margin: passivity margin from Colgate's condition at w > 0.
        stiffness: normalized stiffness of the wall at w = 0.
    """
    xp = namespace(margin, stiffness)
    return xp.where(stiffness < 0, xp.minimum(margin, stiffness), margin)
