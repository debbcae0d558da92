"""Velocity estimates: transfer functions from the sampled position to the velocity that the wall's damper uses.

Each is ``F(z)`` from position in m to velocity in m/s. Its method ``estimate`` returns it normalized to T = 1, as
`Estimate`. The coded period of an estimate is the sampling period that its formulas were written for. If the loop has
another period, the program divides the difference by the wrong time and shifts the cut-off frequency. The loop is
computed with these errors.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from zwidth.parts.checks import Part
from zwidth.parts.circle import CirclePoints, Jet, lag_jet, product_jet
from zwidth.parts.filter_sections import (
    NEXT_TO_ONE,
    ball_offsets,
    count_trailing_zeros,
    is_rounding,
    offsets,
    read_sections,
)
from zwidth.words.errors import InputError
from zwidth.words.quantities import Range
from zwidth.words.xp import is_jax, namespace


@dataclass(frozen=True)
class Estimate:
    """The velocity estimate F: a difference over ``window`` periods, then a filter.

    ``F(z) = gain prod(z - zeros)/(z^lag prod(z - poles)) (1 - z^-window)/window``, without the last factor for a window
    of 0.
    """

    window: int = 1
    gain: Any = 1.0
    lag: int = 0
    zeros: Any = field(default_factory=lambda: np.zeros(0, complex))
    poles: Any = field(default_factory=lambda: np.zeros(0, complex))

    def jet(self, at: CirclePoints) -> Jet:
        """Return F and its derivative in w."""
        xp = namespace(at.w)
        parts = product_jet(at, self.zeros, self.gain)
        if self.poles.size:
            parts = parts.over(product_jet(at, self.poles, 1.0))
        if self.lag:
            parts = parts.times(lag_jet(at, -self.lag))
        if self.window:
            back = lag_jet(at, -self.window)
            n = self.window
            s = xp.sin(0.5 * n * at.w)
            value = xp.where(at.w >= np.pi, 1.0 - back.value, 2.0 * s * s - 1j * back.value.imag) / n
            parts = parts.times(Jet(value, -back.slope / n))
        return parts

    @property
    def is_difference(self) -> bool:
        """True if the estimate is the difference of two successive samples, multiplied by a gain."""
        window = self.window == 1 and not self.lag and not np.size(self.zeros) and not np.size(self.poles)
        coefficients = not self.window and self.lag == 1 and not np.size(self.poles)
        return window or (coefficients and np.size(self.zeros) == 1 and bool(np.all(np.equal(self.zeros, 0))))

    @property
    def degree(self) -> int:
        """The number of zeros, poles and delays; bounds the rate of change of the phase of F."""
        return self.window + abs(self.lag) + self.zeros.size + self.poles.size


class _Checked(Part):
    """Base of the estimates whose fields have ranges."""

    _owner = "velocity"


@dataclass(frozen=True, repr=False)
class BackwardDifference(_Checked):
    """``v = (x_k - x_(k-1))/T``, the default and the paper's.

    Args:
        coded_period: period in s by which the difference is divided; the period of the loop if left out.

    References:
        Hulin, Preusche, Hirzinger 2006, section II.
    """

    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """Return the estimate for a loop of this period, normalized."""
        return Estimate(window=1, gain=_ratio(period, self.coded_period))


@dataclass(frozen=True, repr=False)
class WindowedDifference(_Checked):
    """``v = (x_k - x_(k-n))/(n T)``, the mean velocity of the last n periods.

    Args:
        samples: n, from 1 (the backward difference) to 1000.
        coded_period: period in s in the formula; the period of the loop if left out.

    References:
        chai3d/chai3d ``src/devices/CGenericHapticDevice.cpp`` (15 ms), Force Dimension SDK ``dhdc.h`` (20 ms).
    """

    samples: int
    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """Return the estimate for a loop of this period, normalized."""
        return Estimate(window=self.samples, gain=_ratio(period, self.coded_period))


@dataclass(frozen=True, repr=False)
class LowPass(_Checked):
    """The backward difference, followed by one or two equal first-order low-passes: ``v <- p v + (1 - p) input``.

    ``p = exp(-T/tau)``, ``tau = 1/(2 pi cutoff)``; ``F = (1 - 1/z)/T ((1 - p) z/(z - p))^order``.

    Args:
        cutoff: in Hz, > 0 and below half the sampling rate; or
        time_constant: tau in s, > 0.
        order: 1 or 2.
        coded_period: period in s for which p and the difference are computed; the period of the loop if left out.

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
            got = "none of the two" if self.cutoff is None else "both"
            raise InputError(
                f"velocity: got {got}; give either cutoff (Hz) or time_constant (s) of a low-pass, and only one of them"
            )
        super().__post_init__()

    def estimate(self, period: Any) -> Estimate:
        """Return the estimate for a loop of this period, normalized."""
        coded = period if self.coded_period is None else self.coded_period
        if self.time_constant is None:
            check_cutoff(self.cutoff, coded)
            decay = 2.0 * _pi(coded) * self.cutoff * coded
        else:
            decay = coded / self.time_constant
        xp = namespace(decay)
        offset = -xp.expm1(-decay)
        poles = xp.stack([_as_complex(xp.asarray(offset))] * self.order)
        gain = offset**self.order * _ratio(period, self.coded_period)
        return Estimate(1, gain, -self.order, poles=poles)


@dataclass(frozen=True, repr=False)
class Butterworth(_Checked):
    """The backward difference, followed by a Butterworth low-pass, as `scipy.signal.butter` designs it.

    Args:
        cutoff: in Hz, > 0 and below half the sampling rate.
        order: 1 to 8.
        coded_period: period in s for which the filter was designed; the period of the loop if left out.

    References:
        mahilab/HapticPaddle ``src/main.cpp`` (order 4, 25 Hz at 1 kHz); Butterworth 1930, Wireless Engineer 7.
    """

    cutoff: Any
    order: int = 2
    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """Return the estimate for a loop of this period, normalized."""
        coded = period if self.coded_period is None else self.coded_period
        check_cutoff(self.cutoff, coded)
        # Bilinear transform s = (z - 1)/(z + 1), prewarped to keep the cut-off frequency; analog poles on a circle.
        xp = namespace(self.cutoff, coded)
        size = xp.tan(_pi(coded) * self.cutoff * coded)
        angles = _pi(coded) * (2.0 * np.arange(self.order) + 1.0 + self.order) / (2.0 * self.order)
        analog = size * xp.asarray(_unit_vectors(angles))
        offsets = -2.0 * analog / (1.0 - analog)
        gain = xp.prod(offsets).real * 0.5**self.order * _ratio(period, self.coded_period)
        return Estimate(1, gain, zeros=np.full(self.order, 2.0 + 0j), poles=offsets)


@dataclass(frozen=True, repr=False)
class VelocityFilter(Part):
    """Any linear estimate ``F(z) = numerator/denominator``, from position in m to velocity in m/s.

    Args:
        numerator: coefficients in 1/s, highest power first; or a list of sections in series, each with its
            coefficients.
        denominator: likewise. Its degree must be at least that of the numerator (a causal filter), and its poles must
            be inside the unit circle. Use sections for filters of high order, because the rounding errors of a single
            polynomial's coefficients move the poles.

    Example:
        >>> import zwidth
        >>> zwidth.VelocityFilter([1000, -1000], [1, 0]).estimate(1e-3).gain
        1.0
        >>> from scipy import signal
        >>> sos = signal.butter(8, 2, fs=1000, output="sos")
        >>> velocity = zwidth.VelocityFilter([[1000, -1000], *sos[:, :3]], [[1, 0], *sos[:, 3:]])
    """

    numerator: Any
    denominator: Any

    def __post_init__(self) -> None:
        for name in ("numerator", "denominator"):
            sections: tuple[Any, ...] = read_sections(name, getattr(self, name))
            (first, *others) = sections
            object.__setattr__(self, name, sections if others else first)
        top, bottom = (sum(len(section) - 1 for section in part) for part in self._sections)
        if top > bottom:
            raise InputError(
                f"velocity.numerator: its degree {top} exceeds that of the denominator, {bottom}, so the filter needs "
                "future samples; multiply the denominator by z"
            )
        self._check_poles()

    def _check_poles(self) -> None:
        """Raise `InputError` if a pole is on or outside the unit circle, with the likely cause."""
        poles = self._roots[1]
        largest = np.max(np.abs(1.0 - poles), initial=0.0)
        if largest < 1.0:
            return
        got = f"velocity.denominator: got a pole of magnitude {largest:.6g}; it must be below 1. "
        # A single pole at z = 1 is an integrator. Rounding errors of the coefficients move several poles near z = 1.
        slow = np.abs(poles) < NEXT_TO_ONE
        if np.sum(slow) != 1 and any(is_rounding(section) for section in self._sections[1]):
            cause = "Cause: rounding errors of the coefficients; use sections in series (scipy.signal: output='sos')"
        elif np.any(poles[slow] == 0):
            cause = "Integral action: model controller and sampled device in series as one LinearDevice (K = 1)"
        else:
            cause = "Check the coefficients: highest power first"
        raise InputError(got + cause)

    @property
    def _sections(self) -> tuple[Any, Any]:
        """The sections of the numerator and of the denominator, each a tuple of coefficients."""
        both: Any = self.numerator, self.denominator
        top, bottom = (part if isinstance(part[0], tuple) else (part,) for part in both)
        return top, bottom

    @cached_property
    def _roots(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Zeros and poles as 1 - z, without those at z = 0, and the number of poles minus zeros at z = 0."""
        found, trailing = [], []
        for part in self._sections:
            sections = [np.array(section) for section in part]
            trailing.append(sum(map(count_trailing_zeros, sections)))
            found.append(np.concatenate([offsets(np.trim_zeros(section, "b")) for section in sections]))
        return found[0], found[1], trailing[1] - trailing[0]

    def estimate(self, period: Any) -> Estimate:
        """Return the estimate for a loop of this period, normalized."""
        tops, bottoms = self._sections
        gain = period
        for section in tops:
            gain = section[0] * gain
        for section in bottoms:
            gain = gain / section[0]
        if hasattr(period, "mid"):
            # Compute the roots as balls from the exact coefficients, because rounded roots would lose exact zeros at
            # z = 1.
            exact = (np.concatenate([ball_offsets(section) for section in part]) for part in (tops, bottoms))
            return Estimate(0, gain, 0, *exact)
        zeros, poles, lag = self._roots
        return Estimate(0, gain, lag, zeros, poles)


@dataclass(frozen=True, repr=False)
class FOAW(_Checked):
    """First-order adaptive windowing, for simulations only: the estimate is nonlinear, so the loop has no poles.

    The estimate is the slope of the line from the oldest to the newest position of a window. The window is extended by
    one period at a time, up to ``samples``, until a position in it deviates from this line by more than ``noise``.

    Args:
        noise: largest error of a measured position in m, > 0; one count of an encoder.
        samples: longest window in periods, 1 to 64.

    References:
        Janabi-Sharifi, Hayward, Chen 2000, IEEE Trans. Control Systems Technology 8(6):1003-1009 (end-fit).
    """

    noise: Any
    samples: int = field(default=15, metadata={"allowed": Range(1, 64)})

    def estimate(self, period: Any) -> Estimate:
        """Raise `InputError`, because the estimate depends on the motion."""
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
"""Velocity estimates by their names in configurations and on the command line."""


def name_estimate(velocity: Velocity) -> str:
    """Return the name of the kind of an estimate in configurations."""
    for kind, part in ESTIMATES.items():
        if type(velocity) is part:
            return kind
    raise InputError(
        f"velocity: got {type(velocity).__name__}, which is not available in configurations; use one of "
        f"{', '.join(ESTIMATES)}"
    )


def is_plain(velocity: Velocity, period: Any) -> bool:
    """Return whether an estimate is the backward difference over the period of the loop, without any parameters."""
    if any(getattr(velocity, item.name) is not None for item in fields(velocity)):
        return False
    estimate = velocity.estimate(period)
    return estimate.window == 1 and estimate.is_difference and isinstance(estimate.gain, float) and estimate.gain == 1.0


def check_cutoff(cutoff: Any, period: Any) -> None:
    """Raise `InputError` if a cut-off frequency is not below the Nyquist frequency."""
    if is_jax(cutoff) or is_jax(period):
        return
    if cutoff * period >= 0.5:
        raise InputError(
            f"velocity.cutoff: got {cutoff:g} Hz; it must lie below half the sampling rate, {0.5 / period:g} Hz; "
            "lower it, or remove the filter"
        )


def _ratio(period: Any, coded: Any) -> Any:
    """Return the period of the loop divided by the coded period; 1 if no coded period is given."""
    return 1.0 if coded is None else period / coded


# The estimates are evaluated with floats, JAX arrays and balls of python-flint (``flint.arb``). The next functions
# provide operations that differ between these types.


def _pi(like: Any) -> Any:
    """Return pi as a number of the same type as the argument."""
    return like.pi() if hasattr(like, "pi") else np.pi


def _as_complex(value: Any) -> Any:
    """Return an array with complex dtype. Arrays of balls are returned unchanged, because balls convert themselves."""
    return value if value.dtype == object else value + 0j


def _unit_vectors(angles: np.ndarray) -> np.ndarray:
    """Return ``e^(j angle)`` for each angle."""
    if angles.dtype != object:
        return np.exp(1j * angles)
    import flint

    return np.array([flint.acb(angle.cos(), angle.sin()) for angle in angles])
