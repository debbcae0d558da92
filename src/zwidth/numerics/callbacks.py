"""Call NumPy functions from programs that JAX compiles, without loss of precision.

A *callback* is such a call (`jax.pure_callback`). Its arguments and results are floats; they pass as *bit patterns*,
i.e. their bytes are read as int32 integers, because JAX may round float64 arguments of a callback to float32.
"""

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
    """Return the results of a NumPy function that compiled JAX code calls.

    All arrays and results have the same type, float32 or float64. The call passes them as bit patterns in int32.
    Otherwise, float64 values could be rounded to float32, because JAX may run the call in a thread with another default
    precision.

    Args:
        function: maps NumPy arrays to a sequence of NumPy arrays; it must not use JAX.
        shapes: shapes of the results.
        *arrays: arguments of the function.
        vmap_method: argument of `jax.pure_callback` that determines how `jax.vmap` evaluates the call for a batch.
    """
    import jax
    import jax.numpy as jnp

    dtype = arrays[0].dtype
    bits = [jax.lax.bitcast_convert_type(array, jnp.int32) for array in arrays]
    # Each float64 number is two int32 integers, along an additional last axis of length 2.
    results = tuple(jax.ShapeDtypeStruct((*shape, *(2,) * (dtype.itemsize == 8)), jnp.int32) for shape in shapes)
    values = jax.pure_callback(partial(_call, function, np.dtype(dtype)), results, *bits, vmap_method=vmap_method)
    return [jax.lax.bitcast_convert_type(value, dtype) for value in values]


def _call(function: Callable[..., Sequence[np.ndarray]], dtype: np.dtype, *bits: Any) -> tuple[np.ndarray, ...]:
    """Apply a NumPy function to arguments given as bit patterns; return the bit patterns of its results."""
    wide = dtype.itemsize == 8
    arrays = [np.ascontiguousarray(part).view(dtype) for part in bits]
    results = function(*(array[..., 0] if wide else array for array in arrays))
    results = [np.ascontiguousarray(result, dtype) for result in results]
    return tuple((result[..., None] if wide else result).view(np.int32) for result in results)
