"""Spectral radii of maps: the outermost pole of one node a cell is found by itself and followed to the cell's points.

The derivatives of the node's pole by alpha and beta place the pole of every point; steps of Halley's method, one of
Newton's and the proof of `loops.rigid.pole_search` finish it. What is not proved (another pole is the outermost there,
or two are about to meet) is left to the methods for single points. Cells are computed in lists of one length, so that
maps of any size, and of any number of devices, share one compilation.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.arguments import compute_concretely
from zwidth.arrays.evaluate import processors
from zwidth.arrays.xla import WIDE
from zwidth.loops.domain import wall_status
from zwidth.loops.rigid.circle import Loop, factor_loop
from zwidth.loops.rigid.folding import Points
from zwidth.loops.rigid.pole_search import certify_pole
from zwidth.loops.rigid.pole_step import halley_step, move_pole, value_at
from zwidth.words.types import Array

# Points along each side of a cell.
_CELL = 16
# Cells computed at one time: what their points hold stays in the cache.
_LIST = 64
# Of Halley's method.
_STEPS = 2
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

    def kernel(alpha: Array, beta: Array, fields: Array, tolerance: Array) -> tuple[Array, Array]:
        middle, beside, re, im, re_alpha, im_alpha, re_beta, im_beta, *device = fields[:, None, None, :]
        alpha, beta = alpha[None, :, :], beta[:, None, :]
        loop = Loop(alpha, beta, alpha + beta, *device)
        da, db = alpha - middle, beta - beside
        start = move_pole(re + (da * re_alpha + db * re_beta), im, 0.0, da * im_alpha + db * im_beta)
        for _ in range(_STEPS):
            start = halley_step(*start, loop, fractional)
        found = certify_pole(*start, tolerance, loop, fractional, fractional)
        return found.re, found.proved

    return jax.jit(kernel, compiler_options=WIDE)


def _fields(nodes: list[np.ndarray], re: np.ndarray, im: np.ndarray, fractional: bool) -> np.ndarray:
    """What the cells need of their nodes: the pole, how it moves with alpha and beta, the device."""
    with np.errstate(all="ignore"):
        loop = factor_loop(nodes[0], nodes[1], nodes[2], nodes[3], fractional)
        at = value_at(re, im, loop, fractional)
        back = at.first.conjugate() * (-1.0 / (at.first.real**2 + at.first.imag**2))
    alpha, beta = at.by_alpha * back, at.by_beta * back
    return np.stack([*nodes[:2], re, im, alpha.real, alpha.imag, beta.real, beta.imag, *loop[3:]])


def _cut(values: np.ndarray) -> np.ndarray:
    """Values in cells; the last value fills up."""
    missing = -values.size % _CELL
    return np.concatenate([values, np.full(missing, values[-1])]).reshape(-1, _CELL)


def lay_nodes(area: Map) -> list[np.ndarray]:
    """alpha, beta, delta and d of the cells' middles: device by device, row by row."""
    across, down = _cut(area.alpha), _cut(area.beta)
    middles = (down[:, _CELL // 2][None, :, None], across[:, _CELL // 2][None, None, :])
    beta, alpha, delta, d = np.broadcast_arrays(*middles, area.delta[:, None, None], area.d[:, None, None])
    return [np.array(column).reshape(-1) for column in (alpha, beta, delta, d)]


def followed_poles(
    area: Map, nodes: list[np.ndarray], re: np.ndarray, im: np.ndarray, tolerance: float, fractional: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The logarithm of every point's radius, and whether it is proved, from the poles of the nodes."""
    across, down = _cut(area.alpha).T, _cut(area.beta).T
    grid = (area.delta.size, down.shape[1], across.shape[1])
    out = tuple(np.empty((grid[0], grid[1] * _CELL, grid[2] * _CELL), kind) for kind in (np.float64, np.bool_))
    tiles = [leaf.reshape(grid[0], grid[1], _CELL, grid[2], _CELL) for leaf in out]
    run, fields = _cells(fractional), _fields(nodes, re, im, fractional)

    def piece(start: int) -> None:
        index = np.minimum(np.arange(start, start + _LIST), re.size - 1)
        at = np.unravel_index(index, grid)
        with compute_concretely():
            found = run(across[:, at[2]], down[:, at[1]], fields[:, index], tolerance)
            for tile, leaf in zip(tiles, found, strict=True):
                tile[at[0], at[1], :, at[2], :] = np.asarray(leaf).transpose(2, 0, 1)

    piece(0)
    with ThreadPoolExecutor(processors()) as pool:
        list(pool.map(piece, range(_LIST, re.size, _LIST)))
    return out[0][:, : area.beta.size, : area.alpha.size], out[1][:, : area.beta.size, : area.alpha.size]
