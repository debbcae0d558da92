"""The haptic device: a mass with viscous damping, rigid or with a compliance behind it, and what drives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from zwidth.parts.actuator import Actuator
from zwidth.parts.checks import check_fields
from zwidth.parts.mode import Mode
from zwidth.words.errors import InputError


@dataclass(frozen=True)
class Coupling:
    """The mass beyond a spring and a damper: a tendon's, a belt's, a gear's or a link's elasticity.

    ``m x1'' = F - b x1' + k (x2 - x1) + c (x2' - x1')``, ``m2 x2'' = -k (x2 - x1) - c (x2' - x1')`` with the wall's
    force F on the motor side.

    Args:
        mass: m2, the mass on the tip's side, in kg, > 0.
        stiffness: k of the spring between, in N/m, > 0.
        damping: c of the damper between, in N s/m, >= 0.
        sensor: where the position is measured, "motor" or "tip".

    Example:
        >>> import zwidth
        >>> zwidth.Coupling(mass=0.05, stiffness=20e3, damping=1.0).sensor
        'motor'
    """

    # Forms that the explorer offers.
    usual: ClassVar[dict[str, dict[str, Any]]] = {
        "motor": {"mass": 0.05, "stiffness": 20e3, "damping": 2.0},
        "tip": {"mass": 0.05, "stiffness": 20e3, "damping": 2.0, "sensor": "tip"},
    }

    mass: Any
    stiffness: Any
    damping: Any = 0.0
    sensor: Literal["motor", "tip"] = "motor"

    def __post_init__(self) -> None:
        check_fields(self, "coupling")


@dataclass(frozen=True)
class Device:
    """The haptic device: a mass with viscous damping.

    Args:
        mass: m in kg, > 0; with a coupling, of the motor's side.
        damping: b in N s/m, >= 0.
        coupling: the mass beyond a spring and damper, None for a rigid device.
        actuator: the lag of amplifier and motor, None where a command acts at once.
        modes: resonances that a command excites and the sensor sees, in any number.
    """

    mass: Any
    damping: Any = 0.0
    coupling: Coupling | None = None
    actuator: Actuator | None = None
    # A list is as good.
    modes: Any = ()

    def __post_init__(self) -> None:
        check_fields(self)
        for name, kind in {"coupling": Coupling, "actuator": Actuator}.items():
            part = getattr(self, name)
            if part is not None and not isinstance(part, kind):
                raise InputError(f"{name}: got {part!r}; a zwidth.{kind.__name__} is needed, or None")
        modes = (self.modes,) if isinstance(self.modes, Mode) else self.modes
        if not isinstance(modes, list | tuple) or not all(isinstance(mode, Mode) for mode in modes):
            raise InputError(f"modes: got {self.modes!r}; a list of zwidth.Mode is needed")
        object.__setattr__(self, "modes", tuple(modes))
