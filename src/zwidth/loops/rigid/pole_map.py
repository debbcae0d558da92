"""Outermost poles of maps: one expansion a cell of walls, and one proof for all of its walls.

On a pole ``alpha + beta f = Q(z)``, ``f = 1 - 1/z``, ``Q = -z^n (z - 1)(z - c)/M(z)``. Around a center z0, with
``z = z0 (1 + u)``, ``alpha = alpha0 + a xi``, ``beta = beta0 + b eta`` (|xi|, |eta| <= 1), a wall's poles solve

    A(u) = Q(z) - beta0 f(z) - alpha0 = a xi + b eta f(z)

A group is one pole, or the two that meet on the real axis, where what they add up to has no branch. Its sums are
integrals over a circle. The proofs, C1 to C5, are in docs/theory/maps.md: of the errors, and that the group holds the
outermost pole of every wall. Cells that fail are cut in four; what is left of the smallest is for single walls.
"""

from __future__ import annotations

from math import comb
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.xp import horner
from zwidth.loops.rigid.circle import Loop, count_in_cell, factor_loop
from zwidth.loops.rigid.pole_search import both_starts
from zwidth.loops.rigid.pole_step import halley_step

# Sides of cells, in walls.
_SIDES = (64, 32, 16, 8, 4)
# Cells of one list: what they need stays in the cache.
_LIST = 1 << 10
# Cells whose sums are made at one time.
_BATCH = 1 << 6
# Cells whose walls are summed up at one time, in walls.
_WALLS = 1 << 15
# Of Halley's method on both starts.
_STEPS = 5
# Orders of the polynomials in xi and eta; each cell takes the least that will do.
_ORDERS = (4, 10, 20)
# Terms of A by u.
_TERMS = 36
# Radii of circles over the largest; how many places on the next one is that a mean over one or two poles needs.
_CIRCLES = 2.0 ** (-0.5 * np.arange(14))
_BESIDE = {1: 2, 2: 1}
# Points on a circle and their weights: all around, and above the real axis twice as many.
_AROUND = np.exp(2j * np.pi * np.arange(48) / 48), np.full(48, 1.0 / 48.0)
_ABOVE = np.exp(1j * np.pi * np.arange(49) / 48), np.pad(np.full(47, 1.0 / 48.0), 1, constant_values=0.5 / 48.0)
# How far inside of the group the circles of a count are, in units of the distance between poles of a long delay.
_INSIDE = (0.15, 0.5, 0.05, 0.015)
# Centers so near to the real axis are put on it.
_REAL = 1e-7
# Of the accuracy, for sums of two poles: their difference is a square root.
_FINER = 1e-3
# Rounding errors of polynomials, in units of the sum of their terms.
_ROUNDING = 1e-14


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
        return _AxisPieces(middle, half, place[..., None] ** np.arange(_ORDERS[-1] + 1))


class _Cells(NamedTuple):
    """The middles of cells: their loops, and the half lengths of the cells along alpha and beta."""

    loop: Loop
    a: np.ndarray
    b: np.ndarray


class _Group(NamedTuple):
    """One or two poles of the middles, by A on a circle around them and a center e^(re + j im) (C2)."""

    re: np.ndarray
    im: np.ndarray
    a: Any  # complex coefficients of A by u, (terms, cells)
    f: Any
    w: Any  # 1/z
    disk: np.ndarray  # the radius in u
    inner: np.ndarray  # that of a disk in which they stay
    error: np.ndarray  # of sums to each order, in units of what the disk allows (orders, cells)


def _complex(re: np.ndarray, im: np.ndarray) -> np.ndarray:
    value = np.empty(re.shape, complex)
    value.real, value.imag = re, im
    return value


def _expand(re: np.ndarray, im: np.ndarray, loop: Loop, fractional: bool, terms: int) -> tuple[Any, ...]:
    """The coefficients of A around centers; f and 1/z there, and the factors that bound A elsewhere."""
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
    factors = (n - np.arange(terms)[:, None]) / np.arange(1, terms + 1)[:, None]
    power = np.cumprod(np.concatenate([np.ones((1, re.size)), factors]), axis=0)
    a = front[0] * power
    a[1:] += front[1] * power[:-1]
    a[2:] += front[2] * power[:-2]
    for k in range(1, terms + 1):
        a[k] -= rho * a[k - 1]
    if fractional:
        a[1:] += a[:-1].copy()
        for k in range(1, terms + 1):
            a[k] -= late * a[k - 1]
    a[0] -= f * loop.beta + loop.alpha
    a[1:] += (-1.0) ** np.arange(1, terms + 1)[:, None] * (w * loop.beta)
    return a, f, w, [np.abs(part) for part in (near, off, lead, rho, late)]


def _find_poles(loop: Loop, fractional: bool) -> list[tuple[np.ndarray, np.ndarray]]:
    """The slow pole and the first pair of the ring, nearly, the larger one first."""
    # All at one time: the steps are short.
    slow, ring = both_starts(loop, fractional)
    re, im = np.concatenate([slow[0], ring[0]]), np.concatenate([slow[1], ring[1]])
    twice = Loop(*(np.tile(part, 2) for part in loop))
    for _ in range(_STEPS):
        re, im = halley_step(re, im, twice, fractional)
    im = np.where(im < _REAL, 0.0, np.where(np.pi - im < _REAL, np.pi, im))
    re, im = re.reshape(2, -1), im.reshape(2, -1)
    first = np.where((re[0] >= re[1]) | np.isnan(re[1]), 0, 1)
    return [(np.choose(k, re), np.choose(k, im)) for k in (first, 1 - first)]


def _find_turn(re: np.ndarray, im: np.ndarray, loop: Loop, fractional: bool) -> tuple[Any, Any]:
    """The real place next to a pole between two of them, where A' is 0."""
    near = np.expm1(re) - 2.0 * np.exp(re) * np.sin(0.5 * im) ** 2
    re, im = np.where(near > -1.0, np.log1p(near), np.log(-1.0 - near)), np.where(near > -1.0, 0.0, np.pi)
    longest = 0.5 / loop.turns
    for _ in range(_STEPS):
        _, slope, bend = _expand(re, im, loop, fractional, 2)[0].real
        re = re + np.log1p(np.clip(-0.5 * slope / bend, -longest, longest))
    return re, im


def _enclose(poles: int, re: np.ndarray, im: np.ndarray, cells: _Cells, fractional: bool) -> _Group:
    """The circle on which the group's term of A is the largest, over all of the others and what walls change (C2)."""
    loop = cells.loop
    a, f, w, (near, off, lead, rho, late) = _expand(re, im, loop, fractional, _TERMS)
    r, level, by, sizes = np.exp(re), np.abs(f), np.abs(w), np.abs(a)
    limit = 1.0 / np.maximum(1.0, np.maximum(rho, late) if fractional else rho)
    disk = np.minimum(2.0 / loop.turns, 0.4 * limit) * _CIRCLES[:, None]
    # The rest of A's series is bounded by a wider disk, on which every factor is at most what it is for |u|.
    wide = np.minimum(4.0 * disk, 0.5 * (disk + limit))
    most = lead * np.exp(loop.turns * wide) * (near + r * wide) * (off + r * wide) / (1.0 - rho * wide)
    if fractional:
        most *= (1.0 + wide) / (1.0 - late * wide)
    rest = (most + np.abs(loop.beta) * by / (1.0 - wide)) * (disk / wide) ** (_TERMS + 1)
    total = horner(disk, sizes)
    # Of P's own rounding errors what `pole_step` says, too.
    rounding = 2.0**-52 * (16.0 + loop.turns * (np.abs(re) + im))
    rest += rounding * (total + 2.0 * (np.abs(loop.alpha) + np.abs(loop.beta) * level))
    main = sizes[poles] * disk**poles
    low = 2.0 * main - total - rest
    ratio = low / (cells.a + cells.b * (level + by * disk / (1.0 - disk)))
    # No pole is on the circles beside it either: then the mean of points on it is exact to 2^-48.
    beside = _BESIDE[poles]
    score = np.where(ratio > 1.02, ratio / (1.0 + 1e12 * rest / low), 0.0)
    best = (score[beside:-beside] * (score[: -2 * beside] > 0) * (score[2 * beside :] > 0)).argmax(0) + beside
    outer, own, inner = ((best + step, np.arange(re.size)) for step in (-beside, 0, beside))
    spread = np.log(main / low) - np.log1p(-1.0 / ratio)
    good, alias = np.minimum(score[outer], score[inner]) > 0, 2.0**-48 * (4.5 * spread[outer] + spread[inner])
    if poles == 1:
        # A pole alone in a disk about a real center is real, and off the real axis in one that the axis does not meet.
        good &= (im == 0.0) | (im == np.pi) | (np.sin(im) > disk[own])
    inverse, power = 1.0 / ratio[own], np.array(_ORDERS)[:, None] + 1
    share = rest[own] / (low[own] * (1.0 - inverse))
    error = inverse**power / (power * (1.0 - inverse)) + alias + share / (1.0 - share)
    error = np.where(good & (score[own] > 0) & (share < 0.5), error, np.inf)
    return _Group(re, im, a, f, w, disk[own], disk[inner], error)


def _pick(tree: Any, index: Any) -> Any:
    """Some of the cells of arrays whose last axis they are."""
    if not isinstance(tree, tuple):
        return tree[..., index]
    parts = [_pick(leaf, index) for leaf in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def _fill(index: np.ndarray) -> np.ndarray:
    """A multiple of 16 places: NumPy rounds odd ones at the end of a list otherwise."""
    return np.pad(index, (0, -index.size % 16), mode="edge") if index.size else index


def _find(mask: np.ndarray) -> np.ndarray:
    return _fill(np.flatnonzero(mask))


_SHARES = np.array(
    [[comb(i + j, j) / (i + j) if i + j else 0.0 for i in range(_ORDERS[-1] + 1)] for j in range(_ORDERS[-1] + 1)]
)


def _powers(x: Any, count: int, first: Any = 1.0) -> np.ndarray:
    """1, x, x^2, ... times a factor, of points on circles (cells, points): (cells, powers, parts of points)."""
    powers = np.empty((count, *x.shape), complex)
    powers[0] = first
    for k in range(1, count):
        np.multiply(powers[k - 1], x, out=powers[k])
    return powers.view(float).transpose(1, 0, 2)


def _sum_up(poles: int, group: _Group, cells: _Cells, order: int) -> list[np.ndarray]:
    """The log(1 + u) of one pole, or sums of powers of u/disk of more, by powers of eta and xi (C1), cells first."""
    points, weights = _AROUND if poles == 1 else _ABOVE
    u = group.disk[:, None] * points
    terms = (group.a * group.disk ** np.arange(_TERMS + 1)[:, None]).T
    value = np.fft.ifft(terms, 48 * min(poles, 2), norm="forward")[:, : points.size]
    inverse = 1.0 / value
    along_xi = _powers(np.conj(cells.a[:, None] * inverse), order + 1).transpose(0, 2, 1)
    along_eta = cells.b[:, None] * inverse * (group.f[:, None] + group.w[:, None] * (u / (1.0 + u)))
    left = np.log(value / (terms[:, poles, None] * points**poles))
    places = np.arange(order + 1)
    shares = np.where(places[:, None] + places <= order, _SHARES[: order + 1, : order + 1], 0.0)
    sums = []
    for k in range(1, poles + 1):
        weight = weights * (u / (1.0 + u) if poles == 1 else k * points**k)
        found = _powers(along_eta, order + 1, weight) @ along_xi * shares
        found[:, 0, 0] = -(weight * left).real.sum(1)
        sums.append(found)
    return sums


class _Followed(NamedTuple):
    """A group in all of some cells."""

    cells: np.ndarray  # which ones of a list
    re: np.ndarray  # of the center
    sums: list[np.ndarray]  # by powers of eta and xi
    disk: np.ndarray
    error: np.ndarray  # of one pole, or in units of the sums of more
    low: np.ndarray  # the least logarithm of a modulus

    @classmethod
    def make(cls, poles: int, index: np.ndarray, group: _Group, cells: _Cells, k: int) -> _Followed:
        """By sums of the k-th order."""
        group, cells = _pick(group, index), _pick(cells, index)
        sums = _sum_up(poles, group, cells, _ORDERS[k])
        disk, error, low = group.disk, group.error[k] + _ROUNDING, group.re + np.log1p(-group.inner)
        if poles == 1:
            most = np.abs(sums[0]).sum((1, 2))
            error = disk / (1.0 - disk) * group.error[k] + _ROUNDING * most
            low = group.re - most - error
        return cls(index, group.re, sums, disk, error, low)

    def pick(self, index: Any) -> _Followed:
        """The same of some of the cells."""
        return _Followed(*([part[index] for part in leaf] if isinstance(leaf, list) else leaf[index] for leaf in self))

    def walls(self, xi: np.ndarray, eta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The logarithms of the largest modulus at powers of places in the cells, and their errors (C3)."""
        order = self.sums[0].shape[1]
        sums = [eta[..., :order] @ (part @ xi[..., :order].transpose(0, 2, 1)) for part in self.sums]
        re, disk, error = (part[:, None, None] for part in (self.re, self.disk, self.error))
        if len(sums) == 1:
            return sums[0] + re, error
        found, error = _larger_of_two(*sums, disk, error)
        return found + re, error


def _larger_of_two(first: Any, second: Any, disk: Any, error: Any) -> tuple[np.ndarray, np.ndarray]:
    """log |1 + u| from the sums of u/disk and of its square, as they are known to ``error`` and twice as much."""
    # half +- sqrt(inside)
    half, doubt = 0.5 * first, 2.01 * error
    inside = 0.5 * second - half * half
    real = disk * (half + np.sqrt(np.maximum(inside, 0.0)))
    half = disk * half
    size = np.where(inside > 0, np.log1p(real), 0.5 * np.log1p(half * (2.0 + half) - disk**2 * np.minimum(inside, 0.0)))
    apart = np.where(inside > -doubt, np.minimum(np.sqrt(doubt), doubt / np.sqrt(np.abs(inside))), 0.0)
    return size, disk / (1.0 - disk) ** 2 * (0.5 * error + doubt + apart)


def _prove(low: np.ndarray, wanted: np.ndarray, cells: _Cells, fractional: bool) -> np.ndarray:
    """In which cells as many poles as wanted are outside of a circle inside of them, whatever the wall (C4, C5)."""
    proved = np.zeros(low.size, bool)
    for inside in _INSIDE:
        left = _find(~proved & (wanted > 0))
        if left.size:
            loop, a, b = _pick(cells, left)
            outside, sure = count_in_cell(low[left] - inside / (loop.turns + 1.0), loop, (a, b), fractional)
            proved[left] = sure & (outside == wanted[left])
    return proved


class _Choice(NamedTuple):
    """The groups about some starts of a list of cells: one pole, or two where that is known better."""

    groups: tuple[_Group, ...]
    needed: np.ndarray  # the order of each group that is known well enough (groups, cells)
    best: np.ndarray  # which of the groups

    def follow(self, cells: _Cells, where: np.ndarray) -> list[_Followed]:
        """The groups of the cells where it is wanted, in batches of one kind."""
        found = []
        for poles, group in enumerate(self.groups, 1):
            for k in range(len(_ORDERS)):
                index = np.flatnonzero(where & (self.best == poles - 1) & (self.needed[poles - 1] == k))
                found += [
                    _Followed.make(poles, _fill(index[start : start + _BATCH]), group, cells, k)
                    for start in range(0, index.size, _BATCH)
                ]
        return found

    @property
    def known(self) -> np.ndarray:
        """Where one of the groups is known."""
        return self.needed.min(0) < len(_ORDERS)

    @property
    def many(self) -> np.ndarray:
        """How many poles that are, with their conjugates."""
        one = self.groups[0]
        return np.where(self.best > 0, self.best + 1, np.where((one.im == 0.0) | (one.im == np.pi), 1, 2))

    @property
    def disk(self) -> tuple[np.ndarray, np.ndarray]:
        """The center and the radius of the disk in which they are."""
        re, im, disk = (np.choose(self.best, [getattr(g, name) for g in self.groups]) for name in ("re", "im", "disk"))
        return np.exp(re + 1j * im), np.exp(re) * disk


def _choose(accuracy: float, *groups: _Group) -> _Choice:
    shares = [group.error * (group.disk / (1.0 - group.disk)) for group in groups]
    wanted = (accuracy, accuracy * _FINER)
    needed = np.stack([(~(share <= most)).sum(0) for share, most in zip(shares, wanted, strict=False)])
    return _Choice(groups, needed, needed.argmin(0))


class _Level:
    """The cells of one size of some devices."""

    def __init__(self, area: Area, side: int, accuracy: float, out: MapPoles, first: list[int]) -> None:
        self.area, self.side, self.accuracy, self.first = area, side, accuracy, first
        self.axes = _cut(area.alpha, side), _cut(area.beta, side)
        self.tiles = [leaf.reshape(leaf.shape[0], -1, side, leaf.shape[2] // side, side) for leaf in out]

    def split(self, cells: np.ndarray) -> np.ndarray:
        """Each cell in four, without what is beyond the ends of the axes."""
        device, row, column = np.repeat(cells, 4, axis=1)
        row, column = (
            2 * part + np.tile(place, cells.shape[1]) for part, place in ((row, [0, 0, 1, 1]), (column, [0, 1, 0, 1]))
        )
        inside = (row < self.axes[1].middle.shape[1]) & (column < self.axes[0].middle.shape[1])
        return np.stack([device, row, column])[:, inside]

    def solve_all(self, places: np.ndarray, fractional: bool) -> np.ndarray:
        """`solve` list by list; threads would wait for each other, for NumPy's steps are short."""
        lists = (places[:, start : start + _LIST] for start in range(0, places.shape[1], _LIST))
        with np.errstate(all="ignore"):
            return np.concatenate([places[:, :0], *(self.solve(some, fractional) for some in lists)], axis=1)

    def solve(self, places: np.ndarray, fractional: bool) -> np.ndarray:
        """Write the poles of the cells of which all is proved; the others are returned."""
        count = places.shape[1]
        places = places[:, _find(np.ones(count, bool))]
        along = self._along(places)
        alpha, beta = (axis.middle[place] for axis, place in zip(self.axes, along, strict=True))
        half = (axis.half[place] for axis, place in zip(self.axes, along, strict=True))
        loop = factor_loop(alpha, beta, self.area.delta[places[0]], self.area.d[places[0]], fractional)
        cells = _Cells(loop, *half)
        starts = _find_poles(loop, fractional)
        one = _enclose(1, *starts[0], cells, fractional)
        written = self._try([_choose(self.accuracy, one)], places, cells, fractional)
        # Next to a double pole the two are followed together; where another pole is about to take over, both.
        chosen: list[_Choice] = []
        left = _find(~written)
        for start in starts:
            if left.size:
                own, (re, im) = _pick(cells, left), _pick(start, left)
                groups = (
                    _enclose(1, re, im, own, fractional),
                    _enclose(2, *_find_turn(re, im, own.loop, fractional), own, fractional),
                )
                chosen.append(_choose(self.accuracy, *groups))
                written[left] = done = self._try(chosen, places[:, left], own, fractional)
                still = _find(~done)
                left, chosen = left[still], [_pick(choice, still) for choice in chosen]
        return places[:, :count][:, ~written[:count]]

    def _along(self, places: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """The pieces of alpha's axis and of beta's in which cells are."""
        device, row, column = places
        return [
            (device if axis.middle.shape[0] > 1 else 0 * device, place)
            for axis, place in zip(self.axes, (column, row), strict=True)
        ]

    def _try(self, chosen: list[_Choice], places: np.ndarray, cells: _Cells, fractional: bool) -> np.ndarray:
        """Write the cells in which these groups are known and hold the outermost pole."""
        known = np.logical_and.reduce([choice.known for choice in chosen])
        if len(chosen) == 2:
            (one, reach), (other, further) = (choice.disk for choice in chosen)
            known &= np.abs(one - other) > reach + further
        followed = [choice.follow(cells, known) for choice in chosen]
        low = np.full(known.size, np.inf)
        for part in [part for parts in followed for part in parts]:
            low[part.cells] = np.minimum(low[part.cells], part.low)
        proved = _prove(low, np.where(known, sum(choice.many for choice in chosen), 0), cells, fractional)
        for merge, parts in enumerate(followed):
            for part in parts:
                self._write(places, part.pick(proved[part.cells]), merge > 0)
        return proved

    def _write(self, places: np.ndarray, followed: _Followed, merge: bool) -> None:
        """The poles of all walls of some cells, or the larger ones of these and of what is there."""
        size = max(1, _WALLS // self.side**2)
        for start in range(0, followed.cells.size, size):
            part = followed.pick(slice(start, start + size))
            some = places[:, part.cells]
            values, error = part.walls(
                *(axis.powers[place] for axis, place in zip(self.axes, self._along(some), strict=True))
            )
            inside = some[0], some[1] - self.first[0], slice(None), some[2] - self.first[1]
            re, errors = self.tiles
            re[inside] = np.maximum(re[inside], values) if merge else values
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
