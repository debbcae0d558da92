"""Evaluate the two formulas of Colgate's passivity condition that the rigid and every linear loop share.

At one frequency a wall needs the physical damping N, the larger root of ``N^2 - A N - S/4 = 0``. A is the damping that
the force of the wall needs if its delay is an integer number of periods, and S >= 0 is the effect of the fraction f of
the delay, in proportion to f (1 - f) (docs/theory/passivity.md, P4). The wall is passive if the damping of the device
exceeds N at every frequency; the passivity margin is the least difference.
"""

from __future__ import annotations

from typing import Any

from zwidth.core.types import Array
from zwidth.core.xp import namespace


def solve_larger_root(A: Array, S: Array, xp: Any) -> tuple[Array, Array]:
    """Return the larger root N of ``N^2 - A N - S/4 = 0``, and 2 N - A, with finite derivatives at A = S = 0."""
    discriminant = A * A + S
    root = xp.where(discriminant > 0, xp.sqrt(xp.where(discriminant > 0, discriminant, 1.0)), 0.0)
    difference = root - A
    return xp.where(A > 0, 0.5 * (root + A), 0.5 * S / xp.where(difference > 0, difference, 1.0)), root


def limit_margin(margin: Array, stiffness: Array) -> Array:
    """Limit the margin to the stiffness if it is negative: such a wall supplies energy without limit at w -> 0.

    The condition at w > 0 does not detect this energy.

    Args:
        margin: passivity margin by the condition.
        stiffness: normalized stiffness of the wall at w = 0.
    """
    xp = namespace(margin, stiffness)
    return xp.where(stiffness < 0, xp.minimum(margin, stiffness), margin)
