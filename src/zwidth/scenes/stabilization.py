"""Changes that make an unstable wall stable, one parameter at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zwidth.scenes.assessment import nearest_interval
from zwidth.scenes.base import of_scene
from zwidth.scenes.stiffest import SceneOptima
from zwidth.words.errors import InputError
from zwidth.words.formatting import round_safely, tell_apart, with_unit
from zwidth.words.quantities import PARAMETERS
from zwidth.words.showing import shown

# The direction in which a parameter is searched, and the largest factor on it.
DIRECTIONS = {
    "delay": (-1, 1e3),
    "rate": (1, 10.0),
    "damping": (1, 1e3),
    "velocity.cutoff": (1, 1e3),
    "velocity.time_constant": (-1, 1e3),
    "velocity.samples": (-1, 1e3),
    "actuator.cutoff": (1, 1e3),
    "actuator.time_constant": (-1, 1e3),
    "coupling.stiffness": (1, 1e3),
}
POINTS = 14  # values of a parameter tried over its range
HALVINGS = 14  # of the interval between two of them
DIGITS = 4

NAMES = {
    "stiffness": "K",
    "virtual_damping": "B",
    "damping": "damping of the device",
    "velocity.cutoff": "filter cutoff",
    "velocity.time_constant": "filter time constant",
    "velocity.samples": "velocity window",
    "actuator.cutoff": "amplifier cutoff",
    "actuator.time_constant": "amplifier time constant",
    "coupling.stiffness": "link stiffness",
}


@shown()
class StableRange(NamedTuple):
    """A range of one parameter in which a wall is stable, with everything else unchanged."""

    parameter: str  # dotted path
    low: float  # SI units; -inf for no lower end
    high: float  # inf for no upper end
    note: str = ""

    def spell(self) -> str:
        """Return the range in words, rounded inwards."""
        name, unit = NAMES.get(self.parameter, self.parameter), PARAMETERS[self.parameter].unit
        kept = f" ({self.note})" if self.note else ""
        if self.parameter == "velocity.samples":
            return f"{name} of at most {self.high:g} samples"
        if self.high == math.inf:
            return f"{name} at least {with_unit(round_safely(self.low, 'above', DIGITS), unit, DIGITS)}{kept}"
        if self.low == -math.inf:
            return f"{name} at most {with_unit(round_safely(self.high, 'below', DIGITS), unit, DIGITS)}{kept}"
        return f"{name} from {' to '.join(tell_apart(self.low, self.high, unit))}{kept}"


@of_scene
def stabilize(scene: SceneOptima) -> list[StableRange]:
    """Return the ranges of single parameters in which the wall of a scene is stable.

    Stiffness and virtual damping come first, each with its stable interval next to the present value. Then follow
    delay, rate, damping of the device, velocity filter, actuator and coupling, each in the direction that usually
    helps, if a value within the range that is searched makes the wall stable.
    """
    K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
    row, column = (list(map(tuple, ends.tolist())) for ends in (scene.stable_stiffness(), scene.stable_damping()))
    found = []
    if row:
        low, high = nearest_interval(tuple(row), K)
        found.append(StableRange("stiffness", low if low > 0 or low >= K else -math.inf, high))
    if column:
        found.append(StableRange("virtual_damping", *nearest_interval(tuple(column), B)))
    values = {**scene.parameters(), "rate": 1.0 / scene.timing.period}
    for path, (direction, factor) in DIRECTIONS.items():
        if path in values and (path != "delay" or values[path] > 0):
            found += _search(scene, path, float(values[path]), direction, factor)
    return found


def _search(scene: SceneOptima, path: str, now: float, direction: int, factor: float) -> list[StableRange]:
    """Return the nearest stable range of one parameter in a direction, if any."""

    def holds(value: float) -> bool | None:
        """Return the stability of the wall; None for a refused value, as a cutoff above the Nyquist frequency."""
        try:
            return bool(scene.replace(**{path: value}).is_stable())
        except InputError:
            return None

    if path == "velocity.samples":
        shorter: int | None = next((count for count in range(int(now) - 1, 0, -1) if holds(count)), None)
        return [] if shorter is None else [StableRange(path, -math.inf, shorter)]
    start = now or 1e-3 * scene.units.virtual_damping
    values = [now, *(start * np.geomspace(1.0, factor, POINTS)[1:] ** direction).tolist()]
    if path == "delay":
        values[-1] = 0.0
    stable = [holds(value) for value in values]
    if True not in stable:
        return []
    first = stable.index(True)
    near = _bisect(holds, values[first], values[first - 1]) if first else now
    beyond = stable.index(False, first) if False in stable[first:] else None
    far = _bisect(holds, values[beyond - 1], values[beyond]) if beyond else None
    note = f"the delay stays {scene.timing.kept_delay}" if path == "rate" and scene.timing.delay else ""
    if direction > 0:
        return [StableRange(path, near, math.inf if far is None else far, note)]
    return [StableRange(path, -math.inf if far is None else far, near, note)]


def _bisect(holds: Callable[[float], bool | None], inside: float, outside: float) -> float:
    """Return the value next to the end of a stable range, itself stable."""
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
    return inside
