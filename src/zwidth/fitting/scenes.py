"""The scene of a fitted device, and its numbers in the order of their covariance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from zwidth.parts.actuator import Actuator
from zwidth.parts.device import Device
from zwidth.parts.mode import Mode
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import Velocity
from zwidth.scenes.scene import Scene


def scene_of(values: Iterable[float], period: float, velocity: Velocity, lag: int = 0, modes: int = 0) -> Scene:
    """A device with its timing, of numbers that go as `name_numbers` names them; ``lag`` is an amplifier's order.

    One number more is the velocity's cut-off.
    """
    mass, damping, delay, *beside = map(float, values)
    first = len(beside) - lag - 3 * modes
    if first:
        velocity = with_cutoff(velocity, beside[0])
    constant, *ratio = beside[first : first + lag] or [None]
    actuator = Actuator(None, constant, lag, *ratio) if lag else None
    ringing = [Mode(*beside[k : k + 3]) for k in range(first + lag, len(beside), 3)]
    device = Device(mass, damping, actuator=actuator, modes=ringing)
    return Scene(device, Timing(period=period, delay=delay), velocity=velocity)


def name_numbers(scene: Scene, cutoff: bool = False) -> tuple[str, ...]:
    """Paths of what is fitted: mass, damping, delay, an unknown cut-off, and what stands beside the rigid mass."""
    actuator, modes = scene.device.actuator, range(len(scene.device.modes))
    lag = () if actuator is None else ("time_constant", *(["damping_ratio"] if actuator.order == 2 else []))
    of_mode = ("frequency", "damping_ratio", "mass")
    beside = [f"actuator.{name}" for name in lag] + [f"modes.{k}.{name}" for k in modes for name in of_mode]
    return ("mass", "damping", "delay", *(["velocity.cutoff"] if cutoff else []), *beside)


def with_cutoff(velocity: Any, cutoff: float) -> Any:
    """A low-pass with another cut-off in Hz."""
    return replace(velocity, cutoff=cutoff, **({"time_constant": None} if hasattr(velocity, "time_constant") else {}))
