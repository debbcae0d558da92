"""Floating-point filter of the certified method: a Schur-Cohn recursion with a proved error bound.

``u = 2^-53``; ``|.|`` of a polynomial is the sum of its absolute coefficients, which bounds it on the unit circle;
a hat marks what was computed. Taken for granted: binary64 ``+ - * /`` round correctly (XLA may fuse a product into a
sum, which only removes an error), and whatever is below 2^-1022 may become zero. No library's exp is trusted.

1. Device. ``c = e^-x``: x = k ln 2 + r with a two-part ln 2, an error of r below 0.8u, Horner's rule on 15 terms
   below 3u: together below 8u. For x < 2.5 ``A = sum x^k/(k+2)!`` has positive terms only: 8u, hence
   ``psi = c A`` 17u and ``phi2 = c (1 + (x - 1) A)`` 20u, because ``|x - 1| A <= 1 + (x - 1) A``. For x >= 2.5, where
   c <= 0.083, the quotients lose little: phi1 4u, phi2 6u, psi 11u. Beyond 700, c is off by 1e-304 at most.
   Held fraction: t = 1 - f is off by u, and x = delta t by 2u. phi1 and phi2 amplify that at most once and psi twice,
   e^-x x times; as ``x e^-x <= phi1(x)`` and ``<= 1/2``, that error is below 2u of another term of a1. Every term of
   a2, a1, a0 is positive and within 50u; sums included the errors add up to less than 60u (a2 + a1 + a0).
2. Coefficients. With s = alpha + beta (off by u) and ``size = 4 + (a2 + a1 + a0)(|s| + |beta|)``: the head
   z^N - (1 + c) z^(N-1) + c z^(N-2) errs by less than 18u, the wall's part by less than (60 + 4)u of itself, and
   where the two overlap a sum adds 2u size: ``P = p + e`` with ``|p| <= size`` and ``|e| <= 72u size``.
3. One stage, degree m: p of degree m, e any continuous function with ``|e| <= eps`` on the circle, and
   ``p*(z) = z^m conj(p(z))``. From a = 2^-k p_m and b = 2^-k p_0 (exact) comes

       q_i = a p_(i+1) - b p_(m-1-i),   that is   (a P - b P*)/z = q + e'

   the constant term vanishes exactly. ``|e'| <= (|a| + |b|)(eps + 2.01u |p|)``, the latter for the rounding of q. The
   bounds of e and of |p| grow by the same factor, so that after all stages
   ``eps <= (72 + 2.01 N) u size G`` with the running product ``G = prod (|a| + |b|)``.
4. Decision. The last p is p_2 z^2 + p_1 z + p_0. Two stages more, taken exactly, show that on the circle

       (|p_2| + |p_0|) |p| >= |p_2 - p_0| | |p_2 + p_0| - |p_1| |

   If the right side exceeds ``(|p_2| + |p_0|) eps``, no stage vanishes on the circle, for
   ``|q + e'| <= (|a| + |b|) |p + e|`` there. Let o = m minus the winding number of p + e. Rouche's theorem gives
   o(p) = o(q) where |b| < |a|, o(p) = m - o(q) where |b| > |a|, and o(p) = m/2 where they are equal (a P and b P* are
   then of one size and nowhere equal, so their quotient winds as often as 1 does). Since 0 <= o(q) <= m - 1, o(P) = 0
   exactly if |b| < |a| at every stage, |p_0| < |p_2| and |p_1| < |p_2 + p_0|: stable. Otherwise a pole is strictly
   outside: unstable. Comparisons are between floating-point numbers, hence exact; p_2 + p_0 is within u of itself,
   which the last stage's rounding covers.

The test asks for ``1.01 (72 + 3 N) u``: the rounding of G, of size and of the test itself, and second-order terms,
are below N u of it. What is below 2^-1022 and becomes zero changes a stage by less than 2^-1019 m. Relative to eps that
is nothing, because |a| >= 2 wherever a stage is scaled (without an exponent p_m is scaled to inf or NaN, which decide
nothing). The first stage, where a = 1, and the last two are not scaled; if one of those shrinks everything by more than
2^900, the addend 2^-500 covers it. Overflow makes ``2 size G``, which bounds all coefficients, inf or NaN.
"""

from __future__ import annotations

from math import factorial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from zwidth._types import Array

UNSTABLE, STABLE, OPEN = 0, 1, 2

_LOG2_E = 1.4426950408889634
# The first part has 32 significant bits: its products with whole numbers below 2^21 are exact.
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXP_TERMS = [(-1.0) ** k / factorial(k) for k in range(15)]
_SERIES_BELOW = 2.5
# The first term left out is below 1e-19 of the sum.
_A_TERMS = [1.0 / factorial(k + 2) for k in range(26)]
_EXP_LIMIT = 700.0

_COEFFICIENT_ERROR = 72
_UNIT = 2.0**-53
_ABSOLUTE = 2.0**-500
_EXPONENT_BITS = 0x7FF << 52


class HeldDevice(NamedTuple):
    """c and the numerator N(z) = a2 z^2 + a1 z + a0, within the errors stated above."""

    c: Array
    a2: Array
    a1: Array
    a0: Array | None  # None for a whole delay, where N(z) = z (a2 z + a1)


def _horner(x: Array, terms: list[float]) -> Array:
    total = jnp.full_like(x, terms[-1])
    for term in reversed(terms[:-1]):
        total = total * x + term
    return total


def _exp_minus(x: Array) -> Array:
    """``e^-x``, 0 <= x <= 700, within 8u."""
    k = jnp.round(x * _LOG2_E)
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    power = lax.bitcast_convert_type((1023 - k.astype(jnp.int64)) << 52, jnp.float64)
    return _horner(r, _EXP_TERMS) * power


def _phi(x: Array) -> tuple[Array, Array, Array]:
    """c, phi2 and psi of one argument, within 8u, 20u and 20u."""
    c = _exp_minus(jnp.where(x < _EXP_LIMIT, x, _EXP_LIMIT))
    small = x < _SERIES_BELOW
    low, high = jnp.where(small, x, 0.0), jnp.where(small, _SERIES_BELOW, x)
    a = _horner(low, _A_TERMS)
    inverse = 1.0 / high
    p1 = (1.0 - c) * inverse
    phi2 = jnp.where(small, c * (1.0 + (low - 1.0) * a), (1.0 - p1) * inverse)
    psi = jnp.where(small, c * a, (p1 - c) * inverse)
    return c, phi2, psi


def device(delta: Array, fraction: Array, fractional: bool) -> HeldDevice:
    """Discretize the device, elementwise."""
    if not fractional:
        return HeldDevice(*_phi(delta), None)
    f = fraction
    t = 1.0 - f
    e_t, phi2_t, psi_t = _phi(delta * t)
    _, phi2_f, psi_f = _phi(delta * f)
    c = _exp_minus(jnp.where(delta < _EXP_LIMIT, delta, _EXP_LIMIT))
    phi1_f = phi2_f + psi_f
    a1 = t * t * psi_t + t * f * (e_t * phi1_f) + f * f * phi2_f + t * f * ((phi2_t + psi_t) * phi1_f)
    return HeldDevice(c, t * t * phi2_t, a1, e_t * (f * f * psi_f))


def coefficients(alpha: Array, beta: Array, plant: HeldDevice, whole: int) -> tuple[list, Array]:
    """P, lowest power first, None for a zero of the structure; and ``size``, which bounds its coefficients' sum."""
    c, a2, a1, a0 = plant
    s = alpha + beta
    if a0 is None:
        low, gain = [-(a1 * beta), a1 * s - a2 * beta, a2 * s], a2 + a1
    else:
        low, gain = [-(a0 * beta), a0 * s - a1 * beta, a1 * s - a2 * beta, a2 * s], a2 + a1 + a0
    head = [c, -(1.0 + c), jnp.ones_like(c)]
    size = 4.0 + gain * (jnp.abs(s) + jnp.abs(beta))
    p: list = [*low, *[None] * (whole + 1)]
    for index, value in enumerate(head, len(p) - 3):
        p[index] = value if p[index] is None else p[index] + value
    return p, size


def recursion(p: list, size: Array) -> Array:
    """UNSTABLE, STABLE or OPEN for a monic polynomial, elementwise; ``p`` lowest power first, degree 3 or more."""
    degree = len(p) - 1
    growth, inside = 2.0 * size, jnp.ones_like(size, dtype=bool)
    for m in range(degree, 2, -1):
        lead, last = p[m], p[0]
        # Scaled by lead's own power of two: no square, so neither overflow nor underflow over many stages. The two
        # last stages are few enough without it.
        scale = _inverse_power(lead) if 4 < m < degree else 1.0
        a, b = (None, last) if m == degree else (lead * scale, last * scale)
        size_a, size_b = 1.0 if a is None else jnp.abs(a), jnp.abs(b)
        smaller = size_b < size_a
        inside = inside & smaller
        growth = growth * (size_a + size_b)
        p = [_combined(a, p[i + 1], b, p[m - 1 - i]) for i in range(m)]
    p0, p1, p2 = p
    size_0, size_1, size_2, total = jnp.abs(p0), jnp.abs(p1), jnp.abs(p2), jnp.abs(p2 + p0)
    inside = inside & (size_0 < size_2) & (size_1 < total)
    least = jnp.abs(p2 - p0) * jnp.abs(total - size_1)
    bound = 0.5 * 1.01 * (_COEFFICIENT_ERROR + 3 * degree) * _UNIT
    decided = least > (bound * growth + _ABSOLUTE) * (size_2 + size_0)
    return jnp.where(decided, inside.astype(jnp.uint8), jnp.uint8(OPEN))


def _inverse_power(value: Array) -> Array:
    """2^-k, where 2^(k+1) <= |value| < 2^(k+2); inf where value has no exponent."""
    bits = lax.bitcast_convert_type(value, jnp.int64) & _EXPONENT_BITS
    return lax.bitcast_convert_type(_EXPONENT_BITS - bits, jnp.float64)


def _combined(a: Array | None, x: Array | None, b: Array, y: Array | None) -> Array | None:
    """``a x - b y``; None stands for a = 1 and for x = 0, y = 0."""
    left = None if x is None else (x if a is None else a * x)
    if y is None:
        return left
    return -(b * y) if left is None else left - b * y
