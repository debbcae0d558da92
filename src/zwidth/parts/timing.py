"""When the wall's force is computed and when it acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zwidth._types import DELAY_MODELS, DelayModel
from zwidth.errors import InputError, check_choice
from zwidth.parts.checks import check_number


@dataclass(frozen=True)
class Timing:
    """When the wall's force is computed and when it acts.

    Args:
        period: T in s, > 0; or give the rate.
        delay: t_d, from a sample to the moment its force acts, in s, >= 0, whole periods or not.
        delay_model: "held" (exact for every delay) or "fractional_power" (the paper's z^(1+d), boundary and
            ridge only).
        rate: 1/T in Hz, > 0, in place of the period.

    Example:
        >>> import zwidth
        >>> zwidth.Timing(rate=4000).period
        0.00025
    """

    period: Any = None
    delay: Any = 0.0
    delay_model: DelayModel = "held"
    rate: Any = None

    def __post_init__(self) -> None:
        if (self.period is None) == (self.rate is None):
            raise InputError("timing: give either the period (s) or the rate (Hz), and only one of them")
        if self.rate is not None:
            object.__setattr__(self, "period", 1.0 / check_number("rate", self.rate, "Hz", low_open=True))
            object.__setattr__(self, "rate", None)
        object.__setattr__(self, "period", check_number("period", self.period, "s", low_open=True))
        object.__setattr__(self, "delay", check_number("delay", self.delay, "s"))
        check_choice("delay_model", self.delay_model, DELAY_MODELS)
