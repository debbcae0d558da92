"""What a simulation has beside device and wall, as a configuration has it: the words are those of `zwidth.simulate`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

from zwidth.config.faults import LocatedProblem, problem
from zwidth.config.fields import Strict
from zwidth.config.parts import SimulatedVelocityField
from zwidth.config.values import Delay, Duration, Quantity
from zwidth.parts.checks import Span
from zwidth.scenes.scene import Scene
from zwidth.simulation.simulate import Contact
from zwidth.words.quantities import NOT_NEGATIVE, POSITIVE

Length = Annotated[float, Quantity("m", NOT_NEGATIVE)]
Friction = Annotated[float, Quantity("N", NOT_NEGATIVE)]
Seed = Annotated[int, Quantity(allowed=NOT_NEGATIVE, whole=True)]

LONGEST = 1_000_000
"""Periods that one motion may take."""


class Circumstances(Strict):
    """How a device meets a wall: start, push, contact, and what motor, encoder, bearings and clock add."""

    duration: Duration = Span(1000.0, "periods")
    """Length of the motion, in s or in periods."""

    velocity: SimulatedVelocityField | None = None
    """How the velocity is estimated; as the device has it where left out."""

    start_position: Annotated[float, Quantity("m")] = 0.0
    """Where the motion starts, in m or with a unit; the wall's surface is at 0 and positive is into the wall."""

    start_velocity: Annotated[float, Quantity("m/s")] = 0.0
    """Its velocity there, in m/s or with a unit."""

    push: Annotated[float, Quantity("N")] = 0.0
    """Constant force of the hand on the device, in N or with a unit."""

    contact: Contact = "bilateral"
    """Where the wall acts: on both sides of its surface, where positions are positive, or there and never pulling."""

    resolution: Length = 0.0
    """One count of the encoder, in m or with a unit."""

    noise: Length = 0.0
    """Standard deviation of the measured position, in m or with a unit."""

    coulomb: Friction = 0.0
    """Dry friction while the device slips, in N or with a unit."""

    static: Friction | None = None
    """Dry friction that holds the device, at least coulomb, which it is where left out."""

    max_force: Annotated[float, Quantity("N", POSITIVE)] | None = None
    """The most that the motor gives, in N or with a unit; no limit where left out."""

    max_rate: Annotated[float, Quantity("N/s", POSITIVE)] | None = None
    """The fastest that the command changes, in N/s or with a unit; no limit where left out."""

    jitter: Delay = Span(0.0, "s")
    """Samples are late by random times up to this, in s or in periods, below one period."""

    seed: Seed = 0
    """Whole number that decides the random numbers."""

    def find_clashes(self, period: float) -> Iterable[LocatedProblem]:
        """Values that do not go together, or not with this sampling period."""
        if self.static is not None and self.static < self.coulomb:
            what = f"got {self.static:g} N, below coulomb, {self.coulomb:g} N"
            yield ("static",), problem(what, "what holds is at least the friction while slipping", "raise it")
        if not self.jitter.seconds(period) < period:
            what = f"got {self.jitter}"
            yield ("jitter",), problem(what, "a sample is late by less than one period", "write '0.2 periods'")
        if not 1 <= round(self.duration.periods(period)) <= LONGEST:
            what = f"got {self.duration}, which is {self.duration.periods(period):.4g} periods"
            yield ("duration",), problem(what, f"1 to {LONGEST} periods", "change the duration")

    def count_periods(self, period: float) -> int:
        """The length of the motion."""
        return max(1, round(self.duration.periods(period)))

    def place(self, scene: Scene) -> Scene:
        """The scene with the velocity estimate of these circumstances."""
        return scene if self.velocity is None else scene.replace(velocity=self.velocity.to_part())

    def options(self, period: float) -> dict[str, Any]:
        """The arguments of `zwidth.simulate`."""
        names = [name for name in Circumstances.model_fields if name not in ("duration", "velocity", "jitter")]
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return {**given, "periods": self.count_periods(period), "jitter": self.jitter.seconds(period)}
