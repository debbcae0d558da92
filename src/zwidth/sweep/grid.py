"""The grid of a sweep: its dimensions, their values, and the normalized parameters of any block of it."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.config.device_table import LABEL
from zwidth.config.sweep import SweepStudy
from zwidth.loops.rigid.normalization import normalize
from zwidth.words.quantities import PARAMETERS, WALL, Family


class Block(NamedTuple):
    """A block of the grid, normalized: D devices with A x B walls each, every alpha with every beta."""

    delta: np.ndarray  # shape (D,)
    d: np.ndarray  # shape (D,)
    all_alpha: np.ndarray  # of the whole grid, shape (D, ..), likewise beta
    all_beta: np.ndarray
    alphas: slice  # which of them are the block's
    betas: slice
    mass: np.ndarray  # in SI units, shape (D,); 1 in a normalized sweep, likewise the period
    period: np.ndarray
    rows: int  # of one beta, in the whole grid

    @property
    def alpha(self) -> np.ndarray:
        """Those of its walls, shape (D, A)."""
        return self.all_alpha[:, self.alphas]

    @property
    def beta(self) -> np.ndarray:
        """Those of its walls, shape (D, B)."""
        return self.all_beta[:, self.betas]


class SceneBlock(NamedTuple):
    """A block of the grid as it is given: D devices by their parameters, with A x B walls each."""

    parameters: dict[str, np.ndarray]  # each of shape (D,)
    stiffness: np.ndarray  # shape (D, A); alpha in a normalized sweep, likewise beta
    virtual_damping: np.ndarray  # shape (D, B)


class Grid:
    """Grid of a sweep: its dimensions, those of walls last, and the parameters at its points."""

    def __init__(self, study: SweepStudy) -> None:
        self.axes, self.unit_system = study.axes, study.unit_system
        self.physical = study.axes.physical
        self.of_wall = ("stiffness", "virtual_damping") if self.physical else ("alpha", "beta")
        sizes = study.axes.sizes
        self.wall_dims = tuple(name for name in sizes if name in WALL)
        self.device_dims = tuple(name for name in sizes if name not in WALL)
        self.dims = (*self.device_dims, *self.wall_dims)
        self.sizes = sizes

    def dims_of(self, family: Family) -> tuple[str, ...]:
        return self.dims if family == "wall" else self.device_dims

    def shape_of(self, family: Family) -> tuple[int, ...]:
        return tuple(self.sizes[name] for name in self.dims_of(family))

    @cached_property
    def _values(self) -> dict[str, np.ndarray]:
        """All given parameters, as flat arrays."""
        table = self.axes.devices
        columns = {name: table.values(name) for name in table.columns} if table else {}
        own = {name: getattr(self.axes, name) for name in PARAMETERS}
        return columns | {name: axis.values() for name, axis in own.items() if axis is not None}

    def coordinates(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]]:
        """Return dimensions, values and attributes of each parameter by its name in a store, and labels of devices."""
        table = self.axes.devices
        found: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]] = {}
        if table is not None:
            labels = table.labels or tuple(str(row) for row in range(1, table.size + 1))
            found["device"] = (("device",), np.array(labels), {"long_name": f"{LABEL} of the device"})
        for name, values in self._values.items():
            in_periods = name == "delay" and self.axes.delay_in_periods
            units = "sampling periods" if in_periods else self.unit_system[PARAMETERS[name].unit]
            attributes = {"long_name": PARAMETERS[name].long_name, "units": units}
            variable, dim = PARAMETERS[name].variable, self._dim_of(name)
            dims = () if dim is None else (dim.replace(".", "_"),)
            found[variable] = (dims, values if dims else values[0], attributes)
        return found

    def scene_block(self, place: tuple[slice, ...]) -> SceneBlock:
        """Return a block with its given parameters; ``place`` has a slice per dimension, at least those of devices."""
        slices = dict(zip(self.dims, place, strict=False))
        for name in self.wall_dims:
            slices.setdefault(name, slice(0, 1))
        shape = tuple(len(range(*slices[name].indices(self.sizes[name]))) for name in self.device_dims)
        parameters = {name: self._device(name, slices, shape) for name in self.axes.given if name not in WALL}
        walls = [self._wall(name, slices, shape) for name in self.of_wall]
        return SceneBlock(parameters, *(np.broadcast_to(part, (math.prod(shape), part.shape[1])) for part in walls))

    def block(self, place: tuple[slice, ...]) -> Block:
        """Return a block in normalized parameters, with the walls of the whole grid."""
        alphas = betas = slice(0, 1)
        if len(place) == len(self.dims):
            slices = dict(zip(self.dims, place, strict=True))
            alphas, betas = (
                slice(*slices.get(name, alphas).indices(self.sizes.get(name, 1))[:2]) for name in self.of_wall
            )
            place = (*place[: len(self.device_dims)], *[slice(None)] * len(self.wall_dims))
        given = self.scene_block(place)
        rows, none = self.size_of("device") * given.virtual_damping.shape[1], np.zeros(len(given.stiffness))
        if not self.physical:
            delta, d = given.parameters["delta"], given.parameters["d"]
            return Block(delta, d, *given[1:], alphas, betas, none + 1.0, none + 1.0, rows)
        mass, damping, delay = (given.parameters.get(name, none) for name in ("mass", "damping", "delay"))
        rate = given.parameters.get("rate")
        period = given.parameters["period"] if rate is None else 1.0 / rate
        in_periods = self.axes.delay_in_periods
        # Suppress warnings, because the status of a point reports an overflow.
        with np.errstate(all="ignore"):
            device = normalize(mass=mass, damping=damping, period=period, delay=none if in_periods else delay)
            units = {"mass": mass[:, None], "period": period[:, None]}
            alpha = normalize(**units, stiffness=given.stiffness).alpha
            beta = normalize(**units, virtual_damping=given.virtual_damping).beta
        d = delay if in_periods else device.d
        return Block(device.delta, d, alpha, beta, alphas, betas, mass, period, rows)

    def _device(self, name: str, slices: dict[str, slice], shape: tuple[int, ...]) -> np.ndarray:
        """Return a parameter of the devices of a block as a flat array; 0 if it is not given."""
        values = self._values.get(name, np.zeros(1))
        dim = self._dim_of(name)
        if dim is not None:
            axis = self.device_dims.index(dim)
            values = values[slices[dim]].reshape([-1 if index == axis else 1 for index in range(len(shape))])
        return np.broadcast_to(values, shape or (1,)).ravel()

    def _wall(self, name: str, slices: dict[str, slice], shape: tuple[int, ...]) -> np.ndarray:
        """Return a parameter of the walls of a block: one row for all devices, or one row per device."""
        if name in self.wall_dims:
            return self._values[name][slices[name]][None, :]
        return self._device(name, slices, shape)[:, None]

    def _dim_of(self, name: str) -> str | None:
        table = self.axes.devices
        if table is not None and name in table.columns:
            return "device"
        return name if name in self.sizes else None

    def size_of(self, family: Family) -> int:
        return math.prod(self.shape_of(family))
