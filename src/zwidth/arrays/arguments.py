"""What a caller passes and gets back: numbers, lists, NumPy arrays, JAX arrays or traced values."""

from __future__ import annotations

import math
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from zwidth.arrays.xp import is_jax, is_traced, tree_map
from zwidth.words.errors import InputError, PrecisionWarning
from zwidth.words.quantities import SIZES
from zwidth.words.types import ArrayLike

# The types whose conversion needs no check; bool and 0-d arrays take the long way.
_PLAIN = frozenset({float, int, np.float64})
_NUMBERS = (int, float, np.floating, np.integer)


@contextmanager
def compute_concretely() -> Iterator[None]:
    """Compute in float64 and at once, though the caller may be inside a JAX transformation that traces other values.

    The settings belong to the thread and end with the block.
    """
    import jax

    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        yield


def are_numbers(*values: ArrayLike) -> bool:
    """Whether all values are plain numbers, whose conversion needs no check."""
    return _PLAIN.issuperset(map(type, values))


def check_scalars(arguments: Mapping[str, ArrayLike]) -> None:
    """Raise `InputError` for a plain number beyond the range of its name; NaN, negatives and arrays get a status."""
    for name, value in arguments.items():
        if name not in SIZES or not isinstance(value, _NUMBERS):
            continue
        # What is infinite gets a status, as what is negative.
        least, most = SIZES[name]
        size = abs(value) if least else value
        if 0 < size < least or most < size < math.inf:
            allowed = f"0 or {least:g} to {most:g} in magnitude" if least else f"0 to {most:g}"
            raise InputError(f"{name}: got {value!r}; it must be {allowed}")


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


def broadcast(arguments: Mapping[str, ArrayLike]) -> list[np.ndarray]:
    """Convert concrete arguments to float64 arrays of one common shape."""
    arrays = {name: as_float64(name, value) for name, value in arguments.items()}
    join_shapes((name, array.shape) for name, array in arrays.items())
    return list(np.broadcast_arrays(*arrays.values()))


def join_shapes(named: Iterable[tuple[str, tuple[int, ...]]], what: str = "shapes") -> tuple[int, ...]:
    """The shape that arguments of these shapes broadcast to; an `InputError` with all of them where they do not."""
    named = list(named)
    try:
        return np.broadcast_shapes(*(shape for _, shape in named))
    except ValueError:
        shapes = ", ".join(f"{name} {shape}" for name, shape in named)
        raise InputError(f"{what} do not broadcast: {shapes}; make each axis equal or 1") from None


def to_caller(result: Any, values: Iterable[ArrayLike]) -> Any:
    """Hand NumPy results to a caller who passed NumPy or plain numbers, JAX arrays to one who passed any."""
    if any(map(is_jax, values)):
        import jax.numpy as jnp

        # Without this a caller with JAX's default precision would lose half of the digits on the way out.
        with compute_concretely():
            return tree_map(jnp.asarray, result)
    return tree_map(lambda leaf: np.asarray(leaf)[()], result)


def broadcast_traced(values: Iterable[ArrayLike]) -> list[Any]:
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
