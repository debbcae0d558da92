"""Calls of NumPy functions by programs that JAX compiles, without loss of precision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from zwidth.core.types import Array


def call_numpy(
    function: Callable[..., Sequence[np.ndarray]],
    shapes: Sequence[tuple[int, ...]],
    *arrays: Array,
    vmap_method: str = "sequential",
) -> list[Array]:
    """Return the results of a NumPy function by a callback of JAX.

    All arrays and results have the same type, float32 or float64. They pass the callback as bit patterns in int32,
    because the callback may run in a thread with JAX's default precision, which would round float64 to float32.

    Args:
        function: maps NumPy arrays to a sequence of NumPy arrays; it must not use JAX.
        shapes: shapes of the results.
        *arrays: arguments of the function.
        vmap_method: method of `jax.pure_callback` under `jax.vmap`.
    """
    import jax
    import jax.numpy as jnp

    dtype = arrays[0].dtype
    bits = [jax.lax.bitcast_convert_type(array, jnp.int32) for array in arrays]
    # The bit pattern of float64 has a last axis of length 2.
    results = tuple(jax.ShapeDtypeStruct((*shape, *(2,) * (dtype.itemsize == 8)), jnp.int32) for shape in shapes)
    values = jax.pure_callback(partial(_call, function, np.dtype(dtype)), results, *bits, vmap_method=vmap_method)
    return [jax.lax.bitcast_convert_type(value, dtype) for value in values]


def _call(function: Callable[..., Sequence[np.ndarray]], dtype: np.dtype, *bits: Any) -> tuple[np.ndarray, ...]:
    """Return the bit patterns of the results of a function, given those of its arguments."""
    wide = dtype.itemsize == 8
    arrays = [np.ascontiguousarray(part).view(dtype) for part in bits]
    results = function(*(array[..., 0] if wide else array for array in arrays))
    results = [np.ascontiguousarray(result, dtype) for result in results]
    return tuple((result[..., None] if wide else result).view(np.int32) for result in results)
