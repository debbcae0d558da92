"""The lowest point of a function with kinks and several dips, over an interval or a cube, for kernels of one point.

Without derivatives: kinks have none, and a long formula would be compiled once more for them. The number of steps is
fixed, so that no point of a batch waits for another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from zwidth.words.types import Array

# The part of the larger half of a bracket that golden section leaves between the middle and its trial.
_GOLDEN = 0.3819660112501051

# Values at several trials, and whatever else is wanted of the best one, with the same leading axis.
Cost = Callable[[Array], tuple[Array, Any]]


class _Dips(NamedTuple):
    """Brackets of dips, with the value and the rest of what is known at the lowest point of each."""

    left: Array
    middle: Array
    right: Array
    value: Array
    rest: Any

    def trial(self) -> Array:
        """A point in the larger part of each bracket."""
        upwards = self.right - self.middle > self.middle - self.left
        return self.middle + _GOLDEN * jnp.where(upwards, self.right - self.middle, self.left - self.middle)

    def shrunk(self, trial: Array, value: Array, rest: Any) -> _Dips:
        """Of the trial and the middle the lower one becomes the middle, the other one an end."""
        better = value < self.value
        end = jnp.where(better, self.middle, trial)
        is_right = better ^ (trial > self.middle)
        return _Dips(
            jnp.where(is_right, self.left, end),
            jnp.where(better, trial, self.middle),
            jnp.where(is_right, end, self.right),
            jnp.where(better, value, self.value),
            jax.tree.map(lambda new, old: jnp.where(better, new, old), rest, self.rest),
        )


def lowest(cost: Cost, lower: Array, upper: Array, *, samples: int, dips: int, steps: int) -> tuple[Array, Array, Any]:
    """Minimize over an interval: samples across it, then golden section round the lowest dips. (x, value, rest)

    ``cost`` gets ``dips`` trial values at once, of which ``samples`` is a multiple. Sampling and refinement are one
    loop: a long formula is compiled in one place only, and the memory it needs does not grow with the samples.
    """
    grid = lower + (upper - lower) * jnp.arange(samples, dtype=lower.dtype) / (samples - 1)
    rounds = samples // dips
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(cost, grid[:dips]))
    known = jax.tree.map(lambda leaf: jnp.zeros(samples, leaf.dtype), blank)
    start = _Dips(grid[:dips], grid[:dips], grid[:dips], *blank)

    def step(index: Array, state: tuple[Any, _Dips]) -> tuple[Any, _Dips]:
        known, brackets = state
        sampling = index < rounds
        place = jnp.minimum(index, rounds - 1) * dips
        trial = jnp.where(sampling, jax.lax.dynamic_slice(grid, (place,), (dips,)), brackets.trial())
        reached = cost(trial)
        filled = jax.tree.map(lambda all_, new: jax.lax.dynamic_update_slice(all_, new, (place,)), known, reached)
        known = jax.tree.map(lambda new, old: jnp.where(sampling, new, old), filled, known)
        # Before the last sample the brackets mean nothing, and are shrunk all the same.
        brackets = jax.lax.cond(
            index == rounds - 1,
            lambda: _gather_dips(dips, grid, *known),
            lambda: brackets.shrunk(trial, *reached),
        )
        return known, brackets

    _, found = jax.lax.fori_loop(0, rounds + steps, step, (known, start))
    best = jnp.argmin(found.value)
    return found.middle[best], found.value[best], jax.tree.map(lambda leaf: leaf[best], found.rest)


def _gather_dips(count: int, grid: Array, values: Array, rest: Any) -> _Dips:
    """The lowest dips among the samples; fewer dips than ``count`` are filled up with other samples."""
    padded = jnp.pad(values, 1, constant_values=jnp.inf)
    is_dip = (values <= padded[:-2]) & (values <= padded[2:])
    _, best = jax.lax.top_k(jnp.where(is_dip, -values, -jnp.inf), count)
    ends = grid[jnp.maximum(best - 1, 0)], grid[jnp.minimum(best + 1, grid.shape[0] - 1)]
    return _Dips(ends[0], grid[best], ends[1], values[best], jax.tree.map(lambda leaf: leaf[best], rest))


@jax.custom_jvp
def without_slope(result: Any, inputs: Any) -> Any:
    """``result`` with NaN for its derivatives in ``inputs``, where a search has none to offer."""
    return result


@without_slope.defjvp
def _nan_slope(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
    result, _ = primals
    change = sum(jnp.sum(tangent) for tangent in jax.tree.leaves(tangents[1]))
    return result, jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan) * change, result)
