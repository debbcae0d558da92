"""Values that no device has: one line of doubt each, with the slip of unit that makes such a value."""

from __future__ import annotations

from typing import Any

from zwidth.parts.checks import Span
from zwidth.words.formatting import short
from zwidth.words.quantities import FIELDS

# What devices have, by what kind of quantity it is, from and up to in its SI unit. An inertia of a rotary device, in
# kg m^2, is far below any mass.
_PLAUSIBLE = {
    "mass": (1e-9, 20.0),
    "damping": (0.0, 1e4),
    "stiffness": (0.0, 1e7),
    "spring": (0.0, 1e9),
    "period": (1e-6, 0.2),
    "rate": (5.0, 1e6),
    "delay": (0.0, 5.0),
    "cutoff": (0.05, 1e6),
    "time_constant": (1e-7, 5.0),
}
# Kinds of quantities with another name.
_OF_UNIT = {"N s/m": "damping", "N/m": "spring", "s": "period", "kg": "mass"}
# The slips: the same number with another unit, or as another quantity.
_SLIPS = {
    "mass": (("{flag} '{value} g'", "mass", 1e-3),),
    "damping": (("{flag} '{value} mN s/m'", "damping", 1e-3),),
    "stiffness": (("a thousandth of it, with kN/m or N/mm counted once", "stiffness", 1e-3),),
    "period": (("{flag} '{value} ms'", "period", 1e-3), ("--rate '{value} Hz'", "rate", 1.0)),
    "rate": (("{flag} '{value} kHz'", "rate", 1e3), ("--period '{value} s'", "period", 1.0)),
    "delay": (("{flag} '{value} ms'", "delay", 1e-3), ("{flag} '{value} us'", "delay", 1e-6)),
    "time_constant": (("{flag} '{value} ms'", "time_constant", 1e-3),),
    "cutoff": (("{flag} '{value} kHz'", "cutoff", 1e3),),
}


def doubts_of(given: dict[str, Any]) -> list[str]:
    """A line for every value, by path, that lies far from what any device has; it is taken all the same."""
    lines = []
    for path, value in given.items():
        unit, name = FIELDS[path].unit if path in FIELDS else "", path.rpartition(".")[2]
        kind = name if name in _PLAUSIBLE and path != "coupling.stiffness" else _OF_UNIT.get(unit, "")
        number = value.value if isinstance(value, Span) and value.unit == "s" else value
        if isinstance(number, int | float) and kind in _PLAUSIBLE and not _is_plausible(kind, number):
            flag = "--" + path.replace(".", "-").replace("_", "-")
            meant = [
                text.format(flag=flag, value=short(number))
                for text, other, scale in _SLIPS.get(kind, ())
                if _is_plausible(other, number * scale)
            ]
            remedy = f"did you mean {meant[0]}?" if meant else "check its unit"
            lines.append(f"{flag} is {short(number)} {unit}, far from any device; {remedy}")
    return lines


def _is_plausible(kind: str, value: float) -> bool:
    low, high = _PLAUSIBLE[kind]
    return value == 0 or low <= abs(value) <= high
