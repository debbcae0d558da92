"""The stiffest wall that every device of a family can render, when mass, damping, period and delay are uncertain."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from zwidth.design.stiffness import max_stiffness, sensitivities
from zwidth.errors import InputError
from zwidth.scene import normalize
from zwidth.stability.boundary import boundary_point

Interval = tuple[float, float] | float
_NAMES = ("mass", "damping", "period", "delay")
# Samples along every uncertain quantity, and how many of the worst devices a local search starts from.
_GRID, _STARTS = 7, 8
_BISECTIONS = 30


class RobustStiffness(NamedTuple):
    """The worst device of a box: its K_max in N/m, the device, and whether it is a vertex of the box."""

    stiffness: float
    mass: float
    damping: float
    period: float
    delay: float
    is_vertex: bool


def _box(mass: Interval, damping: Interval, period: Interval, delay: Interval) -> np.ndarray:
    """The box as rows (low, high), checked."""
    rows = []
    for name, interval in zip(_NAMES, (mass, damping, period, delay), strict=True):
        ends = np.asarray(interval if np.ndim(interval) else (interval, interval), dtype=object)
        if ends.shape != (2,):
            raise InputError(f"{name}: got {interval!r}; give (low, high), or one number if it is known")
        for end in ends:
            normalize(**({"mass": 1.0, "period": 1.0} | {name: end}))
        low, high = float(ends[0]), float(ends[1])
        if low > high:
            raise InputError(f"{name}: got {interval!r}; the first number must not be greater than the second")
        rows.append((low, high))
    return np.array(rows)


def _devices(box: np.ndarray, count: int) -> np.ndarray:
    """A grid of devices in the box, vertices included: columns mass, damping, period, delay."""
    axes = [np.linspace(low, high, count) if high > low else np.array([low]) for low, high in box]
    return np.array(list(product(*axes))).T


def robust_max_stiffness(
    *, mass: Interval, damping: Interval = 0.0, period: Interval, delay: Interval = 0.0
) -> RobustStiffness:
    """Find the smallest K_max of all devices in a box: each of them can render any wall below it.

    ``min over the box of K_max(m, b, T, t_d)``; the virtual damping may differ from device to device. For one wall
    (K, B) that suits all of them see `robust_wall`, which is never stiffer.

    Args:
        mass: (low, high) of m in kg, or one number; likewise the others.
        damping: of b in N s/m, >= 0.
        period: of T in s, > 0.
        delay: of t_d in s, >= 0.

    Returns:
        RobustStiffness: ``stiffness`` in N/m; ``mass``, ``damping``, ``period``, ``delay`` of the device that attains
        it; ``is_vertex``, whether that is a corner of the box. K_max rises with the damping, so ``damping`` is always
        its lower end; with the mass and the delay it may have an extremum inside.

    Raises:
        InputError: an interval is not (low, high) in range.

    Numerics:
        A grid of devices, then bounded local searches (L-BFGS-B, exact gradient) from the worst of them. Not a proof:
        a dip between grid points deeper than any other would be missed.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth.design import robust_max_stiffness
        >>> worst = robust_max_stiffness(mass=(0.08, 0.12), damping=(5, 15), period=1e-3, delay=(0.5e-3, 1e-3))
        >>> worst.is_vertex, worst.damping, worst.delay
        (True, 5.0, 0.001)
    """
    box = _box(mass, damping, period, delay)
    devices = _devices(box, _GRID)
    stiffness = np.asarray(max_stiffness(**dict(zip(_NAMES, devices, strict=True))))
    order = np.argsort(stiffness, kind="stable")[:_STARTS]
    best, device = float(stiffness[order[0]]), devices[:, order[0]]
    for start in devices[:, order].T:
        reached, candidate = _descend(box, start)
        if reached < best:
            best, device = reached, candidate
    is_vertex = bool(np.all((device == box[:, 0]) | (device == box[:, 1])))
    worst = (float(value) for value in device)
    return RobustStiffness(best, *worst, is_vertex=is_vertex)


def _descend(box: np.ndarray, start: np.ndarray) -> tuple[float, np.ndarray]:
    """A local minimum of K_max in the box, in coordinates that run from 0 to 1."""
    low, width = box[:, 0], box[:, 1] - box[:, 0]

    def device_at(unit: np.ndarray) -> np.ndarray:
        # Exactly the end of the interval at 1, which low + width may miss by rounding.
        return np.where(unit >= 1.0, box[:, 1], low + width * unit)

    def cost(unit: np.ndarray) -> tuple[float, np.ndarray]:
        gain = sensitivities(**dict(zip(_NAMES, device_at(unit), strict=True)))
        slopes = np.array([gain.per_mass, gain.per_damping, gain.per_period, gain.per_delay], dtype=float)
        return float(np.log(gain.stiffness_max)), slopes * width / gain.stiffness_max

    unit = np.divide(start - low, width, out=np.zeros(4), where=width > 0)
    found = minimize(cost, unit, jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)] * 4)
    return float(np.exp(found.fun)), device_at(found.x)


class RobustWall(NamedTuple):
    """One wall for a whole family of devices: K in N/m and B in N s/m."""

    stiffness: float
    virtual_damping: float


def robust_wall(
    *, mass: Interval, damping: Interval = 0.0, period: Interval, delay: Interval = 0.0, samples: int = 3
) -> RobustWall:
    """Find the stiffest single wall (K, B) that is stable on every sampled device of a box.

    The largest K for which the stable intervals of B of all devices have a point in common.

    Args:
        mass: (low, high) of m in kg, or one number; likewise the others.
        damping: of b in N s/m, >= 0.
        period: of T in s, > 0.
        delay: of t_d in s, >= 0.
        samples: devices along every uncertain quantity, at least 2: the vertices, and what lies between.

    Returns:
        RobustWall: ``stiffness``, the limit, which itself is no longer stable, and the ``virtual_damping`` left there.
        Both are NaN where no wall suits all devices.

    Raises:
        InputError: an interval is not (low, high) in range, or ``samples`` is less than 2.

    Numerics:
        Bisection over K, to 1e-9, assuming that a wall can always be made softer. It holds for the sampled devices;
        for those between them it is evidence, not proof.

    References:
        Hulin, Preusche, Hirzinger 2006, sections V, VII.

    Example:
        >>> from zwidth.design import robust_wall
        >>> wall = robust_wall(mass=0.1, damping=10, period=1e-3, delay=1e-3)
        >>> print(f"{wall.stiffness:.0f} N/m")
        19865 N/m
    """
    box = _box(mass, damping, period, delay)
    if not (isinstance(samples, int) and samples >= 2):
        raise InputError(f"samples: got {samples!r}; a whole number of at least 2 is needed")
    devices = _devices(box, samples)
    low, high = 0.0, float(np.min(max_stiffness(**dict(zip(_NAMES, devices, strict=True)))))
    middle_of = np.nan
    for _ in range(_BISECTIONS):
        trial = 0.5 * (low + high)
        lower, upper = _common_damping(trial, devices)
        if lower < upper:
            low, middle_of = trial, 0.5 * (lower + upper)
        else:
            high = trial
    return RobustWall(low if np.isfinite(middle_of) else np.nan, float(middle_of))


def _common_damping(stiffness: float, devices: np.ndarray) -> tuple[float, float]:
    """The interval of B that is stable on every device at this K; empty (or NaN) where there is none."""
    mass, damping, period, delay = devices
    device = normalize(mass=mass, damping=damping, period=period, delay=delay, stiffness=np.full(mass.shape, stiffness))
    rate = mass / period
    lower, upper = (
        np.asarray(boundary_point(device.delta, device.d, alpha=device.alpha, side=side).beta) * rate
        for side in ("lower", "upper")
    )
    return float(np.max(lower)), float(np.min(upper))
