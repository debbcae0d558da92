"""The step study: responses from force to position."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import WrapValidator
from pydantic_core import PydanticCustomError

from zwidth import figures
from zwidth.config.faults import LocatedProblem, problem
from zwidth.config.fields import members
from zwidth.config.parts import list_parts
from zwidth.config.scenes import (
    AnyDevice,
    AnyScene,
    AnyWall,
    DeviceField,
    NormalizedDevice,
    PhysicalDevice,
    PhysicalWall,
    normalized_wall,
)
from zwidth.config.study import HeldOnly, refuse_parts, register
from zwidth.config.values import Duration, Fraction, Quantity
from zwidth.figures.stable_set import name_wall
from zwidth.figures.table import stack
from zwidth.loops.rigid.response import step_response
from zwidth.loops.rigid.ridge import alpha_max
from zwidth.parts.checks import Span
from zwidth.studies.outcome import ComputedStudy, Outcome, WallsStudy
from zwidth.words.formatting import plain, with_unit
from zwidth.words.quantities import LONGEST_SETTLING, Range


class ResponseStudy(ComputedStudy):
    """What the studies that compute responses share."""

    remedy_if_too_large = "shorten the duration, or lower substeps"
    # Time, position, velocity and force.
    point_bytes = 32

    duration: Duration = Span(100.0, "periods")
    """Length of the response, in s or in periods."""

    substeps: Annotated[int, Quantity(allowed=Range(1, 10_000), whole=True)] = 10
    """Points computed per period."""

    delay_model: HeldOnly = "held"
    """How a delay that is not whole is modeled; poles exist in the model 'held' only."""

    def pairs(self) -> tuple[tuple[AnyDevice, AnyWall | None], ...]:
        """Each device with its wall; the wall is None where stiffness_fraction decides it."""
        raise NotImplementedError

    def periods(self, device: AnyDevice) -> float:
        """Length of the response of a device in sampling periods."""
        # By plain division: seconds may be many more periods than the rounding of a delay is made for.
        return self.duration.value / (device.period if self.duration.unit == "s" else 1.0)

    def respond(
        self, device: AnyDevice, alpha: float, beta: float, *, label: str, physical: bool
    ) -> tuple[dict[str, Any], str]:
        """The response of one device to 1 N, or to a unit force where normalized.

        Returns:
            Its columns, those in SI units with their unit; and what to say of one that has not settled at the end.
        """
        periods = max(1, round(self.periods(device)))
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
            longest = f"the delay exceeds {LONGEST_SETTLING} periods"
            unknown = f"the wall is not stable, its poles nearly coincide, or {longest}"
            return columns, f"no settling time: {unknown}"
        after = with_unit(settling_time, "s", 3) if physical else f"{plain(settling_time)} periods"
        late = settling_time > time[-1]
        return columns, f"the response settles after {after}, later than the time shown" if late else ""

    @property
    def sizes(self) -> dict[str, int]:
        periods = max((self.periods(device) for device, _ in self.pairs()), default=0.0)
        return {
            "responses": len(self.pairs()),
            "periods": 1 + int(min(periods, 1e15)),
            "points a period": self.substeps,
        }


@register
class StepStudy(WallsStudy, ResponseStudy):
    """Response of the position to a step of force, for one or more devices."""

    method = "Exact solution between the instants at which a force changes; rounding alone."
    from_scene = ("devices", "delay_model")

    kind: Literal["step"]

    devices: Annotated[tuple[DeviceField, ...], WrapValidator(members("devices"))]
    """Devices; the scene's where left out."""

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
        several = self.walls is not None and len(self.walls) > 1
        faulty: dict[int, PydanticCustomError] = {}
        for index, (device, wall) in enumerate(self.pairs()):
            if wall is None:
                continue
            if isinstance(device, NormalizedDevice) and isinstance(wall, PhysicalWall):
                allowed = "a wall in SI units needs a device with mass and period"
                fault = problem("got a wall in SI units", allowed, "write alpha and beta")
            elif not all(math.isfinite(value) for value in normalized_wall(device, wall)):
                allowed = "alpha and beta must be finite"
                fault = problem("got a wall whose normalized values are beyond float64", allowed, "check the units")
            else:
                continue
            faulty[index if several else 0] = fault
        yield from ((("walls", index), fault) for index, fault in faulty.items())

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
            label = device.label or _wall_text(device, alpha, beta) or f"device {number}"
            part, note = self.respond(device, alpha, beta, label=label, physical=physical)
            parts.append(part)
            notes += [f"{label}: {note}"] if note else []
        table = stack(parts)
        return Outcome(table=table, figures={"": partial(figures.draw_step, table)}, notes=tuple(notes))


def _wall_text(device: AnyDevice, alpha: float, beta: float) -> str:
    """The wall in SI units, the name of a response whose device has none."""
    if not isinstance(device, PhysicalDevice):
        return ""
    wall = device.to_scene().to_si(alpha=alpha, beta=beta)
    return name_wall(wall.stiffness, wall.virtual_damping)
