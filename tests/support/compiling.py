"""How tests compile what they run once."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from zwidth.core.xp import filter_options

# In a third of the time, for what runs once or a few times: XLA simplifies and fuses, but does little work on machine
# code, in one piece and by its older emitters. Where both were compared the numbers were the same to the last places.
# That the library's own compiled functions are right at full optimization is seen wherever they are called.
QUICKLY = filter_options(
    ("xla_backend_optimization_level", 0),
    ("xla_cpu_use_fusion_emitters", False),
    ("xla_cpu_parallel_codegen_split_count", 1),
)


def compile_bends(slopes: Callable[[Any], Any]) -> Callable[[Any], tuple[np.ndarray, np.ndarray]]:
    """From slopes at a point: slopes at many points, and how they change in each number of the point, last axis.

    One number after the other, by one program: for all at once it compiles twice as long, and slopes need no other.
    """
    along = jax.jit(
        jax.vmap(lambda point, side: jax.jvp(slopes, (point,), (side,)), (0, None)), compiler_options=QUICKLY
    )

    def differentiate(points: Any) -> tuple[np.ndarray, np.ndarray]:
        points = np.asarray(points)
        found = [along(points, side) for side in np.eye(points.shape[-1])]
        return np.asarray(found[0][0]), np.stack([np.asarray(change) for _, change in found], axis=-1)

    return differentiate
