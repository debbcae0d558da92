"""One or two poles of all walls of a cell, as polynomials in the place of the wall in it.

A wall's poles solve ``A(u) = a xi + b eta f(z)``, z = z0 (1 + u), in the notation of docs/theory/maps.md.
A group is one pole, or the two next to the real axis that may meet there: their sums have no branch where they do. Sums
over a group are integrals along a circle around it (C1 to C3).
"""

from __future__ import annotations

from functools import cache
from math import comb
from typing import Any, NamedTuple

import numpy as np

from zwidth.loops.rigid.circle import Loop
from zwidth.loops.rigid.pole_step import join

# Orders of the polynomials in xi and eta; each group takes the least that will do.
ORDERS = (2, 4, 8, 12, 20)
# Radii are exponentials of them, interpolated between so many nodes more, along xi and along eta, than the order says.
SPARE = 6
# Terms of A by u, and points of a mean for each pole; what is asked for less than that need not tell all poles apart.
_TERMS, _POINTS, _COARSE = 36, 48, 1e-5
# So near to the circle (in the logarithm of the radius) the verdict in closed form says on which side a pole is: of the
# radii of walls with alpha from 1e-18 on one in ten rounds to 1, of those within 1e-10 of the boundary as many err.
DOUBTFUL = 1e-7
# Of the errors allowed, for sums of two poles: their difference is a square root.
_FINER = 1e-3
# Of a rate: one that is known less well is looked at wall by wall.
_RATE_SHARE = 1e-6
# Walls of a cell whose logarithms are smaller may have to be computed by themselves; few are so near to the circle.
_SLOW = 1e-5
# Poles so near to the real axis are on it.
REAL = 1e-7
# Steps to the middles of groups.
_STEPS = 4
# Radii of circles over the largest; how many places on the next one is that a mean over a group of one or two needs.
_CIRCLES = 2.0 ** (-0.5 * np.arange(14))
_BESIDE = {1: 2, 2: 1}
# More than this A need not be over what walls change.
_AMPLE = 100.0
# Rounding errors of the polynomials, in units of what the circle allows.
ROUNDING = 1e-14
# How many ways lead to a power of xi and eta, over its order (eta first).
_SHARES = np.array([[comb(i + j, j) / max(i + j, 1) for i in range(ORDERS[-1] + 1)] for j in range(ORDERS[-1] + 1)])


class AllowedErrors(NamedTuple):
    """The errors that logarithms of radii may have: the accuracy, and for a rate a share of themselves."""

    accuracy: float
    with_rate: bool

    @property
    def is_coarse(self) -> bool:
        """Whether poles need not be told apart that are as large as that."""
        return self.accuracy > _COARSE and not self.with_rate

    @property
    def spare(self) -> float:
        """What is left for other poles that may be larger."""
        return 0.5 * self.accuracy if self.is_coarse else 0.0

    @property
    def doubt(self) -> float:
        """The size up to which logarithms may have the wrong sign."""
        return DOUBTFUL + min(self.accuracy, _COARSE)

    def allowed(self, size: np.ndarray) -> Any:
        """The errors of logarithms of some size."""
        if self.with_rate:
            return np.minimum(self.accuracy, _RATE_SHARE * size)
        return np.minimum(self.accuracy - self.spare, np.maximum(size, _COARSE))


class Cells(NamedTuple):
    """The middles of cells: their loops, and the half lengths of the cells along alpha and beta."""

    loop: Loop
    a: np.ndarray
    b: np.ndarray


class Group(NamedTuple):
    """One or two poles of each cell, by A around a center e^(re + j im) and a circle around them (C2)."""

    poles: int
    re: np.ndarray
    im: np.ndarray
    a: Any  # complex coefficients of A by u, (terms, cells)
    f: Any
    w: Any  # 1/z
    disk: np.ndarray  # the circle's radius in u
    low: np.ndarray  # the least logarithm of a modulus in the cell
    error: np.ndarray  # of sums to each order, in units of what the circle allows (orders, cells)
    order: np.ndarray  # which of the orders is needed; none of them where it is their number

    @property
    def many(self) -> np.ndarray:
        """How many poles that are, with their conjugates."""
        return np.where((self.poles == 1) & (np.sin(self.im) < REAL), 1, 2)

    @property
    def doubt(self) -> np.ndarray:
        """How far logarithms of single poles may be off, and those of the disk of two (orders, cells)."""
        return (self.error + ROUNDING) * (self.disk / (1.0 - self.disk)) + ROUNDING * np.abs(self.re)

    def is_apart(self, other: Group) -> np.ndarray:
        """Whether no pole is in both groups."""
        places = [np.exp(group.re + 1j * group.im) for group in (self, other)]
        return np.abs(places[0] - places[1]) > np.abs(places[0]) * self.disk + np.abs(places[1]) * other.disk


def pick(tree: Any, index: Any) -> Any:
    """Some of the cells of arrays whose last axis they are."""
    if isinstance(tree, tuple):
        return type(tree)(*(pick(leaf, index) for leaf in tree))
    return tree[..., index] if isinstance(tree, np.ndarray) else tree


def _expand(re: np.ndarray, im: np.ndarray, loop: Loop, fractional: bool, terms: int) -> tuple[Any, ...]:
    """The coefficients of A around centers; f and 1/z there, and the moduli of factors that bound A elsewhere."""
    size, sine = np.expm1(re), np.sin(0.5 * im)
    r = 1.0 + size
    near = join(size - 2.0 * r * sine * sine, 2.0 * r * sine * np.cos(0.5 * im))
    z, off = near + 1.0, near + loop.em
    w, body = 1.0 / z, 1.0 / (loop.a2 * z + loop.h)
    # Q = -z^n (z - 1)(z - c)/((a2 z + h)(1 + q/z)), each factor by u.
    n, growth = loop.turns - 1.0, np.exp((loop.turns - 1.0) * re)
    lead, rho = -join(growth * np.cos(n * im), growth * np.sin(n * im)) * body, loop.a2 * z * body
    late = z / (z + loop.q)
    if fractional:
        lead *= late
    f, places = near * w, np.arange(terms)[:, None]
    power = np.ones((terms + 1, re.size))
    np.cumprod((n - places) / (places + 1.0), axis=0, out=power[1:])
    a = near * off * lead * power
    a[1:] += z * (near + off) * lead * power[:-1]
    a[2:] += z * z * lead * power[:-2]
    if fractional:
        _divide(a, rho)
        a[1:] += a[:-1].copy()
        _divide(a, late)
    else:
        _divide(a, rho)
    a[0] -= f * loop.beta + loop.alpha
    a[1:] += (-1.0) ** (places + 1.0) * (w * loop.beta)
    return a, f, w, [np.abs(part) for part in (near, off, lead, rho, late)]


def _divide(a: np.ndarray, x: Any) -> None:
    """Divide series by 1 + x u = 1/((1 - x u)(1 + x^2 u^2)(1 + x^4 u^4) ...)."""
    shift, x = 1, -x
    while shift < len(a):
        a[shift:] += x * a[:-shift]
        shift, x = 2 * shift, x * x


def find_middle(re: np.ndarray, im: np.ndarray, loop: Loop, fractional: bool) -> tuple[np.ndarray, np.ndarray]:
    """The real place next to a pole between two of them, where A' is 0, nearly."""
    near = np.expm1(re) - 2.0 * np.exp(re) * np.sin(0.5 * im) ** 2
    re, im = np.where(near > -1.0, np.log1p(near), np.log(-1.0 - near)), np.where(near > -1.0, 0.0, np.pi)
    longest = 0.5 / loop.turns
    for _ in range(_STEPS):
        _, slope, bend = _expand(re, im, loop, fractional, 2)[0].real
        re = re + np.log1p(np.clip(-0.5 * slope / bend, -longest, longest))
    return re, im


def enclose(poles: int, re: np.ndarray, im: np.ndarray, cells: Cells, fractional: bool, wanted: AllowedErrors) -> Group:
    """The circle on which the group's term of A is the largest, over all of the others and what walls change (C2)."""
    loop, points, places = cells.loop, _POINTS * poles, np.arange(_TERMS + 1)
    a, f, w, (near, off, lead, rho, late) = _expand(re, im, loop, fractional, _TERMS)
    r, level, by, sizes = np.exp(re), np.abs(f), np.abs(w), np.abs(a)
    limit = 1.0 / np.maximum(1.0, np.maximum(rho, late) if fractional else rho)
    largest = np.minimum(2.0 / loop.turns, 0.4 * limit)
    disk = largest * _CIRCLES[:, None]
    # The rest of A's series is bounded by a wider disk, on which every factor is at most what it is for |u|.
    wide = np.minimum(4.0 * disk, 0.5 * (disk + limit))
    most = lead * np.exp(loop.turns * wide) * (near + r * wide) * (off + r * wide) / (1.0 - rho * wide)
    if fractional:
        most *= (1.0 + wide) / (1.0 - late * wide)
    rest = (most + np.abs(loop.beta) * by / (1.0 - wide)) * (disk / wide) ** (_TERMS + 1)
    total = ((sizes * largest ** places[:, None]).T[:, None] @ _CIRCLES ** places[:, None])[:, 0].T
    # Of P's own rounding errors what `pole_step` says, too.
    rounding = 2.0**-52 * (16.0 + loop.turns * (np.abs(re) + im))
    rest += rounding * (total + 2.0 * (np.abs(loop.alpha) + np.abs(loop.beta) * level))
    main = sizes[poles] * disk**poles
    low = 2.0 * main - total - rest
    ratio = low / (cells.a + cells.b * (level + by * disk / (1.0 - disk)))
    score = np.where(ratio > 1.02, ratio / (1.0 + 1e3 / wanted.accuracy * rest / low), 0.0)
    # With circles beside it between which no pole is either, means of points on it are nearly exact.
    beside, cells_of = _BESIDE[poles], np.arange(re.size)
    # Where all is small enough for every order, a smaller circle is farther from what is outside.
    rank = np.minimum(score, _AMPLE) * (1.0 + 0.01 * np.arange(_CIRCLES.size)[:, None])
    best = (rank[beside:-beside] * (score[: -2 * beside] > 0) * (score[2 * beside :] > 0)).argmax(0) + beside
    own, spread, alias = (best, cells_of), np.log(main / low) - np.log1p(-1.0 / ratio), np.full(re.size, np.inf)
    for step in (beside, beside + 1):
        outer, inner = np.maximum(best - step, 0), np.minimum(best + step, _CIRCLES.size - 1)
        between = (outer + inner == 2 * best) & (np.minimum(score[outer, cells_of], score[inner, cells_of]) > 0)
        # Of the sums of powers of tau/A, and as often as there are points that of the middle's own poles.
        missed = 2.0 ** (-0.5 * step * points) * (1 + points)
        missed = missed * (4.5 * spread[outer, cells_of] + spread[inner, cells_of])
        alias = np.where(between, np.fmin(alias, missed), alias)
    good = score[own] > 0
    if poles == 1:
        # A pole alone in a disk about a real center is real, and off the real axis in one that the axis does not meet.
        good &= (im == 0.0) | (im == np.pi) | (np.sin(im) > disk[own])
    inverse, power = 1.0 / ratio[own], np.array(ORDERS)[:, None] + 1
    share = rest[own] / (low[own] * (1.0 - inverse))
    error = inverse**power / (power * (1.0 - inverse)) + share / (1.0 - share)
    if poles == 1:
        # And of radii between nodes, by Lebesgue's constant of those.
        nodes = power + (SPARE - 1)
        error = error + (1.0 + (1.0 + np.log(nodes) / 1.57) ** 2) * inverse**nodes / (1.0 - inverse) ** 2
    error = np.where(good & (share < 0.5), error + alias, np.inf)
    # Two stay in the smallest disk that will do; one moves from the center by less.
    if poles == 1:
        reach = 1.0 / ratio + sizes[0] / low
        farthest = np.where((ratio > 1.02) & (reach < 0.98), np.log1p(-reach) * disk / (1.0 - disk), -np.inf)
    else:
        farthest = np.where(ratio > 1.02, np.log1p(-disk), -np.inf)
    group = Group(poles, re, im, a, f, w, disk[own], re + farthest.max(0), error, best)
    least = np.maximum(np.abs(re) - (re - group.low), _SLOW)
    most = wanted.allowed(least) * (1.0 if poles == 1 else _FINER)
    return group._replace(order=(~(group.doubt <= most)).sum(0))


def _powers(x: Any, count: int, first: Any = 1.0) -> np.ndarray:
    """1, x, x^2, ... times a factor, of points on circles (cells, points): (cells, powers, parts of points)."""
    powers = np.empty((count, *x.shape), complex)
    powers[0], known = first, 1
    while known < count:
        np.multiply(powers[: min(known, count - known)], x, out=powers[known : 2 * known])
        known, x = 2 * known, x * x
    return powers.view(float).transpose(1, 0, 2)


@cache
def _points(poles: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on a circle and their weights: all around for one pole, and above the real axis for two."""
    count = _POINTS * poles
    points = np.exp(2j * np.pi * np.arange(count) / count)
    weights = np.full(count, 1.0 / count)
    if poles == 2:
        points, weights = points[: count // 2 + 1], 2.0 * weights[: count // 2 + 1]
        weights[[0, -1]] *= 0.5
    return points, weights


def sum_up(group: Group, cells: Cells, order: int) -> list[np.ndarray]:
    """The log |1 + u| of one pole, or sums of u/disk and its square over two, by powers of eta and xi (C1)."""
    poles, powers = group.poles, np.arange(_TERMS + 1)
    count = _POINTS * poles
    points, weights = _points(poles)
    u = group.disk[:, None] * points
    coefficients = (group.a * group.disk ** powers[:, None]).T
    inverse = 1.0 / np.fft.ifft(coefficients, count, norm="forward")[:, : points.size]
    turn = np.fft.ifft(coefficients * powers, count, norm="forward")[:, : points.size] * inverse
    along_xi = _powers(np.conj(cells.a[:, None] * inverse), order + 1).transpose(0, 2, 1)
    along_eta = cells.b[:, None] * inverse * (group.f[:, None] + group.w[:, None] * (u / (1.0 + u)))
    places, sums = np.arange(order + 1), []
    shares = np.where(places[:, None] + places <= order, _SHARES[: order + 1, : order + 1], 0.0)
    for k in range(1, poles + 1):
        weight = weights * (u / (1.0 + u) if poles == 1 else k * points**k)
        found = _powers(along_eta, order + 1, weight) @ along_xi * shares
        # Of the middle's own poles.
        middle = (turn * (weights * points**k)).sum(1)
        found[:, 0, 0] = np.log1p(group.disk * middle).real if poles == 1 else middle.real
        sums.append(found)
    return sums


def larger_of_two(first: np.ndarray, second: np.ndarray, disk: Any) -> tuple[np.ndarray, np.ndarray]:
    """log |1 + u| of the larger pole, from sums of u/disk and its square; and D of C3, which a double pole has at 0."""
    # half +- sqrt(inside)
    half = 0.5 * first
    inside = 0.5 * second - half * half
    real = disk * (half + np.sqrt(np.maximum(inside, 0.0)))
    return 0.5 * np.log1p(real * (2.0 + real) - disk**2 * np.minimum(inside, 0.0)), inside


def knows_larger(inside: np.ndarray, disk: Any, error: Any, allowed: Any) -> np.ndarray:
    """Where the larger pole is known to what is allowed, if the two sums are to 1 and 2 errors (C3)."""
    doubt = 2.01 * error
    # Of the root: at most the root of the doubt, and the doubt over the root of what is inside.
    rest = np.maximum(allowed * ((1.0 - disk) ** 2 / disk) - 0.5 * error - doubt, 0.0)
    return np.abs(inside) * rest**2 >= np.where(doubt <= rest**2, -1.0, doubt**2)
