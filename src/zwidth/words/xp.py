"""Support for kernels with the same source code for NumPy and JAX.

A kernel selects the namespace of its arguments, computes elementwise, iterates a fixed number of steps and selects by
``xp.where``. Comments give the reason and the gain of code that is written for the compiler (XLA on a CPU): ratios of
times to compile and to run without and with it, by `benchmarks/bench_xla.py` on 2 cores with AVX-512. Importing this
module does not import JAX.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, reduce
from math import factorial
from typing import Any, TypeVar

import numpy as np

from zwidth.words.types import Array

State = TypeVar("State")
_STEP = 1e-100  # complex step of numerical derivatives; its square is negligible
_HOST_TYPES = (float, int, np.ndarray, np.generic, bool, list, tuple, str, type(None))


def is_jax(value: Any) -> bool:
    """Return whether a value is a JAX array, traced or not; False if JAX was never imported."""
    if isinstance(value, _HOST_TYPES):
        return False
    kind = getattr(sys.modules.get("jax"), "Array", None)
    # The attribute is missing while another thread imports JAX.
    return kind is not None and isinstance(value, kind)


def is_traced(*values: Any) -> bool:
    """Return whether any argument is traced by a JAX transformation."""
    kind = getattr(getattr(sys.modules.get("jax"), "core", None), "Tracer", None)
    return kind is not None and any(isinstance(value, kind) for value in values)


@contextmanager
def compute_concretely() -> Iterator[None]:
    """Compute in float64 without tracing inside the context, also during a JAX transformation of other values."""
    import jax

    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        yield


def namespace(*values: Any) -> Any:
    """Return `jax.numpy` if any argument is a JAX array, otherwise NumPy."""
    # Repeat the code of `is_jax`, because its calls would take half of the time of a single wall.
    kind = getattr(sys.modules.get("jax"), "Array", None)
    if kind is not None:
        for value in values:
            if not isinstance(value, _HOST_TYPES) and isinstance(value, kind):
                import jax.numpy

                return jax.numpy
    return np


def repeat(
    steps: int,
    step: Callable[[State], State],
    state: State,
    xp: Any,
    arrived: Callable[[State, State], bool] = lambda old, new: False,
) -> State:
    """Apply ``step`` a number of times; in NumPy only until ``arrived(old, new)`` returns True."""
    # Use a loop of the compiler for JAX, because its length does not increase the time to compile.
    if xp is np:
        for _ in range(steps):
            old, state = state, step(state)
            if arrived(old, state):
                break
        return state
    from jax.lax import fori_loop

    return fori_loop(0, steps, lambda _, state: step(state), state)


def apply_each(function: Callable[[Any], State], values: Sequence[Any], xp: Any) -> list[State]:
    """Apply a function to each value; JAX traces and compiles it only once."""
    if xp is np:
        return [function(value) for value in values]
    import jax

    results = jax.vmap(function)(jax.tree.map(lambda *parts: xp.stack(parts), *values))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], results) for k in range(len(values))]


def frozen(values: State, xp: Any) -> State:
    """Return the values as constants for differentiation."""
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
    """Return the derivative of an analytic function along changes of its arguments, as a tree of (named) tuples."""
    if xp is not np:
        from jax import jvp

        return jvp(function, values, changes)[1]
    moved = tree_map(lambda value, change: value + 1j * _STEP * change, values, changes)
    return tree_map(lambda result: np.imag(result) / _STEP, function(*moved))


def along(values: np.ndarray, like: Any) -> Any:
    """Return values along a new last axis after those of ``like``, with the type of ``like``."""
    return namespace(like).asarray(values, like.dtype).reshape((1,) * like.ndim + (-1,))


def epsilon(value: Any) -> float:
    """Return the machine epsilon of the type of a value; that of float64 for plain numbers."""
    return float(np.finfo(getattr(value, "dtype", np.float64)).eps)


def horner(x: Any, coefficients: Sequence[Any]) -> Any:
    """Evaluate a polynomial, lowest power first, by Horner's rule."""
    # Test the type before `is_jax`, because single walls evaluate many polynomials and a call costs time.
    if not isinstance(x, _HOST_TYPES) and is_jax(x) and all(isinstance(each, float) for each in coefficients):
        return _polynomial(tuple(coefficients))(x)
    total = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


@cache
def _polynomial(coefficients: tuple[float, ...]) -> Callable[[Any], Any]:
    """Return a fixed polynomial as a JAX function, traced once; derivatives of all orders are polynomials, too."""
    import jax

    if len(coefficients) == 1:
        return lambda x: jax.numpy.full_like(x, *coefficients)
    function = jax.custom_jvp(jax.jit(lambda x: reduce(lambda total, each: total * x + each, reversed(coefficients))))
    slope = tuple(k * coefficient for k, coefficient in enumerate(coefficients))[1:]
    function.defjvp(lambda x, change: (function(*x), _polynomial(slope)(*x) * change[0]))
    return function


def roots(*values: Any) -> tuple[Any, ...]:
    """Return the square roots of arrays, or of numbers with a method ``sqrt``."""
    if hasattr(values[0], "sqrt"):
        return tuple([value.sqrt() for value in values])
    return tuple(map(namespace(*values).sqrt, values))


def within(value: Array, limits: tuple[float, float]) -> Array:
    """Return whether a value is 0 or has a magnitude within ``limits``."""
    size = abs(value)
    # In single precision the limits would overflow.
    kind = getattr(size, "dtype", np.float64)
    most = limits[1] if kind == np.float64 else min(limits[1], float(np.finfo(kind).max))
    return (size <= most) & ((size >= limits[0]) | (size == 0)) if limits[0] else size <= most


def nan_beyond(limits: tuple[float, float], *values: Array) -> list[np.ndarray]:
    """Return the values, with NaN for each value that is not `within` the limits."""
    return [np.where(within(value, limits), value, np.nan) for value in values]


# The values and derivatives of an invalid point are NaN. `where(ok, value, nan)` would have the derivative 0 instead.
# Apply `nan_unless` to the arguments if the kernel can compute with NaN. For solvers, searches and exponents, replace
# invalid arguments by valid ones and add `nan_with_nan_slopes` to the results.


def nan_unless(ok: Array, *values: Array) -> tuple[Array, ...]:
    """Return the values where ``ok``, otherwise NaN, so that results and derivatives computed from them are NaN."""
    xp = namespace(ok, *values)
    factor = xp.where(ok, 1.0, np.nan)
    return tuple([value * factor for value in values])


def nan_with_nan_slopes(ok: Array, *inputs: Array) -> Array:
    """Return a term to add to a result: 0 where ``ok``, otherwise NaN with NaN first and second derivatives."""
    xp = namespace(ok, *inputs)
    # Select twice, because the square of a large valid input overflows and would turn 0 into NaN.
    total = sum(xp.where(ok, 0.0, value) for value in inputs)
    return xp.where(ok, 0.0, np.nan) * total * (1.0 + total)


Values = TypeVar("Values")

# Vector registers twice as wide as XLA's default, on processors that have them; no effect on others. Radii run 1.2 and
# verdicts 1.04 times as fast.
WIDE = ("xla_cpu_prefer_vector_width", 512)


@cache
def known_options(*options: tuple[str, int]) -> dict[str, int]:
    """Return the options that the installed XLA accepts, because an unknown option would stop every run."""
    import jax

    def are_known(wanted: dict[str, int]) -> bool:
        try:
            jax.jit(abs, compiler_options=wanted).lower(0.0).compile()
        except jax.errors.JaxRuntimeError:
            return False
        return True

    # Test all options together first, because usually all are accepted.
    return wanted if are_known(wanted := dict(options)) else {k: v for k, v in options if are_known({k: v})}


def store_once(values: Values, witness: Array) -> Values:
    """Return ``values`` such that XLA computes them once for all later steps that use them."""
    # XLA repeats a chain of cheap operations in every loop that uses its result, but never a division. The divisor is
    # 1, or NaN where ``witness`` (any run-time value) is NaN, so the compiler cannot remove it. The ridge of the rigid
    # loop compiles 1.3 times and runs 1.3 to 1.5 times as fast.
    if not is_jax(witness):
        return values
    import jax
    import jax.numpy as jnp

    one = jax.lax.stop_gradient(jnp.where(jnp.isnan(witness), jnp.nan, 1.0))
    return jax.tree.map(lambda value: value / one > 0 if value.dtype == bool else value / one, values)


def fit_arcsine(terms: int) -> list[float]:
    """Fit ``asin(sqrt y)/sqrt y`` on [0, 1/2] by powers of 4 y - 1; error 2e-16 with 19 terms, 6e-15 with 16."""
    node = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    y = 0.25 * (node + 1.0)
    fit = np.polynomial.chebyshev.chebfit(node, np.arcsin(np.sqrt(y)) / np.sqrt(y), terms - 1)
    return np.polynomial.chebyshev.cheb2poly(fit).tolist()


# Polynomials replace library calls, which have to handle every argument. With the series of the sine, radii run 2.9
# times as fast, and `angle` alone 2.1 times. With `angle` and `find_turn`, radii run 1.06 times as fast and compile in
# 0.7 of the time.
ARCSINE = fit_arcsine(19)
# Taylor series of sin(x)/x and cos(x) by x^2; on [0, pi/2] the first term left out is below 1e-17.
SINE = [(-1.0) ** k / factorial(2 * k + 1) for k in range(11)]
COSINE = [(-1.0) ** k / factorial(2 * k) for k in range(12)]


def angle(re: Array, im: Array) -> Array:
    """Return the argument of a complex number, in (-pi, pi]."""
    xp = namespace(re, im)
    if xp is np:
        return np.arctan2(im, re)
    size = xp.abs(re)
    length = xp.sqrt(re * re + im * im)
    half = 0.5 * im * im / (length * (length + size))
    value = 2.0 * xp.sqrt(half) * horner(4.0 * half - 1.0, ARCSINE)
    value = xp.where(re < 0, np.pi - value, value)
    return xp.where(im < 0, -value, value)


def find_turn(x: Array, y: Array, xp: Any) -> Array:
    """Return the w in [0, pi] for which ``x = sin^2(w/2)``; y = 1 - x."""
    if xp is np:
        return 2.0 * np.arctan2(np.sqrt(x), np.sqrt(y))
    # Do not use the minimum, because its derivative at x = y is the mean of both derivatives.
    beyond = x > y
    low = xp.where(beyond, y, x)
    value = 2.0 * xp.sqrt(low) * horner(4.0 * low - 1.0, ARCSINE)
    return xp.where(beyond, np.pi - value, value)
