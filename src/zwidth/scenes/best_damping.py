"""The virtual damping that suits a stiffness best: the fastest to settle, or the farthest from instability."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from zwidth.loops.linear.margins import OpenLoop
from zwidth.parts.wall import resolve_wall
from zwidth.scenes.stiffest import soft_dampings
from zwidth.words.errors import InputError, check_choice
from zwidth.words.status import Status

Goal = Literal["fast", "robust"]

# Samples across a column, how many of their dips are refined, and by how many steps of golden section.
_SAMPLES, _DIPS, _STEPS = 66, 3, 52
_GOLDEN = 0.3819660112501051


class BestDamping(NamedTuple):
    """A virtual damping in N s/m, the spectral radius and the modulus margin there, and the `zwidth.Status`."""

    virtual_damping: float
    spectral_radius: float
    modulus_margin: float
    status: Status


def find_best_damping(
    scene: Any, stiffness: float | None, goal: Goal, negative_damping: bool | None = None
) -> BestDamping:
    """See `zwidth.Scene.best_damping`."""
    check_choice("goal", goal, get_args(Goal))
    stiffness = float(resolve_wall(scene.wall, None, None)[0] if stiffness is None else stiffness)
    if not (math.isfinite(stiffness) and stiffness > 0):
        raise InputError(f"stiffness: got {stiffness:g}; it must be finite and greater than 0 (in N/m)")

    units = scene.units

    def radius(beta: Any) -> np.ndarray:
        return scene.spectral_radius(stiffness, beta * units.virtual_damping)

    @np.vectorize
    def margin(beta: float) -> float:
        loop = scene.loop
        wall = OpenLoop.lay_out(loop.roots, stiffness / units.stiffness, beta, loop.boundary.w)
        return wall.least_distance()[0]

    cost: Callable[[Any], np.ndarray] = radius if goal == "fast" else lambda beta: -margin(beta)
    columns = soft_dampings(scene, stiffness, negative_damping)
    if not columns:
        return BestDamping(math.nan, math.nan, math.nan, Status.NO_BOUNDARY)
    best = min((_lowest(cost, low, high) for low, high in columns), key=lambda beta: float(cost(beta)))
    return BestDamping(best * units.virtual_damping, float(radius(best)), float(margin(best)), Status.OK)


def _lowest(cost: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> float:
    """Where a function with kinks and several dips is lowest: samples, then golden section around the lowest dips."""
    grid = np.linspace(low, high, _SAMPLES)
    # On the boundary itself nothing is gained.
    values = np.pad(cost(grid[1:-1]), 1, constant_values=math.inf)
    dips = 1 + np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:]))
    dips = dips[np.argsort(values[dips])][:_DIPS]
    left, middle, right, value = grid[dips - 1], grid[dips], grid[dips + 1], values[dips]
    for _ in range(_STEPS):
        upwards = right - middle > middle - left
        trial = middle + _GOLDEN * np.where(upwards, right - middle, left - middle)
        reached = cost(trial)
        # Of the trial and the middle the lower one becomes the middle, the other one an end.
        better = reached < value
        end, is_right = np.where(better, middle, trial), better ^ (trial > middle)
        left, right = np.where(is_right, left, end), np.where(is_right, end, right)
        middle, value = np.where(better, trial, middle), np.where(better, reached, value)
    return float(middle[np.argmin(value)])
