"""Structural mode of a device: a resonance that contributes to the measured position.

The measured position is the position of the sensor's body plus the displacements of all modes. The displacement q of a
mode satisfies

    q'' + 2 zeta w q' + w^2 q = F/mass

with the actuator force F, the natural frequency w, the damping ratio zeta and the modal mass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zwidth.core.errors import InputError
from zwidth.model.actuator import to_angular
from zwidth.model.checks import Part


@dataclass(frozen=True, repr=False)
class Mode(Part):
    """A structural mode: adds ``(1/mass)/(s^2 + 2 zeta w s + w^2)`` to the response from force to measured position.

    The actuator force excites the mode. The forces of the operator and of friction act on the body of the device and do
    not excite it.

    Args:
        frequency: natural frequency w/(2 pi) of the undamped mode in Hz, > 0.
        damping_ratio: zeta, > 0 and at most 10.
        mass: modal mass in kg, divided by the product of the mode shape at actuator and sensor; negative if actuator
            and sensor move in opposite directions.

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
            raise InputError(
                "mode.mass: got 0.0; it must not be 0; use < 0 if actuator and sensor move in opposite directions"
            )

    @property
    def rate(self) -> Any:
        """The natural frequency w in rad/s."""
        return to_angular(self.frequency)
