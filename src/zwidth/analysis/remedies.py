"""Remedies for a limit cycle: changes of a single parameter that stop the oscillation, found by simulation.

A *trial* simulates the wall with one set of parameter values from several initial conditions; it comes to rest if every
simulated response does (`zwidth.analysis.trials`). The search tries coarse values of each parameter, then fine values
near the smallest change that succeeds. K and B are the stiffness and damping of the wall, Q is the step of the encoder.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from zwidth.analysis.stabilization import Remedy, count_steps
from zwidth.analysis.trials import Experiment
from zwidth.model.linear_device import LinearDevice
from zwidth.units.display import with_units
from zwidth.units.formatting import round_conservatively
from zwidth.units.unit_system import UnitSystem

SPAN = 64.0  # largest factor by which a remedy changes its parameter
COARSE = 12  # values of a parameter simulated over the whole span
FINE = 16  # values simulated between the last coarse value that oscillates and the third coarse value after it
LONGEST_TRIAL = 20_000  # sampling periods per simulation of the search, to limit its run time
RESERVE = 3  # fine values skipped after the first one at rest, because values close to it may oscillate again


class _Candidates(NamedTuple):
    """Values of one parameter to try, ordered from the smallest change to the largest."""

    parameter: str
    values: np.ndarray
    increasing: bool

    def select(self, at_rest: np.ndarray) -> int:
        """Return the smallest index from which on all trials come to rest; ``len(at_rest)`` if no such index exists."""
        return len(at_rest) - int(np.argmin(np.append(at_rest[::-1], False)))

    def refine(self, index: int, present: float) -> _Candidates:
        """Return candidates with finer values near the selected value.

        Args:
            index: index of the selected value; the finer values start after the value before it, which oscillates, and
                end at the second value after it.
            present: current value of the parameter, which precedes the first value.
        """
        before = self.values[index - 1] if index else present or self.values[0] / 2
        values = np.geomspace(before, self.values[min(index + 2, len(self.values) - 1)], FINE + 1)[1:]
        return self._replace(values=values)

    def round(self, system: UnitSystem) -> _Candidates:
        """Return the candidates with each value rounded to three significant digits, away from the current value."""
        values = [
            round_conservatively(value, "above" if self.increasing else "below", 3) for value in self.values.tolist()
        ]
        if self.parameter == "resolution" and system.rotary:
            values = [
                2.0 * math.pi / round_conservatively(count_steps(value), "above", 3) for value in self.values.tolist()
            ]
        return self._replace(values=np.array(values))


def search_remedies(experiment: Experiment, cause: Literal["quantization", "saturation"]) -> list[Remedy]:
    """Return one `Remedy` per parameter whose change stops the oscillation: its values from the smallest change on."""
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
    """Return the values to try, for each parameter whose change may stop the oscillation."""
    scene, hardware = experiment.scene, experiment.hardware
    K, B, Q = float(scene.wall.stiffness), float(scene.wall.virtual_damping), hardware.resolution
    factors = np.geomspace(1.0, SPAN, COARSE + 1)[1:]
    candidates = []
    # Try a finer encoder only with friction: without friction the limit cycle becomes smaller with Q but persists.
    if cause == "quantization" and hardware.static > 0:
        candidates.append(_Candidates("resolution", Q / factors, False))
    if not isinstance(scene.device, LinearDevice):
        least = hardware.coulomb or (K * Q if cause == "quantization" else hardware.max_force) / SPAN
        candidates.append(_Candidates("coulomb", least * factors, True))
    # Do not try K and B without friction, because an external force of K Q/2 then sustains an oscillation for each
    # K and B.
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
    """Run one trial per candidate value; return one boolean array per parameter, True if a trial comes to rest."""
    if not candidates:
        return []
    hardware, sizes = experiment.hardware, [len(each.values) for each in candidates]
    names = {"coulomb", "static", *(each.parameter for each in candidates)}
    table = {name: np.full(sum(sizes), experiment.present[name]) for name in names}
    ends = np.cumsum(sizes)
    for each, end in zip(candidates, ends, strict=True):
        table[each.parameter][end - len(each.values) : end] = each.values
    # In trials with more Coulomb friction, increase the static friction in the same ratio, as in a real device.
    ratio = hardware.static / hardware.coulomb if hardware.coulomb else 1.0
    table["static"] = np.maximum(table["static"], ratio * table["coulomb"])
    return np.split(experiment.measure(**table).amplitude == 0, ends[:-1])
