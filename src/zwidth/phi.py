"""The phi-functions of exponential integrators, accurate with their derivatives for every damping.

Notation: ``c = e^-x``, ``phi1 = (1 - c)/x``, ``phi2 = (1 - phi1)/x``, ``psi = phi1 - phi2``, ``gap = phi2 - psi``.
As printed, each quotient cancels for small x: at x = 1e-8 phi2 would have no digit left. Below `_SERIES_BELOW`
each is therefore ``e^-x`` (or ``e^(-x/2)``) times a power series whose terms are all positive, which cancels
nowhere and has the right derivatives at 0; above it the closed form loses less than two bits.
"""

from __future__ import annotations

from math import factorial

import jax.numpy as jnp

from zwidth._types import Array

_SERIES_BELOW = 2.5
# The first term left out is below 2.5^25/26! = 2e-17 of the sum, and of its first two derivatives.
_TERMS = 26


def _series(x: Array, coefficients: list[float]) -> Array:
    """Evaluate a polynomial, lowest power first, by Horner's rule."""
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def _branches(x: Array) -> tuple[Array, Array, Array]:
    """Which branch holds, and for each an argument that is harmless where the other one holds."""
    small = x < _SERIES_BELOW
    return small, jnp.where(small, x, 0.0), jnp.where(small, _SERIES_BELOW, x)


_PHI1 = [1.0 / factorial(k + 1) for k in range(_TERMS)]
_PHI2 = [(k + 1.0) / factorial(k + 2) for k in range(_TERMS)]
_PSI = [1.0 / factorial(k + 2) for k in range(_TERMS)]
# gap = e^(-x/2) x sum_k (k + 1) (x/2)^(2k) / (2k + 3)!
_GAP = [(k + 1.0) / factorial(2 * k + 3) for k in range(13)]


def decay(x: Array) -> Array:
    """``c = e^-x``."""
    return jnp.exp(-x)


def phi1(x: Array) -> Array:
    """``(1 - e^-x)/x``, 1 at x = 0."""
    small, low, high = _branches(x)
    # Above the switch 1 - c loses nothing, and unlike expm1 has a derivative that is relatively exact.
    return jnp.where(small, jnp.exp(-low) * _series(low, _PHI1), (1.0 - jnp.exp(-high)) / high)


def phi2(x: Array) -> Array:
    """``(1 - phi1)/x = (e^-x - 1 + x)/x^2``, 1/2 at x = 0."""
    small, low, high = _branches(x)
    # Divided twice: x^2 overflows, and its derivative does so sooner.
    return jnp.where(small, jnp.exp(-low) * _series(low, _PHI2), (1.0 - (1.0 - jnp.exp(-high)) / high) / high)


def psi(x: Array) -> Array:
    """``phi1 - phi2 = (1 - e^-x - x e^-x)/x^2``, 1/2 at x = 0."""
    small, low, high = _branches(x)
    c = jnp.exp(-high)
    return jnp.where(small, jnp.exp(-low) * _series(low, _PSI), ((1.0 - c) / high - c) / high)


def gap(x: Array) -> Array:
    """``phi2 - psi = (x (1 + c) - 2 (1 - c))/x^2``, about x/6 for small x."""
    small, low, high = _branches(x)
    half = 0.5 * low
    series = jnp.exp(-half) * low * _series(half * half, _GAP)
    c = jnp.exp(-high)
    return jnp.where(small, series, ((1.0 + c) - 2.0 * (1.0 - c) / high) / high)
