"""Velocity estimates: what a program makes of the sampled positions, and feeds to the wall's damper.

Each is ``F(z)`` from position in m to velocity in m/s, and says what the loop is to know of it: `Estimate`, for T = 1.
A filter's coded period is the one its formulas were written for. Where it is not the loop's, the difference is divided
by the wrong time and the cut-off lies elsewhere: that is what the loop then does, and what is computed here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from zwidth.parts.checks import Part
from zwidth.parts.circle import CirclePoints, Jet, lag_jet, product_jet
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
        """F and its derivative in w."""
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
        """By how much the estimate turns in all, a bound for how fast it varies."""
        return self.window + abs(self.lag) + self.zeros.size + self.poles.size


class _Checked(Part):
    """Base of the estimates that are given by their numbers."""

    _owner = "velocity"


@dataclass(frozen=True, repr=False)
class BackwardDifference(_Checked):
    """``v = (x_k - x_(k-1))/T``, the default and the paper's.

    Args:
        coded_period: the period the difference is divided by, in s; the loop's where left out.

    References:
        Hulin, Preusche, Hirzinger 2006, section II.
    """

    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """The estimate for a loop of this period, normalized."""
        return Estimate(window=1, gain=_ratio(period, self.coded_period))


@dataclass(frozen=True, repr=False)
class WindowedDifference(_Checked):
    """``v = (x_k - x_(k-n))/(n T)``, the mean velocity of the last n periods.

    Args:
        samples: n, from 1 (the backward difference) to 1000.
        coded_period: the period in the formula, in s; the loop's where left out.

    References:
        chai3d/chai3d ``src/devices/CGenericHapticDevice.cpp`` (15 ms), Force Dimension SDK ``dhdc.h`` (20 ms).
    """

    samples: int
    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """The estimate for a loop of this period, normalized."""
        return Estimate(window=self.samples, gain=_ratio(period, self.coded_period))


@dataclass(frozen=True, repr=False)
class LowPass(_Checked):
    """The backward difference behind one or two equal first-order low-passes: ``v <- p v + (1 - p) input`` each.

    ``p = exp(-T/tau)``, ``tau = 1/(2 pi cutoff)``; ``F = (1 - 1/z)/T ((1 - p) z/(z - p))^order``.

    Args:
        cutoff: in Hz, > 0 and at most half the sampling rate; or
        time_constant: tau in s, > 0.
        order: 1 or 2.
        coded_period: the period that p and the difference were written for, in s; the loop's where left out.

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
        """The estimate for a loop of this period, normalized."""
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
    """The backward difference behind a Butterworth low-pass, as `scipy.signal.butter` designs it.

    Args:
        cutoff: in Hz, > 0 and below half the sampling rate.
        order: 1 to 8.
        coded_period: the period it was designed for, in s; the loop's where left out.

    References:
        mahilab/HapticPaddle ``src/main.cpp`` (order 4, 25 Hz at 1 kHz); Butterworth 1930, Wireless Engineer 7.
    """

    cutoff: Any
    order: int = 2
    coded_period: Any = None

    def estimate(self, period: Any) -> Estimate:
        """The estimate for a loop of this period, normalized."""
        coded = period if self.coded_period is None else self.coded_period
        check_cutoff(self.cutoff, coded)
        # The bilinear transform, warped so that the cut-off stays: s = (z - 1)/(z + 1), poles on a circle.
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
            sections: tuple[Any, ...] = _read_sections(name, getattr(self, name))
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
        slow = np.abs(poles) < _NEXT_TO_ONE
        if np.sum(slow) != 1 and any(_is_rounding(section) for section in self._sections[1]):
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
        """Zeros and poles by their offsets from 1, and by how many powers of z the denominator exceeds both."""
        found, trailing = [], []
        for part in self._sections:
            sections = [np.array(section) for section in part]
            trailing.append(sum(map(_trailing, sections)))
            found.append(np.concatenate([_offsets(np.trim_zeros(section, "b")) for section in sections]))
        return found[0], found[1], trailing[1] - trailing[0]

    def estimate(self, period: Any) -> Estimate:
        """The estimate for a loop of this period, normalized."""
        tops, bottoms = self._sections
        gain = period
        for section in tops:
            gain = section[0] * gain
        for section in bottoms:
            gain = gain / section[0]
        if hasattr(period, "mid"):
            # Compute the roots as balls from the exact coefficients, because rounded roots would lose exact zeros at
            # z = 1.
            exact = (np.concatenate([_ball_offsets(section) for section in part]) for part in (tops, bottoms))
            return Estimate(0, gain, 0, *exact)
        zeros, poles, lag = self._roots
        return Estimate(0, gain, lag, zeros, poles)


@dataclass(frozen=True, repr=False)
class FOAW(_Checked):
    """First-order adaptive windowing, for simulations: it has no linear form and no answer to questions of stability.

    The slope over the longest window, up to ``samples`` periods, whose straight line from its oldest to its newest
    position misses none between by more than ``noise``.

    Args:
        noise: the largest error of a measured position in m, > 0: one count of an encoder.
        samples: the longest window in periods, 1 to 64.

    References:
        Janabi-Sharifi, Hayward, Chen 2000, IEEE Trans. Control Systems Technology 8(6):1003-1009 (end-fit).
    """

    noise: Any
    samples: int = field(default=15, metadata={"allowed": Range(1, 64)})

    def estimate(self, period: Any) -> Estimate:
        """Refused: what it answers hangs on the motion."""
        raise InputError(
            "velocity: FOAW has no linear form, so that a wall with it has no poles and no boundary; simulate it, or "
            "ask with a linear estimate such as zwidth.WindowedDifference"
        )


Velocity: TypeAlias = BackwardDifference | WindowedDifference | LowPass | Butterworth | VelocityFilter | FOAW
# By what configurations and the command line call them.
ESTIMATES = {
    "backward_difference": BackwardDifference,
    "windowed_difference": WindowedDifference,
    "low_pass": LowPass,
    "butterworth": Butterworth,
    "filter": VelocityFilter,
    "foaw": FOAW,
}


def name_estimate(velocity: Velocity) -> str:
    """What configurations call the kind of an estimate."""
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
    """Refuse a cut-off that a filter of this period cannot have."""
    if is_jax(cutoff) or is_jax(period):
        return
    if cutoff * period >= 0.5:
        raise InputError(
            f"velocity.cutoff: got {cutoff:g} Hz; it must lie below half the sampling rate, {0.5 / period:g} Hz here; "
            "a filter that high does nothing, leave it out"
        )


def _ratio(period: Any, coded: Any) -> Any:
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


def _ball_offsets(coefficients: tuple[Any, ...]) -> np.ndarray:
    """Return 1 - root for the roots of a polynomial with exact coefficients, as balls."""
    import flint

    exact = flint.fmpq_poly([flint.arb(value).fmpq() for value in reversed(coefficients)])
    found: Any = exact(flint.fmpq_poly([1, -1])).numer().complex_roots()
    return np.array([flint.acb(root) for root, times in found for _ in range(times)], object)


_NEXT_TO_ONE = 1e-2  # largest distance from z = 1 of poles that rounding errors of the coefficients can move there


def _read_sections(name: str, given: Any) -> tuple[tuple[float, ...], ...]:
    """Return the coefficients of the sections without leading zeros; raise `InputError` for other values.

    Args:
        name: "numerator" or "denominator", for messages.
        given: coefficients of one polynomial, or a list of sections with their coefficients.
    """
    try:
        rows = list(given) if np.ndim(given) or any(map(np.ndim, given)) else [given]
    except ValueError:
        # NumPy raises this error for sections of different lengths.
        rows = list(given)
    except TypeError:
        rows = [given]
    nested = any(np.ndim(row) for row in rows)
    sections = []
    for row in rows if nested else [rows]:
        try:
            values = np.atleast_1d(np.asarray(row, float))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"velocity.{name}: got {given!r}; it must be a list of real coefficients") from error
        values = np.trim_zeros(values, "f") if values.ndim == 1 else values
        if values.ndim != 1 or not values.size or not np.all(np.isfinite(values)):
            raise InputError(
                f"velocity.{name}: got {given!r}; it must be a list of finite coefficients, highest power first, not "
                "all 0"
            )
        sections.append(tuple(values.tolist()))
    return tuple(sections)


def _is_rounding(coefficients: tuple[float, ...]) -> bool:
    """Return whether rounding errors of the coefficients alone can explain the roots on or outside the unit circle."""
    roots = 1.0 - _offsets(np.trim_zeros(np.array(coefficients), "b"))
    on = np.exp(1j * np.angle(roots[np.abs(roots) >= 1.0]))
    # If the polynomial is this small at a point of the circle, another one whose coefficients differ only by rounding
    # errors has a root exactly there.
    noise = 4.0 * len(coefficients) * np.finfo(float).eps * np.abs(coefficients).sum()
    return bool(on.size and len(coefficients) > 2 and np.all(np.abs(np.polyval(coefficients, on)) <= noise))


def _trailing(polynomial: np.ndarray) -> int:
    return polynomial.size - int(np.flatnonzero(polynomial)[-1]) - 1


def _offsets(polynomial: np.ndarray) -> np.ndarray:
    """Roots by their offsets from 1, found in powers of z - 1: next to 1 they keep their digits."""
    if polynomial.size < 2:
        return np.zeros(0, complex)
    shifted = np.polynomial.polynomial.Polynomial(polynomial[::-1])(
        np.polynomial.polynomial.Polynomial([1.0, 1.0])
    ).coef
    scale = np.abs(polynomial).sum()
    shifted = np.where(np.abs(shifted) <= 4 * polynomial.size * np.finfo(float).eps * scale, 0.0, shifted)
    return -np.polynomial.polynomial.polyroots(shifted) + 0j
