"""Safe limit of a device: an upper limit on stiffness and damping of its walls, derived from measurements.

The limit is a wall (K, B): the stiffest one that is stable for nearly all devices that are consistent with the
measurements. A fit of the device computes the limit, a scene stores it, and a recommended wall does not exceed it,
unless the user requests a stiffer wall explicitly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from zwidth.core.errors import InputError
from zwidth.model.checks import Part, check_number
from zwidth.units.formatting import format_wall
from zwidth.units.quantities import Range
from zwidth.units.unit_system import UnitSystem

ROUNDING = 5e-4  # relative tolerance of `allows`, so that the limit allows a wall that is rounded to four digits


@dataclass(frozen=True, repr=False)
class SafeLimit(Part):
    """The stiffest wall (K, B) that measurements of a device show to be stable, with the reason for this limit.

    The limit allows a wall (K', B') if K' <= K and B' is between B K'/K and B. At the first end of this interval,
    stiffness and damping are reduced by the same factor; at the second end, only the stiffness is reduced.

    Args:
        stiffness: K in N/m, >= 0; 0 if the measurements are insufficient for any wall.
        virtual_damping: B in N s/m.
        reason: the effect that limits the stiffness, and the measurement that could raise the limit.
        warnings: faults of the measurements, one sentence each.
        damping_reserve: physical damping of the device in N s/m that does not count for passivity, because its estimate
            is uncertain; for a fit, the estimate minus the lower end of its 95 % interval.

    Example:
        >>> import zwidth
        >>> limit = zwidth.SafeLimit("484 N/m", "1.13 N s/m", reason="a resonance may hide in the log")
        >>> limit.allows(400, 1.13), limit.allows(400, 20)
        (True, False)
    """

    _texts = ("reason", "warnings")

    stiffness: Any
    virtual_damping: Any = 0.0
    reason: str = ""
    warnings: Sequence[str] = ()
    damping_reserve: Any = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stiffness >= 0:
            raise InputError(f"safe_limit.stiffness: got {self.stiffness!r}; it must be >= 0; 0 allows no wall")
        if not isinstance(self.reason, str):
            raise InputError(f"safe_limit.reason: got {self.reason!r}; it must be a string")
        texts = (self.warnings,) if isinstance(self.warnings, str) else self.warnings
        if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
            raise InputError(f"safe_limit.warnings: got {self.warnings!r}; it must be a list of strings")
        object.__setattr__(self, "warnings", tuple(texts))
        reserve = check_number("safe_limit.damping_reserve", self.damping_reserve, self.unit_system["N s/m"])
        object.__setattr__(self, "damping_reserve", reserve)

    @property
    def forbids_all(self) -> bool:
        """True if the limit allows no wall."""
        return self.stiffness == 0

    def dampings(self, stiffness: float) -> tuple[float, float] | None:
        """Return the smallest and the largest allowed damping at a stiffness; None if the stiffness is not allowed."""
        if self.forbids_all or not 0 <= stiffness <= (1.0 + ROUNDING) * self.stiffness:
            return None
        scaled = min(stiffness / self.stiffness, 1.0) * self.virtual_damping
        return min(scaled, self.virtual_damping), max(scaled, self.virtual_damping)

    def allows(self, stiffness: float | str, virtual_damping: float | str) -> bool:
        """Return whether the limit allows a wall, within a relative tolerance of ``ROUNDING``."""
        K = check_number("stiffness", stiffness, self.unit_system["N/m"], Range())
        B = check_number("virtual_damping", virtual_damping, self.unit_system["N s/m"], Range())
        ends = self.dampings(K)
        slack = ROUNDING * abs(self.virtual_damping)
        return ends is not None and ends[0] - slack <= B <= ends[1] + slack

    def warn(self, text: str) -> SafeLimit:
        """Return a copy with an additional warning; the limit itself if it contains this warning already."""
        return self if text in self.warnings else replace(self, warnings=(*self.warnings, text))

    def describe(self, system: UnitSystem) -> str:
        """Return a one-line description of the limit and its reason, in the given units."""
        wall = "no wall is supported" if self.forbids_all else format_wall(self.stiffness, self.virtual_damping, system)
        return f"{wall}: {self.reason}" if self.reason else wall


def reserve_damping(scene: Any) -> float:
    """Return the physical damping in N s/m that does not count for passivity, because its estimate is uncertain.

    It is 0 for a scene without safe limit.
    """
    return 0.0 if scene.safe_limit is None else scene.safe_limit.damping_reserve
