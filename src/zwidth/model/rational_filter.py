"""Filters given by a transfer function in z: its coefficients, second-order sections, or zeros, poles and gain.

Numerator and denominator are products of *sections*, polynomials in z. Roots are computed as *offsets* ``1 - root``.
`RationalFilter` is the base class of velocity filters, position filters and further feedback.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from zwidth.core.errors import InputError
from zwidth.model.checks import Part
from zwidth.model.estimate import Estimate
from zwidth.model.filter_sections import (
    NEXT_TO_ONE,
    ball_offsets,
    count_trailing_zeros,
    is_rounding,
    offsets,
    read_sections,
)
from zwidth.model.system_forms import pair_roots, read_roots, read_sos


@dataclass(frozen=True, repr=False)
class RationalFilter(Part):
    """Base class of filters that are given by their transfer function, as coefficients, sections or roots.

    If several forms are given, the transfer function is their product, for example numerator/denominator times the
    filter with the sections ``sos``.

    Args:
        numerator: coefficients, highest power of z first; or a list of sections in series, each a list of coefficients.
        denominator: coefficients or sections, as for the numerator. The filter must be causal: the total degree of all
            denominators must be at least that of all numerators. Use sections or roots for a filter of high order,
            because rounding errors in the coefficients of a single polynomial move its poles.
        sos: second-order sections, rows of the coefficients b0 b1 b2 a0 a1 a2, as returned by scipy.signal with
            ``output="sos"``.
        zeros: zeros in z; complex zeros together with their conjugates. Default: none, if ``poles`` is given.
        poles: poles in z, in the same form as the zeros; requires ``gain``.
        gain: leading coefficient of the numerator divided by that of the denominator; requires ``poles``.
    """

    _owner = "velocity"
    _poles_inside: ClassVar[bool] = True  # True if all poles must be inside the unit circle

    numerator: Any = None
    denominator: Any = None
    sos: Any = None
    zeros: Any = None
    poles: Any = None
    gain: Any = None

    def __post_init__(self) -> None:
        self._combine_forms()
        for name in ("numerator", "denominator"):
            sections: tuple[Any, ...] = read_sections(f"{self._owner}.{name}", getattr(self, name))
            (first, *others) = sections
            object.__setattr__(self, name, sections if others else first)
        top, bottom = (sum(len(section) - 1 for section in part) for part in self._sections)
        if top > bottom:
            raise InputError(
                f"{self._owner}.numerator: got degree {top} over a denominator of degree {bottom}, so the filter needs "
                "future samples; multiply the denominator by z"
            )
        if self._poles_inside:
            self._check_poles()

    def _combine_forms(self) -> None:
        """Convert the forms ``sos`` and zeros-poles-gain to sections of ``numerator`` and ``denominator``."""
        if (self.numerator is None) != (self.denominator is None) or (self.poles is None) != (self.gain is None):
            raise InputError(
                f"{self._owner}: got half of a form; give numerator and denominator, sos, or poles and gain"
            )
        top, bottom = ([] if part is None else [part] for part in (self.numerator, self.denominator))
        if self.sos is not None:
            rows = read_sos(f"{self._owner}.sos", self.sos)
            top, bottom = [*top, rows[:, :3]], [*bottom, rows[:, 3:]]
        if self.poles is not None:
            try:
                (gain,) = np.ravel(self.gain).astype(float).tolist()
                zeros, poles = (pair_roots(read_roots(roots)) for roots in (self.zeros, self.poles))
            except (TypeError, ValueError, OverflowError):
                raise InputError(
                    f"{self._owner}.poles: got {self.zeros!r}, {self.poles!r}, {self.gain!r}; zeros and poles must be "
                    "numbers, complex ones with their conjugates, and the gain one number"
                ) from None
            top, bottom = [*top, [[gain], *zeros]], [*bottom, [[1.0], *poles]]
        elif self.zeros is not None:
            raise InputError(f"{self._owner}.zeros: got zeros without poles; add poles and gain")
        if not top:
            raise InputError(
                f"{self._owner}: got no coefficients; give numerator and denominator, sos, or poles and gain"
            )
        if self.sos is None and self.poles is None:
            return
        for name, forms in (("numerator", top), ("denominator", bottom)):
            sections = [section for form in forms for section in read_sections(f"{self._owner}.{name}", form)]
            object.__setattr__(self, name, sections)
        for name in ("sos", "zeros", "poles", "gain"):
            object.__setattr__(self, name, None)

    def _check_poles(self) -> None:
        """Raise `InputError` with the likely cause if a pole is on or outside the unit circle."""
        poles = self._roots[1]
        largest = np.max(np.abs(1.0 - poles), initial=0.0)
        if largest < 1.0:
            return
        got = f"{self._owner}.denominator: got a pole of magnitude {largest:.6g}; it must be below 1. "
        # Do not report rounding errors of the coefficients as the cause if exactly one pole is near z = 1, because
        # rounding errors hardly move a single pole. A single pole at z = 1 is probably an intended integrator.
        slow = np.abs(poles) < NEXT_TO_ONE
        if np.sum(slow) != 1 and any(is_rounding(section) for section in self._sections[1]):
            cause = (
                "Cause: rounding errors of the coefficients; use sections in series (sos=, scipy.signal: output='sos')"
            )
        elif np.any(poles[slow] == 0):
            cause = "For an integral gain, pass feedback=zwidth.Feedback.integral(gain) to the scene"
        else:
            cause = "Check the coefficients: highest power first"
        raise InputError(got + cause)

    @property
    def _sections(self) -> tuple[Any, Any]:
        """Numerator and denominator, each as a tuple of sections; a section is a tuple of coefficients."""
        both: Any = self.numerator, self.denominator
        top, bottom = (part if isinstance(part[0], tuple) else (part,) for part in both)
        return top, bottom

    @cached_property
    def _roots(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Offsets of the zeros and poles other than z = 0, and number of poles minus number of zeros at z = 0."""
        roots, trailing = [], []
        for part in self._sections:
            sections = [np.array(section) for section in part]
            trailing.append(sum(map(count_trailing_zeros, sections)))
            roots.append(np.concatenate([offsets(np.trim_zeros(section, "b")) for section in sections]))
        return roots[0], roots[1], trailing[1] - trailing[0]

    def factor(self, unit: Any) -> Estimate:
        """Return the transfer function, multiplied by the number ``unit``, as gain, zeros and poles."""
        tops, bottoms = self._sections
        gain = unit
        for section in tops:
            gain = section[0] * gain
        for section in bottoms:
            gain = gain / section[0]
        if hasattr(unit, "mid"):
            # If ``unit`` is a ball (an interval in certified computations), compute the roots as balls, too. Use the
            # exact coefficients, so that roots at z = 1 stay exact.
            exact = (np.concatenate([ball_offsets(section) for section in part]) for part in (tops, bottoms))
            return Estimate(0, gain, 0, *exact)
        zeros, poles, lag = self._roots
        return Estimate(0, gain, lag, zeros, poles)
