"""Values and derivatives of rational functions on the unit circle, computed from their zeros and poles.

A function is given by the *offsets* ``1 - root`` of its zeros and poles, because loops that are slow compared with the
sampling period have roots near z = 1, and there float64 represents the offset far more accurately than the root. On the
circle, z = e^(jw). Derivatives are taken with respect to the angle w.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import namespace, stop_gradient

# A root is treated as a root on the unit circle, such as that of an undamped mode, if its distance from the circle is
# at most _ON_CIRCLE (_AT_ONE + |offset|). This limit is smaller near z = 1, because there even a very small distance
# from the circle is significant: it determines the decay time.
_ON_CIRCLE = 1e-12  # relative tolerance
_AT_ONE = 1e-3  # value added to the offset, so that the tolerance at z = 1 is not 0
# Largest distance of a root from the circle, relative to its offset, that rounding errors of the offset can explain.
_UNDAMPED = 8.0 * np.finfo(float).eps


class Jet(NamedTuple):
    """Value and derivative of a complex function of one variable, usually the angle w."""

    value: Array
    slope: Array  # derivative with respect to the variable of the function, for example the angle w

    def times(self, other: Jet) -> Jet:
        """Return the product with another function, with the derivative by the product rule."""
        return Jet(self.value * other.value, self.slope * other.value + self.value * other.slope)

    def over(self, other: Jet) -> Jet:
        """Return the quotient of this and another function, with the derivative by the quotient rule."""
        value = self.value / other.value
        return Jet(value, (self.slope - value * other.slope) / other.value)


class CirclePoints(NamedTuple):
    """Points ``z = e^(jw)`` of the unit circle; z - 1 and z + 1 are computed without cancellation."""

    w: Array
    z: Array
    z_minus_1: Array
    z_plus_1: Array


def circle_points(w: Array) -> CirclePoints:
    """Return the points of the unit circle at the angles ``w``; the point at pi is exactly -1."""
    xp = namespace(w)
    half = 0.5 * w
    s, c = xp.sin(half), _exactly_at_pi(w, 0.0, xp.cos(half), xp)
    z_minus_1 = -2.0 * s * s + 2j * s * c
    return CirclePoints(w, 1.0 + z_minus_1, z_minus_1, 2.0 * c * (c + 1j * s))


def distances_inside(offsets: Array) -> Array:
    """Return ``1 - |root|`` for roots given by their offsets, without cancellation for roots near 1."""
    xp = namespace(offsets)
    return (2.0 * xp.real(offsets) - xp.abs(offsets) ** 2) / (1.0 + xp.abs(1.0 - offsets))


def are_on_circle(offsets: np.ndarray) -> np.ndarray:
    """Return a Boolean array: True for roots, given by their offsets, that are on the unit circle within tolerance."""
    return np.abs(distances_inside(offsets)) <= _ON_CIRCLE * (_AT_ONE + np.abs(offsets))


def _exactly_at_pi(w: Array, exact: complex, value: Array, xp: Any) -> Array:
    """Return ``value`` with its entries at w = pi replaced by their exact value."""
    if xp is np:
        return np.where(w >= np.pi, exact, value)
    # Subtract the rounding error as a constant (without gradient), so that the derivative at pi remains that of
    # ``value``.
    return value - stop_gradient(xp.where(w >= np.pi, value - exact, 0.0), xp)


def power_jet(points: CirclePoints, power: float) -> Jet:
    """Return ``z^power`` and its derivative, for an integer power."""
    # z^power is 1 at w = pi for even powers and -1 for odd ones.
    at_pi = 1.0 - 2.0 * (power % 2)
    xp = namespace(points.w)
    value = _exactly_at_pi(points.w, at_pi + 0j, xp.exp(1j * power * points.w), xp)
    return Jet(value, 1j * power * value)


def product_jet(points: CirclePoints, offsets: Any, factor: Any) -> Jet:
    """Return ``factor prod(z - root)`` and its derivative, for roots given by their offsets."""
    value = 0.0 * points.z + factor
    slope = 0.0 * points.z
    dz_dw = 1j * points.z
    for offset in offsets:
        is_number = isinstance(offset, np.number)
        if is_number and offset.imag and abs(2.0 * offset.real - abs(offset) ** 2) < _UNDAMPED * abs(offset):
            # For a root on the circle, compute z - root from the difference of the angles, because near the root the
            # sum z - 1 + offset would cancel and have a wrong phase.
            angle, xp = np.angle(1.0 - offset), namespace(points.w)
            difference = 2j * xp.sin(0.5 * (points.w - angle)) * xp.exp(0.5j * (points.w + angle))
        else:
            # Compute z - root from z + 1 for roots in the left half-plane, otherwise from z - 1, because the nearer of
            # -1 and 1 yields an accurate difference near the root.
            difference = (
                points.z_plus_1 + (offset - 2.0) if is_number and offset.real > 1.0 else points.z_minus_1 + offset
            )
        value, slope = value * difference, slope * difference + value * dz_dw
    return Jet(value, slope)
