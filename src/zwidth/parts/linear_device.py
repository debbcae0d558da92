"""A device defined by a linear system from commanded force to sensed position."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from zwidth.parts.exact_polynomials import (
    Polynomial,
    characteristic_polynomial,
    divide,
    find_common_factor,
    find_roots,
    multiply,
    subtract,
    trim,
)
from zwidth.words.errors import InputError
from zwidth.words.formatting import short
from zwidth.words.unit_system import SYSTEMS, UnitSystem

_FORMS = (
    "(A, B, C), (numerator, denominator), (zeros, poles, gain), or a model of scipy.signal or python-control with one "
    "input and one output"
)


class RationalResponse(NamedTuple):
    """``numerator/denominator`` in s, or in z for a sampled system, with exact coefficients."""

    numerator: Polynomial
    denominator: Polynomial
    dt: float | None  # s


class WholeDevice:
    """Base of devices without bodies: defines the attributes of a `Device` that they do not have."""

    coupling: ClassVar[None] = None
    actuator: ClassVar[None] = None
    modes: ClassVar[tuple[()]] = ()
    rotary: bool = False
    # The response contains the damping.
    damping: ClassVar[float] = 0.0

    @property
    def unit_system(self) -> UnitSystem:
        """The units of the device."""
        return SYSTEMS[self.rotary]


@dataclass(frozen=True, repr=False)
class LinearDevice(WholeDevice):
    """A device defined by any strictly proper linear system from commanded force (N) to sensed position (m).

    All functions for walls accept it; its coefficients are taken as exact. Its bodies are unknown, so an operator,
    friction, initial values and energies need a `Device`. The stiffest wall and recommendations are restricted to
    B >= 0, because B < 0 would cancel modeled damping that the real device may not have. Walls with B < 0 are included
    in `Scene.max_stiffness` with ``negative_damping=True``.

    Args:
        system: matrices ``(A, B, C)``, coefficients ``(numerator, denominator)`` with the highest power first, as text
            too, "1 / 0.1 10 0", or ``(zeros, poles, gain)``; or a model of scipy.signal (lti, dlti) or python-control
            (TransferFunction, StateSpace). A sampled system, with ``dt`` equal to the period of the loop, includes hold
            and delay.

    Raises:
        InputError: the system is none of these, or it is not strictly proper.

    Example:
        >>> import zwidth
        >>> device = zwidth.LinearDevice(([1.0], [0.1, 10.0, 0.0]))
        >>> scene = zwidth.Scene(device, zwidth.Timing(period=1e-3, delay=1e-3))
        >>> print(f"{scene.max_stiffness().stiffness:.0f} N/m")
        19865 N/m
    """

    system: Any

    def __post_init__(self) -> None:
        if not isinstance(self.system, RationalResponse):
            object.__setattr__(self, "system", _read(self.system))

    def __repr__(self) -> str:
        """Return an expression that creates the device."""
        return f"LinearDevice({self.spell_form()!r})"

    def spell_form(self) -> str | dict[str, Any]:
        """Return the entry ``device`` of a configuration, with the coefficients in float64."""
        top, bottom = ([float(c) for c in part] for part in self.system[:2])
        if self.dt:
            return {"numerator": top, "denominator": bottom, "sampled": self.dt}
        return " / ".join(" ".join(map(short, part)) for part in (top, bottom))

    @property
    def dt(self) -> float | None:
        """The period of a sampled system, in s."""
        return self.system.dt

    def spell(self) -> str:
        """Return a one-line description of the system."""
        kind = "sampled" if self.dt else "continuous"
        return f"{kind} linear system of order {self.poles.size}, {self.zeros.size} finite zeros"

    @cached_property
    def zeros(self) -> np.ndarray:
        """The finite zeros, in rad/s or in z."""
        return find_roots(self.system.numerator)

    @cached_property
    def poles(self) -> np.ndarray:
        """The poles, in rad/s or in z."""
        return find_roots(self.system.denominator)

    @cached_property
    def offsets(self) -> tuple[np.ndarray, np.ndarray]:
        """``1 - z`` of the zeros and poles of a sampled system, with all digits of slow ones."""
        return find_roots(self.system.numerator, True), find_roots(self.system.denominator, True)

    @cached_property
    def gain(self) -> float:
        """Ratio of the leading coefficients of numerator and denominator."""
        return float(self.system.numerator[0] / self.system.denominator[0])

    @cached_property
    def mass(self) -> float:
        """A mass in kg with a response of similar magnitude, the unit of normalized parameters."""
        behind = self.poles.size - self.zeros.size
        if self.dt is None and behind == 2 and self.gain > 0:
            return 1.0 / self.gain
        moving = np.abs(self.poles)[np.abs(self.poles) > 0]
        w = float(np.exp(np.mean(np.log(moving)))) if moving.size else 1.0
        # Evaluate off the axis or circle on which undamped devices have poles.
        at, unit = (w * (0.3 + 1j), w) if self.dt is None else (0.3 + 1j, 1.0 / self.dt)
        size = abs(self.gain) * np.prod(np.abs(at - self.zeros)) / np.prod(np.abs(at - self.poles))
        return float(1.0 / (size * unit * unit))


def split_fraction(text: str) -> tuple[list[float], list[float]]:
    """Return the coefficients of ``NUMERATOR / DENOMINATOR``, separated by blanks or commas, highest power first."""
    try:
        top, bottom = ([float(c) for c in side.replace(",", " ").split()] for side in text.split("/"))
    except ValueError:
        raise InputError(
            f"device: got {text!r}; needed are coefficients in s, highest power first; write '1 / 0.1 10 0'"
        ) from None
    return top, bottom


def _read(given: Any) -> RationalResponse:
    """The exact response of a system in any form."""
    given = split_fraction(given) if isinstance(given, str) else given
    dt = getattr(given, "dt", None)
    if dt is True:
        raise InputError("device: got a sampled system without its period; give it dt, that of the loop, in s")
    try:
        top, bottom = _read_form(given)
    except (TypeError, ValueError, OverflowError, LookupError) as error:
        raise InputError(f"device: got {str(given)[:60]!r}; needed are finite numbers as {_FORMS}") from error
    if not top or len(bottom) < 2:
        raise InputError("device: got a system that a force does not move; check input and output")
    if len(top) >= len(bottom):
        raise InputError(
            f"device: got a numerator of degree {len(top) - 1} over a denominator of degree {len(bottom) - 1}; a force "
            "must not move the position at once, so the denominator's must be higher: add the lag that is missing"
        )
    _refuse_stuck(find_roots(find_common_factor(top, bottom)), "z" if dt else "s")
    return RationalResponse(top, bottom, float(dt) if dt else None)


def _refuse_stuck(roots: np.ndarray, letter: str) -> None:
    """Refuse matrices with a mode that no wall moves and that does not come to rest."""
    stuck = roots[(np.abs(roots) >= 1.0) if letter == "z" else (np.real(roots) >= 0.0)]
    for root in stuck.tolist():
        raise InputError(
            f"device: a mode of {letter} = {root if root.imag else root.real:.4g} is not moved by the force, or not "
            "seen in the position, so that with every wall it does not come to rest; leave it out of the matrices"
        )


def _read_form(given: Any) -> tuple[Polynomial, Polynomial]:
    """Return the numerator and denominator of a system given by matrices, coefficients or roots."""
    if hasattr(given, "A") and hasattr(given, "C"):
        given = (given.A, given.B, given.C, given.D)
    elif hasattr(given, "num") and hasattr(given, "den"):
        given = tuple(_take_channel(part) for part in (given.num, given.den))
    elif hasattr(given, "zeros") and hasattr(given, "gain"):
        given = (given.zeros, given.poles, given.gain)
    if len(given) == 2:
        return _reduce(*(trim(np.ravel(part)) for part in given))
    if np.ndim(given[0]) < 2:
        zeros, poles, gain = given
        return _reduce(multiply(_expand(zeros), trim([gain])), _expand(poles))
    A, B, C, *D = given
    size = len(A)
    if np.shape(A) != (size, size) or np.size(B) != size or np.size(C) != size or np.any(D):
        raise ValueError("matrices of one input and one output without feedthrough")
    dynamics, inputs, outputs = (_as_fractions(part) for part in (A, np.ravel(B), np.ravel(C)))
    bottom = characteristic_polynomial(dynamics)
    # The numerator C adj(s I - A) B is det(s I - A + B C) - det(s I - A), by the matrix determinant lemma.
    top = subtract(characteristic_polynomial(dynamics - np.outer(inputs, outputs)), bottom)
    return top, bottom


def _as_fractions(values: Any) -> np.ndarray:
    """Return an array of floats as exact fractions."""
    floats = np.asarray(values, float)
    return np.array([Fraction(value) for value in floats.ravel().tolist()], object).reshape(floats.shape)


def _expand(roots: Any) -> Polynomial:
    """Return the monic polynomial with the given roots; raise `ValueError` if a complex root has no conjugate."""
    values: Any = np.asarray(roots, complex).ravel()
    product: Polynomial = (Fraction(1),)
    for root in values[values.imag >= 0].tolist():
        real, imag = Fraction(root.real), Fraction(root.imag)
        if root.imag and np.sum(values == root.conjugate()) != np.sum(values == root):
            raise ValueError("a root without its conjugate")
        factor = (Fraction(1), -2 * real, real * real + imag * imag) if root.imag else (Fraction(1), -real)
        product = multiply(product, factor)
    if len(product) - 1 != values.size:
        raise ValueError("a root without its conjugate")
    return product


def _reduce(top: Polynomial, bottom: Polynomial) -> tuple[Polynomial, Polynomial]:
    """Return numerator and denominator without their common factors, because canceled modes do not affect the response.

    Sums of responses, for example, have common factors.
    """
    if not top or len(top) >= len(bottom):
        return top, bottom
    common = find_common_factor(top, bottom)
    return divide(top, common)[0], divide(bottom, common)[0]


def _take_channel(part: Any) -> Any:
    """Coefficients of the only input and output, which python-control nests."""
    while len(part) == 1 and np.ndim(part[0]) > 0:
        part = part[0]
    if np.ndim(part) != 1:
        raise ValueError("more than one channel")
    return part
