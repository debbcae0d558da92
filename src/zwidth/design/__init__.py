"""Design questions, answered through the exact model: how stiff, at what price, how well damped, how robust.

Names are loaded on first use, so that questions answered without JAX need not wait for it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from zwidth.design.area import stable_area as stable_area
    from zwidth.design.damping import DampingChoice as DampingChoice
    from zwidth.design.damping import FastestWall as FastestWall
    from zwidth.design.damping import fastest_damping as fastest_damping
    from zwidth.design.damping import fastest_wall as fastest_wall
    from zwidth.design.damping import most_robust_damping as most_robust_damping
    from zwidth.design.margin import modulus_margin as modulus_margin
    from zwidth.design.passive import passive_area as passive_area
    from zwidth.design.requirements import Requirement as Requirement
    from zwidth.design.requirements import allowed_delay as allowed_delay
    from zwidth.design.requirements import required_damping as required_damping
    from zwidth.design.requirements import required_mass as required_mass
    from zwidth.design.requirements import required_period as required_period
    from zwidth.design.robust import Interval as Interval
    from zwidth.design.robust import RobustStiffness as RobustStiffness
    from zwidth.design.robust import RobustWall as RobustWall
    from zwidth.design.robust import robust_max_stiffness as robust_max_stiffness
    from zwidth.design.robust import robust_wall as robust_wall
    from zwidth.design.stiffness import Sensitivities as Sensitivities
    from zwidth.design.stiffness import max_stiffness as max_stiffness
    from zwidth.design.stiffness import sensitivities as sensitivities
    from zwidth.design.stiffness import sensitivity_lines as sensitivity_lines

# public name -> the module that defines it
_HOME = {
    "stable_area": "zwidth.design.area",
    "DampingChoice": "zwidth.design.damping",
    "FastestWall": "zwidth.design.damping",
    "fastest_damping": "zwidth.design.damping",
    "fastest_wall": "zwidth.design.damping",
    "most_robust_damping": "zwidth.design.damping",
    "modulus_margin": "zwidth.design.margin",
    "passive_area": "zwidth.design.passive",
    "Requirement": "zwidth.design.requirements",
    "allowed_delay": "zwidth.design.requirements",
    "required_damping": "zwidth.design.requirements",
    "required_mass": "zwidth.design.requirements",
    "required_period": "zwidth.design.requirements",
    "Interval": "zwidth.design.robust",
    "RobustStiffness": "zwidth.design.robust",
    "RobustWall": "zwidth.design.robust",
    "robust_max_stiffness": "zwidth.design.robust",
    "robust_wall": "zwidth.design.robust",
    "Sensitivities": "zwidth.design.stiffness",
    "max_stiffness": "zwidth.design.stiffness",
    "sensitivities": "zwidth.design.stiffness",
    "sensitivity_lines": "zwidth.design.stiffness",
}

__all__ = [
    "DampingChoice",
    "FastestWall",
    "Interval",
    "Requirement",
    "RobustStiffness",
    "RobustWall",
    "Sensitivities",
    "allowed_delay",
    "fastest_damping",
    "fastest_wall",
    "max_stiffness",
    "modulus_margin",
    "most_robust_damping",
    "passive_area",
    "required_damping",
    "required_mass",
    "required_period",
    "robust_max_stiffness",
    "robust_wall",
    "sensitivities",
    "sensitivity_lines",
    "stable_area",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'zwidth.design' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
