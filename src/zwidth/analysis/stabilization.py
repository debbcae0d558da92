"""Remedies: ranges of single parameters in which the wall of a scene is stable, or in which an oscillation stops.

`stabilize` returns the ranges of a scene with an unstable wall; K and B are its stiffness and damping. The stable
intervals of K and B are exact. Other parameters are tried at values from the current one to the end of a search range,
in the direction that usually stabilizes; bisection then finds the ends of the stable range. `zwidth.analysis.remedies`
finds ranges in which a limit cycle stops, by simulation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from zwidth.analysis.assessment import find_nearest_interval
from zwidth.analysis.base import wrap_function
from zwidth.analysis.optimization import SceneOptima
from zwidth.core.errors import InputError
from zwidth.units.display import compact_repr, find_unit
from zwidth.units.formatting import count_digits, format_interval, round_conservatively, with_unit
from zwidth.units.quantities import FIELDS

# Parameters to search, by dotted path, each with its direction, 1 (increase) or -1 (decrease), and the largest factor
# of the change.
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
POINTS = 14  # values of a parameter tried, from the current one to the end of the search range
HALVINGS = 14  # bisection steps between two tried values

NAMES = {
    "stiffness": "K",
    "virtual_damping": "B",
    "resolution": "encoder steps",
    "coulomb": "friction",
    "damping": "damping of the device",
    "velocity.cutoff": "filter cutoff",
    "velocity.time_constant": "filter time constant",
    "velocity.samples": "velocity window",
    "actuator.cutoff": "amplifier cutoff",
    "actuator.time_constant": "amplifier time constant",
    "coupling.stiffness": "link stiffness",
}


@compact_repr()
class Remedy(NamedTuple):
    """A range of one parameter in which an oscillation stops, all other parameters unchanged.

    For an unstable linear loop the wall is stable in the whole range. For a limit cycle, simulations confirm many
    values from the finite end on; values between them may oscillate, because the outcome need not be monotone.
    """

    parameter: str  # dotted path, or "resolution" or "coulomb"
    low: float  # in SI units; -inf if the range has no lower end
    high: float  # in SI units; inf if the range has no upper end
    note: str = ""  # quantity that stays constant, such as "the delay stays 1 ms"

    def spell(self, digits: int = 4) -> str:
        """Return a text with the parameter and its range, whose ends are rounded towards the inside of the range."""
        name, unit = NAMES.get(self.parameter, self.parameter), find_unit(self, FIELDS[self.parameter].unit)
        note = f" ({self.note})" if self.note else ""
        if self.parameter == "velocity.samples":
            return f"{name} of at most {self.high:g} samples"
        if self.parameter == "resolution" and unit == "rad":
            note = f" (at least {count_steps(self.high):,} counts per turn)"
        if self.high == math.inf:
            return f"{name} at least {with_unit(round_conservatively(self.low, 'above', digits), unit, digits)}{note}"
        if self.low == -math.inf:
            return f"{name} at most {with_unit(round_conservatively(self.high, 'below', digits), unit, digits)}{note}"
        return f"{name} from {' to '.join(format_interval(self.low, self.high, unit, digits))}{note}"


def count_steps(resolution: float) -> int:
    """Return the least number of counts per revolution of an encoder whose steps are at most ``resolution``, in rad."""
    return math.ceil(2.0 * math.pi / resolution - 1e-6)


@wrap_function
def stabilize(scene: SceneOptima) -> list[Remedy]:
    """Return the ranges of single parameters in which the wall of a scene is stable.

    The list starts with stiffness and virtual damping, each with the stable interval nearest to its current value.
    Delay, rate, physical damping, velocity filter, actuator and coupling follow; each is searched in the direction that
    usually stabilizes and omitted if no value in the searched range is stable.
    """
    K, B = float(scene.wall.stiffness), float(scene.wall.virtual_damping)
    row, column = (list(map(tuple, ends.tolist())) for ends in (scene.stable_stiffness(), scene.stable_damping()))
    ranges = []
    if row:
        low, high = _round_inwards(*find_nearest_interval(tuple(row), K))
        ranges.append(Remedy("stiffness", low if low > 0 or low >= K else -math.inf, high))
    if column:
        ranges.append(Remedy("virtual_damping", *_round_inwards(*find_nearest_interval(tuple(column), B))))
    values = {**scene.parameters(), "rate": 1.0 / scene.timing.period}
    for path, (direction, factor) in DIRECTIONS.items():
        if path in values and (path != "delay" or values[path] > 0):
            ranges += _search(scene, path, float(values[path]), direction, factor)
    return ranges


def _round_inwards(low: float, high: float) -> tuple[float, float]:
    """Return the ends of an open stable interval, rounded into it to as few digits as possible, at least 4."""

    def shorten(digits: int) -> tuple[float, float]:
        """Round both ends to this number of digits, towards the inside of the interval."""
        return round_conservatively(low, "above", digits), round_conservatively(high, "below", digits)

    return shorten(count_digits(lambda digits: shorten(digits)[0] < shorten(digits)[1]))


def _search(scene: SceneOptima, path: str, present: float, direction: int, factor: float) -> list[Remedy]:
    """Find the stable range of a parameter that is nearest to its current value in one direction.

    Args:
        scene: the scene.
        path: dotted path of the parameter.
        present: current value of the parameter.
        direction: 1 to search larger values, -1 to search smaller ones.
        factor: largest factor of the change.

    Returns:
        A list with one remedy, or an empty list if no stable value was found.
    """

    def holds(value: float) -> bool | None:
        """Return whether the wall is stable; None for an invalid value (a cutoff above the Nyquist frequency)."""
        try:
            return bool(scene.replace(**{path: value}).is_stable())
        except InputError:
            return None

    if path == "velocity.samples":
        shorter: int | None = next((count for count in range(int(present) - 1, 0, -1) if holds(count)), None)
        return [] if shorter is None else [Remedy(path, -math.inf, shorter)]
    start = present or 1e-3 * scene.units.virtual_damping
    values = [present, *(start * np.geomspace(1.0, factor, POINTS)[1:] ** direction).tolist()]
    if path == "delay":
        values[-1] = 0.0
    stable = [holds(value) for value in values]
    if True not in stable:
        return []
    first = stable.index(True)
    near = _bisect(holds, values[first], values[first - 1]) if first else present
    after = stable.index(False, first) if False in stable[first:] else None
    far = _bisect(holds, values[after - 1], values[after]) if after else None
    note = f"the delay stays {scene.timing.delay_text}" if path == "rate" and scene.timing.delay else ""
    if path == "rate" and scene.tool is not None and scene.tool.every > 1:
        note = "; ".join(filter(None, [note, f"the tool keeps one step per {scene.tool.every} periods"]))
    if direction > 0:
        return [Remedy(path, near, math.inf if far is None else far, note)]
    return [Remedy(path, -math.inf if far is None else far, near, note)]


def _bisect(holds: Callable[[float], bool | None], inside: float, outside: float) -> float:
    """Find the end of a stable range by bisection between a stable and another value; return the last stable value."""
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
    return inside
