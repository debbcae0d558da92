"""The stiffest stable wall of a scene in SI units: by closed form, on the host, or inside a JAX transformation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.xp import is_jax, is_traced, namespace
from zwidth.loops.linear.columns import stable_dampings
from zwidth.loops.linear.pieces import Island
from zwidth.loops.linear.ridge import BoundRidge, find_ridge
from zwidth.loops.rigid.boundary import boundary_point
from zwidth.loops.rigid.ridge import alpha_max
from zwidth.parts.velocity import BackwardDifference
from zwidth.words.errors import InputError, ZwidthError
from zwidth.words.status import RidgeKind, Status
from zwidth.words.types import Array

# By what share a row may end below the stiffest wall that is on it.
_ROUNDED = 1e-6


class StiffestWall(NamedTuple):
    """The stiffest stable wall: N/m, N s/m, Hz, and the codes of `zwidth.RidgeKind` and `zwidth.Status`."""

    stiffness: Array
    virtual_damping: Array
    frequency: Array
    kind: Array
    status: Array


def allows_negative(scene: Any, negative_damping: bool | None) -> bool:
    """Whether walls with B < 0 count: by default only where B acts on the plain difference of two samples."""
    return isinstance(scene.velocity, BackwardDifference) if negative_damping is None else bool(negative_damping)


def stiffest_wall(scene: Any, negative_damping: bool | None = None) -> StiffestWall:
    """See `zwidth.Scene.max_stiffness`, for numbers that nothing traces, and for rigid devices."""
    negative = allows_negative(scene, negative_damping)
    if scene.is_rigid:
        return _rigid_wall(scene, negative)
    refuse_fractional_power(scene)
    held = {path: float(value) for path, value in scene.parameters().items() if is_jax(value)}
    scene = scene.replace(**held) if held else scene
    found, status = search(scene, negative)
    if found is None:
        nan = np.float64(math.nan)
        return StiffestWall(nan, nan, nan, np.int32(RidgeKind.SMOOTH), np.int32(status))
    units = scene.units
    return StiffestWall(
        np.float64(found.alpha * units.stiffness),
        np.float64(found.beta * units.virtual_damping),
        np.float64(found.omega / (2.0 * math.pi * scene.timing.period)),
        np.int32(found.kind),
        np.int32(status),
    )


def choose_damping(scene: Any, top: StiffestWall, stiffness: float) -> float:
    """A damping with which a softer wall than the stiffest is stable, where it can be so without leaving its piece.

    That of the stiffest wall, if all walls of that damping between the two are stable; else the middle of the widest
    interval of dampings.
    """
    damping = float(top.virtual_damping)
    row = scene.stable_stiffness(damping)
    if scene.is_rigid or np.any((row[:, 0] < stiffness) & (row[:, 1] > (1.0 - _ROUNDED) * top.stiffness)):
        return damping
    column = soft_dampings(scene, stiffness, allows_negative(scene, None))
    low, high = max(column, key=lambda ends: ends[1] - ends[0], default=(math.nan, math.nan))
    return 0.5 * (low + high) * scene.units.virtual_damping if column else damping


def soft_dampings(scene: Any, stiffness: float, negative: bool) -> list[tuple[float, float]]:
    """The intervals of beta with which walls of a stiffness are stable in a piece with soft walls."""
    alpha, least = stiffness / scene.units.stiffness, -math.inf if negative else 0.0
    column = np.maximum(stable_dampings(scene.traced_boundary, alpha), least)
    return [
        (low, high)
        for low, high in column.tolist()
        if low < high and (scene.is_rigid or scene.border.pieces.holds_softly(alpha, 0.5 * (low + high)))
    ]


def list_islands(scene: Any, negative_damping: bool | None = None) -> list[Island]:
    """See `zwidth.Scene.islands`."""
    if scene.is_rigid:
        return []
    units = np.array([scene.units.stiffness, scene.units.virtual_damping])[:, None]
    found = scene.border.islands(-math.inf if allows_negative(scene, negative_damping) else 0.0)
    return [Island(*(tuple(pair.tolist()) for pair in np.array(one) * units)) for one in found]


def refuse_fractional_power(scene: Any) -> None:
    """Raise `InputError` for the paper's z^(1+d) where it has no meaning."""
    if scene.timing.delay_model != "held":
        raise InputError(
            f"delay_model: got {scene.timing.delay_model!r}, which is known of a rigid device with the backward "
            "difference only; use 'held'"
        )


def search(scene: Any, negative: bool) -> tuple[BoundRidge | None, Status]:
    """The ridge of a scene of plain numbers, or why there is none."""
    border = scene.border
    if negative not in border.ridges:
        try:
            border.ridges[negative] = find_ridge(border, negative)
        except (ArithmeticError, ZwidthError):
            return None, Status.NOT_CONVERGED
    found = border.ridges[negative]
    return found, Status.NO_BOUNDARY if found is None else Status.OK


def _rigid_wall(scene: Any, negative: bool) -> StiffestWall:
    """The closed form; without negative dampings the end of the row B = 0 where the ridge lies below it."""
    device, model = scene.normalized, scene.timing.delay_model
    alpha, beta, omega, kind, status = alpha_max(device.delta, device.d, delay=model)
    xp = namespace(alpha)
    below = beta < 0
    # Asked for only where it counts, unless a trace hides whether it does.
    if not negative and (is_traced(below) or below):
        row = boundary_point(device.delta, device.d, beta=0.0 * device.delta, delay=model)
        alpha, beta = xp.where(below, row.alpha, alpha), xp.where(below, 0.0 * row.alpha, beta)
        omega, kind = xp.where(below, row.omega, omega), xp.where(below, int(RidgeKind.NO_DAMPING), kind)
        status = xp.where(below, row.status, status)
    mass, period = scene.mass, scene.timing.period
    rate = mass / period
    # In the order of `zwidth.max_stiffness`, for the same last digit.
    values = (alpha * rate / period, beta * rate, omega / (2.0 * math.pi * period), kind, status)
    return StiffestWall(*(value if is_jax(value) else np.asarray(value)[()] for value in values))
