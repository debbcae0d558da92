"""The scene of a fitted device, and its numbers in the order of their covariance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from zwidth.parts.device import Device
from zwidth.parts.timing import Timing
from zwidth.parts.velocity import Velocity
from zwidth.scenes.scene import Scene


def scene_of(values: Iterable[float], period: float, velocity: Velocity) -> Scene:
    """A device of this mass, damping and delay with its timing; a fourth value is the velocity's cut-off."""
    mass, damping, delay, *cutoff = map(float, values)
    if cutoff:
        velocity = with_cutoff(velocity, cutoff[0])
    return Scene(Device(mass, damping), Timing(period=period, delay=delay), velocity=velocity)


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
