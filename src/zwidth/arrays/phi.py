"""The phi-functions of exponential integrators, accurate with their derivatives for every damping.

Notation: ``c = e^-x``, ``phi1 = (1 - c)/x``, ``phi2 = (1 - phi1)/x``, ``psi = phi1 - phi2``, ``gap = phi2 - psi``.
As printed, each quotient cancels for small x: at x = 1e-8 phi2 would have no digit left. Below `_SERIES_BELOW` phi1
and gap are therefore ``e^(-x/2)`` times a power series in x^2 whose terms are all positive, which cancels nowhere and
has the right derivatives at 0; ``phi2, psi = (phi1 +- gap)/2`` loses about one bit at the switch and none at 0. Above
it the closed forms lose less than two bits.
"""

from __future__ import annotations

from collections.abc import Callable
from math import factorial
from typing import NamedTuple

from zwidth.arrays.xp import horner, namespace
from zwidth.words.types import Array

_SERIES_BELOW = 2.5
# The first term left out is below 1.25^22/23! = 6e-21 of the sum, and of its first two derivatives.
_TERMS = 11
# phi1 = e^(-x/2) sum_k (x/2)^(2k) / (2k + 1)!
_PHI1 = [1.0 / factorial(2 * k + 1) for k in range(_TERMS)]
# gap = e^(-x/2) x sum_k (k + 1) (x/2)^(2k) / (2k + 3)!
_GAP = [(k + 1.0) / factorial(2 * k + 3) for k in range(_TERMS)]


class PhiFunctions(NamedTuple):
    """All of them at one argument: they share their exponential and their series."""

    c: Array
    phi1: Array
    phi2: Array
    psi: Array
    gap: Array


def phi_functions(x: Array, exp: Callable[[Array], Array] | None = None) -> PhiFunctions:
    """c, phi1, phi2, psi and gap at x >= 0; within 30 units of 2^-53 for an ``exp`` within 8 of them."""
    xp = namespace(x)
    small = x < _SERIES_BELOW
    factor = (exp or xp.exp)(-0.5 * x)
    c = factor * factor
    # Each branch gets an argument that is harmless where the other one holds.
    half, high = xp.where(small, 0.5 * x, 0.0), xp.where(small, _SERIES_BELOW, x)
    square = half * half
    low1, low_gap = factor * horner(square, _PHI1), factor * (2.0 * half) * horner(square, _GAP)
    # Above the switch 1 - c loses nothing, and unlike expm1 has a derivative that is relatively exact.
    inverse = 1.0 / high
    high1 = (1.0 - c) * inverse
    return PhiFunctions(
        c,
        xp.where(small, low1, high1),
        xp.where(small, 0.5 * (low1 + low_gap), (1.0 - high1) * inverse),
        xp.where(small, 0.5 * (low1 - low_gap), (high1 - c) * inverse),
        xp.where(small, low_gap, ((1.0 + c) - 2.0 * high1) * inverse),
    )


def decay(x: Array) -> Array:
    """``c = e^-x``."""
    return namespace(x).exp(-x)


def phi1(x: Array) -> Array:
    """``(1 - e^-x)/x``, 1 at x = 0."""
    return phi_functions(x).phi1


def phi2(x: Array) -> Array:
    """``(1 - phi1)/x = (e^-x - 1 + x)/x^2``, 1/2 at x = 0."""
    return phi_functions(x).phi2


def psi(x: Array) -> Array:
    """``phi1 - phi2 = (1 - e^-x - x e^-x)/x^2``, 1/2 at x = 0."""
    return phi_functions(x).psi


def gap(x: Array) -> Array:
    """``phi2 - psi = (x (1 + c) - 2 (1 - c))/x^2``, about x/6 for small x."""
    return phi_functions(x).gap
