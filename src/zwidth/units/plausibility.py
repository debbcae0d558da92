"""Warnings for implausible values: far outside the range of real devices, probably because of a wrong unit.

A *kind of quantity* is a key of the table of plausible ranges, such as "mass". Implausible values are not rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from zwidth.units.formatting import short
from zwidth.units.quantities import FIELDS
from zwidth.units.unit_system import UnitSystem

# Smallest and largest plausible values by kind of quantity, in SI units. The smallest mass is only 1e-9, because the
# range also applies to inertias of rotary devices, in kg m^2.
_PLAUSIBLE = {
    "mass": (1e-9, 20.0),
    "damping": (0.0, 1e4),
    "stiffness": (0.0, 1e7),
    "spring": (0.0, 1e9),
    "period": (1e-6, 0.2),
    "rate": (5.0, 1e6),
    "delay": (0.0, 0.5),
    "cutoff": (0.05, 1e6),
    "time_constant": (1e-7, 5.0),
    "resolution": (1e-10, 0.01),
}
_STEP_ANGLE = (1e-9, 1.1)  # plausible resolutions of rotary encoders in rad: from 32 bits to 6 steps per revolution
# Kind of quantity by SI unit, for parameters whose name is not a kind.
_OF_UNIT = {"N s/m": "damping", "N/m": "spring", "s": "period", "kg": "mass"}
# Likely mistakes by kind of quantity. Each mistake has four entries: the intended parameter ("" if the name is right),
# the intended unit, the conversion factor of this unit to SI, and a suggestion ("" to suggest parameter and unit).
_SLIPS = {
    "mass": (("", "g", 1e-3, ""),),
    "damping": (("", "mN s/m", 1e-3, ""),),
    "stiffness": (("", "", 1e-3, "a thousandth of it (kN/m or N/mm converted twice)"),),
    "period": (("", "ms", 1e-3, ""), ("rate", "Hz", 1.0, "")),
    "rate": (("", "kHz", 1e3, ""), ("period", "s", 1.0, "")),
    "delay": (("", "ms", 1e-3, ""), ("", "us", 1e-6, "")),
    "time_constant": (("", "ms", 1e-3, ""),),
    "cutoff": (("", "kHz", 1e3, ""),),
}


def list_implausible(given: Mapping[str, Any], spell: Callable[[str, str], str], system: UnitSystem) -> list[str]:
    """Return a list with one warning per implausible value: a sentence with the value and a suggested correction.

    Args:
        given: values in SI units, by dotted path of the parameter.
        spell: function that formats a path and a value as the user would write them, or only the path if the value
            is "".
        system: units of the device.
    """
    lines = []
    for path, value in given.items():
        unit, name = FIELDS[path].unit if path in FIELDS else "", path.rpartition(".")[2]
        kind = name if name in _PLAUSIBLE and path != "coupling.stiffness" else _OF_UNIT.get(unit, "")
        if isinstance(value, int | float) and kind in _PLAUSIBLE and not _is_plausible(kind, value, system):
            number = short(value)
            suggestions = [
                text or spell(other or path, f"{number} {smaller}")
                for other, smaller, scale, text in _SLIPS.get(kind, ())
                if _is_plausible(other or kind, value * scale, system) and system[unit] == unit
            ]
            if kind == "delay" and suggestions:
                suggestions[0] += f" or {spell(path, f'{number} periods')}"
            remedy = f"did you mean {suggestions[0]}?" if suggestions else "check its unit"
            if kind == "resolution" and value > 1:
                per = "rev" if system.rotary else "mm"
                remedy = f"write counts as {spell(path, f'{number} counts/{per}')}"
            lines.append(f"{spell(path, '')} is {number} {system[unit]}, an implausible value; {remedy}")
    return lines


def _is_plausible(kind: str, value: float, system: UnitSystem) -> bool:
    """Return whether a value in SI units is 0 or in the plausible range of its kind of quantity."""
    low, high = _STEP_ANGLE if kind == "resolution" and system.rotary else _PLAUSIBLE[kind]
    return value == 0 or low <= abs(value) <= high
