"""Device defined by a linear system from commanded force to measured position.

The system may be given by matrices, coefficients or roots, or as a model of scipy.signal or python-control. It is
stored as a rational function with exact coefficients, from which poles and zeros are computed to full accuracy.
"""

from __future__ import annotations

from dataclasses import InitVar, dataclass
from fractions import Fraction
from functools import cached_property, reduce
from typing import Any, ClassVar, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.pytrees import register
from zwidth.model.checks import check_number
from zwidth.model.exact_polynomials import (
    Polynomial,
    characteristic_polynomial,
    divide,
    find_common_factor,
    find_roots,
    multiply,
    subtract,
    trim,
)
from zwidth.model.system_forms import pair_roots, parse_system, read_roots, read_sos
from zwidth.units.formatting import short
from zwidth.units.quantities import POSITIVE
from zwidth.units.unit_system import SYSTEMS, UnitSystem

# Accepted forms of a system, for messages.
_FORMS = (
    "(A, B, C), (numerator, denominator), (zeros, poles, gain), {'sos': sections}, or a model of scipy.signal or "
    "python-control with one input and one output"
)
# Limits for a warning that the coefficients of a device given in s were probably meant in z. If so, no pole is far
# outside the unit circle, and the mass of the device causes a pole near 1.
NEAR_CIRCLE = 0.05  # largest distance of a pole outside the unit circle from the circle
NEAR_ONE = 0.1  # largest distance of the nearest pole from 1
SLOWEST_PERIOD = 0.05  # s; in loops with longer periods, devices with poles of 1 rad/s are plausible


class RationalResponse(NamedTuple):
    """Transfer function ``numerator/denominator`` in s, or in z for a discrete-time system, with exact coefficients."""

    numerator: Polynomial
    denominator: Polynomial
    dt: float | None  # sampling period in s; None for a continuous-time system


class ResponseDevice:
    """Base class of devices that are defined by their response only, without masses, coupling, actuator and modes."""

    coupling: ClassVar[None] = None
    actuator: ClassVar[None] = None
    modes: ClassVar[tuple[()]] = ()
    rotary: bool = False
    # True if the device is an admittance display: K and B of a scene are then those of its environment.
    is_display: bool = False
    # The damping is 0, because the response already includes the physical damping.
    damping: ClassVar[float] = 0.0

    def __init_subclass__(cls) -> None:
        """Register the class as a node of JAX pytrees."""
        register(cls)

    def _flatten(self) -> tuple[tuple[tuple[str, Any], ...], Any]:
        """Return no children and the device itself as its structure, because its exact coefficients are constant."""
        return (), self

    @classmethod
    def _unflatten(cls, structure: Any, children: Any) -> Any:
        """Return the device, which is its own structure."""
        return structure

    @property
    def unit_system(self) -> UnitSystem:
        """The units of the device, linear or rotary."""
        return SYSTEMS[self.rotary]


@dataclass(frozen=True, repr=False)
class LinearDevice(ResponseDevice):
    """A device defined by any strictly proper linear system from commanded force (N) to measured position (m).

    The coefficients are taken as exact. All functions for walls accept such a device. An operator, friction, initial
    values and energies require a `Device`, because the masses of a linear system are unknown. Stiffest walls and
    recommendations are restricted to B >= 0, because B < 0 would cancel modeled damping that the real device may not
    have; `Scene.max_stiffness` includes B < 0 with ``negative_damping=True``.

    Args:
        system: matrices ``(A, B, C)``; coefficients ``(numerator, denominator)`` with the highest power first; roots
            ``(zeros, poles, gain)``; a dict with the keys of a configuration, such as ``{"sos": sections}`` for
            second-order sections; a string, "1 / 0.1 10 0", "zpk: / 0 -100 / 10" or "sos: b0 b1 b2 a0 a1 a2; ..."; or a
            model of scipy.signal (lti, dlti) or python-control (TransferFunction, StateSpace).
        sampled: sampling period of a discrete-time system in s, which must equal the period of the loop. A
            discrete-time system must include hold and delay. Default: the period of ``system``, if it has one;
            otherwise the system is continuous-time.
        rotary: True for a system from torque (N m) to angle (rad); walls are then in N m/rad and N m s/rad.

    Raises:
        InputError: the system has none of these forms, or it is not strictly proper.

    Example:
        >>> import zwidth
        >>> device = zwidth.LinearDevice(([1.0], [0.1, 10.0, 0.0]))
        >>> scene = zwidth.Scene(device, zwidth.Timing(period=1e-3, delay=1e-3))
        >>> print(f"{scene.max_stiffness().stiffness:.0f} N/m")
        19865 N/m
        >>> zwidth.LinearDevice("25e-5 0 / 1 -2 1", sampled="5 ms").poles.real
        array([1., 1.])
    """

    system: Any
    sampled: InitVar[Any] = None
    rotary: bool = False

    def __post_init__(self, sampled: Any) -> None:
        if not isinstance(self.system, RationalResponse):
            object.__setattr__(self, "system", _read(self.system, sampled))

    def __repr__(self) -> str:
        """Return the expression that creates the device."""
        return f"LinearDevice({self.spell_form()!r}{', rotary=True' if self.rotary else ''})"

    def spell_form(self) -> str | dict[str, Any]:
        """Return the value of the key ``device`` of a configuration, with the coefficients rounded to float64."""
        numerator, denominator = ([float(c) for c in part] for part in self.system[:2])
        if self.dt:
            return {"numerator": numerator, "denominator": denominator, "sampled": self.dt}
        return " / ".join(" ".join(map(short, part)) for part in (numerator, denominator))

    @property
    def dt(self) -> float | None:
        """The sampling period of a discrete-time system in s; None for a continuous-time system."""
        return self.system.dt

    def spell(self) -> str:
        """Return a one-line description of the system."""
        kind = "sampled" if self.dt else "continuous"
        return f"{kind} linear system of order {self.poles.size}, {self.zeros.size} finite zeros"

    @cached_property
    def zeros(self) -> np.ndarray:
        """The finite zeros, in s (rad/s) or in z."""
        return find_roots(self.system.numerator)

    @cached_property
    def poles(self) -> np.ndarray:
        """The poles, in s (rad/s) or in z."""
        return find_roots(self.system.denominator)

    @cached_property
    def offsets(self) -> tuple[np.ndarray, np.ndarray]:
        """``1 - z`` for the zeros and for the poles of a discrete-time system, accurate for roots near z = 1."""
        return find_roots(self.system.numerator, True), find_roots(self.system.denominator, True)

    @cached_property
    def gain(self) -> float:
        """The ratio of the leading coefficients of numerator and denominator."""
        return float(self.system.numerator[0] / self.system.denominator[0])

    @cached_property
    def mass(self) -> float:
        """The unit of mass of normalized parameters in kg: a mass with about the same response as the device."""
        relative_degree = self.poles.size - self.zeros.size
        if self.dt is None and relative_degree == 2 and self.gain > 0:
            return 1.0 / self.gain
        magnitudes = np.abs(self.poles)[np.abs(self.poles) > 0]
        w = float(np.exp(np.mean(np.log(magnitudes)))) if magnitudes.size else 1.0
        # Evaluate the response at a point off the imaginary axis (off the unit circle in discrete time), because
        # undamped devices have poles there.
        point, unit = (w * (0.3 + 1j), w) if self.dt is None else (0.3 + 1j, 1.0 / self.dt)
        size = abs(self.gain) * np.prod(np.abs(point - self.zeros)) / np.prod(np.abs(point - self.poles))
        return float(1.0 / (size * unit * unit))

    def warn_of_variable(self, period: float) -> str:
        """Return a warning if the coefficients were given in s, but probably meant in z; otherwise return "".

        The warning is returned if no pole is far outside the unit circle, if one pole is near 1, and if the sampling
        period is so short that poles of about 1 rad/s are implausibly slow. ``period`` is the sampling period in s.
        """
        size, distance = np.abs(self.poles).max(), np.abs(self.poles - 1.0).min()
        if self.dt or size > 1.0 + NEAR_CIRCLE or distance > NEAR_ONE or period > SLOWEST_PERIOD:
            return ""
        return f"got poles of at most {size:.3g} rad/s, near the unit circle; if the coefficients are in z,"


def _read(given: Any, sampled: Any) -> RationalResponse:
    """Convert a system in any accepted form to an exact transfer function; raise `InputError` for other values.

    ``sampled`` is the sampling period of a discrete-time system. It is None for a continuous-time system, or if
    ``given`` contains the sampling period.
    """
    given = parse_system("device", given, "s" if sampled is None else "z") if isinstance(given, str) else given
    dt = getattr(given, "dt", None)
    if isinstance(given, dict):
        given, dt = dict(given), given.get("sampled")
        given.pop("sampled", None)
    if sampled is not None:
        period = check_number("sampled", sampled, "s", POSITIVE)
        if dt and dt is not True and dt != period:
            raise InputError(f"sampled: got {period:g} s for a system with dt = {dt:g} s; remove one of them")
        dt = period
    if dt is True:
        raise InputError("device: got a sampled system without its period; set dt to the period of the loop in s")
    dt = None if dt is None or dt == 0 else check_number("sampled", dt, "s", POSITIVE)
    try:
        numerator, denominator = _read_form(given)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError, LookupError) as error:
        raise InputError(f"device: got {str(given)[:60]!r}; it must be finite numbers as {_FORMS}") from error
    if not numerator or len(denominator) < 2:
        raise InputError("device: got a system whose position does not depend on the force; check input and output")
    if len(numerator) >= len(denominator):
        raise InputError(
            f"device: got a numerator of degree {len(numerator) - 1} over one of degree {len(denominator) - 1}; "
            "the denominator must have the higher degree; add the missing dynamics"
        )
    _reject_unstable_hidden_modes(find_roots(find_common_factor(numerator, denominator)), "z" if dt else "s")
    return RationalResponse(numerator, denominator, dt)


def _reject_unstable_hidden_modes(roots: np.ndarray, letter: str) -> None:
    """Raise `InputError` if a canceled mode is not asymptotically stable, because no wall can stabilize it.

    Args:
        roots: common roots of numerator and denominator, which are uncontrollable or unobservable modes.
        letter: "s" or "z", the variable of the roots.
    """
    unstable = roots[(np.abs(roots) >= 1.0) if letter == "z" else (np.real(roots) >= 0.0)]
    for root in unstable.tolist():
        raise InputError(
            f"device: the mode {letter} = {root if root.imag else root.real:.4g} does not decay and is uncontrollable "
            "or unobservable, so no wall is stable; remove it from the matrices"
        )


def _read_form(given: Any) -> tuple[Polynomial, Polynomial]:
    """Return the exact numerator and denominator of a system that is given by matrices, coefficients or roots."""
    if isinstance(given, dict):
        given = _read_keys(given)
    elif hasattr(given, "A") and hasattr(given, "C"):
        given = (given.A, given.B, given.C, given.D)
    elif hasattr(given, "num") and hasattr(given, "den"):
        given = tuple(_take_channel(part) for part in (given.num, given.den))
    elif hasattr(given, "zeros") and hasattr(given, "gain"):
        given = (given.zeros, given.poles, given.gain)
    if isinstance(given, np.ndarray) and given.shape == (2, 6):
        raise InputError(
            "device: got an array of shape (2, 6), which may be two sections or two polynomials; write {'sos': array} "
            "or (numerator, denominator)"
        )
    if len(given) == 2:
        return _reduce(*(trim(np.ravel(part)) for part in given))
    if np.ndim(given[0]) < 2:
        zeros, poles, gain = given
        return _reduce(multiply(_expand(zeros), trim(np.ravel(gain))), _expand(poles))
    A, B, C, *D = given
    size = len(A)
    if np.shape(A) != (size, size) or np.size(B) != size or np.size(C) != size or np.any(D):
        raise ValueError("matrices of one input and one output without feedthrough")
    dynamics, inputs, outputs = (_as_fractions(part) for part in (A, np.ravel(B), np.ravel(C)))
    denominator = characteristic_polynomial(dynamics)
    # The numerator C adj(s I - A) B is det(s I - A + B C) - det(s I - A), by the matrix determinant lemma.
    numerator = subtract(characteristic_polynomial(dynamics - np.outer(inputs, outputs)), denominator)
    return numerator, denominator


def _read_keys(given: dict[str, Any]) -> tuple[Any, ...]:
    """Convert a system from a dict with the keys of a configuration to a tuple of coefficients, roots or matrices."""
    keys = set(given)
    if keys == {"sos"}:
        # Multiply the sections exactly, because rounding errors of the products would move the roots.
        rows = read_sos("device.sos", given["sos"])
        numerator, denominator = (reduce(multiply, map(trim, rows[:, part])) for part in (slice(3), slice(3, 6)))
        return numerator, denominator
    for form in (("numerator", "denominator"), ("zeros", "poles", "gain"), ("A", "B", "C")):
        if set(form) - {"zeros"} <= keys <= set(form):
            return tuple(given.get(name, ()) for name in form)
    raise ValueError("unknown keys")


def _as_fractions(values: Any) -> np.ndarray:
    """Convert an array of floats to exact fractions."""
    floats = np.asarray(values, float)
    return np.array([Fraction(value) for value in floats.ravel().tolist()], object).reshape(floats.shape)


def _expand(roots: Any) -> Polynomial:
    """Return the monic polynomial with the given roots; raise `ValueError` if a complex root has no conjugate."""
    return reduce(multiply, pair_roots(read_roots(roots)), (Fraction(1),))


def _reduce(numerator: Polynomial, denominator: Polynomial) -> tuple[Polynomial, Polynomial]:
    """Return numerator and denominator divided by their greatest common divisor.

    For example, the sum of two transfer functions with the same integrator has a common factor s.
    """
    if not numerator or len(numerator) >= len(denominator):
        return numerator, denominator
    common = find_common_factor(numerator, denominator)
    return divide(numerator, common)[0], divide(denominator, common)[0]


def _take_channel(part: Any) -> Any:
    """Return the coefficients of a system with one input and one output from the nested lists of python-control."""
    while len(part) == 1 and np.ndim(part[0]) > 0:
        part = part[0]
    if np.ndim(part) != 1:
        raise ValueError("more than one channel")
    return part
