"""What a device needs for a wanted stiffness: damping, sampling period, shortness of delay, or mass.

Every answer is a zero of ``log(K_max/K)`` in one quantity with the others fixed. The search is bracketed by bounds that
were found over delta from 0 to 1e5 and d from 0 to 1e6, with room to spare:

    0.2 (1/D^2 + delta/D) < alpha_max(delta, d) < 6 (1/D^2 + delta/D)     D = d + 1
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from zwidth._types import Array, ArrayLike
from zwidth.batching import pointwise
from zwidth.design.crossing import Function, outermost_zero
from zwidth.design.stiffness import check_stiffness
from zwidth.errors import InputError
from zwidth.loop import poison
from zwidth.scene import denormalize, normalize
from zwidth.stability.ridge import ridge_kernel
from zwidth.status import Status

_LEAST, _MOST = 0.2, 6.0
# A delay of this many periods is as good as continuous time, to 1e-6 of the stiffness; a device with this delta is
# as good as massless.
_LIMIT = 1e6
_CHUNK = 1 << 11
# Smaller batches are filled up: compiling for one more size takes far longer than solving for this many devices.
_LEAST_BATCH = 1 << 6


class Requirement(NamedTuple):
    """The value asked for, in SI units, and a `zwidth.Status`."""

    value: Array
    status: Array


def _alpha(delta: Array, d: Array) -> Array:
    return ridge_kernel(delta, d, "held").alpha


def _requirement(
    function: Function, bracket: tuple[Array, Array, Array], ok: Array, inputs: tuple[Array, ...], free: bool = False
) -> Requirement:
    """Solve and attach the status. ``free``: where the function never reaches 0, nothing at all is required."""
    value, found = outermost_zero(function, *bracket)
    answered = ok & (found | free)
    value = jnp.where(ok & found, value, 0.0)
    status = jnp.where(ok, jnp.where(answered, Status.OK, Status.UNREACHABLE), Status.INVALID_INPUT)
    return Requirement(value + poison(answered, *inputs), status.astype(jnp.int32))


def _pointwise(kernel: Callable[..., Any], names: tuple[str, ...], values: tuple[ArrayLike, ...]) -> Requirement:
    return pointwise(kernel, names, values, chunk=_CHUNK, fused=False, least=_LEAST_BATCH)


def _positive(*values: Array) -> Array:
    ok = jnp.isfinite(values[0]) & (values[0] > 0)
    for value in values[1:]:
        ok = ok & jnp.isfinite(value) & (value > 0)
    return ok


def _not_negative(*values: Array) -> Array:
    ok = jnp.isfinite(values[0]) & (values[0] >= 0)
    for value in values[1:]:
        ok = ok & jnp.isfinite(value) & (value >= 0)
    return ok


def _safe(ok: Array, *values: Array) -> tuple[Array, ...]:
    return tuple(jnp.where(ok, value, 1.0) for value in values)


def required_damping(
    stiffness: ArrayLike, *, mass: ArrayLike, period: ArrayLike, delay: ArrayLike = 0.0
) -> Requirement:
    """Return the least physical damping with which a wall of the wanted stiffness can be stable.

    The b of ``K_max(m, b, T, t_d) = K``. K_max rises with b without bound, so there is exactly one, unless the
    undamped device already reaches K: then b = 0.

    Args:
        stiffness: the wanted K_max in N/m, > 0.
        mass: m in kg, > 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0. All four broadcast.

    Returns:
        Requirement: ``value`` in N s/m; ``status``. NaN where an entry is out of range.

    Raises:
        InputError: a scalar is out of range, an argument is no real number, or shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem
        (0 where no damping is needed).

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth.design import required_damping
        >>> print(f"{required_damping(20e3, mass=0.1, period=1e-3, delay=1e-3).value:.2f} N s/m")
        10.24 N s/m
    """
    check_stiffness(stiffness)
    d = normalize(mass=mass, period=period, delay=delay).d
    return _pointwise(_damping_kernel, ("stiffness", "mass", "period", "d"), (stiffness, mass, period, d))


def _damping_kernel(stiffness: Array, mass: Array, period: Array, d: Array) -> Requirement:
    inputs = (stiffness, mass, period, d)
    ok = _positive(stiffness, mass, period) & _not_negative(d)
    stiffness, mass, period, d = _safe(ok, *inputs)
    rate = mass / period
    wanted = stiffness * period / rate
    enough = wanted * (d + 1.0) / _LEAST

    def shortfall(damping: Array) -> Array:
        return -jnp.log(_alpha(damping / rate, d) / wanted)

    # Outwards is towards more damping; the offset lets the samples start at 0.
    bracket = (jnp.zeros_like(d), enough * rate, jnp.minimum(1e-3, 1e-3 * enough) * rate)
    return _requirement(shortfall, bracket, ok, inputs, free=True)


def required_period(
    stiffness: ArrayLike,
    *,
    mass: ArrayLike,
    damping: ArrayLike = 0.0,
    delay: ArrayLike | None = None,
    delay_periods: ArrayLike | None = None,
) -> Requirement:
    """Return the longest sampling period, hence the lowest rate, at which a wanted stiffness can be stable.

    The T of ``K_max(m, b, T, t_d) = K``, with the delay fixed either in seconds or in periods. In periods there is
    exactly one. In seconds K_max tends to a finite limit for T -> 0: at or above it no rate is enough. Below it, at
    strong damping (delta > 8), K_max is not quite monotone in T (it dips by up to 1.2 %) and nearly flat where d is
    between 1/4 and 1; the longest T is returned that samples a few percent apart show.

    Args:
        stiffness: the wanted K_max in N/m, > 0.
        mass: m in kg, > 0.
        damping: b in N s/m, >= 0.
        delay: t_d in s, >= 0; give it or ``delay_periods``.
        delay_periods: d = t_d/T, >= 0. Everything broadcasts.

    Returns:
        Requirement: ``value`` in s; ``status``, UNREACHABLE with NaN where no rate is enough.

    Raises:
        InputError: not exactly one delay is given, a scalar is out of range, an argument is no real number, or
            shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth.design import required_period
        >>> print(f"{1 / required_period(20e3, mass=0.1, damping=10, delay_periods=1).value:.0f} Hz")
        1004 Hz
    """
    given = [name for name, value in (("delay", delay), ("delay_periods", delay_periods)) if value is not None]
    if len(given) != 1:
        raise InputError(f"delay, delay_periods: got {' and '.join(given) or 'neither'}; give exactly one of the two")
    fixed = delay if delay_periods is None else delay_periods
    check_stiffness(stiffness)
    normalize(mass=mass, damping=damping, period=1.0)
    if delay is not None:
        normalize(mass=1.0, period=1.0, delay=delay)
    else:
        denormalize(mass=1.0, period=1.0, d=delay_periods)
    kernel = _period_kernel if delay_periods is None else _period_in_periods_kernel
    return _pointwise(kernel, ("stiffness", "mass", "damping", given[0]), (stiffness, mass, damping, fixed))


def _period_at(bound: float, stiffness: Array, mass: Array, damping: Array, D: Array) -> Array:
    """The T at which ``bound (1/D^2 + delta/D) m/T^2 = K``."""
    linear, constant = bound * damping / D, bound * mass / (D * D)
    return (linear + jnp.sqrt(linear * linear + 4.0 * stiffness * constant)) / (2.0 * stiffness)


def _period_in_periods_kernel(stiffness: Array, mass: Array, damping: Array, d: Array) -> Requirement:
    inputs = (stiffness, mass, damping, d)
    ok = _positive(stiffness, mass) & _not_negative(damping, d)
    stiffness, mass, damping, d = _safe(ok, *inputs)

    def surplus(period: Array) -> Array:
        return jnp.log(_alpha(damping * period / mass, d) * (mass / stiffness) / period / period)

    ends = (_period_at(bound, stiffness, mass, damping, d + 1.0) for bound in (_LEAST, _MOST))
    return _requirement(surplus, (*ends, jnp.zeros_like(d)), ok, inputs)


def _period_kernel(stiffness: Array, mass: Array, damping: Array, delay: Array) -> Requirement:
    inputs = (stiffness, mass, damping, delay)
    ok = _positive(stiffness, mass) & _not_negative(damping, delay)
    stiffness, mass, damping, delay = _safe(ok, *inputs)

    def surplus(period: Array) -> Array:
        return jnp.log(_alpha(damping * period / mass, delay / period) * (mass / stiffness) / period / period)

    one = jnp.ones_like(delay)
    longest = _period_at(_MOST, stiffness, mass, damping, one)
    without_delay = _period_at(_LEAST, stiffness, mass, damping, one)
    shortest = jnp.where(delay > 0, jnp.minimum(delay / _LIMIT, 0.1 * without_delay), without_delay)
    return _requirement(surplus, (shortest, longest, jnp.zeros_like(delay)), ok, inputs)


def allowed_delay(stiffness: ArrayLike, *, mass: ArrayLike, damping: ArrayLike = 0.0, period: ArrayLike) -> Requirement:
    """Return the longest delay with which a wall of the wanted stiffness can be stable.

    The largest t_d of ``K_max(m, b, T, t_d) = K``. K_max falls with the delay to 0, except that for delta > 6 it first
    rises up to a delay of at most 0.17 periods (no more than 12.5 %).

    Args:
        stiffness: the wanted K_max in N/m, > 0.
        mass: m in kg, > 0.
        damping: b in N s/m, >= 0.
        period: T in s, > 0. All four broadcast.

    Returns:
        Requirement: ``value`` in s; ``status``, UNREACHABLE with NaN where even the best delay is not enough.

    Raises:
        InputError: a scalar is out of range, an argument is no real number, or shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth.design import allowed_delay
        >>> print(f"{allowed_delay(20e3, mass=0.1, damping=10, period=1e-3).value * 1e3:.3f} ms")
        0.993 ms
    """
    check_stiffness(stiffness)
    normalize(mass=mass, damping=damping, period=period)
    return _pointwise(_delay_kernel, ("stiffness", "mass", "damping", "period"), (stiffness, mass, damping, period))


def _delay_kernel(stiffness: Array, mass: Array, damping: Array, period: Array) -> Requirement:
    inputs = (stiffness, mass, damping, period)
    ok = _positive(stiffness, mass, period) & _not_negative(damping)
    stiffness, mass, damping, period = _safe(ok, *inputs)
    delta, wanted = damping * period / mass, stiffness * (period / mass) * period

    def surplus(delay: Array) -> Array:
        return jnp.log(_alpha(delta, delay / period) / wanted)

    # alpha_max < 6 (1/D^2 + delta/D) at D = d + 1
    linear = _MOST * delta
    longest = (linear + jnp.sqrt(linear * linear + 4.0 * wanted * _MOST)) / (2.0 * wanted)
    longest = jnp.maximum(longest, 1.5) - 1.0
    return _requirement(surplus, (jnp.zeros_like(delta), longest * period, period), ok, inputs)


def required_mass(
    stiffness: ArrayLike, *, damping: ArrayLike = 0.0, period: ArrayLike, delay: ArrayLike = 0.0
) -> Requirement:
    """Return the mass from which on a wall of the wanted stiffness can be stable.

    The largest m of ``K_max(m, b, T, t_d) = K``: every heavier device reaches K as well. As a function of the mass
    K_max starts at ``g(d) b/T`` (eq. 22), falls to a minimum and then rises without bound; where K lies below that
    minimum any mass will do and the answer is 0. (Between the minimum and g b/T very light devices reach K too.)

    Args:
        stiffness: the wanted K_max in N/m, > 0.
        damping: b in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0. All four broadcast.

    Returns:
        Requirement: ``value`` in kg; ``status``. NaN where an entry is out of range.

    Raises:
        InputError: a scalar is out of range, an argument is no real number, or shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem
        (0 where any mass will do).

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth.design import required_mass
        >>> print(f"{required_mass(20e3, damping=10, period=1e-3, delay=1e-3).value:.4f} kg")
        0.1010 kg
    """
    check_stiffness(stiffness)
    d = normalize(mass=1.0, damping=damping, period=period, delay=delay).d
    return _pointwise(_mass_kernel, ("stiffness", "damping", "period", "d"), (stiffness, damping, period, d))


def _mass_kernel(stiffness: Array, damping: Array, period: Array, d: Array) -> Requirement:
    inputs = (stiffness, damping, period, d)
    ok = _positive(stiffness, period) & _not_negative(damping, d)
    stiffness, damping, period, d = _safe(ok, *inputs)

    def shortfall(mass: Array) -> Array:
        return -jnp.log(_alpha(damping * period / mass, d) * (mass / stiffness) / period / period)

    D = d + 1.0
    heaviest = stiffness * (period * D) ** 2 / _LEAST
    # The undamped device answers above the second bound.
    lightest = jnp.where(damping > 0, damping * period / _LIMIT, heaviest * _LEAST / _MOST)
    bracket = (jnp.minimum(lightest, 0.01 * heaviest), heaviest, jnp.zeros_like(d))
    return _requirement(shortfall, bracket, ok, inputs, free=True)
