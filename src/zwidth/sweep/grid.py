"""Build the grid of a sweep: its dimensions, their values, and the parameters of any block of the grid.

A sweep varies parameters of walls (stiffness and virtual damping, or their normalized values alpha and beta) and
parameters of devices. A *block* of the grid contains D devices with the same A values of stiffness and B values of
virtual damping each. In a *physical* sweep the parameters are in SI units, and this module normalizes them; in a
*normalized* sweep they are used as specified: alpha, beta, delta (physical damping), d (delay in sampling periods). The
*family* of an output is "wall" (one value per wall) or "device" (one value per device). A *line* is the set of walls
of one device with the same beta.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from zwidth.config.device_table import LABEL
from zwidth.config.sweep import SweepStudy
from zwidth.stability.rigid.normalization import normalize
from zwidth.units.outputs import Family
from zwidth.units.quantities import PARAMETERS, WALL


class Block(NamedTuple):
    """The normalized parameters of a block: D devices with A x B walls each, every alpha with every beta."""

    delta: np.ndarray  # normalized physical damping, shape (D,)
    d: np.ndarray  # delay in sampling periods, shape (D,)
    all_alpha: np.ndarray  # every alpha of the whole grid, shape (D, number of alphas)
    all_beta: np.ndarray  # every beta of the whole grid, shape (D, number of betas)
    alphas: slice  # range of the block in ``all_alpha``
    betas: slice  # range of the block in ``all_beta``
    mass: np.ndarray  # mass in kg, or kg m^2 for a rotary device; 1 in a normalized sweep; shape (D,)
    period: np.ndarray  # sampling period in s; 1 in a normalized sweep; shape (D,)
    lines: int  # number of lines in the whole grid

    @property
    def alpha(self) -> np.ndarray:
        """The alphas of the block, shape (D, A)."""
        return self.all_alpha[:, self.alphas]

    @property
    def beta(self) -> np.ndarray:
        """The betas of the block, shape (D, B)."""
        return self.all_beta[:, self.betas]


class SceneBlock(NamedTuple):
    """The parameters of a block in the units of the configuration: D devices with A x B walls each."""

    parameters: dict[str, np.ndarray]  # parameters of the devices by name, each of shape (D,)
    stiffness: np.ndarray  # stiffness in N/m or N m/rad; alpha in a normalized sweep; shape (D, A)
    virtual_damping: np.ndarray  # virtual damping in N s/m or N m s/rad; beta in a normalized sweep; shape (D, B)


class Grid:
    """The grid of a sweep: its dimensions, and the parameters of its points.

    The dimensions of devices precede those of walls.
    """

    def __init__(self, study: SweepStudy) -> None:
        self.axes, self.unit_system = study.axes, study.unit_system
        self.physical = study.axes.physical
        self.wall_names = ("stiffness", "virtual_damping") if self.physical else ("alpha", "beta")
        sizes = study.axes.sizes
        self.wall_dims = tuple(name for name in sizes if name in WALL)
        self.device_dims = tuple(name for name in sizes if name not in WALL)
        self.dims = (*self.device_dims, *self.wall_dims)
        self.sizes = sizes

    def dims_of(self, family: Family) -> tuple[str, ...]:
        """Return the names of the dimensions of a family of outputs."""
        return self.dims if family == "wall" else self.device_dims

    def shape_of(self, family: Family) -> tuple[int, ...]:
        """Return the number of values along each dimension of a family of outputs."""
        return tuple(self.sizes[name] for name in self.dims_of(family))

    @cached_property
    def _values(self) -> dict[str, np.ndarray]:
        """The values of every parameter that the configuration specifies, as 1-D arrays by name."""
        table = self.axes.devices
        columns = {name: table.values(name) for name in table.columns} if table else {}
        axes = {name: getattr(self.axes, name) for name in PARAMETERS}
        return columns | {name: axis.values() for name, axis in axes.items() if axis is not None}

    def coordinates(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]]:
        """Return the coordinate variables of a store: dimensions, values and attributes by name of the variable.

        The coordinates are the parameters that the configuration specifies and, if it reads the devices from a table,
        the labels of the devices.
        """
        table = self.axes.devices
        variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, Any]]] = {}
        if table is not None:
            labels = table.labels or tuple(str(row) for row in range(1, table.size + 1))
            variables["device"] = (("device",), np.array(labels), {"long_name": f"{LABEL} of the device"})
        for name, values in self._values.items():
            in_periods = name == "delay" and self.axes.delay_in_periods
            units = "sampling periods" if in_periods else self.unit_system[PARAMETERS[name].unit]
            attributes = {"long_name": PARAMETERS[name].long_name, "units": units}
            variable, dim = PARAMETERS[name].variable, self._dim_of(name)
            dims = () if dim is None else (dim.replace(".", "_"),)
            variables[variable] = (dims, values if dims else values[0], attributes)
        return variables

    def scene_block(self, slices: tuple[slice, ...]) -> SceneBlock:
        """Return a block with its parameters as specified in the configuration.

        ``slices`` contains one slice per dimension, or one per device dimension only. In the second case the block has
        the first value of each wall dimension.
        """
        by_dim = dict(zip(self.dims, slices, strict=False))
        for name in self.wall_dims:
            by_dim.setdefault(name, slice(0, 1))
        shape = tuple(len(range(*by_dim[name].indices(self.sizes[name]))) for name in self.device_dims)
        parameters = {name: self._device_values(name, by_dim, shape) for name in self.axes.given if name not in WALL}
        walls = [self._wall_values(name, by_dim, shape) for name in self.wall_names]
        return SceneBlock(parameters, *(np.broadcast_to(part, (math.prod(shape), part.shape[1])) for part in walls))

    def block(self, slices: tuple[slice, ...]) -> Block:
        """Return a block with normalized parameters; it also stores every alpha and beta of the whole grid.

        ``slices`` has the same meaning as for `scene_block`.
        """
        alphas = betas = slice(0, 1)
        if len(slices) == len(self.dims):
            by_dim = dict(zip(self.dims, slices, strict=True))
            alphas, betas = (
                slice(*by_dim.get(name, alphas).indices(self.sizes.get(name, 1))[:2]) for name in self.wall_names
            )
            slices = (*slices[: len(self.device_dims)], *[slice(None)] * len(self.wall_dims))
        given = self.scene_block(slices)
        lines, zeros = self.size_of("device") * given.virtual_damping.shape[1], np.zeros(len(given.stiffness))
        if not self.physical:
            delta, d = given.parameters["delta"], given.parameters["d"]
            return Block(delta, d, *given[1:], alphas, betas, zeros + 1.0, zeros + 1.0, lines)
        mass, damping, delay = (given.parameters.get(name, zeros) for name in ("mass", "damping", "delay"))
        rate = given.parameters.get("rate")
        period = given.parameters["period"] if rate is None else 1.0 / rate
        in_periods = self.axes.delay_in_periods
        # Suppress NumPy's warnings of overflow, because the status of a point reports it.
        with np.errstate(all="ignore"):
            device = normalize(mass=mass, damping=damping, period=period, delay=zeros if in_periods else delay)
            units = {"mass": mass[:, None], "period": period[:, None]}
            alpha = normalize(**units, stiffness=given.stiffness).alpha
            beta = normalize(**units, virtual_damping=given.virtual_damping).beta
        d = delay if in_periods else device.d
        return Block(device.delta, d, alpha, beta, alphas, betas, mass, period, lines)

    def _device_values(self, name: str, by_dim: dict[str, slice], shape: tuple[int, ...]) -> np.ndarray:
        """Return the values of a parameter for all devices of a block, as a 1-D array; 0 if it is not specified.

        Args:
            name: Name of the parameter.
            by_dim: Slice of the block by name of the dimension.
            shape: Number of values of the block along each device dimension.
        """
        values = self._values.get(name, np.zeros(1))
        dim = self._dim_of(name)
        if dim is not None:
            axis = self.device_dims.index(dim)
            values = values[by_dim[dim]].reshape([-1 if index == axis else 1 for index in range(len(shape))])
        return np.broadcast_to(values, shape or (1,)).ravel()

    def _wall_values(self, name: str, by_dim: dict[str, slice], shape: tuple[int, ...]) -> np.ndarray:
        """Return the values of a parameter of the walls in a block; the arguments are those of `_device_values`.

        The shape is (1, number of values) if the parameter is a dimension of the walls, otherwise (D, 1).
        """
        if name in self.wall_dims:
            return self._values[name][by_dim[name]][None, :]
        return self._device_values(name, by_dim, shape)[:, None]

    def _dim_of(self, name: str) -> str | None:
        """Return the name of the dimension along which a parameter varies; None if the parameter is constant."""
        table = self.axes.devices
        if table is not None and name in table.columns:
            return "device"
        return name if name in self.sizes else None

    def size_of(self, family: Family) -> int:
        """Return the number of points of a family of outputs."""
        return math.prod(self.shape_of(family))
