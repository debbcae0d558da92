"""Outermost poles of maps: one expansion a cell of walls, and one proof for all of its walls.

In each cell one or two groups of poles are followed (`loops.rigid.pole_groups`), and one count says that no other pole
of any of its walls is larger. The proofs, C1 to C5, are in docs/theory/maps.md. Cells that fail are cut in four; what
is left of the smallest is for single walls.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.evaluate import processors, run_in_threads, work_beside
from zwidth.loops.rigid.circle import Loop, count_in_cell, factor_loop
from zwidth.loops.rigid.pole_groups import (
    ORDERS,
    ROUNDING,
    Cells,
    Group,
    enclose,
    find_middle,
    knows_larger,
    larger_of_two,
    pick,
    sum_up,
)
from zwidth.loops.rigid.pole_search import both_starts
from zwidth.loops.rigid.pole_step import halley_step

# Sides of cells, in walls.
_SIDES = (128, 64, 32, 16, 8)
# Cells of one list, and of those how many have their sums made at one time, and walls: what they need stays in caches.
_LIST, _BATCH, _WALLS = 1 << 9, 1 << 7, 1 << 14
# Of Halley's method on both starts. Centers so near to the real axis are put on it.
_STEPS, _REAL = 5, 1e-7
# Of the accuracy, for sums of two poles: their difference is a square root.
_FINER = 1e-3
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

    def arrays(self) -> list[np.ndarray]:
        """alpha, beta, delta and d of the window, each in its shape (devices, betas, alphas)."""
        beta, alpha = self.beta[:, self.window[0], None], self.alpha[:, None, self.window[1]]
        return list(np.broadcast_arrays(alpha, beta, self.delta[:, None, None], self.d[:, None, None]))

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


def _find_poles(loop: Loop, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """The slow pole and the first pair of the ring, nearly, the larger one first: (2, cells)."""
    re, im = map(np.stack, zip(*both_starts(loop, fractional), strict=True))
    for _ in range(_STEPS):
        re, im = halley_step(re, im, loop, fractional)
    im = np.where(im < _REAL, 0.0, np.where(np.pi - im < _REAL, np.pi, im))
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
        shares = [
            (group.error + ROUNDING) * (group.disk / (1.0 - group.disk)) + ROUNDING * np.abs(group.re)
            for group in groups
        ]
        needed = np.stack([(~(share <= most)).sum(0) for share, most in zip(shares, wanted, strict=False)])
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

    def __init__(self, area: Area, side: int, accuracy: float, share: float, out: np.ndarray, first: list[int]) -> None:
        self.area, self.side, self.accuracy, self.share, self.first = area, side, accuracy, share, first
        self.axes = _cut(area.alpha, side), _cut(area.beta, side)
        self.tiles = out.reshape(out.shape[0], -1, side, out.shape[2] // side, side)

    def split(self, places: np.ndarray) -> np.ndarray:
        """Each cell in four, without what is beyond the ends of the axes."""
        device, row, column = np.repeat(places, 4, axis=1)
        row, column = (
            2 * part + np.tile(place, places.shape[1]) for part, place in ((row, [0, 0, 1, 1]), (column, [0, 1, 0, 1]))
        )
        inside = (row < self.axes[1].middle.shape[1]) & (column < self.axes[0].middle.shape[1])
        return np.stack([device, row, column])[:, inside]

    def solve_all(self, places: np.ndarray, fractional: bool, begin: Any) -> np.ndarray:
        """`solve` list by list; ``begin`` writes beside what is done here."""
        lists = (places[:, start : start + _LIST] for start in range(0, places.shape[1], _LIST))
        return np.concatenate([places[:, :0], *(self.solve(some, fractional, begin) for some in lists)], axis=1)

    def solve(self, places: np.ndarray, fractional: bool, begin: Any) -> np.ndarray:
        """Write the poles of the cells of which all is proved; the others are returned."""
        count = places.shape[1]
        places = places[:, fill_up(np.arange(count))]
        along = self._along(places)
        alpha, beta = (axis.middle[place] for axis, place in zip(self.axes, along, strict=True))
        half = (axis.half[place] for axis, place in zip(self.axes, along, strict=True))
        loop = factor_loop(alpha, beta, self.area.delta[places[0]], self.area.d[places[0]], fractional)
        cells = Cells(loop, *half)
        re, im = _find_poles(loop, fractional)
        one = _GroupOfCell.of(self.accuracy, enclose(1, re[0], im[0], cells, fractional))
        written = self._try([[one]], places, cells, fractional, begin)
        left = fill_up(np.flatnonzero(~written))
        if left.size:
            # Next to a double pole the two are followed together; where another pole is about to take over, both.
            own, twice = pick(cells, left), pick(cells, np.tile(left, 2))
            singles = pick(one.groups[0], left), enclose(1, re[1, left], im[1, left], own, fractional)
            middles = find_middle(re[:, left].reshape(-1), im[:, left].reshape(-1), twice.loop, fractional)
            pairs = enclose(2, *middles, twice, fractional)
            larger, other = (
                _GroupOfCell.of(self.accuracy, single, pick(pairs, part))
                for single, part in zip(singles, (slice(left.size), slice(left.size, None)), strict=True)
            )
            written[left] = self._try([[larger], [larger, other]], places[:, left], own, fractional, begin)
        return places[:, :count][:, ~written[:count]]

    def _along(self, places: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """The pieces of alpha's axis and of beta's in which cells are."""
        device, row, column = places
        return [
            (device if axis.middle.shape[0] > 1 else 0 * device, place)
            for axis, place in zip(self.axes, (column, row), strict=True)
        ]

    def _try(
        self, proposals: list[list[_GroupOfCell]], places: np.ndarray, cells: Cells, fractional: bool, begin: Any
    ) -> np.ndarray:
        """Write the cells in which groups are known and hold the outermost pole whatever the wall (C4, C5)."""
        wanted, indices, radii = [], [], []
        for followed in proposals:
            known = np.logical_and.reduce([choice.known for choice in followed])
            if len(followed) == 2:
                known &= followed[0].is_apart(followed[1])
            index = fill_up(np.flatnonzero(known))
            wanted.append(sum(choice.many for choice in followed))
            indices.append(np.tile(index, len(_INSIDE)))
            for inside in _INSIDE:
                radii.append(np.minimum.reduce([choice.inside(inside)[index] for choice in followed]))
        loop, a, b = pick(cells, np.concatenate(indices))
        # One count for all of the circles.
        outside, sure = count_in_cell(np.concatenate(radii), loop, (a, b), fractional)
        proved, start = np.zeros((2, places.shape[1]), bool), 0
        for followed, many, index in zip(proposals, wanted, indices, strict=True):
            part = slice(start, start + index.size)
            proved[len(followed) - 1, index[sure[part] & (outside[part] == many[index])]], start = True, part.stop
        known = np.asarray(proved.any(0))
        begin(self._follow, proposals[-1][0], known, places, cells, False)
        if proved[1].any():
            begin(self._follow, proposals[-1][1], proved[1] & ~proved[0], places, cells, True)
        return known

    def _follow(self, choice: _GroupOfCell, where: np.ndarray, places: np.ndarray, cells: Cells, merge: bool) -> None:
        """Write the groups of some cells, in batches of one kind."""
        for (poles, group), k in product(enumerate(choice.groups, 1), range(len(ORDERS))):
            index = np.flatnonzero(where & (choice.best == poles - 1) & (choice.needed[poles - 1] == k))
            for start in range(0, index.size, _BATCH):
                some = index[start : start + _BATCH]
                full = fill_up(some)
                batch = pick(group, full)
                with np.errstate(all="ignore"):
                    sums = sum_up(poles, batch, pick(cells, full), ORDERS[k])
                    self._write(places[:, some], sums, batch, k, merge)

    def _write(self, places: np.ndarray, sums: list[np.ndarray], group: Group, k: int, merge: bool) -> None:
        """The poles of all walls of some cells, or the larger ones of these and of what is there."""
        size, order = max(1, _WALLS // self.side**2), ORDERS[k] + 1
        if len(sums) == 1:
            sums[0][:, 0, 0] += group.re
        for start in range(0, places.shape[1], size):
            part = slice(start, min(start + size, places.shape[1]))
            some = places[:, part]
            xi, eta = (
                axis.powers[place][..., :order] for axis, place in zip(self.axes, self._along(some), strict=True)
            )
            along_xi = [x[part] @ xi.transpose(0, 2, 1) for x in sums]
            device, row, column = some[0], some[1] - self.first[0], some[2] - self.first[1]
            if len(sums) == 1 and not merge and self.share == np.inf:
                # To where they belong at once: copies would take as long.
                for one, other, *cell in zip(eta, along_xi[0], device, row, column, strict=True):
                    np.matmul(one, other, out=self.tiles[cell[0], cell[1], :, cell[2]])
                continue
            values = [eta @ x for x in along_xi]
            re, disk, error = (x[part, None, None] for x in (group.re, group.disk, group.error[k] + ROUNDING))
            if len(sums) == 1:
                values, allowed = values[0], self.allowed(values[0])
                known = disk / (1.0 - disk) * error <= allowed
            else:
                values, inside = larger_of_two(*values, disk)
                values += re
                known = knows_larger(inside, disk, error, self.allowed(values))
            if not known.all():
                values[np.broadcast_to(~known, values.shape)] = np.nan
            walls = device, row, slice(None), column
            self.tiles[walls] = np.maximum(self.tiles[walls], values) if merge else values

    def allowed(self, values: np.ndarray) -> Any:
        """The errors that walls may have."""
        return self.accuracy if self.share == np.inf else np.minimum(self.accuracy, self.share * np.abs(values))

    def forget(self, places: np.ndarray) -> None:
        """NaN for all walls of some cells."""
        self.tiles[places[0], places[1] - self.first[0], :, places[2] - self.first[1]] = np.nan


def follow_poles(area: Area, accuracy: float, share: float = np.inf) -> np.ndarray:
    """Logarithms of the moduli of the outermost poles in the window (devices, betas, alphas).

    NaN where no cell knows them to the accuracy and to that share of themselves. A wall's value does not depend on the
    window: cells lie on the whole map, and each is computed by itself.
    """
    longest = max(area.alpha.shape[1], area.beta.shape[1])
    sides = [side for side in _SIDES if side < 2 * longest or side == _SIDES[-1]]
    top, window = sides[0], area.window
    first = [part.start // top for part in window]
    last = [-(-part.stop // top) for part in window]
    out = np.empty((area.d.size, *(top * (stop - start) for start, stop in zip(first, last, strict=True))))
    held = area.d != np.floor(area.d)
    levels = [_Level(area, side, accuracy, share, out, [start * (top // side) for start in first]) for side in sides]

    def follow(kind: bool, cells: np.ndarray) -> None:
        with np.errstate(all="ignore"), work_beside() as begin:
            for level in levels:
                cells = level.solve_all(cells if level is levels[0] else level.split(cells), kind, begin)
            levels[-1].forget(cells)

    pieces = []
    for kind in (False, True):
        axes = np.flatnonzero(held == kind), *map(np.arange, first, last)
        cells = np.stack([part.reshape(-1) for part in np.meshgrid(*axes, indexing="ij")])
        # What is hard lies together: each thread gets its share of it. Two are needed to find poles and to write them.
        count = min(max(1, processors() // 2), cells.shape[1])
        pieces += [(kind, cells[:, k::count]) for k in range(count)]
    run_in_threads(lambda piece: follow(*piece), pieces)
    inside = tuple(slice(w.start - top * start, w.stop - top * start) for w, start in zip(window, first, strict=True))
    return out[:, *inside]
