"""The one place where kernels of a single point become functions of whole arrays.

A public function converts and checks its arguments on the host, then calls `pointwise` with a pure kernel of
one point. Called directly it computes in float64, whatever JAX's configuration says, and changes no setting
of it; inside somebody's own transformation (`jit`, `grad`, ...) the ambient precision holds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from zwidth._types import ArrayLike
from zwidth.errors import InputError, TracedDelayError

# Large batches run in pieces of one size: one compilation, bounded memory, and a point's value does not depend
# on how many others came with it.
CHUNK = 1 << 15


def is_traced(*values: ArrayLike) -> bool:
    """Whether any argument is inside a JAX transformation."""
    return any(isinstance(value, jax.core.Tracer) for value in values)


def as_float64(name: str, value: ArrayLike) -> np.ndarray:
    """Convert one concrete argument to float64, or say what is wrong with it."""
    try:
        array = np.asarray(value)
        if array.dtype.kind in "OSUcVmM":
            raise TypeError(array.dtype)
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{name}: got {value!r}, a real number or a rectangular array of real numbers is needed"
        ) from error


def broadcast(names: tuple[str, ...], values: tuple[ArrayLike, ...]) -> list[np.ndarray]:
    """Convert concrete arguments to float64 arrays of one common shape."""
    arrays = [as_float64(name, value) for name, value in zip(names, values, strict=True)]
    try:
        return list(np.broadcast_arrays(*arrays))
    except ValueError as error:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in zip(names, arrays, strict=True))
        raise InputError(f"shapes do not broadcast: {shapes}; make each axis equal or 1") from error


def to_caller(result: Any, values: tuple[ArrayLike, ...]) -> Any:
    """Hand NumPy results to a caller who passed NumPy or plain numbers, JAX arrays to one who passed any."""
    if any(isinstance(value, jax.Array) for value in values):
        # Without this a caller with JAX's default precision would lose half of the digits on the way out.
        with jax.enable_x64(True):
            return jax.tree.map(jnp.asarray, result)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[()], result)


# Kernels that iterate over long formulas compile 2 to 5 times faster without XLA's fusion, and run no slower:
# fused, XLA computes shared parts of the formula again for each of their uses.
_UNFUSED = {"xla_disable_hlo_passes": "fusion"}


@cache
def _compiled(kernel: Callable[..., Any], static: tuple[Any, ...], fused: bool) -> Callable[..., Any]:
    options = None if fused else _UNFUSED
    return jax.jit(jax.vmap(lambda *point: kernel(*point, *static)), compiler_options=options)


def _padded_size(count: int, chunk: int) -> int:
    """Round up to a power of two, so that batches of many sizes share a few compilations."""
    return min(chunk, 1 << max(count - 1, 0).bit_length())


def map_flat(
    kernel: Callable[..., Any],
    columns: list[np.ndarray],
    static: tuple[Any, ...] = (),
    chunk: int = CHUNK,
    fused: bool = True,
) -> Any:
    """Apply a one-point kernel to every row of equally long columns, in float64; NumPy leaves come back."""
    count = columns[0].size
    function = _compiled(kernel, static, fused)
    size = _padded_size(count, chunk)
    pieces = []
    with jax.enable_x64(True):
        for start in range(0, max(count, 1), size):
            parts = [column[start : start + size] for column in columns]
            missing = size - parts[0].size
            # The last point is repeated: a neutral filler would need to be known to be good for every kernel.
            filled = [np.pad(part, (0, missing), mode="edge") if part.size else np.zeros(size) for part in parts]
            result = function(*filled)
            pieces.append(jax.tree.map(lambda leaf, stop=size - missing: np.asarray(leaf)[:stop], result))
    return pieces[0] if len(pieces) == 1 else jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)


def pointwise(
    kernel: Callable[..., Any],
    names: tuple[str, ...],
    values: tuple[ArrayLike, ...],
    static: tuple[Any, ...] = (),
    chunk: int = CHUNK,
    fused: bool = True,
) -> Any:
    """Broadcast ``values``, apply the one-point ``kernel`` to each point, and restore the common shape."""
    if is_traced(*values):
        return _traced(kernel, values, static)
    arrays = broadcast(names, values)
    shape = arrays[0].shape
    flat = map_flat(kernel, [array.ravel() for array in arrays], static, chunk, fused)
    return to_caller(jax.tree.map(lambda leaf: leaf.reshape(shape + leaf.shape[1:]), flat), values)


def _traced(kernel: Callable[..., Any], values: tuple[ArrayLike, ...], static: tuple[Any, ...]) -> Any:
    dtype = jnp.result_type(float)
    arrays = jnp.broadcast_arrays(*(jnp.asarray(value, dtype) for value in values))
    shape = arrays[0].shape
    if not shape:
        return kernel(*arrays, *static)
    flat = jax.vmap(lambda *point: kernel(*point, *static))(*(array.reshape(-1) for array in arrays))
    return jax.tree.map(lambda leaf: leaf.reshape(shape + leaf.shape[1:]), flat)


def concrete_delay(d: ArrayLike) -> np.ndarray:
    """The delay as a concrete array; a traced one is refused where it decides an array's shape."""
    if is_traced(d):
        raise TracedDelayError(
            "d: got a traced value, but the number of poles depends on it; pass d as a plain number, "
            "for example through jit's static_argnums or a closure"
        )
    return as_float64("d", d)
