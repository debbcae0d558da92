"""Where the stable and the passive walls of a sweep end, exactly: for figures, which compute nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from zwidth.figures.region import Outlines
from zwidth.studies.passivity import find_edges
from zwidth.sweep.store import Store
from zwidth.words.errors import InputError

if TYPE_CHECKING:
    import xarray

Edges: TypeAlias = Callable[["xarray.Dataset"], dict[str, Outlines]]

_PLANES = ({"alpha", "beta"}, {"stiffness", "virtual_damping"})


def make_edges(store: Store) -> Edges:
    """What gives the outlines of the stable and the passive walls of a part of a sweep, at one device and delay.

    The part is one of `zwidth.figures.grid.prepare`. Outlines are in its units, stiffness first. Of what is not a
    plane of walls, and where nothing is proved, there are none.
    """
    grid = store.grid
    at_device = cache(lambda place: _outline(store, place))

    def edges(part: xarray.Dataset) -> dict[str, Outlines]:
        walls = {str(dim) for dim in part.dims}
        if walls not in _PLANES:
            return {}
        places = []
        for dim in grid.device_dims:
            if dim not in part.coords:
                places.append(0)
            elif dim == "device":
                labels = [str(label) for label in grid.coordinates()["device"][1]]
                places.append(labels.index(str(part["device"].values)))
            else:
                value = float(part[dim]) / part[dim].attrs["factor"]
                places.append(int(np.argmin(np.abs(np.asarray(grid.coordinates()[dim][1]) - value))))
        factors = [
            part[dim].attrs["factor"] for dim in sorted(walls, key=lambda dim: dim not in ("alpha", "stiffness"))
        ]
        found = at_device(tuple(places))
        return {name: [(points * factors, hole) for points, hole in outlines] for name, outlines in found.items()}

    return edges


def _outline(store: Store, place: tuple[int, ...]) -> dict[str, Outlines]:
    """Outlines in the units of a store."""
    slices = tuple(slice(k, k + 1) for k in place)
    try:
        if store.study.with_parts:
            parameters = store.grid.scene_block(slices).parameters
            scene = store.study.make_scene({name: float(values[0]) for name, values in parameters.items()})
            pieces = scene.stable_region()
            return {"stable": [(np.stack([one.stiffness, one.virtual_damping], -1), one.hole) for one in pieces]}
        block = store.grid.block(slices)
        delta, d = float(block.delta[0]), float(block.d[0])
        found = find_edges(delta, d)
    except InputError:
        return {}
    units = np.ones(2)
    if block.mass.size:
        rate = float(block.mass[0] / block.period[0])
        units = np.array([rate / float(block.period[0]), rate])
    return {name: [(points * units, hole) for points, hole in outlines] for name, outlines in found.items()}
