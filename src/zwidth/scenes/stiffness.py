"""How stiff the wall of a rigid device can be, and what a little more of each property buys: arrays, also inside JAX.

The same of one scene, rigid or not, and what a wanted stiffness requires: `zwidth.Scene`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.arrays.evaluate import check_scalars, compile_traced, evaluate
from zwidth.arrays.held_mass import DelayClasses, classify_delays
from zwidth.loops.rigid.normalization import Normalized, normalize, quantity_status
from zwidth.loops.rigid.ridge import ridge_kernel, slopes_kernel, stiffness_slopes
from zwidth.parts.checks import accept_units
from zwidth.words.showing import shown
from zwidth.words.status import Status
from zwidth.words.types import Array, ArrayLike
from zwidth.words.xp import namespace


def checked_device(**quantities: ArrayLike) -> Normalized:
    """The normalized device; raises `InputError` also where a scalar delta or d is beyond the range of the model."""
    device = normalize(**quantities)
    check_scalars({"delta": device.delta, "d": device.d})
    return device


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
    return ridge_kernel(delta, d, kind).alpha * (mass / period) / period


def move_max_stiffness(
    mass: Array, period: Array, delta: Array, d: Array, kind: DelayClasses
) -> tuple[Array, tuple[Array, ...]]:
    """Return `max_stiffness_kernel` and its derivatives with respect to mass, period, delta and d."""
    found = slopes_kernel(delta, d, kind)
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
    *, mass: ArrayLike, damping: ArrayLike = 0.0, period: ArrayLike, delay: ArrayLike = 0.0
) -> Sensitivities:
    """Return the stiffest stable wall and what it gains per unit of mass, damping, period and delay.

    With ``a = alpha_max(delta, d)``: ``dK/dm = (a - delta a_delta)/T^2``, ``dK/db = a_delta/T``,
    ``dK/dT = (delta a_delta - d a_d - 2 a) m/T^3``, ``dK/dt_d = a_d m/T^3``; each with the other three held fixed.

    Args:
        mass: m in kg, > 0.
        damping: b in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0, held. All four broadcast.

    Returns:
        Sensitivities of the broadcast shape: ``stiffness_max`` in N/m, ``per_mass`` in N/m per kg, ``per_damping``
        in N/m per N s/m, ``per_period`` and ``per_delay`` in N/m per s; ``status``, with NaN where it is not 0.

    Numerics:
        Exact derivatives, about 1e-14. Both sides agree at whole d > 0; at zero damping and zero delay they are those
        from the right. Traceable.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import sensitivities
        >>> gain = sensitivities(mass=0.1, damping=10, period=1e-3, delay=1e-3)
        >>> print(f"{gain.per_damping:.0f} N/m per N s/m")
        572 N/m per N s/m
    """
    device = checked_device(mass=mass, damping=damping, period=period, delay=delay)
    given = {"mass": mass, "damping": damping, "period": period, "delay": delay}
    arguments = given | {"delta": device.delta, "d": device.d}
    return evaluate(_sensitivities_kernel, arguments, classify_delays(device.d))


def _sensitivities_kernel(mass, damping, period, delay, delta, d, kind) -> Sensitivities:
    xp = namespace(mass, delta, d)
    # If traced, compute the derivatives in delta and d once, not again for each quantity.
    found = slopes_kernel(delta, d, kind) if xp is np else compile_traced(slopes_kernel, (kind,))(delta, d)
    # Array entries out of range are NaN in delta or d; compute their status from the quantities.
    given = quantity_status(mass=mass, damping=damping, period=period, delay=delay)
    status = xp.where(given == Status.OK, found.point.status, given).astype(np.int32)
    return Sensitivities(*stiffness_slopes(found, mass, period, delta, d), status)
