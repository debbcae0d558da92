"""The grid of a sweep: its dimensions, their values, and the normalized parameters of any block of it."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.config.device_table import LABEL
from zwidth.config.sweep import SweepStudy
from zwidth.loops.normalization import normalize
from zwidth.words.quantities import PARAMETERS, WALL, Family
from zwidth.words.rotation import own_unit


class Plane(NamedTuple):
    """All alphas (D, ..) and betas (D, ..) of the devices of a block, and which of them are the block's."""

    alpha: np.ndarray
    beta: np.ndarray
    alphas: slice
    betas: slice


class Block(NamedTuple):
    """A block of the grid, normalized: D devices with A x B walls each, every alpha with every beta."""

    delta: np.ndarray  # shape (D,)
    d: np.ndarray  # shape (D,)
    alpha: np.ndarray  # shape (D, A)
    beta: np.ndarray  # shape (D, B)
    mass: np.ndarray  # in SI units, shape (D,); empty in a normalized sweep, likewise the period
    period: np.ndarray
    plane: Plane  # the whole grid's walls, of which the block may hold a part only
    devices: int  # of the whole grid

    @property
    def rows(self) -> int:
        """How many rows of one beta the whole grid has."""
        return self.devices * self.plane.beta.shape[1]

    @property
    def walls(self) -> int:
        """How many walls the whole grid has."""
        return self.rows * self.plane.alpha.shape[1]


class SceneBlock(NamedTuple):
    """A block of the grid in SI units: D devices by their parameters, with A x B walls each."""

    parameters: dict[str, np.ndarray]  # each of shape (D,)
    stiffness: np.ndarray  # shape (D, A)
    virtual_damping: np.ndarray  # shape (D, B)


class Grid:
    """The dimensions of a sweep, those of walls last, and what lies at each of their points."""

    def __init__(self, study: SweepStudy) -> None:
        self.axes = study.axes
        self.physical = study.axes.physical
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
        """Every parameter that is given, as a flat array."""
        table = self.axes.devices
        columns = {name: table.values(name) for name in table.columns} if table else {}
        own = {name: getattr(self.axes, name) for name in PARAMETERS}
        return columns | {name: axis.values() for name, axis in own.items() if axis is not None}

    def coordinates(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]]:
        """Dimensions, values and attributes of every parameter by its name in a store, and the labels of devices."""
        table = self.axes.devices
        found: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]] = {}
        if table is not None:
            labels = table.labels or tuple(str(row) for row in range(1, table.size + 1))
            found["device"] = (("device",), np.array(labels), {"long_name": f"{LABEL} of the device"})
        for name, values in self._values.items():
            units = (
                "sampling periods"
                if name == "delay" and self.axes.delay_in_periods
                else own_unit(PARAMETERS[name].unit)
            )
            attributes = {"long_name": PARAMETERS[name].long_name, "units": units}
            variable, dim = PARAMETERS[name].variable, self._dim_of(name)
            dims = () if dim is None else (dim.replace(".", "_"),)
            found[variable] = (dims, values if dims else values[0], attributes)
        return found

    def block(self, place: tuple[slice, ...]) -> Block:
        """The normalized parameters of a block, given one slice for every dimension, or for those of devices."""
        slices, shape = self._cut(place)
        cut = [slice(0, 1), slice(0, 1)]
        if len(place) == len(self.dims):
            names = ("stiffness", "virtual_damping") if self.physical else ("alpha", "beta")
            cut = [slice(*slices.get(name, slice(0, 1)).indices(self.sizes.get(name, 1))[:2]) for name in names]
            slices |= dict.fromkeys(self.wall_dims, slice(None))
        if self.physical:
            delta, d, alpha, beta, mass, period = self._physical_block(slices, shape)
        else:
            delta, d = (self._device(name, slices, shape) for name in ("delta", "d"))
            alpha, beta = (self._wall(name, slices, shape) for name in ("alpha", "beta"))
            mass, period = np.empty(0), np.empty(0)
        alpha, beta = self._broadcast_walls(alpha, beta, delta.size)
        plane = Plane(alpha, beta, *cut)
        return Block(
            delta,
            d,
            alpha[:, plane.alphas],
            beta[:, plane.betas],
            mass,
            period,
            plane,
            math.prod(self.shape_of("device")),
        )

    def scene_block(self, place: tuple[slice, ...]) -> SceneBlock:
        """The same in SI units, of a sweep whose devices have parts."""
        slices, shape = self._cut(place)
        names = [name for name in self.axes.given if name not in WALL]
        parameters = {name: self._device(name, slices, shape) for name in names}
        stiffness, damping = (self._wall(name, slices, shape) for name in ("stiffness", "virtual_damping"))
        return SceneBlock(parameters, *self._broadcast_walls(stiffness, damping, math.prod(shape)))

    def _cut(self, place: tuple[slice, ...]) -> tuple[dict[str, slice], tuple[int, ...]]:
        """The slice of every dimension, and the shape of the devices."""
        slices = dict(zip(self.dims, place, strict=False))
        for name in self.wall_dims:
            slices.setdefault(name, slice(0, 1))
        return slices, tuple(len(range(*slices[name].indices(self.sizes[name]))) for name in self.device_dims)

    def _physical_block(self, slices: dict[str, slice], shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
        mass, damping, delay = (self._device(name, slices, shape) for name in ("mass", "damping", "delay"))
        period = (
            1.0 / self._device("rate", slices, shape)
            if "rate" in self._values
            else self._device("period", slices, shape)
        )
        in_periods = self.axes.delay_in_periods
        # Beyond float64 is a status of the point, not a warning.
        with np.errstate(all="ignore"):
            device = normalize(mass=mass, damping=damping, period=period, delay=np.zeros(1) if in_periods else delay)
            stiffness, virtual_damping = (self._wall(name, slices, shape) for name in ("stiffness", "virtual_damping"))
            walls = normalize(
                mass=mass[:, None], period=period[:, None], stiffness=stiffness, virtual_damping=np.zeros((1, 1))
            )
            damped = normalize(mass=mass[:, None], period=period[:, None], virtual_damping=virtual_damping)
        d = delay if in_periods else device.d
        return device.delta, np.broadcast_to(d, mass.shape), walls.alpha, damped.beta, mass, period

    def _device(self, name: str, slices: dict[str, slice], shape: tuple[int, ...]) -> np.ndarray:
        """A parameter of the devices of a block, flat; 0 where it is not given."""
        values = self._values.get(name, np.zeros(1))
        dim = self._dim_of(name)
        if dim is not None:
            axis = self.device_dims.index(dim)
            values = values[slices[dim]].reshape([-1 if index == axis else 1 for index in range(len(shape))])
        return np.broadcast_to(values, shape or (1,)).ravel()

    def _wall(self, name: str, slices: dict[str, slice], shape: tuple[int, ...]) -> np.ndarray:
        """A parameter of the walls of a block: one row for all devices, or one column with an entry a device."""
        if name in self.wall_dims:
            return self._values[name][slices[name]][None, :]
        return self._device(name, slices, shape)[:, None]

    def _dim_of(self, name: str) -> str | None:
        table = self.axes.devices
        if table is not None and name in table.columns:
            return "device"
        return name if name in self.sizes else None

    @staticmethod
    def _broadcast_walls(alpha: np.ndarray, beta: np.ndarray, devices: int) -> tuple[np.ndarray, np.ndarray]:
        return np.broadcast_to(alpha, (devices, alpha.shape[1])), np.broadcast_to(beta, (devices, beta.shape[1]))

    def size_of(self, family: Family) -> int:
        return math.prod(self.shape_of(family))
