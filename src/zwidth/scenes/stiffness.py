"""How stiff the wall of a rigid device can be, what a little more of each property buys, and what a stiffness requires.

For arrays and inside JAX (for any scene: `zwidth.Scene`). What is required is the last zero of ``K_max - K`` in one
quantity with the others fixed. It lies between bounds that were found over delta from 0 to 1e5 and d from 0 to 1e6,
with room to spare:

    0.2 k < K_max < 6 k        k = m/S^2 + b/S        S = T + t_d

K_max rises with the damping. In the mass (damping may dominate), in the delay (d < 0.17 and delta > 6) and in the
period at a delay in seconds (by 1.2 % at strong damping) it is not quite monotone: samples a few percent apart show the
last zero. Derivatives are those of the implicit function, 0 where nothing is required.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from zwidth.arrays.evaluate import check_scalars, evaluate
from zwidth.arrays.roots import follow_root, last_cell, newton
from zwidth.arrays.xp import apply_each, frozen, is_traced, namespace, nan_with_nan_slopes, within
from zwidth.loops.normalization import Normalized, denormalize, normalize, quantity_status
from zwidth.loops.rigid.device import ANY, DelayClasses, classify_delays, device_status
from zwidth.loops.rigid.polynomial import check_delay_model
from zwidth.loops.rigid.ridge import ridge_kernel, slopes_kernel, stiffness_slopes
from zwidth.parts.checks import accept_units, in_periods
from zwidth.words.errors import InputError, check_choice
from zwidth.words.quantities import LARGEST_DAMPING, LONGEST_DELAY, SI_RANGE
from zwidth.words.showing import shown
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike, DelayModel

_NAMES: tuple[str, ...] = ("mass", "damping", "period", "delay", "delta", "d")


def checked_device(**quantities: ArrayLike) -> Normalized:
    """The normalized device; raises `InputError` also where a scalar delta or d is beyond the range of the model."""
    device = normalize(**quantities)
    check_scalars({"delta": device.delta, "d": device.d})
    return device


def check_stiffness(stiffness: ArrayLike) -> None:
    """Raise `InputError` for a scalar that no wall can have; what is traced becomes NaN instead."""
    if is_traced(stiffness):
        return
    normalize(mass=1.0, period=1.0, stiffness=stiffness)
    if np.ndim(stiffness) == 0 and not np.asarray(stiffness) > 0:
        raise InputError(f"stiffness: got {stiffness!r}; it must be finite and greater than 0 (in N/m)")


@accept_units
def max_stiffness(*, mass: ArrayLike, damping: ArrayLike = 0.0, period: ArrayLike, delay: ArrayLike = 0.0) -> Array:
    """Return the stiffness below which some virtual damping makes the wall stable.

    ``K_max = alpha_max(b T/m, t_d/T) m/T^2``, in N/m, for a held delay.

    Args:
        mass: m in kg, > 0.
        damping: b, the physical damping of the device, in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0, whole periods or not. All four broadcast.

    Returns:
        Array of the broadcast shape, in N/m; an entry of an array that is out of range gives NaN.

    Numerics:
        About 1e-15 relative. Traceable, with first and second derivatives. How it moves with each quantity stands in
        `scenes.stiffness`.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import max_stiffness
        >>> print(f"{max_stiffness(mass=0.1, damping=10, period=1e-3, delay=1e-3):.0f} N/m")
        19865 N/m
    """
    device = checked_device(mass=mass, damping=damping, period=period, delay=delay)
    arguments = {"mass": mass, "period": period, "delta": device.delta, "d": device.d}
    return evaluate(max_stiffness_kernel, arguments, classify_delays(device.d), slopes=move_max_stiffness)


def max_stiffness_kernel(mass: Array, period: Array, delta: Array, d: Array, kind: DelayClasses) -> Array:
    return ridge_kernel(delta, d, "held", kind).alpha * (mass / period) / period


def move_max_stiffness(
    mass: Array, period: Array, delta: Array, d: Array, kind: DelayClasses
) -> tuple[Array, tuple[Array, ...]]:
    """`max_stiffness_kernel`, and how it moves with each of mass, period, delta and d."""
    found = slopes_kernel(delta, d, "held", kind)
    scale = (mass / period) / period
    value = found.point.alpha * scale
    return value, (value / mass, -2.0 * value / period, found.by_delta * scale, found.by_d * scale)


@shown(
    stiffness_max="N/m",
    per_mass="N/m per kg",
    per_damping="N/m per N s/m",
    per_period="N/m per s",
    per_delay="N/m per s",
)
class Sensitivities(NamedTuple):
    """K_max in N/m and its derivatives: per kg, per N s/m, per s of period and per s of delay."""

    stiffness_max: Array
    per_mass: Array
    per_damping: Array
    per_period: Array
    per_delay: Array
    status: Array


@accept_units
def sensitivities(
    *,
    mass: ArrayLike,
    damping: ArrayLike = 0.0,
    period: ArrayLike,
    delay: ArrayLike = 0.0,
    delay_model: DelayModel = "held",
) -> Sensitivities:
    """Return the stiffest stable wall and what it gains per unit of mass, damping, period and delay.

    With ``a = alpha_max(delta, d)``: ``dK/dm = (a - delta a_delta)/T^2``, ``dK/db = a_delta/T``,
    ``dK/dT = (delta a_delta - d a_d - 2 a) m/T^3``, ``dK/dt_d = a_d m/T^3``; each with the other three held fixed.

    Args:
        mass: m in kg, > 0.
        damping: b in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0. All four broadcast.
        delay_model: "held" (exact) or "fractional_power" (the paper's z^(1+d)).

    Returns:
        Sensitivities of the broadcast shape: ``stiffness_max`` in N/m, ``per_mass`` in N/m per kg, ``per_damping``
        in N/m per N s/m, ``per_period`` and ``per_delay`` in N/m per s; ``status``, with NaN where it is not 0.

    Numerics:
        Exact derivatives, about 1e-14. Both sides agree at whole d > 0; at zero damping and zero delay they are those
        from the right (-inf for ``per_delay`` of the fractional power at strong damping). Traceable.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import sensitivities
        >>> gain = sensitivities(mass=0.1, damping=10, period=1e-3, delay=1e-3)
        >>> print(f"{gain.per_damping:.0f} N/m per N s/m")
        572 N/m per N s/m
    """
    check_delay_model(delay_model)
    device = checked_device(mass=mass, damping=damping, period=period, delay=delay)
    arguments = dict(zip(_NAMES, (mass, damping, period, delay, device.delta, device.d), strict=True))
    return evaluate(_sensitivities_kernel, arguments, delay_model, classify_delays(device.d))


def _sensitivities_kernel(mass, damping, period, delay, delta, d, delay_model, kind) -> Sensitivities:
    xp = namespace(mass, delta, d)
    found = slopes_kernel(delta, d, delay_model, kind)
    # An array's entry beyond the range of its quantity is NaN in delta or d; the quantities tell why.
    given = quantity_status(mass=mass, damping=damping, period=period, delay=delay)
    status = xp.where(given == Status.OK, found.point.status, given).astype(np.int32)
    return Sensitivities(*stiffness_slopes(found, mass, period, delta, d), status)


Property = Literal["mass", "damping", "period", "delay"]
# Of these more only helps, in the end.
_RISES = ("mass", "damping")

_LEAST, _MOST = 0.2, 6.0
# Enough for two zeros that all but meet; in NumPy a few steps end it.
_STEPS = 24
# For the samples of a point.
_WEIGHT = 8


@shown()
class Requirement(NamedTuple):
    """The value asked for, in SI units, and a `zwidth.Status`.

    NaN where an entry is out of range, or the answer would be (OUT_OF_RANGE: SI quantities are 0 or 1e-30 to 1e30,
    delta at most 1e12, d at most 1e5), and where nothing is enough (UNREACHABLE).
    """

    value: Array
    status: Array


@accept_units
def required(
    parameter: Property,
    stiffness: ArrayLike,
    *,
    mass: ArrayLike | None = None,
    damping: ArrayLike | None = None,
    period: ArrayLike | None = None,
    delay: ArrayLike | None = None,
    delay_periods: ArrayLike | None = None,
) -> Requirement:
    """Return the value of one property of a rigid device at which its stiffest wall has a wanted stiffness.

    The last x of ``K_max(m, b, T, t_d) = K``: the least damping and the least mass from which on every more reaches K,
    the longest period, hence the lowest rate, and the longest delay that do.

    Args:
        parameter: "mass", "damping", "period" or "delay"; it is left out of those that follow.
        stiffness: the wanted K_max in N/m, > 0.
        mass: m in kg, > 0.
        damping: b in N s/m, >= 0; 0 where left out.
        period: T in s, > 0.
        delay: t_d in s, >= 0; 0 where left out.
        delay_periods: the delay as d = t_d/T in place of ``delay``; it moves with a period that is sought. All
            broadcast.

    Returns:
        `Requirement` in the SI unit of the parameter: a damping and a mass are 0 where the rest is enough; UNREACHABLE
        where no period or no delay is short enough.

    Raises:
        InputError: a scalar is out of range; what is sought is given, or what is needed is not.

    Numerics:
        K_max at the answer equals K to 2e-14; two zeros within two percent may not be told apart. Traceable, with first
        and second derivatives.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import required
        >>> print(f"{required('damping', 20e3, mass=0.1, period=1e-3, delay=1e-3).value:.2f} N s/m")
        10.24 N s/m
        >>> print(f"{1 / required('period', 20e3, mass=0.1, damping=10, delay_periods=1).value:.0f} Hz")
        1004 Hz
    """
    check_choice("parameter", parameter, get_args(Property))
    named = {"mass": mass, "damping": damping, "period": period, "delay": delay, "delay_periods": delay_periods}
    if named[parameter] is not None:
        raise InputError(f"{parameter}: got {named[parameter]!r}, but it is what is sought; leave it out")
    if delay_periods is not None and (delay is not None or parameter == "delay"):
        raise InputError(f"delay_periods: got {delay_periods!r}, and a delay in seconds; give one of the two")
    check_stiffness(stiffness)
    unnamed = {"damping": 0.0, "delay": 0.0, "delay_periods": 0.0, parameter: 1.0}
    *physical, turns = (unnamed.get(name) if value is None else value for name, value in named.items())
    device = normalize(**dict(zip(named, physical, strict=False)))
    denormalize(mass=1.0, period=1.0, d=turns)
    known = parameter in _RISES
    check_scalars({"delta": device.delta if parameter == "delay" else 0.0, "d": device.d if known else 0.0})
    fixed = delay_periods if delay_periods is not None else device.d if known else None
    kind = ANY if fixed is None else classify_delays(fixed)
    arguments = dict(zip(("stiffness", *named), (stiffness, *physical, turns), strict=True))
    return evaluate(_kernel, arguments, parameter, kind, weight=_WEIGHT)


class _Request(NamedTuple):
    wanted: Array  # stiffness
    mass: Array
    damping: Array
    period: Array
    delay: Array
    turns: Array  # delay in periods, beside the one in seconds

    def normalized(self) -> tuple[Array, Array]:
        """(delta, d)."""
        return self.damping * self.period / self.mass, in_periods(self.delay, self.period) + self.turns


def _kernel(*arguments: Any) -> Requirement:
    """The requirement of `_Request`; the last two arguments are the parameter and the delays that occur."""
    *inputs, parameter, kind = arguments
    names = ("stiffness", "mass", "damping", "period", "delay", "d")
    xp = namespace(*inputs)
    usable = quantity_status(**dict(zip(names, inputs, strict=True)))
    usable = xp.where(inputs[0] > 0, usable, int(Status.INVALID_INPUT))
    # A harmless number in place of a bad one.
    given, rises = _Request(*(xp.where(usable == Status.OK, value, 1.0) for value in inputs)), parameter in _RISES
    still = frozen(given, xp)

    def misfit(x: Array, given: _Request = still) -> Array:
        """``K_max/K - 1``, or ``K/K_max - 1`` where K_max falls: positive at large x, and there all but a power."""
        given = given._replace(**{parameter: x})
        reached = max_stiffness_kernel(given.mass, given.period, *given.normalized(), kind)
        return (reached / given.wanted if rises else given.wanted / reached) - 1.0

    def with_slope(x: Array, given: _Request = still) -> tuple[Array, Array]:
        given = given._replace(**{parameter: x})
        at = given.normalized()
        reached, *slopes = stiffness_slopes(slopes_kernel(*at, "held", kind), given.mass, given.period, *at)
        slope = slopes[get_args(Property).index(parameter)]
        if parameter == "period":
            # A delay in periods moves along.
            slope = slope + given.turns * slopes[-1]
        ratio = reached / given.wanted if rises else given.wanted / reached
        return ratio - 1.0, (1.0 if rises else -1.0) * ratio * slope / reached

    def at_samples(x: Array) -> Array:
        return misfit(x, _Request(*(part[..., None] for part in still)))

    inner, outer, offset = _bracket(parameter, still)
    at_inner, at_outer = apply_each(misfit, (inner, outer), xp)
    # Cut off by the domain, the bracket may end short of any zero.
    beyond = ~(at_outer > 0.0)
    if parameter == "damping":
        low, high, crossed = inner, outer, ~(at_inner > 0.0)
    else:
        low, high, crossed = last_cell(at_samples, inner, outer, offset)
    x = frozen(newton(with_slope, low, high, high, _STEPS)[0], xp)
    # Between samples that are all short of K a peak may touch it.
    crossed = crossed | (xp.abs(misfit(x)) <= 1e-12)
    near = 1e-3 * xp.abs(x)
    x = follow_root(lambda x: misfit(x, given), x, lambda slope, step: xp.abs(step) <= near)
    x = xp.where(x < inner, inner, x)
    found = crossed & ~beyond
    value = xp.where(found, x, 0.0)
    delta, d = given._replace(**{parameter: xp.where(found, x, outer)}).normalized()
    inside = within(value, SI_RANGE) & (device_status(delta, d) == Status.OK) & ~beyond
    # Where more of it only helps and there is no zero, nothing at all is required.
    status = xp.where(found | rises, int(Status.OK), int(Status.UNREACHABLE))
    status = xp.where(usable == Status.OK, xp.where(inside, status, int(Status.OUT_OF_RANGE)), usable)
    return Requirement(value + nan_with_nan_slopes(status == Status.OK, *inputs), status.astype(np.int32))


def _bracket(parameter: Property, given: _Request) -> tuple[Array, Array, Array]:
    """Ends between which the last zero lies within the domain, and what to add to samples of equal ratios."""
    wanted, m, b, T, t, turns = given
    xp = namespace(wanted, m)
    least, most = wanted / _LEAST, wanted / _MOST
    span = T * (1.0 + turns) + t
    if parameter == "damping":
        return 0.0 * m, xp.minimum(least * span, LARGEST_DAMPING * m / T), 0.0 * m
    if parameter == "mass":
        heaviest = least * span * span
        # The undamped device answers above the second bound; the lightest one has the largest delta.
        lightest = xp.where(b > 0, b * T / LARGEST_DAMPING, most * span * span)
        # No device so light that the damping drowns its mass is needed to see where K_max rises.
        return xp.minimum(xp.maximum(lightest, 1e-12 * heaviest), 0.01 * heaviest), heaviest, 0.0 * m
    # S of m/S^2 + b/S = k.
    short, long = ((b + xp.sqrt(b * b + 4.0 * k * m)) / (2.0 * k) for k in (least, most))
    if parameter == "delay":
        return 0.0 * T, xp.minimum(xp.maximum(long - T, 0.5 * T), LONGEST_DELAY * T), T
    short, long = short / (1.0 + turns), long / (1.0 + turns)
    # A delay of 1e5 periods, the longest that the model takes, is as good as continuous time, to 1e-5 of K.
    shortest = xp.where(t > 0, xp.maximum(1.001 * t / LONGEST_DELAY, 1e-6 * short), short)
    return xp.minimum(shortest, long), long, 0.0 * T
