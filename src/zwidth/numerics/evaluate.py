"""Evaluation of kernels on arrays, by NumPy or by code that JAX compiles.

A *kernel* is a function that applies a formula to each point of its arguments, with the same source code for NumPy and
JAX. NumPy evaluates plain numbers and few points in float64, regardless of the configuration of JAX and without
importing it. For many points JAX compiles the kernel and evaluates it in blocks of equal size. Inside a transformation
of the caller, such as `jit` or `grad`, values are *traced*, and the compiled kernel uses the default precision of JAX.
A *column* is a one-dimensional array that holds one argument at all points. A *tree* is an array or a named tuple of
arrays, its leaves.
"""

from __future__ import annotations

import math
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache, lru_cache
from typing import Any, Literal, TypeAlias

import numpy as np

from zwidth.core.errors import InputError, PrecisionWarning
from zwidth.core.types import ArrayLike
from zwidth.core.xp import WIDE, compile_with_options, compute_concretely, is_jax, is_traced, tree_map
from zwidth.numerics.blocks import count_points, map_blocks
from zwidth.units.quantities import SIZES

# Types of plain numbers, which are converted to float64 without a check; Booleans and 0-d arrays are checked first.
_PLAIN = frozenset({float, int, np.float64})
_NUMBERS = (int, float, np.floating, np.integer)


def are_numbers(*values: ArrayLike) -> bool:
    """Return whether all values are plain numbers, which can be converted to float64 without a check."""
    return _PLAIN.issuperset(map(type, values))


def check_scalars(arguments: Mapping[str, ArrayLike]) -> None:
    """Raise `InputError` if the magnitude of a plain number is outside the range of its parameter (`SIZES`).

    Other invalid numbers and arrays pass, because results report them by a status.
    """
    for name, value in arguments.items():
        if name not in SIZES or not isinstance(value, _NUMBERS):
            continue
        # Infinite values, and negative ones of quantities that must not be negative, pass without an error, because
        # results report them by a status.
        least, most = SIZES[name]
        # Convert NumPy numbers to Python numbers, because the limits would overflow in float32.
        number = value.item() if isinstance(value, np.generic) else value
        size = abs(number) if least else number
        if 0 < size < least or most < size < math.inf:
            allowed = f"0 or {least:g} to {most:g} in magnitude" if least else f"0 to {most:g}"
            raise InputError(f"{name}: got {number!r}; it must be {allowed}")


def as_float64(name: str, value: ArrayLike) -> np.ndarray:
    """Convert one argument to a float64 array; raise `InputError` if it is traced or not numeric."""
    # Reject masked arrays. Look up their module without importing it: without the module no masked array can exist.
    if isinstance(value, getattr(sys.modules.get("numpy.ma"), "MaskedArray", ())):
        raise InputError(f"{name}: got a masked array, whose mask would be lost; fill it, with NaN say, first")
    # Reject arrays of xarray, because broadcasting by position may combine axes with different names.
    if getattr(value, "dims", ()):
        raise InputError(
            f"{name}: got a DataArray, whose names of axes would be lost; call through xarray.apply_ufunc, or give its "
            "values"
        )
    if is_traced(value):
        raise InputError(f"{name}: got a value that JAX traces; give numbers, outside of jit, vmap and grad")
    try:
        # Convert Python integers to float first, because NumPy converts large ones to arrays of objects.
        array = np.asarray(float(value) if isinstance(value, int) else value)
        # Reject the type void by its class and not by its kind "V", because number types such as bfloat16 also have
        # kind "V".
        if array.dtype.kind in "OSUcmM" or array.dtype.type is np.void:
            raise TypeError(array.dtype)
        return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(value, list | tuple) and is_traced(*value):
            raise InputError(
                f"{name}: got a list of values that JAX traces; combine them with jax.numpy.stack"
            ) from None
        raise InputError(
            f"{name}: got {value!r}, a real number or a rectangular array of real numbers is needed"
        ) from error


def as_number(name: str, value: Any, least: float = -math.inf) -> float:
    """Convert one argument to a single finite number; raise `InputError` if it is not one or below ``least``."""
    number = as_float64(name, value)
    if number.ndim or not (np.isfinite(number) and number >= least):
        raise InputError(
            f"{name}: got {value!r}; a single finite number{'' if least < 0 else f' of at least {least:g}'} is needed"
        )
    return float(number)


def broadcast(arguments: Mapping[str, ArrayLike]) -> list[np.ndarray]:
    """Convert arguments that are not traced to float64 arrays, broadcast to a common shape."""
    arrays = {name: as_float64(name, value) for name, value in arguments.items()}
    join_shapes((name, array.shape) for name, array in arrays.items())
    return list(np.broadcast_arrays(*arrays.values()))


def join_shapes(named: Iterable[tuple[str, tuple[int, ...]]], noun: str = "shapes") -> tuple[int, ...]:
    """Return the common shape to which named shapes broadcast; raise `InputError` if they do not broadcast."""
    named = list(named)
    try:
        return np.broadcast_shapes(*(shape for _, shape in named))
    except ValueError:
        shapes = ", ".join(f"{name} {shape}" for name, shape in named)
        raise InputError(f"{noun} do not broadcast: {shapes}; make each axis equal or 1") from None


def to_caller(result: Any, values: Iterable[ArrayLike]) -> Any:
    """Convert results to JAX arrays if one of the arguments ``values`` is a JAX array, otherwise to NumPy arrays."""
    if any(map(is_jax, values)):
        import jax.numpy as jnp

        # Keep float64 in the conversion, because the default precision of JAX, float32, has half of the digits.
        with compute_concretely():
            return tree_map(jnp.asarray, result)
    return tree_map(lambda leaf: np.asarray(leaf)[()], result)


def convert_for_jax(arguments: Mapping[str, ArrayLike]) -> list[Any]:
    """Convert arguments, some of them JAX arrays, to arrays of JAX's default float type, and check their shapes.

    The other arguments may have the same types as in calls without JAX arrays, and they are checked in the same way.
    """
    import jax.numpy as jnp

    dtype = jnp.result_type(float)
    if dtype == np.float32:
        _warn_of_float32()
    arrays = [_as_ambient(name, value, dtype) for name, value in arguments.items()]
    join_shapes((name, np.shape(array)) for name, array in zip(arguments, arrays, strict=True))
    return arrays


def broadcast_traced(arguments: Mapping[str, ArrayLike]) -> list[Any]:
    """Convert arguments, some of them traced by JAX, to arrays of a common shape in JAX's default float type."""
    import jax.numpy as jnp

    return jnp.broadcast_arrays(*convert_for_jax(arguments))


def precision(values: Iterable[ArrayLike]) -> AbstractContextManager[Any]:
    """Return a context in which JAX computes in float64; if JAX traces one of the values, the context has no effect."""
    import jax

    if is_traced(*values):
        return nullcontext()
    # Inside `jit`, JAX traces all operations, even on values that are not traced. Changing the float type is not
    # allowed for traced operations, so compute these values outside the trace (`compute_concretely`).
    return compute_concretely() if is_traced(jax.numpy.asarray(0.0)) else jax.enable_x64(True)


def _as_ambient(name: str, value: ArrayLike, dtype: Any) -> Any:
    """Convert one argument to the number type ``dtype``, and return a NumPy array unless ``value`` is a JAX array."""
    if not is_jax(value):
        with np.errstate(over="ignore"):
            return as_float64(name, value).astype(dtype, copy=False)
    if value.dtype.kind == "c":
        raise InputError(f"{name}: got complex numbers; real numbers are needed")
    # Convert only if the type differs, because outside jit JAX compiles a separate program for each operation. Convert
    # the weak type of a Python number as well, because JAX compiles a kernel again for each combination of weak types.
    return value if value.dtype == dtype and not value.weak_type else value.astype(dtype)


_warned = threading.Event()


def _warn_of_float32() -> None:
    """Warn once per process that results have float32 precision, at which optimizers stop early without a message."""
    if not _warned.is_set():
        _warned.set()
        warnings.warn(
            "computing in float32 inside a JAX transformation; call jax.config.update('jax_enable_x64', True) first "
            "for float64",
            PrecisionWarning,
            stacklevel=_stack_level(),
        )


def _stack_level() -> int:
    """Return the stack level of the first caller outside zwidth and JAX, so that the warning shows the user's line."""
    frame, level = sys._getframe(1), 1
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in ("zwidth", "jax"):
        frame, level = frame.f_back, level + 1
    return level


# Method of evaluation. "auto": NumPy for few points, JAX for many; "numpy": NumPy for all points; "jax": always
# compiled by JAX, for kernels without NumPy code and for results that must not depend on the number of points, because
# NumPy and JAX may differ in the last digit.
Route: TypeAlias = Literal["auto", "numpy", "jax"]

# Largest number of points that NumPy evaluates. NumPy takes some tenths of a second for so many points, a compilation
# takes seconds. With ten times as many points a compilation saves time, because compiled calls are two to five times as
# fast.
FEW = 1 << 18
_AT_ONCE = 1 << 15  # points per NumPy call, so that arrays stay in caches
BLOCK = 1 << 16  # points per compiled call: one compilation, bounded memory, work for every processor


def evaluate(
    kernel: Callable[..., Any],
    arguments: Mapping[str, ArrayLike],
    *static: Any,
    weight: int = 1,
    route: Route = "auto",
) -> Any:
    """Evaluate a kernel for arguments that broadcast, by NumPy or JAX.

    Args:
        kernel: function of arrays and ``static``.
        arguments: arguments by name; raises `InputError` for plain numbers out of the range of their name.
        *static: further arguments of the kernel, which are constants at compilation.
        weight: time and memory of a point relative to a simple kernel; larger for kernels that sample each point.
        route: evaluation by NumPy or JAX.

    Returns:
        The results, with the broadcast shape and the array type of the arguments.
    """
    values = tuple(arguments.values())
    check_scalars(arguments)
    if route != "jax" and are_numbers(*values):
        try:
            numbers = list(map(np.float64, values))
        except OverflowError:
            pass  # ignore an integer that overflows; `broadcast` reports it by name
        else:
            with np.errstate(all="ignore"):
                result = kernel(*numbers, *static)
            return result if isinstance(result, np.generic) else tree_map(_plain, result)
    if any(map(is_jax, values)):
        with precision(values):
            return compile_kernel(kernel, static, weight)(*convert_for_jax(arguments))
    arrays = broadcast(arguments)
    shape = arrays[0].shape
    flat = evaluate_columns(kernel, [array.reshape(-1) for array in arrays], *static, weight=weight, route=route)
    return tree_map(lambda leaf: np.asarray(leaf.reshape(shape))[()], flat)


def evaluate_columns(
    kernel: Callable[..., Any], columns: Sequence[np.ndarray], *static: Any, weight: int = 1, route: Route = "auto"
) -> Any:
    """Evaluate a kernel at points given by columns; the kernel receives a column of length 1 as a number.

    The arguments are those of `evaluate`, except that ``columns`` holds one array per argument of the kernel.
    """
    count = count_points(columns)
    if route == "jax" or (route == "auto" and count > max(1, FEW // weight)):
        return map_blocks(compile_columns(kernel, static), columns, BLOCK // weight)

    def at_once(*parts: np.ndarray) -> Any:
        with np.errstate(all="ignore"):
            result = kernel(*(part[0] if part.size == 1 else part for part in parts), *static)
        # Copy the results, because a result that is a view of an argument or of a broadcast value may be read-only. If
        # there is only one point, add the missing axis of the points.
        shape = (count_points(parts),)
        if shape == (1,):
            return tree_map(lambda leaf: np.array(leaf)[None], result)
        return tree_map(lambda leaf: leaf if np.ndim(leaf) > 1 else np.array(np.broadcast_to(leaf, shape)), result)

    size = max(1, _AT_ONCE // weight)
    return at_once(*columns) if count <= size else map_blocks(at_once, columns, size, within=nullcontext)


def _plain(leaf: Any) -> Any:
    """Convert one leaf of the result at a single point, a zero-dimensional array, to a NumPy scalar."""
    return leaf if isinstance(leaf, np.generic) else np.asarray(leaf)[()]


# Largest number of compiled kernels that each cache of compiled functions keeps.
CACHED_KERNELS = 256


@lru_cache(CACHED_KERNELS)
def compile_kernel(kernel: Callable[..., Any], static: tuple[Any, ...], weight: int = 1) -> Callable[..., Any]:
    """Return a kernel, compiled by JAX, as a function of arrays that broadcast; JAX can differentiate it to any order.

    Args:
        kernel: function of arrays of one shape and ``static``.
        static: further arguments of the kernel, which are constants at compilation.
        weight: memory that a point needs, relative to a simple kernel.
    """
    import jax

    function = differentiate_elementwise(lambda *arrays: kernel(*arrays, *static))

    @jax.jit
    def whole(*arrays: Any) -> Any:
        return _map_in_blocks(function, jax.numpy.broadcast_arrays(*arrays), BLOCK // weight)

    return whole


def differentiate_elementwise(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel as a JAX function whose derivatives, of any order, are computed elementwise.

    The result at a point depends only on the arguments at this point. Its directional derivative is therefore a sum
    with one term per argument: partial derivative times change of the argument. For gradients, JAX stores only these
    partial derivatives instead of all intermediate results.
    """
    import jax

    function = jax.custom_jvp(kernel)

    @cache
    def add_partials(moving: tuple[int, ...]) -> Callable[..., Any]:
        """Return a function that computes the results of the kernel, and their partial derivatives in some arguments.

        ``moving`` are the indices of these arguments, whose tangents (changes) in JAX are not known to be 0.
        """

        def compute(*arrays: Any) -> tuple[Any, list[list[Any]]]:
            value, partials = None, []
            for k in moving:
                one = jax.numpy.ones_like(arrays[k])
                value, change = jax.jvp(lambda x, k=k: kernel(*arrays[:k], x, *arrays[k + 1 :]), (arrays[k],), (one,))
                partials.append([leaf for leaf in jax.tree.leaves(change) if leaf.dtype != jax.dtypes.float0])
            return value, partials

        return differentiate_elementwise(compute)

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        moving = tuple(k for k, t in enumerate(tangents) if not isinstance(t, jax.custom_derivatives.SymbolicZero))
        value, partials = add_partials(moving)(*primals)
        real = iter(zip(*partials, strict=True))

        def change(leaf: Any) -> Any:
            if not jax.numpy.issubdtype(leaf.dtype, np.inexact):
                return np.zeros(leaf.shape, jax.dtypes.float0)
            return sum(partial * tangents[k] for k, partial in zip(moving, next(real), strict=True))

        return value, jax.tree.map(change, value)

    function.defjvp(rule, symbolic_zeros=True)
    return function


def _map_in_blocks(function: Callable[..., Any], arrays: Sequence[Any], block: int) -> Any:
    """Apply a function to arrays that JAX traces; on a CPU, to blocks of ``block`` points, one after another."""
    import jax
    import jax.numpy as jnp

    shape, size = arrays[0].shape, arrays[0].size
    # Use blocks on a CPU, because the intermediate results of a block fit in the cache: with 2^16 points per block, a
    # million stability tests take 40 % of the time without blocks, and a million maxima of the stiffness take 50 %.
    if size <= block or not computes_on_one_cpu():
        return function(*arrays)
    count = -(-size // block)
    columns = [jnp.pad(a.reshape(-1), (0, count * block - size), mode="edge").reshape(count, block) for a in arrays]
    results = jax.lax.map(lambda parts: function(*parts), columns)
    return jax.tree.map(lambda leaf: leaf.reshape(-1)[:size].reshape(shape), results)


def computes_on_one_cpu() -> bool:
    """Return whether JAX uses a single CPU device only, so that no array is stored in parts on several devices."""
    import jax

    return jax.default_backend() == "cpu" and jax.device_count() == 1


@lru_cache(CACHED_KERNELS)
def compile_columns(kernel: Callable[..., Any], static: tuple[Any, ...]) -> Callable[..., Any]:
    """Return a function of columns that evaluates the kernel in code compiled by JAX."""

    def whole(*columns: Any) -> Any:
        count = count_points(columns)
        return kernel(*(column[0] if column.size == 1 < count else column for column in columns), *static)

    return compile_with_options(whole, WIDE)
