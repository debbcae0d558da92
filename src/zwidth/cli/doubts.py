"""Values that no device has: one line of doubt each, with the slip of unit that makes such a value."""

from __future__ import annotations

from typing import Any

from zwidth.parts.span import Span
from zwidth.words.formatting import short

# What devices have, by what kind of quantity it is: the SI unit, from and up to. An inertia of a rotary device, in
# kg m^2, is far below any mass.
_PLAUSIBLE = {
    "mass": ("kg", 1e-9, 20.0),
    "damping": ("N s/m", 0.0, 1e4),
    "stiffness": ("N/m", 0.0, 1e7),
    "spring": ("N/m", 0.0, 1e9),
    "period": ("s", 1e-6, 0.2),
    "rate": ("Hz", 5.0, 1e6),
    "delay": ("s", 0.0, 5.0),
    "cutoff": ("Hz", 0.05, 1e6),
    "time_constant": ("s", 1e-7, 5.0),
}
_KIND = {"virtual_damping": "damping", "coupling_damping": "damping", "coupling_stiffness": "spring"}
_KIND |= {"coupling.stiffness": "spring", "coded_period": "period"}
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
        kind = _KIND.get(path) or _KIND.get(path.rpartition(".")[2], path.rpartition(".")[2])
        number = value.value if isinstance(value, Span) and value.unit == "s" else value
        if isinstance(number, int | float) and kind in _PLAUSIBLE and not _is_plausible(kind, number):
            flag = "--" + path.replace(".", "-").replace("_", "-")
            meant = [
                text.format(flag=flag, value=short(number))
                for text, other, scale in _SLIPS.get(kind, ())
                if _is_plausible(other, number * scale)
            ]
            remedy = f"did you mean {meant[0]}?" if meant else "check its unit"
            lines.append(f"{flag} is {short(number)} {_PLAUSIBLE[kind][0]}, far from any device; {remedy}")
    return lines


def _is_plausible(kind: str, value: float) -> bool:
    _, low, high = _PLAUSIBLE[kind]
    return value == 0 or low <= abs(value) <= high
