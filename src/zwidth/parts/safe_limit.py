"""Represent the safe limit: the stiffest wall that measurements of a device support, with reason and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from zwidth.parts.checks import Part, check_number
from zwidth.words.errors import InputError
from zwidth.words.formatting import name_wall
from zwidth.words.unit_system import UnitSystem

ROUNDING = 5e-4  # relative tolerance, so that the limit allows a wall that is rounded to four digits


@dataclass(frozen=True, repr=False)
class SafeLimit(Part):
    """The stiffest wall that measurements of a device support.

    The limit is a wall (K, B). It allows a wall (K', B') if K' <= K and B' is between B K'/K and B. The two extremes
    are the limit with reduced stiffness only, and the limit with stiffness and damping reduced by the same factor.

    Args:
        stiffness: K in N/m, >= 0; 0 if no wall is supported.
        virtual_damping: B in N s/m.
        reason: the reason of the limit, and the measurement that can raise it.
        warnings: faults of the measurement, one sentence each.
        damping_reserve: physical damping of the device in N s/m that passivity does not count, because its estimate is
            uncertain: the estimate minus the lower end of its 95 % interval, for a fit.

    Example:
        >>> import zwidth
        >>> limit = zwidth.SafeLimit("484 N/m", "1.13 N s/m", reason="a resonance may hide in the log")
        >>> limit.allows(400, 1.13), limit.allows(400, 20)
        (True, False)
    """

    stiffness: Any
    virtual_damping: Any = 0.0
    reason: str = ""
    warnings: Sequence[str] = ()
    damping_reserve: Any = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stiffness >= 0:
            raise InputError(f"safe_limit.stiffness: got {self.stiffness!r}; it must be >= 0 (0: no wall is allowed)")
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
        """Return the smallest and the largest allowed damping at a stiffness; None if no damping is allowed."""
        if self.forbids_all or not 0 <= stiffness <= (1.0 + ROUNDING) * self.stiffness:
            return None
        scaled = min(stiffness / self.stiffness, 1.0) * self.virtual_damping
        return min(scaled, self.virtual_damping), max(scaled, self.virtual_damping)

    def allows(self, stiffness: float, virtual_damping: float) -> bool:
        """Return True if the limit allows a wall."""
        ends = self.dampings(stiffness)
        slack = ROUNDING * abs(self.virtual_damping)
        return ends is not None and ends[0] - slack <= virtual_damping <= ends[1] + slack

    def warn(self, text: str) -> SafeLimit:
        """Return the limit with an additional warning."""
        return self if text in self.warnings else replace(self, warnings=(*self.warnings, text))

    def describe(self, system: UnitSystem) -> str:
        """Return a one-line description of the limit and its reason."""
        wall = "no wall is supported" if self.forbids_all else name_wall(self.stiffness, self.virtual_damping, system)
        return f"{wall}: {self.reason}" if self.reason else wall


def reserve_damping(scene: Any) -> float:
    """Return the physical damping that passivity does not count, from the safe limit of a scene."""
    return 0.0 if scene.safe_limit is None else scene.safe_limit.damping_reserve
