"""Outermost poles of maps: one expansion a cell of walls, and one proof for all of its walls.

In each cell one or two groups of poles are followed (`loops.rigid.pole_groups`), and one count says that no other pole
of any of its walls is larger. The proofs, C1 to C6, are in docs/theory/maps.md. Cells that fail are cut in four; what
is left of the smallest is for single walls.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.loops.rigid.circle import Loop, count_in_cell, factor_loop
from zwidth.loops.rigid.pole_groups import (
    DOUBTFUL,
    ORDERS,
    REAL,
    ROUNDING,
    AllowedErrors,
    Cells,
    Group,
    enclose,
    find_middle,
    knows_larger,
    larger_of_two,
    pick,
    sum_up,
)
from zwidth.loops.rigid.pole_search import all_starts
from zwidth.loops.rigid.pole_step import halley_step

# Sides of cells, in walls.
_SIDES = (128, 64, 32, 16, 8)
# Cells of one list, and of those how many have their sums made at one time, and walls: what they need stays in caches.
_LIST, _BATCH, _WALLS = 1 << 9, 1 << 7, 1 << 14
# Of Halley's method on every start; where the last one was shorter than this share of the distance between the poles of
# a long delay it has arrived, and starts that end nearer to each other than that have found one pole.
_STEPS, _NEARBY = 5, 1e-2
# How far inside of the groups the circles of a count are, in units of how far the groups move in the cell.
_INSIDE = (0.3, 1.5, 6.0)


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
    """An axis in pieces: their middles and half lengths (devices, pieces), and powers of places in them."""

    middle: np.ndarray
    half: np.ndarray
    powers: np.ndarray  # (devices, pieces, walls, powers)


def _cut(values: np.ndarray, side: int) -> _AxisPieces:
    with np.errstate(all="ignore"):
        pieces = np.pad(values, ((0, 0), (0, -values.shape[1] % side)), mode="edge")
        pieces = pieces.reshape(values.shape[0], -1, side)
        low, high = pieces.min(-1), pieces.max(-1)
        middle = 0.5 * (low + high)
        half = np.maximum(0.5 * (high - low), 1e-12 * np.abs(middle) + 1e-200)
        place = (pieces - middle[..., None]) / half[..., None]
        powers = np.ones((*place.shape, ORDERS[-1] + 1))
        for k in range(ORDERS[-1]):
            np.multiply(powers[..., k], place, out=powers[..., k + 1])
        return _AxisPieces(middle, half, powers)


def fill_up(index: np.ndarray) -> np.ndarray:
    """A multiple of 16 places, the last one again: NumPy rounds odd ones at the end of a list otherwise."""
    return np.concatenate([index, np.repeat(index[-1:], -index.size % 16)])


def _on_one_side(re: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of radii, smaller and larger by an error, on the same side of the unit circle and not next to it."""
    gap = 2.0 * DOUBTFUL
    return (
        np.where(re > 0, np.maximum(re - error, gap), re - error),
        np.where(re > 0, re + error, np.minimum(re + error, -gap)),
    )


def _find_poles(loop: Loop, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """The largest pole to which a start leads, and the largest of the others, nearly: (2, cells)."""
    before = re, im = all_starts(loop, fractional)
    nearby = _NEARBY / loop.turns
    for _ in range(_STEPS):
        before = re, im
        re, im = halley_step(re, im, loop, fractional)
    arrived = np.abs(re - before[0]) + np.abs(im - before[1]) < nearby
    im = np.where(im < REAL, 0.0, np.where(np.pi - im < REAL, np.pi, im))
    re, cells = np.where(arrived, re, -np.inf), np.arange(re.shape[1])
    first = re.argmax(0)
    same = np.abs(re - re[first, cells]) + np.abs(im - im[first, cells]) < nearby
    second = np.where(same, -np.inf, re).argmax(0)
    best = np.stack([first, second])
    return re[best, cells], im[best, cells]


class FollowedPoles(NamedTuple):
    """Radii (devices, betas, alphas), rates of decay if wanted, and where a radius is next to 1 or NaN."""

    radius: np.ndarray
    rate: np.ndarray
    special: tuple[np.ndarray, ...]


class _Level:
    """The cells of one size of some devices."""

    def __init__(self, area: Area, side: int, wanted: AllowedErrors, radius: np.ndarray, rate: np.ndarray) -> None:
        self.area, self.side, self.wanted, self.radius, self.rate = area, side, wanted, radius, rate
        self.axes = _cut(area.alpha, side), _cut(area.beta, side)
        # Devices, rows and columns of walls whose radius is next to 1 or NaN.
        self.special: list[np.ndarray] = []

    def split(self, places: np.ndarray) -> np.ndarray:
        """Each cell in four, without what is beyond the window."""
        device, row, column = np.repeat(places, 4, axis=1)
        row, column = (
            2 * part + np.tile(place, places.shape[1]) for part, place in ((row, [0, 0, 1, 1]), (column, [0, 1, 0, 1]))
        )
        rows, columns = self.area.window
        inside = (self.side * row < rows.stop) & (self.side * (row + 1) > rows.start)
        inside &= (self.side * column < columns.stop) & (self.side * (column + 1) > columns.start)
        return np.stack([device, row, column])[:, inside]

    def solve_all(self, places: np.ndarray, fractional: bool) -> np.ndarray:
        """`solve` list by list."""
        lists = (places[:, start : start + _LIST] for start in range(0, places.shape[1], _LIST))
        return np.concatenate([places[:, :0], *(self.solve(some, fractional) for some in lists)], axis=1)

    def solve(self, places: np.ndarray, fractional: bool) -> np.ndarray:
        """Write the poles of the cells of which all is proved; the others are returned."""
        count = places.shape[1]
        places = places[:, fill_up(np.arange(count))]
        along = self._along(places)
        alpha, beta = (axis.middle[place] for axis, place in zip(self.axes, along, strict=True))
        half = (axis.half[place] for axis, place in zip(self.axes, along, strict=True))
        loop = factor_loop(alpha, beta, self.area.delta[places[0]], self.area.d[places[0]], fractional)
        cells = Cells(loop, *half)
        re, im = _find_poles(loop, fractional)
        single = enclose(1, re[0], im[0], cells, fractional, self.wanted)
        done = self._prove([single], places, cells, fractional)
        if self.wanted.is_coarse:
            index = fill_up(np.flatnonzero(~done))
            if index.size:
                done[index] = self._prove_flat(re[0, index], places[:, index], pick(cells, index), fractional)
        known = (single.order < len(ORDERS)) | done
        # Where another pole is about to take over, both are followed; next to a double pole the two together.
        for left, poles in ((known & ~done, 1), (~known, 2)):
            index = fill_up(np.flatnonzero(left))
            if not index.size:
                continue
            some = pick(cells, index)
            if poles == 1:
                followed = [pick(single, index), enclose(1, re[1, index], im[1, index], some, fractional, self.wanted)]
            else:
                middle = find_middle(re[0, index], im[0, index], some.loop, fractional)
                followed = [enclose(2, *middle, some, fractional, self.wanted)]
            done[index] = self._prove(followed, places[:, index], some, fractional)
        return places[:, :count][:, ~done[:count]]

    def _along(self, places: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """The pieces of alpha's axis and of beta's in which cells are."""
        device, row, column = places
        return [
            (device if axis.middle.shape[0] > 1 else 0 * device, place)
            for axis, place in zip(self.axes, (column, row), strict=True)
        ]

    def _prove(self, groups: list[Group], places: np.ndarray, cells: Cells, fractional: bool) -> np.ndarray:
        """Write the cells in which groups are known and hold the outermost pole whatever the wall (C4 to C6)."""
        known = np.logical_and.reduce([group.order < len(ORDERS) for group in groups])
        if len(groups) == 2:
            known &= groups[0].is_apart(groups[1])
        index = fill_up(np.flatnonzero(known))
        groups = [pick(group, index) for group in groups]
        circles = [np.minimum.reduce([group.low - x * (group.re - group.low) for group in groups]) for x in _INSIDE]
        many = [sum(group.many for group in groups)] * len(circles)
        if self.wanted.is_coarse:
            # Others may be larger by what is spared, on the same side of the unit circle.
            low = np.maximum.reduce([group.low for group in groups])
            circles.append(_on_one_side(low, self.wanted.spare)[1])
            many.append(0 * many[0])
        loop, a, b = pick(cells, np.tile(index, len(circles)))
        # One count for all of the circles.
        outside, sure = count_in_cell(np.concatenate(circles), loop, (a, b), fractional)
        shape = len(circles), index.size
        proved = np.zeros(places.shape[1], bool)
        proved[index[(sure.reshape(shape) & (outside.reshape(shape) == many)).any(0)]] = True
        where, places, cells = np.flatnonzero(proved[index]), places[:, index], pick(cells, index)
        for k, group in enumerate(groups):
            self._follow(group, where, places, cells, k > 0)
        return proved

    def _prove_flat(self, re: np.ndarray, places: np.ndarray, cells: Cells, fractional: bool) -> np.ndarray:
        """Write one value in the cells in which all outermost poles are as large within the accuracy (C6)."""
        loop, a, b = pick(cells, np.tile(np.arange(re.size), 2))
        circles = np.concatenate(_on_one_side(re, self.wanted.accuracy))
        outside, sure = (part.reshape(2, -1) for part in count_in_cell(circles, loop, (a, b), fractional))
        flat = sure.all(0) & (outside[0] > 0) & (outside[1] == 0)
        self._fill(np.where(re > 0, *_on_one_side(re, 0.0))[flat], places[:, flat])
        return flat

    def _fill(self, re: np.ndarray, places: np.ndarray) -> None:
        for value, cell in zip(np.exp(re).tolist(), places.T.tolist(), strict=True):
            self.radius[self._place(cell)[0]] = value

    def _follow(self, group: Group, where: np.ndarray, places: np.ndarray, cells: Cells, merge: bool) -> None:
        """Write a group in some cells, in batches of one order."""
        for k, order in enumerate(ORDERS):
            index = where[group.order[where] == k]
            for start in range(0, index.size, _BATCH):
                some = index[start : start + _BATCH]
                full = fill_up(some)
                batch = pick(group, full)
                with np.errstate(all="ignore"):
                    self._write(places[:, some], sum_up(batch, pick(cells, full), order), batch, k, merge)

    def _write(self, places: np.ndarray, sums: list[np.ndarray], group: Group, k: int, merge: bool) -> None:
        """The poles of all walls of some cells, or the larger ones of these and of what is there."""
        size, order = max(1, _WALLS // self.side**2), ORDERS[k] + 1
        memories = np.empty((len(sums), min(size, places.shape[1]), self.side, self.side))
        if len(sums) == 1:
            sums[0][:, 0, 0] += group.re
        for start in range(0, places.shape[1], size):
            part = slice(start, min(start + size, places.shape[1]))
            some = places[:, part]
            xi, eta = (
                axis.powers[place][..., :order] for axis, place in zip(self.axes, self._along(some), strict=True)
            )
            # Into the same memory: new memory takes as long to get as all of this.
            values, *others = (
                np.matmul(eta, x[part] @ xi.transpose(0, 2, 1), out=memory[: some.shape[1]])
                for x, memory in zip(sums, memories, strict=True)
            )
            if others or self.wanted.with_rate:
                re, disk, error = (x[part, None, None] for x in (group.re, group.disk, group.error[k] + ROUNDING))
                if others:
                    values, inside = larger_of_two(values, others[0], disk)
                    values += re
                    known = knows_larger(inside, disk, error, self.wanted.allowed(np.abs(values)))
                else:
                    known = disk / (1.0 - disk) * error + ROUNDING * np.abs(re) <= self.wanted.allowed(np.abs(values))
                values[~known] = np.nan
            self._note(some, values)
            for cell, value in zip(some.T.tolist(), values, strict=True):
                tile, inside = self._place(cell)
                # Of whole cells, then to their places: how numbers are rounded may depend on how many there are, and
                # NumPy 2.4 negates strided ones wrongly.
                if self.rate.size:
                    rate = (-value)[inside]
                    self.rate[tile] = np.minimum(self.rate[tile], rate) if merge else rate
                radius = np.exp(value, out=value)[inside]
                self.radius[tile] = np.maximum(self.radius[tile], radius) if merge else radius

    def _place(self, cell: list[int]) -> tuple[Any, Any]:
        """Where a cell, by device, row and column, lies in the window; and what of it does."""
        tile: list[Any] = cell[:1]
        inside = []
        for index, axis in zip(cell[1:], self.area.window, strict=True):
            start = self.side * index - axis.start
            first, stop = max(0, start), min(start + self.side, axis.stop - axis.start)
            tile.append(slice(first, stop))
            inside.append(slice(first - start, stop - start))
        return tuple(tile), tuple(inside)

    def forget(self, places: np.ndarray) -> None:
        """NaN for all walls of some cells."""
        self._note(places, np.full((places.shape[1], self.side, self.side), np.nan))
        for cell in places.T.tolist():
            tile, _ = self._place(cell)
            self.radius[tile] = np.nan

    def _note(self, places: np.ndarray, logarithms: np.ndarray) -> None:
        """Note the walls whose side of the circle is in doubt, or that are NaN."""
        flat, doubt = logarithms.reshape(-1, self.side**2), self.wanted.doubt
        for index in np.flatnonzero(~((flat.min(1) > doubt) | (flat.max(1) < -doubt))):
            (device, rows, columns), inside = self._place(places[:, index].tolist())
            row, column = np.nonzero(~(np.abs(logarithms[index][inside]) > doubt))
            self.special.append(np.stack([np.full(row.size, device), row + rows.start, column + columns.start]))


def follow_poles(area: Area, accuracy: float, with_rate: bool = False) -> FollowedPoles:
    """The outermost poles of a window of a map, NaN where no cell knows them well enough.

    A wall's value does not depend on the window: cells lie on the whole map, and each is computed by itself.
    """
    longest = max(area.alpha.shape[1], area.beta.shape[1])
    sides = [side for side in _SIDES if side < 2 * longest or side == _SIDES[-1]]
    shape = area.d.size, *(part.stop - part.start for part in area.window)
    radius, rate = np.empty(shape), np.empty(shape if with_rate else 0)
    held = area.d != np.floor(area.d)
    levels = [_Level(area, side, AllowedErrors(accuracy, with_rate), radius, rate) for side in sides]

    corners = [np.arange(part.start // sides[0], -(-part.stop // sides[0])) for part in area.window]
    for kind in (False, True):
        devices = np.flatnonzero(held == kind)
        cells = np.stack([part.reshape(-1) for part in np.meshgrid(devices, *corners, indexing="ij")])
        with np.errstate(all="ignore"):
            for level in levels:
                cells = level.solve_all(cells if level is levels[0] else level.split(cells), kind)
            levels[-1].forget(cells)
    special = np.concatenate([np.empty((3, 0), int), *(part for level in levels for part in level.special)], axis=1)
    # Walls at which two groups were compared may be there twice.
    flat = np.unique(np.ravel_multi_index(tuple(special), shape))
    return FollowedPoles(radius, rate, np.unravel_index(flat, shape))
