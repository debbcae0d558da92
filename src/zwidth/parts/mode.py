"""A resonance of the device's structure, seen by its sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zwidth.parts.actuator import angular
from zwidth.parts.checks import Part
from zwidth.words.errors import InputError


@dataclass(frozen=True, repr=False)
class Mode(Part):
    """What one resonance adds to the position that the sensor sees: ``(1/mass)/(s^2 + 2 zeta w s + w^2)`` of the force.

    A command excites it behind the actuator; a hand and friction act on the device's body without it.

    Args:
        frequency: w/(2 pi) in Hz, > 0, of the undamped resonance.
        damping_ratio: zeta, > 0 and at most 10.
        mass: modal mass in kg, as driving force and sensor meet it; negative where the sensor lies beyond a node.

    References:
        Ewins 2000, Modal Testing, section 2.4 (receptance as a sum of modes).

    Example:
        >>> import zwidth
        >>> device = zwidth.Device(0.1, 10, modes=[zwidth.Mode(frequency=120, damping_ratio=0.02, mass=-0.5)])
        >>> print(f"{zwidth.Scene(device, zwidth.Timing(period=1e-3)).max_stiffness().stiffness:.0f} N/m")
        25419 N/m
    """

    _owner = "mode"

    frequency: Any
    damping_ratio: Any
    mass: Any

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.mass, float) and self.mass == 0.0:
            raise InputError("mode.mass: got 0.0; a mass is needed, negative where the sensor lies beyond a node")

    @property
    def rate(self) -> Any:
        """w in rad/s."""
        return angular(self.frequency)
