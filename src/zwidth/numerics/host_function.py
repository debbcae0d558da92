"""Functions that NumPy computes with their derivatives, for use inside JAX transformations.

A *host function* is such a NumPy function; it also returns its first and second derivatives as arrays. `call_host`
evaluates it by a callback of JAX; under `jax.vmap`, one callback serves the whole batch. A program compiled by JAX
therefore contains only the callback and products with the arrays of derivatives, and is compiled fast. Third
derivatives are NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from zwidth.numerics.callbacks import call_numpy
from zwidth.numerics.evaluate import CACHED_KERNELS

# Type of a host function. Arguments: the order of the highest derivative (0 to 2), and an array of points with the
# shape (points, arguments). Result: a list of arrays, namely the values with the shape (points, results), then the
# first derivatives (points, results, arguments), then the second derivatives (points, results, arguments, arguments).
# The function must be hashable.
HostFunction: TypeAlias = Callable[[int, np.ndarray], list[np.ndarray]]


def call_host(function: HostFunction, count: int, point: jax.Array) -> jax.Array:
    """Return the ``count`` results of a host function at one point, which is a vector of arguments."""
    return _make_differentiable(function, count)(point)


@lru_cache(CACHED_KERNELS)
def _make_differentiable(function: HostFunction, count: int) -> Callable[[jax.Array], jax.Array]:
    """Return the host function as a JAX function with rules for its first and second derivatives."""

    def request(order: int, point: jax.Array) -> list[jax.Array]:
        return _request(function, count, order, point)

    @jax.custom_jvp
    def value(point: jax.Array) -> jax.Array:
        return request(0, point)[0]

    @jax.custom_jvp
    def slopes(point: jax.Array) -> tuple[jax.Array, jax.Array]:
        first, second = request(1, point)
        return first, second

    @jax.custom_jvp
    def curvatures(point: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        first, second, third = request(2, point)
        return first, second, third

    @value.defjvp
    def _(points: Any, changes: Any) -> Any:
        result, first = slopes(*points)
        return result, first @ changes[0]

    @slopes.defjvp
    def _(points: Any, changes: Any) -> Any:
        result, first, second = curvatures(*points)
        return (result, first), (first @ changes[0], second @ changes[0])

    @curvatures.defjvp
    def _(points: Any, changes: Any) -> Any:
        result, first, second = curvatures(*points)
        third = jnp.full_like(second, jnp.nan) * jnp.sum(changes[0])
        return (result, first, second), (first @ changes[0], second @ changes[0], third)

    return value


def _request(function: HostFunction, count: int, order: int, point: jax.Array) -> list[jax.Array]:
    """Return the values of a host function and its derivatives up to ``order`` at one point, by a callback of JAX."""
    shapes = [(count, *(point.shape[0],) * k) for k in range(order + 1)]
    return call_numpy(partial(_answer, function, order), shapes, point, vmap_method="broadcast_all")


def _answer(function: HostFunction, order: int, point: np.ndarray) -> list[np.ndarray]:
    """Return values and derivatives of a host function; the last axis of ``point`` holds the function's arguments."""
    parts = function(order, point.reshape(-1, point.shape[-1]).astype(np.float64))
    return [part.reshape(*point.shape[:-1], *part.shape[1:]) for part in parts]
