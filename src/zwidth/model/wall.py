"""The virtual wall of a scene, and the rule by which a wall passed as arguments replaces the wall of the scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from zwidth.core.errors import InputError
from zwidth.model.checks import Part, read_texts
from zwidth.units.parsing import to_float
from zwidth.units.unit_system import UnitSystem


@dataclass(frozen=True, repr=False)
class VirtualWall(Part):
    """A virtual wall: a spring and a damper, computed by the controller.

    The force is -(K x + B v), with the measured position x and the velocity estimate v.

    Args:
        stiffness: K in N/m.
        virtual_damping: B in N s/m.
    """

    stiffness: Any
    virtual_damping: Any = 0.0


@dataclass(frozen=True, repr=False)
class NoWall(VirtualWall):
    """Placeholder for the wall of a scene without wall: the force is 0, and functions do not take K and B from it."""

    stiffness: Any = field(default=0.0, init=False, repr=False)
    virtual_damping: Any = field(default=0.0, init=False, repr=False)


def resolve_wall(wall: VirtualWall, stiffness: Any, virtual_damping: Any, system: UnitSystem) -> tuple[Any, Any]:
    """Return K and B in SI units: those passed, or those of the scene's wall if stiffness and damping are both None.

    K without B means B = 0 if the scene has no wall. If it has one, K without B is ambiguous and raises `InputError`.
    """
    # Convert integers that overflow float64 to infinity, which the range checks of the caller reject.
    both = stiffness, virtual_damping
    stiffness, virtual_damping = (to_float(v) if isinstance(v, int) and v.bit_length() > 1023 else v for v in both)
    # Search for texts with units only if an argument is not a number, because the search would slow down most calls.
    if not (isinstance(stiffness, int | float) and isinstance(virtual_damping, int | float | None)):
        stiffness = read_texts("stiffness", stiffness, system["N/m"])
        virtual_damping = read_texts("virtual_damping", virtual_damping, system["N s/m"])
    chosen = not isinstance(wall, NoWall)
    if stiffness is None and virtual_damping is None:
        if not chosen:
            raise InputError(
                "stiffness: none is given, and the scene has no wall; pass stiffness (and virtual_damping), or build "
                "the scene with wall=zwidth.VirtualWall(stiffness=...)"
            )
        return wall.stiffness, wall.virtual_damping
    if stiffness is None:
        raise InputError(
            "stiffness: none is given with virtual_damping; pass both, or replace the scene's wall: "
            "scene.replace(stiffness=..., virtual_damping=...)"
        )
    if virtual_damping is None:
        if chosen:
            raise InputError(
                f"virtual_damping: none is given with stiffness, and the scene's wall has {wall.virtual_damping} "
                f"{system['N s/m']}; pass it, 0 for a spring only, or replace the wall: scene.replace(stiffness=...)"
            )
        return stiffness, 0.0
    return stiffness, virtual_damping
