"""Studies of step responses: "step" for given walls, and "recommend" for the recommended wall of a device.

The response of the position to a step of 1 N (or 1 N m) is computed with the wall acting on both sides of its surface.
The recommended wall is the stiffest one that satisfies the required margins (`zwidth.analysis.recommendation`). The
symbols alpha, beta, delta and d are normalized stiffness, virtual damping, physical damping and delay; K_max is the
maximum stable stiffness, and alpha_max its normalized value.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import WrapValidator
from pydantic_core import PydanticCustomError

from zwidth import plotting
from zwidth.analysis.diagnosis import diagnose
from zwidth.analysis.recommendation import Recommendation
from zwidth.analysis.trials import spell_hardware
from zwidth.analysis.wall_search import RANGES, Grasps
from zwidth.config.fields import LocatedProblem, problem, require_entries
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
from zwidth.config.study import make_parts_error, register
from zwidth.config.values import Duration, Fraction, Quantity
from zwidth.model.checks import Span
from zwidth.model.measured_device import MeasuredDevice
from zwidth.plotting.stable_set import trace_outlines
from zwidth.plotting.style import WIDTH, house_style, new_figure
from zwidth.plotting.table import Table, stack
from zwidth.stability.rigid.ridge import alpha_max
from zwidth.stability.rigid.step_response import step_response
from zwidth.studies.outcome import ComputedStudy, Outcome, WallsStudy
from zwidth.units.formatting import format_wall, plain, to_json, with_unit
from zwidth.units.quantities import WALL_RANGE, Range


class ResponseStudy(ComputedStudy):
    """Base of the studies that compute responses to a step of the external force."""

    remedy_if_too_large = "shorten the duration, or lower substeps"
    point_bytes = 32  # bytes of time, position, velocity and force

    duration: Duration = Span(100.0, "periods")
    """Duration of the response, in s or in periods."""

    substeps: Annotated[int, Quantity(allowed=Range(1, 10_000), whole=True)] = 10
    """Number of computed points per period."""

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        """Return each device with its wall; the wall is None if the study computes it."""
        raise NotImplementedError

    def respond(
        self, device: AnyDevice, alpha: float, beta: float, *, label: str, physical: bool
    ) -> tuple[dict[str, Any], str]:
        """Compute the step response of a device with a wall; return its columns, and a note on the settling or "".

        Args:
            device: device without parts.
            alpha: normalized stiffness of the wall.
            beta: normalized virtual damping of the wall.
            label: name of the response.
            physical: True for a step of 1 N and columns in SI units, False for normalized columns.
        """
        periods = max(1, round(self.duration.periods(device.period)))
        raw = step_response(alpha, beta, device.delta, device.d, periods=periods, substeps=self.substeps)
        time_unit, length_unit = (device.period, 1.0 / device.to_scene().units.stiffness) if physical else (1.0, 1.0)
        time_suffix, position_suffix, velocity_suffix, force_suffix = (
            ("_s", "_m", "_m_per_s", "_N") if physical else ("",) * 4
        )
        time, settling_time = raw.time * time_unit, raw.settling_time * time_unit
        columns = {
            **{"label": label, "alpha": alpha, "beta": beta, "delta": device.delta, "d": device.d},
            f"time{time_suffix}": time,
            f"position{position_suffix}": raw.position * length_unit,
            f"velocity{velocity_suffix}": raw.velocity * length_unit / time_unit,
            f"wall_force{force_suffix}": raw.wall_force,
            f"final_position{position_suffix}": raw.final_position * length_unit,
            f"settling_time{time_suffix}": settling_time,
        }
        if np.isnan(settling_time):
            return columns, "no settling time: the wall is unstable, or settles after more than 500,000 periods"
        after = with_unit(settling_time, "s", 3) if physical else f"{plain(settling_time)} periods"
        late = settling_time > time[-1]
        return columns, f"the response settles after {after}, later than the time shown" if late else ""

    @property
    def sizes(self) -> dict[str, int]:
        periods = [min(self.duration.periods(device.period), 1e15) for device, _ in self.pairs()]
        return {"responses": len(periods), "periods": 1 + int(max(periods)), "points a period": self.substeps}


@register
class StepStudy(WallsStudy, ResponseStudy):
    """The response of the position to a step of the external force, for one or more devices and walls."""

    method = "Exact solution between changes of the force; rounding errors only."
    from_scene = ("devices",)

    kind: Literal["step"]

    devices: Annotated[tuple[DeviceField, ...], WrapValidator(require_entries("devices"))]
    """Devices in SI units or normalized, without parts."""

    stiffness_fraction: Fraction | None = None
    """Stiffness as a fraction of alpha_max, with beta at alpha_max; alternative to walls."""

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        for index, device in enumerate(self.devices):
            if device.nonrigid_parts:
                yield ("devices", index), make_parts_error("step", list_parts(device))
        sizes = len(self.devices), len(self.walls or (None,))
        if min(sizes) > 1 and sizes[0] != sizes[1]:
            allowed = "allowed are one wall for all devices, one per device, or one device"
            yield ("walls",), problem(f"got {sizes[1]} walls for {sizes[0]} devices", allowed, "make the numbers equal")
            return
        if self.duration.unit == "s" and any(isinstance(device, NormalizedDevice) for device in self.devices):
            allowed = "the period of a normalized device in seconds is unknown"
            yield ("duration",), problem(f"got {self.duration}", allowed, "write it in periods, as in '100 periods'")
        yield from self._wall_limits()

    def _wall_limits(self) -> Iterable[LocatedProblem]:
        """Yield a problem for each wall that is out of range, or in SI units although its device is normalized."""
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
                label = format_wall(wall.stiffness, wall.virtual_damping, self.unit_system)
            part, note = self.respond(device, alpha, beta, label=label, physical=physical)
            parts.append(part)
            notes += [f"{label}: {note}"] if note else []
        table = stack(parts)
        return Outcome(table=table, figures={"": partial(plotting.draw_step, table)}, notes=tuple(notes))


# Parameters that the report does not list among the parts of the device.
_DEVICE_NAMES = ("mass", "damping", "period", "delay", "delta", "d")


@register
class RecommendStudy(ResponseStudy):
    """The recommended wall of a device with the required margins, its limits, and its step response."""

    method = "Closed forms of boundary, stiffest wall and margins; with parts, signed crossings."
    from_scene = ("device",)

    takes_parts = True

    kind: Literal["recommend"]

    device: PhysicalDevice
    """Device in SI units."""

    stiffness_fraction: Fraction | None = None
    """Largest stiffness of the recommended wall as a fraction of K_max. Default: 0.75 of K_max, a gain margin of 2, a
    phase margin of 30 degrees and soft grasps, if no fraction, margin or passivity is given."""

    gain_margin: Annotated[float, Quantity(allowed=RANGES["gain_margin"])] | None = None
    """Required gain margin: factor on stiffness and virtual damping together, up to which the wall stays stable.
    Default: see stiffness_fraction."""

    phase_margin: Annotated[float, Quantity(allowed=RANGES["phase_margin"])] | None = None
    """Required phase margin in degrees. Default: see stiffness_fraction."""

    passive: bool = False
    """True to require a passive wall."""

    grasps: Grasps | None = None
    """Reference grasps in which the wall must be stable: all, soft or none. Default: soft together with the default
    margins; none if a requirement is given or the scene has an operator."""

    beyond_safe: bool = False
    """True to ignore the safe limit of the device, which is usually set by a fit."""

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        return ((self.device, None),)

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        stem, label = "recommendation" if alone else f"{self.name}_recommendation", self.device.label or self.name
        bare = self.device.to_scene()
        wanted = ("stiffness_fraction", "gain_margin", "phase_margin", "passive", "grasps", "beyond_safe")
        recommendation = bare.recommend(**{name: getattr(self, name) for name in wanted})
        summary, notes, response = recommendation.as_dict(), list(recommendation.notes), None
        lines = (*recommendation.lines(), *self._simulate(recommendation, scene))
        if not bare.nonrigid_parts and recommendation.verdict is not None:
            # Use the normalized wall of the assessment instead of the wall in SI units, because a conversion has
            # rounding errors.
            wall = recommendation.verdict.alpha, recommendation.verdict.beta
            columns, note = self.respond(self.device, *wall, label=label, physical=True)
            summary["recommended"]["settling_time"] = to_json(float(columns["settling_time_s"]))
            response, notes = stack([columns]), [*notes, note] if note else notes
        table = response or stack(trace_outlines(bare, label=label))
        return Outcome(
            table=table,
            figures={"": partial(draw, recommendation, response)} if table else {},
            documents={
                f"{stem}.json": json.dumps(summary, indent=2, allow_nan=False) + "\n",
                f"{stem}.md": _describe(recommendation, summary, lines),
            },
            answer=lines,
            notes=tuple(notes),
        )

    def _simulate(self, recommendation: Recommendation, scene: AnyScene | None) -> list[str]:
        """Simulate the recommended wall with the encoder, friction and motor of the file's scene.

        Returns:
            A line with the diagnosis of the simulated motion; an empty list if no wall is recommended, the scene has
            none of these parameters, or the device is a measured response.
        """
        hardware = {}
        if isinstance(scene, PhysicalScene) and self.device == scene.without_wall():
            hardware = scene.hardware
        if recommendation.verdict is None or not hardware or isinstance(recommendation.scene.device, MeasuredDevice):
            return []
        diagnosis = diagnose(recommendation.scene, **hardware, remedies=False)
        used = spell_hardware(hardware, recommendation.unit_system)
        used += "" if {"coulomb", "static"} & hardware.keys() else ", without friction"
        return [f"simulated with {used}: {diagnosis.word}: {diagnosis.explain()}"]


@house_style()
def draw(recommendation: Recommendation, response: Table | None = None) -> Any:
    """Draw a recommendation and, if given, its step response in a new figure, and return the Axes.

    The figure is not registered with pyplot, so that the caller need not close it.
    """
    # Omit the panel of the step response for a measured device, because a simulation needs a model. The assessment of a
    # measured device contains no frequency of the dominant pole.
    columns = 1 if recommendation.verdict is None or math.isnan(recommendation.verdict.frequency) else 2
    _, axes = new_figure(WIDTH if columns == 2 else 5.6, 3.5, 1, columns)
    return plotting.plot.recommendation(recommendation, axes, response=response)


def _describe(recommendation: Recommendation, summary: dict[str, Any], lines: Iterable[str]) -> str:
    """Return a page in Markdown: the device, the results, and changes of the device that allow more stiffness.

    Args:
        recommendation: recommended wall of the device.
        summary: content of the JSON file of the study.
        lines: results, as printed in the terminal.
    """
    scene, settled, results = recommendation.scene, summary["recommended"]["settling_time"], list(lines)
    times = (with_unit(time, "s") for time in (scene.timing.period, scene.timing.delay))
    parts = [f"{name} = {value}" for name, value in summary["device"].items() if name not in _DEVICE_NAMES]
    if isinstance(scene.device, MeasuredDevice) and recommendation.verdict is not None:
        every = "by the measured curve" if scene.device.deviation is None else "for every response in the band"
        results.append(f"stable {every}")
    if settled is not None:
        results.append(
            f"settles to 2 % of a step of {'torque' if recommendation.unit_system.rotary else 'force'} in about "
            f"{with_unit(settled, 's')}"
        )
    page = [
        *("# Recommended virtual wall", ""),
        "Device: {}, sampled every {}, force delayed by {}.".format(scene.device.spell(), *times),
        *([f"Its parts, in SI units: {', '.join(parts)}."] if scene.nonrigid_parts or scene.operator else []),
        *("", *(f"- {text}" for text in results), ""),
        *(text for note in recommendation.notes for text in (f"Note: {note}", "")),
        *(("To gain stiffness under the same requirements:", "") if recommendation.improvements else ()),
        *(f"- {step.spell()}" for step in recommendation.improvements),
    ]
    return "\n".join(page).rstrip() + "\n"
