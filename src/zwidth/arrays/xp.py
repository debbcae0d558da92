"""One text of a formula for NumPy and for JAX: which of the two, and the few operations they spell differently.

A kernel asks its arguments for their namespace, computes elementwise, iterates a fixed number of steps and chooses
with ``xp.where``. Importing this imports no JAX.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np

State = TypeVar("State")
# Its square is nothing beside any derivative.
_STEP = 1e-100
_HOST_TYPES = (float, int, np.ndarray, np.generic, bool, list, tuple, str, type(None))


def is_jax(value: Any) -> bool:
    """Whether a value is a JAX array, traced or not. Where JAX was never imported, none can exist."""
    if isinstance(value, _HOST_TYPES):
        return False
    kind = getattr(sys.modules.get("jax"), "Array", None)
    # None also while another thread is about to import JAX.
    return kind is not None and isinstance(value, kind)


def is_traced(*values: Any) -> bool:
    """Whether any argument is inside a JAX transformation."""
    kind = getattr(getattr(sys.modules.get("jax"), "core", None), "Tracer", None)
    return kind is not None and any(isinstance(value, kind) for value in values)


def namespace(*values: Any) -> Any:
    """`jax.numpy` where any argument is a JAX array, NumPy otherwise."""
    # As `is_jax`, which a call for each argument would take half of the time of a single wall.
    kind = getattr(sys.modules.get("jax"), "Array", None)
    if kind is not None:
        for value in values:
            if not isinstance(value, _HOST_TYPES) and isinstance(value, kind):
                import jax.numpy

                return jax.numpy
    return np


def repeat(steps: int, step: Callable[[State], State], state: State, xp: Any) -> State:
    """Apply ``step`` so many times: a loop of the compiler in JAX, whose length does not add to the time to compile."""
    if xp is np:
        for _ in range(steps):
            state = step(state)
        return state
    from jax.lax import fori_loop

    return fori_loop(0, steps, lambda _, state: step(state), state)


def frozen(values: State, xp: Any) -> State:
    """The same values, through which no derivative passes."""
    if xp is np:
        return values
    from jax.lax import stop_gradient

    return stop_gradient(values)


def tree_map(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Apply a function to the arrays of a (named) tuple, or to a single array."""
    if not isinstance(tree, tuple):
        return function(tree, *others)
    parts = [tree_map(function, *leaves) for leaves in zip(tree, *others, strict=True)]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def push_forward(function: Callable[..., Any], values: tuple[Any, ...], changes: tuple[Any, ...], xp: Any) -> Any:
    """How the results of an analytic function move when its arguments do; trees are (named) tuples.

    NumPy takes a step into the complex plane, which no difference rounds.
    """
    if xp is not np:
        from jax import jvp

        return jvp(function, values, changes)[1]
    moved = tree_map(lambda value, change: value + 1j * _STEP * change, values, changes)
    return tree_map(lambda result: np.imag(result) / _STEP, function(*moved))


def along(values: np.ndarray, like: Any) -> Any:
    """Values along a new last axis behind those of ``like``, and of its type."""
    return namespace(like).asarray(values, like.dtype).reshape((1,) * like.ndim + (-1,))


def epsilon(value: Any) -> float:
    """The rounding unit of a value's type; that of float64 for plain numbers."""
    return float(np.finfo(getattr(value, "dtype", np.float64)).eps)


def horner(x: Any, coefficients: Sequence[Any]) -> Any:
    """A polynomial, lowest power first, by Horner's rule."""
    total = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


def roots(*values: Any) -> tuple[Any, ...]:
    """The square roots of arrays, or of numbers of another arithmetic."""
    if hasattr(values[0], "sqrt"):
        return tuple([value.sqrt() for value in values])
    return tuple(map(namespace(*values).sqrt, values))
