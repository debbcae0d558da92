"""Floating-point filter of the certified method: the verdict in float64 balls over arrays of walls."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from zwidth._types import Array
from zwidth.batching import BLOCK, FEW, in_blocks
from zwidth.domain import LARGEST_DAMPING, LONGEST_DELAY, WALL_RANGE
from zwidth.stability.certified_rows import OPEN, UNSTABLE, by_rows, has_rows
from zwidth.stability.devices import Kind, kind_of
from zwidth.stability.enclosed_plant import plant
from zwidth.stability.enclosed_verdict import (
    Long,
    Short,
    Verdict,
    enclose_zero,
    long_device,
    long_verdict,
    short_device,
    short_verdict,
    take_lag,
)
from zwidth.stability.enclosure import Ball
from zwidth.stability.layout import Points
from zwidth.xp import namespace

# Added to the code where alpha or beta is 0 or a value is out of range: XLA takes numbers below 2^-1022 for zero, and
# at alpha = 0 the verdict is not on the pole at z = 1.
SPECIAL = 4


def filtered(points: Points) -> np.ndarray:
    """The code of every point, of the broadcast shape."""
    return by_rows(points, _each) if has_rows(points) else _each(points)


def _each(points: Points) -> np.ndarray:
    """The same, point by point."""
    shape, kind = points.shape, kind_of(points.d)
    if points.size <= FEW:
        # NumPy is several times faster with scalars than with arrays without axes.
        alpha, beta, delta, d = (array[()] for array in points)
        with np.errstate(all="ignore"):
            return np.broadcast_to(wall_codes(alpha, beta, device_fields(delta, d, kind), kind), shape).copy()
    if points.delta.size == points.d.size == 1:
        with np.errstate(all="ignore"):
            fields = device_fields(points.delta.reshape(()), points.d.reshape(()), kind)
        columns = [np.broadcast_to(array, shape).reshape(-1) for array in points[:2]]
        shared = _compiled(kind, True)
        return in_blocks(lambda alpha, beta: shared(alpha, beta, fields), columns, BLOCK).reshape(shape)
    columns = [np.broadcast_to(array, shape).reshape(-1) for array in points]
    code = in_blocks(_compiled(kind, False), columns, BLOCK).reshape(shape)
    if np.signbit(points.delta).any() or np.signbit(points.d).any():
        code |= np.where((points.delta < 0) | (points.d < 0), SPECIAL, 0).astype(np.uint8)
    return code


@cache
def _compiled(kind: Kind, shared: bool) -> Any:
    import jax

    if shared:
        return jax.jit(lambda alpha, beta, fields: wall_codes(alpha, beta, fields, kind))
    return jax.jit(lambda alpha, beta, delta, d: wall_codes(alpha, beta, device_fields(delta, d, kind), kind))


def device_fields(delta: Array, d: Array, kind: Kind) -> list[Array]:
    """What the verdict needs of each device: whether it is in range, the whole periods, midpoints and radii."""
    xp = namespace(delta, d)
    ok = (delta >= 0) & (delta <= LARGEST_DAMPING) & (d >= 0) & (d <= LONGEST_DELAY)
    delta, d = xp.where(ok, delta, 1.0), xp.where(ok, d, 0.0)
    whole = xp.floor(d)
    here = plant(delta, d - whole if kind.fractional else None)
    fields = [ok, whole]
    for wanted, device in ((kind.short, short_device), (kind.long, long_device)):
        if wanted:
            fields += _numbers(device(here))
    return fields


def _numbers(tree: Any) -> list[Array]:
    """Midpoints and radii of all balls of a device, in order."""
    if isinstance(tree, Ball):
        return [tree.mid] if tree.rad is None else [tree.mid, tree.rad]
    return [number for part in tree or () for number in _numbers(part)]


@cache
def _shapes(kind: Kind) -> tuple[Any, Any]:
    """One short and one long device, for the places of their balls."""
    here = plant(np.float64(1.0), np.float64(0.5) if kind.fractional else None)
    return short_device(here) if kind.short else None, long_device(here) if kind.long else None


def _rebuilt(tree: Any, numbers: Any) -> Any:
    """`_numbers` undone."""
    if isinstance(tree, Ball):
        return Ball(next(numbers), None if tree.rad is None else next(numbers))
    if tree is None:
        return None
    parts = [_rebuilt(part, numbers) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def wall_codes(alpha: Array, beta: Array, fields: list[Array], kind: Kind) -> Array:
    """The codes of walls on given devices, elementwise."""
    ok, whole, *numbers = fields
    rest = iter(numbers)
    short, long = (_rebuilt(shape, rest) for shape in _shapes(kind))
    delta = (short or long).plant.delta.mid
    xp = namespace(alpha, beta, delta)
    verdict = _verdict(Ball(alpha), Ball(beta), whole, short, long, xp)
    above = beta + delta > 0
    sure = verdict.stable | verdict.unstable
    code = xp.where(sure & above, verdict.stable.astype(xp.uint8), xp.uint8(OPEN))
    # P(1) = phi1 alpha < 0: a real pole beyond 1. The lobe lies above beta = -delta.
    code = xp.where((alpha < 0) | ((alpha > 0) & (beta <= -delta)), xp.uint8(UNSTABLE), code)
    least, most = WALL_RANGE
    stiffness, damping = abs(alpha), abs(beta)
    plain = ok & (stiffness >= least) & (stiffness <= most) & (damping >= least) & (damping <= most)
    return code + xp.where(plain, xp.uint8(0), xp.uint8(SPECIAL))


def _verdict(alpha: Ball, beta: Ball, whole: Array, short: Short | None, long: Long | None, xp: Any) -> Verdict:
    late = None if long is None else long_verdict(alpha, beta, whole, long, enclose_zero, take_lag)
    early = None if short is None else short_verdict(alpha, beta, short)
    if early is None or late is None:
        found = early or late
        assert found is not None
        return found
    return Verdict(*(xp.where(whole < 1, one, other) for one, other in zip(early, late, strict=True)))
