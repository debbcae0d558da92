"""Study "simulate": motions of a device on virtual walls over time.

`SimulationConditions` are the options of `zwidth.simulate` that do not belong to the device or its walls: duration,
initial state, external force, encoder, friction, motor limits and jitter. They are shared with the study "limit_cycle".
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from zwidth import plotting
from zwidth.analysis.scene import Scene
from zwidth.config.fields import LocatedProblem, Strict, problem
from zwidth.config.parts import NO_LINEAR_FORM, SimulatedVelocityField, parse_input_error
from zwidth.config.scenes import AnyScene, PhysicalWall, SimulatedDevice
from zwidth.config.study import register
from zwidth.config.values import Axis, AxisOf, Delay, Duration, Quantity, quantity_of
from zwidth.core.errors import InputError
from zwidth.model.checks import Span
from zwidth.model.measured_device import MeasuredDevice
from zwidth.model.velocity import FOAW
from zwidth.plotting.table import SI_COLUMNS, stack
from zwidth.simulation.arguments import refuse_unsupported
from zwidth.simulation.behavior import describe_ending
from zwidth.simulation.result import OF_MOTION, OF_WHOLE, READING, Motion
from zwidth.simulation.simulate import Contact
from zwidth.studies.outcome import ComputedStudy, Outcome, WallsStudy, csv_text
from zwidth.units.formatting import format_wall, header
from zwidth.units.quantities import HARDWARE, NOT_NEGATIVE, POSITIVE, Range

MAX_PERIODS = 1_000_000
"""Largest duration of a motion in sampling periods."""

# Variables of the controller, whose arrays have one value per sample instead of one per substep.
_OF_SAMPLES = READING


class SimulationConditions(Strict):
    """Conditions of a simulation: duration, initial state, force, contact, encoder, friction, motor and jitter."""

    duration: Duration = Span(1000.0, "periods")
    """Duration of the motion, in s or in periods."""

    velocity: SimulatedVelocityField | None = None
    """Velocity estimate. Default: that of the device."""

    start_position: Annotated[float, quantity_of("start_position")] = 0.0
    start_velocity: Annotated[float, quantity_of("start_velocity")] = 0.0
    external_force: Annotated[float, quantity_of("external_force")] = 0.0

    contact: Contact = "bilateral"
    """Contact of the wall: bilateral (the wall acts on both sides of its surface), unilateral (only for positive
    positions), or push_only (only for positive positions, and never with a pulling force)."""

    resolution: Annotated[float, quantity_of("resolution")] = 0.0
    noise: Annotated[float, quantity_of("noise")] = 0.0
    coulomb: Annotated[float, quantity_of("coulomb")] = 0.0
    static: Annotated[float, quantity_of("static")] | None = None
    max_force: Annotated[float, quantity_of("max_force")] | None = None
    max_rate: Annotated[float, quantity_of("max_rate")] | None = None

    jitter: Delay = Span(0.0, "s")
    """Largest random delay of a sample, in s or in periods; less than one period."""

    seed: Annotated[int, Quantity(allowed=NOT_NEGATIVE, whole=True)] = 0
    """Seed of the random numbers, a whole number."""

    def find_inconsistencies(self, scene: Scene) -> Iterable[LocatedProblem]:
        """Yield a problem for each value that is inconsistent with another value, the device or the sampling period."""
        period = scene.timing.period
        if self.static is not None and self.static < self.coulomb:
            message = f"got {self.static:g} N, below coulomb, {self.coulomb:g} N"
            yield ("static",), problem(message, "static friction is at least the sliding friction", "raise it")
        if not self.jitter.seconds(period) < period:
            message = f"got {self.jitter}"
            yield ("jitter",), problem(message, "a sample is late by less than one period", "write '0.2 periods'")
        if not 1 <= round(self.duration.periods(period)) <= MAX_PERIODS:
            message = f"got {self.duration}, which is {self.duration.periods(period):.4g} periods"
            yield ("duration",), problem(message, f"1 to {MAX_PERIODS} periods", "change the duration")
        if isinstance(scene.device, MeasuredDevice):
            allowed = "a simulation needs mass and damping, or a linear system"
            yield ("device",), problem("got a measured response", allowed, "fit a model to a log with the kind 'fit'")
        if self.velocity is not None and not isinstance(placed := self.set_velocity(scene).velocity, FOAW):
            try:
                placed.estimate(period)
            except InputError as error:
                yield parse_input_error(error)
        try:
            refuse_unsupported([self.set_velocity(scene)], self.contact, None)
        except InputError as error:
            yield parse_input_error(error)

    def set_velocity(self, scene: Scene) -> Scene:
        """Return the scene with the velocity estimate of these conditions, or unchanged if they have none."""
        return scene if self.velocity is None else scene.replace(velocity=self.velocity.instance)

    def list_options(self, period: float) -> dict[str, Any]:
        """Return the conditions as keyword arguments of `Scene.simulate`; ``period`` is the sampling period in s."""
        names = [name for name in SimulationConditions.model_fields if name not in ("duration", "velocity", "jitter")]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        periods = max(1, round(self.duration.periods(period)))
        return {**given, "periods": periods, "jitter": self.jitter.seconds(period)}


class SimulatedStudy(ComputedStudy):
    """Base of the studies that simulate a device."""

    from_scene = ("device", *HARDWARE)
    takes_parts = True
    simulates = True

    device: SimulatedDevice
    """Device in SI units."""


@register
class SimulateStudy(WallsStudy, SimulatedStudy, SimulationConditions):
    """The motions of a device in one or several walls, by simulation."""

    method = "Matrix exponentials between events; transitions of friction located to rounding errors."
    remedy_if_too_large = "shorten the duration, lower substeps, or use fewer walls"
    point_bytes = 8 * len(OF_MOTION)

    kind: Literal["simulate"]

    substeps: Annotated[int, Quantity(allowed=Range(1, 10_000), whole=True)] = 1
    """Number of recorded points per period."""

    tool_position: Annotated[float, quantity_of("start_position")] | None = None
    """Initial position of the tool, for a scene with a tool. Default: the initial position of the device."""

    stiffness_fraction: Annotated[Axis, AxisOf(Quantity(allowed=POSITIVE))] | None = None
    """Stiffness as a fraction of the maximum stable stiffness K_max, with the virtual damping at K_max; alternative to
    walls."""

    def find_faults(self) -> Iterable[LocatedProblem]:
        yield from super().find_faults()
        scene = self.device.to_scene()
        yield from self.find_inconsistencies(scene)
        if self.tool_position is not None and scene.tool is None:
            yield (
                ("tool_position",),
                problem("given without a tool", "only a scene with a tool", "remove it", on_key=True),
            )
        if self.stiffness_fraction is not None and isinstance(self.set_velocity(scene).velocity, FOAW):
            message = "got a fraction of the maximum stiffness"
            yield ("stiffness_fraction",), problem(message, f"{NO_LINEAR_FORM} and no such maximum", "write walls")

    @property
    def sizes(self) -> dict[str, int]:
        periods = int(min(self.duration.periods(self.device.period), 1e15))
        count = self.stiffness_fraction.size if self.stiffness_fraction is not None else len(self.walls or ())
        return {"motions": count, "periods": periods, "points a period": self.substeps}

    def list_walls(self, scene: Scene) -> list[tuple[str, float, float]]:
        """Return a tuple (label, stiffness, virtual damping) for each wall of the study, in SI units."""
        if self.stiffness_fraction is not None:
            top = scene.max_stiffness()
            stiffness, damping = float(top.stiffness), float(top.virtual_damping)
            if not np.isfinite(stiffness):
                raise InputError("stiffness_fraction: no wall of this device is stable; write walls")
            fractions = self.stiffness_fraction.values().tolist()
            return [(f"{fraction:g} of K_max", fraction * stiffness, damping) for fraction in fractions]
        walls: list[tuple[float, float]] = [
            (each.stiffness, each.virtual_damping)
            if isinstance(each, PhysicalWall)
            else (each.alpha * scene.units.stiffness, each.beta * scene.units.virtual_damping)
            for each in self.walls or ()
        ]
        return [(format_wall(*wall, scene.unit_system), *wall) for wall in walls]

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        simulated = self.set_velocity(self.device.to_scene())
        walls = self.list_walls(simulated)
        stiffness, damping = np.array([wall[1:] for wall in walls]).T
        options: dict[str, Any] = self.list_options(self.device.period) | {"substeps": self.substeps}
        if self.tool_position is not None:
            options["start_position"] = {"position": self.start_position, "tool_position": self.tool_position}
        motion = simulated.simulate(stiffness, damping, **options)
        linear = None if isinstance(simulated.velocity, FOAW) else simulated.is_stable(stiffness, damping)
        parts, rows, notes = [], [], []
        for k, (label, *wall) in enumerate(walls):
            named = {"label": label, **dict(zip(SI_COLUMNS, wall, strict=True))}
            parts.append({**named, **tabulate_motion(motion, k, self.substeps)})
            ending = describe_ending(motion, k)
            judged = {} if linear is None else {"linearly_stable": bool(linear[k])}
            properties = {header(name, unit): getattr(motion, name)[k] for name, (_, unit) in OF_WHOLE.items()}
            rows.append({**named, **judged, **properties, "outcome": ending})
            verdict = "" if linear is None else f" (linearly {'stable' if linear[k] else 'unstable'})"
            notes.append(f"{label}{verdict}: {ending}")
        table = stack(parts)
        drawn = {"": plotting.draw_motion, "_phase": plotting.draw_phase_plane, "_energy": plotting.draw_energy}
        return Outcome(
            table=table,
            figures={addition: partial(draw, table) for addition, draw in drawn.items()},
            documents={f"{self.name}_summary.csv": csv_text(stack(rows), simulated.unit_system)},
            notes=tuple(notes),
        )


def tabulate_motion(motion: Motion, k: int, substeps: int) -> dict[str, np.ndarray]:
    """Return columns with the time and all recorded variables of the motion with index ``k``.

    Variables with one value per sample are repeated ``substeps`` times, to the length of the other columns.
    """
    assert motion.time is not None, "it is recorded"
    columns = {"time_s": motion.time if motion.time.ndim == 1 else motion.time[k]}
    for name, (_, unit) in OF_MOTION.items():
        values = getattr(motion, name)
        if values is not None:
            column = np.repeat(values[k], substeps) if name in _OF_SAMPLES else values[k]
            columns[header(name, unit)] = column.astype(int) if column.dtype == bool else column
    return columns
