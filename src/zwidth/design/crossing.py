"""The outermost zero of a function of one unknown, for kernels of one point.

Outermost means: beyond it the function stays negative, whatever it does before. The number of steps is fixed, so
that no point of a batch waits for another.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from zwidth._types import Array

# Each round cuts the bracket into this many cells; the first one has equal ratios, the others equal widths.
_CELLS = 160
_ROUNDS = 9
# A logarithm of a ratio of stiffnesses this close to 0 is 0 but for rounding.
_ZERO = 1e-14

Function = Callable[[Array], Array]


def outermost_zero(function: Function, inner: Array, outer: Array, offset: Array) -> tuple[Array, Array]:
    """The last zero between ``inner`` and ``outer``, and whether there is one; implicitly differentiable.

    ``inner + offset`` and ``outer + offset`` are positive, and ``function(outer)`` is negative. Cutting into many
    cells at once, without derivatives, has the function compiled in one place only: Newton's method would add two.
    """
    inner, outer, offset = jax.lax.stop_gradient((inner, outer, offset))

    def search(residual: Function, _: tuple[Array, Array]) -> tuple[Array, Array]:
        return _cut(residual, inner, outer, offset)

    # The flag rides along as a second unknown, whose equation is trivial.
    def equations(unknowns: tuple[Array, Array]) -> tuple[Array, Array]:
        return function(unknowns[0]), unknowns[1]

    def solve(residual: Callable[..., tuple[Array, Array]], start: tuple[Array, Array]) -> tuple[Array, Array]:
        return search(lambda x: residual((x, start[1]))[0], start)

    def tangent(linear: Callable[..., tuple[Array, Array]], right: tuple[Array, Array]) -> tuple[Array, Array]:
        slope, _ = linear((jnp.ones_like(right[0]), jnp.zeros_like(right[1])))
        return right[0] / slope, right[1]

    zero, found = jax.lax.custom_root(equations, (inner, jnp.zeros_like(inner)), solve, tangent)
    return zero, jax.lax.stop_gradient(found) > 0


def _cut(function: Function, inner: Array, outer: Array, offset: Array) -> tuple[Array, Array]:
    """Shrink the bracket to the last cell whose inner end is not negative, or else round the highest sample."""
    part = jnp.arange(_CELLS + 1, dtype=inner.dtype) / _CELLS

    def one_round(index: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        inner, outer, found = state
        width = outer - inner
        ratio = jnp.log((outer + offset) / (inner + offset))
        share = jnp.expm1(part * ratio) * (inner + offset) / width
        share = jnp.where((index == 0) & (width != 0), jnp.where(part < 1.0, share, 1.0), part)
        points = inner + share * width
        values = jax.vmap(function)(points)
        last = jnp.max(jnp.where(values >= -_ZERO, jnp.arange(_CELLS + 1), -1))
        top = jnp.argmax(values)
        crossed = last >= 0
        low = jnp.where(crossed, last, jnp.maximum(top - 1, 0))
        high = jnp.minimum(jnp.where(crossed, last, top) + 1, _CELLS)
        return points[low], points[high], jnp.where(crossed, 1.0, found)

    inner, outer, found = jax.lax.fori_loop(0, _ROUNDS, one_round, (inner, outer, jnp.zeros_like(inner)))
    return inner, found
