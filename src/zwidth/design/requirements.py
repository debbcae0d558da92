"""What a device needs for a wanted stiffness: damping, sampling period, shortness of delay, or mass.

Every answer is a zero of ``log(K_max/K)`` in one quantity with the others fixed. The search is bracketed by bounds that
were found over delta from 0 to 1e5 and d from 0 to 1e6, with room to spare:

    0.2 (1/D^2 + delta/D) < alpha_max(delta, d) < 6 (1/D^2 + delta/D)     D = d + 1
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import elementwise
from zwidth.design.crossing import outermost_zero
from zwidth.design.stiffness import check_stiffness, checked_device
from zwidth.domain import LARGEST_DAMPING, LONGEST_DELAY, SI_RANGE, device_status, within
from zwidth.errors import InputError
from zwidth.loop import poison
from zwidth.scene import denormalize, in_periods, normalize, quantity_status
from zwidth.stability.ridge import ridge_kernel, slopes_kernel
from zwidth.status import Status
from zwidth.xp import namespace

_LEAST, _MOST = 0.2, 6.0
# A hundred samples of a lobe at a time: what a block needs stays in the cache.
_BLOCK = 1 << 6
_FEW = 1 << 9


class Requirement(NamedTuple):
    """The value asked for, in SI units, and a `zwidth.Status`."""

    value: Array
    status: Array


class _Path(NamedTuple):
    """How the wanted quantity x enters: ``delta = strength x^a``, ``d = lag x^b``, ``K_max/K = alpha_max scale x^p``.

    ``outwards`` is the sign with which ``log(K_max/K)`` turns negative towards large x.
    """

    strength: Array
    lag: Array
    scale: Array
    a: int = 0
    b: int = 0
    p: int = 0
    outwards: float = 1.0

    def device(self, x: Array) -> tuple[Array, Array]:
        """(delta, d) at x."""
        xp = namespace(x, self.scale)
        delta, d = xp.broadcast_arrays(_times_power(self.strength, x, self.a), _times_power(self.lag, x, self.b))
        return delta, d

    def value(self, x: Array) -> Array:
        """The logarithm of K_max/K, signed."""
        alpha = ridge_kernel(*self.device(x), "held").alpha
        return self._signed_log(alpha, x)

    def value_and_slope(self, x: Array) -> tuple[Array, Array]:
        """The same with its derivative in x."""
        delta, d = self.device(x)
        point, by_delta, by_d = slopes_kernel(delta, d, "held")
        slope = by_delta * _power_slope(self.strength, x, self.a) + by_d * _power_slope(self.lag, x, self.b)
        slope = slope / point.alpha + (self.p / x if self.p else 0.0)
        return self._signed_log(point.alpha, x), self.outwards * slope

    def _signed_log(self, alpha: Array, x: Array) -> Array:
        xp = namespace(alpha)
        return self.outwards * xp.log(_times_power(alpha * self.scale, x, self.p))


def _times_power(factor: Array, x: Array, exponent: int) -> Array:
    return factor if exponent == 0 else factor * x**exponent if exponent > 0 else factor / x**-exponent


def _power_slope(factor: Array, x: Array, exponent: int) -> Array:
    return 0.0 * x if exponent == 0 else factor + 0.0 * x if exponent == 1 else -factor / (x * x)


def _solved(
    path: _Path, bracket: tuple[Array, Array, Array], unit: Array, given: Array, inputs: tuple, free: bool = False
) -> Requirement:
    """Solve for x and give ``x unit`` with its status. ``free``: a function that is never 0 requires nothing at all."""
    xp = namespace(unit, *inputs)
    lifted = path._replace(strength=path.strength[None], lag=path.lag[None], scale=path.scale[None])
    inner, outer, offset = (xp.broadcast_to(value, unit.shape)[None] for value in bracket)
    x, found = (leaf[0] for leaf in outermost_zero(lifted.value, lifted.value_and_slope, inner, outer, offset))
    # Cut off by the domain, the bracket does not end where the function is negative.
    beyond = ~(lifted.value(outer)[0] < 0.0)
    found = found & ~beyond
    value = xp.where(found, x, 0.0) * unit
    delta, d = (leaf[0] for leaf in lifted.device(xp.where(found, x, outer[0])[None]))
    inside = within(value, SI_RANGE) & (device_status(delta, d) == Status.OK) & ~beyond
    status = xp.where(found | free, int(Status.OK), int(Status.UNREACHABLE))
    status = xp.where(given == Status.OK, xp.where(inside, status, int(Status.OUT_OF_RANGE)), given)
    return Requirement(value + poison(status == Status.OK, *inputs), status.astype(np.int32))


def _safe(*inputs: Array, **quantities: Array) -> tuple[Array, ...]:
    """The status of the inputs, then the inputs with harmless numbers in place of bad ones."""
    given = quantity_status(**quantities)
    xp = namespace(*inputs)
    return given, *(xp.where(given == Status.OK, value, 1.0) for value in inputs)


def _answer(kernel: Any, names: tuple[str, ...], values: tuple[ArrayLike, ...]) -> Requirement:
    return elementwise(kernel, names, values, few=_FEW, block=_BLOCK)


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
        Requirement: ``value`` in N s/m; ``status``. NaN where an entry is out of range, or the answer would be
        (OUT_OF_RANGE: SI quantities are 0 or 1e-30 to 1e30, delta at most 1e12, d at most 1e5).

    Raises:
        InputError: a scalar is out of range, an argument is no real number, or shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem
        (0 where no damping is needed).

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import required_damping
        >>> print(f"{required_damping(20e3, mass=0.1, period=1e-3, delay=1e-3).value:.2f} N s/m")
        10.24 N s/m
    """
    check_stiffness(stiffness)
    checked_device(mass=mass, period=period, delay=delay)
    return _answer(_damping_kernel, ("stiffness", "mass", "period", "delay"), (stiffness, mass, period, delay))


def _damping_kernel(stiffness: Array, mass: Array, period: Array, delay: Array) -> Requirement:
    inputs = (stiffness, mass, period, delay)
    given, stiffness, mass, period, delay = _safe(
        *inputs, wanted_stiffness=stiffness, mass=mass, period=period, delay=delay
    )
    xp = namespace(*inputs)
    rate, d = mass / period, in_periods(delay, period)
    wanted = stiffness * period / rate
    # In delta; outwards is towards more damping, and the offset lets the samples start at 0.
    enough = xp.minimum(wanted * (d + 1.0) / _LEAST, LARGEST_DAMPING)
    path = _Path(xp.ones_like(d), d, 1.0 / wanted, a=1, outwards=-1.0)
    return _solved(path, (0.0 * d, enough, xp.minimum(1e-3, 1e-3 * enough)), rate, given, inputs, free=True)


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
        Requirement: ``value`` in s; ``status``, UNREACHABLE with NaN where no rate is enough; OUT_OF_RANGE as for
        `required_damping`.

    Raises:
        InputError: not exactly one delay is given, a scalar is out of range, an argument is no real number, or
            shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import required_period
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
    return _answer(kernel, ("stiffness", "mass", "damping", given[0]), (stiffness, mass, damping, fixed))


def _period_at(bound: float, stiffness: Array, mass: Array, damping: Array, D: Array) -> Array:
    """The T at which ``bound (1/D^2 + delta/D) m/T^2 = K``."""
    linear, constant = bound * damping / D, bound * mass / (D * D)
    xp = namespace(linear, constant, stiffness)
    return (linear + xp.sqrt(linear * linear + 4.0 * stiffness * constant)) / (2.0 * stiffness)


def _period_in_periods_kernel(stiffness: Array, mass: Array, damping: Array, d: Array) -> Requirement:
    inputs = (stiffness, mass, damping, d)
    given, stiffness, mass, damping, d = _safe(*inputs, wanted_stiffness=stiffness, mass=mass, damping=damping, d=d)
    shortest, longest = (_period_at(bound, stiffness, mass, damping, d + 1.0) for bound in (_LEAST, _MOST))
    path = _Path(damping / mass, d, mass / stiffness, a=1, p=-2)
    return _solved(path, (shortest, longest, 0.0 * d), 0.0 * d + 1.0, given, inputs)


def _period_kernel(stiffness: Array, mass: Array, damping: Array, delay: Array) -> Requirement:
    inputs = (stiffness, mass, damping, delay)
    given, stiffness, mass, damping, delay = _safe(
        *inputs, wanted_stiffness=stiffness, mass=mass, damping=damping, delay=delay
    )
    xp = namespace(*inputs)
    longest = _period_at(_MOST, stiffness, mass, damping, 1.0)
    without_delay = _period_at(_LEAST, stiffness, mass, damping, 1.0)
    # A delay of 1e5 periods, the longest that the model takes, is as good as continuous time, to 1e-5 of K.
    shortest = xp.where(delay > 0, xp.maximum(1.001 * delay / LONGEST_DELAY, 1e-6 * without_delay), without_delay)
    shortest = xp.minimum(shortest, longest)
    path = _Path(damping / mass, delay, mass / stiffness, a=1, b=-1, p=-2)
    return _solved(path, (shortest, longest, 0.0 * delay), 0.0 * delay + 1.0, given, inputs)


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
        Requirement: ``value`` in s; ``status``, UNREACHABLE with NaN where even the best delay is not enough;
        OUT_OF_RANGE as for `required_damping`.

    Raises:
        InputError: a scalar is out of range, an argument is no real number, or shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import allowed_delay
        >>> print(f"{allowed_delay(20e3, mass=0.1, damping=10, period=1e-3).value * 1e3:.3f} ms")
        0.993 ms
    """
    check_stiffness(stiffness)
    checked_device(mass=mass, damping=damping, period=period)
    return _answer(_delay_kernel, ("stiffness", "mass", "damping", "period"), (stiffness, mass, damping, period))


def _delay_kernel(stiffness: Array, mass: Array, damping: Array, period: Array) -> Requirement:
    inputs = (stiffness, mass, damping, period)
    given, stiffness, mass, damping, period = _safe(
        *inputs, wanted_stiffness=stiffness, mass=mass, damping=damping, period=period
    )
    xp = namespace(*inputs)
    delta, wanted = damping * period / mass, stiffness * (period / mass) * period
    # alpha_max < 6 (1/D^2 + delta/D) at D = d + 1
    linear = _MOST * delta
    longest = (linear + xp.sqrt(linear * linear + 4.0 * wanted * _MOST)) / (2.0 * wanted)
    longest = xp.minimum(xp.maximum(longest, 1.5) - 1.0, LONGEST_DELAY)
    path = _Path(delta, 0.0 * delta + 1.0, 1.0 / wanted, b=1)
    return _solved(path, (0.0 * delta, longest, 0.0 * delta + 1.0), period, given, inputs)


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
        Requirement: ``value`` in kg; ``status``. NaN where an entry is out of range, or the answer would be, see
        `required_damping`.

    Raises:
        InputError: a scalar is out of range, an argument is no real number, or shapes do not broadcast.

    Numerics:
        K_max at the answer equals K to 2e-14. Traceable, with derivatives by the implicit function theorem
        (0 where any mass will do).

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import required_mass
        >>> print(f"{required_mass(20e3, damping=10, period=1e-3, delay=1e-3).value:.4f} kg")
        0.1010 kg
    """
    check_stiffness(stiffness)
    checked_device(mass=1.0, damping=damping, period=period, delay=delay)
    return _answer(_mass_kernel, ("stiffness", "damping", "period", "delay"), (stiffness, damping, period, delay))


def _mass_kernel(stiffness: Array, damping: Array, period: Array, delay: Array) -> Requirement:
    inputs = (stiffness, damping, period, delay)
    given, stiffness, damping, period, delay = _safe(
        *inputs, wanted_stiffness=stiffness, damping=damping, period=period, delay=delay
    )
    xp = namespace(*inputs)
    d = in_periods(delay, period)
    D = d + 1.0
    heaviest = stiffness * (period * D) ** 2 / _LEAST
    # The undamped device answers above the second bound; the lightest one has the largest delta.
    lightest = xp.where(damping > 0, damping * period / LARGEST_DAMPING, heaviest * _LEAST / _MOST)
    # No device so light that the damping drowns its mass is needed to see where K_max rises.
    lightest = xp.minimum(xp.maximum(lightest, 1e-12 * heaviest), 0.01 * heaviest)
    path = _Path(damping * period, d, 1.0 / (stiffness * period * period), a=-1, p=1, outwards=-1.0)
    return _solved(path, (lightest, heaviest, 0.0 * d), 0.0 * d + 1.0, given, inputs, free=True)
