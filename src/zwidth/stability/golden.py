"""Golden section, for kernels of one point."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from zwidth._types import Array

_SHARE = 0.6180339887498949


def golden_section(cost: Callable[[Array], Array], low: Array, high: Array, steps: int) -> tuple[Array, Array]:
    """Shrink brackets of a lowest point so many times; ``cost`` takes and returns arrays of their shape."""

    def shrink(_: int, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        width = _SHARE * (high - low)
        inside = jnp.stack([high - width, low + width])
        # Both at once: a long formula is compiled in one place only.
        left, right = jax.vmap(cost)(inside)
        return jnp.where(left < right, low, inside[0]), jnp.where(left < right, inside[1], high)

    return jax.lax.fori_loop(0, steps, shrink, (low, high))
