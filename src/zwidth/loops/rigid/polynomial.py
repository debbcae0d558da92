"""The closed loop of device and virtual wall, affine in (alpha, beta).

Held delay d = n + f, with N(z) = a2 z^2 + a1 z + a0 of `loops.rigid.device`:

    P(z) = z^(2+n) (z - 1)(z - c) + N(z) (alpha z + beta (z - 1))

For whole d, a0 = 0 and one factor z cancels; that is the paper's polynomial (17) over -delta^2, monic and
factored. Pole methods use the coefficients `coefficients`, frequency methods `frequency_boundary`.
"""

from __future__ import annotations

from math import factorial
from typing import NamedTuple

import numpy as np

from zwidth.arrays.xp import horner, namespace, nan_with_nan_slopes
from zwidth.loops.rigid.device import Plant, held_plant, split_delay, valid_wall
from zwidth.loops.rigid.folding import Degree, map_by_degree
from zwidth.words.errors import InputError, check_choice
from zwidth.words.types import DELAY_MODELS, Array, ArrayLike, Coefficients, Reals


class Affine(NamedTuple):
    """``P = D + alpha N1 + beta N2``: three coefficient vectors of one length, highest power first."""

    D: Coefficients
    N1: Coefficients
    N2: Coefficients


def affine(delta: Reals, d: Reals, degree: Degree) -> Affine:
    """The three coefficient vectors of devices of one degree, along a new last axis of degree.poles + 1."""
    plant = held_plant(delta, d - degree.whole if degree.fractional else None)
    xp = namespace(plant.a2)
    zero, one = 0.0 * plant.a2, 0.0 * plant.a2 + 1.0
    head = [one, -(1.0 + plant.c), plant.c]
    # N(z) and (z - 1) N(z), without the common factor z that a whole delay leaves in them; a2 - a1 is then the gap.
    if degree.fractional:
        n = [plant.a2, plant.a1, plant.a0]
        differences = [plant.a1 - plant.a2, plant.a0 - plant.a1]
    else:
        n = [plant.a2, plant.a1]
        differences = [-plant.gap]
    pad = [zero] * (degree.poles - len(n))
    rows = (head + [zero] * (degree.poles - 2), [*pad, *n, zero], [*pad, n[0], *differences, -n[-1]])
    return Affine(*(xp.stack(row, axis=-1) for row in rows))


def coefficients(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Coefficients:
    """Coefficients of P, highest power first, along a new last axis of degree.poles + 1; P is monic."""
    parts = affine(delta, d, degree)
    return parts.D + alpha[..., None] * parts.N1 + beta[..., None] * parts.N2


class Wall(NamedTuple):
    """A wall by its normalized stiffness and damping, or an array of them."""

    alpha: Reals
    beta: Reals


class FrequencyLoop(NamedTuple):
    """What the frequency methods need of a point: computed once, then evaluated at many frequencies."""

    plant: Plant
    lag: Array  # whole periods of delay; the whole exponent d in the fractional-power model


def frequency_loop(delta: Array, d: Array, delay_model: str) -> FrequencyLoop:
    """The loop of one (delta, d) for evaluation on the unit circle."""
    if delay_model == "fractional_power":
        return FrequencyLoop(held_plant(delta), d)
    whole, fraction = split_delay(d)
    return FrequencyLoop(held_plant(delta, fraction), whole)


def frequency_boundary(omega: Reals, loop: FrequencyLoop, delay_model: str) -> Wall:
    """The wall (alpha, beta) that puts a pole at z = e^(j omega), in closed form, for one point.

    On the unit circle P = 0 is a real linear 2x2 system. With s = sin(omega/2), C = cos(omega/2), M = N(z)/z,
    G = (z - c)/M, W = e^(j k omega) G and k = n + 1/2, it solves to

        beta = -Re W / C          alpha = 2 s (Im W - s beta)

    Re W vanishes with C at omega = pi. cos(k omega)/C and Im G/C are therefore formed as ratios that stay finite.
    """
    plant, whole = loop
    xp = namespace(omega, whole, plant.c)
    half = 0.5 * omega
    s, cos_half, sin_w = xp.sin(half), xp.cos(half), xp.sin(omega)
    below_pi = cos_half > 0
    c_safe = xp.where(below_pi, cos_half, 1.0)
    k = whole + 0.5
    re_m = -plant.gap + 2.0 * (plant.a2 + plant.a0) * cos_half * cos_half
    im_m_over_sin = plant.a2 - plant.a0
    re_z = plant.em - 2.0 * s * s
    norm = re_m * re_m + (im_m_over_sin * sin_w) ** 2
    finite = norm > 0
    norm = xp.where(finite, norm, 1.0)
    re_g = (re_z * re_m + sin_w * im_m_over_sin * sin_w) / norm
    # sin_w/C = 2 s
    im_g_over_c = 2.0 * s * (re_m - re_z * im_m_over_sin) / norm
    sin_k, cos_k = xp.sin(k * omega), xp.cos(k * omega)
    ratio = _cosine_ratio(omega, whole, c_safe, delay_model)
    beta = -(ratio * re_g - sin_k * im_g_over_c)
    alpha = 2.0 * s * (sin_k * re_g + cos_k * im_g_over_c * cos_half - s * beta)
    # Where N(z) vanishes (delta = 0 at omega = pi) the curve runs to infinity with alternating sign.
    far = xp.inf * (1.0 - 2.0 * xp.mod(whole, 2.0))
    inside = (omega >= 0) & (omega <= np.pi)
    limits = ((alpha, -far), (beta, far))
    return Wall(*(xp.where(inside, xp.where(finite, value, limit), xp.nan) for value, limit in limits))


def _cosine_ratio(omega: Array, lag: Array, cos_half: Array, delay_model: str) -> Array:
    """``cos((lag + 1/2) omega)/cos(omega/2)``, finite at pi for a whole lag."""
    if delay_model == "held":
        return _whole_cosine_ratio(omega, lag, cos_half)
    # With lag = n + e, n the nearest whole number: only the part with sin(e omega) is unbounded towards pi, and it
    # vanishes with e.
    xp = namespace(omega, lag)
    nearest = xp.round(lag)
    excess = (lag - nearest) * omega
    unbounded = xp.sin((nearest + 0.5) * omega) * xp.sin(excess) / cos_half
    return _whole_cosine_ratio(omega, nearest, cos_half) * xp.cos(excess) - unbounded


def _whole_cosine_ratio(omega: Array, n: Array, cos_half: Array) -> Array:
    """The ratio for a whole lag n: near pi as ``(-1)^n sin(k v)/sin(v/2)``, k = n + 1/2, v = pi - omega."""
    xp = namespace(omega, n)
    k = n + 0.5
    # pi is not a float64: its second half keeps v exact to the last digit.
    v = (np.pi - omega) + 1.2246467991473532e-16
    sign = 1.0 - 2.0 * xp.mod(n, 2.0)
    near = sign * 2.0 * k * _cardinal_sine(k * v) / _cardinal_sine(0.5 * v)
    return xp.where(omega > 2.0, near, xp.cos(k * omega) / cos_half)


_CARDINAL = [(-1.0) ** i / factorial(2 * i + 1) for i in range(11)]


def _cardinal_sine(x: Array) -> Array:
    """``sin(x)/x``, for small x by its series: the quotient has no digit of its derivatives there."""
    xp = namespace(x)
    small = xp.abs(x) < 1.5
    safe = xp.where(small, 2.0, x)
    inner = xp.where(small, x, 0.0)
    return xp.where(small, horner(inner * inner, _CARDINAL), xp.sin(safe) / safe)


def check_delay_model(delay_model: str) -> None:
    """Raise `InputError` unless the name of a delay model is known."""
    check_choice("delay", delay_model, DELAY_MODELS)


def check_has_poles(delay_model: str) -> None:
    """Refuse the fractional power where poles are asked for."""
    check_delay_model(delay_model)
    if delay_model == "fractional_power":
        raise InputError(
            "delay: 'fractional_power' has no poles (z^d has other sheets, always with roots outside the unit "
            "circle); use delay='held' for poles, radius and stability, or ask for the boundary or the ridge"
        )


def char_poly(
    alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike, *, delay: str = "held"
) -> Coefficients:
    """Return the coefficients of the monic characteristic polynomial, highest power first.

    ``P(z) = z^(2+n) (z - 1)(z - c) + (z n0(z) + n1(z)) (alpha z + beta (z - 1))``, d = n + f, ``c = e^-delta``; for
    whole d the paper's (17) over ``-delta^2``, delta = 0 included. Stable means: all zeros inside the unit circle.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not; concrete also inside `jit`, because it decides the degree.
            All four broadcast.
        delay: only "held" has a polynomial.

    Returns:
        Array of the broadcast shape with one more axis at the end: 4 + d coefficients for whole d, 5 + n
        otherwise. Where degrees are mixed, shorter polynomials have zeros in front. A point out of range is NaN.

    Raises:
        InputError: an argument is no real number or a scalar out of range, shapes do not broadcast, or
            ``delay="fractional_power"``.
        TracedDelayError: d is traced.

    Numerics:
        Every coefficient is accurate to a few rounding errors of the terms it is the sum of, for every delta.

    References:
        Hulin, Preusche, Hirzinger 2006, eqs. (15), (17).

    Example:
        >>> import numpy as np, zwidth
        >>> print(np.array2string(zwidth.char_poly(0.5, 0.5, 0.0, 0), precision=2))
        [ 1.   -1.5   1.25 -0.25]
    """
    check_has_poles(delay)
    return map_by_degree(_char_poly_kernel, (alpha, beta, delta, d), lead=True)


def _char_poly_kernel(alpha: Reals, beta: Reals, delta: Reals, d: Reals, degree: Degree) -> Coefficients:
    ok = valid_wall(alpha, beta, delta, d)
    spoiled = nan_with_nan_slopes(ok, alpha, beta, delta, d)[..., None]
    xp = namespace(alpha, beta, delta, d)
    alpha, beta, delta = (xp.where(ok, value, 0.0) for value in (alpha, beta, delta))
    return coefficients(alpha, beta, delta, xp.where(ok, d, float(degree.whole)), degree) + spoiled
