"""Outermost poles of maps: one Taylor series a cell of walls, and one proof for all of its walls.

On a pole ``alpha + beta f = Q(z)``, ``f = 1 - 1/z``, ``Q = -z^n (z - 1)(z - c)/M(z)``. From the pole z0 of a cell's
middle, with ``z = z0 (1 + u)``, ``alpha = alpha0 + a xi``, ``beta = beta0 + b eta`` (|xi|, |eta| <= 1),

    A(u) = Q(z) - beta0 f(z) - alpha0 = a xi + b eta f(z)

is solved for log z by Lagrange's formula. The proofs, C1 to C5, are in docs/theory/maps.md: of the series' error, and
that the followed pole is the outermost of every wall. Cells that fail are cut in four; what is left of the smallest is
for single walls.
"""

from __future__ import annotations

from math import comb
from typing import Any, NamedTuple

import numpy as np

from zwidth.loops.rigid.circle import Loop, count_in_cell, factor_loop
from zwidth.loops.rigid.pole_search import both_poles
from zwidth.loops.rigid.pole_step import halley_step, move_pole, newton_step

# Sides of cells, in walls.
_SIDES = (32, 16, 8, 4)
# Cells of one list: what they need stays in the cache.
_LIST = 1 << 12
# Of Halley's method: on both starts, then on the one that is followed.
_BOTH, _STEPS = 2, 3
# Orders of series; each cell takes the least that will do.
_ORDERS = (2, 4, 6, 8)
# Radii of disks to try, in units of 1/(1 + n).
_DISKS = (0.03, 0.06, 0.12, 0.25, 0.5, 1.0, 2.0)
# How far inside of the followed pole the circles are, in units of the distance between poles of a long delay.
_INSIDE = (0.15, 0.5, 0.05, 0.015)
# A pole so near to the real axis is real where it is alone.
_REAL = 1e-7
# How near a pole is known at least, and how far from each other the logarithms of two are, that are not one.
_FOUND, _APART = 1e-8, 1e-6
# Walls whose series are summed up at one time.
_WALLS = 1 << 15


class Area(NamedTuple):
    """A map of several devices, or a window of it: alpha and beta (devices or 1, walls), delta and d of each device."""

    alpha: np.ndarray
    beta: np.ndarray
    delta: np.ndarray
    d: np.ndarray
    window: tuple[slice, slice]  # of the betas and the alphas

    @classmethod
    def whole(cls, alpha: np.ndarray, beta: np.ndarray, delta: np.ndarray, d: np.ndarray) -> Area:
        """All of a map."""
        return cls(alpha, beta, delta, d, (slice(0, beta.shape[1]), slice(0, alpha.shape[1])))

    def walls(self, place: np.ndarray) -> list[np.ndarray]:
        """alpha, beta, delta and d at places (3, walls) by device, row and column in the window."""
        device, row, column = place
        alpha, beta = (device if part.shape[0] > 1 else 0 * device for part in (self.alpha, self.beta))
        row, column = row + self.window[0].start, column + self.window[1].start
        return [self.alpha[alpha, column], self.beta[beta, row], self.delta[device], self.d[device]]


class _AxisPieces(NamedTuple):
    """An axis in pieces: their middles and half lengths (devices, pieces), and places (walls, devices, pieces)."""

    middle: np.ndarray
    half: np.ndarray
    place: np.ndarray


class MapPoles(NamedTuple):
    """Logarithms of the moduli of outermost poles (devices, betas, alphas), and their errors."""

    re: np.ndarray
    error: np.ndarray


def _cut(values: np.ndarray, side: int) -> _AxisPieces:
    with np.errstate(all="ignore"):
        pieces = np.pad(values, ((0, 0), (0, -values.shape[1] % side)), mode="edge")
        pieces = pieces.reshape(values.shape[0], -1, side)
        low, high = pieces.min(-1), pieces.max(-1)
        middle = 0.5 * (low + high)
        half = np.maximum(0.5 * (high - low), 1e-12 * np.abs(middle) + 1e-200)
        return _AxisPieces(
            middle, half, np.ascontiguousarray(((pieces - middle[..., None]) / half[..., None]).transpose(2, 0, 1))
        )


class _Nodes(NamedTuple):
    """The middles of cells: their loops, and the half lengths of the cells along alpha and beta."""

    loop: Loop
    half: tuple[np.ndarray, np.ndarray]


class _Series(NamedTuple):
    """The poles of the middles, and what the coefficients of log z are made from."""

    log_z: Any  # complex, as the next three
    a: Any  # coefficients of A by u, (order + 1, cells)
    f: Any
    w: Any  # 1/z
    errors: np.ndarray  # of series of each order, (orders, cells)


def _expand(re: np.ndarray, im: np.ndarray, nodes: _Nodes, fractional: bool) -> _Series:
    """The poles of the middles, begun at some places, and the coefficients of A there."""
    loop = nodes.loop
    for _ in range(_STEPS):
        re, im = halley_step(re, im, loop, fractional)
    step = newton_step(re, im, loop, fractional)
    re, im = move_pole(re, im, step.re, step.im)
    size, sine = np.expm1(re), np.sin(0.5 * im)
    r = 1.0 + size
    near = _complex(size - 2.0 * r * sine * sine, 2.0 * r * sine * np.cos(0.5 * im))
    z, off = near + 1.0, near + loop.em
    w, body = 1.0 / z, 1.0 / (loop.a2 * z + loop.h)
    # Q = -z^n (z - 1)(z - c)/((a2 z + h)(1 + q/z)), each factor by u.
    n, growth = loop.turns - 1.0, np.exp((loop.turns - 1.0) * re)
    lead, rho = -_complex(growth * np.cos(n * im), growth * np.sin(n * im)) * body, loop.a2 * z * body
    late = z / (z + loop.q)
    if fractional:
        lead *= late
    front, f = (near * off * lead, z * (near + off) * lead, z * z * lead), near * w
    order, power = _ORDERS[-1], [np.ones_like(re)]
    for k in range(order):
        power.append(power[-1] * ((n - k) / (k + 1.0)))
    a = np.empty((order + 1, re.size), complex)
    for k in range(order + 1):
        a[k] = sum((front[j] * power[k - j] for j in range(1, min(k, 2) + 1)), front[0] * power[k])
    for k in range(1, order + 1):
        a[k] -= rho * a[k - 1]
    if fractional:
        a[1:] += a[:-1].copy()
        for k in range(1, order + 1):
            a[k] -= late * a[k - 1]
    a[0] -= f * loop.beta
    a[1:] += (-1.0) ** np.arange(1, order + 1)[:, None] * (w * loop.beta)
    # The middle's own pole is known to rounding errors, or the steps have not found it.
    known = 4.0 * (np.abs(a[0] - loop.alpha) / np.abs(a[1]) + step.doubt)
    known = np.where(known < _FOUND, known, np.inf)
    errors = _bound_errors(np.abs(a), nodes, [np.abs(x) for x in (near, off, z, w, f, lead, rho, late)], fractional)
    return _Series(_complex(re, im), a, f, w, errors + known)


def _complex(re: np.ndarray, im: np.ndarray) -> np.ndarray:
    value = np.empty(re.shape, complex)
    value.real, value.imag = re, im
    return value


def _bound_errors(a: np.ndarray, nodes: _Nodes, moduli: list[np.ndarray], fractional: bool) -> np.ndarray:
    """What series of each order miss (C2, C3), from the moduli of A's coefficients and of its factors."""
    (loop, half), (near, off, r, w, f, lead, rho, late) = nodes, moduli
    limit = 1.0 / np.maximum(1.0, np.maximum(rho, late) if fractional else rho)
    best = np.full((len(_ORDERS), r.size), np.inf)
    for share in _DISKS:
        disk = np.minimum(share / loop.turns, 0.5 * limit)
        # The rest of A's series is bounded by a wider disk, on which every factor is at most what it is for |u|.
        wide = np.minimum(3.0 * disk, 0.5 * (disk + limit))
        most = lead * np.exp(loop.turns * wide) * (near + r * wide) * (off + r * wide) / (1.0 - rho * wide)
        if fractional:
            most *= (1.0 + wide) / (1.0 - late * wide)
        rest = (most + np.abs(loop.beta) * w / (1.0 - wide)) * (disk / wide) ** (a.shape[0])
        bent = a[-1]
        for size in a[-2:1:-1]:
            bent = bent * disk + size
        inner = (half[0] + half[1] * (f + w * disk / (1.0 - disk))) / (a[1] * disk - bent * disk * disk - rest)
        # V R^-m/(R - 1), R = 1/inner.
        error = np.where((inner > 0) & (inner < 1.0), -np.log1p(-disk) * inner / (1.0 - inner), np.inf)
        for k, steps in enumerate(np.diff(_ORDERS, prepend=0)):
            error = error * inner ** int(steps)
            best[k] = np.fmin(best[k], error)
    return best


def _coefficients(series: _Series, half: tuple[np.ndarray, np.ndarray], m: int) -> np.ndarray:
    """The coefficients of log |z| to order m (C1), (cells, powers of eta, powers of xi)."""
    count, by, first = series.f.size, half[1] / half[0], 1.0 / series.a[1]
    ratio, phi = series.a[2 : m + 1] * first, np.empty((m, count), complex)
    phi[0] = half[0] * first
    for k in range(1, m):
        phi[k] = -(ratio[:k] * phi[k - 1 :: -1]).sum(0)
    # Powers of b f/a with the highest terms first: f = 1 - (1/z0)/(1 + u).
    level, step = series.f * by, series.w * by
    tilt = np.zeros((m + 1, m, count), complex)
    tilt[0, -1] = 1.0
    for j in range(m):
        tilt[j + 1], part = tilt[j] * level, 0.0
        for k in range(m - 2, -1, -1):
            part = tilt[j, k + 1] - part
            tilt[j + 1, k] += step * part
    found = np.zeros((m + 1, m + 1, count))
    found[0, 0] = series.log_z.real
    power = np.repeat((-1.0 + 0.0j) ** np.arange(m)[:, None], count, 1)
    for k in range(1, m + 1):
        last, power = power, power * phi[0]
        for j in range(1, m):
            power[j:] += last[: m - j] * phi[j]
        places = np.arange(k + 1)
        shares = np.array([[comb(k, j) / k] for j in places])
        found[places, k - places] = (power[:k] * tilt[: k + 1, m - k :]).real.sum(1) * shares
    return np.ascontiguousarray(found.transpose(2, 0, 1))


def _pick(tree: Any, index: Any) -> Any:
    """Some of the cells of arrays whose last axis they are."""
    if not isinstance(tree, tuple):
        return tree[..., index]
    parts = [_pick(leaf, index) for leaf in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def _find(mask: np.ndarray) -> np.ndarray:
    """Where it is true, a multiple of 16 places: NumPy rounds odd ones at the end of a list otherwise."""
    index = np.flatnonzero(mask)
    return np.pad(index, (0, -index.size % 16), mode="edge") if index.size else index


class _CellPole(NamedTuple):
    """One pole in all of a cell."""

    re: np.ndarray  # coefficients of log |z|, (cells, powers of eta, powers of xi)
    error: np.ndarray
    low: np.ndarray  # the least logarithm of its modulus
    many: np.ndarray  # 2 with its conjugate

    @classmethod
    def expand(cls, series: _Series, nodes: _Nodes, k: int) -> _CellPole:
        """By the series of the k-th order."""
        re = _coefficients(series, nodes.half, _ORDERS[k])
        spread = np.abs(re).sum((1, 2)) - np.abs(re[:, 0, 0])
        error = series.errors[k] + 1e-14 * spread
        many = np.where(np.sin(series.log_z.imag) < _REAL, 1, 2)
        return cls(re, error, re[:, 0, 0] - spread - error, many)

    def pick(self, index: Any) -> _CellPole:
        """The same of some of the cells."""
        return _CellPole(*(leaf[index] for leaf in self))


def _prove(followed: list[_CellPole], nodes: _Nodes, fractional: bool) -> np.ndarray:
    """In which cells these poles are the outermost, whatever the wall (C4, C5)."""
    low, wanted = followed[0].low, followed[0].many
    for other in followed[1:]:
        low, wanted = np.minimum(low, other.low), wanted + other.many
    proved = np.zeros(low.size, bool)
    for inside in _INSIDE:
        left = np.flatnonzero(~proved)
        if left.size:
            loop, half = _pick(nodes, left)
            outside, sure = count_in_cell(low[left] - inside / (loop.turns + 1.0), loop, half, fractional)
            proved[left] = sure & (outside == wanted[left])
    return proved


class _Level:
    """The cells of one size of some devices."""

    def __init__(self, area: Area, side: int, accuracy: float, out: MapPoles, first: list[int]) -> None:
        self.area, self.side, self.accuracy, self.out, self.first = area, side, accuracy, out, first
        self.axes = _cut(area.alpha, side), _cut(area.beta, side)

    def split(self, cells: np.ndarray) -> np.ndarray:
        """Each cell in four, without what is beyond the ends of the axes."""
        device, row, column = np.repeat(cells, 4, axis=1)
        row, column = (
            2 * part + np.tile(place, cells.shape[1]) for part, place in ((row, [0, 0, 1, 1]), (column, [0, 1, 0, 1]))
        )
        inside = (row < self.axes[1].middle.shape[1]) & (column < self.axes[0].middle.shape[1])
        return np.stack([device, row, column])[:, inside]

    def solve_all(self, cells: np.ndarray, fractional: bool) -> np.ndarray:
        """`solve` list by list; threads would wait for each other, for NumPy's steps are short."""
        lists = (cells[:, start : start + _LIST] for start in range(0, cells.shape[1], _LIST))
        with np.errstate(all="ignore"):
            return np.concatenate([cells[:, :0], *(self.solve(some, fractional) for some in lists)], axis=1)

    def solve(self, cells: np.ndarray, fractional: bool) -> np.ndarray:
        """Write the poles of the cells of which all is proved; the others are returned."""
        count = cells.shape[1]
        cells = cells[:, _find(np.ones(count, bool))]
        device, row, column = cells
        along = [
            (device if axis.middle.shape[0] > 1 else 0 * device, place)
            for axis, place in zip(self.axes, (column, row), strict=True)
        ]
        alpha, beta = (axis.middle[place] for axis, place in zip(self.axes, along, strict=True))
        half = self.axes[0].half[along[0]], self.axes[1].half[along[1]]
        places = tuple(axis.place[:, place[0], place[1]] for axis, place in zip(self.axes, along, strict=True))
        loop = factor_loop(alpha, beta, self.area.delta[device], self.area.d[device], fractional)
        nodes = _Nodes(loop, half)
        slow_re, slow_im, re, im = both_poles(_BOTH, loop, fractional)
        first = (slow_re >= re) | np.isnan(re)
        larger = _expand(np.where(first, slow_re, re), np.where(first, slow_im, im), nodes, fractional)
        needed = (larger.errors > self.accuracy).sum(0)
        alone = needed < 0
        for k in range(len(_ORDERS)):
            index = _find(needed == k)
            if index.size:
                own = _pick(nodes, index)
                one = _CellPole.expand(_pick(larger, index), own, k)
                proved = _prove([one], own, fractional)
                self._write(cells, index[proved], [one.pick(proved)], places)
                alone[index] = proved
        written, rest = alone.copy(), _find(~alone & (needed < len(_ORDERS)))
        if rest.size:
            # Where another pole is about to take over, both are followed.
            start = np.where(first, re, slow_re)[rest], np.where(first, im, slow_im)[rest]
            other = _expand(*start, _pick(nodes, rest), fractional)
            apart = np.abs(other.log_z - larger.log_z[rest]) > _APART
            good = _find((other.errors[-1] <= self.accuracy) & apart)
            both, own = rest[good], _pick(nodes, rest[good])
            pair = [_CellPole.expand(one, own, -1) for one in (_pick(larger, both), _pick(other, good))]
            proved = _prove(pair, own, fractional)
            self._write(cells, both[proved], [one.pick(proved) for one in pair], places)
            written[both] = proved
        return cells[:, :count][:, ~written[:count]]

    def _write(self, cells: np.ndarray, index: np.ndarray, followed: list[_CellPole], places: Any) -> None:
        """The poles of all walls of some cells."""
        size = max(1, _WALLS // self.side**2)
        tiles = [leaf.reshape(leaf.shape[0], -1, self.side, leaf.shape[2] // self.side, self.side) for leaf in self.out]
        for start in range(0, index.size, size):
            part = slice(start, start + size)
            device, row, column = cells[:, index[part]]
            row, column = row - self.first[0], column - self.first[1]
            xi, eta = (self._powers(place[:, index[part]], followed[0].re.shape[1]) for place in places)
            values = [eta @ (one.re[part] @ xi.transpose(0, 2, 1)) for one in followed]
            tiles[0][device, row, :, column, :] = values[0] if len(values) == 1 else np.maximum(*values)
            error = followed[0].error if len(followed) == 1 else np.maximum(followed[0].error, followed[1].error)
            tiles[1][device, row, :, column, :] = error[part, None, None]

    @staticmethod
    def _powers(place: np.ndarray, count: int) -> np.ndarray:
        """Powers of places (walls, cells) in their cells: (cells, walls, powers)."""
        powers = np.ones((place.shape[1], place.shape[0], count))
        for k in range(1, count):
            np.multiply(powers[..., k - 1], place.T, out=powers[..., k])
        return powers


def follow_poles(area: Area, accuracy: float) -> tuple[MapPoles, np.ndarray]:
    """The outermost poles in the window (devices, betas, alphas), and the places (3, walls) of those without a series.

    A wall's value does not depend on the window: cells lie on the whole map, and each is computed by itself.
    """
    top, window = _SIDES[0], area.window
    first = [part.start // top for part in window]
    last = [-(-part.stop // top) for part in window]
    shape = (area.d.size, *(top * (stop - start) for start, stop in zip(first, last, strict=True)))
    out = MapPoles(np.zeros(shape), np.zeros(shape))
    held, missing = area.d != np.floor(area.d), []
    for kind in (False, True):
        pieces = np.flatnonzero(held == kind), *map(np.arange, first, last)
        cells = np.stack([part.reshape(-1) for part in np.meshgrid(*pieces, indexing="ij")])
        for side in _SIDES:
            level = _Level(area, side, accuracy, out, [start * (top // side) for start in first])
            cells = level.solve_all(cells if side == top else level.split(cells), kind)
        missing.append(_list_walls(cells, _SIDES[-1], window))
    inside = tuple(slice(w.start - top * start, w.stop - top * start) for w, start in zip(window, first, strict=True))
    return MapPoles(*(leaf[:, *inside] for leaf in out)), np.concatenate(missing, axis=1)


def _list_walls(cells: np.ndarray, side: int, window: tuple[slice, slice]) -> np.ndarray:
    """The walls of cells in a window, by device, row and column in it."""
    device, row, column = np.repeat(cells, side * side, axis=1)
    inner = np.tile(np.arange(side * side), cells.shape[1])
    row, column = row * side + inner // side - window[0].start, column * side + inner % side - window[1].start
    size = [part.stop - part.start for part in window]
    return np.stack([device, row, column])[:, (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])]
