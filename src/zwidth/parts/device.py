"""The haptic device: a mass with viscous damping, rigid or with a compliance behind it, and what drives it."""

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
    """The haptic device: a mass with viscous damping, or an inertia where it is rotary.

    A rotary device is the same mathematics in other units: kg m^2 in place of kg, N m s/rad of N s/m, N m/rad of N/m,
    rad of m and N m of N. Every part and every wall of its scene is in these, and so is every answer.

    Args:
        mass: m in kg, > 0; with a coupling, of the motor's side. Of a rotary device the inertia J in kg m^2.
        damping: b in N s/m, >= 0; N m s/rad of a rotary device.
        coupling: the mass beyond a spring and damper, None for a rigid device.
        actuator: the lag of amplifier and motor, None where a command acts at once.
        modes: resonances that a command excites and the sensor sees, in any number.
        rotary: whether it turns; left out, the units of the other arguments say so, and plain numbers are of a linear
            device.

    Example:
        >>> import zwidth
        >>> zwidth.Device("12 g cm^2", "0.02 mN m s/rad")
        Device(mass=1.2e-06, damping=2e-05, rotary=True)
    """

    mass: Any
    damping: Any = 0.0
    coupling: Coupling | None = None
    actuator: Actuator | None = None
    # A list is as good.
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
