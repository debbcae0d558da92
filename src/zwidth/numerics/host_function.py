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

# Type of a host function. Arguments: the order of the highest derivative (0 to 2), and an array of points with the
# shape (points, arguments). Result: a list of arrays, namely the values with the shape (points, results), then the
# first derivatives (points, results, arguments), then the second derivatives (points, results, arguments, arguments).
# The function must be hashable.
HostFunction: TypeAlias = Callable[[int, np.ndarray], list[np.ndarray]]

CACHED = 256  # number of functions whose compiled programs are kept


def call_host(function: HostFunction, count: int, point: jax.Array) -> jax.Array:
    """Return the ``count`` results of a host function at one point, which is a vector of arguments."""
    return _make_differentiable(function, count)(point)


@lru_cache(CACHED)
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
    size, dtype = point.shape[0], point.dtype
    shapes = [(count, *(size,) * k) for k in range(order + 1)]
    # Pass the float64 numbers to the callback and back as int32 bit patterns, because the callback may run in a thread
    # with JAX's default precision, which would round the numbers to float32.
    bits = jax.lax.bitcast_convert_type(point, jnp.int32)
    total = sum(int(np.prod(shape)) for shape in shapes)
    result = jax.pure_callback(
        partial(_answer, function, order, np.dtype(dtype)),
        jax.ShapeDtypeStruct((total, *bits.shape[1:]), jnp.int32),
        bits,
        vmap_method="broadcast_all",
    )
    flat = jax.lax.bitcast_convert_type(result, dtype)
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(jnp.split(flat, ends[:-1]), shapes, strict=True)]


def _answer(function: HostFunction, order: int, dtype: np.dtype, bits: Any) -> np.ndarray:
    """Compute values and derivatives of a host function at a batch of points; input and output are bit patterns."""
    bits = np.ascontiguousarray(bits)
    tail = bits.shape[bits.ndim - (2 if dtype.itemsize == 8 else 1) :]
    points = bits.view(dtype).reshape(-1, tail[0]).astype(np.float64)
    parts = function(order, points)
    rows = np.concatenate([part.reshape(len(points), -1) for part in parts], 1).astype(dtype)
    return np.ascontiguousarray(rows).view(np.int32).reshape(*bits.shape[: bits.ndim - len(tail)], -1, *tail[1:])
