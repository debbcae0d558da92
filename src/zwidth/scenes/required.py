"""The value of one parameter of a scene at which its stiffest wall reaches a wanted stiffness."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from zwidth.scenes.stiffest import stiffest_wall
from zwidth.words.errors import InputError, describe_choice
from zwidth.words.status import Status

# How far the range reaches to both sides of the present value where none is given, and its points.
_REACH, _POINTS = 30.0, 25
# By what share of the value both sides of a crossing are proved, the closest that tells them apart.
_BESIDE = (1e-11, 1e-9, 1e-7, 1e-5)

# The logarithm of a stiffness that counts as none.
_HARDLY_ANY = 60.0

Side = Literal["above", "below", "everywhere", "nowhere"]


class Crossing(NamedTuple):
    """A value of a parameter at which K_max passes the wanted stiffness, and on which side of it there is enough."""

    value: float
    enough: Side


class RequiredValue(NamedTuple):
    """The value to choose, the side on which there is enough, and every crossing in the range, ascending."""

    value: float
    enough: Side
    crossings: tuple[Crossing, ...]
    range: tuple[float, float]
    status: Status


def require(
    scene: Any,
    parameter: str,
    stiffness: float,
    within: tuple[float, float] | None = None,
    negative_damping: bool | None = None,
) -> RequiredValue:
    """See `zwidth.Scene.required`."""
    if not (isinstance(stiffness, int | float | np.number) and math.isfinite(stiffness) and stiffness > 0):
        raise InputError(f"stiffness: got {stiffness!r}; it must be finite and greater than 0 (in N/m)")
    now = _present_value(scene, parameter)
    low, high = _range(parameter, now, within)

    def surplus(value: float) -> float:
        """How K_max compares with the wanted stiffness, in logarithms; NaN where it cannot be computed."""
        wall = stiffest_wall(scene.replace(**{parameter: value}), negative_damping)
        if wall.status == Status.NO_BOUNDARY:
            return -_HARDLY_ANY
        return math.log(wall.stiffness / stiffness) if wall.status == Status.OK else math.nan

    grid, values = [], []
    for value in np.geomspace(low, high, _POINTS).tolist():
        try:
            values.append(surplus(value))
        except InputError:
            # The range ends where values are refused, as for a cut-off at half the sampling rate.
            continue
        grid.append(value)
    if not grid:
        raise InputError(f"within: {parameter} cannot have any value from {low:g} to {high:g}")
    low, high = grid[0], grid[-1]
    enough = [value >= 0 for value in values if not math.isnan(value)]
    if not enough or not any(enough):
        status = Status.UNREACHABLE if enough and len(enough) == len(values) else Status.NOT_CONVERGED
        return RequiredValue(math.nan, "nowhere", (), (low, high), status)
    if len(enough) == len(values) and all(enough):
        return RequiredValue(min(max(now, low), high), "everywhere", (), (low, high), Status.OK)
    found = tuple(
        _cross(surplus, grid[k], grid[k + 1])
        for k in range(len(grid) - 1)
        if (values[k] >= 0) != (values[k + 1] >= 0) and not math.isnan(values[k] + values[k + 1])
    )
    proved = tuple(crossing for crossing in found if crossing is not None)
    if not proved or len(proved) < len(found):
        return RequiredValue(math.nan, "nowhere", proved, (low, high), Status.NOT_CONVERGED)
    middle = now if now > 0 else low
    best = min(proved, key=lambda crossing: abs(math.log(crossing.value / middle)))
    return RequiredValue(best.value, best.enough, proved, (low, high), Status.OK)


def _present_value(scene: Any, parameter: str) -> float:
    known = scene.parameters()
    known = {path: value for path, value in known.items() if path not in ("stiffness", "virtual_damping")}
    known["rate"] = 1.0 / known["period"]
    if parameter not in known:
        raise InputError(f"parameter: {describe_choice(parameter, tuple(known))}")
    if isinstance(known[parameter], int | np.integer):
        raise InputError(f"parameter: got {parameter!r}, a whole number; try its few values one by one")
    return float(known[parameter])


def _range(parameter: str, now: float, within: tuple[float, float] | None) -> tuple[float, float]:
    if within is None:
        if not now > 0:
            raise InputError(f"within: {parameter} is 0 now; give the range to search, as within=(0.1, 10)")
        return now / _REACH, now * _REACH
    low, high = (float(end) for end in within)
    if not 0 < low < high < math.inf:
        raise InputError(f"within: got {within!r}; two finite numbers with 0 < low < high are needed")
    return low, high


def _cross(surplus: Callable[[float], float], low: float, high: float) -> Crossing | None:
    """The crossing between two values, proved by a value on each side of it; None where it cannot be."""
    from scipy.optimize import brentq

    root = brentq(lambda x: surplus(min(max(math.exp(x), low), high)), math.log(low), math.log(high))
    place = math.exp(cast("float", root))
    for share in _BESIDE:
        ends = place * (1.0 - share), place * (1.0 + share)
        below, above = (surplus(end) >= 0 for end in ends)
        if below != above:
            return Crossing(ends[1], "above") if above else Crossing(ends[0], "below")
    return None
