"""The stiffest stable wall of a scene in SI units."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.xp import is_jax, is_traced
from zwidth.parts.velocity import BackwardDifference
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
    """See `zwidth.Scene.max_stiffness`."""
    alpha, beta, omega, kind, status = scene.loop.stiffest(allows_negative(scene, negative_damping))
    mass, period = (value if is_traced(value) else float(value) for value in (scene.mass, scene.timing.period))
    rate = mass / period
    # In the order of `zwidth.max_stiffness`, for the same last digit.
    values = (alpha * rate / period, beta * rate, omega / (2.0 * math.pi * period), kind, status)
    return StiffestWall(*(value if is_jax(value) else np.asarray(value)[()] for value in values))


def choose_damping(scene: Any, top: StiffestWall, stiffness: float) -> float:
    """A damping with which a softer wall than the stiffest is stable, where it can be so without leaving its piece.

    That of the stiffest wall, if all walls of that damping between the two are stable; else the middle of the widest
    interval of dampings.
    """
    damping = float(top.virtual_damping)
    row = scene.stable_stiffness(damping)
    if np.any((row[:, 0] < stiffness) & (row[:, 1] > (1.0 - _ROUNDED) * top.stiffness)):
        return damping
    column = soft_dampings(scene, stiffness)
    low, high = max(column, key=lambda ends: ends[1] - ends[0], default=(math.nan, math.nan))
    return 0.5 * (low + high) * scene.units.virtual_damping if column else damping


def soft_dampings(scene: Any, stiffness: float, negative_damping: bool | None = None) -> list[tuple[float, float]]:
    """The intervals of beta with which walls of a stiffness are stable in a piece with soft walls."""
    least = -math.inf if allows_negative(scene, negative_damping) else 0.0
    return scene.loop.soft_column(stiffness / scene.units.stiffness, least)
