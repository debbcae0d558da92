"""The outermost zero of functions of one unknown, elementwise, in NumPy and in JAX.

Outermost means: beyond it the function stays negative, whatever it does before. The number of steps is fixed, so
that no point of a batch waits for another.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from zwidth._types import Array
from zwidth.xp import epsilon, frozen, namespace, repeat

# Each round cuts the bracket into this many cells; the first one has equal ratios, the others equal widths.
_CELLS = 160
_ROUNDS = 4

Function = Callable[[Array], Array]
Sloped = Callable[[Array], tuple[Array, Array]]


def outermost_cell(function: Function, inner: Array, outer: Array, offset: Array) -> tuple[Array, Array, Array]:
    """A narrow bracket of the last zero between ``inner`` and ``outer``, and whether there is one.

    All have one shape with a leading axis of 1; ``function`` takes points along that axis. ``inner + offset`` and
    ``outer + offset`` are positive, and ``function(outer)`` is negative. A dip below zero narrower than a cell of the
    first round is not seen; a peak above it is, where the highest of the samples stands beside it.
    """
    xp = namespace(inner)
    inner, outer, offset = frozen((inner, outer, offset), xp)
    part = xp.arange(_CELLS + 1).astype(inner.dtype).reshape((-1,) + (1,) * (inner.ndim - 1)) / _CELLS
    # A logarithm of a ratio this close to 0 is 0 but for rounding.
    least = -45.0 * epsilon(inner)

    def cut(state: tuple[Array, Array, Array], share: Array) -> tuple[Array, Array, Array]:
        inner, outer, found = state
        points = inner + share * (outer - inner)
        values = frozen(function(points), xp)
        place = xp.arange(_CELLS + 1).reshape(part.shape)
        last = xp.max(xp.where(values >= least, place, -1), axis=0, keepdims=True)
        top = xp.argmax(xp.where(xp.isnan(values), -np.inf, values), axis=0)[None]
        crossed = last >= 0
        low = xp.where(crossed, last, xp.maximum(top - 1, 0))
        high = xp.minimum(xp.where(crossed, last, top) + 1, _CELLS)
        ends = (xp.take_along_axis(points, index, axis=0) for index in (low, high))
        return (*ends, found | crossed)

    width = outer - inner
    spread = xp.expm1(part * xp.log((outer + offset) / (inner + offset))) * (inner + offset)
    share = xp.where((width != 0) & (part < 1.0), spread / xp.where(width != 0, width, 1.0), part)
    state = cut((inner, outer, inner != inner), share)
    return repeat(_ROUNDS - 1, lambda state: cut(state, part), state, xp)


def outermost_zero(
    function: Function, sloped: Sloped, inner: Array, outer: Array, offset: Array
) -> tuple[Array, Array]:
    """The last zero and whether there is one; ``sloped`` returns value and slope and is differentiable.

    Two steps of Newton's method end the search. Derivatives pass through them alone: started at the zero, they move
    with its parameters as it does, up to the third order.
    """
    xp = namespace(inner)
    low, high, found = outermost_cell(function, inner, outer, offset)
    zero, width = low, high - low
    for _ in range(2):
        value, slope = sloped(zero)
        step = value / slope
        # Where the function is flat, a step is rounding over rounding.
        zero = zero - xp.where(xp.abs(step) <= width, step, 0.0)
    # Rounding may lead out of the bracket where it ends in the zero.
    least = frozen(inner, xp)
    return xp.where(zero < least, least, zero), found
