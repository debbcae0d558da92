"""The outermost zero of a function of one unknown, for kernels of one point: bracket, solve, differentiate.

Outermost means: beyond it the function stays negative, whatever it does before. The number of steps is fixed, so
that no point of a batch waits for another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from zwidth._types import Array

_GOLDEN = 0.6180339887498949
_GOLDEN_STEPS = 45
# Newton steps inside a bracket that halves whenever they do not: far more than the smooth functions here need.
_SOLVER_STEPS = 48
# A logarithm of a ratio of stiffnesses this close to 0 is 0 but for rounding.
_ZERO = 1e-14

Function = Callable[[Array], Array]


class Bracket(NamedTuple):
    """The function is >= 0 at ``inner`` and < 0 at ``outer``, where ``exists``."""

    inner: Array
    outer: Array
    exists: Array


def outermost_bracket(function: Function, grid: Array) -> Bracket:
    """Bracket the last sign change along ``grid``, which runs outwards.

    Where no sample is positive, the highest one is climbed: a peak between two samples may still be.
    """
    values = jax.vmap(function)(grid)
    last = grid.shape[0] - 1
    index = jnp.max(jnp.where(values >= -_ZERO, jnp.arange(last + 1), -1))
    top = jnp.argmax(values)
    peak, height = _climb(function, grid[jnp.maximum(top - 1, 0)], grid[jnp.minimum(top + 1, last)])
    found = index >= 0
    inner = jnp.where(found, grid[jnp.maximum(index, 0)], peak)
    outer = jnp.where(found, grid[jnp.clip(index + 1, 0, last)], grid[jnp.minimum(top + 1, last)])
    return Bracket(inner, outer, (found | (height >= -_ZERO)) & (values[last] < 0))


def _climb(function: Function, low: Array, high: Array) -> tuple[Array, Array]:
    """The place and the height of the peak between two points, by golden section."""

    def shrink(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, _ = state
        width = _GOLDEN * (high - low)
        inside = jnp.stack([high - width, low + width])
        # One call for both points: the function is compiled once.
        left, right = jax.vmap(function)(inside)
        keep_left = left > right
        low, high = jnp.where(keep_left, low, inside[0]), jnp.where(keep_left, inside[1], high)
        return low, high, jnp.maximum(left, right)

    low, high, height = jax.lax.fori_loop(0, _GOLDEN_STEPS, shrink, (low, high, jnp.full_like(low, -jnp.inf)))
    return 0.5 * (low + high), height


def solve(function: Function, bracket: Bracket) -> Array:
    """The zero inside a bracket, differentiable in all that ``function`` closes over (implicit function theorem)."""
    inner, outer = jax.lax.stop_gradient((bracket.inner, bracket.outer))
    return jax.lax.custom_root(
        function,
        0.5 * (inner + outer),
        lambda residual, start: _safeguarded_newton(residual, start, inner, outer),
        lambda linear, right: right / linear(jnp.ones_like(right)),
    )


def _safeguarded_newton(function: Function, start: Array, inner: Array, outer: Array) -> Array:
    """Newton's method in a bracket, with bisection where a step would leave it."""

    def step(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        x, inner, outer = state
        value, slope = jax.jvp(function, (x,), (jnp.ones_like(x),))
        inside = value >= 0
        inner, outer = jnp.where(inside, x, inner), jnp.where(inside, outer, x)
        newton = x - value / jnp.where(slope == 0, 1.0, slope)
        low, high = jnp.minimum(inner, outer), jnp.maximum(inner, outer)
        usable = (slope != 0) & (newton >= low) & (newton <= high)
        return jnp.where(usable, newton, 0.5 * (low + high)), inner, outer

    x, _, _ = jax.lax.fori_loop(0, _SOLVER_STEPS, step, (start, inner, outer))
    return x
