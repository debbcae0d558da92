"""What studies say of a device with parts, in SI units: outlines of its stable set, its stiffest wall, its damping."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from zwidth.figures.table import SI_COLUMNS
from zwidth.linear.stiffest import StiffestWall
from zwidth.scene import Scene
from zwidth.stability.passivity import passivity_margin
from zwidth.stability.region import stable_region
from zwidth.stability.ridge import RidgeKind
from zwidth.status import Status
from zwidth.studies.outcome import Table

if TYPE_CHECKING:
    from zwidth.figures.region import Outlines

_ANGLES = 721


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


def name_kind(wall: StiffestWall) -> str:
    """The kind of a stiffest wall in words, "none" where there is no such wall."""
    return RidgeKind(int(wall.kind)).name.lower() if wall.status == Status.OK else "none"


def tabulate_walls(label: str, walls: Mapping[str, StiffestWall]) -> Table:
    """The walls that a figure marks on one device, by what each is."""
    table: Table = {"label": np.array([label] * len(walls)), "wall": np.array(list(walls))}
    table[SI_COLUMNS[0]] = np.array([wall.stiffness for wall in walls.values()])
    table[SI_COLUMNS[1]] = np.array([wall.virtual_damping for wall in walls.values()])
    return table


def find_edges(delta: float, d: float) -> dict[str, Outlines]:
    """Where the stable and the passive walls of a rigid device end, normalized."""
    found = stable_region(delta, d)
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
