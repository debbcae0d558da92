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
from contextlib import nullcontext
from functools import cache, partial
from typing import Any, Literal, TypeAlias

import numpy as np

from zwidth.core.errors import InputError, PrecisionWarning
from zwidth.core.types import ArrayLike
from zwidth.core.xp import WIDE, compute_concretely, filter_options, is_jax, is_traced, materialize, tree_map
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


def broadcast_traced(arguments: Mapping[str, ArrayLike]) -> list[Any]:
    """Convert arguments, some of them traced by JAX, to arrays of a common shape in JAX's default float type.

    Arguments that are not traced may have the same types as in a direct call, and are checked in the same way.
    """
    import jax.numpy as jnp

    dtype = jnp.result_type(float)
    if dtype == np.float32:
        _warn_of_float32()
    arrays = [_as_ambient(name, value, dtype) for name, value in arguments.items()]
    shape = join_shapes((name, np.shape(array)) for name, array in zip(arguments, arrays, strict=True))
    return [array if np.shape(array) == shape else jnp.broadcast_to(array, shape) for array in arrays]


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
    if is_traced(*values):
        return compile_traced(kernel, static)(*broadcast_traced(arguments))
    arrays = broadcast(arguments)
    shape = arrays[0].shape
    flat = evaluate_columns(kernel, [array.reshape(-1) for array in arrays], *static, weight=weight, route=route)
    return to_caller(tree_map(lambda leaf: leaf.reshape(shape), flat), values)


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


@cache
def compile_traced(kernel: Callable[..., Any], static: tuple[Any, ...]) -> Callable[..., Any]:
    """Return a kernel compiled for traced values, with a rule that computes its derivatives elementwise.

    Args:
        kernel: function of arrays and ``static``.
        static: further arguments of the kernel, which are constants at compilation.
    """
    # Define the derivatives by a rule, because the result at a point depends only on the arguments at this point: its
    # tangent is a sum of one product per argument. Without the rule, `jax.grad` outside `jit` would compile a program
    # that returns every intermediate result, which takes 1.2 to 1.5 times as long for the ridge
    # (benchmarks/bench_xla.py).
    import jax

    def plain(*arrays: Any) -> Any:
        return kernel(*arrays, *static)

    def by_argument(active: tuple[bool, ...], *arrays: Any) -> tuple[Any, Any]:
        """Return the kernel's values, and their derivatives in the ``active`` arguments along a new first axis."""
        moving = [k for k, moves in enumerate(active) if moves]

        def of_moving(*values: Any) -> Any:
            varied = dict(zip(moving, values, strict=True))
            return plain(*(varied.get(k, array) for k, array in enumerate(arrays)))

        points = tuple(arrays[k] for k in moving)
        ones = jax.numpy.ones_like(points[0])
        if len(moving) == 1:
            value, slopes = jax.jvp(of_moving, points, (ones,))
            return value, tree_map(lambda leaf: leaf[None], slopes)
        sides = tuple(
            side.reshape(-1, *(1,) * ones.ndim) * ones[None] for side in np.eye(len(moving), dtype=ones.dtype)
        )
        # Compute the values once, not once per argument, and make XLA store the derivatives, because several products
        # use them.
        value, slopes = jax.vmap(lambda *side: jax.jvp(of_moving, points, side), out_axes=(None, 0))(*sides)
        return value, tree_map(
            lambda leaf: leaf if leaf.dtype == jax.dtypes.float0 else materialize(leaf, leaf), slopes
        )

    function = jax.custom_jvp(jax.jit(plain))

    @cache
    def sloped(active: tuple[bool, ...]) -> Callable[..., Any]:
        """Return a compiled function for the kernel's values and their derivatives in the ``active`` arguments."""
        # Define a derivative rule for the compiled function as well. Without it, `jax.grad` would separate the terms
        # that are linear in the tangents in each equation of the function, which takes twice as long.
        compiled = jax.jit(partial(by_argument, active))
        whole = jax.custom_jvp(compiled)
        whole.defjvp(lambda primals, tangents: jax.jvp(compiled, primals, tangents))
        return whole

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        active = tuple(not isinstance(tangent, jax.custom_derivatives.SymbolicZero) for tangent in tangents)
        if not any(active):
            return function(*primals), tree_map(_no_change, function(*primals))
        value, sides = sloped(active)(*primals)
        moving = [tangent for tangent, moves in zip(tangents, active, strict=True) if moves]

        def change(leaf: Any, by: Any) -> Any:
            if not jax.numpy.issubdtype(leaf.dtype, np.inexact):
                return _no_change(leaf)
            # Multiply by `jax.lax.mul`, because the product of `jax.numpy` compiles a program even if an argument is
            # constant.
            parts = [jax.lax.mul(by[k], tangent) for k, tangent in enumerate(moving)]
            return sum(parts[1:], parts[0])

        return value, tree_map(change, value, sides)

    function.defjvp(rule, symbolic_zeros=True)
    return function


def _no_change(leaf: Any) -> Any:
    """Return a zero tangent of the right type, for a constant result or one whose type has no derivative."""
    import jax

    if jax.numpy.issubdtype(leaf.dtype, np.inexact):
        return jax.numpy.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)


@cache
def compile_columns(kernel: Callable[..., Any], static: tuple[Any, ...]) -> Callable[..., Any]:
    """Return a function of columns that evaluates the kernel in code compiled by JAX."""
    import jax

    def whole(*columns: Any) -> Any:
        count = count_points(columns)
        return kernel(*(column[0] if column.size == 1 < count else column for column in columns), *static)

    return jax.jit(whole, compiler_options=filter_options(WIDE))
