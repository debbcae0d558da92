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
# Places between which a bound is looked for, and how often: to the last digit.
_PLACES, _ROUNDS = np.arange(1, 32) / 32.0, 11


def trace_outlines(scene: Scene, **columns: Any) -> Iterator[dict[str, Any]]:
    """The outlines of the stable set, the largest first, as columns; the hole of an island lies inside of it."""
    units = scene.units
    for number, outline in enumerate(scene.stable_region(), start=1):
        piece = "hole" if outline.hole else ("outline" if number == 1 else "island")
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


def bound_damping(scene: Scene, stiffness: float, virtual_damping: float) -> tuple[float, float]:
    """The ends of the stable damping around a stable wall at its stiffness, in N s/m."""
    below, above = [-math.inf], [math.inf]
    for outline in scene.stable_region():
        x, y = (np.append(part, part[0]) for part in outline[:2])
        k = np.flatnonzero((x[:-1] < stiffness) != (x[1:] < stiffness))
        crossed = y[k] + (stiffness - x[k]) / (x[k + 1] - x[k]) * (y[k + 1] - y[k])
        below += crossed[crossed <= virtual_damping].tolist()
        above += crossed[crossed > virtual_damping].tolist()
    return tuple(_sharpen(scene, stiffness, virtual_damping, end) for end in (max(below), min(above)))  # pyright: ignore


def _sharpen(scene: Scene, stiffness: float, inside: float, near: float) -> float:
    """The last stable damping from ``inside`` on towards a bound that the polygon of the outline has nearly right."""
    if not math.isfinite(near):
        return near
    outside = near + 0.05 * (near - inside)
    for _ in range(_ROUNDS):
        places = inside + (outside - inside) * _PLACES
        held = scene.is_stable(stiffness, places)
        first = int(np.argmin(held)) if not held.all() else held.size
        inside, outside = (
            float(places[first - 1]) if first else inside,
            float(places[first]) if first < held.size else outside,
        )
    return inside


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
