"""The haptic device: a mass with viscous damping, and optionally a coupling, an actuator and modes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from zwidth.parts.actuator import Actuator
from zwidth.parts.checks import Part, check_kind, find_kind
from zwidth.parts.mode import Mode
from zwidth.words.errors import InputError
from zwidth.words.formatting import with_unit


@dataclass(frozen=True, repr=False)
class Coupling(Part):
    """A second mass, coupled by a spring and a damper: the elasticity of a tendon, belt, gear or link.

    ``m x1'' = F - b x1' + k (x2 - x1) + c (x2' - x1')``, ``m2 x2'' = -k (x2 - x1) - c (x2' - x1')``; the wall's
    force F acts on the motor side.

    Args:
        mass: m2, the mass on the tip side, in kg, > 0.
        stiffness: k of the spring, in N/m, > 0.
        damping: c of the damper, in N s/m, >= 0.
        sensor: side on which the position is measured, "motor" or "tip".

    Example:
        >>> import zwidth
        >>> zwidth.Coupling(mass=0.05, stiffness=20e3, damping=1.0).sensor
        'motor'
    """

    _owner = "coupling"
    # Forms that the explorer offers.
    usual: ClassVar[dict[str, dict[str, Any]]] = {
        "motor": {"mass": 0.05, "stiffness": 20e3, "damping": 2.0},
        "tip": {"mass": 0.05, "stiffness": 20e3, "damping": 2.0, "sensor": "tip"},
    }

    mass: Any
    stiffness: Any
    damping: Any = 0.0
    sensor: Literal["motor", "tip"] = "motor"


@dataclass(frozen=True, repr=False)
class Device(Part):
    """The haptic device: a mass with viscous damping, or an inertia if the device is rotary.

    The equations of a rotary device are the same in other units: kg m^2 instead of kg, N m s/rad instead of N s/m,
    N m/rad instead of N/m, rad instead of m, and N m instead of N. All parts, walls and results of its scene have these
    units.

    Args:
        mass: m in kg, > 0; with a coupling, that of the motor side. For a rotary device, the inertia J in kg m^2.
        damping: b in N s/m, >= 0; in N m s/rad for a rotary device.
        coupling: a second mass, coupled by a spring and a damper; None for a rigid device.
        actuator: dynamics of amplifier and motor; None if commands act immediately.
        modes: resonances that commands excite and the sensor measures, in any number.
        rotary: True for a rotary device. If left out, the units of the other arguments decide; plain numbers are those
            of a linear device.

    Example:
        >>> import zwidth
        >>> zwidth.Device("12 g cm^2", "0.02 mN m s/rad")
        Device(mass=1.2e-06, damping=2e-05, rotary=True)
    """

    mass: Any
    damping: Any = 0.0
    coupling: Coupling | None = None
    actuator: Actuator | None = None
    # A list is also accepted.
    modes: Any = ()
    rotary: bool | None = None

    def __post_init__(self) -> None:
        modes = (self.modes,) if isinstance(self.modes, Mode) else self.modes
        if not isinstance(modes, list | tuple) or not all(isinstance(mode, Mode) for mode in modes):
            raise InputError(f"modes: got {self.modes!r}; a list of zwidth.Mode is needed")
        if self.rotary is not None and not isinstance(self.rotary, bool):
            raise InputError(f"rotary: got {self.rotary!r}; True or False is needed")
        own = {name: getattr(self, name) for name in ("mass", "damping", "coupling")}
        own |= {f"modes.{k}": mode for k, mode in enumerate(modes)}
        told = find_kind(own)
        rotary = told or False if self.rotary is None else self.rotary
        object.__setattr__(self, "modes", tuple(modes))
        for name, kind in {"coupling": Coupling, "actuator": Actuator}.items():
            part = getattr(self, name)
            if part is not None and not isinstance(part, kind):
                raise InputError(f"{name}: got {part!r}; a zwidth.{kind.__name__} is needed, or None")
        check_kind(rotary, own)
        object.__setattr__(self, "rotary", rotary)
        super().__post_init__()

    def spell(self) -> str:
        """Return mass and damping with symbols and units."""
        mass, damping = with_unit(self.mass, self.unit_system["kg"]), with_unit(self.damping, self.unit_system["N s/m"])
        return f"{'J' if self.rotary else 'm'} = {mass}, b = {damping}"
