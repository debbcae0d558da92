"""The device in balls: c = e^-delta and the numerator M(z) = a2 z + a1 + a0/z, with proved errors.

``u = 2^-53``. No library's exp is trusted.

- ``c = e^-x``: x = k ln 2 + r with a two-part ln 2, an error of r below 0.8u, Horner's rule on 14 terms below 3u:
  together below 8u. Beyond x = 700 it is off by 1e-304 at most.
- For x < 1.5 ``A = sum x^k/(k+2)!`` has positive terms only: 8u, hence ``psi = c A`` 17u and
  ``phi2 = c (1 + (x - 1) A)`` 20u, because ``|x - 1| A <= 1 + (x - 1) A``. For x >= 1.5, where c <= 0.224, the
  quotients lose little: phi1 6u, phi2 9u, psi 19u. ``phi1 = phi2 + psi`` is within 21u, ``em = delta phi1`` within 22u.
- Held fraction: t = 1 - f is off by u, and x = delta t by 2u. phi1 and phi2 amplify that at most once and psi twice
  (24u), e^-x x times; as ``x e^-x <= phi1(x)`` and ``<= 1/2``, that error is below 2u of another term of a1, and of a0
  below u of a1. Term by term a2 is within 27u, a1, sums included, within 54u, a0 within 33u (and u of a1).
  ``c = e^-(delta t) e^-(delta f)`` is within 17u, and 3 delta u for the rounding of the exponents.
"""

from __future__ import annotations

from math import factorial
from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array
from zwidth.batching import stored
from zwidth.stability.enclosure import TINY, UNIT, Ball
from zwidth.xp import horner, namespace

_LOG2_E = 1.4426950408889634
# The first part has 32 significant bits: its products with whole numbers below 2^21 are exact.
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXP_TERMS = [(-1.0) ** k / factorial(k) for k in range(14)]
_SERIES_BELOW = 1.5
# The first term left out is below 5e-17 of the sum.
_A_TERMS = [1.0 / factorial(k + 2) for k in range(19)]
_EXP_LIMIT = 700.0


class Plant(NamedTuple):
    """Device and delay of a loop, in balls of any arithmetic; what is None is not needed."""

    delta: Any
    c: Any
    em: Any  # 1 - c
    p1: Any  # phi1 = a2 + a1 + a0
    a2: Any
    a1: Any
    a0: Any = None  # None for a whole delay, like all below
    f: Any = None
    p1_t: Any = None  # phi1 and psi of delta (1 - f)
    psi_t: Any = None


def _two_to_minus(k: Array, xp: Any) -> Array:
    if xp is np:
        return np.ldexp(1.0, -k.astype(np.int64))
    from jax.lax import bitcast_convert_type

    return bitcast_convert_type((1023 - k.astype(xp.int64)) << 52, xp.float64)


def exp_minus(x: Array) -> Array:
    """``e^-x``, 0 <= x, within 8u, and 1e-304 beyond 700."""
    xp = namespace(x)
    x = xp.minimum(x, _EXP_LIMIT)
    k = xp.round(x * _LOG2_E)
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    return horner(r, _EXP_TERMS) * _two_to_minus(k, xp)


def phi(x: Array) -> tuple[Array, Array, Array]:
    """c, phi2 and psi of x >= 0, within 8u, 20u and 20u."""
    xp = namespace(x)
    c, small = exp_minus(x), x < _SERIES_BELOW
    low, high = xp.where(small, x, 0.0), xp.where(small, _SERIES_BELOW, x)
    a = horner(low, _A_TERMS)
    inverse = 1.0 / high
    p1 = (1.0 - c) * inverse
    phi2 = xp.where(small, c * (1.0 + (low - 1.0) * a), (1.0 - p1) * inverse)
    psi = xp.where(small, c * a, (p1 - c) * inverse)
    return c, phi2, psi


def _within(mid: Array, units: float) -> Ball:
    return Ball(mid, (units * UNIT) * mid + TINY)


def plant(delta: Array, fraction: Array | None) -> Plant:
    """The device of exact delta and f, elementwise; ``fraction`` is None for whole delays."""
    if fraction is None:
        c, phi2, psi = phi(delta)
        p1 = phi2 + psi
        a2, a1 = _within(phi2, 21.0), _within(psi, 21.0)
        return Plant(Ball(delta), _within(c, 9.0), _within(delta * p1, 23.0), _within(p1, 22.0), a2, a1)
    f = fraction
    t = 1.0 - f
    e_t, phi2_t, psi_t = phi(delta * t)
    e_f, phi2_f, psi_f = phi(delta * f)
    p1_t, p1_f = phi2_t + psi_t, phi2_f + psi_f
    a2 = t * t * phi2_t
    a1 = t * t * psi_t + t * f * (e_t * p1_f) + f * f * phi2_f + t * f * (p1_t * p1_f)
    a0 = e_t * (f * f * psi_f)
    # Several loops of the compiler use them.
    a2, a1, a0, c, p1_t, psi_t = stored((a2, a1, a0, e_t * e_f, p1_t, psi_t), delta)
    p1 = a2 + a1 + a0
    return Plant(
        Ball(delta),
        Ball(c, (18.0 + 3.0 * delta) * UNIT * c + TINY),
        _within(delta * p1, 66.0),
        _within(p1, 64.0),
        _within(a2, 28.0),
        _within(a1, 56.0),
        Ball(a0, UNIT * (34.0 * a0 + 2.0 * a1) + TINY),
        Ball(f),
        _within(p1_t, 25.0),
        _within(psi_t, 26.0),
    )
