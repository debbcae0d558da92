"""Outermost poles of maps: one expansion a cell of walls, and one proof for all of its walls.

In each cell one or two groups of poles are followed (`loops.rigid.pole_groups`), and one count says that no other pole
of any of its walls is larger. The proofs, C1 to C5, are in docs/theory/maps.md. Cells that fail are cut in four; what
is left of the smallest is for single walls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.loops.rigid.circle import Loop, count_in_cell, factor_loop
from zwidth.loops.rigid.pole_groups import (
    ORDERS,
    ROUNDING,
    Cells,
    Group,
    enclose,
    find_middle,
    larger_of_two,
    pick,
    sum_up,
)
from zwidth.loops.rigid.pole_search import both_starts
from zwidth.loops.rigid.pole_step import halley_step

# Sides of cells, in walls.
_SIDES = (64, 32, 16, 8, 4)
# Cells of one list, and of those how many have their sums made at one time, and walls: what they need stays in caches.
_LIST, _BATCH, _WALLS = 1 << 10, 1 << 7, 1 << 15
# Of Halley's method on both starts. Centers so near to the real axis are put on it.
_STEPS, _REAL = 5, 1e-7
# Below this accuracy the least order serves too few cells.
_COARSE = 1e-5
# Of the accuracy, for sums of two poles: their difference is a square root.
_FINER = 1e-3
# How far inside of the groups the circles of a count are, in units of how far the groups move in the cell.
_INSIDE = (0.3, 1.0, 3.0, 10.0)


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


class MapPoles(NamedTuple):
    """Logarithms of the moduli of outermost poles (devices, betas, alphas), and their errors, infinite for none."""

    re: np.ndarray
    error: np.ndarray


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


def _fill(index: np.ndarray) -> np.ndarray:
    """A multiple of 16 places, the last one again: NumPy rounds odd ones at the end of a list otherwise."""
    return np.concatenate([index, np.repeat(index[-1:], -index.size % 16)])


def _find_poles(loop: Loop, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """The slow pole and the first pair of the ring, nearly, the larger one first: (2, cells)."""
    # All at one time: the steps are short.
    re, im = map(np.concatenate, zip(*both_starts(loop, fractional), strict=True))
    twice = Loop(*(np.tile(part, 2) for part in loop))
    for _ in range(_STEPS):
        re, im = halley_step(re, im, twice, fractional)
    im = np.where(im < _REAL, 0.0, np.where(np.pi - im < _REAL, np.pi, im))
    re, im = re.reshape(2, -1), im.reshape(2, -1)
    larger = (re[0] >= re[1]) | np.isnan(re[1])
    return np.where(larger, re, re[::-1]), np.where(larger, im, im[::-1])


class _GroupOfCell(NamedTuple):
    """The group about one start that is to be followed in each cell, of one pole or of two."""

    groups: tuple[Group, ...]
    needed: np.ndarray  # the order of each group that is known well enough (groups, cells)
    best: np.ndarray  # which of the groups

    @classmethod
    def of(cls, accuracy: float, *groups: Group) -> _GroupOfCell:
        """The groups that need the least order."""
        wanted = accuracy, accuracy * _FINER
        shares = [group.error * (group.disk / (1.0 - group.disk)) for group in groups]
        needed = np.stack([(~(share <= most)).sum(0) for share, most in zip(shares, wanted, strict=False)])
        needed = np.maximum(needed, accuracy < _COARSE)
        return cls(groups, needed, needed.argmin(0))

    @property
    def known(self) -> np.ndarray:
        """Where one of the groups is known."""
        return self.needed.min(0) < len(ORDERS)

    @property
    def many(self) -> np.ndarray:
        """How many poles that are, with their conjugates."""
        return np.where((self.best == 0) & (np.sin(self.groups[0].im) < _REAL), 1, 2)

    def _choose(self, name: str) -> np.ndarray:
        return np.choose(self.best, [getattr(group, name) for group in self.groups])

    def inside(self, share: float) -> np.ndarray:
        """The logarithm of a radius below all moduli in the cell, by so much of what these may differ."""
        low = self._choose("low")
        return low - share * (self._choose("re") - low)

    def is_apart(self, other: _GroupOfCell) -> np.ndarray:
        """Whether no pole is in both groups."""
        places = [np.exp(choice._choose("re") + 1j * choice._choose("im")) for choice in (self, other)]
        return np.abs(places[0] - places[1]) > sum(
            np.abs(place) * choice._choose("disk") for place, choice in zip(places, (self, other), strict=True)
        )


class _Level:
    """The cells of one size of some devices."""

    def __init__(self, area: Area, side: int, accuracy: float, out: MapPoles, first: list[int]) -> None:
        self.area, self.side, self.accuracy, self.first = area, side, accuracy, first
        self.axes = _cut(area.alpha, side), _cut(area.beta, side)
        self.tiles = [leaf.reshape(leaf.shape[0], -1, side, leaf.shape[2] // side, side) for leaf in out]

    def split(self, places: np.ndarray) -> np.ndarray:
        """Each cell in four, without what is beyond the ends of the axes."""
        device, row, column = np.repeat(places, 4, axis=1)
        row, column = (
            2 * part + np.tile(place, places.shape[1]) for part, place in ((row, [0, 0, 1, 1]), (column, [0, 1, 0, 1]))
        )
        inside = (row < self.axes[1].middle.shape[1]) & (column < self.axes[0].middle.shape[1])
        return np.stack([device, row, column])[:, inside]

    def solve_all(self, places: np.ndarray, fractional: bool) -> np.ndarray:
        """`solve` list by list."""
        lists = (places[:, start : start + _LIST] for start in range(0, places.shape[1], _LIST))
        with np.errstate(all="ignore"):
            return np.concatenate([places[:, :0], *(self.solve(some, fractional) for some in lists)], axis=1)

    def solve(self, places: np.ndarray, fractional: bool) -> np.ndarray:
        """Write the poles of the cells of which all is proved; the others are returned."""
        count = places.shape[1]
        places = places[:, _fill(np.arange(count))]
        along = self._along(places)
        alpha, beta = (axis.middle[place] for axis, place in zip(self.axes, along, strict=True))
        half = (axis.half[place] for axis, place in zip(self.axes, along, strict=True))
        loop = factor_loop(alpha, beta, self.area.delta[places[0]], self.area.d[places[0]], fractional)
        cells = Cells(loop, *half)
        re, im = _find_poles(loop, fractional)
        one = _GroupOfCell.of(self.accuracy, enclose(1, re[0], im[0], cells, fractional))
        written = self._try([[one]], places, cells, fractional)
        left = _fill(np.flatnonzero(~written))
        if left.size:
            # Next to a double pole the two are followed together; where another pole is about to take over, both.
            own, twice = pick(cells, left), pick(cells, np.tile(left, 2))
            re, im = re[:, left].reshape(-1), im[:, left].reshape(-1)
            groups = (
                enclose(1, re, im, twice, fractional),
                enclose(2, *find_middle(re, im, twice.loop, fractional), twice, fractional),
            )
            larger, other = (
                _GroupOfCell.of(self.accuracy, *(pick(group, part) for group in groups))
                for part in (slice(left.size), slice(left.size, None))
            )
            written[left] = self._try([[larger], [larger, other]], places[:, left], own, fractional)
        return places[:, :count][:, ~written[:count]]

    def _along(self, places: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """The pieces of alpha's axis and of beta's in which cells are."""
        device, row, column = places
        return [
            (device if axis.middle.shape[0] > 1 else 0 * device, place)
            for axis, place in zip(self.axes, (column, row), strict=True)
        ]

    def _try(
        self, proposals: list[list[_GroupOfCell]], places: np.ndarray, cells: Cells, fractional: bool
    ) -> np.ndarray:
        """Write the cells in which groups are known and hold the outermost pole whatever the wall (C4, C5)."""
        wanted, indices, radii = [], [], []
        for followed in proposals:
            known = np.logical_and.reduce([choice.known for choice in followed])
            if len(followed) == 2:
                known &= followed[0].is_apart(followed[1])
            index = _fill(np.flatnonzero(known))
            wanted.append(sum(choice.many for choice in followed))
            indices.append(np.tile(index, len(_INSIDE)))
            for inside in _INSIDE:
                radii.append(np.minimum.reduce([choice.inside(inside)[index] for choice in followed]))
        loop, a, b = pick(cells, np.concatenate(indices))
        # One count for all of the circles.
        outside, sure = count_in_cell(np.concatenate(radii), loop, (a, b), fractional)
        written, start = np.zeros(places.shape[1], bool), 0
        for followed, many, index in zip(proposals, wanted, indices, strict=True):
            part = slice(start, start + index.size)
            proved, start = np.zeros(written.size, bool), part.stop
            proved[index[sure[part] & (outside[part] == many[index])]] = True
            for merge, choice in enumerate(followed):
                self._follow(choice, proved & ~written, places, cells, merge > 0)
            written |= proved
        return written

    def _follow(self, choice: _GroupOfCell, where: np.ndarray, places: np.ndarray, cells: Cells, merge: bool) -> None:
        """Write the groups of some cells, in batches of one kind."""
        for poles, group in enumerate(choice.groups, 1):
            for k, order in enumerate(ORDERS):
                index = np.flatnonzero(where & (choice.best == poles - 1) & (choice.needed[poles - 1] == k))
                for start in range(0, index.size, _BATCH):
                    some = _fill(index[start : start + _BATCH])
                    batch = pick(group, some)
                    self._write(places[:, some], sum_up(poles, batch, pick(cells, some), order), batch, k, merge)

    def _write(self, places: np.ndarray, sums: list[np.ndarray], group: Group, k: int, merge: bool) -> None:
        """The poles of all walls of some cells, or the larger ones of these and of what is there."""
        size, order = max(1, _WALLS // self.side**2), ORDERS[k] + 1
        for start in range(0, places.shape[1], size):
            part = slice(start, start + size)
            some = places[:, part]
            xi, eta = (
                axis.powers[place][..., :order] for axis, place in zip(self.axes, self._along(some), strict=True)
            )
            on_walls = [eta @ (x[part] @ xi.transpose(0, 2, 1)) for x in sums]
            re, disk, error = (x[part, None, None] for x in (group.re, group.disk, group.error[k] + ROUNDING))
            if len(sums) == 1:
                values, error = on_walls[0], disk / (1.0 - disk) * error
            else:
                values, error = larger_of_two(on_walls[0], on_walls[1], disk, error)
            values += re
            inside = some[0], some[1] - self.first[0], slice(None), some[2] - self.first[1]
            whole, errors = self.tiles
            whole[inside] = np.maximum(whole[inside], values) if merge else values
            errors[inside] = np.maximum(errors[inside], error) if merge else error


def follow_poles(area: Area, accuracy: float) -> tuple[MapPoles, np.ndarray]:
    """The outermost poles in the window (devices, betas, alphas), and the places (3, walls) of those that no cell has.

    A wall's value does not depend on the window: cells lie on the whole map, and each is computed by itself.
    """
    top, window = _SIDES[0], area.window
    first = [part.start // top for part in window]
    last = [-(-part.stop // top) for part in window]
    shape = (area.d.size, *(top * (stop - start) for start, stop in zip(first, last, strict=True)))
    out = MapPoles(np.empty(shape), np.full(shape, np.inf))
    held = area.d != np.floor(area.d)
    for kind in (False, True):
        pieces = np.flatnonzero(held == kind), *map(np.arange, first, last)
        cells = np.stack([part.reshape(-1) for part in np.meshgrid(*pieces, indexing="ij")])
        for side in _SIDES:
            if cells.size:
                level = _Level(area, side, accuracy, out, [start * (top // side) for start in first])
                cells = level.solve_all(cells if side == top else level.split(cells), kind)
    inside = tuple(slice(w.start - top * start, w.stop - top * start) for w, start in zip(window, first, strict=True))
    found = MapPoles(*(leaf[:, *inside] for leaf in out))
    return found, np.stack(np.nonzero(~(found.error <= accuracy)))
