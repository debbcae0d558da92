"""Model of the operator's hand: a mass with a damper and a spring to ground, attached to the device.

A rigid grasp adds mass, damping and stiffness to the body of the device that the operator holds: the tip if the device
has a coupling. A grasp with a spring and a damper connects this body with the hand as a separate mass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from zwidth.core.errors import InputError
from zwidth.core.xp import is_jax
from zwidth.model.checks import Part, check_number
from zwidth.units.quantities import POSITIVE

# Parameters of a measured hand in kg, N s/m and N/m; `Operator` names the source.
_HAND = {"mass": 0.554, "damping": 6.45, "stiffness": 135.0}


@dataclass(frozen=True, repr=False)
class Operator(Part):
    """The operator's hand on the device: a mass with a damper and a spring to ground.

    Args:
        mass: mass of the hand in kg, >= 0; > 0 if ``coupling_stiffness`` is given.
        damping: damping of the hand to ground in N s/m, >= 0.
        stiffness: stiffness of the hand to ground in N/m, >= 0.
        coupling_stiffness: stiffness of the spring between hand and device in N/m, > 0; None for a rigid grasp.
        coupling_damping: damping parallel to this spring in N s/m, >= 0.

    References:
        A hand of 0.554 kg, 6.45 N s/m and 135 N/m: Sci. Rep. 5:18004 (2015), Fig. 3 (one trial).

    Example:
        >>> import zwidth
        >>> zwidth.Operator(mass=0.554, damping=6.45, stiffness=135).rigid
        True
    """

    _owner = "operator"
    # Presets of this part in the page of ``zwidth explore``: arguments of the constructor, by name of the preset.
    usual: ClassVar[dict[str, dict[str, float]]] = {
        "rigid": _HAND,
        "grasp": {**_HAND, "coupling_stiffness": 1e3, "coupling_damping": 5.0},
    }

    mass: Any = 0.0
    damping: Any = 0.0
    stiffness: Any = 0.0
    coupling_stiffness: Any = None
    coupling_damping: Any = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rigid:
            # Check the range of the mass after the base class has converted the mass to SI units.
            check_number("operator.mass", self.mass, self.unit_system["kg"], POSITIVE)
        # Treat a damping that is a JAX array as nonzero, because the value of a traced array is unknown.
        if self.rigid and (is_jax(self.coupling_damping) or self.coupling_damping):
            raise InputError(
                f"operator.coupling_damping: got {self.coupling_damping!r} without a coupling spring; pass "
                "operator.coupling_stiffness too, or add the damping to the device"
            )

    def _is_child(self, name: str, value: Any) -> bool:
        # A rigid grasp has no damper between hand and device.
        return super()._is_child(name, value) and not (self.rigid and name == "coupling_damping")

    @property
    def rigid(self) -> bool:
        """True if the grasp is rigid, without a spring between hand and device."""
        return self.coupling_stiffness is None
