"""Remedies for a limit cycle: changes of a single parameter that end it, found by simulation.

Symbols: K and B of the wall, Q the step of the encoder.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from zwidth.parts.linear_device import LinearDevice
from zwidth.scenes.stabilization import Remedy, count_steps
from zwidth.scenes.trials import Experiment
from zwidth.words.formatting import round_conservatively
from zwidth.words.showing import with_units
from zwidth.words.unit_system import UnitSystem

SPAN = 64.0  # largest factor by which a remedy changes its parameter
COARSE = 12  # values of a parameter simulated over the whole span
FINE = 16  # values simulated between the last oscillating value and the third coarse value after it
LONGEST_TRIAL = 20_000  # sampling periods per simulation of the search, to limit its run time
RESERVE = 3  # of these values skipped after the first at rest, because the outcome is not monotone close to it


class _Candidates(NamedTuple):
    """Values of one parameter to try, ordered from the smallest change to the largest."""

    parameter: str
    values: np.ndarray
    increasing: bool

    def select(self, at_rest: np.ndarray) -> int:
        """Return the index of the first value from which all trials come to rest; ``len(at_rest)`` if none does."""
        return len(at_rest) - int(np.argmin(np.append(at_rest[::-1], False)))

    def refine(self, index: int, present: float) -> _Candidates:
        """Return values from the last oscillating one, excluded, through the selected one to the second after it."""
        before = self.values[index - 1] if index else present or self.values[0] / 2
        values = np.geomspace(before, self.values[min(index + 2, len(self.values) - 1)], FINE + 1)[1:]
        return self._replace(values=values)

    def round(self, system: UnitSystem) -> _Candidates:
        """Return the values to three significant digits, each rounded away from the parameter's current value."""
        values = [
            round_conservatively(value, "above" if self.increasing else "below", 3) for value in self.values.tolist()
        ]
        if self.parameter == "resolution" and system.rotary:
            values = [
                2.0 * math.pi / round_conservatively(count_steps(value), "above", 3) for value in self.values.tolist()
            ]
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
            value, last = float(fine.values[min(index + RESERVE, FINE - 1)]), float(coarse.values[-1])
            open_end = math.inf if coarse.parameter == "coulomb" else last
            remedies.append(Remedy(coarse.parameter, *((value, open_end) if coarse.increasing else (-math.inf, value))))
    return with_units(remedies, experiment.scene.unit_system)


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
