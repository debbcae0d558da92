"""Actuator dynamics: the lag of first or second order between commanded force and actual force.

The lag models amplifier, current loop and motor. With the command u, the actual force F and w = 1/tau = 2 pi cutoff,

    first order:   tau F' + F = u
    second order:  F''/w^2 + 2 zeta F'/w + F = u
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.checks import Part


def to_angular(frequency: Any) -> Any:
    """Return the angular frequency in rad/s of a frequency in Hz, a number or a ball (interval of python-flint)."""
    return 2.0 * (frequency.pi() if hasattr(frequency, "pi") else np.pi) * frequency


@dataclass(frozen=True, repr=False)
class Actuator(Part):
    """The lag of first or second order between commanded and actual force.

    ``tau F' + F = u``, or ``F''/w^2 + 2 zeta F'/w + F = u`` with ``w = 1/tau = 2 pi cutoff``. The forces of the
    operator and of friction act on the device directly, without this lag.

    Args:
        cutoff: corner frequency w/(2 pi) in Hz, > 0. Pass either ``cutoff`` or ``time_constant``.
        time_constant: tau in s, > 0.
        order: 1 or 2.
        damping_ratio: zeta, > 0, for order 2 only. Default: sqrt(1/2).

    Example:
        >>> import zwidth
        >>> device, timing = zwidth.Device(0.1, 10, actuator=zwidth.Actuator(cutoff=300)), zwidth.Timing(period=1e-3)
        >>> print(f"{zwidth.Scene(device, timing).max_stiffness().stiffness:.0f} N/m")
        36925 N/m
    """

    _owner = "actuator"
    # Presets of this part in the page of ``zwidth explore``: arguments of the constructor, by name of the preset.
    usual: ClassVar[dict[str, dict[str, float]]] = {
        "first order": {"cutoff": 300.0},
        "second order": {"cutoff": 300.0, "order": 2, "damping_ratio": 0.7},
        "first order, time constant": {"time_constant": 0.5e-3},
        "second order, time constant": {"time_constant": 0.5e-3, "order": 2, "damping_ratio": 0.7},
    }

    cutoff: Any = None
    time_constant: Any = None
    order: int = 1
    damping_ratio: Any = None

    def __post_init__(self) -> None:
        if (self.cutoff is None) == (self.time_constant is None):
            given = "neither cutoff nor time_constant" if self.cutoff is None else "cutoff and time_constant"
            raise InputError(f"actuator: got {given}; pass either cutoff (Hz) or time_constant (s)")
        super().__post_init__()
        if self.order == 1 and self.damping_ratio is not None:
            raise InputError(
                f"actuator.damping_ratio: got {self.damping_ratio!r} for a first-order actuator; omit it, or pass "
                "order=2"
            )
        if self.order == 2 and self.damping_ratio is None:
            object.__setattr__(self, "damping_ratio", 0.5**0.5)

    @property
    def rate(self) -> Any:
        """The corner frequency w in rad/s."""
        return to_angular(self.cutoff) if self.time_constant is None else 1.0 / self.time_constant
