"""Maximum stiffness and the stiffest wall for all rigid devices with parameters in given intervals.

A device has the parameters m, b, T, t_d: mass, damping, sampling period and delay. A wall has the stiffness K and the
damping B. Normalized quantities are alpha = K T^2/m, beta = B T/m, delta = b T/m and d = t_d/T. The intervals of the
four parameters form a box of devices. The *limit* of a device is its maximum stiffness K_max or, for a wall with
damping B, the largest stable stiffness at this B. A pattern search over the box finds the weakest device, which has the
smallest limit. It starts from the weakest device of a grid that contains all vertices of the box.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import NamedTuple, TypeAlias

import numpy as np

from zwidth.analysis.stiffness import max_stiffness
from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import is_traced
from zwidth.model.checks import accept_units
from zwidth.numerics.evaluate import as_float64, join_shapes
from zwidth.numerics.root_finding import bisect
from zwidth.stability.rigid.boundary import boundary_point
from zwidth.stability.rigid.normalization import normalize, quantity_status
from zwidth.units.display import compact_repr

_NAMES = ("mass", "damping", "period", "delay")  # parameters of a device, in this order
BELOW = 1e-6  # relative distance of a reported stiffness below the limit of the weakest device; covers rounding errors
STARTS = 5  # values per uncertain parameter in the grid of starting devices
SEARCH_STEPS = 60  # steps of the pattern search; each moves the pattern or halves it
ROUNDS = 40  # largest number of devices that `robust_wall` adds to the vertices of the box
DIGITS = 8  # significant digits of the damping of a wall for all devices
AT_END = 1e-12  # relative positions in an interval closer than this to 0 or 1 are treated as its end


class Interval(NamedTuple):
    """An uncertain parameter: all values from ``low`` to ``high``; numbers or arrays that broadcast."""

    low: ArrayLike
    high: ArrayLike


Uncertain: TypeAlias = Interval | ArrayLike


@compact_repr(stiffness_max="N/m", mass="kg", damping="N s/m", period="s", delay="s")
class RobustStiffness(NamedTuple):
    """Largest stiffness that every device of a box can render, and the weakest device found, which limits it."""

    stiffness: Array
    stiffness_max: Array
    mass: Array
    damping: Array
    period: Array
    delay: Array
    is_vertex: Array
    status: Array


@compact_repr(limit="N/m")
class RobustWall(NamedTuple):
    """Wall that is stable on all devices of a box, in N/m and N s/m, and a stiffness that no such wall reaches."""

    stiffness: Array
    virtual_damping: Array
    limit: Array
    status: Array


@accept_units
def robust_max_stiffness(
    *, mass: Uncertain, damping: Uncertain = 0.0, period: Uncertain, delay: Uncertain = 0.0
) -> RobustStiffness:
    """Find the smallest K_max of all devices in a box, the largest stiffness that each of them can render.

    The result is the minimum of ``K_max(m, b, T, t_d)`` over the box. The virtual damping may differ from device to
    device. For one wall (K, B) that is stable on all devices use `robust_wall`, which is never stiffer.

    Args:
        mass: m in kg, > 0: an `Interval`, or an exact value; likewise the other arguments.
        damping: b in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0; need not be a multiple of T. All arguments and ends of intervals broadcast; each entry is
            one box.

    Returns:
        RobustStiffness of the broadcast shape: ``stiffness`` in N/m, 1e-6 below ``stiffness_max``; ``stiffness_max``,
        K_max of the weakest device found, with its ``mass``, ``damping``, ``period`` and ``delay``; ``is_vertex``, True
        if this device is a vertex of the box; ``status``: OK, or INVALID_INPUT or OUT_OF_RANGE with NaN for a box among
        arrays.

    Raises:
        InputError: an argument is a tuple or list instead of an `Interval`, out of range, not a real number, or traced
            by JAX; the ends of an interval are out of order; or shapes do not broadcast.

    Numerics:
        Pattern search, started from the weakest device of a grid with 5 values per uncertain parameter. The minimum is
        not certified. Run time 10 to 100 ms per box.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII; docs/theory/one-lobe.md.

    Example:
        >>> from zwidth import Interval, robust_max_stiffness
        >>> worst = robust_max_stiffness(mass=Interval(0.08, 0.12), damping=10, period=1e-3, delay=1e-3)
        >>> print(worst.is_vertex, worst.mass, f"{worst.stiffness:.0f} N/m")
        True 0.08 17051 N/m
    """
    return RobustStiffness(*_solve_boxes(_find_weakest_device, RobustStiffness._fields, (mass, damping, period, delay)))


@accept_units
def robust_wall(*, mass: Uncertain, damping: Uncertain = 0.0, period: Uncertain, delay: Uncertain = 0.0) -> RobustWall:
    """Find the stiffest single wall (K, B) that is stable on every device of a box.

    Args:
        mass, damping, period, delay: as for `robust_max_stiffness`.

    Returns:
        RobustWall of the broadcast shape: ``stiffness`` in N/m and ``virtual_damping`` in N s/m, stable on every device
        that the search finds; ``limit``, a stiffness that no wall can reach on all devices. ``status`` as for
        `robust_max_stiffness`; UNDECIDED if the search still finds weaker devices after 40 rounds.

    Numerics:
        Computes the best wall for the vertices of the box, then searches for the device with the smallest limit at the
        damping of this wall. If the wall is unstable on this device, the device joins the vertices.

    References:
        Hulin, Preusche, Hirzinger 2006, sections V, VII.

    Example:
        >>> from zwidth import Interval, robust_wall
        >>> wall = robust_wall(mass=Interval(0.08, 0.12), damping=10, period=1e-3, delay=Interval(0, 1e-3))
        >>> print(f"{wall.stiffness:.0f} N/m, {wall.virtual_damping:.1f} N s/m")
        17051 N/m, 33.1 N s/m
    """
    return RobustWall(*_solve_boxes(_find_wall, RobustWall._fields, (mass, damping, period, delay)))


def _solve_boxes(
    solve: Callable[[np.ndarray, np.ndarray], tuple], names: tuple[str, ...], parameters: tuple[Uncertain, ...]
) -> list[np.ndarray]:
    """Check the intervals of the parameters, and compute the results of each box of devices.

    Args:
        solve: function that maps the lower and the upper ends of the four intervals of one box to a tuple of results.
        names: names of the results.
        parameters: mass, damping, period and delay: intervals or exact values, which broadcast.

    Returns:
        One array per result, of the broadcast shape; NaN and a status for invalid boxes.
    """
    ends = []
    for name, value in zip(_NAMES, parameters, strict=True):
        if isinstance(value, tuple | list) and not isinstance(value, Interval):
            raise InputError(
                f"{name}: got {value!r}; write Interval(low, high) for an uncertain quantity, or a NumPy array for "
                "several exact values"
            )
        pair = value if isinstance(value, Interval) else Interval(value, value)
        if is_traced(*pair):
            raise InputError(f"{name}: got a value traced by JAX; pass plain numbers, outside jit, vmap and grad")
        for end in pair:
            normalize(**({"mass": 1.0, "period": 1.0} | {name: end}))
        low, high = (as_float64(name, end) for end in pair)
        if low.ndim == high.ndim == 0 and low > high:
            raise InputError(f"{name}: got {value!r}; the first number must not be greater than the second")
        ends += [low, high]
    join_shapes(zip(map(str, np.repeat(_NAMES, 2)), map(np.shape, ends), strict=True))
    broadcast = np.broadcast_arrays(*ends)
    shape = broadcast[0].shape
    boxes = np.stack([end.ravel() for end in broadcast], axis=-1)
    results = []
    with np.errstate(all="ignore"):
        for box in boxes:
            low, high = box[0::2], box[1::2]
            status = _check_box(low, high)
            results.append(solve(low, high) if status == Status.OK else (*[np.nan] * (len(names) - 1), status))
    columns = zip(*results, strict=True) if results else [()] * len(names)
    # Convert NaN in ``is_vertex``, which marks an invalid box, to False.
    types = {"is_vertex": lambda values: np.equal(values, True), "status": lambda values: np.array(values, np.int32)}
    arrays = (types.get(name, np.array)(values) for name, values in zip(names, columns, strict=True))
    return [np.asarray(array).reshape(shape)[()] for array in arrays]


def _check_box(low: np.ndarray, high: np.ndarray) -> Status:
    """Return the status code of a box given by the ends of its intervals: the lowest error code, or OK."""
    codes = quantity_status(**dict(zip(_NAMES, np.stack([low, high], -1), strict=True)))
    return Status(min(codes[codes > 0].tolist(), default=0)) if np.all(low <= high) else Status.INVALID_INPUT


def _normalize_devices(devices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return m/T^2 (the unit of alpha), delta and d of each device; the rows of ``devices`` are (m, b, T, t_d)."""
    mass, damping, period, delay = devices.T
    return mass / period / period, damping * period / mass, delay / period


def _compute_max_stiffness(devices: np.ndarray) -> np.ndarray:
    """Return K_max in N/m of each device; the rows of ``devices`` are (m, b, T, t_d)."""
    mass, damping, period, delay = devices.T
    return np.asarray(max_stiffness(mass=mass, damping=damping, period=period, delay=delay))


def _stable_dampings(stiffness: float, devices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each device the lower and the upper end of the stable interval of B at one K; NaN if none exists."""
    spring, delta, d = _normalize_devices(devices)
    alpha, damper = stiffness / spring, spring * devices[:, 2]
    lower, upper = (boundary_point(delta, d, alpha=alpha, side=side).beta for side in ("lower", "upper"))
    return np.asarray(lower) * damper, np.asarray(upper) * damper


def _find_lowest(cost: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Find the device with the lowest cost in a box by a pattern search; return its parameters, shape (1, 4).

    The cost of a device is its limit. A pattern consists of a center and its neighbors, one step away in any of the
    uncertain parameters. It moves to the neighbor with the lowest cost; if no neighbor improves on the center, the step
    is halved.
    """
    free = np.flatnonzero(high > low)
    moves = np.zeros((3**free.size, low.size))
    moves[:, free] = np.array(list(product((-1.0, 0.0, 1.0), repeat=free.size)))

    def values(shares: np.ndarray) -> np.ndarray:
        """Return the costs of the devices at relative positions in the box, with infinity in place of NaN."""
        costs = cost(_place_devices(shares, low, high))
        return np.where(np.isnan(costs), np.inf, costs)

    trials = _build_grid(low, high, STARTS)
    best, value, step = trials[0], np.inf, 0.5
    for _ in range(SEARCH_STEPS):
        reached = values(trials)
        if reached.min() < value:
            best, value = trials[int(np.argmin(reached))], float(reached.min())
        else:
            step *= 0.5
        trials = np.clip(best + step * moves, 0.0, 1.0)
    # Replace positions close to the end of an interval by the end, unless this increases the cost, because rounding
    # errors may keep the search from reaching the end.
    ends = np.where(best < AT_END, 0.0, np.where(best > 1.0 - AT_END, 1.0, best))
    return _place_devices((ends if values(ends[None])[0] <= value * (1.0 + AT_END) else best)[None], low, high)


def _place_devices(shares: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the devices at the relative positions ``shares`` in a box; 0 yields exactly ``low``, 1 ``high``."""
    inside = np.clip(low + shares * (high - low), low, high)
    return np.where(shares == 0.0, low, np.where(shares == 1.0, high, inside))


def _build_grid(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """Return a grid of relative positions in a box: all combinations of ``count`` values per uncertain parameter."""
    axes = [np.linspace(0.0, 1.0, count) if b > a else np.zeros(1) for a, b in zip(low, high, strict=True)]
    return np.array(list(product(*axes)))


def _find_weakest_device(low: np.ndarray, high: np.ndarray) -> tuple:
    """Find the weakest device of a box from ``low`` to ``high``, and return the fields of `RobustStiffness`."""
    device = _find_lowest(_compute_max_stiffness, low, high)
    stiffness_max = float(_compute_max_stiffness(device)[0])
    is_vertex = bool(np.all((device == low) | (device == high)))
    return stiffness_max * (1.0 - BELOW), stiffness_max, *device[0], is_vertex, Status.OK


def _find_common_limit(devices: np.ndarray) -> tuple[float, Callable[[float], float]]:
    """Return a K that no wall stable on all devices reaches, and a function that returns the middle stable B at a K."""

    def common(stiffness: float) -> tuple[float, float]:
        """Return the ends of the interval of B that is stable on all devices at one K; lower > upper if it is empty."""
        lower, upper = _stable_dampings(stiffness, devices)
        return float(np.max(lower)), float(np.min(upper))

    def suits(stiffness: np.ndarray) -> np.ndarray:
        """Return whether a wall with this K and a suitable B is stable on all devices."""
        lower, upper = common(float(stiffness))
        return np.asarray(lower < upper)

    # Round the limit up, because it must be a stiffness that no wall stable on all devices reaches.
    limit = float(np.nextafter(bisect(suits, np.float64(0.0), np.min(_compute_max_stiffness(devices))), np.inf))
    return limit, lambda stiffness: 0.5 * float(np.add(*common(stiffness)))


def _find_wall(low: np.ndarray, high: np.ndarray) -> tuple:
    """Find the stiffest wall stable on all devices of a box, and return the fields of `RobustWall`."""
    devices = _place_devices(_build_grid(low, high, 2), low, high)
    limit, middle = _find_common_limit(devices)
    for _ in range(ROUNDS):
        stiffness = limit * (1.0 - BELOW)
        # Round the damping before the search for the weakest device, because users set the rounded value.
        damping = float(f"{middle(stiffness):.{DIGITS}g}")

        def find_limits(candidates: np.ndarray, damping: float = damping) -> np.ndarray:
            """Return the largest stable stiffness of each device at this damping; 0 if none is stable."""
            spring, delta, d = _normalize_devices(candidates)
            ends = boundary_point(delta, d, beta=damping / spring / candidates[:, 2])
            return np.where(ends.status == Status.OK, np.asarray(ends.alpha) * spring, 0.0)

        weakest = _find_lowest(find_limits, low, high)
        if find_limits(weakest)[0] > stiffness:
            return stiffness, damping, limit, Status.OK
        devices = np.concatenate([devices, weakest])
        limit, middle = _find_common_limit(devices)
    return np.nan, np.nan, limit, Status.UNDECIDED
