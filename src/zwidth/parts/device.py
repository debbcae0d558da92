"""The haptic device: a mass with viscous damping, rigid or with a compliance behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zwidth.errors import InputError
from zwidth.parts.checks import check_number
from zwidth.parts.coupling import Coupling


@dataclass(frozen=True)
class Device:
    """The haptic device: a mass with viscous damping.

    Args:
        mass: m in kg, > 0; with a coupling, of the motor's side.
        damping: b in N s/m, >= 0.
        coupling: the mass beyond a spring and damper, None for a rigid device.
    """

    mass: Any
    damping: Any = 0.0
    coupling: Coupling | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "mass", check_number("mass", self.mass))
        object.__setattr__(self, "damping", check_number("damping", self.damping))
        if self.coupling is not None and not isinstance(self.coupling, Coupling):
            raise InputError(f"coupling: got {self.coupling!r}; a zwidth.Coupling is needed, or None")
