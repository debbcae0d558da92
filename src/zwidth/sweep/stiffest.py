"""The stiffest stable wall of a scene with parts, in SI units."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zwidth.scene import Scene


class Stiffest(NamedTuple):
    """The stiffest stable wall with B >= 0, in SI units; NaN where no wall is stable."""

    stiffness: float
    virtual_damping: float
    frequency: float  # in Hz
    kind: str


def find_stiffest(scene: Scene) -> Stiffest:
    """The stiffest stable wall of a scene among those with B >= 0."""
    units, best = scene.units, Stiffest(math.nan, math.nan, math.nan, "none")
    row = scene.stable_stiffness(0.0)
    found = [(float(row.max()), 0.0, math.nan, "no_damping")] if row.size else []
    for edge in (*scene.border.curved, *scene.border.straight):
        alpha = np.where(edge.beta >= 0.0, edge.alpha, -np.inf)
        k = int(np.argmax(alpha))
        if np.isfinite(alpha[k]):
            hertz = float(edge.w[k]) / (2.0 * math.pi * scene.timing.period)
            smooth = edge.line < 0 and 0 < k < edge.w.size - 1
            kind = "smooth" if smooth else "corner"
            wall = (float(alpha[k]) * units.stiffness, float(edge.beta[k]) * units.virtual_damping)
            found.append((*wall, hertz, kind))
    top = max(found, default=None)
    return Stiffest(*top) if top is not None and top[0] > 0 else best
