"""Spectral radii of maps: the outermost pole of one node a cell is found by itself and followed to the cell's points.

The derivatives of the node's pole by alpha and beta place the pole of every point; a step of Halley's method, one of
Newton's and the proof of `zwidth.stability.radius` finish it. What is not proved (another pole is the outermost there,
or two are about to meet) is left to the methods for single points. Cells are computed in lists of one length, so that
maps of any size, and of any number of devices, share one compilation.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.batching import concretely, processors
from zwidth.domain import wall_status
from zwidth.stability.circle import loop_of
from zwidth.stability.layout import Points
from zwidth.stability.pole_step import halley_step, moved, value_at
from zwidth.stability.radius import Found, certified

# Points along each side of a cell.
_CELL = 8
# Cells computed at one time: what their points hold stays in the cache.
_LIST = 256
# Smaller maps are not worth a compilation of their own.
SMALLEST_MAP = 1 << 14


class Map(NamedTuple):
    """Arguments of a map: alpha and beta along one axis each, the devices along the others."""

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray  # of all devices
    d: np.ndarray
    order: tuple[int, ...]  # the caller's axes: those of the devices, then beta's, then alpha's
    shape: tuple[int, ...]  # in this order

    @property
    def size(self) -> int:
        """How many points there are."""
        return self.alpha.size * self.beta.size * self.d.size

    def good(self) -> bool:
        """Whether every argument is one that has a spectral radius."""
        walls = [wall_status(self.alpha, 0.0, 1.0, 0.0), wall_status(0.0, self.beta, 1.0, 0.0)]
        return not any(np.any(status) for status in (*walls, wall_status(0.0, 0.0, self.delta, self.d)))

    def of(self, part: np.ndarray) -> Map:
        """Some of the devices; the axes are then these devices, beta's and alpha's."""
        shape = (part.size, self.beta.size, self.alpha.size)
        return Map(self.alpha, self.beta, self.delta[part], self.d[part], (0, 1, 2), shape)


def as_map(points: Points) -> Map | None:
    """The points as a map of one or several devices, where they are one and it is large enough."""
    shape, alone = points.shape, []
    for name in ("beta", "alpha"):
        varying = [axis for axis, length in enumerate(getattr(points, name).shape) if length > 1]
        # By name: one and the same array may be given twice.
        others = [array for other, array in points._asdict().items() if other != name]
        if len(varying) != 1 or any(other.shape[varying[0]] > 1 for other in others):
            return None
        alone.append(varying[0])
    if points.alpha.size * points.beta.size < SMALLEST_MAP:
        return None
    others = tuple(axis for axis in range(len(shape)) if axis not in alone)
    order = (*others, *alone)
    devices = tuple(shape[axis] for axis in others)
    delta, d = (
        np.broadcast_to(array.transpose(order).reshape([array.shape[axis] for axis in others]), devices).reshape(-1)
        for array in (points.delta, points.d)
    )
    whole = tuple(shape[axis] for axis in order)
    return Map(points.alpha.reshape(-1), points.beta.reshape(-1), delta, d, order, whole)


@cache
def _cells(fractional: bool) -> Any:
    """The compiled work on a list of cells: arrays (points of beta, points of alpha, cells)."""
    import jax

    def kernel(alpha: Array, beta: Array, node: Array, re: Array, im: Array, tolerance: Array) -> Found:
        node, re, im = node[:, None, None, :], re[None, None, :], im[None, None, :]
        middle = value_at(re, im, loop_of(*node, fractional), fractional)
        back = middle.first.conjugate() * (-1.0 / (middle.first.real**2 + middle.first.imag**2))
        by_alpha, by_beta = middle.by_alpha * back, middle.by_beta * back
        alpha, beta = alpha[None, :, :], beta[:, None, :]
        da, db = alpha - node[0], beta - node[1]
        nothing = 0.0 * node[2]
        device = loop_of(nothing, nothing, node[2], node[3], fractional)
        loop = device._replace(alpha=alpha, beta=beta, s=alpha + beta)
        start = moved(
            re + (da * by_alpha.real + db * by_beta.real), im, 0.0, da * by_alpha.imag + db * by_beta.imag
        )
        return certified(*halley_step(*start, loop, fractional), tolerance, loop, fractional, True)

    return jax.jit(kernel)


def _cut(values: np.ndarray) -> np.ndarray:
    """Values in cells; the last value fills up."""
    missing = -values.size % _CELL
    return np.concatenate([values, np.full(missing, values[-1])]).reshape(-1, _CELL)


def nodes_of(area: Map) -> list[np.ndarray]:
    """alpha, beta, delta and d of the cells' middles: device by device, row by row."""
    across, down = _cut(area.alpha), _cut(area.beta)
    middles = (down[:, _CELL // 2][None, :, None], across[:, _CELL // 2][None, None, :])
    beta, alpha, delta, d = np.broadcast_arrays(*middles, area.delta[:, None, None], area.d[:, None, None])
    return [np.array(column).reshape(-1) for column in (alpha, beta, delta, d)]


def followed_poles(
    area: Map, nodes: list[np.ndarray], re: np.ndarray, im: np.ndarray, tolerance: float, fractional: bool
) -> Found:
    """The pole of every point, and whether it is proved to be the outermost, from those of the nodes."""
    across, down = _cut(area.alpha).T, _cut(area.beta).T
    grid = (area.delta.size, down.shape[1], across.shape[1])
    count = re.size
    shape = (area.delta.size, grid[1] * _CELL, grid[2] * _CELL)
    out = Found(*(np.empty(shape, np.bool_ if name == "proved" else np.float64) for name in Found._fields))
    tiles = [leaf.reshape(grid[0], grid[1], _CELL, grid[2], _CELL) for leaf in out]
    run = _cells(fractional)

    def piece(start: int) -> None:
        index = np.minimum(np.arange(start, start + _LIST), count - 1)
        at = np.unravel_index(index, grid)
        node = np.stack([column[index] for column in nodes])
        with concretely():
            found = run(across[:, at[2]], down[:, at[1]], node, re[index], im[index], tolerance)
            for tile, leaf in zip(tiles, found, strict=True):
                tile[at[0], at[1], :, at[2], :] = np.asarray(leaf).transpose(2, 0, 1)

    piece(0)
    with ThreadPoolExecutor(processors()) as pool:
        list(pool.map(piece, range(_LIST, count, _LIST)))
    return Found(*(leaf[:, : area.beta.size, : area.alpha.size] for leaf in out))
