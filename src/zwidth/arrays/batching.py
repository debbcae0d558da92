"""The one place where kernels become functions of whole arrays, in NumPy or in compiled JAX.

A public function converts and checks its arguments on the host, then calls `elementwise` with a pure kernel. Called
directly it computes in float64, whatever JAX's configuration says, and changes no setting of it: few points by NumPy
at once, without importing JAX; many by JAX, compiled. Inside somebody's own transformation (`jit`, `grad`, ...) the
compiled kernel is called and the ambient precision holds.
"""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from zwidth.arrays.xla import STRIP, WIDE
from zwidth.arrays.xp import is_jax, is_traced
from zwidth.words.errors import InputError, PrecisionWarning, TracedDelayError
from zwidth.words.types import ArrayLike

# Large batches run in pieces of one size: one compilation, bounded memory, and a point's value does not depend
# on how many others came with it. (A single number is computed apart and may differ in the last place.)
CHUNK = 1 << 15
# Up to so many points NumPy is done before a compiler has begun.
FEW = 1 << 12
# What an elementwise kernel holds at one time then stays in the cache; smaller blocks cost as much in calls.
BLOCK = 1 << 16
# The same of kernels that make hundreds of samples of each point.
SAMPLED = 1 << 9
# The compiler treats shorter arrays differently, to the last place.
_LEAST = 1 << 4


@contextmanager
def compute_concretely() -> Iterator[None]:
    """Compute in float64 and at once, though the caller may be inside a JAX transformation that traces other values.

    The settings belong to the thread and end with the block.
    """
    import jax

    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        yield


def refuse_masked(name: str, value: ArrayLike) -> None:
    """Raise `InputError` for a masked array; the module that defines them is loaded by those who make some."""
    masked = sys.modules.get("numpy.ma")
    if masked is not None and isinstance(value, masked.MaskedArray):
        raise InputError(f"{name}: got a masked array, whose mask would be lost; fill it, with NaN say, first")


def as_float64(name: str, value: ArrayLike) -> np.ndarray:
    """Convert one concrete argument to float64, or say what is wrong with it."""
    refuse_masked(name, value)
    if is_traced(value):
        raise InputError(f"{name}: got a value that JAX traces; give numbers, outside of jit, vmap and grad")
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
    join_shapes(zip(names, (array.shape for array in arrays), strict=True))
    return list(np.broadcast_arrays(*arrays))


def join_shapes(named: Iterable[tuple[str, tuple[int, ...]]], what: str = "shapes") -> tuple[int, ...]:
    """The shape that arguments of these shapes broadcast to; an `InputError` with all of them where they do not."""
    named = list(named)
    try:
        return np.broadcast_shapes(*(shape for _, shape in named))
    except ValueError:
        shapes = ", ".join(f"{name} {shape}" for name, shape in named)
        raise InputError(f"{what} do not broadcast: {shapes}; make each axis equal or 1") from None


def tree_map(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Apply a function to the arrays of a (named) tuple, or to a single array."""
    if not isinstance(tree, tuple):
        return function(tree, *others)
    parts = [tree_map(function, *leaves) for leaves in zip(tree, *others, strict=True)]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def to_caller(result: Any, values: tuple[ArrayLike, ...]) -> Any:
    """Hand NumPy results to a caller who passed NumPy or plain numbers, JAX arrays to one who passed any."""
    if any(map(is_jax, values)):
        import jax.numpy as jnp

        # Without this a caller with JAX's default precision would lose half of the digits on the way out.
        with compute_concretely():
            return tree_map(jnp.asarray, result)
    return tree_map(lambda leaf: np.asarray(leaf)[()], result)


# The types whose conversion needs no check; bool and 0-d arrays take the long way.
_NUMBERS = frozenset({float, int, np.float64})


def are_numbers(*values: ArrayLike) -> bool:
    """Whether all values are plain numbers, whose conversion needs no check."""
    return _NUMBERS.issuperset(map(type, values))


def elementwise(
    kernel: Callable[..., Any],
    names: tuple[str, ...],
    values: tuple[ArrayLike, ...],
    static: tuple[Any, ...] = (),
    *,
    few: int = FEW,
    block: int = BLOCK,
    samples: bool = False,
) -> Any:
    """Broadcast ``values`` and apply ``kernel(*arrays, *static)``, whose text serves NumPy and JAX.

    The kernel is elementwise: it gets arrays of one shape (or plain numbers) and returns one or a tuple of that shape.
    With ``samples`` it makes hundreds of samples of a point, and is compiled for traced values only: that takes many
    seconds and then wins nothing over NumPy.
    """
    if are_numbers(*values):
        try:
            numbers = list(map(np.float64, values))
        except OverflowError:
            pass  # An integer beyond float64: the long way names it.
        else:
            with np.errstate(all="ignore"):
                return tree_map(_plain, kernel(*numbers, *static))
    if is_traced(*values):
        return _compile_elementwise(kernel, static)(*traced_columns(values))
    arrays = broadcast(names, values)
    few, block = (SAMPLED, SAMPLED) if samples else (few, block)
    if arrays[0].size <= few:
        with np.errstate(all="ignore"):
            result = kernel(*arrays, *static)
        # A copy: a view of an argument, or of one value, could not be written to.
        return to_caller(tree_map(lambda leaf: np.array(np.broadcast_to(leaf, arrays[0].shape)), result), values)
    shape = arrays[0].shape
    function = _quietly(kernel, static) if samples else _compile_elementwise(kernel, static)
    flat = map_blocks(function, [array.reshape(-1) for array in arrays], block)
    return to_caller(tree_map(lambda leaf: leaf.reshape(shape), flat), values)


def _quietly(kernel: Callable[..., Any], static: tuple[Any, ...]) -> Callable[..., Any]:
    """A kernel for NumPy's arrays that warns of nothing."""

    def function(*arrays: np.ndarray) -> Any:
        with np.errstate(all="ignore"):
            return kernel(*arrays, *static)

    return function


def _plain(leaf: Any) -> Any:
    """A NumPy scalar for the result at a single point."""
    return leaf if isinstance(leaf, np.generic) else np.asarray(leaf)[()]


def traced_columns(values: tuple[ArrayLike, ...]) -> list[Any]:
    """The arguments inside a transformation: one shape, the ambient precision."""
    import jax.numpy as jnp

    dtype = jnp.result_type(float)
    if dtype == np.float32:
        _warn_of_float32()
    return jnp.broadcast_arrays(*(jnp.asarray(value, dtype) for value in values))


_warned = threading.Event()


def _warn_of_float32() -> None:
    """Say once a process that half of the digits are missing: an optimizer would stop there and not tell."""
    if not _warned.is_set():
        _warned.set()
        warnings.warn(
            "computing in float32 inside a JAX transformation; call jax.config.update('jax_enable_x64', True) first "
            "for float64",
            PrecisionWarning,
            stacklevel=_stack_level(),
        )


def _stack_level() -> int:
    """How far up the first caller outside of zwidth and JAX is: the warning then names a line of the user's."""
    frame, level = sys._getframe(1), 1
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in ("zwidth", "jax"):
        frame, level = frame.f_back, level + 1
    return level


@cache
def _compile_elementwise(kernel: Callable[..., Any], static: tuple[Any, ...]) -> Callable[..., Any]:
    """A kernel compiled, with its derivatives as one product for each argument.

    A point depends on itself alone, so that all there is to differentiate is a few numbers a point. Left to itself,
    `jax.grad` outside `jit` would compile a program that hands out every intermediate result: for the ridge
    1.2 to 1.5 times as long (benchmarks/bench_xla.py).
    """
    import jax

    def plain(*arrays: Any) -> Any:
        return kernel(*arrays, *static)

    def by_argument(active: tuple[bool, ...], *arrays: Any) -> tuple[Any, Any]:
        """The values, and along a new first axis the derivatives in the arguments that move."""
        moving = [k for k, moves in enumerate(active) if moves]

        def of_moving(*values: Any) -> Any:
            known = dict(zip(moving, values, strict=True))
            return plain(*(known.get(k, array) for k, array in enumerate(arrays)))

        points = tuple(arrays[k] for k in moving)
        ones = jax.numpy.ones_like(points[0])
        if len(moving) == 1:
            value, slopes = jax.jvp(of_moving, points, (ones,))
            return value, tree_map(lambda leaf: leaf[None], slopes)
        sides = tuple(side.reshape(-1, *(1,) * ones.ndim) * ones for side in np.eye(len(moving), dtype=ones.dtype))
        # The values are computed once for all sides.
        return jax.vmap(lambda *side: jax.jvp(of_moving, points, side), out_axes=(None, 0))(*sides)

    function = jax.custom_jvp(jax.jit(plain))
    sloped = jax.jit(by_argument, static_argnums=0)

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        active = tuple(not isinstance(tangent, jax.custom_derivatives.SymbolicZero) for tangent in tangents)
        if not any(active):
            return function(*primals), tree_map(_no_change, function(*primals))
        value, slopes = sloped(active, *primals)
        moving = [tangent for tangent, moves in zip(tangents, active, strict=True) if moves]

        def change(leaf: Any, by: Any) -> Any:
            if not jax.numpy.issubdtype(leaf.dtype, np.inexact):
                return _no_change(leaf)
            return sum((by[k] * tangent for k, tangent in enumerate(moving[1:], 1)), by[0] * moving[0])

        return value, tree_map(change, value, slopes)

    function.defjvp(rule, symbolic_zeros=True)
    return function


def _no_change(leaf: Any) -> Any:
    """The tangent of what is constant or no real number."""
    import jax

    if jax.numpy.issubdtype(leaf.dtype, np.inexact):
        return jax.numpy.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)


@cache
def compile_strips(kernel: Callable[..., Any], static: tuple[Any, ...] = ()) -> Callable[..., Any]:
    """An elementwise kernel compiled for `map_blocks`; columns of one value stay single numbers."""
    import jax

    def strips(*columns: Any) -> Any:
        size = max(column.size for column in columns)
        if size <= STRIP:
            return kernel(*(column if column.size > 1 else column[0] for column in columns), *static)
        long = tuple(column.reshape(-1, STRIP) for column in columns if column.size > 1)

        def strip(parts: tuple[Any, ...]) -> Any:
            rest = iter(parts)
            return kernel(*(next(rest) if column.size > 1 else column[0] for column in columns), *static)

        return tree_map(lambda leaf: leaf.reshape(-1), jax.lax.map(strip, long))

    return jax.jit(strips, compiler_options=WIDE)


def map_blocks(function: Callable[..., Any], columns: list[np.ndarray], block: int, threads: int | None = None) -> Any:
    """Apply a compiled elementwise function to equally long columns, block by block on every processor.

    One array of a million points is 2.5 times slower for the ridge (benchmarks/bench_xla.py):
    what the function holds meanwhile leaves the cache.
    Columns of one value are handed over as they are.
    """
    return _map_pieces(function, columns, _padded_size(_length(columns), block, _LEAST), threads)


@cache
def _compile_pointwise(kernel: Callable[..., Any], static: tuple[Any, ...]) -> Callable[..., Any]:
    import jax

    return jax.jit(jax.vmap(lambda *point: kernel(*point, *static)))


def _padded_size(count: int, chunk: int, least: int) -> int:
    """Round up to a power of two, so that batches of many sizes share a few compilations."""
    return min(chunk, 1 << max(count - 1, least - 1, 0).bit_length())


def _length(columns: list[np.ndarray]) -> int:
    return np.broadcast_shapes(*(column.shape for column in columns))[0]


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
) -> Any:
    """Apply a one-point kernel to every row of equally long columns, in float64; NumPy leaves come back.

    Pieces hold ``chunk`` points and run on as many threads as there are processors.
    """
    return _map_pieces(_compile_pointwise(kernel, static), columns, _padded_size(columns[0].size, chunk, 1))


def _map_pieces(function: Callable[..., Any], columns: list[np.ndarray], size: int, threads: int | None = None) -> Any:
    count = _length(columns)
    flagged = [(column, column.size == 1 < count) for column in columns]

    def run(start: int) -> Any:
        with compute_concretely():
            parts = (column if shared else _piece(column, start, size) for column, shared in flagged)
            return tree_map(np.asarray, function(*parts))

    first = run(0)
    # A copy, because JAX's own memory is read-only.
    whole = tree_map(lambda leaf: np.empty((count, *leaf.shape[1:]), leaf.dtype), first)

    def store(start: int, result: Any) -> None:
        stop = min(start + size, count)
        tree_map(lambda to, leaf: np.copyto(to[start:stop], leaf[: stop - start]), whole, result)

    store(0, first)
    if count > size:
        # The first piece has compiled the function; JAX lets go of the interpreter while it computes.
        with ThreadPoolExecutor(threads or processors()) as pool:
            list(pool.map(lambda start: store(start, run(start)), range(size, count, size)))
    return whole


def processors() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS
        return os.cpu_count() or 1


def pointwise(
    kernel: Callable[..., Any],
    names: tuple[str, ...],
    values: tuple[ArrayLike, ...],
    static: tuple[Any, ...] = (),
    chunk: int = CHUNK,
) -> Any:
    """Broadcast ``values``, apply the one-point JAX ``kernel`` to each point, and restore the common shape."""
    if is_traced(*values):
        return _map_traced(kernel, values, static)
    arrays = broadcast(names, values)
    shape = arrays[0].shape
    flat = map_flat(kernel, [array.ravel() for array in arrays], static, chunk)
    return to_caller(tree_map(lambda leaf: leaf.reshape(shape + leaf.shape[1:]), flat), values)


def _map_traced(kernel: Callable[..., Any], values: tuple[ArrayLike, ...], static: tuple[Any, ...]) -> Any:
    import jax

    arrays = traced_columns(values)
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
