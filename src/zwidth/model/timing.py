"""Timing of a loop: its sampling period, and the delay from a sample to the start of the force computed from it."""

from __future__ import annotations

import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.xp import is_jax, is_traced
from zwidth.model.checks import Part, Span, check_number, check_span, to_periods
from zwidth.units.formatting import format_periods, with_unit
from zwidth.units.plausibility import list_implausible
from zwidth.units.unit_system import LINEAR

# Limits of plain numbers; from these, a number was probably meant in another unit, and `Timing` issues a warning.
_LONG_PERIOD = 10.0  # s
_LONG_DELAY = 0.5  # s
_MANY_PERIODS = 50.0  # sampling periods; the warning requires that the delay reaches both limits
_NORMALIZED = 0.5  # s; loops with longer periods are probably normalized (T = 1), so no delay causes a warning


@dataclass(frozen=True, repr=False)
class Timing(Part):
    """The sampling period of a loop and the delay of the wall's force.

    Args:
        period: sampling period T in s, > 0. Pass either ``period`` or ``rate``.
        delay: delay t_d from a sample to the start of its force in s, >= 0, or a text in periods, "1.5 periods". It
            need not be a multiple of the period. If the period changes, a delay in periods keeps its number of periods.
            A JAX derivative with respect to such a delay is per period of delay; in the gradient of a scene, it is
            the number ``gradient.timing.span.value``.
        rate: sampling rate 1/T in Hz, > 0.

    Numerics:
        Plain numbers that were probably meant in another unit cause a `UserWarning`: a period of 10 s or more, and a
        delay of 0.5 s or more that is also at least 50 periods. Write such values with their unit, "1 s", to avoid it.

    Example:
        >>> import zwidth
        >>> zwidth.Timing(rate="4 kHz", delay="1.5 periods")
        Timing(period=0.00025, delay='1.5 periods')
    """

    period: Any = None
    delay: Any = 0.0
    rate: Any = None
    # Delay in periods if the user gave it in periods, otherwise None. This number is stored, because the quotient of
    # delay and period in seconds may have a rounding error.
    _periods: ClassVar[Any] = None
    # True if the delay was given in periods; its number of periods is then constant if the period changes.
    in_periods: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if (self.period is None) == (self.rate is None):
            both = "" if self.rate is None else "got both; "
            raise InputError(f"timing: {both}pass either period (s) or rate (Hz), and only one of them")
        given = {"period": self.period, "delay": self.delay}
        if self.rate is not None:
            object.__setattr__(self, "period", 1.0 / check_number("rate", self.rate))
            object.__setattr__(self, "rate", None)
        object.__setattr__(self, "period", check_number("period", self.period))
        delay = check_span("delay", self.delay)
        if isinstance(delay, Span):
            object.__setattr__(self, "in_periods", delay.unit == "periods")
            object.__setattr__(self, "_periods", delay.value if self.in_periods else None)
            object.__setattr__(self, "delay", delay.seconds(self.period))
        # Warn only if the user's code creates the timing, because zwidth and `dataclasses.replace` pass all delays as
        # numbers. Frame 1 is the constructor, and frame 2 is its caller.
        caller = sys._getframe(2).f_globals.get("__name__", "").partition(".")[0]
        if caller not in ("zwidth", "dataclasses"):
            self._warn_of_units(given)

    def _warn_of_units(self, given: dict[str, Any]) -> None:
        """Issue a warning if period or delay is a plain number that was probably meant in another unit."""
        least = {"period": _LONG_PERIOD, "delay": _LONG_DELAY}
        long = {name: v for name, v in given.items() if isinstance(v, int | float) and v >= least[name]}
        if "delay" in long and (self.d < _MANY_PERIODS or self.period > _NORMALIZED):
            del long["delay"]

        def spell(name: str, value: str) -> str:
            return f"{name}={value!r}" if value else name

        for text in list_implausible(long, spell, LINEAR):
            warnings.warn(text, UserWarning, stacklevel=4)

    def __repr__(self) -> str:
        """Return the expression that creates this timing, with the delay in its original unit, seconds or periods."""
        text = super().__repr__()
        if not self.in_periods or self.delay is self._periods:
            # If JAX stores a derivative in place of the delay, `_unflatten` assigns the same object to both attributes.
            return text
        return text.replace(f"delay={self.delay!r}", f"delay='{self.span}'")

    def _flatten(self) -> tuple[tuple[tuple[str, Any], ...], Any]:
        # Pass the delay to JAX in the unit in which it was given, because it is constant in this unit.
        return (("period", self.period), ("delay", self._periods if self.in_periods else self.delay)), self.in_periods

    @classmethod
    def _unflatten(cls, structure: Any, children: Any) -> Any:
        timing, (period, delay) = object.__new__(cls), children
        values = {"period": period, "delay": delay, "rate": None}
        if structure:
            # Convert the delay to seconds, except if JAX passes derivatives, or placeholders that cannot be multiplied.
            with suppress(TypeError):
                values["delay"] = delay if _is_derivative(period, delay) else delay * period
            values |= {"_periods": delay, "in_periods": True}
        for name, value in values.items():
            object.__setattr__(timing, name, value)
        return timing

    def _rebuild(self) -> Self:
        delay = f"{float(self._periods)!r} periods" if self.in_periods else self.delay
        return type(self)(period=self.period, delay=delay)

    @property
    def span(self) -> Any:
        """The delay in the unit in which the user gave it: a `Span` in periods, or a number of seconds."""
        return Span(self._periods, "periods") if self.in_periods else self.delay

    @property
    def delay_text(self) -> str:
        """The delay as text in the unit in which it stays constant if the period changes: "1 period" or "1 ms"."""
        if not self.in_periods:
            return with_unit(float(self.delay), "s")
        return format_periods(self._periods)

    @property
    def d(self) -> Any:
        """The delay in periods; an exact integer if it differs from one only by rounding errors."""
        if self.in_periods:
            return self._periods if is_jax(self._periods) else np.float64(self._periods)
        return to_periods(*(value if is_jax(value) else np.float64(value) for value in (self.delay, self.period)))


def _is_derivative(period: Any, count: Any) -> bool:
    """Return True if period or number of periods is out of range: JAX then stores derivatives in a `Timing`."""
    if is_traced(period, count) or np.ndim(period) or np.ndim(count):
        return False
    return float(period) <= 0 or float(count) < 0
