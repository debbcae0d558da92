"""Position estimates: filters P(z) of the measured position x, whose output the spring of the wall uses as position.

The velocity estimate V has one of three forms. If the program differentiates the filtered position, V = P F with the
difference F of `model.velocity`. If the program differentiates the measured position, V = F. An *observer* or a
phase-locked loop (PLL) estimates both position and velocity; V then has the same poles as P.

Parameters are in SI units. The method ``estimate`` of each class returns P as an `Estimate`. The method
``estimate_velocity`` of observers and PLLs returns V as an `Estimate`, for time in sampling periods.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np

from zwidth.core.errors import InputError, check_choice
from zwidth.core.xp import is_traced, namespace
from zwidth.model.checks import Part, check_number
from zwidth.model.estimate import Estimate
from zwidth.model.rational_filter import RationalFilter
from zwidth.model.velocity import Butterworth, LowPass, as_complex, check_cutoff, get_coded_ratio, get_pi
from zwidth.units.quantities import POSITIVE

VelocitySource = Literal["position", "measured"]
SOURCES = ("position", "measured")
"""Inputs of the velocity estimate: the position estimate, or the measured position."""
LARGEST_BANDWIDTH = 2.0 * (np.sqrt(2.0) - 1.0)  # bandwidth times T at the stability limit of a PLL


@dataclass(frozen=True, repr=False)
class ExponentialFilter(Part):
    """The exponential moving average ``x <- x + a (new - x)`` of the measured position: ``P = a z/(z - 1 + a)``.

    Programs define the coefficient a differently; with the sampling period T and the time constant tau or T_f:

    - Arduino libraries: ``a = alpha``, because ``alpha`` is the weight of the new sample;
    - zwidth, `LowPass` and a filter designed in continuous time: ``a = 1 - exp(-T/tau)``, from ``time_constant`` or
      ``cutoff = 1/(2 pi tau)``;
    - SimpleFOC ``LowPassFilter``: ``a = T/(T_f + T)``, because ``alpha = T_f/(T_f + T)`` is the weight of the old
      value; see `ExponentialFilter.simplefoc`.

    Args:
        coefficient: a, the weight of the new sample, above 0 and at most 1. Pass exactly one of ``coefficient``,
            ``time_constant`` and ``cutoff``.
        time_constant: tau in s, > 0.
        cutoff: cut-off frequency in Hz, > 0 and below the Nyquist frequency.
        velocity_from: input of the velocity estimate: "position" (the filtered position) or "measured".

    References:
        simplefoc/Arduino-FOC ``src/common/lowpass_filter.cpp``.

    Example:
        >>> import zwidth
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), position=zwidth.ExponentialFilter(0.3))
        >>> bool(scene.is_stable(10e3, 40))
        True
    """

    _owner = "position"

    coefficient: Any = None
    time_constant: Any = None
    cutoff: Any = None
    velocity_from: VelocitySource = "position"

    def __post_init__(self) -> None:
        names = ("coefficient", "time_constant", "cutoff")
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) != 1:
            raise InputError(
                f"position: got {' and '.join(given) or 'none'} of {', '.join(names)}; pass exactly one of them"
            )
        check_choice("position.velocity_from", self.velocity_from, SOURCES)
        super().__post_init__()

    @classmethod
    def simplefoc(cls, time_constant: Any, period: Any) -> ExponentialFilter:
        """Return the filter of the class ``LowPassFilter`` of SimpleFOC, with ``a = T/(T_f + T)``.

        Args:
            time_constant: T_f in s, the field ``Tf`` of ``LowPassFilter``.
            period: sampling period T of the program in s.
        """
        T_f, T = (
            check_number(name, value, "s", POSITIVE)
            for name, value in (("time_constant", time_constant), ("period", period))
        )
        return cls(coefficient=T / (T_f + T))

    def estimate(self, period: Any) -> Estimate:
        """Return P for a loop with sampling period ``period`` in s."""
        if self.coefficient is not None:
            gain = self.coefficient
            if not is_traced(gain) and isinstance(gain, float) and gain == 1.0:
                return Estimate(0)
        elif self.time_constant is not None:
            gain = -namespace(self.time_constant, period).expm1(-period / self.time_constant)
        else:
            check_cutoff(self.cutoff, period, "position")
            gain = -namespace(self.cutoff, period).expm1(-2.0 * get_pi(period) * self.cutoff * period)
        xp = namespace(gain)
        return Estimate(0, gain, -1, poles=xp.stack([as_complex(xp.asarray(gain))]))


@dataclass(frozen=True, repr=False)
class PositionFilter(RationalFilter):
    """Any linear filter ``P(z) = numerator/denominator`` of the measured position.

    Args:
        numerator: coefficients, highest power of z first; or a list of sections in series, each a list of coefficients.
        denominator: coefficients or sections, as for the numerator. The degree must be at least that of the numerator,
            and all roots must be inside the unit circle.
        sos, zeros, poles, gain: second-order sections, or roots, as for `VelocityFilter`.
        velocity_from: input of the velocity estimate: "position" (the filtered position) or "measured".

    Example:
        >>> import zwidth
        >>> mean = zwidth.PositionFilter([0.25, 0.25, 0.25, 0.25], [1, 0, 0, 0])
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(1e-3), position=mean)
        >>> bool(scene.is_stable(5e3, 20))
        True
    """

    _owner = "position"

    velocity_from: VelocitySource = "position"

    def __post_init__(self) -> None:
        check_choice("position.velocity_from", self.velocity_from, SOURCES)
        super().__post_init__()

    def estimate(self, period: Any) -> Estimate:
        """Return P, whose coefficients do not depend on the sampling period ``period``."""
        return self.factor(1.0 + 0.0 * period)


@dataclass(frozen=True, repr=False)
class Pll(Part):
    """The phase-locked loop of motor controllers, which estimates position and velocity.

    In every period the program updates the estimates p of the position and v of the velocity with the measured
    position x:

        p <- p + T v;   e = x - p;   p <- p + T k_p e;   v <- v + T k_i e

    with ``k_p = 2 bandwidth`` and ``k_i = k_p^2/4``. The transfer functions are, with u = bandwidth T and zeta = z - 1,

        P = z (2 u zeta + u^2)/D      V = (u^2/T) z zeta/D      D = zeta^2 + (2 u + u^2) zeta + u^2

    Args:
        bandwidth: bandwidth in rad/s, > 0 and at most 0.828/T, above which the PLL is unstable.

    References:
        odriverobotics/ODrive ``Firmware/MotorControl/encoder.cpp`` (default 1000 rad/s).

    Example:
        >>> import zwidth
        >>> device = zwidth.Device("1e-4 kg m^2", "1e-4 N m s/rad")
        >>> timing = zwidth.Timing(rate=8e3, delay="1.5 periods")
        >>> scene = zwidth.Scene(device, timing, position=zwidth.Pll(bandwidth=1000))
        >>> print(f"{scene.spectral_radius(20 * 0.0254648, 0.0254648):.4f}")
        0.9974
    """

    _owner = "position"

    bandwidth: Any

    def _scale(self, period: Any) -> tuple[Any, Any]:
        """Return u = bandwidth T, and the two poles of P and V as offsets ``1 - pole``."""
        u = self.bandwidth * period
        if not is_traced(u) and np.ndim(getattr(u, "v", u)) == 0 and u >= LARGEST_BANDWIDTH:
            raise InputError(
                f"position.bandwidth: got {self.bandwidth:g} rad/s; the PLL is unstable from "
                f"{LARGEST_BANDWIDTH / period:g} rad/s on; lower it"
            )
        xp = namespace(u)
        fast = 0.5 * u * (2.0 + u + xp.sqrt(u * u + 4.0 * u))
        return u, xp.stack([as_complex(xp.asarray(each)) for each in (fast, u * u / fast)])

    def estimate(self, period: Any) -> Estimate:
        """Return P for a loop with sampling period ``period`` in s."""
        u, poles = self._scale(period)
        xp = namespace(u)
        return Estimate(0, 2.0 * u, -1, xp.stack([as_complex(xp.asarray(0.5 * u))]), poles)

    def estimate_velocity(self, period: Any) -> Estimate:
        """Return the velocity estimate V for a loop with sampling period ``period`` in s, normalized to T = 1."""
        u, poles = self._scale(period)
        return Estimate(0, u * u, -1, np.zeros(1, complex), poles)


@dataclass(frozen=True, repr=False)
class Observer(Part):
    """A linear observer, which estimates position and velocity with common poles.

    With the numerators N_p and N_v and the common denominator D, polynomials in z, ``P = N_p/D`` and ``V = N_v/D``.

    Args:
        position: coefficients of N_p, highest power of z first.
        velocity: coefficients of N_v in 1/s.
        denominator: coefficients of D, with all roots inside the unit circle.

    References:
        Franklin, Powell, Workman 1998, Digital Control of Dynamic Systems, 3rd ed. (current estimator).

    Example:
        An alpha-beta filter, ``p <- p + T v; e = x - p; p <- p + a e; v <- v + (b/T) e`` with a = 0.5, b = 0.1:

        >>> import zwidth
        >>> T, a, b = 1e-3, 0.5, 0.1
        >>> observer = zwidth.Observer([a, b - a, 0], [b / T, -b / T, 0], [1, a + b - 2, 1 - a])
        >>> scene = zwidth.Scene(zwidth.Device(0.1, 10), zwidth.Timing(T), position=observer)
        >>> bool(scene.is_stable(5e3, 20))
        True
    """

    _owner = "position"

    position: Any
    velocity: Any
    denominator: Any

    def __post_init__(self) -> None:
        for name, part in zip(("position", "velocity"), self._filters, strict=True):
            object.__setattr__(self, name, part.numerator)
        object.__setattr__(self, "denominator", self._filters[0].denominator)

    @cached_property
    def _filters(self) -> tuple[PositionFilter, PositionFilter]:
        """The transfer functions P and V, each as a `PositionFilter`.

        Raises:
            InputError: a numerator is invalid; the message refers to it by the field of this class,
                ``position.position`` or ``position.velocity``, not by the ``numerator`` of the `PositionFilter`.
        """

        def make(name: str) -> PositionFilter:
            try:
                return PositionFilter(getattr(self, name), self.denominator)
            except InputError as error:
                raise InputError(re.sub(r"^position\.numerator", f"position.{name}", str(error))) from None

        return make("position"), make("velocity")

    def estimate(self, period: Any) -> Estimate:
        """Return P, whose coefficients do not depend on the sampling period ``period``."""
        return self._filters[0].factor(1.0 + 0.0 * period)

    def estimate_velocity(self, period: Any) -> Estimate:
        """Return the velocity estimate V for a loop with sampling period ``period`` in s, normalized to T = 1."""
        return self._filters[1].factor(period)


Position: TypeAlias = ExponentialFilter | PositionFilter | LowPass | Butterworth | Pll | Observer


POSITIONS = {
    "exponential": ExponentialFilter,
    "low_pass": LowPass,
    "butterworth": Butterworth,
    "filter": PositionFilter,
    "pll": Pll,
    "observer": Observer,
}
"""Classes of position estimates, keyed by the name of the kind in configurations and on the command line."""


def estimate_position(position: Position | None, period: Any) -> Estimate:
    """Return the transfer function P of a position estimate, for a sampling period in s.

    P is 1 for None. `LowPass` and `Butterworth` are velocity estimates, a difference followed by a filter; as position
    estimates, P is the filter without the difference.
    """
    if position is None:
        return Estimate(0)
    if not isinstance(position, LowPass | Butterworth):
        return position.estimate(period)
    try:
        estimate = position.estimate(period)
    except InputError as error:
        raise InputError(str(error).replace("velocity", "position", 1)) from None
    return replace(estimate, window=0, gain=estimate.gain / get_coded_ratio(period, position.coded_period))


def has_velocity(position: Position | None) -> bool:
    """Return whether a position estimate is an observer or a PLL, which also estimates the velocity."""
    return isinstance(position, Pll | Observer)
