"""Array functions that work with NumPy and JAX, for kernels with the same source code for both.

A *kernel* is a function of arrays of one shape. It computes elementwise with the *namespace* of its arguments, NumPy or
`jax.numpy`, iterates a fixed number of steps, and selects values by ``xp.where``. Some code is written for the compiler
of JAX (XLA on a CPU). Its comments state the gain as a ratio of compile times or run times, without and with this code,
measured by `benchmarks/bench_xla.py` on 2 cores with AVX-512. Importing this module does not import JAX.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, reduce
from math import factorial
from typing import Any, TypeVar

import numpy as np

from zwidth.core.types import Array

State = TypeVar("State")
_STEP = 1e-100  # step of complex-step derivatives, so small that its square is negligible
# Types that are never JAX arrays.
_HOST_TYPES = (float, int, np.ndarray, np.generic, bool, list, tuple, str, type(None))


def is_jax(value: Any) -> bool:
    """Return whether a value is a JAX array, traced or not; False if JAX was never imported."""
    if isinstance(value, _HOST_TYPES):
        return False
    kind = getattr(sys.modules.get("jax"), "Array", None)
    # While another thread imports JAX, the module may have no attribute ``Array`` yet, and no value is a JAX array.
    return kind is not None and isinstance(value, kind)


def is_traced(*values: Any) -> bool:
    """Return whether any argument is traced by a JAX transformation."""
    kind = getattr(getattr(sys.modules.get("jax"), "core", None), "Tracer", None)
    return kind is not None and any(isinstance(value, kind) for value in values)


class _Jax:
    """Module `jax`, imported when an attribute is first used."""

    def __getattr__(self, name: str) -> Any:
        import jax.numpy

        return getattr(jax, name)


lazy_jax: Any = _Jax()


@contextmanager
def compute_concretely() -> Iterator[None]:
    """Compute in float64 without tracing inside the context, even during a JAX transformation of other values."""
    import jax

    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        yield


def namespace(*values: Any) -> Any:
    """Return `jax.numpy` if any argument is a JAX array, otherwise NumPy."""
    # Inline `is_jax`, because calls of it would take half of the computation time of a single wall.
    kind = getattr(sys.modules.get("jax"), "Array", None)
    if kind is not None:
        for value in values:
            if not isinstance(value, _HOST_TYPES) and isinstance(value, kind):
                import jax.numpy

                return jax.numpy
    return np


def iterate(
    steps: int,
    step: Callable[[State], State],
    state: State,
    xp: Any,
    converged: Callable[[State, State], bool] = lambda old, new: False,
) -> State:
    """Iterate ``step`` a fixed number of times; with NumPy, stop as soon as the iteration has converged.

    Args:
        steps: number of steps.
        step: function from a state to the next state.
        state: initial state.
        xp: namespace.
        converged: convergence test, a function of the previous and the new state. JAX ignores it.
    """
    # For JAX, use a compiled loop, because the compile time then does not depend on the number of steps.
    if xp is np:
        for _ in range(steps):
            old, state = state, step(state)
            if converged(old, state):
                break
        return state
    from jax.lax import fori_loop

    return fori_loop(0, steps, lambda _, state: step(state), state)


def apply_each(function: Callable[[Any], State], values: Sequence[Any], xp: Any) -> list[State]:
    """Return the list of the results of a function for all values; JAX traces and compiles the function only once."""
    if xp is np:
        return [function(value) for value in values]
    import jax

    results = jax.vmap(function)(jax.tree.map(lambda *parts: xp.stack(parts), *values))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], results) for k in range(len(values))]


def stop_gradient(values: State, xp: Any) -> State:
    """Return the values as constants for differentiation; see `jax.lax.stop_gradient`."""
    if xp is np:
        return values
    from jax.lax import stop_gradient

    return stop_gradient(values)


def tree_map(function: Callable[..., Any], tree: Any, *others: Any) -> Any:
    """Apply a function to each array of nested (named) tuples, or to a single array."""
    if not isinstance(tree, tuple):
        return function(tree, *others)
    parts = [tree_map(function, *leaves) for leaves in zip(tree, *others, strict=True)]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


def differentiate_along(
    function: Callable[..., Any], values: tuple[Any, ...], changes: tuple[Any, ...], xp: Any
) -> Any:
    """Return the directional derivative of an analytic function.

    With NumPy it is computed by a complex step, with JAX by `jax.jvp`.

    Args:
        function: function of arrays and (named) tuples of arrays.
        values: arguments at which the derivative is computed.
        changes: direction, of the same structure as ``values``.
        xp: namespace.
    """
    if xp is not np:
        from jax import jvp

        return jvp(function, values, changes)[1]
    moved = tree_map(lambda value, change: value + 1j * _STEP * change, values, changes)
    return tree_map(lambda result: np.imag(result) / _STEP, function(*moved))


def expand_along(values: np.ndarray, like: Any) -> Any:
    """Convert a vector to the array type and dtype of ``like``, in a shape that broadcasts with ``like[..., None]``."""
    return namespace(like).asarray(values, like.dtype).reshape((1,) * like.ndim + (-1,))


def epsilon(value: Any) -> float:
    """Return the machine epsilon of the type of an array; for a number, that of float64."""
    return float(np.finfo(getattr(value, "dtype", np.float64)).eps)


def horner(x: Any, coefficients: Sequence[Any]) -> Any:
    """Evaluate a polynomial at x by Horner's rule; the coefficients are given from the lowest power up."""
    # Test for NumPy and Python types first, because this avoids most calls of `is_jax` when single walls are computed.
    if not isinstance(x, _HOST_TYPES) and is_jax(x) and all(isinstance(each, float) for each in coefficients):
        return _polynomial(tuple(coefficients))(x)
    total = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


@lru_cache(256)
def _polynomial(coefficients: tuple[float, ...]) -> Callable[[Any], Any]:
    """Return a polynomial with constant coefficients as a JAX function that is traced once.

    Its derivatives of all orders are functions of the same kind.
    """
    import jax

    if len(coefficients) == 1:
        return lambda x: jax.numpy.full_like(x, *coefficients)
    function = jax.custom_jvp(jax.jit(lambda x: reduce(lambda total, each: total * x + each, reversed(coefficients))))
    derivative = tuple(k * coefficient for k, coefficient in enumerate(coefficients))[1:]
    function.defjvp(lambda x, change: (function(*x), _polynomial(derivative)(*x) * change[0]))
    return function


def square_roots(*values: Any) -> tuple[Any, ...]:
    """Return the square roots of arrays, or of numbers with a method ``sqrt``, such as the balls of python-flint."""
    if hasattr(values[0], "sqrt"):
        return tuple([value.sqrt() for value in values])
    return tuple(map(namespace(*values).sqrt, values))


def within(value: Array, limits: tuple[float, float]) -> Array:
    """Return whether a value is 0 or has a magnitude within ``limits``, elementwise."""
    size = abs(value)
    # Reduce the upper limit to the largest number of the type, because a limit such as 1e60 would overflow in float32.
    kind = getattr(size, "dtype", np.float64)
    most = limits[1] if kind == np.float64 else min(limits[1], float(np.finfo(kind).max))
    return (size <= most) & ((size >= limits[0]) | (size == 0)) if limits[0] else size <= most


def nan_beyond(limits: tuple[float, float], *values: Array) -> list[np.ndarray]:
    """Return the values, with NaN in place of each value that is not `within` the limits."""
    return [np.where(within(value, limits), value, np.nan) for value in values]


# The following two functions make both values and derivatives NaN at invalid points; with `where(ok, value, nan)` the
# derivatives would be 0. Kernels that can compute with NaN apply `nan_unless` to their arguments. Others, such as
# solvers, replace invalid arguments by valid ones and add `nan_with_nan_derivatives` to the results.


def nan_unless(ok: Array, *values: Array) -> tuple[Array, ...]:
    """Multiply the values by NaN where not ``ok``, so that results and derivatives computed from them are NaN."""
    xp = namespace(ok, *values)
    factor = xp.where(ok, 1.0, np.nan)
    return tuple([value * factor for value in values])


def nan_with_nan_derivatives(ok: Array, *inputs: Array) -> Array:
    """Return a term to be added to a result: 0 where ``ok``, otherwise NaN with first and second derivatives NaN.

    Args:
        ok: True at valid points.
        *inputs: arguments with respect to which derivatives are taken.
    """
    xp = namespace(ok, *inputs)
    # Replace valid inputs by 0 first, because the square of a large one would overflow, and 0 times infinity is NaN.
    total = sum(xp.where(ok, 0.0, value) for value in inputs)
    return xp.where(ok, 0.0, np.nan) * total * (1.0 + total)


Values = TypeVar("Values")

# Option of the compiler XLA that doubles the width of the vector registers in use. It has no effect on processors that
# lack such registers. The spectral radius is computed 1.2 times as fast, and stability 1.04 times as fast.
WIDE = {"xla_cpu_prefer_vector_width": 512}


def compile_with_options(
    function: Callable[..., Any], options: dict[str, bool | int], **arguments: Any
) -> Callable[..., Any]:
    """Return ``jax.jit(function, **arguments)`` with compiler options, or without them if XLA rejects any option."""
    import jax

    variants = [jax.jit(function, compiler_options=options, **arguments), jax.jit(function, **arguments)]

    def call(*values: Any) -> Any:
        try:
            return variants[0](*values)
        except jax.errors.JaxRuntimeError:
            if len(variants) == 1:
                raise
            # Call without options from now on, because this release of XLA lacks one of them.
            del variants[0]
            return variants[0](*values)

    return call


def materialize(values: Values, witness: Array) -> Values:
    """Return ``values`` such that XLA computes them only once, even if several fused loops use them.

    Args:
        values: arrays.
        witness: any array whose values are unknown at compile time.
    """
    # XLA repeats cheap operations in every fused loop that uses their result, but it does not repeat a division.
    # Therefore divide by 1, which is computed from ``witness`` so that the compiler cannot remove the division. In CPU
    # time, four kernels become faster: the maximum stiffness 1.1 to 1.2 times, the spectral radius for mixed delays
    # also 1.1 to 1.2 times, phase margins 1.15 times, and labels of grids 2 to 4 times. All other kernels would be less
    # than 5 % faster and do not call this function.
    if not is_jax(witness):
        return values
    import jax
    import jax.numpy as jnp

    one = jax.lax.stop_gradient(jnp.where(jnp.isnan(witness), jnp.nan, 1.0))
    return jax.tree.map(lambda value: value / one > 0 if value.dtype == bool else value / one, values)


def fit_arcsine(terms: int) -> list[float]:
    """Fit asin(sqrt(y))/sqrt(y) on [0, 1/2] by a polynomial in 4 y - 1, and return its coefficients.

    The coefficients start with the lowest power. The error is 2e-16 for 19 terms and 6e-15 for 16 terms.
    """
    node = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    y = 0.25 * (node + 1.0)
    fit = np.polynomial.chebyshev.chebfit(node, np.arcsin(np.sqrt(y)) / np.sqrt(y), terms - 1)
    return np.polynomial.chebyshev.cheb2poly(fit).tolist()


# For JAX, polynomials replace library functions, which are slower because they handle all arguments. With SINE and
# COSINE, the spectral radius is computed 2.9 times as fast. `angle` is 2.1 times as fast as the library function. With
# `angle` and `invert_haversine`, the spectral radius is computed 1.06 times as fast and compiled in 0.7 of the time.
ARCSINE = fit_arcsine(19)  # coefficients of asin(sqrt(y))/sqrt(y) in powers of 4 y - 1
# Taylor coefficients of sin(x)/x and cos(x) in powers of x^2. On [0, pi/2] the first omitted term is below 1e-17.
SINE = [(-1.0) ** k / factorial(2 * k + 1) for k in range(11)]
COSINE = [(-1.0) ** k / factorial(2 * k) for k in range(12)]


def angle(re: Array, im: Array) -> Array:
    """Return the argument of the complex number re + j im, in (-pi, pi]."""
    xp = namespace(re, im)
    if xp is np:
        return np.arctan2(im, re)
    size = xp.abs(re)
    length = xp.sqrt(re * re + im * im)
    # half = sin^2(w/2) for the argument w of |re| + j |im|, without cancellation. Therefore w = 2 asin(sqrt(half)).
    half = 0.5 * im * im / (length * (length + size))
    value = 2.0 * xp.sqrt(half) * horner(4.0 * half - 1.0, ARCSINE)
    value = xp.where(re < 0, np.pi - value, value)
    return xp.where(im < 0, -value, value)


def invert_haversine(x: Array, y: Array, xp: Any) -> Array:
    """Return the angle w in [0, pi] with ``sin^2(w/2) = x``.

    Args:
        x: sin^2(w/2).
        y: cos^2(w/2), i.e. 1 - x.
        xp: namespace.
    """
    if xp is np:
        return 2.0 * np.arctan2(np.sqrt(x), np.sqrt(y))
    # Use ``where``, because the derivative of ``minimum`` at x = y would be the mean of the derivatives of x and y.
    beyond = x > y
    low = xp.where(beyond, y, x)
    value = 2.0 * xp.sqrt(low) * horner(4.0 * low - 1.0, ARCSINE)
    return xp.where(beyond, np.pi - value, value)
