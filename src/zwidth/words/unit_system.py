"""SI units of linear and of rotary devices.

The equations of both kinds of device are the same; only the units differ. Code names a quantity by its unit on a linear
device, and a `UnitSystem` returns the unit on the device at hand: ``ROTARY["N/m"]`` is ``"N m/rad"``.
"""

from __future__ import annotations

from enum import Enum

_ROTARY_UNITS = {
    "kg": "kg m^2",
    "N s/m": "N m s/rad",
    "N/m": "N m/rad",
    "N": "N m",
    "m": "rad",
    "m/s": "rad/s",
    "m/N": "rad/(N m)",
    "N/s": "N m/s",
}
UNIT_PAIRS = tuple(_ROTARY_UNITS.items())
"""Pairs of units of the same quantity: of a linear and of a rotary device."""


class UnitSystem(Enum):
    """SI units of a kind of device, "linear" or "rotary"."""

    LINEAR = "linear"
    ROTARY = "rotary"

    @property
    def rotary(self) -> bool:
        """True for the units of rotary devices."""
        return self is ROTARY

    def __getitem__(self, unit: str) -> str:
        """Return the unit of this system for a unit of linear devices, also for a quotient such as ``N/m per kg``."""
        if self is LINEAR:
            return unit
        return " per ".join(_ROTARY_UNITS.get(part, part) for part in unit.split(" per "))


SYSTEMS = LINEAR, ROTARY = tuple(UnitSystem)
"""Both systems, indexed by "is rotary"."""
