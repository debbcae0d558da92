"""The wall that is rendered."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from zwidth.parts.checks import check_number


@dataclass(frozen=True)
class VirtualWall:
    """A spring and a damper, the damper acting on the velocity estimate.

    Args:
        stiffness: K in N/m.
        virtual_damping: B in N s/m.
    """

    stiffness: Any
    virtual_damping: Any = 0.0

    def __post_init__(self) -> None:
        for name, unit in (("stiffness", "N/m"), ("virtual_damping", "N s/m")):
            object.__setattr__(self, name, check_number(name, getattr(self, name), unit, low=-math.inf))
