"""What studies say of a device with parts, in SI units: outlines of its stable set, its stiffest wall, its damping."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from zwidth.loops.rigid.passivity import passivity_margin
from zwidth.loops.rigid.region import stable_region
from zwidth.loops.rigid.ridge import RidgeKind
from zwidth.scenes.stiffest import StiffestWall
from zwidth.words.status import Status

if TYPE_CHECKING:
    from zwidth.figures.region import Outlines

_ANGLES = 721


def name_kind(wall: StiffestWall) -> str:
    """The kind of a stiffest wall in words, "none" where there is no such wall."""
    return RidgeKind(int(wall.kind)).name.lower() if wall.status == Status.OK else "none"


def find_edges(delta: float, d: float) -> dict[str, Outlines]:
    """Where the stable and the passive walls of a rigid device end, normalized; none where that is not verified."""
    found = stable_region(delta, d)
    if not found.verified:
        return {}
    edges: dict[str, Outlines] = {"stable": [(np.stack([found.alpha, found.beta], -1), False)]}
    if delta > 0:
        edges["passive"] = [(_find_passive(delta, d), False)]
    return edges


def _find_passive(delta: float, d: float) -> np.ndarray:
    """The edge of the passive walls: the damping that a wall needs grows as the wall does."""
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, _ANGLES)
    walls = np.stack([np.cos(angle), np.sin(angle)], -1)
    needed = -np.asarray(passivity_margin(walls[:, 0], walls[:, 1], 0.0, d))
    # The smallest cosines are rounded zeros.
    walls[[0, -1], 0] = 0.0
    return delta * walls / needed[:, None]
