"""Evaluation of kernels on arrays.

A kernel is a formula for one point, applied elementwise, with the same source code for NumPy and JAX. Plain numbers and
few concrete points are evaluated by NumPy in float64, regardless of JAX's configuration and without importing JAX. For
many points JAX compiles the kernel and evaluates it in blocks of one size. Inside a transformation of the caller, as
`jit` or `grad`, the compiled kernel uses the ambient precision.
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

from zwidth.arrays.blocks import count_points, map_blocks
from zwidth.words.errors import InputError, PrecisionWarning
from zwidth.words.quantities import SIZES
from zwidth.words.types import ArrayLike
from zwidth.words.xp import WIDE, compute_concretely, filter_options, is_jax, is_traced, materialize, tree_map

# Types whose conversion needs no check; bool and 0-d arrays are checked.
_PLAIN = frozenset({float, int, np.float64})
_NUMBERS = (int, float, np.floating, np.integer)


def are_numbers(*values: ArrayLike) -> bool:
    """Return whether all values are plain numbers, whose conversion needs no check."""
    return _PLAIN.issuperset(map(type, values))


def check_scalars(arguments: Mapping[str, ArrayLike]) -> None:
    """Raise `InputError` for a plain number out of the range of its name; NaN, negatives and arrays get a status."""
    for name, value in arguments.items():
        if name not in SIZES or not isinstance(value, _NUMBERS):
            continue
        # Infinite and negative values have a status instead of an error.
        least, most = SIZES[name]
        # Convert to float64, because the limits would overflow in float32.
        number = value.item() if isinstance(value, np.generic) else value
        size = abs(number) if least else number
        if 0 < size < least or most < size < math.inf:
            allowed = f"0 or {least:g} to {most:g} in magnitude" if least else f"0 to {most:g}"
            raise InputError(f"{name}: got {number!r}; it must be {allowed}")


def as_float64(name: str, value: ArrayLike) -> np.ndarray:
    """Convert one concrete argument to float64; raise `InputError` if it is not numeric."""
    # Masked arrays exist only if their module is loaded.
    if isinstance(value, getattr(sys.modules.get("numpy.ma"), "MaskedArray", ())):
        raise InputError(f"{name}: got a masked array, whose mask would be lost; fill it, with NaN say, first")
    # Broadcasting by position would combine axes of different names.
    if getattr(value, "dims", ()):
        raise InputError(
            f"{name}: got a DataArray, whose names of axes would be lost; call through xarray.apply_ufunc, or give its "
            "values"
        )
    if is_traced(value):
        raise InputError(f"{name}: got a value that JAX traces; give numbers, outside of jit, vmap and grad")
    try:
        # Convert integers first, because NumPy makes objects of large ones.
        array = np.asarray(float(value) if isinstance(value, int) else value)
        # Types such as bfloat16 have the kind V of NumPy, but not the type void.
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
    """Convert concrete arguments to float64 arrays of one common shape."""
    arrays = {name: as_float64(name, value) for name, value in arguments.items()}
    join_shapes((name, array.shape) for name, array in arrays.items())
    return list(np.broadcast_arrays(*arrays.values()))


def join_shapes(named: Iterable[tuple[str, tuple[int, ...]]], what: str = "shapes") -> tuple[int, ...]:
    """Return the shape that all shapes broadcast to; raise `InputError` if they do not broadcast."""
    named = list(named)
    try:
        return np.broadcast_shapes(*(shape for _, shape in named))
    except ValueError:
        shapes = ", ".join(f"{name} {shape}" for name, shape in named)
        raise InputError(f"{what} do not broadcast: {shapes}; make each axis equal or 1") from None


def to_caller(result: Any, values: Iterable[ArrayLike]) -> Any:
    """Convert results to JAX arrays if an argument is a JAX array, otherwise to NumPy arrays or scalars."""
    if any(map(is_jax, values)):
        import jax.numpy as jnp

        # Convert in float64, because JAX's default precision would lose half of the digits.
        with compute_concretely():
            return tree_map(jnp.asarray, result)
    return tree_map(lambda leaf: np.asarray(leaf)[()], result)


def broadcast_traced(arguments: Mapping[str, ArrayLike]) -> list[Any]:
    """Convert the arguments of a traced call to arrays of one shape in JAX's default float type.

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
    """Convert one argument to ``dtype``, with NumPy unless it is a JAX array."""
    if not is_jax(value):
        with np.errstate(over="ignore"):
            return as_float64(name, value).astype(dtype, copy=False)
    if value.dtype.kind == "c":
        raise InputError(f"{name}: got complex numbers; real numbers are needed")
    # Convert only if the type differs, because outside jit JAX compiles a program for each operation.
    return value if value.dtype == dtype else value.astype(dtype)


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


# "auto": NumPy for few points; "numpy": NumPy for all points; "jax": always compiled, if the kernel has no NumPy code
# or values must not depend on the number of points (both routes may differ in the last place).
Route: TypeAlias = Literal["auto", "numpy", "jax"]

# Function that returns the values of a kernel at concrete points, and their derivatives in each argument.
Slopes: TypeAlias = Callable[..., tuple[Any, Sequence[Any]]]

# Number of points up to which NumPy, with some tenths of a second, is faster than a compiler, which takes seconds. A
# compiler pays off at ten times as many points; later calls of NumPy take two to five times as long as compiled ones.
FEW = 1 << 18
_AT_ONCE = 1 << 15  # points per NumPy call, so that arrays stay in caches
BLOCK = 1 << 16  # points per compiled call: one compilation, bounded memory, work for every processor


def evaluate(
    kernel: Callable[..., Any],
    arguments: Mapping[str, ArrayLike],
    *static: Any,
    weight: int = 1,
    route: Route = "auto",
    slopes: Slopes | None = None,
) -> Any:
    """Apply a kernel to arguments that broadcast.

    Args:
        kernel: function of arrays and ``static``.
        arguments: arguments by name; plain numbers out of the range of their name are an `InputError`.
        *static: further arguments of the kernel, constants of the compilation.
        weight: time and memory of a point relative to a simple kernel; larger for kernels that sample each point.
        route: evaluation by NumPy or JAX.
        slopes: derivatives of the kernel in NumPy, so that gradients of few points need no compilation.

    Returns:
        The results, with the broadcast shape and the array type of the arguments.
    """
    values = tuple(arguments.values())
    check_scalars(arguments)
    if route != "jax" and are_numbers(*values):
        try:
            numbers = list(map(np.float64, values))
        except OverflowError:
            pass  # `broadcast` names the integer that overflows
        else:
            with np.errstate(all="ignore"):
                found = kernel(*numbers, *static)
            return found if isinstance(found, np.generic) else tree_map(_plain, found)
    if is_traced(*values):
        return compile_traced(kernel, static, slopes)(*broadcast_traced(arguments))
    arrays = broadcast(arguments)
    shape = arrays[0].shape
    flat = evaluate_columns(kernel, [array.reshape(-1) for array in arrays], *static, weight=weight, route=route)
    return to_caller(tree_map(lambda leaf: leaf.reshape(shape), flat), values)


def evaluate_columns(
    kernel: Callable[..., Any], columns: Sequence[np.ndarray], *static: Any, weight: int = 1, route: Route = "auto"
) -> Any:
    """Evaluate a kernel on concrete columns of one length; pass a column of length 1 as a number."""
    count = count_points(columns)
    if route == "jax" or (route == "auto" and count > max(1, FEW // weight)):
        return map_blocks(compile_columns(kernel, static), columns, BLOCK // weight)

    def at_once(*parts: np.ndarray) -> Any:
        with np.errstate(all="ignore"):
            result = kernel(*(part[0] if part.size == 1 else part for part in parts), *static)
        # Copy, because views of an argument or of a single value are read-only. Add the axis of a single point.
        shape = (count_points(parts),)
        if shape == (1,):
            return tree_map(lambda leaf: np.array(leaf)[None], result)
        return tree_map(lambda leaf: leaf if np.ndim(leaf) > 1 else np.array(np.broadcast_to(leaf, shape)), result)

    size = max(1, _AT_ONCE // weight)
    return at_once(*columns) if count <= size else map_blocks(at_once, columns, size, within=nullcontext)


def _plain(leaf: Any) -> Any:
    """Return the result at a single point as a NumPy scalar."""
    return leaf if isinstance(leaf, np.generic) else np.asarray(leaf)[()]


@cache
def compile_traced(
    kernel: Callable[..., Any], static: tuple[Any, ...], slopes: Slopes | None = None
) -> Callable[..., Any]:
    """Return a kernel compiled for traced values, whose derivative is one product per argument."""
    # A point depends on itself alone: all there is to differentiate is a few numbers a point. Left to itself,
    # `jax.grad` outside `jit` would compile a program that hands out every intermediate result: for the ridge 1.2 to
    # 1.5 times as long (benchmarks/bench_xla.py). There the values are concrete: where ``slopes`` are known, nothing is
    # compiled.
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
        sides = tuple(
            side.reshape(-1, *(1,) * ones.ndim) * ones[None] for side in np.eye(len(moving), dtype=ones.dtype)
        )
        # The values are computed once for all sides, and a side once for all that is made of it.
        value, slopes = jax.vmap(lambda *side: jax.jvp(of_moving, points, side), out_axes=(None, 0))(*sides)
        return value, tree_map(
            lambda leaf: leaf if leaf.dtype == jax.dtypes.float0 else materialize(leaf, leaf), slopes
        )

    function = jax.custom_jvp(jax.jit(plain))

    @cache
    def sloped(active: tuple[bool, ...]) -> Callable[..., Any]:
        """`by_argument`, compiled."""
        # Of a compiled function `jax.grad` parts every equation into what is linear in the tangents and what is not;
        # one with a rule of its own it takes as a whole, in half of the time.
        compiled = jax.jit(partial(by_argument, active))
        whole = jax.custom_jvp(compiled)
        whole.defjvp(lambda primals, tangents: jax.jvp(compiled, primals, tangents))
        return whole

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        active = tuple(not isinstance(tangent, jax.custom_derivatives.SymbolicZero) for tangent in tangents)
        if not any(active):
            return function(*primals), tree_map(_no_change, function(*primals))
        if slopes is None or is_traced(*primals) or np.size(primals[0]) > FEW:
            value, sides = sloped(active)(*primals)
        else:
            with np.errstate(all="ignore"):
                value, sides = slopes(*(np.asarray(primal, np.float64) for primal in primals), *static)
            value, *sides = (
                tree_map(partial(_as_precise, argument=primals[0]), leaves)
                for leaves in (value, *(by for by, moves in zip(sides, active, strict=True) if moves))
            )
            sides = tree_map(lambda *leaves: leaves, *sides)
        moving = [tangent for tangent, moves in zip(tangents, active, strict=True) if moves]

        def change(leaf: Any, by: Any) -> Any:
            if not jax.numpy.issubdtype(leaf.dtype, np.inexact):
                return _no_change(leaf)
            # Not jax.numpy's product, which compiles a program for what of it does not move: nothing.
            parts = [jax.lax.mul(by[k], tangent) for k, tangent in enumerate(moving)]
            return sum(parts[1:], parts[0])

        return value, tree_map(change, value, sides)

    function.defjvp(rule, symbolic_zeros=True)
    return function


def _as_precise(leaf: Any, argument: Any) -> Any:
    """A result of NumPy for JAX: real numbers are as precise as the argument."""
    import jax

    # Converted by NumPy: by JAX it would be a program to compile.
    kind = argument.dtype if np.issubdtype(leaf.dtype, np.inexact) else leaf.dtype
    return jax.numpy.asarray(np.asarray(leaf, kind))


def _no_change(leaf: Any) -> Any:
    """The tangent of what is constant or no real number."""
    import jax

    if jax.numpy.issubdtype(leaf.dtype, np.inexact):
        return jax.numpy.zeros_like(leaf)
    return np.zeros(leaf.shape, jax.dtypes.float0)


@cache
def compile_columns(kernel: Callable[..., Any], static: tuple[Any, ...]) -> Callable[..., Any]:
    """Return a kernel, compiled for blocks of columns."""
    import jax

    def whole(*columns: Any) -> Any:
        count = count_points(columns)
        return kernel(*(column[0] if column.size == 1 < count else column for column in columns), *static)

    return jax.jit(whole, compiler_options=filter_options(WIDE))
