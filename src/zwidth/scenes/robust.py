"""The stiffest wall that every device of a family can render, proved (rigid loop): all its four numbers uncertain.

A device found by search bounds the answer from above. From below it is proved: the box of devices is cut until the
verdict of `loops.rigid.certified_filter` holds for every device of every part at once.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np

from zwidth.arrays.balls import quantities
from zwidth.arrays.evaluate import as_float64, join_shapes
from zwidth.arrays.roots import bisect
from zwidth.loops.rigid.boundary import boundary_point
from zwidth.loops.rigid.certified_filter import stable_everywhere
from zwidth.loops.rigid.normalization import normalize, quantity_status
from zwidth.loops.rigid.verdict import is_stable
from zwidth.parts.checks import accept_units
from zwidth.scenes.stiffness import max_stiffness
from zwidth.words.errors import InputError
from zwidth.words.showing import shown
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike
from zwidth.words.xp import is_traced

_NAMES = ("mass", "damping", "period", "delay")
# How far the proved bound may lie below what a device was found to limit it to, and what it is then; where that cannot
# be proved, looser ones are tried.
_BOUNDS = ((1e-6, Status.OK), *((looser, Status.UNDECIDED) for looser in (1e-4, 1e-2, 0.1)))
# Parts of a box that are looked at before giving up, and at one time.
_MOST_PARTS, _AT_ONCE = 1 << 18, 1 << 11
# Rounds of proof and counterexample.
_ROUNDS = 40
_SEARCH_ROUNDS = 60
# Of the damping of a wall for all devices.
DIGITS = 8
# Shares this close to 0 or 1 are taken for it.
_AT_END = 1e-12


class Interval(NamedTuple):
    """An uncertain quantity: all values from ``low`` to ``high``, numbers or arrays that broadcast."""

    low: ArrayLike
    high: ArrayLike


Uncertain: TypeAlias = Interval | ArrayLike


@shown(attained="N/m", mass="kg", damping="N s/m", period="s", delay="s")
class RobustStiffness(NamedTuple):
    """What every device of a box can render, the worst device found, and a `zwidth.Status`."""

    stiffness: Array
    attained: Array
    mass: Array
    damping: Array
    period: Array
    delay: Array
    is_vertex: Array
    status: Array


@shown(limit="N/m")
class RobustWall(NamedTuple):
    """One wall for a whole family of devices, in N/m and N s/m, the limit of such walls, and a `zwidth.Status`."""

    stiffness: Array
    virtual_damping: Array
    limit: Array
    status: Array


@accept_units
def robust_max_stiffness(
    *, mass: Uncertain, damping: Uncertain = 0.0, period: Uncertain, delay: Uncertain = 0.0
) -> RobustStiffness:
    """Find the smallest K_max of all devices in a box: each of them can render any wall up to it.

    ``min over the box of K_max(m, b, T, t_d)``; the virtual damping may differ from device to device. For one wall
    (K, B) that suits all of them see `robust_wall`, which is never stiffer.

    Args:
        mass: m in kg, > 0: an `Interval`, or what is known exactly; likewise the others.
        damping: b in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0, held. All broadcast, the ends of intervals too: a box for each entry.

    Returns:
        RobustStiffness of the broadcast shape: ``stiffness`` in N/m, proved for every device of the box; ``attained``,
        K_max of the worst device found, whose ``mass``, ``damping``, ``period`` and ``delay`` follow, and ``is_vertex``
        whether it is a corner of the box. ``status``: OK where ``stiffness`` is within 1e-6 of ``attained``, UNDECIDED
        where only less could be proved, INVALID_INPUT or OUT_OF_RANGE with NaN for a box among arrays.

    Raises:
        InputError: an argument is a tuple or a list of two ends, a number out of range, no real number, or traced; ends
            are out of order; or shapes do not broadcast.

    Numerics:
        Branch and bound: the box is cut until affine arithmetic proves a wall for each part. Some hundred parts and a
        tenth of a second for a box of 10 to 30 %, some ten thousand and a second where delays cross whole periods at
        strong damping.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII; Comba, Stolfi 1993; docs/theory/one-lobe.md (rows and columns).

    Example:
        >>> from zwidth import Interval, robust_max_stiffness
        >>> worst = robust_max_stiffness(mass=Interval(0.08, 0.12), damping=10, period=1e-3, delay=1e-3)
        >>> print(worst.is_vertex, worst.mass, f"{worst.stiffness:.0f} N/m")
        True 0.08 17051 N/m
    """
    return RobustStiffness(*_each_box(_worst, RobustStiffness._fields, (mass, damping, period, delay)))


@accept_units
def robust_wall(*, mass: Uncertain, damping: Uncertain = 0.0, period: Uncertain, delay: Uncertain = 0.0) -> RobustWall:
    """Find the stiffest single wall (K, B) that is stable on every device of a box.

    Args:
        mass, damping, period, delay: as for `robust_max_stiffness`.

    Returns:
        RobustWall of the broadcast shape: ``stiffness`` in N/m and ``virtual_damping`` in N s/m, proved stable on every
        device of the box; ``limit``, a stiffness that no wall can reach on all devices. ``status`` as for
        `robust_max_stiffness`.

    Numerics:
        The wall that suits some devices best, proved for all by branch and bound as in `robust_max_stiffness`; a part
        that cannot be proved shows a device that the wall does not suit, which then joins the others.

    References:
        Hulin, Preusche, Hirzinger 2006, sections V, VII; Comba, Stolfi 1993.

    Example:
        >>> from zwidth import Interval, robust_wall
        >>> wall = robust_wall(mass=Interval(0.08, 0.12), damping=10, period=1e-3, delay=Interval(0, 1e-3))
        >>> print(f"{wall.stiffness:.0f} N/m, {wall.virtual_damping:.1f} N s/m")
        17051 N/m, 33.1 N s/m
    """
    return RobustWall(*_each_box(_wall, RobustWall._fields, (mass, damping, period, delay)))


def _each_box(
    answer: Callable[[np.ndarray, np.ndarray], tuple], names: tuple[str, ...], given: tuple[Uncertain, ...]
) -> list[np.ndarray]:
    """Check the intervals, and answer box by box."""
    ends = []
    for name, value in zip(_NAMES, given, strict=True):
        if isinstance(value, tuple | list) and not isinstance(value, Interval):
            raise InputError(
                f"{name}: got {value!r}; write Interval(low, high) for an uncertain quantity, or a NumPy array for "
                "several known ones"
            )
        pair = value if isinstance(value, Interval) else Interval(value, value)
        if is_traced(*pair):
            raise InputError(f"{name}: got a traced value; a proof is made on the host, outside JAX transformations")
        for end in pair:
            normalize(**({"mass": 1.0, "period": 1.0} | {name: end}))
        low, high = (as_float64(name, end) for end in pair)
        if low.ndim == high.ndim == 0 and low > high:
            raise InputError(f"{name}: got {value!r}; the first number must not be greater than the second")
        ends += [low, high]
    join_shapes(zip(map(str, np.repeat(_NAMES, 2)), map(np.shape, ends), strict=True))
    columns = np.broadcast_arrays(*ends)
    shape = columns[0].shape
    rows = np.stack([column.ravel() for column in columns], axis=-1)
    results = []
    with np.errstate(all="ignore"):
        for row in rows:
            low, high = row[0::2], row[1::2]
            status = _box_status(low, high)
            results.append(answer(low, high) if status == Status.OK else (*[np.nan] * (len(names) - 1), status))
    found = zip(*results, strict=True) if results else [()] * len(names)
    # A box that is not computed is no vertex.
    types = {"is_vertex": lambda values: np.equal(values, True), "status": lambda values: np.array(values, np.int32)}
    arrays = (types.get(name, np.array)(values) for name, values in zip(names, found, strict=True))
    return [np.asarray(array).reshape(shape)[()] for array in arrays]


def _box_status(low: np.ndarray, high: np.ndarray) -> Status:
    found = quantity_status(**dict(zip(_NAMES, np.stack([low, high], -1), strict=True)))
    # Of several faults the first of `Status` is told.
    return Status(min(found[found > 0].tolist(), default=0)) if np.all(low <= high) else Status.INVALID_INPUT


def _normalize_devices(devices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """N/m a unit of alpha, delta and d of devices, rows of (m, b, T, t_d)."""
    mass, damping, period, delay = devices.T
    return mass / period / period, damping * period / mass, delay / period


def _stiffest(devices: np.ndarray) -> np.ndarray:
    mass, damping, period, delay = devices.T
    return np.asarray(max_stiffness(mass=mass, damping=damping, period=period, delay=delay))


def _stable_dampings(stiffness: float, devices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The ends of the stable B at one K; NaN where none is stable."""
    spring, delta, d = _normalize_devices(devices)
    alpha, damper = stiffness / spring, spring * devices[:, 2]
    lower, upper = (boundary_point(delta, d, alpha=alpha, side=side).beta for side in ("lower", "upper"))
    return np.asarray(lower) * damper, np.asarray(upper) * damper


def _lowest(
    cost: Callable[[np.ndarray], np.ndarray], starts: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The best device that a pattern search finds in a box, from the best of ``starts``, rows of shares from 0 to 1."""
    # A pattern is a center and its neighbors, a step away along any of the uncertain quantities; it moves to the lowest
    # of them, and where none is lower the step is halved.
    free = np.flatnonzero(high > low)
    moves = np.zeros((3**free.size, low.size))
    moves[:, free] = np.array(list(product((-1.0, 0.0, 1.0), repeat=free.size)))

    def values(shares: np.ndarray) -> np.ndarray:
        found = cost(_devices(shares, low, high))
        return np.where(np.isnan(found), np.inf, found)

    known = values(starts)
    best, value, step = starts[int(np.argmin(known))], float(np.min(known)), 0.25
    for _ in range(_SEARCH_ROUNDS if free.size else 0):
        trials = np.clip(best + step * moves, 0.0, 1.0)
        reached = values(trials)
        if reached.min() < value:
            best, value = trials[int(np.argmin(reached))], float(reached.min())
        else:
            step *= 0.5
    # Rounding may have kept it from an end of an interval.
    ends = np.where(best < _AT_END, 0.0, np.where(best > 1.0 - _AT_END, 1.0, best))
    return ends if values(ends[None])[0] <= value * (1.0 + _AT_END) else best


def _devices(shares: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Devices of a box, exactly its ends where a share is 0 or 1."""
    inside = np.clip(low + shares * (high - low), low, high)
    return np.where(shares == 0.0, low, np.where(shares == 1.0, high, inside))


def _shares(devices: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    width = high - low
    return np.where(width > 0, (devices - low) / np.where(width > 0, width, 1.0), 0.0)


def _grid(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """So many shares of each uncertain quantity, combined: the vertices, and what lies between."""
    axes = [np.linspace(0.0, 1.0, count) if b > a else np.zeros(1) for a, b in zip(low, high, strict=True)]
    return np.array(list(product(*axes)))


def _prove(
    stiffness: float, damping: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray
) -> tuple[bool, np.ndarray]:
    """Prove that (K, ``damping`` of the part's central device) is stable on every device of every part of a box."""
    # It ends as soon as the wall is not stable on the center of a part: no cutting would help. Such centers come
    # second.
    waiting = [(low[None], high[None])]
    looked_at = 0
    while waiting:
        lows, highs = waiting.pop()
        looked_at += len(lows)
        centers = 0.5 * (lows + highs)
        wall = damping(centers)
        spring, delta, d = _normalize_devices(centers)
        fails = ~np.asarray(is_stable(stiffness / spring, wall / spring / centers[:, 2], delta, d))
        if fails.any() or looked_at > _MOST_PARTS:
            return False, centers[fails]
        mass, friction, period, delay = quantities(lows, highs)
        ratio = period / mass
        proved = stable_everywhere(period * ratio * stiffness, ratio * wall, friction * ratio, delay / period)
        lows, highs = _halve_boxes(lows[~proved], highs[~proved])
        waiting += [(lows[i : i + _AT_ONCE], highs[i : i + _AT_ONCE]) for i in range(0, len(lows), _AT_ONCE)]
    return True, np.empty((0, 4))


def _halve_boxes(lows: np.ndarray, highs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut each part in two, across the quantity whose width matters most."""
    mass, damping, period, delay = (0.5 * (lows + highs)).T
    width = (highs - lows).T
    delta, d = damping * period / mass, delay / period
    # Next to a whole delay all changes within a time constant of the device.
    turn = 0.05 * delta / (1.0 + delta * np.abs(d - np.round(d)))
    weights = width[0] / mass, width[1] * period / mass / (0.3 + delta)
    late = (2.0 + d * turn) * width[2] / period, (1.0 / (d + 0.5) + turn) * width[3] / period
    along = np.argmax(np.stack([*weights, *late]), axis=0)
    rows, middle = np.arange(len(lows)), 0.5 * (lows + highs)
    upper, lower = lows.copy(), highs.copy()
    upper[rows, along], lower[rows, along] = middle[rows, along], middle[rows, along]
    return np.concatenate([lows, upper]), np.concatenate([lower, highs])


def _worst(low: np.ndarray, high: np.ndarray) -> tuple:
    """`robust_max_stiffness` of one box."""
    share = _lowest(_stiffest, _grid(low, high, 5), low, high)
    proved, status = np.nan, Status.UNDECIDED
    for tolerance, reached in _BOUNDS:
        for _ in range(_ROUNDS):
            target = float(_stiffest(_devices(share[None], low, high))[0]) * (1.0 - tolerance)
            holds, failing = _prove(
                target, lambda centers, k=target: 0.5 * np.add(*_stable_dampings(k, centers)), low, high
            )
            if holds:
                proved, status = target, reached
            if holds or not len(failing):
                break
            starts = np.concatenate([share[None], _shares(failing, low, high)])
            share = _lowest(_stiffest, starts, low, high)
        if proved > 0:
            break
    worst = _devices(share, low, high)
    is_vertex = bool(np.all((worst == low) | (worst == high)))
    return proved, float(_stiffest(worst[None])[0]), *worst, is_vertex, status


def _best_wall(devices: np.ndarray) -> tuple[float, Callable[[float], float]]:
    """The limit of the walls that suit a few devices, and the middle of the dampings that are left at a stiffness."""

    def common(stiffness: float) -> tuple[float, float]:
        lower, upper = _stable_dampings(stiffness, devices)
        return float(np.max(lower)), float(np.min(upper))

    def suits(stiffness: np.ndarray) -> np.ndarray:
        lower, upper = common(float(stiffness))
        return np.asarray(lower < upper)

    # Rounded up: no wall reaches it.
    limit = float(np.nextafter(bisect(suits, np.float64(0.0), np.min(_stiffest(devices))), np.inf))

    return limit, lambda stiffness: 0.5 * float(np.add(*common(stiffness)))


def _wall(low: np.ndarray, high: np.ndarray) -> tuple:
    """`robust_wall` of one box."""
    devices = _devices(_grid(low, high, 2), low, high)
    limit, middle = _best_wall(devices)
    for tolerance, status in _BOUNDS:
        for _ in range(_ROUNDS):
            stiffness = limit * (1.0 - tolerance)
            # A wall that is read and set is the one that is proved: no more digits than are printed.
            damping = float(f"{middle(stiffness):.{DIGITS}g}")
            holds, failing = _prove(stiffness, lambda centers, b=damping: np.full(len(centers), b), low, high)
            if holds:
                return stiffness, damping, limit, status
            if not len(failing):
                break

            def row_end(candidates: np.ndarray, damping: float = damping) -> np.ndarray:
                spring, delta, d = _normalize_devices(candidates)
                ends = boundary_point(delta, d, beta=damping / spring / candidates[:, 2])
                return np.where(ends.status == Status.OK, np.asarray(ends.alpha) * spring, 0.0)

            found = _lowest(row_end, _shares(failing, low, high), low, high)
            devices = np.concatenate([devices, _devices(found, low, high)[None]])
            limit, middle = _best_wall(devices)
    return np.nan, np.nan, limit, Status.UNDECIDED
