"""What studies say of a device with parts, in SI units: outlines of its stable set, its stiffest wall, its damping."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.figures.table import SI_COLUMNS
from zwidth.loops.rigid.region import stable_region
from zwidth.scenes.assessment import name_kind
from zwidth.scenes.stiffest import StiffestWall
from zwidth.studies.passivity import unit_outline

if TYPE_CHECKING:
    from zwidth.figures.region import Outlines


def summarize_stiffest(wall: StiffestWall) -> dict[str, Any]:
    """A stiffest wall as columns of a table."""
    found = dict(zip(SI_COLUMNS, map(float, wall[:2]), strict=True))
    return {**found, "frequency_Hz": float(wall.frequency), "kind": name_kind(wall)}


def find_edges(delta: float, d: float) -> dict[str, Outlines]:
    """Where the stable and the passive walls of a rigid device end, normalized."""
    found = stable_region(delta, d)
    edges: dict[str, Outlines] = {"stable": [(np.stack([found.alpha, found.beta], -1), False)]}
    if delta > 0:
        edges["passive"] = [(delta * np.stack(unit_outline(d), -1), False)]
    return edges
