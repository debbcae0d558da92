"""Evaluate compiled functions of arrays that JAX stores in parts on several processors.

JAX calls these processors *devices*, for example GPUs; here a device is never a haptic device. An array is
*distributed* if its parts are stored on several devices. A *point* is one entry of the arguments, for example one wall.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from zwidth.core.types import Array
from zwidth.core.xp import is_traced
from zwidth.numerics.evaluate import CACHED_KERNELS


def map_on_devices(function: Callable[..., Any], arrays: Sequence[Array]) -> Any:
    """Apply a compiled function to JAX arrays; if they are distributed, each device computes its part of the points.

    Use `map_on_devices` for code with loops or matrices, because the compiler of JAX would gather the points of such
    code on one device. Elementwise code does not need it, because the compiler distributes this code itself. Inside
    `jit`, JAX reports how an array is distributed only if the axes of the device mesh are explicit.

    Args:
        function: compiled function of arrays whose first axes are those of the points. Pass the same object in repeated
            calls, because the program for several devices is compiled once per function.
        arrays: arguments of the function. The last array has the axes of the points and no other axes.
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
    """Return a compiled function of ``count`` arrays; on each device, it applies ``function`` to the local parts."""
    import jax

    return jax.jit(jax.shard_map(function, mesh=mesh, in_specs=(spec,) * count, out_specs=spec, check_vma=False))
