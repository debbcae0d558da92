"""Compiler options and helpers for functions that tests run only a few times."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

# These options reduce compilation to a third of the time: XLA simplifies and fuses, but hardly optimizes machine code.
# Results were equal up to the last digits wherever compared. The library's own compiled functions are tested with full
# optimization.
QUICKLY = {
    "xla_backend_optimization_level": 0,
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}


def compile_bends(slopes: Callable[[Any], Any]) -> Callable[[Any], tuple[np.ndarray, np.ndarray]]:
    """Return a function that evaluates ``slopes`` and its Jacobian (last axis) at many points.

    The derivatives are computed one variable at a time by one program, because a program for all variables
    compiles twice as long.
    """
    differentiate_along = jax.jit(
        jax.vmap(lambda point, side: jax.jvp(slopes, (point,), (side,)), (0, None)), compiler_options=QUICKLY
    )

    def differentiate(points: Any) -> tuple[np.ndarray, np.ndarray]:
        points = np.asarray(points)
        columns = [differentiate_along(points, side) for side in np.eye(points.shape[-1])]
        return np.asarray(columns[0][0]), np.stack([np.asarray(change) for _, change in columns], axis=-1)

    return differentiate
