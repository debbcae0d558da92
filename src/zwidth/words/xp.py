"""One text of a formula for NumPy and for JAX: which of the two, and the few operations they spell differently.

A kernel asks its arguments for their namespace, computes elementwise, iterates a fixed number of steps and chooses
with ``xp.where``. What is written the way it is for the compiler's sake (XLA on a processor) stands behind, each trick
with its reason and its gain: times without over times with by `benchmarks/bench_xla.py`, to compile and to run, on 2
cores with AVX-512. Importing this imports no JAX.
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


@contextmanager
def compute_concretely() -> Iterator[None]:
    """Compute in float64 without tracing inside the context, also during a JAX transformation of other values."""
    import jax

    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        yield


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


def repeat(
    steps: int,
    step: Callable[[State], State],
    state: State,
    xp: Any,
    arrived: Callable[[State, State], bool] = lambda old, new: False,
) -> State:
    """Apply ``step`` so many times; in NumPy until ``arrived(old, new)`` says that more would change nothing."""
    # For JAX a loop of the compiler, whose length does not add to the time to compile.
    if xp is np:
        for _ in range(steps):
            old, state = state, step(state)
            if arrived(old, state):
                break
        return state
    from jax.lax import fori_loop

    return fori_loop(0, steps, lambda _, state: step(state), state)


def apply_each(function: Callable[[Any], State], values: Sequence[Any], xp: Any) -> list[State]:
    """A function of each value: JAX traces and compiles it once for all of them."""
    if xp is np:
        return [function(value) for value in values]
    import jax

    results = jax.vmap(function)(jax.tree.map(lambda *parts: xp.stack(parts), *values))
    return [jax.tree.map(lambda leaf, k=k: leaf[k], results) for k in range(len(values))]


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
    """How the results, trees of (named) tuples, of an analytic function move when its arguments do."""
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
    # The type is asked here first: a single wall passes here often, and each time would be one call more.
    if not isinstance(x, _HOST_TYPES) and is_jax(x) and all(isinstance(each, float) for each in coefficients):
        return _polynomial(tuple(coefficients))(x)
    total = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = total * x + coefficient
    return total


@cache
def _polynomial(coefficients: tuple[float, ...]) -> Callable[[Any], Any]:
    """A fixed polynomial for JAX, which reads it once; its slope is a polynomial too, however many derivatives ask."""
    import jax

    if len(coefficients) == 1:
        return lambda x: jax.numpy.full_like(x, *coefficients)
    function = jax.custom_jvp(jax.jit(lambda x: reduce(lambda total, each: total * x + each, reversed(coefficients))))
    slope = tuple(k * coefficient for k, coefficient in enumerate(coefficients))[1:]
    function.defjvp(lambda x, change: (function(*x), _polynomial(slope)(*x) * change[0]))
    return function


def roots(*values: Any) -> tuple[Any, ...]:
    """The square roots of arrays, or of numbers of another arithmetic."""
    if hasattr(values[0], "sqrt"):
        return tuple([value.sqrt() for value in values])
    return tuple(map(namespace(*values).sqrt, values))


def within(value: Array, limits: tuple[float, float]) -> Array:
    """Whether a value is 0 or of a magnitude within ``limits``."""
    size = abs(value)
    # In single precision the limits lie outside of what there is.
    kind = getattr(size, "dtype", np.float64)
    most = limits[1] if kind == np.float64 else min(limits[1], float(np.finfo(kind).max))
    return (size <= most) & ((size >= limits[0]) | (size == 0)) if limits[0] else size <= most


def nan_beyond(limits: tuple[float, float], *values: Array) -> list[np.ndarray]:
    """The values, NaN where one is not `within` the limits."""
    return [np.where(within(value, limits), value, np.nan) for value in values]


# A bad point is NaN, and so are its derivatives: `where(ok, value, nan)` alone would give it the derivative 0, a finite
# number that means nothing. What may compute with NaN is voided before; what may not (a solver, a search, an
# exponent) gets harmless numbers, and its results are poisoned behind.


def nan_unless(ok: Array, *values: Array) -> tuple[Array, ...]:
    """The values where ``ok``, else NaN: so is what is computed with them, derivatives included."""
    xp = namespace(ok, *values)
    factor = xp.where(ok, 1.0, np.nan)
    return tuple([value * factor for value in values])


def nan_with_nan_slopes(ok: Array, *inputs: Array) -> Array:
    """Something to add to a result: 0 where ``ok``, else NaN with NaN first and second derivatives in every input."""
    xp = namespace(ok, *inputs)
    # Chosen twice: an input so large that its square overflows must not turn 0 into NaN where all is well.
    total = sum(xp.where(ok, 0.0, value) for value in inputs)
    return xp.where(ok, 0.0, np.nan) * total * (1.0 + total)


Values = TypeVar("Values")

# Registers twice as wide as what XLA takes by itself, where the processor has them; without effect elsewhere. Runs 1.2
# times as fast for radii and 1.04 times for verdicts.
WIDE = ("xla_cpu_prefer_vector_width", 512)


@cache
def known_options(*options: tuple[str, int]) -> dict[str, int]:
    """Those of XLA's options that the installed XLA knows: releases drop some, and one of them would stop every run."""
    import jax

    def are_known(wanted: dict[str, int]) -> bool:
        try:
            jax.jit(abs, compiler_options=wanted).lower(0.0).compile()
        except jax.errors.JaxRuntimeError:
            return False
        return True

    # Most often all are.
    return wanted if are_known(wanted := dict(options)) else {k: v for k, v in options if are_known({k: v})}


def store_once(values: Values, witness: Array) -> Values:
    """``values``, computed once: for a kernel in which many later steps use them."""
    # XLA repeats a chain of cheap operations in every loop it makes out of the operations behind it, but never a
    # division. The divisor here is 1, or NaN where ``witness`` (anything known at run time) is, so that the compiler
    # cannot see it. The rigid loop's ridge compiles 1.3 and runs 1.3 to 1.5 times as fast.
    if not is_jax(witness):
        return values
    import jax
    import jax.numpy as jnp

    one = jax.lax.stop_gradient(jnp.where(jnp.isnan(witness), jnp.nan, 1.0))
    return jax.tree.map(lambda value: value / one > 0 if value.dtype == bool else value / one, values)


def fit_arcsine(terms: int) -> list[float]:
    """``asin(sqrt y)/sqrt y`` on [0, 1/2] by powers of 4 y - 1: to 2e-16 with 19 terms, to 6e-15 with 16."""
    node = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    y = 0.25 * (node + 1.0)
    fit = np.polynomial.chebyshev.chebfit(node, np.arcsin(np.sqrt(y)) / np.sqrt(y), terms - 1)
    return np.polynomial.chebyshev.cheb2poly(fit).tolist()


# Polynomials in place of calls, which serve every argument: radii run 2.9 times as fast by the series of the sine, an
# `angle` by itself 2.1 times, and radii 1.06 times by `angle` and `find_turn`, whose compilation takes 0.7 of the time.
ARCSINE = fit_arcsine(19)
# Taylor series of sin(x)/x and cos(x) by x^2; on [0, pi/2] the first term left out is below 1e-17.
SINE = [(-1.0) ** k / factorial(2 * k + 1) for k in range(11)]
COSINE = [(-1.0) ** k / factorial(2 * k) for k in range(12)]


def angle(re: Array, im: Array) -> Array:
    """The argument in (-pi, pi]."""
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
    """The w of ``x = sin^2(w/2)`` and y = 1 - x."""
    if xp is np:
        return 2.0 * np.arctan2(np.sqrt(x), np.sqrt(y))
    # Not by the minimum, which has half of two derivatives where both are equal.
    beyond = x > y
    low = xp.where(beyond, y, x)
    value = 2.0 * xp.sqrt(low) * horner(4.0 * low - 1.0, ARCSINE)
    return xp.where(beyond, np.pi - value, value)
