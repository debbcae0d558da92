"""Discretize a damped mass exactly under a delayed force with zero-order hold.

In normalized units (T = 1, m = 1) the device has the damping delta and the delay d = n + f (n integer, 0 <= f < 1). The
force computed at sample k acts from k + d on: in each period, the older force acts during [0, f) and the newer one
during [f, 1). The response from computed force to sampled position is

    x/F = N(z) / (z^(1+n) (z - 1)(z - c))     with N(z) = z n0(z) + n1(z) = a2 z^2 + a1 z + a0

and ``N(z) = phi2 z^2 + psi z`` for f = 0. The three coefficients (docs/theory/model.md) are sums of positive terms in
the phi-functions of exponential integrators at x = delta and its fractions:

    c = e^-x     phi1 = (1 - c)/x     phi2 = (1 - phi1)/x     psi = phi1 - phi2     gap = phi2 - psi

For small x these quotients cancel. Below `SERIES_BELOW`, phi1 and gap are therefore computed as ``e^(-x/2)`` times a
power series in x^2 with positive terms, which does not cancel and has accurate derivatives at 0;
``phi2, psi = (phi1 +- gap)/2`` then loses about one bit at the switch and none at 0. Above it the closed forms lose
less than two bits.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import factorial
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import horner, is_jax, namespace, nan_unless
from zwidth.numerics.evaluate import as_float64
from zwidth.units.quantities import LARGEST_DAMPING, LONGEST_DELAY

SERIES_BELOW = 2.5  # x below which the series are used
SERIES_TERMS = 11  # the first omitted term is below 1.25^22/23! = 6e-21 of the sum and of its first two derivatives
# Coefficients of the series phi1 = e^(-x/2) sum_k (x/2)^(2k) / (2k + 1)!
PHI1 = [1.0 / factorial(2 * k + 1) for k in range(SERIES_TERMS)]
# Coefficients of the series gap = -x phi2' = e^(-x/2) x sum_k (k + 1) (x/2)^(2k) / (2k + 3)!
GAP = [(k + 1.0) / factorial(2 * k + 3) for k in range(SERIES_TERMS)]


class PhiFunctions(NamedTuple):
    """Values of c = e^-x, phi1 = (1 - c)/x, phi2 = (1 - phi1)/x, psi = phi1 - phi2 and gap = phi2 - psi at x."""

    c: Array
    phi1: Array
    phi2: Array
    psi: Array
    gap: Array


def phi_functions(x: Array) -> PhiFunctions:
    """Compute c = e^-x, phi1 = (1 - c)/x, phi2 = (1 - phi1)/x, psi = phi1 - phi2 and gap = phi2 - psi at x >= 0.

    Their relative errors are below 30 units of 2^-53 if that of ``xp.exp`` is below 8 units.
    """
    xp = namespace(x)
    small = x < SERIES_BELOW
    factor = xp.exp(-0.5 * x)
    c = factor * factor
    # Replace the argument of each branch of `where` by a valid one where the branch is not selected, because a NaN in
    # that branch would make the derivatives of the result NaN.
    half, high = xp.where(small, 0.5 * x, 0.0), xp.where(small, SERIES_BELOW, x)
    half_squared = half * half
    low1, low_gap = factor * horner(half_squared, PHI1), factor * (2.0 * half) * horner(half_squared, GAP)
    # Compute 1 - c as a difference and not by expm1. The difference does not cancel above `SERIES_BELOW`, and its
    # derivative has a small relative error, unlike that of expm1.
    inverse = 1.0 / high
    high1 = (1.0 - c) * inverse
    return PhiFunctions(
        c,
        xp.where(small, low1, high1),
        xp.where(small, 0.5 * (low1 + low_gap), (1.0 - high1) * inverse),
        xp.where(small, 0.5 * (low1 - low_gap), (high1 - c) * inverse),
        xp.where(small, low_gap, ((1.0 + c) - 2.0 * high1) * inverse),
    )


# Type of a function that maps x to the values of `PhiFunctions`, in floating-point, traced or ball arithmetic.
Functions = Callable[[Any], Any]


class Plant(NamedTuple):
    """The discretized device: its numerator ``N(z) = a2 z^2 + a1 z + a0`` and its pole c."""

    c: Array  # e^-delta, the pole besides z = 1
    em: Array  # 1 - c, without cancellation
    a2: Array
    a1: Array
    a0: Array
    gap: Array  # N(-1) = a2 - a1 + a0, without cancellation


def discretize_mass(
    delta: Any,
    fraction: Any = None,
    functions: Functions = phi_functions,
    phi: Any = None,
    phi_t: Any = None,
    remainder: Any = None,
) -> Plant:
    """Compute the discrete transfer function of a damped mass with a fractional delay, for floats, JAX arrays or balls.

    Args:
        delta: normalized damping.
        fraction: fractional part f of the delay, in [0, 1); None for an integer delay, with a0 = 0.
        functions: function that evaluates the phi-functions in the arithmetic of ``delta``.
        phi: phi-functions at delta, if already computed.
        phi_t: phi-functions at delta (1 - f), if already computed.
        remainder: 1 - f, if already computed.
    """
    phi = functions(delta) if phi is None else phi
    if fraction is None:
        return Plant(phi.c, delta * phi.phi1, phi.phi2, phi.psi, 0.0 * phi.gap, phi.gap)
    f = fraction
    t = 1.0 - f if remainder is None else remainder
    phi_t, phi_f = functions(delta * t) if phi_t is None else phi_t, functions(delta * f)
    e_t = phi_t.c
    a2 = t * t * phi_t.phi2
    a1 = t * t * phi_t.psi + t * f * e_t * phi_f.phi1 + f * f * phi_f.phi2 + t * f * phi_t.phi1 * phi_f.phi1
    a0 = e_t * f * f * phi_f.psi
    gap = (
        t * t * phi_t.gap
        - t * f * phi_f.phi1 * (e_t + phi_t.phi1)
        - f * f * (phi_f.gap + delta * t * phi_t.phi1 * phi_f.psi)
    )
    return Plant(phi.c, delta * phi.phi1, a2, a1, a0, gap)


def differentiate_mass(delta: Array, fraction: Array) -> tuple[Plant, Plant]:
    """Return the derivatives of `discretize_mass` in delta and in the fraction f of the delay, in closed form.

    The derivative of N(1) in f is exactly 0. Automatic differentiation would yield a rounding error instead of 0. This
    would make the errors of the derivatives of the maximum stiffness in d 80 times as large at d = 500.
    """
    f, t = fraction, 1.0 - fraction
    c, e_t = (namespace(delta).exp(-x) for x in (delta, delta * t))
    phi_t, phi_f = phi_functions(delta * t), phi_functions(delta * f)
    chi_t, chi_f = _compute_chi(delta * t, phi_t.gap), _compute_chi(delta * f, phi_f.gap)
    # The derivatives of all terms of a1 have the same sign, so no digits cancel in their sum below.
    a2 = -t * t * t * chi_t
    a1 = t * t * t * (phi_t.psi - chi_t) + f * f * f * chi_f
    a1 = -(
        a1 + t * f * (e_t * (t * phi_f.phi1 + f * phi_f.psi) + t * phi_t.psi * phi_f.phi1 + f * phi_t.phi1 * phi_f.psi)
    )
    a0 = -e_t * f * f * (t * phi_f.psi + f * (phi_f.psi - chi_f))
    slow, fast = t * phi_t.phi1, e_t * f * phi_f.phi1
    zero = 0.0 * c
    return Plant(-c, c, a2, a1, a0, a2 - a1 + a0), Plant(zero, zero, -slow, slow - fast, fast, 2.0 * (fast - slow))


@cache
def get_differentiable_mass() -> Callable[[Array, Array], Plant]:
    """Return `discretize_mass` as a JAX function whose derivatives are those of `differentiate_mass`."""
    import jax

    function = jax.custom_jvp(lambda delta, fraction: discretize_mass(delta, fraction))

    @function.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple[Plant, Plant]:
        (by_delta, by_f), (d_delta, d_f) = differentiate_mass(*primals), tangents
        return function(*primals), Plant(*(a * d_delta + b * d_f for a, b in zip(by_delta, by_f, strict=True)))

    return function


def _compute_chi(x: Array, gap: Array) -> Array:
    """Return chi = ``gap/x = -phi2'``, with the limit 1/6 at x = 0. The derivative of psi is ``chi - psi``."""
    xp = namespace(x)
    is_small = x < SERIES_BELOW
    half = xp.where(is_small, 0.5 * x, 0.0)
    return xp.where(is_small, xp.exp(-half) * horner(half * half, GAP), gap / xp.where(is_small, 1.0, x))


def factor_numerator(plant: Plant) -> tuple[Array, Array]:
    """Return h >= 0 and q >= 0 of ``N(z) = (a2 z + h)(z + q)``; the zeros of N are real and not positive."""
    xp = namespace(plant.a1)
    h = 0.5 * (plant.a1 + xp.sqrt(xp.maximum(plant.a1 * plant.a1 - 4.0 * plant.a2 * plant.a0, 0.0)))
    return h, plant.a0 / h


def split_delay(d: Array) -> tuple[Array, Array]:
    """Split the delay d into its integer part n and its fractional part f, which has no rounding error.

    At integer d the derivatives are those from the right.
    """
    whole = namespace(d).floor(d)
    return whole, d - whole


class DelayClasses(NamedTuple):
    """Flags for the classes of delays in an array. A compiled function omits the code for all other classes."""

    short: bool  # True if some delay is below one period
    long: bool  # True if some delay is one period or more
    fractional: bool  # True if some delay is not an integer


# All three classes. JAX compiles functions before the values of arrays are known, so it needs the code for all classes.
ANY = DelayClasses(True, True, True)


def classify_delays(d: Any) -> DelayClasses:
    """Return the classes of delays in an array, or `ANY` for a JAX array; NaN and negative values count as short."""
    if isinstance(d, float | int):
        return DelayClasses(not d >= 1, d >= 1, isinstance(d, float) and not d.is_integer())
    if is_jax(d):
        return ANY
    d = as_float64("d", d)
    long = d >= 1
    return DelayClasses(not (long.size and np.all(long)), bool(np.any(long)), bool(np.any(np.floor(d) != d)))


class DiscretePlant(NamedTuple):
    """Delay, discretized device and phi-functions of points (delta, d); all NaN if delta or d is out of range."""

    delta: Array
    whole: Array  # integer delay n
    f: Array  # fractional delay
    c: Array  # e^-delta, the pole besides z = 1
    em: Array  # 1 - c
    p1: Array  # phi1(delta) = a2 + a1 + a0
    p2: Array  # phi2(delta)
    psi: Array  # psi(delta)
    p1_t: Array  # phi1(delta (1 - f))
    psi_t: Array  # psi(delta (1 - f))
    a2: Array
    a1: Array
    a0: Array
    gap: Array  # N(-1) = a2 - a1 + a0
    minus_one_coefficient: Array  # r; a stable loop requires r (alpha + 2 beta) < 1, from its sign at z = -1


def discretize_plant(delta: Array, d: Array, kind: DelayClasses = ANY) -> DiscretePlant:
    """Compute the discretized device and its phi-functions for arrays of delta and d of one shape, or for scalars.

    Args:
        delta: normalized damping.
        d: delay in periods.
        kind: classes of the delays; if none is fractional, the simpler formulas for f = 0 are used.
    """
    delta, d = nan_unless(is_valid_device(delta, d), delta, d)
    whole, f = split_delay(d)
    return discretize_split_delay(delta, whole, f, 1.0 - f, kind)


def discretize_split_delay(delta: Array, whole: Array, f: Array, remainder: Array, kind: DelayClasses) -> DiscretePlant:
    """Discretize the device as `discretize_plant`, with the delay d = n + f given by its two parts.

    Args:
        delta: normalized damping.
        whole: integer delay n.
        f: fractional delay, 0 <= f < 1.
        remainder: 1 - f. For arrays in float32, it must be computed before f is rounded to float32, because the
            difference 1 - f of a rounded f loses digits near f = 1.
        kind: classes of the delays, as for `discretize_plant`.
    """
    phi = phi_functions(delta)
    phi_t = phi_functions(delta * remainder) if kind.fractional else phi
    plant = discretize_mass(delta, f if kind.fractional else None, phi=phi, phi_t=phi_t, remainder=remainder)
    # With a wall (alpha, beta), the characteristic polynomial P of a stable loop satisfies
    # (-1)^n P(-1) = 2 (1 + c) - (-1)^n N(-1) (alpha + 2 beta) > 0.
    minus_one_coefficient = (1.0 - 2.0 * (whole % 2.0)) * 0.5 * plant.gap / (1.0 + plant.c)
    return DiscretePlant(
        *(delta, whole, f, plant.c, plant.em, phi.phi1, phi.phi2, phi.psi, phi_t.phi1, phi_t.psi),
        *(plant.a2, plant.a1, plant.a0, plant.gap, minus_one_coefficient),
    )


def is_valid_device(delta: Array, d: Array) -> Array:
    """Return a boolean array that is True where delta and d are both in range; False for NaN."""
    return (delta >= 0) & (delta <= LARGEST_DAMPING) & (d >= 0) & (d <= LONGEST_DELAY)
