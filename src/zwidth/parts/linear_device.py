"""A device that is given as a linear system: what a force moves the sensed position by."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from math import lcm
from typing import Any, ClassVar, NamedTuple, TypeAlias

import numpy as np

from zwidth.words.errors import InputError
from zwidth.words.formatting import short

Polynomial: TypeAlias = tuple[Fraction, ...]
"""Exact coefficients, highest power first."""

_FORMS = (
    "(A, B, C), (numerator, denominator), (zeros, poles, gain), or a model of scipy.signal or python-control with one "
    "input and one output"
)


class RationalResponse(NamedTuple):
    """``numerator/denominator`` in s, or in z where it is sampled; exact, with the roots to float64."""

    numerator: Polynomial
    denominator: Polynomial
    dt: float | None  # s


class WholeDevice:
    """Base of devices that are given as a whole: what a `Device` has beside its mass, and no body of these has."""

    coupling: ClassVar[None] = None
    actuator: ClassVar[None] = None
    modes: ClassVar[tuple[()]] = ()
    rotary: bool = False
    # What damping there is stands in the response.
    damping: ClassVar[float] = 0.0


@dataclass(frozen=True, repr=False)
class LinearDevice(WholeDevice):
    """A device as any strictly proper linear system from commanded force (N) to sensed position (m).

    Every question about walls is answered of it; its numbers are taken as exact. Nothing is known of bodies: a hand,
    friction, starts and energies of motions are for `Device`.

    Args:
        system: matrices ``(A, B, C)``, coefficients ``(numerator, denominator)`` with the highest power first, as text
            too, "1 / 0.1 10 0", or ``(zeros, poles, gain)``; or a model of scipy.signal (lti, dlti) or python-control
            (TransferFunction, StateSpace). One that is sampled, with ``dt`` the period of the loop, has hold and delay
            inside.

    Raises:
        InputError: the system is none of these, or the force would move the position at once.

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
        """As configurations have it."""
        return f"LinearDevice({self.spell_form()!r})"

    def spell_form(self) -> str | dict[str, Any]:
        """What configurations have under ``device``: coefficients to float64."""
        top, bottom = ([float(c) for c in part] for part in self.system[:2])
        if self.dt:
            return {"numerator": top, "denominator": bottom, "sampled": self.dt}
        return " / ".join(" ".join(map(short, part)) for part in (top, bottom))

    @property
    def dt(self) -> float | None:
        """The period of a sampled system, in s."""
        return self.system.dt

    def spell(self) -> str:
        """What it is, in words."""
        kind = "sampled" if self.dt else "continuous"
        return f"{kind} linear system of order {self.poles.size}, {self.zeros.size} finite zeros"

    @cached_property
    def zeros(self) -> np.ndarray:
        """Its finite zeros, in rad/s or in z."""
        return find_roots(self.system.numerator)

    @cached_property
    def poles(self) -> np.ndarray:
        """Its poles, in rad/s or in z."""
        return find_roots(self.system.denominator)

    @cached_property
    def offsets(self) -> tuple[np.ndarray, np.ndarray]:
        """``1 - z`` of the zeros and poles of a sampled system, which keeps the digits of slow ones."""
        return find_roots(self.system.numerator, True), find_roots(self.system.denominator, True)

    @cached_property
    def gain(self) -> float:
        """Of the highest powers."""
        return float(self.system.numerator[0] / self.system.denominator[0])

    @cached_property
    def mass(self) -> float:
        """A mass of about the same answer, in kg, in which normalized numbers are counted."""
        behind = self.poles.size - self.zeros.size
        if self.dt is None and behind == 2 and self.gain > 0:
            return 1.0 / self.gain
        moving = np.abs(self.poles)[np.abs(self.poles) > 0]
        w = float(np.exp(np.mean(np.log(moving)))) if moving.size else 1.0
        # Beside the poles of undamped devices.
        at, unit = (w * (0.3 + 1j), w) if self.dt is None else (0.3 + 1j, 1.0 / self.dt)
        size = abs(self.gain) * np.prod(np.abs(at - self.zeros)) / np.prod(np.abs(at - self.poles))
        return float(1.0 / (size * unit * unit))


def split_fraction(text: str) -> tuple[list[float], list[float]]:
    """The coefficients of ``NUMERATOR / DENOMINATOR``, each separated by blanks or commas, highest power first."""
    try:
        top, bottom = ([float(c) for c in side.replace(",", " ").split()] for side in text.split("/"))
    except ValueError:
        raise InputError(
            f"device: got {text!r}; needed are coefficients in s, highest power first; write '1 / 0.1 10 0'"
        ) from None
    return top, bottom


def _read(given: Any) -> RationalResponse:
    """The exact response of a system in any form."""
    try:
        import flint
    except ImportError as error:
        raise InputError("device: a LinearDevice needs python-flint; pip install 'zwidth[certified]'") from error
    given = split_fraction(given) if isinstance(given, str) else given
    dt = getattr(given, "dt", None)
    if dt is True:
        raise InputError("device: got a sampled system without its period; give it dt, that of the loop, in s")
    try:
        top, bottom = _read_form(given, flint)
    except (TypeError, ValueError, OverflowError, LookupError) as error:
        raise InputError(f"device: got {str(given)[:60]!r}; needed are finite numbers as {_FORMS}") from error
    if not top or bottom.degree() < 1:
        raise InputError("device: got a system that a force does not move; check input and output")
    if top.degree() >= bottom.degree():
        raise InputError(
            f"device: got a numerator of degree {top.degree()} over a denominator of degree {bottom.degree()}; a force "
            "must not move the position at once, so the denominator's must be higher: add the lag that is missing"
        )
    parts = (top, bottom, top.gcd(bottom))
    first, second, common = (tuple(Fraction(int(c.p), int(c.q)) for c in reversed(part.coeffs())) for part in parts)
    _refuse_stuck(find_roots(common), "z" if dt else "s")
    return RationalResponse(first, second, float(dt) if dt else None)


def _refuse_stuck(roots: np.ndarray, letter: str) -> None:
    """Refuse matrices with a mode that no wall moves and that does not come to rest."""
    stuck = roots[(np.abs(roots) >= 1.0) if letter == "z" else (np.real(roots) >= 0.0)]
    for root in stuck.tolist():
        raise InputError(
            f"device: a mode of {letter} = {root if root.imag else root.real:.4g} is not moved by the force, or not "
            "seen in the position, so that with every wall it does not come to rest; leave it out of the matrices"
        )


def _read_form(given: Any, flint: Any) -> tuple[Any, Any]:
    """Numerator and denominator of matrices, coefficients or roots, as polynomials of exact numbers."""
    if hasattr(given, "A") and hasattr(given, "C"):
        given = (given.A, given.B, given.C, given.D)
    elif hasattr(given, "num") and hasattr(given, "den"):
        given = tuple(_take_channel(part) for part in (given.num, given.den))
    elif hasattr(given, "zeros") and hasattr(given, "gain"):
        given = (given.zeros, given.poles, given.gain)

    def exact(value: Any) -> Any:
        return flint.fmpq(*float(value).as_integer_ratio())

    def expand(roots: Any) -> Any:
        """The monic polynomial of real roots and conjugate pairs."""
        known: Any = np.asarray(roots, complex).ravel()
        found = flint.fmpq_poly([1])
        for root in known[known.imag >= 0].tolist():
            real, imag = exact(root.real), exact(root.imag)
            if root.imag and np.sum(known == root.conjugate()) != np.sum(known == root):
                raise ValueError("a root without its conjugate")
            found *= flint.fmpq_poly([real * real + imag * imag, -2 * real, 1] if root.imag else [-real, 1])
        if found.degree() != known.size:
            raise ValueError("a root without its conjugate")
        return found

    def reduce(top: Any, bottom: Any) -> tuple[Any, Any]:
        """Without common factors, as sums of responses have them: a response knows of no hidden motion."""
        common = top.gcd(bottom) if top.degree() < bottom.degree() else 1
        return top // common, bottom // common

    if len(given) == 2:
        top, bottom = (flint.fmpq_poly([exact(c) for c in np.ravel(part)[::-1]]) for part in given)
        return reduce(top, bottom)
    if np.ndim(given[0]) < 2:
        zeros, poles, gain = given
        return reduce(expand(zeros) * exact(gain), expand(poles))
    A, B, C, *D = given
    size = len(A)
    if np.shape(A) != (size, size) or np.size(B) != size or np.size(C) != size or np.any(D):
        raise ValueError("matrices of one input and one output without feedthrough")
    rate = flint.fmpq_mat([[exact(value) for value in row] for row in np.asarray(A, float)])
    outer = flint.fmpq_mat([[exact(b) * exact(c) for c in np.ravel(C)] for b in np.ravel(B)])
    bottom = rate.charpoly()
    # C adj(s - A) B by the lemma of the determinant.
    return (rate - outer).charpoly() - bottom, bottom


def _take_channel(part: Any) -> Any:
    """Coefficients of the only input and output, which python-control nests."""
    while len(part) == 1 and np.ndim(part[0]) > 0:
        part = part[0]
    if np.ndim(part) != 1:
        raise ValueError("more than one channel")
    return part


def find_roots(polynomial: Polynomial, offsets: bool = False) -> np.ndarray:
    """All roots to the last digits, or 1 less each of them; equal ones as often as they are there."""
    import flint

    scale = lcm(*(value.denominator for value in polynomial))
    whole = flint.fmpz_poly([int(value * scale) for value in reversed(polynomial)])
    if offsets:
        whole = whole(flint.fmpz_poly([1, -1]))
    with flint.ctx.workprec(128):
        found: Any = whole.complex_roots()
        return np.array([complex(root) for root, times in found for _ in range(times)], complex)
