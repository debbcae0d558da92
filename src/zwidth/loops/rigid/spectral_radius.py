"""The spectral radius of arrays of walls, by a method of one's choice."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from zwidth.arrays.batching import broadcast, elementwise, to_caller
from zwidth.arrays.xp import is_traced
from zwidth.loops.domain import check_scalars
from zwidth.loops.rigid.degrees import NAMES
from zwidth.loops.rigid.outermost_poles import prove_radii
from zwidth.loops.rigid.pole_search import traced_kernel
from zwidth.loops.rigid.poles import radius_and_bound, radius_by_companion
from zwidth.loops.rigid.polynomial import check_has_poles
from zwidth.words.errors import InputError, check_choice
from zwidth.words.status import Method, Status
from zwidth.words.types import Array, ArrayLike, DelayModel

RadiusMethod: TypeAlias = Literal["auto", "newton", "companion"]
RADIUS_METHODS: tuple[str, ...] = get_args(RadiusMethod)

_DEFAULT_ACCURACY = 1e-9
# Closer in, the rounding of two counts would meet.
_LEAST_ACCURACY = 1e-12


class Radius(NamedTuple):
    """Spectral radii with absolute error bounds, certificates, status and `Method`, all of the broadcast shape."""

    radius: Array
    error: Array
    certified: Array
    status: Array
    method: Array


def spectral_radius(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: RadiusMethod = "auto",
    accuracy: float | None = None,
    delay: DelayModel = "held",
) -> Array:
    """Return the spectral radius of the loop: the modulus of its largest pole.

    ``max |z|`` over ``P(z) = 0``, see `zwidth.char_poly`; the loop is stable where it is below 1. One period multiplies
    a slowly decaying motion by it.

    Args:
        alpha: normalized stiffness K T^2/m.
        beta: normalized virtual damping B T/m.
        delta: normalized physical damping b T/m, >= 0.
        d: delay in periods, >= 0, whole or not, mixed in one array. All four broadcast.
        method: "newton" (and "auto") finds the outermost pole and proves each value by counts of the poles inside
            a circle, at a cost that does not grow with d; "companion" computes all poles.
        accuracy: relative error to prove, 1e-9 by default, at least 1e-12. Halley's method ends with nearly all digits
            whatever is asked for, so nothing becomes faster by asking for less; "companion" takes any.
        delay: only "held" has poles.

    Returns:
        Array of the broadcast shape: below 1 exactly where `zwidth.is_stable` says so. NaN for a point out of range,
        and where no error bound could be proved (some walls with multiple poles).

    Raises:
        InputError: an argument is no real number or a scalar out of range, shapes do not broadcast, a name is unknown,
            or the accuracy is out of reach.
        TracedDelayError: d is traced with method "companion".

    Numerics:
        Float64 when called directly, few points without JAX; the ambient precision inside `jit`, where d may be traced.
        Derivatives are those of the outermost pole, of every order up to the second; NaN where it is a multiple one.
        Error bounds and certificates come from `bound_radius`: next to a k-fold pole the radius is known to about
        1e-16^(1/k). How slowly a loop decays that is stable by less than 1e-16, `decay_rate` tells.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.spectral_radius(0.5, 0.5, 0.1, 1):.6f}")
        1.207346
    """
    values = (alpha, beta, delta, d)
    wanted = _check_radius(method, accuracy, delay)
    check_scalars(alpha=alpha, beta=beta, delta=delta, d=d)
    if method == "companion":
        return radius_by_companion(*values)
    if is_traced(*values):
        return _exp(elementwise(traced_kernel, NAMES, values, (_has_fraction(d),)))
    arrays = broadcast(NAMES, values)
    return to_caller(prove_radii(arrays, wanted)[0].reshape(arrays[0].shape), values)


def _exp(value: Array) -> Array:
    import jax.numpy as jnp

    return jnp.exp(value)


def _has_fraction(d: ArrayLike) -> bool:
    if is_traced(d):
        return True
    delays = np.asarray(d, np.float64)
    return bool(np.any(delays != np.floor(delays)))


def bound_radius(
    alpha: ArrayLike,
    beta: ArrayLike,
    delta: ArrayLike,
    d: ArrayLike,
    *,
    method: RadiusMethod = "auto",
    accuracy: float | None = None,
    delay: DelayModel = "held",
) -> Radius:
    """Return the spectral radius with an error bound for every point.

    Args:
        alpha, beta, delta, d, method, accuracy, delay: as for `zwidth.spectral_radius`.

    Returns:
        Radius: ``radius``; ``error``, absolute: where ``certified``, all poles were counted inside ``radius + error``,
        and one is not inside ``radius - error``, by a count too or because no polynomial of degree N has its zeros
        farther than N |P/P'| from any z; in float64 arithmetic and with rounding errors that could not have decided
        either, and the error is within what was asked for. ``status``: INVALID_INPUT or OUT_OF_RANGE with NaN;
        NOT_CONVERGED where the error is larger than asked for (next to multiple poles; it is then the least one that
        two counts do prove) or infinite where there is none. With "companion" the error bounds the distance from the
        largest computed pole to a true one, and nothing is certified. ``method``: a `Method`.

    Raises:
        InputError: as for `zwidth.spectral_radius`, and for traced values.

    References:
        Hulin, Preusche, Hirzinger 2006, eq. (17).

    Example:
        >>> from zwidth.loops.rigid.spectral_radius import bound_radius
        >>> found = bound_radius(0.5, 0.5, 0.1, 1)
        >>> bool(found.certified), f"{found.radius:.6f}"
        (True, '1.207346')
    """
    values = (alpha, beta, delta, d)
    wanted = _check_radius(method, accuracy, delay)
    if is_traced(*values):
        raise InputError("bound_radius: got traced values; inside a JAX transformation use `zwidth.spectral_radius`")
    check_scalars(alpha=alpha, beta=beta, delta=delta, d=d)
    if method == "companion":
        return Radius(*radius_and_bound(*values))
    arrays = broadcast(NAMES, values)
    radius, proved, status = prove_radii(arrays, wanted)
    ok = status == Status.OK
    # Of the pole at 1 of a wall without stiffness, and of any other, the logarithm has all the digits.
    error = np.where(np.isinf(proved), np.inf, (np.expm1(proved) + 2e-16) * radius)
    certified = ok & (proved <= wanted)
    status = np.where(ok & ~certified, np.int32(Status.NOT_CONVERGED), status).astype(np.int32)
    leaves = (radius, np.where(ok, error, np.nan), certified, status, np.full(status.size, Method.NEWTON, np.int32))
    return to_caller(Radius(*(leaf.reshape(arrays[0].shape) for leaf in leaves)), values)


def _check_radius(method: str, accuracy: float | None, delay_model: str) -> float:
    check_has_poles(delay_model)
    check_choice("method", method, RADIUS_METHODS)
    if accuracy is None:
        return _DEFAULT_ACCURACY
    least = 0.0 if method == "companion" else _LEAST_ACCURACY
    number: Any = accuracy
    good = isinstance(number, int | float | np.floating) and np.isfinite(number) and 0 < number < 1 and number >= least
    if not good:
        raise InputError(
            f"accuracy: got {accuracy!r}; a relative error of at least {least:g} and below 1 is needed for "
            f"method={method!r}; 'companion' takes any"
        )
    return float(number)
