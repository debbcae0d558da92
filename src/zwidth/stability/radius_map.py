"""Spectral radii of maps: the outermost pole of one node a cell is found by itself and followed to the cell's points.

The derivatives of the node's pole with respect to alpha and beta, up to the second, place the pole of every point; two
Newton steps finish it and the proof of `zwidth.stability.quick` accepts it. What is not accepted (another pole is the
outermost there, or two are about to meet) is left to the search for single points. Cells are computed in lists of one
length, so that maps of any size, and of any number of devices, share one compilation.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.batching import concretely, processors
from zwidth.domain import wall_status
from zwidth.stability.circle import Loop, loop_of
from zwidth.stability.layout import Points
from zwidth.stability.quick import certified, moved, stepped
from zwidth.stability.radius import Found

# Points along each side of a cell.
_CELL = 16
# Cells computed at one time: what their points hold stays in the cache.
_LIST = 64
# Smaller maps are not worth a compilation of their own.
SMALLEST_MAP = 1 << 14
_STEPS = 2


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


def _taylor(re: np.ndarray, im: np.ndarray, loop: Loop, fractional: bool) -> np.ndarray:
    """``w = log z`` of the nodes and its derivatives, from those of P(e^w; alpha, beta) = 0."""
    power = loop.turns + 1.0 if fractional else loop.turns
    w = re + 1j * im
    # e^w - 1 without cancellation
    sine = np.sin(0.5 * im)
    gap = np.expm1(re) - 2.0 * np.exp(re) * sine * sine + 1j * np.exp(re) * np.sin(im)
    z = 1.0 + gap
    scale = np.maximum(power * re, 0.0)
    lag, down = np.exp(power * w - scale), np.exp(-scale)
    # Values, first and second derivatives by w of T = z^p A, N = N(z) and of alpha + s (z - 1).
    a = gap * (gap + loop.em)
    a1 = z * (2.0 * gap + loop.em)
    a2 = a1 + 2.0 * z * z
    t1, t2 = lag * (power * a + a1), lag * (power * power * a + 2.0 * power * a1 + a2)
    n, n1, n2 = loop.h + loop.a2 * z, loop.a2 * z, loop.a2 * z
    if fractional:
        late = z + loop.q
        n, n1, n2 = n * late, n1 * late + n * z, n2 * late + 2.0 * n1 * z + n * z
    n, n1, n2 = n * down, n1 * down, n2 * down
    wall, wall1 = loop.alpha + loop.s * gap, loop.s * z
    p1 = t1 + n1 * wall + n * wall1
    p2 = t2 + n2 * wall + 2.0 * n1 * wall1 + n * wall1
    # By alpha and by beta P changes by N z and N (z - 1).
    by_a, by_a1 = n * z, n1 * z + n * z
    by_b, by_b1 = n * gap, n1 * gap + n * z
    w_a, w_b = -by_a / p1, -by_b / p1
    w_aa = -(2.0 * by_a1 * w_a + p2 * w_a * w_a) / p1
    w_ab = -(by_a1 * w_b + by_b1 * w_a + p2 * w_a * w_b) / p1
    w_bb = -(2.0 * by_b1 * w_b + p2 * w_b * w_b) / p1
    return np.stack([w, w_a, w_b, 0.5 * w_aa, w_ab, 0.5 * w_bb])


@cache
def _cells(fractional: bool) -> Any:
    """The compiled work on a list of cells: arrays (cells, points of beta, points of alpha)."""
    import jax

    def kernel(alpha: Array, beta: Array, middle: Array, re: Array, im: Array, device: Array, tolerance: Array) -> Any:
        alpha, beta = alpha[:, None, :], beta[:, :, None]
        middle, re, im, device = (part[..., None, None] for part in (middle, re, im, device))
        da, db = alpha - middle[0], beta - middle[1]
        z_re, z_im = (
            part[0] + da * (part[1] + da * part[3] + db * part[4]) + db * (part[2] + db * part[5]) for part in (re, im)
        )
        z_re, z_im = moved(z_re, z_im, 0.0, 0.0)
        nothing = 0.0 * device[0]
        loop = loop_of(nothing, nothing, device[0], device[1], fractional)
        loop = loop._replace(alpha=alpha, beta=beta, s=alpha + beta)
        for _ in range(_STEPS):
            z_re, z_im = stepped(z_re, z_im, loop, fractional, limit=False)
        return certified(Found(z_re, z_im), tolerance, loop, fractional)

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
) -> tuple[np.ndarray, ...]:
    """The pole of every point and whether it is proved to be the outermost, from those of the nodes."""
    across, down = _cut(area.alpha), _cut(area.beta)
    with np.errstate(all="ignore"):
        alpha, beta, delta, d = nodes
        taylor: Any = _taylor(re, im, loop_of(alpha, beta, delta, d, fractional), fractional)
    # A real pole stays real.
    real = (im == 0) | (im == np.pi)
    parts = np.stack([taylor.real, np.where(real & (np.arange(6)[:, None] > 0), 0.0, taylor.imag)])
    parts = np.where(np.isfinite(parts), parts, 0.0)
    grid = (area.delta.size, len(down), len(across))
    count = int(np.prod(grid))
    shape = (area.delta.size, len(down) * _CELL, len(across) * _CELL)
    out = tuple(np.empty(shape, kind) for kind in (np.float64, np.float64, np.bool_))
    tiles = [leaf.reshape(area.delta.size, len(down), _CELL, len(across), _CELL) for leaf in out]
    run = _cells(fractional)

    def piece(start: int) -> None:
        index = np.minimum(np.arange(start, start + _LIST), count - 1)
        at = np.unravel_index(index, grid)
        middle, device = np.stack([c[index] for c in nodes[:2]]), np.stack([c[index] for c in nodes[2:]])
        with concretely():
            found = run(across[at[2]], down[at[1]], middle, parts[0][:, index], parts[1][:, index], device, tolerance)
            for tile, leaf in zip(tiles, found, strict=True):
                tile[at[0], at[1], :, at[2], :] = np.asarray(leaf)

    piece(0)
    with ThreadPoolExecutor(processors()) as pool:
        list(pool.map(piece, range(_LIST, count, _LIST)))
    return tuple(leaf[:, : area.beta.size, : area.alpha.size] for leaf in out)
