"""Outermost poles of maps: one expansion a cell of walls, and one proof for all of its walls.

In each cell one or two groups of poles are followed (`loops.rigid.pole_groups`), and one count says that no other pole
of any of its walls is larger. The proofs, C1 to C6, are in docs/theory/maps.md. Cells that fail are cut in four; what
is left of the smallest is for single walls.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander
from numpy.polynomial.polynomial import polyvander

from zwidth.loops.rigid.circle import Loop, count_in_cell, factor_loop
from zwidth.loops.rigid.pole_groups import (
    DOUBTFUL,
    ORDERS,
    REAL,
    ROUNDING,
    SPARE,
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

# Sides of cells on a map as long as wide, in walls; on others as many walls in the map's own proportions.
_SIDES = (128, 64, 32, 16, 8)
# Cells of one list, and of those how many have their sums made at one time, and walls: what they need stays in caches.
_LIST, _BATCH, _WALLS = 1 << 9, 1 << 7, 1 << 16
# Of Halley's method on every start; where the last one was shorter than this share of the distance between the poles of
# a long delay it has arrived, and starts that end nearer to each other than that have found one pole.
_STEPS, _NEARBY = 5, 1e-2
# Values of an axis whose powers and shares are kept.
_REMEMBERED = 1 << 14
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


@cache
def _nodes(order: int) -> np.ndarray:
    """Where polynomials of an order are put into another function: zeros of a Chebyshev polynomial."""
    return chebpts1(order + SPARE)


def _shares(places: np.ndarray, order: int) -> np.ndarray:
    """What values at the nodes add to those at places: (..., nodes)."""
    nodes = _nodes(order)
    waves = chebvander(nodes, nodes.size - 1).T * (2.0 / nodes.size)
    waves[0] *= 0.5
    return chebvander(places, nodes.size - 1) @ waves


class _AxisPieces:
    """An axis in pieces: their middles and half lengths (devices, pieces), and what polynomials on them need."""

    def __init__(self, values: np.ndarray, side: int) -> None:
        with np.errstate(all="ignore"):
            pieces = np.pad(values, ((0, 0), (0, -values.shape[1] % side)), mode="edge")
            pieces = pieces.reshape(values.shape[0], -1, side)
            low, high = pieces.min(-1), pieces.max(-1)
            self.middle = 0.5 * (low + high)
            self.half = np.maximum(0.5 * (high - low), 1e-12 * np.abs(self.middle) + 1e-200)
            self._places = (pieces - self.middle[..., None]) / self.half[..., None]
        self._known: dict[Any, np.ndarray] = {}

    def table(self, kind: Callable[[np.ndarray, int], np.ndarray], order: int, pieces: Any) -> np.ndarray:
        """`polyvander` or `_shares` of the walls of some pieces: (pieces, walls, ...)."""
        if self._places.size > _REMEMBERED:
            return kind(self._places[pieces], order)
        if (kind, order) not in self._known:
            self._known[kind, order] = kind(self._places, order)
        return self._known[kind, order][pieces]


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


class _Canvas:
    """The values of a window and of what else its cells hold, and which of its walls are special."""

    def __init__(self, area: Area, sides: tuple[int, int], with_rate: bool) -> None:
        # All cells end where the largest ones do.
        cells = list(zip(area.window, sides, strict=True))
        first = [part.start // side * side for part, side in cells]
        sizes = [-(-part.stop // side) * side - start for (part, side), start in zip(cells, first, strict=True)]
        shape, self.first = (area.d.size, *sizes), np.array([[0], *([start] for start in first)])
        self.radius, self.rate = np.empty(shape), np.empty(shape if with_rate else (0, 0, 0))
        # Devices, rows and columns of walls whose radius is next to 1 or NaN.
        self.special: list[np.ndarray] = []

    def cut_out(self, window: tuple[slice, slice]) -> FollowedPoles:
        """What lies in the window."""
        rows, columns = (
            slice(part.start - start, part.stop - start)
            for part, start in zip(window, self.first[1:, 0].tolist(), strict=True)
        )
        radius, rate = (values[:, rows, columns] for values in (self.radius, self.rate))
        places = np.concatenate([np.empty((3, 0), int), *self.special], axis=1) - [[0], [rows.start], [columns.start]]
        inside = (places[1:] >= 0).all(0) & (places[1] < radius.shape[1]) & (places[2] < radius.shape[2])
        # Walls at which two groups were compared may be there twice.
        noted = np.zeros(radius.shape, bool)
        noted[tuple(places[:, inside])] = True
        return FollowedPoles(radius, rate, np.unravel_index(np.flatnonzero(noted), radius.shape))


def _sides(rows: int, columns: int) -> list[tuple[int, int]]:
    """Rows and columns of the cells of a map, from the largest on, each a power of 2."""
    longer, all_sides = 0.5 * np.log2(columns / rows), []
    # In larger ones another pole would mostly take over somewhere.
    for side in (side for side in _SIDES if side < 0.1 * max(rows, columns) or side == _SIDES[-1]):
        high = int(2.0 ** np.clip(np.round(np.log2(side) - longer), 0.0, 2.0 * np.log2(side)))
        all_sides.append((high, side**2 // high))
    return all_sides


def _tiles(values: np.ndarray, sides: tuple[int, int]) -> np.ndarray:
    """The same values by device, row and column of cells, and those in them."""
    (devices, rows, columns), (high, wide) = values.shape, sides
    return values.reshape(devices, rows // high, high, columns // wide, wide).swapaxes(2, 3)


class _Level:
    """The cells of one size of some devices."""

    def __init__(self, area: Area, sides: tuple[int, int], wanted: AllowedErrors, canvas: _Canvas) -> None:
        self.area, self.sides, self.wanted, self.canvas = area, sides, wanted, canvas
        self.axes = _AxisPieces(area.alpha, sides[1]), _AxisPieces(area.beta, sides[0])
        self.radius, self.rate = _tiles(canvas.radius, sides), _tiles(canvas.rate, sides)
        # Walls between neighbors, of devices, rows and columns of cells.
        self.steps = np.array([[1], *([side] for side in sides)])
        self.first = canvas.first // self.steps

    def split(self, places: np.ndarray, sides: tuple[int, int]) -> np.ndarray:
        """Cells of such sides in those of this size, without what is beyond the window."""
        parts = np.array([1, *sides]) // self.steps[:, 0]
        within = np.indices(parts.tolist()).reshape(3, 1, -1)
        places = ((places * parts[:, None])[:, :, None] + within).reshape(3, -1)
        low, (start, stop) = (places * self.steps)[1:], np.array([(w.start, w.stop) for w in self.area.window]).T
        return places[:, ((low < stop[:, None]) & (low + self.steps[1:] > start[:, None])).all(0)]

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

    def _takes_logarithms(self, k: int) -> bool:
        """Whether exponentials of all walls are taken: for rates, and where nodes would be as many."""
        return self.wanted.with_rate or min(self.sides) <= _nodes(ORDERS[k]).size

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
        values = np.exp(np.where(re > 0, *_on_one_side(re, 0.0)))
        self.radius[tuple((places - self.first)[:, flat])] = values[flat, None, None]
        return flat

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
        size, doubt = max(1, _WALLS // (self.sides[0] * self.sides[1])), group.doubt[k]
        # Rounding between nodes is in units of the largest value: radii are taken from the middle's.
        middle = np.exp(group.re)[:, None, None]
        if len(sums) == 1:
            (logarithms,) = sums
            logarithms[:, 0, 0] += group.re
            if self._takes_logarithms(k):
                polynomials = [(logarithms, polyvander)]
            else:
                powers = polyvander(_nodes(ORDERS[k]), ORDERS[k])
                polynomials = [(np.exp(powers @ logarithms @ powers.T) - middle, _shares)]
            # The size of all logarithms of a cell is at least that of its middle's less all that the others add.
            sizes = np.abs(logarithms)
            least = np.maximum(2.0 * sizes[:, 0, 0] - sizes.sum((1, 2)), 0.0)
            # No wall of the other cells is in doubt or unknown.
            close = (least < 2.0 * self.wanted.doubt) | (doubt > self.wanted.allowed(least))
        else:
            polynomials, close = [(x, polyvander) for x in sums], np.ones(doubt.size, bool)
        # Into the same memory: new memory takes as long to get as all of this.
        memories = np.empty((len(polynomials), min(size, places.shape[1]), *self.sides))
        for start in range(0, places.shape[1], size):
            part = slice(start, min(start + size, places.shape[1]))
            some, noted = places[:, part], np.flatnonzero(close[part])
            found = [
                self._spread(x[part], by, k, some, memory)
                for (x, by), memory in zip(polynomials, memories, strict=True)
            ]
            if len(sums) == 2:
                found = self._larger(found, pick(group, part), k)
            elif self._takes_logarithms(k):
                unknown = doubt[part][noted, None, None] > self.wanted.allowed(np.abs(found[0][noted]))
                found[0][noted] = np.where(unknown, np.nan, found[0][noted])
                found = [np.exp(found[0]), -found[0]][: 1 + self.wanted.with_rate]
            else:
                found[0] += middle[part]
            if noted.size:
                self._note(some[:, noted], found[0][noted])
            here = tuple(some - self.first)
            for whole, new, larger in zip((self.radius, self.rate), found, (np.maximum, np.minimum), strict=False):
                whole[here] = larger(whole[here], new) if merge else new

    def _larger(self, sums: list[np.ndarray], group: Group, k: int) -> list[np.ndarray]:
        """The radius and the rate of the larger of two poles, NaN where it is not known."""
        re, disk, error = (x[:, None, None] for x in (group.re, group.disk, group.error[k] + ROUNDING))
        values, inside = larger_of_two(sums[0], sums[1], disk)
        values += re
        known = knows_larger(inside, disk, error, self.wanted.allowed(np.abs(values)))
        values[~known] = np.nan
        return [np.exp(values), -values][: 1 + self.wanted.with_rate]

    def _spread(self, values: np.ndarray, by: Any, k: int, places: np.ndarray, memory: np.ndarray) -> np.ndarray:
        """Polynomials of eta and xi, by their coefficients or their values at nodes, at all walls of cells."""
        along = zip(self.axes, self._along(places), strict=True)
        xi, eta = (axis.table(by, ORDERS[k], place) for axis, place in along)
        xi = xi.transpose(0, 2, 1)
        # The longer side last: it costs the more.
        first, second = (eta @ values, xi) if self.sides[0] < self.sides[1] else (eta, values @ xi)
        return np.matmul(first, second, out=memory[: places.shape[1]])

    def forget(self, places: np.ndarray) -> None:
        """NaN for all walls of some cells."""
        self._note(places, np.full((places.shape[1], *self.sides), np.nan))
        self.radius[tuple(places - self.first)] = np.nan

    def _note(self, places: np.ndarray, radius: np.ndarray) -> None:
        """Note the walls whose side of the circle is in doubt, or that are NaN."""
        flat = np.flatnonzero(~(np.abs(radius - 1.0) > 1.01 * self.wanted.doubt))
        cell, *inside = np.unravel_index(flat, radius.shape)
        corner = (self.steps * (places - self.first))[1:, cell]
        self.canvas.special.append(np.concatenate([places[:1, cell], corner + inside]))


def follow_poles(area: Area, accuracy: float, with_rate: bool = False) -> FollowedPoles:
    """The outermost poles of a window of a map, NaN where no cell knows them well enough."""
    # A wall's value does not depend on the window: cells lie on the whole map, and each is computed by itself.
    sizes, wanted = _sides(area.beta.shape[1], area.alpha.shape[1]), AllowedErrors(accuracy, with_rate)
    held = area.d != np.floor(area.d)
    canvas = _Canvas(area, sizes[0], with_rate)
    corners = [np.arange(w.start // side, -(-w.stop // side)) for w, side in zip(area.window, sizes[0], strict=True)]
    left = [
        np.stack([part.reshape(-1) for part in np.meshgrid(np.flatnonzero(held == kind), *corners, indexing="ij")])
        for kind in (False, True)
    ]
    with np.errstate(all="ignore"):
        for sides, larger in zip(sizes, (sizes[0], *sizes), strict=False):
            level = _Level(area, sides, wanted, canvas)
            left = [level.solve_all(level.split(cells, larger), kind == 1) for kind, cells in enumerate(left)]
            if not any(cells.size for cells in left):
                break
            if sides == sizes[-1]:
                level.forget(np.concatenate(left, axis=1))
    return canvas.cut_out(area.window)
