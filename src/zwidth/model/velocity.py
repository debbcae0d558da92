"""Velocity estimates: transfer functions F(z) from measured position to the velocity that the wall's damper uses.

Parameters are in SI units; the method ``estimate`` of each class returns F for time in sampling periods, as `Estimate`.
The *coded period* is the sampling period that the constants of an estimate were computed for. If the loop runs at
another period T, the program divides position differences by the wrong time, and its cut-off frequency is shifted;
`Estimate` includes these errors.

Estimates can be evaluated with floats, with balls of python-flint (``flint.arb``, numbers with an error bound), and
with Taylor objects (numbers with exact derivatives, `zwidth.numerics.taylor`). Zeros and poles are stored as offsets
``1 - root``, which are accurate for roots near z = 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.xp import is_jax, is_traced, namespace
from zwidth.model.checks import Part
from zwidth.model.estimate import Estimate
from zwidth.model.rational_filter import RationalFilter
from zwidth.units.quantities import Range


class _Checked(Part):
    """Base class of the estimates whose parameters are checked against the ranges in `units.quantities`."""

    _owner = "velocity"


@dataclass(frozen=True, repr=False)
class BackwardDifference(_Checked):
    """The backward difference ``v = (x_k - x_(k-1))/T``, the default, as in the paper.

    Args:
        coded_period: period T in s by which the difference is divided. Default: the period of the loop.

    References:
        Hulin, Preusche, Hirzinger 2006, section II.
    """

    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """Return F for a loop with sampling period ``period`` in s, normalized to T = 1."""
        return Estimate(window=1, gain=get_coded_ratio(period, self.coded_period))


@dataclass(frozen=True, repr=False)
class WindowedDifference(_Checked):
    """The difference over n periods, ``v = (x_k - x_(k-n))/(n T)``: the mean velocity of these periods.

    Args:
        samples: window n in periods, from 1 (the backward difference) to 1000.
        coded_period: period T in s in the formula. Default: the period of the loop.

    References:
        chai3d/chai3d ``src/devices/CGenericHapticDevice.cpp`` (15 ms), Force Dimension SDK ``dhdc.h`` (20 ms).
    """

    samples: int
    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """Return F for a loop with sampling period ``period`` in s, normalized to T = 1."""
        return Estimate(window=self.samples, gain=get_coded_ratio(period, self.coded_period))


@dataclass(frozen=True, repr=False)
class LowPass(_Checked):
    """The backward difference, followed by one or two equal first-order low-passes.

    Each low-pass computes ``v <- p v + (1 - p) input`` in every period, with ``p = exp(-T/tau)`` and
    ``tau = 1/(2 pi cutoff)``. Therefore ``F = (1 - 1/z)/T ((1 - p) z/(z - p))^order``.

    Args:
        cutoff: cut-off frequency in Hz, > 0 and below the Nyquist frequency. Pass either ``cutoff`` or
            ``time_constant``.
        time_constant: tau in s, > 0.
        order: number of low-passes, 1 or 2.
        coded_period: period T in s for which p and the difference are computed. Default: the period of the loop.

    References:
        HannesRovina/HapticHumanRobotInterfaces-Lab ``Firmware/src/haptic_controller.c``;
        bgromov/Hapkit3.0 ``hapkit3.h``.
    """

    cutoff: Any = None
    time_constant: Any = None
    order: int = field(default=1, metadata={"allowed": Range(1, 2)})
    coded_period: Any = None

    def __post_init__(self) -> None:
        if (self.cutoff is None) == (self.time_constant is None):
            got = "neither cutoff nor time_constant" if self.cutoff is None else "both cutoff and time_constant"
            raise InputError(
                f"velocity: got {got}; pass either cutoff (Hz) or time_constant (s) of a low-pass, and only one of them"
            )
        super().__post_init__()

    def estimate(self, period: Any) -> Estimate:
        """Return F for a loop with sampling period ``period`` in s, normalized to T = 1."""
        coded = period if self.coded_period is None else self.coded_period
        if self.time_constant is None:
            check_cutoff(self.cutoff, coded)
            decay = 2.0 * get_pi(coded) * self.cutoff * coded
        else:
            decay = coded / self.time_constant
        xp = namespace(decay)
        offset = -xp.expm1(-decay)
        poles = xp.stack([as_complex(xp.asarray(offset))] * self.order)
        gain = offset**self.order * get_coded_ratio(period, self.coded_period)
        return Estimate(1, gain, -self.order, poles=poles)


@dataclass(frozen=True, repr=False)
class Butterworth(_Checked):
    """The backward difference, followed by a digital Butterworth low-pass as designed by `scipy.signal.butter`.

    Args:
        cutoff: cut-off frequency in Hz, > 0 and below the Nyquist frequency.
        order: order of the filter, 1 to 8.
        coded_period: period in s for which the filter was designed. Default: the period of the loop.

    References:
        mahilab/HapticPaddle ``src/main.cpp`` (order 4, 25 Hz at 1 kHz); Butterworth 1930, Wireless Engineer 7.
    """

    cutoff: Any
    order: int = 2
    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """Return F for a loop with sampling period ``period`` in s, normalized to T = 1."""
        coded = period if self.coded_period is None else self.coded_period
        check_cutoff(self.cutoff, coded)
        # The analog poles are on a circle, whose radius is prewarped so that the bilinear transform s = (z - 1)/(z + 1)
        # yields the cut-off frequency.
        xp = namespace(self.cutoff, coded)
        size = xp.tan(get_pi(coded) * self.cutoff * coded)
        angles = get_pi(coded) * (2.0 * np.arange(self.order) + 1.0 + self.order) / (2.0 * self.order)
        analog = size * xp.asarray(_unit_vectors(angles)).reshape(-1, *[1] * np.ndim(size))
        offsets = -2.0 * analog / (1.0 - analog)
        gain = xp.prod(offsets, 0).real * 0.5**self.order * get_coded_ratio(period, self.coded_period)
        return Estimate(1, gain, zeros=np.full(self.order, 2.0 + 0j), poles=offsets)


@dataclass(frozen=True, repr=False)
class VelocityFilter(RationalFilter):
    """Any linear estimate F(z) from position in m to velocity in m/s, by coefficients, sections or roots.

    If several forms are given, F is their product. For example, numerator and denominator can describe a difference,
    and ``sos`` a low-pass filter.

    Args:
        numerator: coefficients in 1/s, highest power of z first; or a list of sections in series, each a list of
            coefficients.
        denominator: coefficients or sections, as for the numerator. F must be causal: the degree of its denominator
            must be at least that of its numerator. All poles must be inside the unit circle. Use sections or roots for
            a filter of high order, because rounding errors in the coefficients of a single polynomial move its poles.
        sos: second-order sections, rows of the coefficients b0 b1 b2 a0 a1 a2, as returned by scipy.signal with
            ``output="sos"``.
        zeros: zeros in z; complex zeros together with their conjugates. Default: none, if ``poles`` is given.
        poles: poles in z, in the same form as the zeros; requires ``gain``.
        gain: leading coefficient of the numerator divided by that of the denominator; requires ``poles``.

    Example:
        >>> import zwidth
        >>> zwidth.VelocityFilter([1000, -1000], [1, 0]).estimate(1e-3).gain
        1.0
        >>> from scipy import signal
        >>> low_pass = signal.butter(8, 2, fs=1000, output="sos")
        >>> velocity = zwidth.VelocityFilter([1000, -1000], [1, 0], sos=low_pass)
    """

    def estimate(self, period: Any) -> Estimate:
        """Return F for a loop with sampling period ``period`` in s, normalized to T = 1."""
        return self.factor(period)


@dataclass(frozen=True, repr=False)
class FOAW(_Checked):
    """First-order adaptive windowing, for simulations only: the estimate is nonlinear, so the loop has no poles.

    The velocity is the slope of the line from the oldest to the newest position of a window. The window grows by one
    period at a time, up to ``samples``, as long as no position in it deviates from this line by more than ``noise``.

    Args:
        noise: largest error of the measured position in m, > 0; for an encoder, one count.
        samples: length of the longest window in periods, 1 to 64.

    References:
        Janabi-Sharifi, Hayward, Chen 2000, IEEE Trans. Control Systems Technology 8(6):1003-1009 (end-fit).
    """

    noise: Any
    samples: int = field(default=15, metadata={"allowed": Range(1, 64)})

    def estimate(self, period: Any) -> Estimate:
        """Raise `InputError`, because FOAW is nonlinear and has no transfer function F(z)."""
        raise InputError(
            "velocity: FOAW has no linear form, so the loop has no poles; simulate it, or use a linear estimate such "
            "as zwidth.WindowedDifference"
        )


Velocity: TypeAlias = BackwardDifference | WindowedDifference | LowPass | Butterworth | VelocityFilter | FOAW
ESTIMATES = {
    "backward_difference": BackwardDifference,
    "windowed_difference": WindowedDifference,
    "low_pass": LowPass,
    "butterworth": Butterworth,
    "filter": VelocityFilter,
    "foaw": FOAW,
}
"""Classes of velocity estimates by the name of their kind in configurations and on the command line."""


def name_estimate(velocity: Velocity) -> str:
    """Return the name of the class of an estimate in configurations; raise `InputError` for classes without a name."""
    for kind, part in ESTIMATES.items():
        if type(velocity) is part:
            return kind
    raise InputError(
        f"velocity: got {type(velocity).__name__}, which is not available in configurations; use one of "
        f"{', '.join(ESTIMATES)}"
    )


def is_plain(velocity: Velocity, period: Any) -> bool:
    """Return whether an estimate is the backward difference, divided by the loop's period, with all fields None."""
    if any(getattr(velocity, item.name) is not None for item in fields(velocity)):
        return False
    if is_traced(period):
        # Compare the methods instead of their results, because a method written by the user may accept only floats.
        return type(velocity).estimate is BackwardDifference.estimate
    estimate = velocity.estimate(period)
    return estimate.window == 1 and estimate.is_difference and isinstance(estimate.gain, float) and estimate.gain == 1.0


def check_cutoff(cutoff: Any, period: Any, owner: str = "velocity") -> None:
    """Raise `InputError` if a cut-off frequency is not below the Nyquist frequency."""
    if is_jax(cutoff) or is_jax(period):
        return
    if np.any(cutoff * period >= 0.5):
        raise InputError(
            f"{owner}.cutoff: got {cutoff:g} Hz; it must be below half the sampling rate, {0.5 / period:g} Hz; "
            "lower it, or remove the filter"
        )


def get_coded_ratio(period: Any, coded: Any) -> Any:
    """Return the sampling period divided by the period in the program's formula, ``coded``; 1 if ``coded`` is None."""
    return 1.0 if coded is None else period / coded


# The functions below implement operations that differ between floats, JAX arrays and balls.


def get_pi(like: Any) -> Any:
    """Return pi as a ball if the argument is a ball, otherwise as a float."""
    return like.pi() if hasattr(like, "pi") else np.pi


def as_complex(value: Any) -> Any:
    """Convert an array to complex dtype; return an array of balls (dtype object) unchanged."""
    return value if value.dtype == object else value + 0j


def _unit_vectors(angles: np.ndarray) -> np.ndarray:
    """Return ``e^(j angle)`` for each angle."""
    if angles.dtype != object:
        return np.exp(1j * angles)
    import flint

    return np.array([flint.acb(angle.cos(), angle.sin()) for angle in angles])
