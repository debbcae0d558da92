"""Functions of z on the unit circle, with their derivatives, by the roots they have: offsets ``1 - root``.

Next to z = 1, where slow loops live, a root itself has lost its digits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.words.types import Array
from zwidth.words.xp import frozen, namespace

# Nearer to the circle than this share of its offset, or of so much, a root of the loop is on it: an undamped mode, or a
# zero of an undamped device. Of a slow one much less tells how soon it comes to rest.
_ON_CIRCLE, _AT_ONE = 1e-12, 1e-3
# And nearer than this share of its offset it is there but for rounding.
_UNDAMPED = 8.0 * np.finfo(float).eps


class Jet(NamedTuple):
    """A complex function of w and its derivative."""

    value: Array
    slope: Array

    def times(self, other: Jet) -> Jet:
        """The product."""
        return Jet(self.value * other.value, self.slope * other.value + self.value * other.slope)

    def over(self, other: Jet) -> Jet:
        """The quotient."""
        value = self.value / other.value
        return Jet(value, (self.slope - value * other.slope) / other.value)


class CirclePoints(NamedTuple):
    """Points ``z = e^(jw)``, and z - 1 with all its digits."""

    w: Array
    z: Array
    before: Array
    after: Array  # z + 1


def circle(w: Array) -> CirclePoints:
    """The points of the unit circle at the angles ``w``, exactly -1 at pi."""
    xp = namespace(w)
    half = 0.5 * w
    s, c = xp.sin(half), _exactly_at_pi(w, 0.0, xp.cos(half), xp)
    before = -2.0 * s * s + 2j * s * c
    return CirclePoints(w, 1.0 + before, before, 2.0 * c * (c + 1j * s))


def depths(offsets: np.ndarray) -> np.ndarray:
    """``1 - |root|`` of roots given by their offsets from 1, with the digits that they have next to 1."""
    return (2.0 * np.real(offsets) - np.abs(offsets) ** 2) / (1.0 + np.abs(1.0 - offsets))


def are_on_circle(offsets: np.ndarray) -> np.ndarray:
    """Whether roots are on the unit circle but for rounding."""
    return np.abs(depths(offsets)) <= _ON_CIRCLE * (_AT_ONE + np.abs(offsets))


def _exactly_at_pi(w: Array, exact: complex, value: Array, xp: Any) -> Array:
    """``value`` without its rounding error at pi, which derivatives must not mistake for a constant."""
    if xp is np:
        return np.where(w >= np.pi, exact, value)
    return value - frozen(xp.where(w >= np.pi, value - exact, 0.0), xp)


def lag_jet(at: CirclePoints, turns: float) -> Jet:
    """``z^turns``."""
    # At pi a whole number of half turns is a sign.
    even = 1.0 - 2.0 * (turns % 2)
    xp = namespace(at.w)
    value = _exactly_at_pi(at.w, even + 0j, xp.exp(1j * turns * at.w), xp)
    return Jet(value, 1j * turns * value)


def product_jet(at: CirclePoints, offsets: Any, factor: Any) -> Jet:
    """``factor prod(z - root)`` of roots given by their offsets from 1."""
    value = 0.0 * at.z + factor
    slope = 0.0 * at.z
    turn = 1j * at.z
    for offset in offsets:
        number = isinstance(offset, np.number)
        if number and offset.imag and abs(2.0 * offset.real - abs(offset) ** 2) < _UNDAMPED * abs(offset):
            # Next to a root on the circle a sum has lost its phase, too.
            angle, xp = np.angle(1.0 - offset), namespace(at.w)
            one = 2j * xp.sin(0.5 * (at.w - angle)) * xp.exp(0.5j * (at.w + angle))
        else:
            # Next to z = -1 that around z = 1 has.
            one = at.after + (offset - 2.0) if number and offset.real > 1.0 else at.before + offset
        value, slope = value * one, slope * one + value * turn
    return Jet(value, slope)
