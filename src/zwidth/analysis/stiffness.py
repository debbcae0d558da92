"""Maximum stiffness of a rigid device and its derivatives, in SI units, for arrays and inside JAX transformations.

The device has mass m, damping b, sampling period T and delay t_d, and uses the backward difference. With the normalized
damping ``delta = b T/m``, the delay ``d = t_d/T`` in periods, and the largest stable normalized stiffness ``a =
alpha_max(delta, d)`` (`stability.rigid.ridge`), the maximum stiffness is ``K_max = a m/T^2``, and by the chain rule

    dK/dm = (a - delta a_delta)/T^2                     dK/db = a_delta/T
    dK/dT = (delta a_delta - d a_d - 2 a) m/T^3         dK/dt_d = a_d m/T^3

with a_delta and a_d the partial derivatives of a. `zwidth.Scene` computes the same for one scene with any parts, and
finds the parameter value at which K_max equals a required stiffness.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import namespace
from zwidth.model.checks import accept_units
from zwidth.numerics.evaluate import check_scalars, compile_kernel, evaluate
from zwidth.plant.rigid_mass import DelayClasses, classify_delays
from zwidth.stability.rigid.normalization import Normalized, normalize, quantity_status
from zwidth.stability.rigid.ridge import ridge_kernel, slopes_kernel, stiffness_slopes
from zwidth.units.display import compact_repr


def normalize_device(**quantities: ArrayLike) -> Normalized:
    """Convert mass, damping, period and delay to delta and d; raise `InputError` if a scalar is out of range."""
    device = normalize(**quantities)
    check_scalars({"delta": device.delta, "d": device.d})
    return device


@accept_units
def max_stiffness(*, mass: ArrayLike, damping: ArrayLike = 0.0, period: ArrayLike, delay: ArrayLike = 0.0) -> Array:
    """Return the maximum stiffness: the supremum of K for which some virtual damping makes the wall stable.

    ``K_max = alpha_max(b T/m, t_d/T) m/T^2``, in N/m. A fractional delay is exact, with a zero-order hold.

    Args:
        mass: m in kg, > 0.
        damping: b, the physical damping of the device, in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0; need not be a multiple of T. All four broadcast.

    Returns:
        Array of the broadcast shape, in N/m; NaN for entries of arrays that are out of range.

    Numerics:
        Relative error about 1e-15. Traceable by JAX, with first and second derivatives.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import max_stiffness
        >>> print(f"{max_stiffness(mass=0.1, damping=10, period=1e-3, delay=1e-3):.0f} N/m")
        19865 N/m
    """
    device = normalize_device(mass=mass, damping=damping, period=period, delay=delay)
    arguments = {"mass": mass, "period": period, "delta": device.delta, "d": device.d}
    return evaluate(max_stiffness_kernel, arguments, classify_delays(device.d))


def max_stiffness_kernel(mass: Array, period: Array, delta: Array, d: Array, kind: DelayClasses) -> Array:
    """Compute K_max in N/m; ``kind`` states which delays d contains: below 1, from 1 on, or fractional ones."""
    return ridge_kernel(delta, d, kind).alpha * (mass / period) / period


@compact_repr(
    stiffness_max="N/m",
    per_mass="N/m per kg",
    per_damping="N/m per N s/m",
    per_period="N/m per s",
    per_delay="N/m per s",
)
class Sensitivities(NamedTuple):
    """Maximum stiffness and its derivatives with respect to mass, damping, period and delay, in SI units."""

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
    """Return the maximum stiffness and its derivatives with respect to mass, damping, period and delay.

    With ``a = alpha_max(delta, d)``: ``dK/dm = (a - delta a_delta)/T^2``, ``dK/db = a_delta/T``,
    ``dK/dT = (delta a_delta - d a_d - 2 a) m/T^3``, ``dK/dt_d = a_d m/T^3``, each with the other three constant.

    Args:
        mass: m in kg, > 0.
        damping: b in N s/m, >= 0.
        period: T in s, > 0.
        delay: t_d in s, >= 0; need not be a multiple of T. All four broadcast.

    Returns:
        Sensitivities of the broadcast shape: ``stiffness_max`` in N/m, ``per_mass`` in N/m per kg, ``per_damping``
        in N/m per N s/m, ``per_period`` and ``per_delay`` in N/m per s; ``status``, 0 if all are valid, else with NaN.

    Numerics:
        Analytic derivatives, relative error about 1e-14. They are continuous at integer d > 0, and derivatives from the
        right at zero damping and at zero delay. Traceable by JAX.

    References:
        Hulin, Preusche, Hirzinger 2006, section VII.

    Example:
        >>> from zwidth import sensitivities
        >>> gain = sensitivities(mass=0.1, damping=10, period=1e-3, delay=1e-3)
        >>> print(f"{gain.per_damping:.0f} N/m per N s/m")
        572 N/m per N s/m
    """
    device = normalize_device(mass=mass, damping=damping, period=period, delay=delay)
    quantities = {"mass": mass, "damping": damping, "period": period, "delay": delay}
    arguments = quantities | {"delta": device.delta, "d": device.d}
    return evaluate(_sensitivities_kernel, arguments, classify_delays(device.d))


def _sensitivities_kernel(mass, damping, period, delay, delta, d, kind) -> Sensitivities:
    """Compute K_max and its derivatives in SI units; ``kind`` is that of `max_stiffness_kernel`."""
    xp = namespace(mass, delta, d)
    # If JAX traces the quantities, compile the derivatives with respect to delta and d as a separate function, so that
    # JAX computes them once instead of once per quantity.
    slopes = slopes_kernel(delta, d, kind) if xp is np else compile_kernel(slopes_kernel, (kind,))(delta, d)
    # Compute the status of entries out of range from the quantities in SI units, because delta or d is NaN there.
    input_status = quantity_status(mass=mass, damping=damping, period=period, delay=delay)
    status = xp.where(input_status == Status.OK, slopes.point.status, input_status).astype(np.int32)
    return Sensitivities(*stiffness_slopes(slopes, mass, period, delta, d), status)
