"""The stiffest wall that measurements of a device support, with the reason and the warnings of the measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from zwidth.parts.checks import Part
from zwidth.words.errors import InputError
from zwidth.words.formatting import name_wall

ROUNDING = 5e-4  # relative; a wall printed with four digits still lies within the limit


@dataclass(frozen=True, repr=False)
class SafeLimit(Part):
    """The stiffest wall that measurements of a device support.

    A wall lies within the limit if its stiffness K' is at most K and its virtual damping lies between B K'/K and B:
    it is softer than the limit at the same damping, or scaled down from it, or between the two.

    Args:
        stiffness: K in N/m, >= 0; 0 if no wall is supported.
        virtual_damping: B in N s/m.
        reason: the cause of the limit, and the measurement that would raise it.
        warnings: what is wrong with the measurement, one sentence each.

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

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stiffness >= 0:
            raise InputError(f"safe_limit.stiffness: got {self.stiffness!r}; it must be 0 or more, 0 for no wall")
        if not isinstance(self.reason, str):
            raise InputError(f"safe_limit.reason: got {self.reason!r}; write a text")
        texts = (self.warnings,) if isinstance(self.warnings, str) else self.warnings
        if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
            raise InputError(f"safe_limit.warnings: got {self.warnings!r}; write a list of texts")
        object.__setattr__(self, "warnings", tuple(texts))

    @property
    def forbids_all(self) -> bool:
        """True if no wall lies within the limit."""
        return self.stiffness == 0

    def dampings(self, stiffness: float) -> tuple[float, float] | None:
        """Return the least and the largest damping within the limit at a stiffness; None if there is none."""
        if self.forbids_all or not 0 <= stiffness <= (1.0 + ROUNDING) * self.stiffness:
            return None
        scaled = min(stiffness / self.stiffness, 1.0) * self.virtual_damping
        return min(scaled, self.virtual_damping), max(scaled, self.virtual_damping)

    def allows(self, stiffness: float, virtual_damping: float) -> bool:
        """Return True if a wall lies within the limit."""
        ends = self.dampings(stiffness)
        slack = ROUNDING * abs(self.virtual_damping)
        return ends is not None and ends[0] - slack <= virtual_damping <= ends[1] + slack

    def warn(self, text: str) -> SafeLimit:
        """Return the limit with one more warning."""
        return self if text in self.warnings else replace(self, warnings=(*self.warnings, text))

    def describe(self) -> str:
        """Return the limit and its reason in one sentence."""
        wall = "no wall is supported" if self.forbids_all else name_wall(self.stiffness, self.virtual_damping)
        return f"{wall}: {self.reason}" if self.reason else wall
