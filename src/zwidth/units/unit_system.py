"""SI units of linear and of rotary devices.

The equations of linear and of rotary devices are the same, only their units differ. The source code identifies a
quantity by its unit on a linear device. A `UnitSystem` converts this unit to the unit on a linear or rotary device:
``ROTARY["N/m"]`` is ``"N m/rad"``.
"""

from __future__ import annotations

from enum import Enum

# Unit of a quantity on rotary devices, by its unit on linear devices.
_ROTARY_UNITS = {
    "kg": "kg m^2",
    "N s/m": "N m s/rad",
    "N/m": "N m/rad",
    "N": "N m",
    "m": "rad",
    "m/s": "rad/s",
    "m/N": "rad/(N m)",
    "N/s": "N m/s",
    "N/(m s)": "N m/(rad s)",
}
UNIT_PAIRS = tuple(_ROTARY_UNITS.items())
"""Pairs of the units of one quantity: the unit on linear devices and the unit on rotary devices."""


class UnitSystem(Enum):
    """The SI units of one kind of device, linear or rotary."""

    LINEAR = "linear"
    ROTARY = "rotary"

    @property
    def rotary(self) -> bool:
        """True for the units of rotary devices."""
        return self is ROTARY

    def __getitem__(self, unit: str) -> str:
        """Convert a unit of linear devices to the unit on this kind of device, also in quotients like "N/m per kg"."""
        if self is LINEAR:
            return unit
        return " per ".join(_ROTARY_UNITS.get(part, part) for part in unit.split(" per "))


SYSTEMS = LINEAR, ROTARY = tuple(UnitSystem)
"""Both unit systems, indexed by a Boolean: True for rotary."""
