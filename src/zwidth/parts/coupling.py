"""The compliance between motor and tip: a second mass behind a spring and a damper.

``m x1'' = F - b x1' + k (x2 - x1) + c (x2' - x1')``, ``m2 x2'' = -k (x2 - x1) - c (x2' - x1')`` with the wall's force
F on the motor side. A tendon, a belt, a gear's or a link's elasticity; the sensor sits at the motor (collocated) or at
the tip.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from zwidth.errors import check_choice
from zwidth.parts.checks import check_number


@dataclass(frozen=True)
class Coupling:
    """The mass beyond a spring and a damper.

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

    mass: Any
    stiffness: Any
    damping: Any = 0.0
    sensor: Literal["motor", "tip"] = "motor"

    def __post_init__(self) -> None:
        for name in ("mass", "stiffness", "damping"):
            object.__setattr__(self, name, check_number(f"coupling.{name}", getattr(self, name)))
        check_choice("coupling.sensor", self.sensor, ("motor", "tip"))
