"""The simulate study: motions of a device on virtual walls over time, under the circumstances of `zwidth.simulate`."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from zwidth import figures
from zwidth.config.fields import LocatedProblem, Strict, problem
from zwidth.config.parts import NO_LINEAR_FORM, SimulatedVelocityField, locate_refusal
from zwidth.config.scenes import AnyScene, PhysicalWall, SimulatedDevice
from zwidth.config.study import register
from zwidth.config.values import Axis, AxisOf, Delay, Duration, Quantity, quantity_of
from zwidth.figures.table import SI_COLUMNS, stack
from zwidth.parts.checks import Span
from zwidth.parts.measured import MeasuredDevice
from zwidth.parts.velocity import FOAW
from zwidth.scenes.scene import Scene
from zwidth.simulation.ending import describe_ending
from zwidth.simulation.result import OF_MOTION, OF_WHOLE, Motion
from zwidth.simulation.simulate import Contact
from zwidth.studies.outcome import ComputedStudy, Outcome, WallsStudy, csv_text
from zwidth.words.errors import InputError
from zwidth.words.formatting import header, name_wall
from zwidth.words.quantities import HARDWARE, NOT_NEGATIVE, POSITIVE, Range

LONGEST = 1_000_000
"""Periods that one motion may take."""

# What the program makes of a sample stays until the next one.
_OF_SAMPLES = ("measured", "estimated_velocity", "command", "contact")


class Circumstances(Strict):
    """How a device meets a wall: start, push, contact, and what motor, encoder, bearings and clock add."""

    duration: Duration = Span(1000.0, "periods")
    """Length of the motion, in s or in periods."""

    velocity: SimulatedVelocityField | None = None
    """Velocity estimate. Default: that of the device."""

    start_position: Annotated[float, quantity_of("start_position")] = 0.0
    start_velocity: Annotated[float, quantity_of("start_velocity")] = 0.0
    push: Annotated[float, quantity_of("push")] = 0.0

    contact: Contact = "bilateral"
    """Where the wall acts: on both sides of its surface, where positions are positive, or there and never pulling."""

    resolution: Annotated[float, quantity_of("resolution")] = 0.0
    noise: Annotated[float, quantity_of("noise")] = 0.0
    coulomb: Annotated[float, quantity_of("coulomb")] = 0.0
    static: Annotated[float, quantity_of("static")] | None = None
    max_force: Annotated[float, quantity_of("max_force")] | None = None
    max_rate: Annotated[float, quantity_of("max_rate")] | None = None

    jitter: Delay = Span(0.0, "s")
    """Samples are late by random times up to this, in s or in periods, below one period."""

    seed: Annotated[int, Quantity(allowed=NOT_NEGATIVE, whole=True)] = 0
    """Whole number that decides the random numbers."""

    def find_clashes(self, scene: Scene) -> Iterable[LocatedProblem]:
        """Values that do not go together, or not with the device and its sampling period."""
        period = scene.timing.period
        if self.static is not None and self.static < self.coulomb:
            what = f"got {self.static:g} N, below coulomb, {self.coulomb:g} N"
            yield ("static",), problem(what, "what holds is at least the friction while slipping", "raise it")
        if not self.jitter.seconds(period) < period:
            what = f"got {self.jitter}"
            yield ("jitter",), problem(what, "a sample is late by less than one period", "write '0.2 periods'")
        if not 1 <= round(self.duration.periods(period)) <= LONGEST:
            what = f"got {self.duration}, which is {self.duration.periods(period):.4g} periods"
            yield ("duration",), problem(what, f"1 to {LONGEST} periods", "change the duration")
        if isinstance(scene.device, MeasuredDevice):
            allowed = "a motion needs a model: mass and damping, or a linear system"
            yield ("device",), problem("got a measured response", allowed, "fit one to a log with the kind 'fit'")
        if self.velocity is not None and not isinstance(placed := self.place(scene).velocity, FOAW):
            try:
                placed.estimate(period)
            except InputError as error:
                yield locate_refusal(error)

    def place(self, scene: Scene) -> Scene:
        """The scene with the velocity estimate of these circumstances."""
        return scene if self.velocity is None else scene.replace(velocity=self.velocity.known)

    def options(self, period: float) -> dict[str, Any]:
        names = [name for name in Circumstances.model_fields if name not in ("duration", "velocity", "jitter")]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        periods = max(1, round(self.duration.periods(period)))
        return {**given, "periods": periods, "jitter": self.jitter.seconds(period)}


class SimulatedStudy(ComputedStudy):
    """Base of the studies that simulate."""

    from_scene = ("device", *HARDWARE)
    takes_parts = True
    simulates = True

    device: SimulatedDevice
    """Device in SI units."""


@register
class SimulateStudy(WallsStudy, SimulatedStudy, Circumstances):
    """Motions of a device on one or several walls over time."""

    method = "Matrix exponentials between events, instants of friction to the last bit; rounding alone."
    remedy_if_too_large = "shorten the duration, lower substeps, or use fewer walls"
    point_bytes = 8 * len(OF_MOTION)

    kind: Literal["simulate"]

    substeps: Annotated[int, Quantity(allowed=Range(1, 10_000), whole=True)] = 1
    """Points recorded per period."""

    stiffness_fraction: Annotated[Axis, AxisOf(Quantity(allowed=POSITIVE))] | None = None
    """Stiffness as a share of the maximum, with the virtual damping of that wall; give this or walls."""

    def limits(self) -> Iterable[LocatedProblem]:
        yield from super().limits()
        scene = self.device.to_scene()
        yield from self.find_clashes(scene)
        if self.stiffness_fraction is not None and isinstance(self.place(scene).velocity, FOAW):
            what = "got a share of the maximum stiffness"
            yield ("stiffness_fraction",), problem(what, f"{NO_LINEAR_FORM} and no such maximum", "write walls")

    @property
    def sizes(self) -> dict[str, int]:
        periods = int(min(self.duration.periods(self.device.period), 1e15))
        count = self.stiffness_fraction.size if self.stiffness_fraction is not None else len(self.walls or ())
        return {"motions": count, "periods": periods, "points a period": self.substeps}

    def list_walls(self, scene: Scene) -> list[tuple[str, float, float]]:
        if self.stiffness_fraction is not None:
            top = scene.max_stiffness()
            stiffness, damping = float(top.stiffness), float(top.virtual_damping)
            if not np.isfinite(stiffness):
                raise InputError("stiffness_fraction: no wall of this device is stable; write walls")
            shares = self.stiffness_fraction.values().tolist()
            return [(f"{share:g} of K_max", share * stiffness, damping) for share in shares]
        walls: list[tuple[float, float]] = [
            (each.stiffness, each.virtual_damping)
            if isinstance(each, PhysicalWall)
            else (each.alpha * scene.units.stiffness, each.beta * scene.units.virtual_damping)
            for each in self.walls or ()
        ]
        return [(name_wall(*wall, scene.unit_system), *wall) for wall in walls]

    def compute(self, scene: AnyScene | None, alone: bool) -> Outcome:
        placed = self.place(self.device.to_scene())
        walls = self.list_walls(placed)
        stiffness, damping = np.array([wall[1:] for wall in walls]).T
        motion = placed.simulate(stiffness, damping, substeps=self.substeps, **self.options(self.device.period))
        linear = None if isinstance(placed.velocity, FOAW) else placed.is_stable(stiffness, damping)
        parts, rows, notes = [], [], []
        for k, (label, *wall) in enumerate(walls):
            named = {"label": label, **dict(zip(SI_COLUMNS, wall, strict=True))}
            parts.append({**named, **tabulate_motion(motion, k, self.substeps)})
            words = describe_ending(motion, k)
            judged = {} if linear is None else {"linearly_stable": bool(linear[k])}
            whole = {header(name, unit): getattr(motion, name)[k] for name, (_, unit) in OF_WHOLE.items()}
            rows.append({**named, **judged, **whole, "outcome": words})
            verdict = "" if linear is None else f" (linearly {'stable' if linear[k] else 'unstable'})"
            notes.append(f"{label}{verdict}: {words}")
        table = stack(parts)
        drawn = {"": figures.draw_motion, "_phase": figures.draw_phase_plane, "_energy": figures.draw_energy}
        return Outcome(
            table=table,
            figures={addition: partial(draw, table) for addition, draw in drawn.items()},
            documents={f"{self.name}_summary.csv": csv_text(stack(rows), placed.unit_system)},
            notes=tuple(notes),
        )


def tabulate_motion(motion: Motion, k: int, substeps: int) -> dict[str, np.ndarray]:
    """One motion of several over time, as columns."""
    assert motion.time is not None, "it is recorded"
    columns = {"time_s": motion.time if motion.time.ndim == 1 else motion.time[k]}
    for name, (_, unit) in OF_MOTION.items():
        values = getattr(motion, name)
        if values is not None:
            own = np.repeat(values[k], substeps) if name in _OF_SAMPLES else values[k]
            columns[header(name, unit)] = own.astype(int) if own.dtype == bool else own
    return columns
