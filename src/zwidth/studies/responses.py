"""Responses of walls: the step study, and the recommend study: the wall to set, what limits it, and how it moves."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import WrapValidator
from pydantic_core import PydanticCustomError

from zwidth import figures
from zwidth.config.fields import LocatedProblem, members, problem
from zwidth.config.parts import list_parts
from zwidth.config.scenes import (
    AnyDevice,
    AnyScene,
    AnyWall,
    DeviceField,
    NormalizedDevice,
    PhysicalDevice,
    PhysicalScene,
    PhysicalWall,
    normalized_wall,
)
from zwidth.config.study import refuse_parts, register
from zwidth.config.values import Duration, Fraction, Quantity
from zwidth.figures.stable_set import trace_outlines
from zwidth.figures.style import WIDTH, house_style, new_figure
from zwidth.figures.table import Table, stack
from zwidth.loops.rigid.response import step_response
from zwidth.loops.rigid.ridge import alpha_max
from zwidth.parts.checks import Span
from zwidth.parts.measured import MeasuredDevice
from zwidth.scenes.diagnosis import diagnose
from zwidth.scenes.recommendation import Recommendation
from zwidth.scenes.trials import spell_hardware
from zwidth.scenes.wall_search import RANGES, Grasps
from zwidth.studies.outcome import ComputedStudy, Outcome, WallsStudy
from zwidth.words.formatting import name_wall, plain, to_json, with_unit
from zwidth.words.quantities import WALL_RANGE, Range


class ResponseStudy(ComputedStudy):
    """Base of the studies that compute responses."""

    remedy_if_too_large = "shorten the duration, or lower substeps"
    # Time, position, velocity and force.
    point_bytes = 32

    duration: Duration = Span(100.0, "periods")
    """Length of the response, in s or in periods."""

    substeps: Annotated[int, Quantity(allowed=Range(1, 10_000), whole=True)] = 10
    """Points computed per period."""

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        """Each device with its wall; the wall is None where stiffness_fraction decides it."""
        raise NotImplementedError

    def respond(
        self, device: AnyDevice, alpha: float, beta: float, *, label: str, physical: bool
    ) -> tuple[dict[str, Any], str]:
        """Return the response of a device to 1 N, normalized to a unit force, as columns, and a note on settling."""
        periods = max(1, round(self.duration.periods(device.period)))
        raw = step_response(alpha, beta, device.delta, device.d, periods=periods, substeps=self.substeps)
        clock, length = (device.period, 1.0 / device.to_scene().units.stiffness) if physical else (1.0, 1.0)
        second, meter, speed, newton = ("_s", "_m", "_m_per_s", "_N") if physical else ("",) * 4
        time, settling_time = raw.time * clock, raw.settling_time * clock
        columns = {
            **{"label": label, "alpha": alpha, "beta": beta, "delta": device.delta, "d": device.d},
            f"time{second}": time,
            f"position{meter}": raw.position * length,
            f"velocity{speed}": raw.velocity * length / clock,
            f"wall_force{newton}": raw.wall_force,
            f"final_position{meter}": raw.final_position * length,
            f"settling_time{second}": settling_time,
        }
        if np.isnan(settling_time):
            return columns, "no settling time: the wall is not stable, or needs more than 500,000 periods to settle"
        after = with_unit(settling_time, "s", 3) if physical else f"{plain(settling_time)} periods"
        late = settling_time > time[-1]
        return columns, f"the response settles after {after}, later than the time shown" if late else ""

    @property
    def sizes(self) -> dict[str, int]:
        periods = [min(self.duration.periods(device.period), 1e15) for device, _ in self.pairs()]
        return {"responses": len(periods), "periods": 1 + int(max(periods)), "points a period": self.substeps}


@register
class StepStudy(WallsStudy, ResponseStudy):
    """Response of the position to a step of force, for one or more devices."""

    method = "Exact solution between the instants at which a force changes; rounding alone."
    from_scene = ("devices",)

    kind: Literal["step"]

    devices: Annotated[tuple[DeviceField, ...], WrapValidator(members("devices"))]
    """Devices."""

    stiffness_fraction: Fraction | None = None
    """Stiffness as a share of alpha_max, with beta as at the ridge; give this or walls."""

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        for index, device in enumerate(self.devices):
            if device.parts_beyond:
                yield ("devices", index), refuse_parts("step", list_parts(device))
        sizes = len(self.devices), len(self.walls or (None,))
        if min(sizes) > 1 and sizes[0] != sizes[1]:
            allowed = "one wall for all devices, one for each, or one device for all walls"
            yield ("walls",), problem(f"got {sizes[1]} walls for {sizes[0]} devices", allowed, "make the numbers equal")
            return
        if self.duration.unit == "s" and any(isinstance(device, NormalizedDevice) for device in self.devices):
            allowed = "a normalized device has no period to measure seconds in"
            yield ("duration",), problem(f"got {self.duration}", allowed, "write it in periods, as in '100 periods'")
        yield from self._wall_limits()

    def _wall_limits(self) -> Iterable[LocatedProblem]:
        """Walls that do not fit their device, each reported once."""
        least, most = WALL_RANGE
        faults: dict[int, PydanticCustomError] = {}
        for number, (device, wall) in enumerate(self.pairs()):
            if wall is None:
                continue
            if isinstance(device, NormalizedDevice) and isinstance(wall, PhysicalWall):
                allowed = "a wall in SI units needs a device with mass and period"
                fault = problem("got a wall in SI units", allowed, "write alpha and beta")
            elif not all(value == 0 or least <= abs(value) <= most for value in normalized_wall(device, wall)):
                allowed = f"alpha and beta must be 0 or {least:g} to {most:g} in magnitude"
                fault = problem("got a wall that is out of range", allowed, "check the units")
            else:
                continue
            faults.setdefault(number % len(self.walls or ()), fault)
        yield from ((("walls", index), fault) for index, fault in faults.items())

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        walls = self.walls or (None,)
        count = max(len(self.devices), len(walls))
        return tuple((self.devices[k % len(self.devices)], walls[k % len(walls)]) for k in range(count))

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        physical = all(isinstance(device, PhysicalDevice) for device in self.devices)
        parts, notes = [], []
        for number, (device, given) in enumerate(self.pairs(), start=1):
            if given is not None:
                alpha, beta = normalized_wall(device, given)
            else:
                ridge = alpha_max(device.delta, device.d)
                assert self.stiffness_fraction is not None, "a study without walls has a fraction"
                alpha, beta = self.stiffness_fraction * float(ridge.alpha), float(ridge.beta)
            label = device.label or f"device {number}"
            if not device.label and isinstance(device, PhysicalDevice):
                wall = device.to_scene().to_si(alpha=alpha, beta=beta)
                label = name_wall(wall.stiffness, wall.virtual_damping, self.unit_system)
            part, note = self.respond(device, alpha, beta, label=label, physical=physical)
            parts.append(part)
            notes += [f"{label}: {note}"] if note else []
        table = stack(parts)
        return Outcome(table=table, figures={"": partial(figures.draw_step, table)}, notes=tuple(notes))


_BARE = ("mass", "damping", "period", "delay", "delta", "d")


@register
class RecommendStudy(ResponseStudy):
    """The wall to set on a device in SI units, at wanted margins, and its response."""

    method = "Closed forms of boundary, stiffest wall and margins; with parts, signed crossings."
    from_scene = ("device",)

    takes_parts = True

    kind: Literal["recommend"]

    device: PhysicalDevice
    """Device in SI units."""

    stiffness_fraction: Fraction | None = None
    """Largest stiffness of the recommended wall as a fraction of K_max. If neither a fraction, a margin nor passivity
    is given, the defaults are 0.75 of K_max, a gain margin of 2, a phase margin of 30 degrees and soft grasps."""

    gain_margin: Annotated[float, Quantity(allowed=RANGES["gain_margin"])] | None = None
    """The factor on stiffness and damping together that the wall must bear, at least."""

    phase_margin: Annotated[float, Quantity(allowed=RANGES["phase_margin"])] | None = None
    """The phase margin that the wall must have, at least, in degrees."""

    passive: bool = False
    """Whether the wall must be passive."""

    grasps: Grasps | None = None
    """Require stability in all reference grasps, in the soft ones, or in none. By default soft, with the default
    margins; none if a requirement is given or the scene has a hand."""

    beyond_safe: bool = False
    """Ignore the safe limit of the device, which is usually set by a fit."""

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        return ((self.device, None),)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        stem, label = "recommendation" if alone else f"{self.name}_recommendation", self.device.label or self.name
        bare = self.device.to_scene()
        wanted = ("stiffness_fraction", "gain_margin", "phase_margin", "passive", "grasps", "beyond_safe")
        found = bare.recommend(**{name: getattr(self, name) for name in wanted})
        told, notes, response = found.as_dict(), list(found.notes), None
        lines = (*found.lines(), *self._simulate(found, scene))
        if not bare.parts_beyond and found.verdict is not None:
            # The wall as it was judged: from SI units and back, a last digit may be another.
            wall = found.verdict.alpha, found.verdict.beta
            columns, note = self.respond(self.device, *wall, label=label, physical=True)
            told["recommended"]["settling_time"] = to_json(float(columns["settling_time_s"]))
            response, notes = stack([columns]), [*notes, note] if note else notes
        table = response or stack(trace_outlines(bare, label=label))
        return Outcome(
            table=table,
            figures={"": partial(draw, found, response)} if table else {},
            documents={
                f"{stem}.json": json.dumps(told, indent=2, allow_nan=False) + "\n",
                f"{stem}.md": _describe(found, told, lines),
            },
            answer=lines,
            notes=tuple(notes),
        )

    def _simulate(self, found: Recommendation, scene: AnyScene | None) -> list[str]:
        """Return a line with the diagnosis of the wall, with encoder, friction and motor of the scene of the file."""
        hardware = {}
        if isinstance(scene, PhysicalScene) and self.device == scene.bare():
            hardware = scene.hardware
        if found.verdict is None or not hardware or isinstance(found.scene.device, MeasuredDevice):
            return []
        diagnosis = diagnose(found.scene, **hardware, remedies=False)
        used = spell_hardware(hardware, found.unit_system)
        used += "" if {"coulomb", "static"} & hardware.keys() else ", without friction"
        return [f"simulated with {used}: {diagnosis.word}: {diagnosis.explain()}"]


@house_style()
def draw(found: Recommendation, response: Table | None = None) -> Any:
    """Draw a recommendation into a figure that pyplot does not know, and return its Axes."""
    # Of a measured response no motion is known.
    columns = 1 if found.verdict is None or math.isnan(found.verdict.frequency) else 2
    _, axes = new_figure(WIDTH if columns == 2 else 5.6, 3.5, 1, columns)
    return figures.plot.recommendation(found, axes, response=response)


def _describe(found: Recommendation, told: dict[str, Any], lines: Iterable[str]) -> str:
    """A recommendation as Markdown: its device, what a terminal is told of the wall, and what would allow more."""
    scene, settled, said = found.scene, told["recommended"]["settling_time"], list(lines)
    times = (with_unit(time, "s") for time in (scene.timing.period, scene.timing.delay))
    parts = [f"{name} = {value}" for name, value in told["device"].items() if name not in _BARE]
    if isinstance(scene.device, MeasuredDevice) and found.verdict is not None:
        every = "by the measured curve" if scene.device.deviation is None else "for every response in the band"
        said.append(f"stable {every}")
    if settled is not None:
        said.append(
            f"settles to 2 % of a step of {'torque' if found.unit_system.rotary else 'force'} in about "
            f"{with_unit(settled, 's')}"
        )
    page = [
        *("# Recommended virtual wall", ""),
        "Device: {}, sampled every {}, force delayed by {}.".format(scene.device.spell(), *times),
        *([f"Its parts, in SI units: {', '.join(parts)}."] if scene.parts_beyond or scene.operator else []),
        *("", *(f"- {text}" for text in said), ""),
        *(text for note in found.notes for text in (f"Note: {note}", "")),
        *(("To gain stiffness under the same requirements:", "") if found.steps else ()),
        *(f"- {step.spell()}" for step in found.steps),
    ]
    return "\n".join(page).rstrip() + "\n"
