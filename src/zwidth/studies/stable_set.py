"""What studies say of a device with parts, in SI units: outlines of its stable set, its stiffest wall, its damping."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.assessment import name_kind
from zwidth.figures.table import SI_COLUMNS
from zwidth.linear.stiffest import StiffestWall
from zwidth.scene import Scene
from zwidth.stability.region import stable_region
from zwidth.studies.outcome import Table
from zwidth.studies.passivity import unit_outline

if TYPE_CHECKING:
    from zwidth.figures.region import Outlines


def trace_outlines(scene: Scene, **columns: Any) -> Iterator[dict[str, Any]]:
    """The outlines of the stable set, the largest first, as columns; the hole of an island lies inside of it."""
    units = scene.units
    for number, outline in enumerate(scene.stable_region(), start=1):
        piece = "hole" if outline.hole else ("island" if outline.island else "outline")
        # Closed: the first point comes again at the end.
        stiffness, damping = (np.append(part, part[0]) for part in outline[:2])
        walls = {"alpha": stiffness / units.stiffness, "beta": damping / units.virtual_damping}
        yield {
            **columns,
            "number": number,
            "piece": piece,
            **walls,
            **dict(zip(SI_COLUMNS, (stiffness, damping), strict=True)),
        }


def summarize_stiffest(wall: StiffestWall) -> dict[str, Any]:
    """A stiffest wall as columns of a table."""
    found = dict(zip(SI_COLUMNS, map(float, wall[:2]), strict=True))
    return {**found, "frequency_Hz": float(wall.frequency), "kind": name_kind(wall)}


def tabulate_walls(label: str, walls: Mapping[str, StiffestWall]) -> Table:
    """The walls that a figure marks on one device, by what each is."""
    table: Table = {"label": np.array([label] * len(walls)), "wall": np.array(list(walls))}
    table[SI_COLUMNS[0]] = np.array([wall.stiffness for wall in walls.values()])
    table[SI_COLUMNS[1]] = np.array([wall.virtual_damping for wall in walls.values()])
    return table


def find_edges(delta: float, d: float) -> dict[str, Outlines]:
    """Where the stable and the passive walls of a rigid device end, normalized; none where that is not verified."""
    found = stable_region(delta, d)
    if not found.verified:
        return {}
    edges: dict[str, Outlines] = {"stable": [(np.stack([found.alpha, found.beta], -1), False)]}
    if delta > 0:
        edges["passive"] = [(delta * np.stack(unit_outline(d), -1), False)]
    return edges
