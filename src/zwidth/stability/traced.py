"""The methods inside a user's own transformation: plain kernels of one point, in the ambient precision."""

from __future__ import annotations

import jax.numpy as jnp

from zwidth._types import Array, ArrayLike
from zwidth.errors import InputError
from zwidth.grouping import Degree, by_degree
from zwidth.loop import valid_wall
from zwidth.stability.devices import device
from zwidth.stability.poles import pole_kernel
from zwidth.stability.radius import bisect, bracket
from zwidth.stability.radius_map import steps_for

Values = tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]


def _largest(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree) -> Array:
    return jnp.max(jnp.abs(pole_kernel(alpha, beta, delta, d, degree)))


def _bisection(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, accuracy: float) -> Array:
    here = device(delta, d)
    low, high = bracket(alpha, beta, here, degree)
    low, high = bisect(alpha, beta, low, high, steps_for(accuracy, degree), here, degree)
    return jnp.where(valid_wall(alpha, beta, delta, d), 0.5 * (low + high), jnp.nan)


def radius(values: Values, method: str, accuracy: float) -> Array:
    """`zwidth.spectral_radius` on values of which some are traced; the delay must be concrete."""
    if method == "newton":
        raise InputError(
            "method: 'newton' works on whole maps, on the host; inside a JAX transformation use 'companion' "
            "or 'bisection'"
        )
    if method == "bisection":
        return by_degree(_bisection, values, static=(accuracy,))
    return by_degree(_largest, values)
