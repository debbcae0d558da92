"""Return the dominant pole of arrays of walls: its modulus (the spectral radius), angle and decay rate.

The dominant pole is the pole with the largest modulus. `stability.rigid.dominant.arrays` computes and certifies it;
with method "companion", `stability.rigid.poles` computes all poles instead. This module contains the public functions.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from zwidth.core.errors import InputError, check_choice
from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import is_jax, namespace
from zwidth.numerics.evaluate import broadcast, check_scalars, evaluate
from zwidth.stability.results import DominantPole
from zwidth.stability.rigid.broadcasting import NAMES
from zwidth.stability.rigid.dominant.arrays import ACCURACY, find_poles
from zwidth.stability.rigid.dominant.compiled import compute_jax_poles
from zwidth.stability.rigid.normalization import status_of_results, wall_status
from zwidth.stability.rigid.poles import radius_by_companion

RadiusMethod: TypeAlias = Literal["auto", "newton", "companion"]

# Smallest relative error that may be requested. With a smaller one, the circles on which poles are counted would be so
# close together that rounding errors make the counts uncertain.
MIN_ACCURACY = 1e-12


def spectral_radius(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: RadiusMethod = "auto",
    accuracy: float | None = None,
) -> Array:
    """Return the spectral radius of the loop: the modulus of its dominant pole.

    The spectral radius is ``max |z|`` over ``P(z) = 0``, see `zwidth.char_poly`. The loop is stable if the radius is
    below 1. A response decays by this factor per period, after faster components have decayed.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional, also mixed in one array. All four broadcast.
        method: "newton" (and "auto") computes the dominant pole and certifies each value by counting the poles inside
            a circle, at a cost independent of d; "companion" computes all poles.
        accuracy: largest relative error, 1e-9 by default, at least 1e-12. If two poles nearly coincide, the radius is
            ill-conditioned: rounding errors of the coefficients then change it by up to 1e-8, whatever the accuracy
            (2.8e-9 was observed near a double pole at z = -1). A larger ``accuracy`` saves next to no time. It has no
            effect with method "companion".

    Returns:
        Array of the broadcast shape: below 1 if and only if `zwidth.is_stable` returns True. NaN for a point out of
        range, and if no error bound could be certified (some walls with multiple poles).

    Raises:
        InputError: an argument is no real number or a scalar out of range, shapes do not broadcast, a name is unknown,
            or the accuracy is out of reach.
        TracedDelayError: d is traced with method "companion".

    Numerics:
        Direct calls compute in float64; grids and up to 262,144 other walls are computed without JAX. JAX arrays are
        computed on the processors that store them. Inside `jit`, the number type is JAX's default, and d may be traced;
        with float32, ``accuracy`` is 1e-4 by default. On grids, one Taylor series with a certified error bound is used
        for each cell of neighboring walls (`stability.rigid.dominant.grid`). Inside `jit`, this applies only if JAX
        uses a single CPU. Derivatives are those of the dominant pole, up to the second order; they are NaN if this pole
        is a multiple pole. Near a k-fold pole the error of the radius is about 1e-16^(1/k), whatever the accuracy. If
        the radius is within 1e-16 of 1, use `decay_rate`.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.spectral_radius(0.5, 0.5, 0.1, 1):.6f}")
        1.207346
    """
    values = (alpha, beta, delta, d)
    required = _check_accuracy(method, accuracy)
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    if method == "companion":
        return radius_by_companion(*values)
    if any(map(is_jax, values)):
        return compute_jax_poles(arguments, accuracy, with_rate=False)[0]
    return np.asarray(find_poles(broadcast(arguments), required).radius)[()]


def decay_rate(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> Array:
    """Return the decay rate of the dominant pole: ``-ln(rho)`` per period, with the spectral radius rho.

    After k periods a disturbance has decayed to about ``exp(-decay_rate k)``. The time constant is ``1/decay_rate``
    periods, the stability margin ``1 - rho = -expm1(-decay_rate)``.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional. All four broadcast.

    Returns:
        Array of the broadcast shape, per period: positive if and only if `zwidth.is_stable` returns True, 0 if the
        dominant pole is 1, negative for growing responses. NaN for a point out of range, and if fewer than three digits
        of the rate are certain: within about 1e-12 of the boundary in alpha or beta, and near (almost) dominant
        multiple poles.

    Raises:
        InputError: an argument is no real number or a scalar out of range, or shapes do not broadcast.

    Numerics:
        The rate is computed from z - 1, for the dominant pole z of `zwidth.spectral_radius`. For soft walls the rate
        has at least 11 digits, however small it is; for a pole pair near the unit circle its absolute error is about
        1e-16. If the certified error bound is not below a thousandth of the rate, the rate is NaN. If the magnitudes of
        some poles agree within 1e-12, the rate is that of any of them. JAX arrays are computed on the processors that
        store them. Inside `jit`, the number type is JAX's default; with float32, the rate has no error bound.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.decay_rate(1e-15, 1e-9, 1e-9, 1):.6e}")
        9.999993e-10
    """
    values = (alpha, beta, delta, d)
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    if any(map(is_jax, values)):
        return compute_jax_poles(arguments, None, with_rate=True)[1]
    return np.asarray(find_poles(broadcast(arguments), ACCURACY, with_rate=True).rate)[()]


def dominant_pole(alpha: ArrayLike, beta: ArrayLike, delta: ArrayLike, d: ArrayLike) -> DominantPole:
    """Return the dominant pole of the loop, i.e. the pole ``z = radius e^(j angle)`` with the largest modulus.

    After faster components have decayed, the response oscillates with the angular frequency ``angle`` in rad per
    sampling period; with the period T this is the frequency ``angle/(2 pi T)`` in Hz.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, integer or fractional. All four broadcast.

    Returns:
        Named tuple of arrays of the broadcast shape: ``radius``, see `zwidth.spectral_radius`; ``angle`` in rad, from 0
        to pi, 0 for a positive real pole and pi for a negative real one; ``decay_rate`` per period, see
        `zwidth.decay_rate`; ``status``, see `zwidth.Status`. A value that is not certified is NaN, with a status that
        is not 0.

    Raises:
        InputError: an argument is no real number or a scalar out of range, or shapes do not broadcast.

    Numerics:
        As for `zwidth.spectral_radius`. The angle is that of a pole whose modulus is certified to be the spectral
        radius within 1e-9; its error is at most 1e-9, near a k-fold pole about 1e-16^(1/k). If the moduli of several
        poles agree within 1e-9, the angle is that of any of them. Inside `jit`, values have the ambient precision.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> import zwidth
        >>> pole = zwidth.dominant_pole(0.5, 0.5, 0.1, 1)
        >>> print(f"{pole.radius:.6f} {pole.angle:.6f}")
        1.207346 0.694368
    """
    values = (alpha, beta, delta, d)
    arguments = dict(zip(NAMES, values, strict=True))
    check_scalars(arguments)
    if any(map(is_jax, values)):
        radius, rate, angle = compute_jax_poles(arguments, None, with_rate=True)
        return DominantPole(radius, angle, rate, evaluate(_status_kernel, arguments | {"rate": rate}))
    arrays = broadcast(arguments)
    radius, certified, rate, angle = find_poles(arrays, ACCURACY, with_rate=True, with_angle=True)
    status = status_of_results(radius.shape, (radius, rate, angle), tuple(arrays[:2]), tuple(arrays[2:]))
    status = np.where((status == Status.OK) & ~certified, Status.NOT_CONVERGED, status).astype(np.int32)
    return DominantPole(*(np.asarray(leaf)[()] for leaf in (radius, angle, rate, status)))


def _status_kernel(alpha: Array, beta: Array, delta: Array, d: Array, rate: Array) -> Array:
    """Return the status of each dominant pole, given its decay rate, which is NaN if the pole is not certified."""
    xp, status = namespace(rate), wall_status(alpha, beta, delta, d)
    return xp.where((status == Status.OK) & xp.isnan(rate), int(Status.NOT_CONVERGED), status)


def _check_accuracy(method: str, accuracy: float | None) -> float:
    """Return the accuracy; raise `InputError` for an unknown method or an accuracy out of range."""
    check_choice("method", method, get_args(RadiusMethod))
    if accuracy is None:
        return ACCURACY
    least = 0.0 if method == "companion" else MIN_ACCURACY
    number: Any = accuracy
    valid = isinstance(number, int | float | np.floating) and np.isfinite(number) and 0 < number < 1 and number >= least
    if not valid:
        raise InputError(
            f"accuracy: got {accuracy!r}; a relative error of at least {least:g} and below 1 is needed for "
            f"method={method!r}; 'companion' takes any"
        )
    return float(number)
