"""Remedies for the sustained oscillation of a wall: changes of a single parameter that stop it.

`stabilize_loop` searches for changes that make the linear loop stable, `search_remedies` for changes that end a limit
cycle. Symbols: K and B of the wall, Q the step of the encoder.
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np

from zwidth.parts.linear_device import LinearDevice
from zwidth.scenes.trials import FIRST_DISPLACEMENT, Experiment
from zwidth.simulation.result import MotionKind
from zwidth.simulation.simulate import simulate
from zwidth.words.formatting import round_safely, with_unit
from zwidth.words.unit_system import UnitSystem

SPAN = 64.0  # largest factor by which a remedy changes its parameter
COARSE = 12  # values of a parameter simulated over the whole span
FINE = 6  # values simulated between the last oscillating coarse value and the first at rest
LONGEST_TRIAL = 20_000  # sampling periods per simulation of the search, to limit its run time
CHECK_PERIODS = 2000  # sampling periods of the simulation that confirms a stable range
DELAY_ACCURACY = 1e-3  # relative accuracy of the largest stable delay; printed with 3 digits

_PHRASES = {
    "resolution": ("an encoder with steps of", "m"),
    "coulomb": ("friction of", "N"),
    "stiffness": ("K of", "N/m"),
    "virtual_damping": ("B of", "N s/m"),
    "delay": ("a delay of", "s"),
}


class Remedy(NamedTuple):
    """A range of one parameter in which the oscillation stops, all other parameters unchanged.

    For an unstable linear loop the whole range is stable. For a limit cycle or saturation, simulations confirm only the
    finite end of the range: other values in it may oscillate, because the outcome need not be monotone.
    """

    parameter: str  # "resolution", "coulomb", "stiffness", "virtual_damping" or "delay"
    low: float  # in SI units; 0 if the range has no lower end
    high: float  # in SI units; infinite if the range has no upper end

    def spell(self, system: UnitSystem, simulated: bool = False) -> str:
        """Return the change in words, with its unit; only the confirmed value if it was ``simulated``."""
        phrase, unit = _PHRASES[self.parameter]
        low, high = (with_unit(end, system[unit], 3) for end in (self.low, self.high))
        if self.low > 0 and self.high < math.inf:
            return f"{phrase} {low} to {high}"
        side = "" if simulated else "at least " if self.low > 0 else "at most "
        text = f"{phrase} {side}{low if self.low > 0 else high}"
        if self.parameter == "resolution" and system.rotary:
            text += f" ({_count_steps(self.high):,} counts per turn)"
        return text


def _count_steps(resolution: float) -> int:
    """Return the counts per turn of an encoder with this step in rad."""
    return math.ceil(2.0 * math.pi / resolution - 1e-6)


def stabilize_loop(scene: Any) -> list[Remedy]:
    """Return the ranges of K, of B and of the delay in which the linear loop is stable."""
    K, B, delay = float(scene.wall.stiffness), float(scene.wall.virtual_damping), float(scene.timing.delay)
    ranges = []
    for name, value, intervals in (
        ("stiffness", K, scene.stable_stiffness(B)),
        ("virtual_damping", B, scene.stable_damping(K)),
    ):
        if len(intervals):
            ends = min(intervals.tolist(), key=lambda ends: max(ends[0] - value, value - ends[1]))
            ranges.append(Remedy(name, round_safely(max(ends[0], 0.0), "above", 3), round_safely(ends[1], "below", 3)))
    low, high = 0.0, delay
    if delay and scene.replace(delay=0.0).is_stable():
        while high - low > DELAY_ACCURACY * delay:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if scene.replace(delay=middle).is_stable() else (low, middle)
        if (value := round_safely(low, "below", 3)) > 0:
            ranges.append(Remedy("delay", 0.0, value))
    return [remedy for remedy in ranges if remedy.low < remedy.high and _is_stabilized(scene, remedy)]


def _is_stabilized(scene: Any, remedy: Remedy) -> bool:
    """Return whether simulations of the linear loop decay at both ends of a range."""
    ends = [end for end in (remedy.low, remedy.high) if 0 < end < math.inf]
    start: dict[str, Any] = (
        {"push": 1.0} if isinstance(scene.device, LinearDevice) else {"start_position": FIRST_DISPLACEMENT}
    )
    changed = [scene.replace(**{remedy.parameter: end}) for end in ends]
    outcome = simulate(changed, periods=CHECK_PERIODS, record=False, **start).outcome
    return bool(np.isin(outcome, (MotionKind.REST, MotionKind.DECAYING)).all())


class _Candidates(NamedTuple):
    """Values of one parameter to try, ordered from the smallest change to the largest."""

    parameter: str
    values: np.ndarray
    increasing: bool

    def select(self, at_rest: np.ndarray) -> int:
        """Return the index of the first value from which all trials come to rest; ``len(at_rest)`` if none does."""
        return len(at_rest) - int(np.argmin(np.append(at_rest[::-1], False)))

    def refine(self, index: int, present: float) -> _Candidates:
        """Return values between the last oscillating value, excluded, and the selected one, included."""
        before = self.values[index - 1] if index else present or self.values[0] / 2
        values = np.geomspace(before, self.values[index], FINE + 2)[1:]
        return self._replace(values=values)

    def round(self, system: UnitSystem) -> _Candidates:
        """Return the values to three significant digits, each rounded away from the parameter's current value."""
        values = [round_safely(value, "above" if self.increasing else "below", 3) for value in self.values.tolist()]
        if self.parameter == "resolution" and system.rotary:
            values = [2.0 * math.pi / round_safely(_count_steps(value), "above", 3) for value in self.values.tolist()]
        return self._replace(values=np.array(values))


def search_remedies(experiment: Experiment, cause: Literal["quantization", "saturation"]) -> list[Remedy]:
    """Return, for each parameter, the smallest change after which every simulated response comes to rest."""
    hardware = experiment.hardware
    periods = min(experiment.periods, LONGEST_TRIAL)
    experiment = experiment._replace(periods=periods, decay=experiment.decay * periods / experiment.periods)
    if cause == "saturation":
        experiment = experiment._replace(hardware=hardware._replace(resolution=0.0))
    chosen = []
    candidates = _list_candidates(experiment, cause)
    for each, at_rest in zip(candidates, _try(experiment, candidates), strict=True):
        index = each.select(at_rest)
        if index < len(at_rest):
            fine = each.refine(index, experiment.present[each.parameter])
            chosen.append((each, fine.round(experiment.scene.unit_system)))
    remedies = []
    for (coarse, fine), at_rest in zip(chosen, _try(experiment, [fine for _, fine in chosen]), strict=True):
        index = fine.select(at_rest)
        if index < len(at_rest):
            value, last = float(fine.values[index]), float(coarse.values[-1])
            open_end = math.inf if coarse.parameter == "coulomb" else last
            remedies.append(Remedy(coarse.parameter, *((value, open_end) if coarse.increasing else (0.0, value))))
    return remedies


def _list_candidates(experiment: Experiment, cause: str) -> list[_Candidates]:
    """Return the values to try of every parameter that may stop the oscillation."""
    scene, hardware = experiment.scene, experiment.hardware
    K, B, Q = float(scene.wall.stiffness), float(scene.wall.virtual_damping), hardware.resolution
    factors = np.geomspace(1.0, SPAN, COARSE + 1)[1:]
    candidates = []
    # Without friction a finer encoder does not help, because the limit cycle shrinks with Q but persists.
    if cause == "quantization" and hardware.static > 0:
        candidates.append(_Candidates("resolution", Q / factors, False))
    if not isinstance(scene.device, LinearDevice):
        least = hardware.coulomb or (K * Q if cause == "quantization" else hardware.max_force) / SPAN
        candidates.append(_Candidates("coulomb", least * factors, True))
    # Without friction no K or B helps, because under an external force of K Q/2 the encoder reading never settles.
    if cause == "quantization" and not hardware.static:
        return [each.round(scene.unit_system) for each in candidates]
    if K > 0:
        candidates.append(_Candidates("stiffness", K / factors, False))
    if B > 0:
        candidates.append(_Candidates("virtual_damping", B / factors, False))
        candidates.append(_Candidates("virtual_damping", B * factors, True))
    usable = [each for each in candidates if np.all(np.isfinite(each.values) & (each.values > 0))]
    return [each.round(scene.unit_system) for each in usable]


def _try(experiment: Experiment, candidates: list[_Candidates]) -> list[np.ndarray]:
    """Return, for each list of candidates, a boolean array that marks the values whose trials come to rest."""
    if not candidates:
        return []
    hardware, sizes = experiment.hardware, [len(each.values) for each in candidates]
    names = {"coulomb", "static", *(each.parameter for each in candidates)}
    table = {name: np.full(sum(sizes), experiment.present[name]) for name in names}
    ends = np.cumsum(sizes)
    for each, end in zip(candidates, ends, strict=True):
        table[each.parameter][end - len(each.values) : end] = each.values
    # A trial with more Coulomb friction keeps the device's ratio of static to Coulomb friction.
    ratio = hardware.static / hardware.coulomb if hardware.coulomb else 1.0
    table["static"] = np.maximum(table["static"], ratio * table["coulomb"])
    return np.split(experiment.measure(**table).amplitude == 0, ends[:-1])
