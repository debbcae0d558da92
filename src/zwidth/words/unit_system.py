"""SI units of linear and of rotary devices.

The equations of linear and of rotary devices are the same, only their units differ. The source code identifies a
quantity by its unit on a linear device. A `UnitSystem` converts this unit to the unit on its kind of device:
``ROTARY["N/m"]`` is ``"N m/rad"``.
"""

from __future__ import annotations

from enum import Enum

# Units on rotary devices by unit on linear devices.
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
"""Pairs of units of one quantity: on linear devices and on rotary devices."""


class UnitSystem(Enum):
    """The SI units of one kind of device, linear or rotary."""

    LINEAR = "linear"
    ROTARY = "rotary"

    @property
    def rotary(self) -> bool:
        """True for the units of rotary devices."""
        return self is ROTARY

    def __getitem__(self, unit: str) -> str:
        """Return the unit on this kind of device for a unit on linear devices; quotients "N/m per kg" are allowed."""
        if self is LINEAR:
            return unit
        return " per ".join(_ROTARY_UNITS.get(part, part) for part in unit.split(" per "))


SYSTEMS = LINEAR, ROTARY = tuple(UnitSystem)
"""Both unit systems, indexed by a Boolean: True for rotary."""
