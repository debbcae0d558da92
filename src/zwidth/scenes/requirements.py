"""What a device needs for a wanted stiffness: damping, sampling period, shortness of delay, or mass (rigid loop).

Every answer is the last zero of K_max - K in one quantity with the others fixed. The search is bracketed by bounds that
were found over delta from 0 to 1e5 and d from 0 to 1e6, with room to spare:

    0.2 (1/D^2 + delta/D) < alpha_max(delta, d) < 6 (1/D^2 + delta/D)     D = d + 1

Over that range K_max was found to rise with the damping, and to fall with the period at a fixed number of periods of
delay. In the mass (damping may dominate), in the delay (d < 0.17 and delta > 6) and in the period at a delay in seconds
(by 1.2 % at strong damping) it is not quite monotone: samples a few percent apart show the last zero. K_max at the
answer equals K to 2e-14; derivatives are those of the implicit function, 0 where nothing is required.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from zwidth.arrays.batching import elementwise
from zwidth.arrays.roots import last_cell, newton
from zwidth.arrays.xp import frozen, namespace
from zwidth.loops.domain import LARGEST_DAMPING, LONGEST_DELAY, device_status, poison, within
from zwidth.loops.normalization import denormalize, normalize, quantity_status
from zwidth.loops.rigid.delay_classes import ANY, Kind, classify_delays
from zwidth.loops.rigid.ridge import ridge_kernel, slopes_kernel
from zwidth.parts.span import accept_units, in_periods
from zwidth.scenes.stiffness import check_stiffness, checked_device
from zwidth.words.errors import InputError
from zwidth.words.quantities import SI_RANGE
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike

_LEAST, _MOST = 0.2, 6.0
# Enough for two zeros that all but meet; in NumPy a few steps end it.
_STEPS = 24
_ENTERING = ("strength", "lag", "scale")
# A hundred samples of a point at a time: what a block needs stays in the cache.
_BLOCK = 1 << 6
_FEW = 1 << 9


class Requirement(NamedTuple):
    """The value asked for, in SI units, and a `zwidth.Status`.

    NaN where an entry is out of range, or the answer would be (OUT_OF_RANGE: SI quantities are 0 or 1e-30 to 1e30,
    delta at most 1e12, d at most 1e5), and where nothing is enough (UNREACHABLE).
    """

    value: Array
    status: Array


class _Path(NamedTuple):
    """How the wanted quantity x enters: ``delta = strength x^a``, ``d = lag x^b``, ``K_max/K = alpha_max scale x^p``.

    The misfit is ``(K/K_max)^outwards - 1``: positive at large x, and there all but a power of x.
    """

    strength: Array
    lag: Array
    scale: Array
    kind: Kind
    a: int = 0
    b: int = 0
    p: int = 0
    outwards: int = 1

    def device(self, x: Array) -> tuple[Array, Array]:
        """(delta, d) at x."""
        return self.strength * x**self.a, self.lag * x**self.b

    def misfit(self, x: Array) -> Array:
        """``(K/K_max)^outwards - 1`` at x."""
        alpha = ridge_kernel(*self.device(x), "held", self.kind).alpha
        return (alpha * self.scale * x**self.p) ** -self.outwards - 1.0

    def at_samples(self, x: Array) -> Array:
        """The same along a new last axis."""
        wide = self._replace(**{name: getattr(self, name)[..., None] for name in _ENTERING})
        return wide.misfit(x)

    def with_slope(self, x: Array) -> tuple[Array, Array]:
        """The misfit with its derivative in x."""
        point, by_delta, by_d = slopes_kernel(*self.device(x), "held", self.kind)
        slope = by_delta * self.strength * self.a * x ** (self.a - 1) if self.a else 0.0 * x
        slope = slope + by_d * self.lag * self.b * x ** (self.b - 1) if self.b else slope
        slope = slope / point.alpha + (self.p / x if self.p else 0.0)
        ratio = (point.alpha * self.scale * x**self.p) ** -self.outwards
        return ratio - 1.0, -self.outwards * ratio * slope


def _solve_requirement(
    path: _Path,
    bracket: tuple[Array, Array],
    unit: Array,
    given: Array,
    inputs: tuple,
    *,
    start: Array | None = None,
    offset: Array | float = 0.0,
    free: bool = False,
) -> Requirement:
    """Solve for x and give ``x unit`` with its status.

    Args:
        start: where to begin on a path that is monotone; without it the last zero is looked for.
        offset: lets samples of equal ratios begin at 0.
        free: where the misfit is never 0, nothing at all is required.
    """
    xp = namespace(unit, *inputs)
    still = path._replace(**frozen({name: getattr(path, name) for name in _ENTERING}, xp))
    inner, outer = frozen(bracket, xp)
    # Cut off by the domain, the bracket may end short of any zero.
    beyond = ~(still.misfit(outer) > 0.0)
    if start is None:
        low, high, crossed = last_cell(still.at_samples, inner, outer, offset + 0.0 * inner)
        x, _ = newton(still.with_slope, low, high, high, _STEPS)
        # Between samples that are all short of K a peak may touch it.
        crossed = crossed | (xp.abs(still.misfit(x)) <= 1e-12)
    else:
        crossed = ~(still.misfit(inner) > 0.0)
        x, _ = newton(still.with_slope, inner, outer, frozen(start, xp), _STEPS)
    x = frozen(x, xp)
    for _ in range(0 if xp is np else 2):
        # Each of these steps makes one more order of derivatives exact.
        value, slope = path.with_slope(x)
        step = value / slope
        x = x - xp.where(xp.abs(step) <= 1e-3 * xp.abs(x), step, 0.0)
    x = xp.where(x < inner, inner, x)
    found = crossed & ~beyond
    value = xp.where(found, x, 0.0) * unit
    delta, d = path.device(xp.where(found, x, outer))
    inside = within(value, SI_RANGE) & (device_status(delta, d) == Status.OK) & ~beyond
    status = xp.where(found | free, int(Status.OK), int(Status.UNREACHABLE))
    status = xp.where(given == Status.OK, xp.where(inside, status, int(Status.OUT_OF_RANGE)), given)
    return Requirement(value + poison(status == Status.OK, *inputs), status.astype(np.int32))


def _safe(**quantities: Array) -> tuple[Any, ...]:
    """The status of the inputs, the inputs, and each of them with a harmless number in place of a bad one."""
    given, values = quantity_status(**quantities), tuple(quantities.values())
    xp = namespace(*values)
    return given, values, *(xp.where(given == Status.OK, value, 1.0) for value in values)


def _answer(kernel: Any, known: ArrayLike | None = None, /, **values: ArrayLike) -> Requirement:
    """Apply a kernel; ``known`` are the delays in periods where the question fixes them."""
    kind = ANY if known is None else classify_delays(known)
    return elementwise(kernel, tuple(values), tuple(values.values()), (kind,), few=_FEW, block=_BLOCK)


@accept_units
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
        `Requirement` in N s/m.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import required_damping
        >>> print(f"{required_damping(20e3, mass=0.1, period=1e-3, delay=1e-3).value:.2f} N s/m")
        10.24 N s/m
    """
    check_stiffness(stiffness)
    device = checked_device(mass=mass, period=period, delay=delay)
    return _answer(_damping_kernel, device.d, stiffness=stiffness, mass=mass, period=period, delay=delay)


def _damping_kernel(stiffness: Array, mass: Array, period: Array, delay: Array, kind: Kind) -> Requirement:
    given, inputs, stiffness, mass, period, delay = _safe(
        wanted_stiffness=stiffness, mass=mass, period=period, delay=delay
    )
    xp = namespace(*inputs)
    rate, d = mass / period, in_periods(delay, period)
    wanted = stiffness * period / rate
    # In delta.
    enough = xp.minimum(wanted * (d + 1.0) / _LEAST, LARGEST_DAMPING)
    path = _Path(xp.ones_like(d)[()], d, 1.0 / wanted, kind, a=1, outwards=-1)
    return _solve_requirement(path, (0.0 * d, enough), rate, given, inputs, start=_LEAST * enough, free=True)


@accept_units
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
        `Requirement` in s, UNREACHABLE where no rate is enough.

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
    check_stiffness(stiffness)
    normalize(mass=mass, damping=damping, period=1.0)
    if delay is not None:
        normalize(mass=1.0, period=1.0, delay=delay)
        return _answer(_period_kernel, stiffness=stiffness, mass=mass, damping=damping, delay=delay)
    denormalize(mass=1.0, period=1.0, d=delay_periods)
    assert delay_periods is not None
    return _answer(
        _period_in_periods_kernel, delay_periods, stiffness=stiffness, mass=mass, damping=damping, d=delay_periods
    )


def _period_at(bound: float, stiffness: Array, mass: Array, damping: Array, D: Array) -> Array:
    """The T at which ``bound (1/D^2 + delta/D) m/T^2 = K``."""
    linear, constant = bound * damping / D, bound * mass / (D * D)
    xp = namespace(linear, constant, stiffness)
    return (linear + xp.sqrt(linear * linear + 4.0 * stiffness * constant)) / (2.0 * stiffness)


def _period_in_periods_kernel(stiffness: Array, mass: Array, damping: Array, d: Array, kind: Kind) -> Requirement:
    given, inputs, stiffness, mass, damping, d = _safe(wanted_stiffness=stiffness, mass=mass, damping=damping, d=d)
    xp = namespace(*inputs)
    shortest, longest = (_period_at(bound, stiffness, mass, damping, d + 1.0) for bound in (_LEAST, _MOST))
    path = _Path(damping / mass, d, mass / stiffness, kind, a=1, p=-2)
    between = xp.sqrt(shortest) * xp.sqrt(longest)
    return _solve_requirement(path, (shortest, longest), xp.ones_like(d)[()], given, inputs, start=between)


def _period_kernel(stiffness: Array, mass: Array, damping: Array, delay: Array, kind: Kind) -> Requirement:
    given, inputs, stiffness, mass, damping, delay = _safe(
        wanted_stiffness=stiffness, mass=mass, damping=damping, delay=delay
    )
    xp = namespace(*inputs)
    without_delay, longest = (_period_at(bound, stiffness, mass, damping, 1.0) for bound in (_LEAST, _MOST))
    # A delay of 1e5 periods, the longest that the model takes, is as good as continuous time, to 1e-5 of K.
    shortest = xp.where(delay > 0, xp.maximum(1.001 * delay / LONGEST_DELAY, 1e-6 * without_delay), without_delay)
    path = _Path(damping / mass, delay, mass / stiffness, kind, a=1, b=-1, p=-2)
    return _solve_requirement(path, (xp.minimum(shortest, longest), longest), xp.ones_like(delay)[()], given, inputs)


@accept_units
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
        `Requirement` in s, UNREACHABLE where even the best delay is not enough.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import allowed_delay
        >>> print(f"{allowed_delay(20e3, mass=0.1, damping=10, period=1e-3).value * 1e3:.3f} ms")
        0.993 ms
    """
    check_stiffness(stiffness)
    checked_device(mass=mass, damping=damping, period=period)
    return _answer(_delay_kernel, stiffness=stiffness, mass=mass, damping=damping, period=period)


def _delay_kernel(stiffness: Array, mass: Array, damping: Array, period: Array, kind: Kind) -> Requirement:
    given, inputs, stiffness, mass, damping, period = _safe(
        wanted_stiffness=stiffness, mass=mass, damping=damping, period=period
    )
    xp = namespace(*inputs)
    delta, wanted = damping * period / mass, stiffness * (period / mass) * period
    # alpha_max < 6 (1/D^2 + delta/D) at D = d + 1
    longest = xp.minimum(xp.maximum(_period_at(_MOST, wanted, 1.0, delta, 1.0), 1.5) - 1.0, LONGEST_DELAY)
    path = _Path(delta, xp.ones_like(delta)[()], 1.0 / wanted, kind, b=1)
    return _solve_requirement(path, (0.0 * delta, longest), period, given, inputs, offset=1.0)


@accept_units
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
        `Requirement` in kg.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import required_mass
        >>> print(f"{required_mass(20e3, damping=10, period=1e-3, delay=1e-3).value:.4f} kg")
        0.1010 kg
    """
    check_stiffness(stiffness)
    device = checked_device(mass=1.0, damping=damping, period=period, delay=delay)
    return _answer(_mass_kernel, device.d, stiffness=stiffness, damping=damping, period=period, delay=delay)


def _mass_kernel(stiffness: Array, damping: Array, period: Array, delay: Array, kind: Kind) -> Requirement:
    given, inputs, stiffness, damping, period, delay = _safe(
        wanted_stiffness=stiffness, damping=damping, period=period, delay=delay
    )
    xp = namespace(*inputs)
    d = in_periods(delay, period)
    heaviest = stiffness * (period * (d + 1.0)) ** 2 / _LEAST
    # The undamped device answers above the second bound; the lightest one has the largest delta.
    lightest = xp.where(damping > 0, damping * period / LARGEST_DAMPING, heaviest * _LEAST / _MOST)
    # No device so light that the damping drowns its mass is needed to see where K_max rises.
    lightest = xp.minimum(xp.maximum(lightest, 1e-12 * heaviest), 0.01 * heaviest)
    path = _Path(damping * period, d, 1.0 / (stiffness * period * period), kind, a=-1, p=1, outwards=-1)
    return _solve_requirement(path, (lightest, heaviest), xp.ones_like(d)[()], given, inputs, free=True)
