"""The methods inside a user's own transformation: plain kernels of one point, in the ambient precision."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.batching import is_traced
from zwidth.errors import InputError
from zwidth.grouping import Degree, by_degree
from zwidth.loop import valid_wall
from zwidth.stability.devices import device
from zwidth.stability.poles import pole_kernel
from zwidth.stability.radius import bisect, bracket
from zwidth.stability.radius_map import steps_for
from zwidth.stability.row_limit import VERIFIED_DAMPING, VERIFIED_DELAY, long_device, long_row, short_row
from zwidth.stability.schur_cohn import labels

Values = tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike]


def _companion(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree) -> Array:
    return jnp.all(jnp.abs(pole_kernel(alpha, beta, delta, d, degree)) < 1.0)


def _schur_cohn(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree) -> Array:
    return labels(alpha, beta, device(delta, d), degree)


def _boundary(alpha: Array, beta: Array, delta: Array, d: Array, degree: Degree, known: bool) -> Array:
    here = device(delta, d)
    limit = short_row(beta, here) if degree.whole == 0 else long_row(beta, long_device(here))
    below = (alpha > 0) & (alpha < limit)
    if known:
        return below
    return jnp.where((delta <= VERIFIED_DAMPING) & (d <= VERIFIED_DELAY), below, labels(alpha, beta, here, degree))


def stable(values: Values, method: str) -> Array:
    """`zwidth.is_stable` on values of which some are traced; the delay must be concrete."""
    if method == "certified":
        raise InputError(
            "method: 'certified' decides in arbitrary precision on the host; inside a JAX transformation use "
            "'auto', 'boundary', 'schur_cohn' or 'companion'"
        )
    if method == "companion":
        return by_degree(_companion, values)
    if method == "schur_cohn":
        return by_degree(_schur_cohn, values)
    delta, d = values[2:]
    known = not is_traced(delta, d) and bool(
        np.all(np.asarray(delta) <= VERIFIED_DAMPING) and np.all(np.asarray(d) <= VERIFIED_DELAY)
    )
    return by_degree(_boundary, values, static=(known,))


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
