"""The operator's hand: attached to the device rigidly, or by a spring and a damper.

A rigid grasp adds mass, damping and a spring to ground to the body that is held (the tip, if the device has a
coupling). A hand attached by a spring and a damper is a separate mass, with its own damper and spring to ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from zwidth.parts.checks import Part, check_number
from zwidth.words.errors import InputError
from zwidth.words.quantities import POSITIVE
from zwidth.words.xp import is_jax

# Values of the reference below.
_HAND = {"mass": 0.554, "damping": 6.45, "stiffness": 135.0}


@dataclass(frozen=True, repr=False)
class Operator(Part):
    """The operator's hand.

    Args:
        mass: in kg, >= 0; > 0 unless the grasp is rigid.
        damping: to ground, in N s/m, >= 0.
        stiffness: to ground, in N/m, >= 0.
        coupling_stiffness: of the spring between hand and device, in N/m, > 0; None for a rigid grasp.
        coupling_damping: of the damper parallel to this spring, in N s/m, >= 0.

    References:
        A hand of 0.554 kg, 6.45 N s/m and 135 N/m: Sci. Rep. 5:18004 (2015), Fig. 3 (one trial).

    Example:
        >>> import zwidth
        >>> zwidth.Operator(mass=0.554, damping=6.45, stiffness=135).rigid
        True
    """

    _owner = "operator"
    # Forms that the explorer offers.
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
            # Check the mass after its conversion to SI.
            check_number("operator.mass", self.mass, self.unit_system["kg"], POSITIVE)
        # Count any JAX value as nonzero, because a traced value cannot be compared.
        if self.rigid and (is_jax(self.coupling_damping) or self.coupling_damping):
            raise InputError(
                f"operator.coupling_damping: got {self.coupling_damping!r} without a spring beside it; give "
                "operator.coupling_stiffness as well, or add the damping to the device"
            )

    @property
    def rigid(self) -> bool:
        """True if the grasp is rigid."""
        return self.coupling_stiffness is None
