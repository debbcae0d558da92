"""Characteristic polynomial P = T + B of the rigid loop, in factors.

T = z^(1+n) (z - 1)(z - c) is the part of device and delay, B = M W that of the wall, with W = alpha z + beta (z - 1)
and M = a2 z + a1 + a0/z. A wall has the normalized stiffness alpha and damping beta, its device has the normalized
damping delta, and the delay is d = n + f periods (n integer, 0 <= f < 1). With the coefficients of the discretized
device (`plant.rigid_mass`),

    P = T + B
    T = z^(1+n) (z - 1)(z - c)         device and delay, c = e^-delta
    B = M W                            wall
    M = a2 z + a1 + a0/z = (a2 z + h)(1 + q/z)
    W = alpha z + beta (z - 1)         `expand_wall`

For integer delays, a0 = q = 0, and ``-delta^2 P`` is the paper's eq. (17), the normalized form of its eq. (11). For
fractional delays, z P is a polynomial. L = B/T is the open loop; at a *gain crossover*, |L| = 1. All other modules of
`stability.rigid` take P from this module; only `stability.reference` evaluates P independently.

References:
    Hulin, Preusche, Hirzinger 2006, eqs. (11), (15), (17).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import namespace, nan_unless
from zwidth.model.circle_functions import Jet
from zwidth.plant.rigid_mass import DiscretePlant, discretize_mass, factor_numerator, split_delay
from zwidth.stability.rigid.normalization import valid_wall


class WallFactor(NamedTuple):
    """The factor ``W = alpha z + beta (z - 1) = s z - beta`` of P."""

    alpha: Any  # coefficient of z, and the value of W at z = 1
    beta: Any  # coefficient of z - 1
    s: Any  # derivative of W in z, alpha + beta


def expand_wall(alpha: Any, beta: Any) -> WallFactor:
    """Return the factor W of a wall, for arrays and other types of numbers; W is linear in (alpha, beta).

    The signs of the wall's terms in the paper's eq. (11) occur in this function only; `recover_wall` is its inverse.
    """
    return WallFactor(alpha, beta, alpha + beta)


def recover_wall(alpha: Any, beta: Any) -> tuple[Any, Any]:
    """Return stiffness and damping of the wall with the factor ``W = alpha z + beta (z - 1)``."""
    return alpha, beta


class LoopFactors(NamedTuple):
    """The coefficients of the factors of P for each loop; all are NaN if an argument of the loop is out of range."""

    alpha: Array  # alpha, beta and s: the coefficients of W, see `WallFactor`
    beta: Array
    s: Array
    n_plus_1: Array  # n + 1, the exponent of z in T
    d_plus_1: Array  # d + 1
    c: Array  # e^-delta, the pole of the device
    em: Array  # 1 - c
    a2: Array  # coefficient of z in M
    h: Array  # -h/a2 is the larger zero of M
    q: Array  # -q is the smaller zero of M; 0 for integer delays


def factor_loop(alpha: Array, beta: Array, delta: Array, d: Array, fractional: bool) -> LoopFactors:
    """Return the coefficients of the factors of P; ``fractional`` is True if any delay is fractional."""
    xp = namespace(alpha, beta, delta, d)
    valid = valid_wall(alpha, beta, delta, d)
    delta, d = xp.where(valid, delta, 1.0), xp.where(valid, d, 0.0)
    n, f = split_delay(d)
    plant = discretize_mass(delta, f if fractional else None)
    h, q = factor_numerator(plant) if fractional else (plant.a1, 0.0 * plant.a1)
    alpha, beta, s = nan_unless(valid, *expand_wall(alpha, beta))
    return LoopFactors(alpha, beta, s, n + 1.0, d + 1.0, plant.c, plant.em, plant.a2, h, q)


class FactorValues(NamedTuple):
    """The values of the factors A, N and W of P at a point z, and their derivatives in z; dW/dz is `LoopFactors.s`."""

    A: Any  # (z - 1)(z - c)
    dA: Any
    N: Any  # z M for fractional delays, M for integer ones
    dN: Any
    ddN: Any
    W: Any


def evaluate_factors(z: Any, z_minus_1: Any, loop: LoopFactors, fractional: bool) -> FactorValues:
    """Return the values of the factors of P at z, with small relative errors also near z = 1.

    For integer delays, ``P = z^(1+n) A + N W``; for fractional delays, ``z P = z^(2+n) A + N W``.

    Args:
        z: Points: complex numbers, or objects of another type with the operations + and *.
        z_minus_1: z - 1.
        loop: Factors of P.
        fractional: Whether any delay is fractional.
    """
    N, dN, ddN = z * loop.a2 + loop.h, loop.a2, 0.0
    if fractional:
        z_plus_q = z + loop.q
        N, dN, ddN = N * z_plus_q, z_plus_q * loop.a2 + N, 2.0 * loop.a2
    W = z * loop.alpha + z_minus_1 * loop.beta
    return FactorValues(z_minus_1 * (z_minus_1 + loop.em), z_minus_1 * 2.0 + loop.em, N, dN, ddN, W)


def bound_wall_part(abs_z: Any, abs_z_minus_1: Any, loop: LoopFactors, fractional: bool) -> Array:
    """Return the sum of the magnitudes of the terms of N W, an upper bound of ``|N W|``, from |z| and |z - 1|."""
    xp = namespace(loop.alpha)
    N = (loop.a2 * abs_z + loop.h) * (abs_z + loop.q if fractional else 1.0)
    return N * (xp.abs(loop.alpha) * abs_z + xp.abs(loop.beta) * abs_z_minus_1)


class CircleFactors(NamedTuple):
    """The five factors of T and B on a circle |z| = r, each as a pair (value, slope).

    The value is that at z = r. At ``z = r e^(j w)``, ``|factor|^2 = value^2 + slope x`` with x = sin^2(w/2), because a
    factor z - a with real a satisfies ``|z - a|^2 = (r - a)^2 + 4 r a x``.
    """

    z_minus_1: tuple[Any, Any]
    z_minus_c: tuple[Any, Any]
    W: tuple[Any, Any]
    numerator: tuple[Any, Any]  # a2 z + h
    late: tuple[Any, Any]  # 1 + q/z


def expand_on_circle(r: Any, r_minus_1: Any, loop: LoopFactors) -> CircleFactors:
    """Return value and slope of each factor of T and B on the circle |z| = r, for r > 0."""
    four_r, ratio = 4.0 * r, loop.q / r
    return CircleFactors(
        (r_minus_1, four_r),
        (r_minus_1 + loop.em, four_r * loop.c),
        (loop.alpha * r + loop.beta * r_minus_1, four_r * loop.s * loop.beta),
        (loop.a2 * r + loop.h, -four_r * loop.a2 * loop.h),
        (1.0 + ratio, -4.0 * ratio),
    )


class UnitCircleFactors(NamedTuple):
    """The factors of the open loop L = B/T at ``z = e^(j w)``.

    ``L = -(W/z) M Z e^(-j (n + 1/2) w)/(2 |Z|^2 sin(w/2))``, where Z is defined by ``z - c = j conj(Z)``.
    """

    sine: Array  # sin(w/2)
    cosine: Array  # cos(w/2)
    u: Array  # 1 - cos w
    sin_w: Array
    W: tuple[Array, Array]  # real and imaginary part of W/z
    M: tuple[Array, Array]  # real and imaginary part of M
    Z: tuple[Array, Array]  # real and imaginary part of Z
    abs2_Z: Array  # |z - c|^2


def evaluate_on_unit_circle(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> UnitCircleFactors:
    """Return the factors of the open loop L at z = e^(j w), 0 < w <= pi, without cancellation near w = 0 and w = pi."""
    xp, wall = namespace(w, alpha), expand_wall(alpha, beta)
    sine, cosine = xp.sin(0.5 * w), xp.cos(0.5 * w)
    u, sin_w = 2.0 * sine * sine, 2.0 * sine * cosine
    M = 2.0 * (plant.a2 + plant.a0) * cosine * cosine - plant.gap, (plant.a2 - plant.a0) * sin_w
    abs2_Z = plant.em * plant.em + 2.0 * plant.c * u
    return UnitCircleFactors(
        sine, cosine, u, sin_w, (wall.alpha + wall.beta * u, wall.beta * sin_w), M, (sin_w, plant.em - u), abs2_Z
    )


def differentiate_open_loop(w: Array, alpha: Array, beta: Array, plant: DiscretePlant) -> Jet:
    """Return the open loop L at z = e^(j w) and its derivative in w, computed as ``L d(log L)/dw``."""
    xp, wall_beta = namespace(w, alpha), expand_wall(alpha, beta).beta
    point, n_plus_half = evaluate_on_unit_circle(w, alpha, beta, plant), plant.whole + 0.5
    W, M, Z = (re + 1j * im for re, im in (point.W, point.M, point.Z))
    z, conj_Z = xp.cos(w) + 1j * point.sin_w, xp.conj(Z)
    # Compute ``rate`` = d(log L)/dw as the sum over all factors. On the circle, dz/dw = j z and d(conj z)/dw = -j conj
    # z, so that the factor W/z = alpha + beta (1 - conj z) has the derivative j beta conj z, and conj Z has the
    # derivative z.
    rate = 1j * wall_beta * xp.conj(z) / W + 1j * (plant.a2 * z - plant.a0 * xp.conj(z)) / M - z / conj_Z
    rate = rate - 1j * n_plus_half - 0.5 * point.cosine / point.sine
    delay = xp.cos(n_plus_half * w) - 1j * xp.sin(n_plus_half * w)
    L = -W * M * delay / (2.0 * point.sine * conj_Z)
    return Jet(L, rate * L)


def expand_gain_difference(alpha: Any, beta: Any, plant: Any) -> tuple[Any, ...]:
    """Expand |B|^2 - |T|^2 at z = e^(j w) in powers of u = 1 - cos w, for arrays and other types of numbers.

    On the unit circle, |B|^2 = |M|^2 |W|^2 and |T|^2 = 2 u (em^2 + 2 c u) with em = 1 - c. Three coefficients are
    returned if a0 is None, i.e. for integer d, otherwise four. For alpha > 0 the polynomial is positive at u = 0 and
    has at most one root in (0, 2), the gain crossover, above which the polynomial is negative.
    """
    p1_squared, cross, alpha_squared = plant.p1 * plant.p1, beta * (alpha + beta) * 2, alpha * alpha
    # Write |W|^2 as alpha^2 + cross u. Compute bend = cross/2 - delta^2 in factored form, to avoid cancellation near
    # beta = delta. In the coefficient of u, 2 phi1^2 bend includes the term -2 em^2 from |T|^2, because em = delta phi1
    # (phi1 is ``plant.p1``).
    bend = (beta - plant.delta) * (beta + plant.delta) + alpha * beta
    # The expansion of |M|^2 is phi1^2 - 2 m1 u + product u^2; for integer d, a0 = 0 and therefore product = 0.
    if plant.a0 is None:
        m1 = plant.a1 * plant.a2
        return p1_squared * alpha_squared, (p1_squared * bend - m1 * alpha_squared) * 2, m1 * cross * -2 - plant.c * 4
    product = plant.a2 * plant.a0 * 4
    m1 = plant.a1 * (plant.a2 + plant.a0) + product
    h2 = product * alpha_squared - m1 * cross * 2 - plant.c * 4
    return p1_squared * alpha_squared, (p1_squared * bend - m1 * alpha_squared) * 2, h2, product * cross


def evaluate_at_nyquist(alpha: Any, beta: Any, plant: Any) -> tuple[Any, Any]:
    """Return the wall part B and the device part T/(-1)^(n+1) of P at z = -1, for arrays and other types of numbers."""
    return plant.gap * (alpha + beta * 2.0), (plant.c + 1.0) * 2.0


def expand_gain_difference_at_nyquist(alpha: Array, beta: Array, plant: DiscretePlant) -> tuple[Array, ...]:
    """Expand |T|^2 - |B|^2 at z = e^(j w) in powers of v = 1 + cos w, which is 0 at the Nyquist frequency w = pi."""
    wall, device = evaluate_at_nyquist(alpha, beta, plant)
    W_nyquist, sigma, mu = alpha + 2.0 * beta, plant.a2 + plant.a0, plant.a2 - plant.a0
    W_squared, cross, product = W_nyquist * W_nyquist, 2.0 * beta * (alpha + beta), 4.0 * plant.a2 * plant.a0
    # In powers of v, |M|^2 is gap^2 + g1 v + product v^2, and |W|^2 is W_squared - cross v.
    g1 = 2.0 * (mu * mu - plant.gap * sigma)
    return (
        (device - wall) * (device + wall),
        plant.gap * plant.gap * cross - g1 * W_squared - 2.0 * (plant.em * plant.em + 8.0 * plant.c),
        4.0 * plant.c - product * W_squared + g1 * cross,
        product * cross,
    )


def expand_at_one(loop: LoopFactors) -> tuple[Array, Array, Array]:
    """Return the Taylor coefficients of ``P/z^(1+n)`` at z = 1, of order 0, 1 and 2 in z - 1."""
    n_plus_1, M, slope = loop.n_plus_1, (loop.a2 + loop.h) * (1.0 + loop.q), loop.a2 - loop.h * loop.q
    first = slope - n_plus_1 * M
    second = 0.5 * n_plus_1 * (n_plus_1 + 1.0) * M - n_plus_1 * slope
    return M * loop.alpha, loop.em + M * loop.s + first * loop.alpha, 1.0 + first * loop.s + second * loop.alpha


class TaylorSeries(NamedTuple):
    """Taylor series in u of ``-P/(z M)`` at z = z0 (1 + u), and the quantities that bound its remainder."""

    terms: Any  # coefficients of the series, shape (terms, points)
    f: Any  # (z0 - 1)/z0, the factor of beta in W/z at z0
    sizes: list[Any]  # moduli of z - 1, z - c, q0, rho and z/(z + q) at z = z0 (q0, rho: see `expand_taylor`)


def expand_taylor(z_minus_1: Any, z_to_n: Any, loop: LoopFactors, fractional: bool, count: int) -> TaylorSeries:
    """Return the Taylor series of ``-P/(z M) = -T/(z M) - W/z`` at z = z0 (1 + u) in powers of u.

    Args:
        z_minus_1: z0 - 1.
        z_to_n: z0^n.
        loop: Coefficients of the factors of P, one loop per point.
        fractional: Whether the delays are fractional.
        count: Order of the series.
    """
    z, z_minus_c = z_minus_1 + 1.0, z_minus_1 + loop.em
    inverse_numerator = 1.0 / (loop.a2 * z + loop.h)
    # Multiply the series in u of the factors of ``-T/(z M) = -z^n (z - 1)(z - c)/((a2 z + h)(1 + q/z))`` one by one.
    # The divisor a2 z + h is proportional to 1 + rho u; q0 collects the constant factors of -T/(z M).
    q0, rho, z_over_z_plus_q = -z_to_n * inverse_numerator, loop.a2 * z * inverse_numerator, z / (z + loop.q)
    if fractional:
        q0 = q0 * z_over_z_plus_q
    n, w, orders = loop.n_plus_1 - 1.0, 1.0 / z, np.arange(count)[:, None]
    power = np.ones((count + 1, z.size))
    np.cumprod((n - orders) / (orders + 1.0), axis=0, out=power[1:])
    terms = z_minus_1 * z_minus_c * q0 * power
    terms[1:] += z * (z_minus_1 + z_minus_c) * q0 * power[:-1]
    terms[2:] += z * z * q0 * power[:-2]
    _divide_series(terms, rho)
    if fractional:
        terms[1:] += terms[:-1].copy()
        _divide_series(terms, z_over_z_plus_q)
    # Subtract W/z = alpha + beta (1 - 1/z).
    f = z_minus_1 * w
    terms[0] -= f * loop.beta + loop.alpha
    terms[1:] += (-1.0) ** (orders + 1.0) * (w * loop.beta)
    return TaylorSeries(terms, f, [np.abs(part) for part in (z_minus_1, z_minus_c, q0, rho, z_over_z_plus_q)])


def _divide_series(terms: np.ndarray, x: Any) -> None:
    """Divide power series in u by 1 + x u in place, by 1/(1 + x u) = (1 - x u)(1 + x^2 u^2)(1 + x^4 u^4) ..."""
    power, x = 1, -x
    while power < len(terms):
        terms[power:] += x * terms[:-power]
        power, x = 2 * power, x * x
