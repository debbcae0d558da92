"""Model of the haptic device: a mass with viscous damping, and optionally a compliant coupling, an actuator and modes.

The *motor side* is the body that the actuator drives. With a coupling, the *tip* is the second body, which the operator
holds; the position sensor is on one of the two bodies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from zwidth.core.errors import InputError
from zwidth.model.actuator import Actuator
from zwidth.model.checks import Part, check_kind, find_kind
from zwidth.model.mode import Mode
from zwidth.units.formatting import with_unit


@dataclass(frozen=True, repr=False)
class Coupling(Part):
    """Compliant coupling: a second mass, connected by a spring and a damper, as with a tendon, belt, gear or link.

    ``m x1'' = F - b x1' + k (x2 - x1) + c (x2' - x1')``, ``m2 x2'' = -k (x2 - x1) - c (x2' - x1')``, with the positions
    x1 of the motor side and x2 of the tip. The force F of the wall acts on the motor side.

    Args:
        mass: mass m2 of the tip in kg, > 0.
        stiffness: stiffness k of the spring in N/m, > 0.
        damping: damping c of the damper in N s/m, >= 0.
        sensor: location of the position sensor, "motor" or "tip".

    Example:
        >>> import zwidth
        >>> zwidth.Coupling(mass=0.05, stiffness=20e3, damping=1.0).sensor
        'motor'
    """

    _owner = "coupling"
    # Presets of this part in the page of ``zwidth explore``: arguments of the constructor, by name of the preset.
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
    N m/rad instead of N/m, rad instead of m, and N m instead of N. These are then the units of all parts, walls and
    results of the scene.

    Args:
        mass: mass m in kg, > 0; with a coupling, the mass of the motor side. For a rotary device, the inertia J in
            kg m^2.
        damping: viscous damping b in N s/m, >= 0; in N m s/rad for a rotary device.
        coupling: compliant coupling to a second mass; None for a rigid device.
        actuator: dynamics of amplifier and motor; None if the commanded force acts without lag.
        modes: list of structural modes, possibly empty.
        rotary: True for a rotary device, False for a linear one. Default: rotary if other arguments have rotary units;
            numbers without unit are in units of a linear device.

    Example:
        >>> import zwidth
        >>> zwidth.Device("12 g cm^2", "0.02 mN m s/rad")
        Device(mass=1.2e-06, damping=2e-05, rotary=True)
    """

    mass: Any
    damping: Any = 0.0
    coupling: Coupling | None = None
    actuator: Actuator | None = None
    # The type is Any, because `__post_init__` converts a list or a single mode to a tuple.
    modes: Any = ()
    rotary: bool | None = None

    def __post_init__(self) -> None:
        modes = (self.modes,) if isinstance(self.modes, Mode) else self.modes
        if not isinstance(modes, list | tuple) or not all(isinstance(mode, Mode) for mode in modes):
            raise InputError(f"modes: got {self.modes!r}; it must be a list of zwidth.Mode")
        if self.rotary is not None and not isinstance(self.rotary, bool):
            raise InputError(f"rotary: got {self.rotary!r}; it must be True or False")
        quantities = {name: getattr(self, name) for name in ("mass", "damping", "coupling")}
        quantities |= {f"modes.{k}": mode for k, mode in enumerate(modes)}
        unit_kind = find_kind(quantities)
        rotary = unit_kind or False if self.rotary is None else self.rotary
        object.__setattr__(self, "modes", tuple(modes))
        for name, kind in {"coupling": Coupling, "actuator": Actuator}.items():
            part = getattr(self, name)
            if part is not None and not isinstance(part, kind):
                raise InputError(f"{name}: got {part!r}; it must be a zwidth.{kind.__name__} or None")
        check_kind(rotary, quantities)
        object.__setattr__(self, "rotary", rotary)
        super().__post_init__()

    def spell(self) -> str:
        """Return mass and damping as text with symbols and units: ``m = 100.0 g, b = 1.000 N s/m``."""
        mass, damping = with_unit(self.mass, self.unit_system["kg"]), with_unit(self.damping, self.unit_system["N s/m"])
        return f"{'J' if self.rotary else 'm'} = {mass}, b = {damping}"
