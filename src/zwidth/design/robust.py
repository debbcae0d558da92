"""The stiffest wall that every device of a family can render, when mass, damping, period and delay are uncertain."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import is_traced, pointwise
from zwidth.design.column import column, lobe
from zwidth.design.lowest import lowest_in_cube, without_slope
from zwidth.design.stiffness import max_stiffness
from zwidth.errors import InputError
from zwidth.loop import poison
from zwidth.scene import normalize
from zwidth.stability.ridge import ridge_kernel

Interval: TypeAlias = tuple[ArrayLike, ArrayLike] | ArrayLike
_NAMES = ("mass", "damping", "period", "delay")
_ENDS = tuple(f"{name}[{end}]" for name in _NAMES for end in (0, 1))
# Samples along every uncertain quantity but the damping, how many of the worst devices a local search starts from, and
# its rounds.
_GRID, _STARTS, _ROUNDS = 7, 4, 64
_BISECTIONS = 40
_CHUNK = 1 << 6


class RobustStiffness(NamedTuple):
    """The worst device of a box: its K_max in N/m, the device, and whether it is a vertex of the box."""

    stiffness: Array
    mass: Array
    damping: Array
    period: Array
    delay: Array
    is_vertex: Array


class _Box(NamedTuple):
    """The lowest and the highest mass, damping, period and delay of one family, and whether they are in range."""

    low: Array
    high: Array
    ok: Array

    def device(self, unit: Array) -> Array:
        """The device at coordinates from 0 to 1 along every quantity; exactly the ends of the intervals there.

        Even in the logarithm of mass and period, which may span decades. Of the coordinates no derivative is passed on.
        """
        low, high, unit = (jax.lax.stop_gradient(value) for value in (self.low, self.high, unit))
        ratio = (high / jnp.where(low > 0, low, 1.0)) ** unit
        inside = jnp.where(np.array([True, False, True, False]), low * ratio, low + (high - low) * unit)
        inside = jnp.clip(inside, low, high)
        at_low = (unit <= 0.0) | (low == high)
        return jnp.where(at_low, self.low, jnp.where(unit >= 1.0, self.high, inside))


def _box(ends: tuple[Array, ...]) -> _Box:
    low, high = jnp.stack(ends[0::2]), jnp.stack(ends[1::2])
    above = jnp.where(np.array([True, False, True, False]), low > 0, low >= 0)
    ok = jnp.all(above & (low <= high) & jnp.isfinite(high))
    return _Box(jnp.where(ok, low, 1.0), jnp.where(ok, high, 1.0), ok)


def _ends(mass: Interval, damping: Interval, period: Interval, delay: Interval) -> tuple[ArrayLike, ...]:
    """The ends of the four intervals, checked."""
    ends: list[ArrayLike] = []
    for name, interval in zip(_NAMES, (mass, damping, period, delay), strict=True):
        whole = not isinstance(interval, tuple | list) and np.ndim(interval) == 0
        pair = (interval, interval) if whole else interval
        if len(pair) != 2:
            raise InputError(f"{name}: got {interval!r}; give (low, high), or one number if it is known")
        low, high = pair
        for end in (low, high):
            if not is_traced(end):
                normalize(**({"mass": 1.0, "period": 1.0} | {name: end}))
        if not is_traced(low, high) and np.ndim(low) == np.ndim(high) == 0 and np.asarray(low) > np.asarray(high):
            raise InputError(f"{name}: got {interval!r}; the first number must not be greater than the second")
        ends += [low, high]
    return tuple(ends)


def robust_max_stiffness(
    *, mass: Interval, damping: Interval = 0.0, period: Interval, delay: Interval = 0.0
) -> RobustStiffness:
    """Find the smallest K_max of all devices in a box: each of them can render any wall below it.

    ``min over the box of K_max(m, b, T, t_d)``; the virtual damping may differ from device to device. For one wall
    (K, B) that suits all of them see `robust_wall`, which is never stiffer.

    Args:
        mass: (low, high) of m in kg, > 0, or one number; likewise the others.
        damping: of b in N s/m, >= 0.
        period: of T in s, > 0.
        delay: of t_d in s, >= 0. Every end may be an array: all eight broadcast, a box for each entry.

    Returns:
        RobustStiffness of the broadcast shape: ``stiffness`` in N/m; ``mass``, ``damping``, ``period``, ``delay`` of
        the device that attains it; ``is_vertex``, whether that is a corner of the box. K_max rises with the damping, so
        ``damping`` is always its lower end; with the mass and the delay it may have an extremum inside. A box out of
        range among arrays gives NaN.

    Raises:
        InputError: an interval is not (low, high), two numbers are out of range or order, an argument is no real
            number, or shapes do not broadcast.

    Numerics:
        A grid of 343 devices, then pattern searches from the worst four of them: K_max to about 1e-14, an inner device
        to about 1e-7 of the box. Not a proof: a dip between grid points deeper than any other would be missed.
        Traceable; derivatives of ``stiffness`` are those of K_max at the worst device in the ends on which it lies.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth.design import robust_max_stiffness
        >>> worst = robust_max_stiffness(mass=(0.08, 0.12), damping=(5, 15), period=1e-3, delay=(0.5e-3, 1e-3))
        >>> print(worst.is_vertex, worst.damping, worst.delay)
        True 5.0 0.001
    """
    ends = _ends(mass, damping, period, delay)
    return pointwise(_worst_kernel, _ENDS, ends, chunk=_CHUNK)


def _worst_kernel(*ends: Array) -> RobustStiffness:
    box = _box(ends)

    def stiffness(unit: Array) -> Array:
        """The logarithm of K_max, which rises with the damping: the lower end is therefore taken."""
        mass, damping, period, delay = box.device(jnp.stack([unit[0], jnp.zeros_like(unit[0]), unit[1], unit[2]]))
        return jnp.log(max_stiffness(mass=mass, damping=damping, period=period, delay=delay))

    unit = lowest_in_cube(stiffness, axes=3, grid=_GRID, starts=_STARTS, rounds=_ROUNDS, dtype=ends[0].dtype)
    device = box.device(jnp.stack([unit[0], jnp.zeros_like(unit[0]), unit[1], unit[2]]))
    mass, damping, period, delay = device
    reached = max_stiffness(mass=mass, damping=damping, period=period, delay=delay)
    bad = poison(box.ok, *ends)
    is_vertex = box.ok & jnp.all((device == box.low) | (device == box.high))
    return RobustStiffness(reached + bad, mass + bad, damping + bad, period + bad, delay + bad, is_vertex)


class RobustWall(NamedTuple):
    """One wall for a whole family of devices: K in N/m and B in N s/m."""

    stiffness: Array
    virtual_damping: Array


def robust_wall(
    *, mass: Interval, damping: Interval = 0.0, period: Interval, delay: Interval = 0.0, samples: int = 3
) -> RobustWall:
    """Find the stiffest single wall (K, B) that is stable on every sampled device of a box.

    The largest K for which the stable intervals of B of all devices have a point in common.

    Args:
        mass: (low, high) of m in kg, > 0, or one number; likewise the others.
        damping: of b in N s/m, >= 0.
        period: of T in s, > 0.
        delay: of t_d in s, >= 0. Every end may be an array: all eight broadcast, a box for each entry.
        samples: devices along every uncertain quantity, at least 2: the vertices, and what lies between.

    Returns:
        RobustWall of the broadcast shape: ``stiffness`` in N/m, the limit, which itself is no longer stable, and the
        ``virtual_damping`` in N s/m left there. Both are NaN where no wall suits all devices, or out of range.

    Raises:
        InputError: an interval is not (low, high), two numbers are out of range or order, an argument is no real
            number, shapes do not broadcast, or ``samples`` is less than 2.

    Numerics:
        Bisection over K, to 1e-12 of the largest K_max, assuming that a wall can always be made softer and that the
        stable dampings of a stiffness are one interval, as pole counts showed. It holds for the sampled devices; for
        those between them it is evidence, not proof. Traceable, with NaN for derivatives: which devices limit the wall
        changes from box to box.

    References:
        Hulin, Preusche, Hirzinger 2006, sections V, VII.

    Example:
        >>> from zwidth.design import robust_wall
        >>> wall = robust_wall(mass=0.1, damping=10, period=1e-3, delay=1e-3)
        >>> print(f"{wall.stiffness:.0f} N/m")
        19865 N/m
    """
    ends = _ends(mass, damping, period, delay)
    if not (isinstance(samples, int) and samples >= 2):
        raise InputError(f"samples: got {samples!r}; a whole number of at least 2 is needed")
    return pointwise(_wall_kernel, _ENDS, ends, (samples,), chunk=_CHUNK)


def _wall_kernel(*arguments: Any) -> RobustWall:
    *ends, samples = arguments
    box = _box(tuple(ends))
    axis = np.linspace(0.0, 1.0, samples)
    grid = jnp.asarray(list(product(axis, repeat=4)), box.low.dtype)
    mass, damping, period, delay = jax.lax.stop_gradient(jax.vmap(box.device)(grid)).T
    _, _, delta, d = normalize(mass=mass, damping=damping, period=period, delay=delay)
    ridge = jax.vmap(lambda delta, d: ridge_kernel(delta, d, "held"))(delta, d)
    lobes = jax.vmap(lobe)(delta, d, ridge.alpha, ridge.omega)
    rate = mass / period

    def halve(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, left = state
        trial = 0.5 * (low + high)
        columns = jax.vmap(column)(trial / rate * period, lobes)
        lower, upper = jnp.max(columns.lower * rate), jnp.min(columns.upper * rate)
        common = jnp.all(columns.exists) & (lower < upper)
        left = jnp.where(common, 0.5 * (lower + upper), left)
        return jnp.where(common, trial, low), jnp.where(common, high, trial), left

    highest = jnp.min(ridge.alpha * rate / period)
    start = (jnp.zeros_like(highest), highest, jnp.full_like(highest, jnp.nan))
    stiffness, _, virtual_damping = jax.lax.fori_loop(0, _BISECTIONS, halve, start)
    bad = jnp.where(box.ok & jnp.isfinite(virtual_damping), 0.0, jnp.nan).astype(stiffness.dtype)
    return without_slope(RobustWall(stiffness + bad, virtual_damping + bad), tuple(ends))
