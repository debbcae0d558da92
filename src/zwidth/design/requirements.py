"""What a device needs for a wanted stiffness: damping, sampling period, shortness of delay, or mass.

Every answer is a zero of ``log(K_max/K)`` in one quantity with the others fixed. Brackets come from bounds found
over delta from 0 to 1e5 and d from 0 to 1e6, where g is the slope of eq. (22):

    0.36 < alpha_max(delta, d)/(alpha_max(0, d) + g(d) delta) < 1.1
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from zwidth._types import Array, ArrayLike
from zwidth.batching import pointwise
from zwidth.design.crossing import Bracket, Function, outermost_bracket, solve
from zwidth.design.stiffness import check_stiffness
from zwidth.errors import InputError
from zwidth.loop import poison
from zwidth.scene import denormalize, normalize
from zwidth.stability.ridge import ridge_kernel
from zwidth.status import Status

# The bounds above with some room, and a bound that holds for every d at once.
_LEAST, _MOST = 0.3, 1.2
_MOST_AT_REST, _MOST_PER_DAMPING = 0.85, 5.5
# A few percent between neighbors, whatever the range.
_SAMPLES = 256
# A delay of this many periods is as good as continuous time, to 1e-6 of the stiffness.
_LONGEST = 1e6
_CHUNK = 1 << 11


class Requirement(NamedTuple):
    """The value asked for, in SI units, and a `zwidth.Status`."""

    value: Array
    status: Array


def _alpha(delta: Array, d: Array) -> Array:
    return ridge_kernel(delta, d, "held").alpha


def _finish(function: Function, bracket: Bracket, ok: Array, inputs: tuple[Array, ...], free: Array | None = None):
    """Solve and attach the status; ``free`` marks points where nothing at all is required."""
    exists = ok & bracket.exists
    free = jnp.zeros_like(ok) if free is None else ok & free
    value = solve(function, Bracket(*(jnp.where(exists, x, 1.0) for x in bracket[:2]), exists))
    answered = exists | free
    value = jnp.where(free, 0.0, jnp.where(exists, value, 0.0))
    status = jnp.where(ok, jnp.where(answered, Status.OK, Status.UNREACHABLE), Status.INVALID_INPUT)
    return Requirement(value + poison(answered, *inputs), status.astype(jnp.int32))


def _pointwise(kernel: Callable[..., Any], names: tuple[str, ...], values: tuple[ArrayLike, ...]) -> Requirement:
    return pointwise(kernel, names, values, chunk=_CHUNK)


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


def _rest_and_slope(d: Array) -> tuple[Array, Array]:
    """alpha_max(0, d) and nearly g(d), for brackets, from one call: the ridge is compiled once."""
    strong = 1e6
    at_rest, strongly_damped = jax.vmap(lambda delta: _alpha(delta, d))(jnp.array([0.0, strong], d.dtype))
    return _constant(at_rest), _constant(strongly_damped / strong)


def _constant(value: Array) -> Array:
    """For what only places a bracket."""
    return jax.lax.stop_gradient(value)


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
        K_max at the answer equals K to about 1e-14. Traceable, with derivatives by the implicit function theorem
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
    at_rest, slope = _rest_and_slope(d)
    lowest, highest = ((wanted / bound - at_rest) / slope for bound in (_MOST, _LEAST))
    # Outwards, where "not enough" is negative, is towards less damping.
    bracket = Bracket(*map(_constant, (highest * rate, jnp.maximum(lowest, 0.0) * rate)), at_rest < wanted)
    return _finish(lambda b: jnp.log(_alpha(b / rate, d) / wanted), bracket, ok, inputs, at_rest >= wanted)


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
    strong damping (delta > 8), K_max is not quite monotone in T (it varies by up to 1.2 %); the longest T is returned.

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
        K_max at the answer equals K to about 1e-14. Traceable, with derivatives by the implicit function theorem.

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


def _longest_period(stiffness: Array, mass: Array, damping: Array, at_rest: Array, per_damping: Array) -> Array:
    """The T at which ``(at_rest + per_damping b T/m) m/T^2 = K``: an explicit bound on the answer."""
    linear = per_damping * damping
    return (linear + jnp.sqrt(linear * linear + 4.0 * stiffness * at_rest * mass)) / (2.0 * stiffness)


def _period_in_periods_kernel(stiffness: Array, mass: Array, damping: Array, d: Array) -> Requirement:
    inputs = (stiffness, mass, damping, d)
    ok = _positive(stiffness, mass) & _not_negative(damping, d)
    stiffness, mass, damping, d = _safe(ok, *inputs)
    at_rest, slope = _rest_and_slope(d)
    ends = (
        _constant(_longest_period(stiffness, mass, damping, bound * at_rest, bound * slope))
        for bound in (_LEAST, _MOST)
    )

    def surplus(period: Array) -> Array:
        return jnp.log(_alpha(damping * period / mass, d) * (mass / stiffness) / period / period)

    return _finish(surplus, Bracket(*ends, jnp.ones_like(ok)), ok, inputs)


def _period_kernel(stiffness: Array, mass: Array, damping: Array, delay: Array) -> Requirement:
    inputs = (stiffness, mass, damping, delay)
    ok = _positive(stiffness, mass) & _not_negative(damping, delay)
    stiffness, mass, damping, delay = _safe(ok, *inputs)

    def surplus(period: Array) -> Array:
        return jnp.log(_alpha(damping * period / mass, delay / period) * (mass / stiffness) / period / period)

    longest = _longest_period(stiffness, mass, damping, jnp.asarray(_MOST_AT_REST), jnp.asarray(_MOST_PER_DAMPING))
    # Without any delay, the answer lies less than a factor of 10 below the bound.
    shortest = jnp.where(delay > 0, jnp.minimum(delay / _LONGEST, 0.01 * longest), 0.01 * longest)
    grid = jnp.geomspace(_constant(shortest), _constant(longest), _SAMPLES)
    return _finish(surplus, _held_fixed(outermost_bracket, surplus, grid), ok, inputs)


def _held_fixed(search: Callable[..., Bracket], function: Function, grid: Array) -> Bracket:
    """A bracket as a constant, so that no derivative passes through the search."""
    return Bracket(*map(_constant, search(function, grid)))


def allowed_delay(
    stiffness: ArrayLike, *, mass: ArrayLike, damping: ArrayLike = 0.0, period: ArrayLike
) -> Requirement:
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
        K_max at the answer equals K to about 1e-14. Traceable, with derivatives by the implicit function theorem.

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

    # alpha_max < 0.85/(d + 1)^2 + 5.5 delta/(d + 1)
    linear = _MOST_PER_DAMPING * delta
    longest = (linear + jnp.sqrt(linear * linear + 4.0 * wanted * _MOST_AT_REST)) / (2.0 * wanted)
    grid = period * (jnp.geomspace(1.0, _constant(jnp.maximum(longest, 1.5)), _SAMPLES) - 1.0)
    # The first point is no delay at all, exactly.
    grid = _constant(grid.at[0].set(0.0))
    return _finish(surplus, _held_fixed(outermost_bracket, surplus, grid), ok, inputs)


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
        K_max at the answer equals K to about 1e-14. Traceable, with derivatives by the implicit function theorem
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
    at_rest, _ = _rest_and_slope(d)

    def shortfall(mass: Array) -> Array:
        return -jnp.log(_alpha(damping * period / mass, d) * (mass / stiffness) / period / period)

    heaviest = stiffness * period * period / (_LEAST * at_rest)
    # delta = 1e6: the limit of a massless device.
    lightest = jnp.maximum(damping * period / _LONGEST, 0.1 * heaviest * (damping == 0))
    grid = _constant(jnp.geomspace(jnp.minimum(lightest, 0.1 * heaviest), heaviest, _SAMPLES))
    bracket = _held_fixed(outermost_bracket, shortfall, grid)
    return _finish(shortfall, bracket, ok, inputs, ~bracket.exists)
