"""The one place where kernels of a single point become functions of whole arrays.

A public function converts and checks its arguments on the host, then calls `pointwise` with a pure kernel of
one point. Called directly it computes in float64, whatever JAX's configuration says, and changes no setting
of it; inside somebody's own transformation (`jit`, `grad`, ...) the ambient precision holds.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from zwidth._types import Array, ArrayLike
from zwidth.errors import InputError, TracedDelayError

# Large batches run in pieces of one size: one compilation, bounded memory, and a point's value does not depend
# on how many others came with it. (A single number is compiled apart and may differ in the last place.)
CHUNK = 1 << 15


def is_traced(*values: ArrayLike) -> bool:
    """Whether any argument is inside a JAX transformation."""
    return any(isinstance(value, jax.core.Tracer) for value in values)


@contextmanager
def concretely() -> Iterator[None]:
    """Compute in float64 and at once, though the caller may be inside a JAX transformation that traces other values.

    The settings belong to the thread and end with the block.
    """
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        yield


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
        with concretely():
            return jax.tree.map(jnp.asarray, result)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[()], result)


# Kernels that iterate over long formulas compile 2 to 5 times faster without XLA's fusion, and run no slower:
# fused, XLA computes shared parts of the formula again for each of their uses.
_UNFUSED = {"xla_disable_hlo_passes": "fusion"}


@cache
def _compiled(kernel: Callable[..., Any], static: tuple[Any, ...], fused: bool) -> Callable[..., Any]:
    options = None if fused else _UNFUSED
    return jax.jit(jax.vmap(lambda *point: kernel(*point, *static)), compiler_options=options)


def _padded_size(count: int, chunk: int, least: int) -> int:
    """Round up to a power of two, so that batches of many sizes share a few compilations."""
    return min(chunk, 1 << max(count - 1, least - 1, 0).bit_length())


def _piece(column: np.ndarray, start: int, size: int) -> np.ndarray:
    part = column[start : start + size]
    missing = size - part.size
    if not missing:
        return part
    # The last point is repeated: a neutral filler would need to be known to be good for every kernel.
    return np.concatenate([part, np.full(missing, part[-1] if part.size else 0.0)])


def map_flat(
    kernel: Callable[..., Any],
    columns: list[np.ndarray],
    static: tuple[Any, ...] = (),
    chunk: int = CHUNK,
    fused: bool = True,
    least: int = 1,
    threads: int | None = None,
) -> Any:
    """Apply a one-point kernel to every row of equally long columns, in float64; NumPy leaves come back.

    Pieces hold ``chunk`` points and run on ``threads`` threads, by default as many as there are processors. A piece is
    never shorter than ``least``: the compiler treats very short ones differently, to the last place.
    """
    count = columns[0].size
    function = _compiled(kernel, static, fused)
    size = _padded_size(count, chunk, least)

    def run(start: int) -> Any:
        with concretely():
            result = function(*(_piece(column, start, size) for column in columns))
            return jax.tree.map(np.asarray, result)

    first = run(0)
    # A copy, because JAX's own memory is read-only.
    whole = jax.tree.map(lambda leaf: np.empty((count, *leaf.shape[1:]), leaf.dtype), first)

    def store(start: int, result: Any) -> None:
        stop = min(start + size, count)
        jax.tree.map(lambda to, leaf: np.copyto(to[start:stop], leaf[: stop - start]), whole, result)

    store(0, first)
    if count > size:
        # The first piece has compiled the function; JAX lets go of the interpreter while it computes.
        with ThreadPoolExecutor(threads or _processors()) as pool:
            list(pool.map(lambda start: store(start, run(start)), range(size, count, size)))
    return whole


def _processors() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS
        return os.cpu_count() or 1


class _Packed(NamedTuple):
    """A compiled kernel of one point that returns one vector, and how to take its result out of it."""

    function: Callable[..., Any]
    unpack: Callable[[np.ndarray], Any]


@cache
def _packed(kernel: Callable[..., Any], static: tuple[Any, ...], arity: int, fused: bool) -> _Packed | None:
    """For a kernel that returns real scalars. One array in and one out: each costs as much as the computation."""

    def at(point: jax.Array) -> Any:
        return kernel(*(point[index] for index in range(arity)), *static)

    shapes = jax.eval_shape(at, jax.ShapeDtypeStruct((arity,), np.float64))
    leaves, structure = jax.tree.flatten(shapes)
    if any(leaf.shape or leaf.dtype.kind not in "fiub" for leaf in leaves):
        return None
    types = [leaf.dtype.type for leaf in leaves]
    function = jax.jit(
        lambda point: jnp.stack([leaf.astype(point.dtype) for leaf in jax.tree.leaves(at(point))]),
        compiler_options=None if fused else _UNFUSED,
    )

    def unpack(vector: np.ndarray) -> Any:
        return structure.unflatten([kind(value) for kind, value in zip(types, vector.tolist(), strict=True)])

    return _Packed(function, unpack)


def _single(kernel: Callable[..., Any], point: list[float], static: tuple[Any, ...], fused: bool) -> Any:
    """The result at one point, as NumPy scalars (arrays where the kernel returns any)."""
    with jax.enable_x64(True):
        packed = _packed(kernel, static, len(point), fused)
        if packed is not None:
            # Entering `concretely` takes a tenth of a query: only where a transformation is found to be under way.
            vector = packed.function(np.array(point)) if fused else None
            if vector is None or isinstance(vector, jax.core.Tracer):
                with concretely():
                    vector = packed.function(np.array(point))
            return packed.unpack(np.asarray(vector))
    columns = [np.array([value]) for value in point]
    return jax.tree.map(lambda leaf: leaf[0], map_flat(kernel, columns, static, fused=fused))


# The types whose conversion needs no check; bool and 0-d arrays take the long way.
_NUMBERS = frozenset({float, int, np.float64})


def pointwise(
    kernel: Callable[..., Any],
    names: tuple[str, ...],
    values: tuple[ArrayLike, ...],
    static: tuple[Any, ...] = (),
    chunk: int = CHUNK,
    fused: bool = True,
    least: int = 1,
) -> Any:
    """Broadcast ``values``, apply the one-point ``kernel`` to each point, and restore the common shape."""
    if _NUMBERS.issuperset(map(type, values)):
        try:
            return _single(kernel, [float(value) for value in values], static, fused)
        except OverflowError:
            pass  # An integer beyond float64: the long way names it.
    if is_traced(*values):
        return _traced(kernel, values, static)
    arrays = broadcast(names, values)
    shape = arrays[0].shape
    if not shape:
        return to_caller(_single(kernel, [float(array) for array in arrays], static, fused), values)
    flat = map_flat(kernel, [array.ravel() for array in arrays], static, chunk, fused, least)
    return to_caller(jax.tree.map(lambda leaf: leaf.reshape(shape + leaf.shape[1:]), flat), values)


def _traced(kernel: Callable[..., Any], values: tuple[ArrayLike, ...], static: tuple[Any, ...]) -> Any:
    dtype = jnp.result_type(float)
    arrays = jnp.broadcast_arrays(*(jnp.asarray(value, dtype) for value in values))
    shape = arrays[0].shape
    if not shape:
        return kernel(*arrays, *static)
    flat = jax.vmap(lambda *point: kernel(*point, *static))(*(array.reshape(-1) for array in arrays))
    return jax.tree.map(lambda leaf: leaf.reshape(shape + leaf.shape[1:]), flat)


def stored(values: Any, witness: Array) -> Any:
    """``values``, computed once: for a kernel in which many later steps use them.

    XLA:CPU repeats a chain of cheap operations in every loop it makes out of the operations behind it, but never a
    division. The divisor here is 1, or NaN where ``witness`` (anything known at run time) is, so that the compiler
    cannot see it. Halves the time to compile and to run of a Newton iteration on a discretized plant.
    """
    one = jax.lax.stop_gradient(jnp.where(jnp.isnan(witness), jnp.nan, 1.0))
    return jax.tree.map(lambda value: value / one, values)


def concrete_delay(d: ArrayLike) -> np.ndarray:
    """The delay as a concrete array; a traced one is refused where it decides an array's shape."""
    if is_traced(d):
        raise TracedDelayError(
            "d: got a traced value, but the number of poles depends on it; pass d as a plain number, "
            "for example through jit's static_argnums or a closure"
        )
    return as_float64("d", d)
