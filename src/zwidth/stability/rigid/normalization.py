"""Convert SI quantities to the normalized parameters alpha, beta, delta and d, and back; check their ranges.

The stability of a rigid loop depends on four dimensionless parameters only (the paper's eqs. (14) and (16)):

    alpha = K T^2/m    beta = B T/m    delta = b T/m    d = t_d/T

A point is *invalid* if a parameter is not finite or has the wrong sign, and *out of range* if its magnitude is outside
the range in which the model is computed (`units.quantities`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from zwidth.core.errors import InputError
from zwidth.core.status import Status
from zwidth.core.types import Array, ArrayLike
from zwidth.core.xp import is_jax, is_traced, namespace, nan_unless, within
from zwidth.model.checks import accept_units, to_periods
from zwidth.numerics.evaluate import as_float64, evaluate, join_shapes
from zwidth.plant.rigid_mass import is_valid_device
from zwidth.units.display import compact_repr
from zwidth.units.quantities import PARAMETERS, SI_RANGE, SIZES, WALL_RANGE


@compact_repr()
class Normalized(NamedTuple):
    """The four dimensionless parameters that determine the stability of a wall."""

    alpha: Array
    beta: Array
    delta: Array
    d: Array


@compact_repr(mass="kg", damping="N s/m", period="s", delay="s")
class Physical(NamedTuple):
    """Mass and damping of the device, period and delay of the loop, stiffness and damping of the wall, in SI."""

    mass: Array
    damping: Array
    period: Array
    delay: Array
    stiffness: Array
    virtual_damping: Array


def _find_magnitude_range(name: str) -> tuple[float, float]:
    """Return the smallest and the largest allowed magnitude of the nonzero values of a quantity."""
    return SIZES.get(name, SI_RANGE)


def _check_quantity(name: str, value: ArrayLike) -> ArrayLike:
    """Convert a value to float64, or raise `InputError` for a scalar out of range; return a traced value unchanged."""
    if is_traced(value):
        return value
    number = as_float64(name, value)
    if number.ndim == 0:
        parameter, (least, most) = PARAMETERS[name], _find_magnitude_range(name)
        unit = f" (in {parameter.unit})" if parameter.unit != "1" else ""
        if not _is_valid(name, number):
            bound = str(parameter.sign)
            raise InputError(f"{name}: got {value!r}; it must be finite{f' and {bound}' if bound else ''}{unit}")
        if not within(number, (least, most)):
            allowed = f"0 or {least:g} to {most:g} in magnitude" if least else f"at most {most:g}"
            raise InputError(f"{name}: got {value!r}; it must be {allowed}{unit}")
    return number


def _is_valid(name: str, value: Array) -> Array:
    """Return whether a value is finite and has the sign that its parameter requires."""
    return namespace(value).isfinite(value) & PARAMETERS[name].sign.holds(value)


def quantity_status(**values: Array) -> Array:
    """Return the `Status` of quantities, given by name, elementwise; INVALID_INPUT has priority over OUT_OF_RANGE."""
    xp = namespace(*values.values())
    valid = inside = True
    for name, value in values.items():
        valid, inside = valid & _is_valid(name, value), inside & within(value, _find_magnitude_range(name))
    status = xp.where(valid, xp.where(inside, int(Status.OK), int(Status.OUT_OF_RANGE)), int(Status.INVALID_INPUT))
    return status.astype(np.int32)


def valid_wall(alpha: Array, beta: Array, delta: Array, d: Array) -> Array:
    """Return a mask that is True if all four values of a wall and its device are numbers in their ranges."""
    return is_valid_device(delta, d) & within(alpha, WALL_RANGE) & within(beta, WALL_RANGE)


def device_status(delta: Array, d: Array) -> Array:
    """Return the `Status` of each device and its delay: OK, INVALID_INPUT or OUT_OF_RANGE."""
    return quantity_status(delta=delta, d=d)


def wall_status(alpha: Array, beta: Array, delta: Array, d: Array) -> Array:
    """Return the `Status` of each wall on its device: OK, INVALID_INPUT or OUT_OF_RANGE."""
    return quantity_status(alpha=alpha, beta=beta, delta=delta, d=d)


def status_of_results(
    shape: tuple[int, ...], results: Iterable[np.ndarray], walls: tuple[np.ndarray, ...], device: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Return the `Status` of results for each wall on each device.

    Args:
        shape: Shape of the result.
        results: Arrays of results; NaN means NOT_CONVERGED.
        walls: alpha and beta.
        device: delta and d.
    """
    status = np.full(shape, Status.OK, np.uint8)
    for values in results:
        status[np.isnan(values)] = Status.NOT_CONVERGED
    # First test if all arguments are in range, because this is the usual case and the test is faster than computing a
    # status per point.
    if not (is_valid_device(*device).all() and all(within(part, WALL_RANGE).all() for part in walls)):
        input_status = wall_status(*walls, *device)
        np.copyto(status, input_status, where=input_status != Status.OK, casting="unsafe")
    return status


def _convert_quantities(formula: Callable[..., tuple[Array, ...]], **values: ArrayLike) -> tuple[Array, ...]:
    """Check the quantities, and return the results of ``formula`` for them, with NaN for array entries out of range."""
    checked = {name: _check_quantity(name, value) for name, value in values.items()}
    join_shapes((name, np.shape(value)) for name, value in checked.items())
    if any(map(is_jax, values.values())):
        return evaluate(_apply_formula, values, formula, tuple(values))
    with np.errstate(all="ignore"):
        result = _apply_formula(*checked.values(), formula, tuple(values))
    return tuple(part[()] for part in result)


def _apply_formula(*arguments: Any) -> tuple[Array, ...]:
    """Apply a formula to quantities, with NaN for those out of range; the last two arguments are formula and names."""
    *values, formula, names = arguments
    valid_masks = (
        _is_valid(name, value) & within(value, _find_magnitude_range(name))
        for name, value in zip(names, values, strict=True)
    )
    return formula(*(nan_unless(ok, value)[0] for ok, value in zip(valid_masks, values, strict=True)))


def _normalize(mass, damping, period, delay, stiffness, virtual_damping) -> tuple[Array, ...]:
    """Return alpha, beta, delta and d of SI quantities, by the paper's eqs. (14) and (16)."""
    return (
        stiffness * period * period / mass,
        virtual_damping * period / mass,
        damping * period / mass,
        to_periods(delay, period),
    )


def _denormalize(mass, period, alpha, beta, delta, d) -> tuple[Array, ...]:
    """Return the SI quantities, in the order of `Physical`, by the paper's eqs. (14) and (16)."""
    rate = mass / period
    return mass, delta * rate, period, d * period, alpha * rate / period, beta * rate


@accept_units
def normalize(
    *,
    mass: ArrayLike,
    damping: ArrayLike = 0.0,
    period: ArrayLike,
    delay: ArrayLike = 0.0,
    stiffness: ArrayLike = 0.0,
    virtual_damping: ArrayLike = 0.0,
) -> Normalized:
    """Convert SI quantities to normalized parameters.

    ``alpha = K T^2/m``, ``beta = B T/m``, ``delta = b T/m``, ``d = t_d/T``.

    Args:
        mass: m in kg, > 0.
        damping: b, the physical damping of the device, in N s/m, >= 0.
        period: T, the sampling period, in s, > 0.
        delay: t_d, from the sample to the instant at which its force begins to act, in s, >= 0.
        stiffness: K of the virtual wall in N/m.
        virtual_damping: B of the virtual wall in N s/m.
            All broadcast against each other; each is 0 or 1e-30 to 1e30 in magnitude.

    Returns:
        ``alpha``, ``beta``, ``delta``, ``d``. ``d`` is rounded to an integer if it differs from one by a rounding
        error only. An array entry that is out of range yields NaN.

    Raises:
        InputError: a scalar is out of range, or an argument is no number.

    References:
        Hulin, Preusche, Hirzinger 2006, eqs. (14), (16).

    Example:
        >>> import zwidth
        >>> wall = zwidth.normalize(mass=0.1, damping=10, period=1e-3, delay=1e-3, stiffness=14.9e3)
        >>> print(f"{wall.alpha:.3f} {wall.delta:.1f} {wall.d:.0f}")
        0.149 0.1 1
    """
    numbers = _convert_quantities(
        _normalize,
        mass=mass,
        damping=damping,
        period=period,
        delay=delay,
        stiffness=stiffness,
        virtual_damping=virtual_damping,
    )
    return Normalized(*numbers)


@accept_units
def denormalize(
    *,
    mass: ArrayLike,
    period: ArrayLike,
    alpha: ArrayLike = 0.0,
    beta: ArrayLike = 0.0,
    delta: ArrayLike = 0.0,
    d: ArrayLike = 0.0,
) -> Physical:
    """Convert normalized parameters to SI quantities, for a device of this mass and sampling period.

    ``K = alpha m/T^2``, ``B = beta m/T``, ``b = delta m/T``, ``t_d = d T``.

    Args:
        mass: m in kg, > 0.
        period: T in s, > 0.
        alpha: normalized stiffness, 0 or 1e-60 to 1e60 in magnitude.
        beta: normalized virtual damping, 0 or 1e-60 to 1e60 in magnitude.
        delta: normalized physical damping, 0 to 1e12.
        d: delay in periods, 0 to 1e5.

    Returns:
        ``mass``, ``damping``, ``period``, ``delay``, ``stiffness``, ``virtual_damping`` in SI units.

    Raises:
        InputError: a scalar is out of range, or an argument is no number.

    References:
        Hulin, Preusche, Hirzinger 2006, eqs. (14), (16).

    Example:
        >>> import zwidth
        >>> print(f"{zwidth.denormalize(mass=0.1, period=1e-3, alpha=0.149).stiffness:.0f} N/m")
        14900 N/m
    """
    numbers = _convert_quantities(_denormalize, mass=mass, period=period, alpha=alpha, beta=beta, delta=delta, d=d)
    return Physical(*numbers)
