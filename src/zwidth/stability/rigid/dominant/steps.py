"""Evaluate the characteristic polynomial P and its derivatives at a point, and take Newton or Halley steps to a pole.

The point is ``z = e^(re + j im)``; steps are taken in log z. P is evaluated in factored form
(`stability.rigid.characteristic_polynomial.evaluate_factors`),

    P = z^p A + N W

with p = 1 + n for integer delays; for fractional delays p = 2 + n, and z P replaces P. All terms are computed from z -
1, so that poles near 1 keep their relative accuracy. P is divided by the larger of |z^p| and 1 to avoid overflow for
large n. As a function of log z, P is close to an exponential function; for such functions Halley's method converges
from distant starting points, and cubically near the pole.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.core.types import Array
from zwidth.core.xp import COSINE, SINE, epsilon, horner, namespace
from zwidth.numerics.complex_pairs import Pair, make_complex
from zwidth.numerics.polynomials import abs2
from zwidth.stability.rigid.characteristic_polynomial import LoopFactors, bound_wall_part, evaluate_factors

# Bound on the rounding error of P, in rounding units of the sum of the moduli of the terms of P. The rounding error of
# the phase p im of z^p is added separately.
FACTOR_ROUNDING = 16.0
# Longest step of Halley's method, relative to 1/(2 + n). Longer steps could lead to other poles, because neighboring
# poles of a long delay n are about 2 pi/n apart in log z.
MAX_STEP = 1.0


class PolynomialValue(NamedTuple):
    """P/max(|z^p|, 1), its derivatives in log z at constant divisor, and a bound on its rounding error."""

    p: Any  # P, divided by the larger of |z^p| and 1
    first: Any  # first derivative in log z
    second: Any  # second derivative in log z
    rounding: Array  # bound on the rounding error of the field p


def _sine_and_cosine(x: Array, xp: Any) -> tuple[Array, Array]:
    """Return sine and cosine for |x| <= pi/2."""
    if xp is np:
        # Convert single results to Python floats, because arithmetic with NumPy scalars is slower.
        return (float(np.sin(x)), float(np.cos(x))) if type(x) is float else (np.sin(x), np.cos(x))
    square = x * x
    return x * horner(square, SINE), horner(square, COSINE)


def evaluate_polynomial(re: Array, im: Array, loop: LoopFactors, fractional: bool) -> PolynomialValue:
    """Evaluate P and its derivatives at ``z = e^(re + j im)``, |im| <= pi; for fractional delays, those of z P."""
    xp = namespace(re, loop.alpha)
    number: Any = make_complex if xp is np else Pair
    if xp is np and not np.ndim(re):
        # Convert single numbers to Python's float and complex, because arithmetic with these is several times faster.
        number, re, im, loop = complex, float(re), float(im), LoopFactors(*map(float, loop))
    power = loop.n_plus_1 + 1.0 if fractional else loop.n_plus_1
    expm1_re = float(np.expm1(re)) if number is complex else xp.expm1(re)
    r = 1.0 + expm1_re
    sine, cosine = _sine_and_cosine(0.5 * im, xp)
    z_minus_1 = number(expm1_re - 2.0 * r * sine * sine, 2.0 * r * sine * cosine)
    log_power = power * re
    # Compute -|log_power| by a selection and not by abs(), because at log_power = 0 the derivative of abs() would be
    # wrong for both scales below.
    smaller = xp.exp(xp.where(log_power < 0, log_power, -log_power))
    device_scale, wall_scale = xp.where(log_power < 0, smaller, 1.0), xp.where(log_power < 0, 1.0, smaller)
    phase = power * im
    full_turns = xp.round(phase / (2.0 * np.pi))
    if number is complex:
        device_scale, wall_scale, full_turns = float(device_scale), float(wall_scale), float(full_turns)
    phase = phase - 2.0 * np.pi * full_turns
    half_sine, half_cosine = _sine_and_cosine(0.5 * phase, xp)
    delay = number(device_scale * (1.0 - 2.0 * half_sine * half_sine), 2.0 * device_scale * half_sine * half_cosine)
    z = z_minus_1 + 1.0
    A, dA, N, dN, ddN, W = evaluate_factors(z, z_minus_1, loop, fractional)
    N, dN, device_slope, z_squared = N * wall_scale, dN * wall_scale, z * dA, z * z
    d, d1, bend = N * W, (W * dN + N * loop.s) * z, dN * (2.0 * loop.s)
    if fractional:
        bend = W * (ddN * wall_scale) + bend
    d2 = z_squared * bend + d1
    abs_z_minus_1 = xp.abs(z_minus_1.real) + xp.abs(z_minus_1.imag)
    wall_size = wall_scale * bound_wall_part(r, abs_z_minus_1, loop, fractional)
    t1 = delay * (A * power + device_slope)
    t2 = delay * ((A * power + device_slope * 2.0) * power + device_slope + z_squared * 2.0)
    angle_rounding = power * (xp.abs(re) + xp.abs(im))
    rounding = (
        device_scale * abs_z_minus_1 * (abs_z_minus_1 + loop.em) * (FACTOR_ROUNDING + angle_rounding)
        + FACTOR_ROUNDING * wall_size
    )
    values = delay * A + d, t1 + d1, t2 + d2
    # Convert single results to NumPy's complex type, because Python's complex type raises an error on division by zero.
    return PolynomialValue(
        *(map(np.complex128, values) if number is complex else values), rounding=epsilon(re) * rounding
    )


class NewtonStep(NamedTuple):
    """A Newton step in log z, with an error bound before the step and an error estimate after it."""

    re: Array  # the step in Re log z
    im: Array  # the step in Im log z
    radius: Array  # a pole lies within this distance, relative to |z|, of the point z before the step
    end_error: Array  # estimated distance of the pole from the point after the step


def newton_step(re: Array, im: Array, loop: LoopFactors, fractional: bool) -> NewtonStep:
    """Compute one Newton step from ``log z = re + j im``, |im| <= pi, with error bounds."""
    xp = namespace(re, loop.alpha)
    value = evaluate_polynomial(re, im, loop, fractional)
    norm = abs2(value.first)
    step = value.p * value.first.conjugate() * (-1.0 / norm)
    # Compute the radius from a theorem: a polynomial P of degree N has a zero within the distance N |P/P'| of any
    # point.
    degree, slope = loop.n_plus_1 + (3.0 if fractional else 2.0), xp.sqrt(norm)
    rounding_error = value.rounding / slope
    # Estimate the error after the step from the second derivative, which covers double poles: near these, the error is
    # half of the step.
    curvature_error = abs2(step) * xp.sqrt(abs2(value.second)) / slope
    return NewtonStep(
        step.real,
        step.imag,
        degree * (xp.sqrt(abs2(value.p)) / slope + rounding_error),
        rounding_error + curvature_error,
    )


def halley_step(re: Array, im: Array, loop: LoopFactors, fractional: bool) -> tuple[Array, Array]:
    """Return re and im after one Halley step, limited to `MAX_STEP`; the result has 0 <= im <= pi."""
    xp = namespace(re, loop.alpha)
    value = evaluate_polynomial(re, im, loop, fractional)
    inverse_first = value.first.conjugate() * (1.0 / abs2(value.first))
    step = value.p * inverse_first
    denominator = step * (value.second * inverse_first) * -0.5 + 1.0
    step = step * denominator.conjugate() * (-1.0 / abs2(denominator))
    size = xp.sqrt(abs2(step)) * (loop.n_plus_1 + 1.0)
    factor = MAX_STEP / xp.maximum(size, MAX_STEP)
    return shift_pole(re, im, step.real * factor, step.imag * factor)


def shift_pole(re: Array, im: Array, step_re: Array, step_im: Array) -> tuple[Array, Array]:
    """Add a step to log z = re + j im; if z is then below the real axis, replace it by its complex conjugate."""
    xp = namespace(re)
    im = xp.abs(im + step_im)
    return re + step_re, xp.where(im > np.pi, 2.0 * np.pi - im, im)
