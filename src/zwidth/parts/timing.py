"""Sampling period and delay of a loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from zwidth.parts.checks import Part, Span, check_number, check_span, in_periods
from zwidth.words.errors import InputError
from zwidth.words.formatting import spell_periods, with_unit
from zwidth.words.xp import is_jax


@dataclass(frozen=True, repr=False)
class Timing(Part):
    """The sampling period of a loop and the delay of the wall's force.

    Args:
        period: T in s, > 0; or pass ``rate``.
        delay: t_d from a sample to the start of its force, in s, >= 0, integer or fractional periods; or exactly in
            periods, as "1.5 periods". If the period changes, a delay given in periods keeps its number of periods.
        rate: 1/T in Hz, > 0, instead of ``period``.

    Example:
        >>> import zwidth
        >>> zwidth.Timing(rate="4 kHz", delay="1.5 periods")
        Timing(period=0.00025, delay='1.5 periods')
    """

    period: Any = None
    delay: Any = 0.0
    rate: Any = None
    # Store a delay given in periods, because its quotient in seconds over the period may have a rounding error.
    _periods: ClassVar[float | None] = None

    def __post_init__(self) -> None:
        if (self.period is None) == (self.rate is None):
            both = "" if self.rate is None else "both are given; "
            raise InputError(f"timing: {both}give either the period (s) or the rate (Hz), and only one of them")
        if self.rate is not None:
            object.__setattr__(self, "period", 1.0 / check_number("rate", self.rate))
            object.__setattr__(self, "rate", None)
        object.__setattr__(self, "period", check_number("period", self.period))
        delay = check_span("delay", self.delay)
        if isinstance(delay, Span):
            object.__setattr__(self, "_periods", delay.value if delay.unit == "periods" else None)
            object.__setattr__(self, "delay", delay.seconds(self.period))

    def __repr__(self) -> str:
        """Return an expression that creates this timing, with the delay in its original unit, seconds or periods."""
        text = super().__repr__()
        return text if self._periods is None else text.replace(f"delay={self.delay!r}", f"delay='{self.span}'")

    @property
    def in_periods(self) -> bool:
        """True if the delay was given in periods. It then keeps its number of periods if the period changes."""
        return self._periods is not None

    @property
    def span(self) -> Any:
        """The delay in its original unit: a `Span` in periods, or a number of seconds."""
        return self.delay if self._periods is None else Span(self._periods, "periods")

    @property
    def kept_delay(self) -> str:
        """The delay that stays constant if the period changes, as text: "1 period" or "1.000 ms"."""
        if self._periods is None:
            return with_unit(float(self.delay), "s")
        return spell_periods(self._periods)

    @property
    def d(self) -> Any:
        """The delay in periods: as given, or the quotient, an exact integer if it differs by rounding errors only."""
        if self._periods is not None:
            return np.float64(self._periods)
        return in_periods(*(value if is_jax(value) else np.float64(value) for value in (self.delay, self.period)))
