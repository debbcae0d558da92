"""Evaluation of functions on several devices of JAX, each of which computes its part of distributed arrays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from zwidth.core.types import Array
from zwidth.core.xp import is_traced
from zwidth.numerics.evaluate import CACHED_KERNELS


def map_on_devices(function: Callable[..., Any], arrays: Sequence[Array]) -> Any:
    """Apply a compiled function to JAX arrays; if they are distributed, each device computes its part of the points.

    The compiler of JAX distributes elementwise code itself. This function serves code with loops or matrices, whose
    results it would gather on one device. Inside `jit`, JAX reports the distribution only for meshes with explicit
    axes.

    Args:
        function: compiled function of arrays whose first axes are those of the points. Each call with the same function
            uses the same program.
        arrays: arguments of the function. The last array has the axes of the points only.
    """
    import jax

    if jax.device_count() == 1:
        return function(*arrays)
    rank = arrays[-1].ndim
    for array in arrays:
        sharding = jax.typeof(array).sharding if is_traced(array) else array.sharding
        if isinstance(sharding, jax.sharding.NamedSharding) and any(sharding.spec[:rank]):
            target = jax.sharding.NamedSharding(sharding.mesh, jax.sharding.PartitionSpec(*sharding.spec[:rank]))
            arrays = [(jax.reshard if is_traced(array) else jax.device_put)(array, target) for array in arrays]
            return _compile_parts(function, target.mesh, target.spec, len(arrays))(*arrays)
    return function(*arrays)


@lru_cache(CACHED_KERNELS)
def _compile_parts(function: Callable[..., Any], mesh: Any, spec: Any, count: int) -> Callable[..., Any]:
    """Return a function that applies another function of ``count`` arrays on each device to its part of the arrays."""
    import jax

    return jax.jit(jax.shard_map(function, mesh=mesh, in_specs=(spec,) * count, out_specs=spec, check_vma=False))
